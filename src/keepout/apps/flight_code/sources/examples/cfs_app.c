/* An example: the step in an application of NASA's core Flight System, once a wake-up message.
 *
 * Compiled against the stubs of this folder only (cfs_stubs.h); a real application includes cfe.h in their stead, and
 * its message definitions are the project's own. The image of tables is a cFE table, loaded and kept by Table Services. */
#include "cfs_stubs.h"
#include "mission_tables.h"

typedef struct {
    CFE_SB_PipeId_t pipe;
    CFE_TBL_Handle_t table;
    keepout_tables tables;
    keepout_mission mission;
    keepout_memory memory;
    bool begun;
} keepout_app;

static keepout_app app;

/* cFE calls it for each new image, and activates the image only if the answer is success. */
static CFE_Status_t validate(void *image)
{
    static keepout_tables tried;
    return (keepout_open(image, KEEPOUT_APP_IMAGE_SIZE, &keepout_mission_layout, keepout_mission_digest, &tried)
            == KEEPOUT_IMAGE_GOOD)
               ? CFE_SUCCESS
               : CFE_STATUS_EXTERNAL_RESOURCE_FAIL;
}

static CFE_Status_t take_image(void)
{
    void *image = NULL;
    CFE_Status_t status = CFE_TBL_GetAddress(&image, app.table);
    if ((status == CFE_SUCCESS) || (status == CFE_TBL_INFO_UPDATED)) {
        status = validate(image);
    }
    if (status == CFE_SUCCESS) {
        (void)keepout_open(image, KEEPOUT_APP_IMAGE_SIZE, &keepout_mission_layout, keepout_mission_digest,
                           &app.tables);
        keepout_mission_with(&app.tables, &app.mission);
        app.begun = false;
    }
    return status;
}

static void on_navigation(const keepout_app_navigation *told)
{
    keepout_app_force given;
    keepout_order order;
#if KEEPOUT_SENSORS > 0
    keepout_knowledge known;
    if (!app.begun) {
        keepout_begin(&app.mission, &app.memory, &told->estimate, told->samples, NULL);
    }
    keepout_step(&app.mission, &app.memory, told->samples, &known, &order);
#else
    if (!app.begun) {
        keepout_begin(&app.mission, &app.memory, &told->estimate, NULL);
    }
    keepout_step(&app.mission, &app.memory, &told->estimate, &order);
#endif
    app.begun = true;
    keepout_app_begin_message(&given);
    given.order = order;
    (void)CFE_SB_TransmitMsg(&given.header, true);
}

void keepout_app_main(void)
{
    uint32_t run = CFE_ES_RunStatus_APP_RUN;
    CFE_Status_t status = CFE_SB_CreatePipe(&app.pipe, 4u, "KEEPOUT");
    if (status == CFE_SUCCESS) {
        status = CFE_SB_Subscribe(KEEPOUT_APP_NAVIGATION_MID, app.pipe);
    }
    if (status == CFE_SUCCESS) {
        status = CFE_TBL_Register(&app.table, "Tables", KEEPOUT_APP_IMAGE_SIZE, CFE_TBL_OPT_DEFAULT, validate);
    }
    if (status == CFE_SUCCESS) {
        status = CFE_TBL_Load(app.table, CFE_TBL_SRC_FILE, "/cf/tables.bin");
    }
    if (status == CFE_SUCCESS) {
        status = take_image();
    }
    while ((status == CFE_SUCCESS) && CFE_ES_RunLoop(&run)) {
        const CFE_MSG_Message_t *message = NULL;
        if (CFE_SB_ReceiveBuffer(&message, app.pipe, CFE_SB_PEND_FOREVER) == CFE_SUCCESS) {
            on_navigation((const keepout_app_navigation *)(const void *)message);
        }
    }
    CFE_ES_ExitApp((status == CFE_SUCCESS) ? CFE_ES_RunStatus_APP_EXIT : CFE_ES_RunStatus_APP_ERROR);
}
