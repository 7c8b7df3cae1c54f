/* Stubs of the little of cFE that cfs_app.c calls, so that it compiles without cFS; and the project's own messages. */
#ifndef CFS_STUBS_H
#define CFS_STUBS_H

#include "keepout.h"

typedef int32_t CFE_Status_t;
typedef uint32_t CFE_SB_PipeId_t;
typedef uint32_t CFE_SB_MsgId_t;
typedef int16_t CFE_TBL_Handle_t;
typedef struct {
    double aligned[4];
} CFE_MSG_Message_t;

#define CFE_SUCCESS ((CFE_Status_t)0)
#define CFE_TBL_INFO_UPDATED ((CFE_Status_t)0x4C000014)
#define CFE_STATUS_EXTERNAL_RESOURCE_FAIL ((CFE_Status_t)-5)
#define CFE_ES_RunStatus_APP_RUN 1u
#define CFE_ES_RunStatus_APP_EXIT 2u
#define CFE_ES_RunStatus_APP_ERROR 3u
#define CFE_SB_PEND_FOREVER (-1)
#define CFE_TBL_OPT_DEFAULT 0u
#define CFE_TBL_SRC_FILE 0u

CFE_Status_t CFE_SB_CreatePipe(CFE_SB_PipeId_t *pipe, uint16_t depth, const char *name);
CFE_Status_t CFE_SB_Subscribe(CFE_SB_MsgId_t id, CFE_SB_PipeId_t pipe);
CFE_Status_t CFE_SB_ReceiveBuffer(const CFE_MSG_Message_t **message, CFE_SB_PipeId_t pipe, int32_t time_out);
CFE_Status_t CFE_SB_TransmitMsg(const CFE_MSG_Message_t *message, bool increment);
CFE_Status_t CFE_TBL_Register(CFE_TBL_Handle_t *table, const char *name, size_t size, uint16_t options,
                              CFE_Status_t (*validate)(void *));
CFE_Status_t CFE_TBL_Load(CFE_TBL_Handle_t table, uint32_t kind, const void *source);
CFE_Status_t CFE_TBL_GetAddress(void **address, CFE_TBL_Handle_t table);
bool CFE_ES_RunLoop(uint32_t *status);
void CFE_ES_ExitApp(uint32_t status);

/* The project's own. */
#define KEEPOUT_APP_NAVIGATION_MID 0x1880u
#define KEEPOUT_APP_IMAGE_SIZE ((size_t)16u * 1024u * 1024u)
typedef struct {
    CFE_MSG_Message_t header;
    keepout_estimate estimate; /* with sensors only the first one counts */
#if KEEPOUT_SENSORS > 0
    keepout_sample samples[KEEPOUT_SENSORS];
#endif
} keepout_app_navigation;
typedef struct {
    CFE_MSG_Message_t header;
    keepout_order order;
} keepout_app_force;
void keepout_app_begin_message(keepout_app_force *message);
void keepout_app_main(void);

#endif
