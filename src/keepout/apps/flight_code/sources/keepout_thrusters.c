/* Thrusters of a layout, on or off: a force becomes one pulse a thruster and control period. In Python:
 * flights/thrusters/on_off.py, Allocation and OnOffThrusters; what pulses do wrong: docs/motion.md. */
#include <math.h>

#include "keepout_internal.h"

static int32_t least_of(int32_t count, int32_t room)
{
    return (count < room) ? count : room;
}

/* The point of the list at which lambda . u - fee is largest, the first of several. Of a force that is not a number all
 * shares are none, whatever the point. In Python: on_off._largest. */
static int32_t best_point(const keepout_thrusters *thrusters, const double force[3])
{
    const int32_t points = least_of(thrusters->points, KEEPOUT_POINTS);
    double most = -HUGE_VAL;
    int32_t best = 0;
    int32_t i;
    for (i = 0; i < points; i++) {
        const double value = keepout_dot(thrusters->price[i], force) - thrusters->fee[i];
        if (value > most) {
            most = value;
            best = i;
        }
    }
    return best;
}

/* Forces of the groups for a mean force (N): as far as their torques cancel, and what is left of them. In Python:
 * Allocation.shares, up to the thrusters of a group. */
static void groups_of(const keepout_thrusters *thrusters, const double force[3], double balanced[KEEPOUT_GROUPS],
                      double rest[KEEPOUT_GROUPS])
{
    const int32_t groups = least_of(thrusters->groups, KEEPOUT_GROUPS);
    const int32_t best = best_point(thrusters, force);
    int32_t i;
    for (i = 0; i < groups; i++) {
        const double asked = keepout_dot(thrusters->slope[best][i], force) + thrusters->offset[best][i];
        const double wanted = keepout_clip(asked, 0.0, thrusters->largest[i]);
        balanced[i] = keepout_minimum(wanted, thrusters->balanced[i]);
        rest[i] = wanted - balanced[i];
    }
}

/* Share of the period, 0 to 1, for which a thruster is to be on. In Python: Allocation.shares. */
static double share_of(const keepout_thrusters *thrusters, int32_t number, const double balanced[KEEPOUT_GROUPS],
                       const double rest[KEEPOUT_GROUPS])
{
    const int32_t group = thrusters->group[number];
    return keepout_minimum((thrusters->paired[number] * balanced[group]) + (thrusters->alone[number] * rest[group]), 1.0);
}

/* In Python: OnOffThrusters.initial_state, of thrusters that push as they should. */
void keepout_thrusters_begin(keepout_thruster_memory *memory)
{
    int32_t i;
    for (i = 0; i < KEEPOUT_THRUSTERS; i++) {
        memory->owed[i] = 0.0;
        memory->tail[i] = 0.0;
    }
}

/* The pulse of one thruster, s; what is owed is kept. In Python: OnOffThrusters.fire, `given` and `owed`. */
static double pulse_of(const keepout_thrusters *thrusters, double share, double *owed)
{
    const double wanted = (thrusters->period * share) + *owed;
    const double given = (wanted <= (0.5 * thrusters->least_on_time))
                             ? 0.0
                             : keepout_clip(wanted, thrusters->least_on_time, thrusters->period);
    if (thrusters->delta_sigma) {
        *owed = wanted - given;
    }
    return given;
}

/* Put the pulses of the coming period for `order->force`, and their mean force, into the order. In Python:
 * OnOffThrusters.fire and Pulses.mean; without a layout motion/chaser.py, Thrusters.fire. */
void keepout_thrusters_fire(const keepout_thrusters *thrusters, keepout_thruster_memory *memory, keepout_order *order)
{
    const int32_t count = least_of(thrusters->count, KEEPOUT_THRUSTERS);
    const double T = thrusters->period;
    double balanced[KEEPOUT_GROUPS];
    double rest[KEEPOUT_GROUPS];
    double force[3];
    double tails[3] = {0.0, 0.0, 0.0}; /* N s, of pulses of the period before */
    double given[3] = {0.0, 0.0, 0.0}; /* N s, of the coming ones */
    int32_t i;
    int32_t axis;
    for (axis = 0; axis < 3; axis++) {
        force[axis] = keepout_clip(order->force[axis], -thrusters->force_limit, thrusters->force_limit);
    }
    for (i = 0; i < KEEPOUT_THRUSTERS; i++) {
        order->pulse[i] = 0.0;
        order->on_time[i] = 0.0;
    }
    for (i = 0; i < KEEPOUT_GROUPS; i++) {
        balanced[i] = 0.0;
        rest[i] = 0.0;
    }
    groups_of(thrusters, force, balanced, rest);
    for (i = 0; i < count; i++) {
        const double pulse = pulse_of(thrusters, share_of(thrusters, i, balanced, rest), &memory->owed[i]);
        const double tail = memory->tail[i];
        const double begin = (0.5 * (T - pulse)) + thrusters->rise_delay;
        const double end = begin + pulse;
        const double from = keepout_minimum(begin, T);
        const double until = keepout_minimum(end, T);
        order->pulse[i] = pulse;
        order->on_time[i] = (tail + until) - from;
        memory->tail[i] = keepout_maximum(end - T, 0.0);
        for (axis = 0; axis < 3; axis++) {
            tails[axis] = tails[axis] + (tail * thrusters->push[i][axis]);
            given[axis] = given[axis] + ((until - from) * thrusters->push[i][axis]);
        }
    }
    for (axis = 0; axis < 3; axis++) {
        order->mean_force[axis] = (count > 0) ? ((tails[axis] + given[axis]) / T) : force[axis];
    }
}
