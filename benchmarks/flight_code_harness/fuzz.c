/* Steps on numbers of any kind: `fuzz tables.bin STEPS SEED`. Flights begin anew every 50 steps; between them the motion
 * goes on, is told wrongly, jumps, is no number, or is any bits. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "keepout_internal.h"
#include "mission_tables.h"
#include "flight_begin.h"

static uint64_t state;

static uint64_t next(void)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

static double uniform(void)
{
    return (double)(next() >> 11) / 9007199254740992.0;
}

static double any(void)
{
    const uint64_t bits = next();
    double x;
    switch (next() % 6u) {
    case 0:
        memcpy(&x, &bits, sizeof x);
        break;
    case 1:
        x = NAN;
        break;
    case 2:
        x = ((next() & 1u) != 0u) ? INFINITY : -INFINITY;
        break;
    case 3:
        x = (uniform() - 0.5) * exp(600.0 * uniform());
        break;
    default:
        x = (uniform() - 0.5) * 40.0;
        break;
    }
    return x;
}

static void scatter(keepout_estimate *told)
{
    int i;
    *told = flight_begin;
    for (i = 0; i < 3; i++) {
        told->position[i] = (uniform() - 0.5) * 30.0;
        told->velocity[i] = (uniform() - 0.5) * 0.1;
    }
    told->time = uniform() * 1e5;
}

/* One number in 40 or so is any. */
static void disturb(keepout_estimate *told)
{
    double *numbers[] = {told->position, told->velocity, told->angular_velocity};
    int i;
    int j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            if ((next() % 60u) == 0u) {
                numbers[i][j] = any();
            }
        }
    }
    for (i = 0; i < 4; i++) {
        if ((next() % 400u) == 0u) {
            told->attitude[i] = any();
        }
    }
    if ((next() % 300u) == 0u) {
        told->time = any();
    }
}

#if KEEPOUT_SENSORS > 0
/* What sensors say of a state, now and then nothing, another thing or any numbers. */
static void measure(const keepout_mission *mission, const keepout_estimate *truth, keepout_sample *samples)
{
    int i;
    int j;
    for (i = 0; i < KEEPOUT_SENSORS; i++) {
        double slopes[3][6];
        (void)keepout_expected(&mission->navigation->sensor[i], truth, samples[i].value, slopes);
        samples[i].came = (next() % 8u) != 0u;
        for (j = 0; j < 4; j++) {
            samples[i].value[j] += (uniform() - 0.5) * 0.01;
            if ((next() % 60u) == 0u) {
                samples[i].value[j] = ((next() & 1u) != 0u) ? any() : (samples[i].value[j] + uniform());
            }
        }
    }
}
#endif

/* The memory after a bit was turned somewhere in it, but for its truth values, which C knows as 0 and 1 only. */
static void turn_a_bit(keepout_memory *memory)
{
    double *places[] = {memory->law.velocity,           memory->law.drift,          memory->guard.plan_position,
                        memory->guard.plan_velocity,    memory->guard.unexplained[0], memory->guard.seen_position,
                        memory->guard.expected_velocity, memory->guard.doubts,
                        memory->thrusters.owed,          memory->thrusters.tail};
    const size_t place = (size_t)(next() % 10u);
    double *at = &places[place][next() % ((place < 8u) ? 2u : (uint64_t)KEEPOUT_THRUSTERS)];
    uint64_t bits;
    memcpy(&bits, at, sizeof bits);
    bits ^= (uint64_t)1u << (next() % 64u);
    memcpy(at, &bits, sizeof bits);
#if KEEPOUT_SENSORS > 0
    {
        keepout_navigation_memory *held = &memory->navigation;
        double *whole[] = {&held->settled.covariance[0][0], held->settled.disturbance, held->forces[0],
                           held->set.position.centre, &held->set.velocity.radius, held->set.accelerations[0]};
        double *one = &whole[next() % 6u][0];
        if (one == &held->settled.covariance[0][0]) {
            one = &one[next() % (uint64_t)(KEEPOUT_STATES * KEEPOUT_STATES)];
        }
        memcpy(&bits, one, sizeof bits);
        bits ^= (uint64_t)1u << (next() % 64u);
        memcpy(one, &bits, sizeof bits);
        held->steps = (int32_t)(next() & 0xFFFFFFFFu);
        held->set.elapsed = (int32_t)(next() & 0xFFFFFFFFu);
        held->set.contradictions[next() & 1u] = (int32_t)(next() & 0xFFFFFFFFu);
        held->settled.left_out[next() % (uint64_t)KEEPOUT_SENSORS] = (int32_t)(next() & 0xFFFFFFFFu);
    }
#endif
    if ((next() % 4u) == 0u) {
        memory->guard.counted = (int32_t)(next() & 0xFFFFFFFFu);
    }
}

int main(int count, char **words)
{
    static uint8_t image[FLIGHT_IMAGE];
    static keepout_tables tables;
    static keepout_mission mission;
    static keepout_memory memory;
    keepout_estimate truth = flight_begin;
    keepout_order order;
#if KEEPOUT_SENSORS > 0
    keepout_sample samples[KEEPOUT_SENSORS];
    keepout_knowledge known;
#endif
    FILE *file = (count == 4) ? fopen(words[1], "rb") : NULL;
    const long steps = (count == 4) ? atol(words[2]) : 0;
    long number;
    int i;
    double (*under_way)[3] = calloc(KEEPOUT_MOST_DELAY, sizeof *under_way);
    state = 88172645463325252u ^ ((count == 4) ? ((uint64_t)atol(words[3]) << 20) : 0u);
    if ((file == NULL) || (under_way == NULL) || (fread(image, 1u, FLIGHT_IMAGE, file) != FLIGHT_IMAGE)
        || (keepout_open(image, FLIGHT_IMAGE, &keepout_mission_layout, keepout_mission_digest, &tables) != 0)) {
        return 2;
    }
    (void)fclose(file);
    keepout_mission_with(&tables, &mission);
    memset(&order, 0, sizeof order);
    for (number = 0; number < steps; number++) {
        keepout_estimate told;
        if ((number % 50) == 0) {
            scatter(&truth);
            for (i = 0; i < (3 * KEEPOUT_MOST_DELAY); i++) {
                under_way[i / 3][i % 3] = any();
            }
            told = truth;
            if ((next() % 4u) == 0u) {
                disturb(&told);
            }
#if KEEPOUT_SENSORS > 0
            measure(&mission, &truth, samples);
            keepout_begin(&mission, &memory, &told, samples, ((next() & 1u) != 0u) ? (const double(*)[3])under_way : NULL);
#else
            keepout_begin(&mission, &memory, &told, ((next() & 1u) != 0u) ? (const double(*)[3])under_way : NULL);
#endif
        }
        told = truth;
        if ((next() % 3u) == 0u) {
            disturb(&told);
        }
        if ((next() % 200u) == 0u) {
            turn_a_bit(&memory);
        }
#if KEEPOUT_SENSORS > 0
        measure(&mission, &told, samples);
        keepout_step(&mission, &memory, samples, &known, &order);
#else
        keepout_step(&mission, &memory, &told, &order);
#endif
        keepout_move(mission.motion, &truth, order.mean_force, mission.law->period, mission.law->mass);
    }
    free(under_way);
    (void)printf("%ld steps\n", steps);
    return 0;
}
