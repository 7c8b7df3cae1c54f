/* Stored steps again: `replay tables.bin steps.bin fields.bin`, the last if it is there; and how many answers
 * are not as stored.
 *
 * The steps are those of Python, which the code has answered alike (flight_code_stored.py). Then the image is damaged in
 * every way that keepout_open tells apart. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "keepout_internal.h"
#include "mission_tables.h"

#define CLOSE 1e-9
#define RADII 1e-14 /* of the set that is begun with, which allows for ten times as much rounding */
#define OWN 2e-14 /* of the functions of keepout_math.c */

typedef struct {
    int32_t kind; /* 0: a whole step, 1: a state of the guard alone, 2: a beginning with forces under way, 3: a force for
                   * the thrusters alone, 4: samples and a force for navigation alone */
    int32_t control_status;
    int32_t guard_status;
    int32_t spare;
    double force[3]; /* answered; of a beginning none, of thrusters what they are told */
    double mean_force[3]; /* answered, of a whole step and of thrusters; likewise the two below */
    double pulse[KEEPOUT_THRUSTERS];
    double on_time[KEEPOUT_THRUSTERS];
    double commanded[3];
    double disturbance[3];
    keepout_doubt doubt;
#if KEEPOUT_SENSORS > 0
    keepout_sample samples[KEEPOUT_SENSORS];
    keepout_knowledge known;
#endif
    double under_way[KEEPOUT_MOST_DELAY][3];
    keepout_estimate estimate;
    keepout_memory before;
    keepout_memory after;
} stored_step;

static int further(double a, double b, double close)
{
    const double apart = (a < b) ? (b - a) : (a - b);
    const double size = (a < 0.0) ? -a : a;
    return !((a == b) || ((a != a) && (b != b)) || (apart <= (close * (1.0 + size))));
}

static int far_from(double a, double b)
{
    return further(a, b, CLOSE);
}

