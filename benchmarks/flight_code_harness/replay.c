/* Stored steps again: `replay tables.bin steps.bin`, and how many answers are not as stored.
 *
 * The steps are those of Python, which the code has answered alike (flight_code_stored.py). Then the image is damaged in
 * every way that keepout_open tells apart. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "keepout_internal.h"
#include "mission_tables.h"

#define CLOSE 1e-9

typedef struct {
    int32_t of_guard; /* 1: a state of the guard alone, 0: a whole step, 2: a beginning with forces under way */
    int32_t control_status;
    int32_t guard_status;
    int32_t spare;
    double force[3]; /* answered; of a beginning none */
    double commanded[3];
    double disturbance[3];
    double under_way[KEEPOUT_MOST_DELAY][3];
    keepout_estimate estimate;
    keepout_memory before;
    keepout_memory after;
} stored_step;

static int far_from(double a, double b)
{
    const double apart = (a < b) ? (b - a) : (a - b);
    const double size = (a < 0.0) ? -a : a;
    return !((a == b) || ((a != a) && (b != b)) || (apart <= (CLOSE * (1.0 + size))));
}

static int any_far(const double *a, const double *b, size_t count)
{
    size_t i;
    int wrong = 0;
    for (i = 0u; i < count; i++) {
        wrong |= far_from(a[i], b[i]);
    }
    return wrong;
}

#define FAR(x, y) any_far((const double *)(x), (const double *)(y), sizeof(x) / sizeof(double))

static int law_differs(const keepout_mission *mission, const keepout_law_memory *a, const keepout_law_memory *b)
{
    int wrong = FAR(a->velocity, b->velocity) || FAR(a->drift, b->drift) || FAR(a->force, b->force)
                || (a->started != b->started) || ((mission->law->delay > 0) && FAR(a->pending, b->pending));
    return wrong || ((mission->law->model > 0) && FAR(a->model, b->model));
}

static int guard_differs(const keepout_mission *mission, const keepout_guard_memory *a, const keepout_guard_memory *b)
{
    const int seen = mission->guard->observes
                     && (FAR(a->seen_position, b->seen_position) || FAR(a->seen_velocity, b->seen_velocity)
                         || FAR(a->doubts, b->doubts) || FAR(a->begun_doubts, b->begun_doubts)
                         || (a->steady != b->steady));
    return seen || FAR(a->plan_position, b->plan_position) || FAR(a->plan_velocity, b->plan_velocity)
           || FAR(a->expected_position, b->expected_position) || FAR(a->expected_velocity, b->expected_velocity)
           || ((mission->guard->delay > 0) && FAR(a->pending, b->pending))
           || ((mission->guard->windows > 0) && FAR(a->unexplained, b->unexplained)) || (a->counted != b->counted)
           || (a->certified != b->certified) || (a->begun != b->begun) || (a->left_out != b->left_out);
}

static int answers_otherwise(const keepout_mission *mission, stored_step *step)
{
    keepout_order order;
    int wrong;
    memset(&order, 0, sizeof order);
    if (step->of_guard == 1) {
        order.guard_status = keepout_guard_filter(mission, &step->before.guard, &step->estimate, step->commanded,
                                                  step->disturbance, order.force);
        order.control_status = step->control_status;
    } else if (step->of_guard == 2) {
        keepout_begin(mission, &step->before, &step->estimate, (const double(*)[3])step->under_way);
        order.guard_status = step->guard_status;
        order.control_status = step->control_status;
    } else {
        keepout_step(mission, &step->before, &step->estimate, &order);
    }
    wrong = FAR(order.force, step->force) || (order.guard_status != step->guard_status)
            || (order.control_status != step->control_status);
    if (step->of_guard != 1) {
        wrong = wrong || law_differs(mission, &step->before.law, &step->after.law);
    }
    if (mission->guard->present) {
        wrong = wrong || guard_differs(mission, &step->before.guard, &step->after.guard);
    }
    return wrong;
}

static uint32_t checksum_of(const uint8_t *bytes, size_t size)
{
    uint32_t sum = 0xFFFFFFFFu;
    size_t i;
    int bit;
    for (i = 0u; i < size; i++) {
        sum ^= bytes[i];
        for (bit = 0; bit < 8; bit++) {
            sum = (sum >> 1) ^ (((sum & 1u) != 0u) ? 0xEDB88320u : 0u);
        }
    }
    return sum ^ 0xFFFFFFFFu;
}

