/* Fly the mission in closed loop: `fly_mission tables.bin SECONDS > flight.csv`.
 *
 * The true motion is the model of the flight code, without a disturbance; of pulses it takes their mean force, and sensors
 * measure without error once a period. Not for flight: it reads and writes files. */
#include <stdio.h>
#include <stdlib.h>

#include "keepout_internal.h"
#include "mission_tables.h"
#include "flight_begin.h"

#if KEEPOUT_SENSORS > 0
/* What the sensors say now; `past` are the states since KEEPOUT_LATENCY periods ago, and `steps` how many have been. */
static void measure(const keepout_navigation *navigation, const keepout_estimate *past, long steps,
                    keepout_sample samples[KEEPOUT_SENSORS])
{
    double slopes[3][6];
    int i;
    for (i = 0; i < KEEPOUT_SENSORS; i++) {
        samples[i].came = steps >= KEEPOUT_LATENCY;
        (void)keepout_expected(&navigation->sensor[i], past, samples[i].value, slopes);
    }
}
#endif

int main(int count, char **words)
{
    static keepout_tables tables;
    static keepout_mission mission;
    static keepout_memory memory;
    keepout_estimate state = flight_begin;
    FILE *file = (count == 3) ? fopen(words[1], "rb") : NULL;
    const long seconds = (count == 3) ? strtol(words[2], NULL, 10) : 0;
    uint8_t *image = malloc(FLIGHT_IMAGE);
    long i;
#if KEEPOUT_SENSORS > 0
    keepout_estimate past[KEEPOUT_LATENCY + 1];
    keepout_sample samples[KEEPOUT_SENSORS];
    keepout_knowledge known;
    int old;
    for (old = 0; old <= KEEPOUT_LATENCY; old++) {
        past[old] = state;
    }
#endif
    if ((file == NULL) || (image == NULL) || (fread(image, 1u, FLIGHT_IMAGE, file) != FLIGHT_IMAGE)
        || (keepout_open(image, FLIGHT_IMAGE, &keepout_mission_layout, keepout_mission_digest, &tables) != 0)) {
        (void)fprintf(stderr, "fly_mission: give the path of tables.bin and the seconds to fly\n");
        free(image);
        return 2;
    }
    (void)fclose(file);
    keepout_mission_with(&tables, &mission);
#if KEEPOUT_SENSORS > 0
    measure(mission.navigation, past, 0L, samples);
    keepout_begin(&mission, &memory, &state, samples, NULL);
#else
    keepout_begin(&mission, &memory, &state, NULL);
#endif
    (void)printf("time,x,y,z,vx,vy,vz,fx,fy,fz,barrier,control_status,guard_status\n");
    for (i = 0; ((double)i * mission.law->period) <= (double)seconds; i++) {
        keepout_order order;
#if KEEPOUT_SENSORS > 0
        measure(mission.navigation, past, i, samples);
        keepout_step(&mission, &memory, samples, &known, &order);
#else
        keepout_step(&mission, &memory, &state, &order);
#endif
        (void)printf("%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%d,%d\n", state.time,
                     state.position[0], state.position[1], state.position[2], state.velocity[0], state.velocity[1],
                     state.velocity[2], order.force[0], order.force[1], order.force[2], order.barrier,
                     (int)order.control_status, (int)order.guard_status);
        keepout_move(mission.motion, &state, order.mean_force, mission.law->period, mission.law->mass);
#if KEEPOUT_SENSORS > 0
        for (old = 0; old < KEEPOUT_LATENCY; old++) {
            past[old] = past[old + 1];
        }
        past[KEEPOUT_LATENCY] = state;
#endif
    }
    free(image);
    return 0;
}