static int off(double a, double b)
{
    return further(a, b, OWN);
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

static int thrusters_differ(const stored_step *step, const keepout_order *order)
{
    return FAR(order->mean_force, step->mean_force) || FAR(order->pulse, step->pulse)
           || FAR(order->on_time, step->on_time);
}

static int owed_differs(const stored_step *step)
{
    return FAR(step->before.thrusters.owed, step->after.thrusters.owed)
           || FAR(step->before.thrusters.tail, step->after.thrusters.tail);
}

#if KEEPOUT_SENSORS > 0
static int estimates_differ(const keepout_estimate *a, const keepout_estimate *b)
{
    return far_from(a->time, b->time) || FAR(a->position, b->position) || FAR(a->velocity, b->velocity)
           || FAR(a->attitude, b->attitude) || FAR(a->angular_velocity, b->angular_velocity);
}

static int known_differs(const keepout_knowledge *a, const keepout_knowledge *b)
{
    return estimates_differ(&a->estimate, &b->estimate) || FAR(a->disturbance, b->disturbance)
           || (a->outliers != b->outliers) || estimates_differ(&a->known, &b->known) || FAR(a->errors, b->errors)
           || (a->contradicted != b->contradicted);
}

/* Over the product of both standard deviations. */
static int covariances_differ(const keepout_belief *a, const keepout_belief *b)
{
    int wrong = 0;
    int i;
    int j;
    for (i = 0; i < KEEPOUT_STATES; i++) {
        for (j = 0; j < KEEPOUT_STATES; j++) {
            const double spread = sqrt(b->covariance[i][i] * b->covariance[j][j]);
            wrong |= !(fabs(a->covariance[i][j] - b->covariance[i][j]) <= (CLOSE * spread));
        }
    }
    return wrong;
}

static int balls_differ(const keepout_ball *a, const keepout_ball *b, double close)
{
    return FAR(a->centre, b->centre) || further(a->radius, b->radius, close);
}

static int set_differs(const keepout_set_memory *a, const keepout_set_memory *b, double close)
{
    int wrong = balls_differ(&a->position, &b->position, close) || balls_differ(&a->velocity, &b->velocity, close)
                || FAR(a->attitudes, b->attitudes) || (a->elapsed != b->elapsed)
                || (a->contradictions[0] != b->contradictions[0]) || (a->contradictions[1] != b->contradictions[1]);
#if (KEEPOUT_LATENCY > 0) || (KEEPOUT_WINDOW > 0)
    wrong = wrong || FAR(a->accelerations, b->accelerations);
#endif
#if KEEPOUT_WINDOW == KEEPOUT_KEPT
    wrong = wrong || FAR(a->centres, b->centres) || FAR(a->radii, b->radii);
#endif
    return wrong;
}

static int navigation_differs(const keepout_mission *mission, const keepout_navigation_memory *a,
                              const keepout_navigation_memory *b, double close)
{
    int wrong = estimates_differ(&a->settled.motion, &b->settled.motion)
                || FAR(a->settled.disturbance, b->settled.disturbance) || covariances_differ(&a->settled, &b->settled)
                || FAR(a->forces, b->forces) || (a->steps != b->steps) || set_differs(&a->set, &b->set, close)
                || ((mission->law->delay > 0) && FAR(a->pending, b->pending));
    int i;
    for (i = 0; i < KEEPOUT_SENSORS; i++) {
        wrong |= a->settled.left_out[i] != b->settled.left_out[i];
    }
    return wrong;
}
#endif

static int answers_otherwise(const keepout_mission *mission, stored_step *step)
{
    keepout_order order;
    int wrong;
    int wrong_knowledge = 0;
    memset(&order, 0, sizeof order);
#if KEEPOUT_SENSORS > 0
    keepout_knowledge known;
    if (step->kind == 4) {
        keepout_navigation_know(mission, &step->before.navigation, step->samples, &known);
        keepout_navigation_told(mission, &step->before.navigation, step->force);
        return known_differs(&known, &step->known)
               || navigation_differs(mission, &step->before.navigation, &step->after.navigation, CLOSE);
    }
#endif
    if (step->kind == 3) {
        keepout_copy(step->force, order.force);
        keepout_thrusters_fire(mission->thrusters, &step->before.thrusters, &order);
        return thrusters_differ(step, &order) || owed_differs(step);
    }
    if (step->kind == 1) {
        order.guard_status = keepout_guard_filter(mission, &step->before.guard, &step->estimate, &step->doubt,
                                                  step->commanded, step->disturbance, order.force);
        order.control_status = step->control_status;
    } else if (step->kind == 2) {
#if KEEPOUT_SENSORS > 0
        keepout_begin(mission, &step->before, &step->estimate, step->samples, (const double(*)[3])step->under_way);
#else
        keepout_begin(mission, &step->before, &step->estimate, (const double(*)[3])step->under_way);
#endif
        order.guard_status = step->guard_status;
        order.control_status = step->control_status;
    } else {
#if KEEPOUT_SENSORS > 0
        keepout_step(mission, &step->before, step->samples, &known, &order);
        wrong_knowledge = known_differs(&known, &step->known);
#else
        keepout_step(mission, &step->before, &step->estimate, &order);
#endif
    }
    wrong = FAR(order.force, step->force) || (order.guard_status != step->guard_status)
            || (order.control_status != step->control_status);
    wrong = wrong || wrong_knowledge;
    if (step->kind == 0) {
        wrong = wrong || thrusters_differ(step, &order);
    }
    if (step->kind != 1) {
#if KEEPOUT_SENSORS > 0
        wrong = wrong
                || navigation_differs(mission, &step->before.navigation, &step->after.navigation,
                                      (step->kind == 2) ? RADII : CLOSE);
#endif
        wrong = wrong || owed_differs(step) || law_differs(mission, &step->before.law, &step->after.law);
    }
    if (mission->guard->present) {
        wrong = wrong || guard_differs(mission, &step->before.guard, &step->after.guard);
    }
    return wrong;
}

/* Functions of keepout_math.c over their whole range, against the library's. */
static int functions_otherwise(void)
{
    static const double at[] = {0.0,    1e-320, 1e-310, 1e-9,  0.1,   0.29, 0.36, 0.5,   0.999, 1.0,      1.5,  1.89, 2.0,
                                3.3,    10.0,   21.9,   22.5,  123.4, 700., 709.7, 711.0, 1e5,   1.234e7, 1e150, 1e308,
                                HUGE_VAL};
    int wrong = 0;
    size_t i;
    size_t j;
    for (i = 0u; i < (2u * (sizeof at / sizeof at[0])); i++) {
        const double x = ((i % 2u) == 0u) ? at[i / 2u] : -at[i / 2u];
        wrong += off(keepout_exp(x), exp(x)) + off(keepout_expm1(x), expm1(x));
        wrong += off(keepout_log(x), log(x)) + off(keepout_log1p(x), log1p(x));
        wrong += off(keepout_tanh(x), tanh(x));
        wrong += (fabs(x) < 1e3) ? (off(keepout_sin(x), sin(x)) + off(keepout_cos(x), cos(x))) : 0;
        /* Beyond 1e6 it is the sine of the remainder by the double 2 pi. */
        wrong += (fabs(x) > 1e6) ? off(keepout_sin(x), sin(fmod(x, 2.0 * KEEPOUT_PI))) : 0;
        wrong += (x >= 0.0) ? off(keepout_cbrt(x), cbrt(x)) : 0;
        wrong += (fabs(x) <= 1.0) ? off(keepout_acos(x), acos(x)) : 0;
        for (j = 0u; j < (sizeof at / sizeof at[0]); j++) {
            if (((x != 0.0) || (at[j] != 0.0)) && (isfinite(x) || isfinite(at[j]))) {
                wrong += off(keepout_atan2(x, at[j]), atan2(x, at[j]))
                         + (((x != 0.0) && (at[j] != 0.0)) ? off(keepout_atan2(x, -at[j]), atan2(x, -at[j])) : 0);
            }
        }
    }
    wrong += !keepout_is_nan(keepout_exp(NAN)) + !keepout_is_nan(keepout_log(NAN)) + !keepout_is_nan(keepout_tanh(NAN));
    wrong += !keepout_is_nan(keepout_atan2(NAN, 1.0)) + !keepout_is_nan(keepout_atan2(1.0, NAN));
    wrong += (keepout_atan2(0.0, 0.0) != 0.0);
    wrong += !keepout_is_nan(keepout_maximum(NAN, 1.0)) + !keepout_is_nan(keepout_maximum(1.0, NAN));
    wrong += !keepout_is_nan(keepout_minimum(NAN, 1.0)) + !keepout_is_nan(keepout_minimum(1.0, NAN));
    wrong += (keepout_to_index(NAN, 2, 5) != 2) + (keepout_to_index(1e300, 2, 5) != 5) + (keepout_to_index(-1e300, 2, 5) != 2);
    wrong += (keepout_to_index(3.9, 2, 5) != 3) + (keepout_to_index(5.0, 2, 5) != 5) + (keepout_to_index(1.0, 2, 5) != 2);
    return wrong;
}

/* A network of one layer whose width is no multiple of the sums that go on side by side, against plain loops. */
static int network_otherwise(void)
{
    enum { MOST = 11 };
    static float weights[MOST][3];
    static float biases[MOST];
    static float last[MOST];
    keepout_network made;
    const int32_t width = (KEEPOUT_WIDTH < MOST) ? KEEPOUT_WIDTH : MOST;
    const double point[3] = {0.2, -0.3, 0.4};
    double gradient[3];
    double told[3] = {0.0, 0.0, 0.0};
    double value = 0.25;
    int32_t i;
    int32_t j;
    memset(&made, 0, sizeof made);
    for (i = 0; i < width; i++) {
        double z;
        biases[i] = (float)(0.1 * i) - 0.4f;
        last[i] = 1.0f / (float)(i + 2);
        for (j = 0; j < 3; j++) {
            weights[i][j] = (float)(((7 * i) + (5 * j)) % 9) / 8.0f - 0.5f;
        }
        z = biases[i];
        for (j = 0; j < 3; j++) {
            z = z + ((double)weights[i][j] * (point[j] / 2.0));
        }
        value = value + ((double)last[i] * (log1p(exp(3.0 * z)) / 3.0));
        for (j = 0; j < 3; j++) {
            told[j] = told[j] + ((double)last[i] * (double)weights[i][j] / (1.0 + exp(-3.0 * z)));
        }
    }
    made.layers = 1;
    made.width[0] = width;
    made.weights[0] = &weights[0][0];
    made.biases[0] = biases;
    made.last_weights = last;
    made.last_bias = 0.25f;
    made.beta = 3.0;
    made.scale = 2.0;
    made.continuation.target_radius = 5.0;
    made.continuation.domain_radius = 8.0;
    made.continuation.outer_radius = 10.0;
    return far_from(keepout_network_value_and_gradient(&made, point, gradient), 2.0 * value) || FAR(gradient, told);
}

#if KEEPOUT_SENSORS == 0
/* A law whose field has no gradient, or no value, and no guard: no way out below 0, and no number. */
static int flat_field_otherwise(const keepout_mission *mission)
{
    static const float none[3] = {0.0f, 0.0f, 0.0f};
    static const keepout_estimate told = {0.0, {1.0, 2.0, 3.0}, {0.01, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    keepout_network flat;
    keepout_mission alone = *mission;
    keepout_law law = *mission->law;
    keepout_guard guard = *mission->guard;
    keepout_memory memory;
    keepout_order order;
    int wrong = 0;
    memset(&flat, 0, sizeof flat);
    memset(&memory, 0, sizeof memory);
    flat.layers = 1;
    flat.width[0] = 1;
    flat.weights[0] = none;
    flat.biases[0] = none;
    flat.last_weights = none;
    flat.beta = 1.0;
    flat.scale = 1.0;
    flat.continuation.target_radius = 5.0;
    flat.continuation.domain_radius = 8.0;
    flat.continuation.outer_radius = 10.0;
    law.field = KEEPOUT_NETWORK;
    guard.present = false;
    alone.network = &flat;
    alone.law = &law;
    alone.guard = &guard;
    flat.last_bias = -1.0e4f;
    keepout_begin(&alone, &memory, &told, NULL);
    keepout_step(&alone, &memory, &told, &order);
    wrong += (order.control_status != KEEPOUT_LAW_NO_WAY_OUT) + (order.guard_status != 0);
    flat.last_bias = (float)NAN;
    keepout_step(&alone, &memory, &told, &order);
    wrong += (order.control_status != KEEPOUT_LAW_NOT_FINITE) + (order.force[0] != 0.0);
    return wrong;
}
#endif

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

/* Values of the fields, and the gradient of the law's: eight numbers a place. */
static int fields_otherwise(const keepout_mission *mission, const double *told)
{
    double gradient[3];
    keepout_cell cell;
    int wrong = 0;
    double law;
    cell.known = false;
    if (mission->guard->present) {
        wrong = far_from(keepout_spline_value(mission->guard_spline, told, &cell), told[3]);
    }
    if (mission->law->field == KEEPOUT_NETWORK) {
        law = keepout_network_value_and_gradient(mission->network, told, gradient);
    } else {
        law = keepout_spline_value_and_gradient(mission->law_spline, told, gradient);
    }
    return wrong || far_from(law, told[4]) || any_far(gradient, &told[5], 3u);
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
            put(&image[i], (digest == 0u) ? 0xFFFFFFFFu : ((before[0] == 1u) ? 2u : 1u));
            put(&image[20], checksum_of(&image[24], size - 24u));
            wrong += keepout_open(image, size, &keepout_mission_layout, checksum_of(&image[24], size - 24u), &tables)
                     != KEEPOUT_IMAGE_WRONG;
            memcpy(&image[i], before, 4u);
            put(&image[20], checksum_of(&image[24], size - 24u));
        }
    }
    { /* one part more, of no bytes, under a checksum that holds */
        uint8_t *longer = malloc(size + 4u);
        if (longer != NULL) {
            const uint32_t parts = image[24];
            memcpy(longer, image, 28u + (4u * parts));
            put(&longer[28u + (4u * parts)], 0u);
            memcpy(&longer[32u + (4u * parts)], &image[28u + (4u * parts)], size - (28u + (4u * parts)));
            put(&longer[24], parts + 1u);
            put(&longer[16], (uint32_t)(size - 20u));
            put(&longer[20], checksum_of(&longer[24], size - 20u));
            wrong += keepout_open(longer, size + 4u, &keepout_mission_layout, checksum_of(&longer[24], size - 20u), &tables)
                     != KEEPOUT_IMAGE_WRONG;
            free(longer);
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
    size_t place = 0u;
    uint8_t *image = (count >= 3) ? read_file(words[1], &size) : NULL;
    uint8_t *steps = (count >= 3) ? read_file(words[2], &stored) : NULL;
    uint8_t *places = (count == 4) ? read_file(words[3], &place) : NULL;
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
    for (i = 0u; (places != NULL) && (i < (place / 64u)); i++) {
        double told[8];
        memcpy(told, &places[64u * i], sizeof told);
        wrong += fields_otherwise(&mission, told);
    }
    i = stored / sizeof(stored_step);
    wrong += images_taken_otherwise(image, size) + functions_otherwise() + network_otherwise();
#if KEEPOUT_SENSORS == 0
    wrong += flat_field_otherwise(&mission);
#endif
    (void)printf("%zu steps, %ld answers that are not as stored\n", i, wrong);
    free(image);
    free(steps);
    free(places);
    return (wrong == 0) ? 0 : 1;
}
