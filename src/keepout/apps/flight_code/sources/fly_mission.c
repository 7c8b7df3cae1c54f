/* Fly the mission in closed loop: `fly_mission tables.bin SECONDS > flight.csv`.
 *
 * The true motion is the model of the flight code, without a disturbance; of pulses it takes their mean force. Not for flight: it reads and writes files. */
#include <stdio.h>
#include <stdlib.h>

#include "keepout_internal.h"
#include "mission_tables.h"
#include "flight_begin.h"

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
    if ((file == NULL) || (image == NULL) || (fread(image, 1u, FLIGHT_IMAGE, file) != FLIGHT_IMAGE)
        || (keepout_open(image, FLIGHT_IMAGE, &keepout_mission_layout, keepout_mission_digest, &tables) != 0)) {
        (void)fprintf(stderr, "fly_mission: give the path of tables.bin and the seconds to fly\n");
        free(image);
        return 2;
    }
    (void)fclose(file);
    keepout_mission_with(&tables, &mission);
    keepout_begin(&mission, &memory, &state, NULL);
    (void)printf("time,x,y,z,vx,vy,vz,fx,fy,fz,barrier,control_status,guard_status\n");
    for (i = 0; ((double)i * mission.law->period) <= (double)seconds; i++) {
        keepout_order order;
        keepout_step(&mission, &memory, &state, &order);
        (void)printf("%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%d,%d\n", state.time,
                     state.position[0], state.position[1], state.position[2], state.velocity[0], state.velocity[1],
                     state.velocity[2], order.force[0], order.force[1], order.force[2], order.barrier,
                     (int)order.control_status, (int)order.guard_status);
        keepout_move(mission.motion, &state, order.mean_force, mission.law->period, mission.law->mass);
    }
    free(image);
    return 0;
}
