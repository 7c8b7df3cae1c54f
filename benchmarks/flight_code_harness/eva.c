/* For Frama-C Eva: every number that the step is told, all that it remembers and every byte of the image are unknown, not
 * numbers and infinite ones included; the mission's constants are its own. First the image goes through keepout_open;
 * then it is taken for good whatever it holds, so that no bound rests on its checksum. */
#include "__fc_builtin.h"
#include "keepout_internal.h"
#include "mission_tables.h"
#include "flight_begin.h"

static uint8_t image[FLIGHT_IMAGE];
static keepout_tables tables;
static keepout_mission mission;
static keepout_memory memory;
static keepout_estimate estimate;
static keepout_order order;
#if KEEPOUT_SENSORS > 0
static keepout_sample samples[KEEPOUT_SENSORS];
static keepout_knowledge known;
#endif
static double under_way[KEEPOUT_MOST_DELAY][3];

static void anything(void *at, size_t size)
{
    Frama_C_make_unknown(at, size);
}

static bool either(void)
{
    return Frama_C_interval(0, 1) != 0;
}

static void forget(void)
{
    anything(&memory, sizeof memory);
    memory.law.started = either();
    memory.guard.certified = either();
    memory.guard.begun = either();
    memory.guard.left_out = either();
    memory.guard.steady = either();
    anything(&estimate, sizeof estimate);
#if KEEPOUT_SENSORS > 0
    {
        int i;
        anything(samples, sizeof samples);
        for (i = 0; i < KEEPOUT_SENSORS; i++) {
            samples[i].came = either();
        }
    }
#endif
    anything(under_way, sizeof under_way);
}

int main(void)
{
    uint32_t digest;
    anything(image, sizeof image);
    anything(&digest, sizeof digest);
    if (keepout_open(image, (size_t)Frama_C_interval(0, (int)FLIGHT_IMAGE), &keepout_mission_layout, digest, &tables)
        == KEEPOUT_IMAGE_GOOD) {
        keepout_mission_with(&tables, &mission);
        forget();
#if KEEPOUT_SENSORS > 0
        keepout_begin(&mission, &memory, &estimate, samples, either() ? (const double(*)[3])under_way : NULL);
        forget();
        keepout_step(&mission, &memory, samples, &known, &order);
#else
        keepout_begin(&mission, &memory, &estimate, either() ? (const double(*)[3])under_way : NULL);
        forget();
        keepout_step(&mission, &memory, &estimate, &order);
#endif
        keepout_move(mission.motion, &estimate, order.mean_force, mission.law->period, mission.law->mass);
    }
    return 0;
}
