/* One control step: the law, then the guard, then the thrusters; with sensors navigation before them. In Python:
 * core/flight/loop.py, `memories`, `command` and of `step` what the thrusters fire; flights/on_board.py, _Samples. */
#include "keepout_internal.h"

/* In Python: loop.memories. */
static void begin_from(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                       const keepout_estimate *known, const double (*under_way)[3])
{
    keepout_law_begin(mission, &memory->law, estimate, under_way);
    if (mission->guard->present) {
        keepout_guard_begin(mission, &memory->guard, known, under_way);
    }
    keepout_thrusters_begin(&memory->thrusters);
}

/* In Python: loop.command. */
static void command(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                    const keepout_estimate *known, const keepout_doubt *doubt, keepout_order *order)
{
    keepout_law_step(mission, &memory->law, estimate, order);
    keepout_copy(order->commanded_force, order->force);
    order->guard_status = 0;
    if (mission->guard->present) {
        order->guard_status = keepout_guard_filter(mission, &memory->guard, known, doubt, order->commanded_force,
                                                   order->disturbance_estimate, order->force);
        keepout_law_told(mission->law, &memory->law, order->force);
    }
}

#if KEEPOUT_SENSORS > 0
void keepout_begin(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                   const keepout_sample samples[KEEPOUT_SENSORS], const double (*under_way)[3])
{
    keepout_knowledge knowledge;
    keepout_navigation_begin(mission, &memory->navigation, estimate, under_way);
    keepout_navigation_know(mission, &memory->navigation, samples, &knowledge);
    keepout_copy(knowledge.disturbance, memory->law.push);
    begin_from(mission, memory, &knowledge.estimate, &knowledge.known, under_way);
    keepout_navigation_begin(mission, &memory->navigation, estimate, under_way); /* its first step is still to come */
}

void keepout_step(const keepout_mission *mission, keepout_memory *memory, const keepout_sample samples[KEEPOUT_SENSORS],
                  keepout_knowledge *knowledge, keepout_order *order)
{
    keepout_doubt doubt;
    keepout_navigation_know(mission, &memory->navigation, samples, knowledge);
    keepout_copy(knowledge->disturbance, memory->law.push);
    doubt.errors[0] = knowledge->errors[0];
    doubt.errors[1] = knowledge->errors[1];
    doubt.contradicted = knowledge->contradicted;
    command(mission, memory, &knowledge->estimate, &knowledge->known, &doubt, order);
    keepout_navigation_told(mission, &memory->navigation, order->force);
    keepout_thrusters_fire(mission->thrusters, &memory->thrusters, order);
}
#else
void keepout_begin(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                   const double (*under_way)[3])
{
    begin_from(mission, memory, estimate, estimate, under_way);
}

void keepout_step(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                  keepout_order *order)
{
    command(mission, memory, estimate, estimate, NULL, order);
    keepout_thrusters_fire(mission->thrusters, &memory->thrusters, order);
}
#endif
