/* One control step: the law, then the guard, then the thrusters. In Python: core/flight/loop.py, `memories`, `command`
 * and of `step` what the thrusters fire. */
#include "keepout_internal.h"

void keepout_begin(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                   const double (*under_way)[3])
{
    keepout_law_begin(mission, &memory->law, estimate, under_way);
    if (mission->guard->present) {
        keepout_guard_begin(mission, &memory->guard, estimate, under_way);
    }
    keepout_thrusters_begin(&memory->thrusters);
}

void keepout_step(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                  keepout_order *order)
{
    keepout_law_step(mission, &memory->law, estimate, order);
    keepout_copy(order->commanded_force, order->force);
    order->guard_status = 0;
    if (mission->guard->present) {
        order->guard_status = keepout_guard_filter(mission, &memory->guard, estimate, order->commanded_force,
                                                   order->disturbance_estimate, order->force);
        keepout_law_told(mission->law, &memory->law, order->force);
    }
    keepout_thrusters_fire(mission->thrusters, &memory->thrusters, order);
}