static void put(uint8_t *at, uint32_t number)
{
    int i;
    for (i = 0; i < 4; i++) {
        at[i] = (uint8_t)(number >> (8 * i));
    }
}

/* Images that must be refused, and as what. */
static int images_taken_otherwise(uint8_t *image, size_t size)
{
    static const struct {
        size_t place;
        int32_t answer;
    } damage[] = {{0, KEEPOUT_IMAGE_NOT_ONE},  {8, KEEPOUT_IMAGE_VERSION},  {12, KEEPOUT_IMAGE_VERSION},
                  {20, KEEPOUT_IMAGE_DAMAGED}, {100, KEEPOUT_IMAGE_DAMAGED}};
    keepout_tables tables;
    int wrong = 0;
    size_t i;
    uint32_t digest;
    for (i = 0u; i < (sizeof damage / sizeof damage[0]); i++) {
        image[damage[i].place] ^= 1u;
        wrong += keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest, &tables) != damage[i].answer;
        image[damage[i].place] ^= 1u;
    }
    wrong += keepout_open(image, 23u, &keepout_mission_layout, keepout_mission_digest, &tables) != KEEPOUT_IMAGE_SHORT;
    wrong += keepout_open(image, size - 1u, &keepout_mission_layout, keepout_mission_digest, &tables)
             != KEEPOUT_IMAGE_SHORT;
    wrong += keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest ^ 1u, &tables)
             != KEEPOUT_IMAGE_OF_ANOTHER;
    /* Parts that are not as long, or as many, as the layout says, under a checksum that holds. */
    for (i = 24u; i <= 28u; i = i + 4u) {
        for (digest = 0u; digest < 2u; digest++) {
            uint8_t before[4];
            memcpy(before, &image[i], 4u);
            put(&image[i], (digest == 0u) ? 0xFFFFFFFFu : 1u);
            put(&image[20], checksum_of(&image[24], size - 24u));
            wrong += keepout_open(image, size, &keepout_mission_layout, checksum_of(&image[24], size - 24u), &tables)
                     != KEEPOUT_IMAGE_WRONG;
            memcpy(&image[i], before, 4u);
            put(&image[20], checksum_of(&image[24], size - 24u));
        }
    }
    for (i = 0u; i <= 4u; i = i + 4u) { /* too short for the number of parts, or for one */
        uint8_t small[32] = "KEEPOUT";
        put(&small[8], KEEPOUT_FORMAT);
        put(&small[12], 0x01020304u);
        put(&small[16], (uint32_t)i);
        put(&small[20], checksum_of(&small[24], i));
        wrong += keepout_open(small, 24u + i, &keepout_mission_layout, checksum_of(&small[24], i), &tables)
                 != KEEPOUT_IMAGE_WRONG;
    }
    return wrong;
}

static uint8_t *read_file(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    uint8_t *bytes = NULL;
    if ((file != NULL) && (fseek(file, 0L, SEEK_END) == 0)) {
        *size = (size_t)ftell(file);
        rewind(file);
        bytes = malloc(*size + 1u);
        if ((bytes != NULL) && (fread(bytes, 1u, *size, file) != *size)) {
            free(bytes);
            bytes = NULL;
        }
    }
    if (file != NULL) {
        (void)fclose(file);
    }
    return bytes;
}

int main(int count, char **words)
{
    static keepout_tables tables;
    static keepout_mission mission;
    size_t size = 0u;
    size_t stored = 0u;
    size_t i;
    long wrong = 0;
    uint8_t *image = (count == 3) ? read_file(words[1], &size) : NULL;
    uint8_t *steps = (count == 3) ? read_file(words[2], &stored) : NULL;
    if ((image == NULL) || (steps == NULL) || ((stored % sizeof(stored_step)) != 0u)) {
        (void)fprintf(stderr, "replay: give tables.bin and steps.bin, of records of %zu bytes\n", sizeof(stored_step));
        return 2;
    }
    if (keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest, &tables) != KEEPOUT_IMAGE_GOOD) {
        (void)printf("the image is refused\n");
        return 1;
    }
    keepout_mission_with(&tables, &mission);
    for (i = 0u; i < (stored / sizeof(stored_step)); i++) {
        stored_step step;
        memcpy(&step, &steps[i * sizeof step], sizeof step);
        wrong += answers_otherwise(&mission, &step);
    }
    i = stored / sizeof(stored_step);
    wrong += images_taken_otherwise(image, size);
    (void)printf("%zu steps, %ld answers that are not as stored\n", i, wrong);
    free(image);
    free(steps);
    return (wrong == 0) ? 0 : 1;
}
