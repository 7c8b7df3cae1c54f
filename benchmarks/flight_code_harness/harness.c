/* The step as a library: many steps at once, for comparison with Python. */
#include "keepout_internal.h"
#include "mission_tables.h"

static keepout_tables tables;
static keepout_mission mission;

int harness_open(const uint8_t *image, size_t size)
{
    const int32_t answer = keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest, &tables);
    if (answer == KEEPOUT_IMAGE_GOOD) {
        keepout_mission_with(&tables, &mission);
    }
    return (int)answer;
}

#if KEEPOUT_SENSORS > 0
void harness_begin(int count, const keepout_estimate *estimate, const double (*under_way)[3],
                   const keepout_sample (*samples)[KEEPOUT_SENSORS], keepout_memory *memory)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_begin(&mission, &memory[i], &estimate[i], samples[i], under_way);
    }
}

void harness_step(int count, keepout_memory *memory, const keepout_sample (*samples)[KEEPOUT_SENSORS],
                  keepout_knowledge *knowledge, keepout_order *order)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_step(&mission, &memory[i], samples[i], &knowledge[i], &order[i]);
    }
}

/* Of navigation alone what is known by samples, and then the force (N) that is commanded. */
void harness_navigate(int count, keepout_memory *memory, const keepout_sample (*samples)[KEEPOUT_SENSORS],
                      const double (*force)[3], keepout_knowledge *knowledge)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_navigation_know(&mission, &memory[i].navigation, samples[i], &knowledge[i]);
        keepout_navigation_told(&mission, &memory[i].navigation, force[i]);
    }
}
#else
void harness_begin(int count, const keepout_estimate *estimate, const double (*under_way)[3], keepout_memory *memory)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_begin(&mission, &memory[i], &estimate[i], under_way);
    }
}

void harness_step(int count, keepout_memory *memory, const keepout_estimate *estimate, keepout_order *order)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_step(&mission, &memory[i], &estimate[i], &order[i]);
    }
}
#endif

void harness_guard(int count, keepout_memory *memory, const keepout_estimate *estimate, const keepout_doubt *doubt,
                   const double (*force)[3], const double (*disturbance)[3], double (*filtered)[3], int32_t *status)
{
    int i;
    for (i = 0; i < count; i++) {
        status[i] = keepout_guard_filter(&mission, &memory[i].guard, &estimate[i], &doubt[i], force[i], disturbance[i],
                                         filtered[i]);
    }
}

/* Forces (N) for the thrusters alone. */
void harness_fire(int count, keepout_memory *memory, const double (*force)[3], keepout_order *order)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_copy(force[i], order[i].force);
        keepout_thrusters_fire(mission.thrusters, &memory[i].thrusters, &order[i]);
    }
}

/* Values of the guard's field and of the law's, (count) each. */
void harness_fields(int count, const double (*point)[3], double *guard, double *law)
{
    int i;
    for (i = 0; i < count; i++) {
        double gradient[3];
        keepout_cell cell;
        cell.known = false;
        guard[i] = mission.guard->present ? keepout_spline_value(mission.guard_spline, point[i], &cell) : 0.0;
        law[i] = (mission.law->field == KEEPOUT_NETWORK)
                     ? keepout_network_value_and_gradient(mission.network, point[i], gradient)
                     : keepout_spline_value(mission.law_spline, point[i], &cell);
    }
}

/* A control period on under a force (N) that is held. */
void harness_move(int count, keepout_estimate *state, const double (*force)[3])
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_move(mission.motion, &state[i], force[i], mission.law->period, mission.law->mass);
    }
}

#if KEEPOUT_SENSORS == 0
void harness_fly(int count, keepout_estimate *state, const double (*push)[3], int steps)
{
    int i;
    for (i = 0; i < count; i++) {
        keepout_memory memory;
        int step;
        keepout_begin(&mission, &memory, &state[i], NULL);
        for (step = 0; step < steps; step++) {
            keepout_order order;
            double force[3];
            int axis;
            keepout_step(&mission, &memory, &state[i], &order);
            for (axis = 0; axis < 3; axis++) {
                force[axis] = order.mean_force[axis] + push[i][axis];
            }
            keepout_move(mission.motion, &state[i], force, mission.law->period, mission.law->mass);
        }
    }
}
#endif
