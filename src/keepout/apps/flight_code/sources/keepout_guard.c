/* The guard: passes a commanded force on, or replaces it, so that a free way to rest remains. In Python:
 * guard/guard.py, with guard/braking.py, guard/observer.py and guard/watch.py; the theorem: docs/guard.md. */
#include <math.h>

#include "keepout_internal.h"

#define LOOSE 1e-6     /* relative slack of the watch against rounding */
#define ROUNDING 1e-9  /* likewise absolute, m and m/s */
#define ESCAPE_SPEED 0.02 /* of the way out, m/s */
#define CORNERS (KEEPOUT_DELAY + 2) /* of a path: after each command under way, after the next, at rest */

/* What is gone by at a step. In Python: Seen. */
typedef struct {
    double told_position[3];
    double told_velocity[3];
    double position[3]; /* x^ */
    double velocity[3];
    double spread[2];
    double unexplained[KEEPOUT_WINDOWS][3];
    double begun_doubts[KEEPOUT_WINDOWS];
    double doubts[2];
    int32_t counted;
    bool told;
    bool narrow; /* whether the errors are within those declared */
    bool jumped;
    bool left_out;
} seen_state;

/* Where the commands under way lead. In Python: Course; `path` and `velocities` from now on. */
typedef struct {
    double path[KEEPOUT_DELAY + 1][3];
    double velocities[KEEPOUT_DELAY + 1][3];
    double drifted[3];
    int32_t last;
    bool off_plan;
    bool planned;
} course_ahead;

/* Bounds of the errors of what is told: of sensors the set's radii, else those declared. */
static void errors_of(const keepout_guard *guard, const keepout_doubt *doubt, double errors[2])
{
#if KEEPOUT_SENSORS > 0
    int32_t i;
    (void)guard;
    for (i = 0; i < 2; i++) {
        errors[i] = (doubt->errors[i] < HUGE_VAL) ? doubt->errors[i] : HUGE_VAL;
    }
#else
    (void)doubt;
    errors[0] = guard->position_error;
    errors[1] = guard->velocity_error;
#endif
}

/* Whether these are within those declared. */
static bool is_narrow(const keepout_guard *guard, const keepout_doubt *doubt)
{
#if KEEPOUT_SENSORS > 0
    return (doubt->errors[0] <= guard->position_error) && (doubt->errors[1] <= guard->velocity_error);
#else
    (void)guard;
    (void)doubt;
    return true;
#endif
}

static bool is_contradicted(const keepout_doubt *doubt)
{
#if KEEPOUT_SENSORS > 0
    return doubt->contradicted;
#else
    (void)doubt;
    return false;
#endif
}

static double loosened(double bound)
{
    return (bound * (1.0 + LOOSE)) + ROUNDING;
}

static int32_t delay_of(const keepout_guard *guard)
{
    return (guard->delay < KEEPOUT_DELAY) ? guard->delay : KEEPOUT_DELAY;
}

static int32_t windows_of(const keepout_guard *guard)
{
    return (guard->windows < KEEPOUT_WINDOWS) ? guard->windows : KEEPOUT_WINDOWS;
}

/* In Python: Guard._plan_radius. */
static double plan_radius(const keepout_guard *guard)
{
    const double late = (double)guard->delay * guard->period;
    return guard->observes
               ? guard->plan_radius
               : (guard->position_radius + ((0.5 * (guard->disturbance + guard->fault_push)) * (late * late)));
}

/* Positions and velocities now and after each command under way. In Python: braking.predict. */
static void predict(const keepout_guard *guard, const keepout_guard_memory *memory, const double position[3],
                    const double velocity[3], course_ahead *course)
{
    int32_t i;
    course->last = delay_of(guard);
    keepout_copy(position, course->path[0]);
    keepout_copy(velocity, course->velocities[0]);
    for (i = 0; i < course->last; i++) {
        keepout_step_ahead(course->path[i], course->velocities[i], guard->period, memory->pending[i],
                           course->path[i + 1], course->velocities[i + 1]);
    }
}

/* In Python: Guard._off_plan. */
static bool off_plan(const keepout_guard *guard, const keepout_guard_memory *memory, const double position[3],
                     const double velocity[3])
{
    course_ahead course;
    predict(guard, memory, position, velocity, &course);
    return keepout_distance(course.path[course.last], memory->plan_position) > plan_radius(guard);
}

/* From where the nominal braking motion begins to where it ends, m. In Python: braking.stop. */
static void stop_of(const keepout_guard *guard, const double velocity[3], double stop[3])
{
    const double speed = keepout_norm(velocity);
    const double rest = fmod(speed, guard->deceleration * guard->period);
    const double length = (((speed * speed) - (rest * rest)) / (2.0 * guard->deceleration))
                          + ((0.5 * rest) * guard->period);
    const double factor = length / keepout_maximum(speed, 1e-12);
    int32_t i;
    for (i = 0; i < 3; i++) {
        stop[i] = velocity[i] * factor;
    }
}

/* Lower bound of the field between two points, of their values. In Python: Guard._lowest. */
static double lowest(const keepout_guard *guard, const double a[3], double value_a, const double b[3], double value_b)
{
    return 0.5 * ((value_a + value_b) - (guard->lipschitz * keepout_distance(a, b)));
}

/* Test 3: points along the stop segment. In Python: Guard._free_along. */
static bool free_along(const keepout_mission *mission, const double from[3], double value_from, const double to[3],
                       double value_to, double least, keepout_cell *cell)
{
    const keepout_guard *guard = mission->guard;
    double before[3];
    double value_before = value_from;
    bool free = true;
    int32_t i;
    int32_t axis;
    keepout_copy(from, before);
    for (i = 1; (i <= guard->parts) && (i <= KEEPOUT_MOST_PARTS); i++) {
        double point[3];
        double value = value_to;
        for (axis = 0; axis < 3; axis++) {
            point[axis] = (i < guard->parts)
                              ? (from[axis] + (((double)i / (double)guard->parts) * (to[axis] - from[axis])))
                              : to[axis];
        }
        if (i < guard->parts) {
            value = keepout_spline_value(mission->guard_spline, point, cell);
        }
        free = free && (lowest(guard, before, value_before, point, value) > least);
        keepout_copy(point, before);
        value_before = value;
    }
    return free;
}

/* Whether a path keeps within range and speed. In Python: Guard._within_limits. */
static bool within_limits(const keepout_guard *guard, const double position[3], double corners[CORNERS][3],
                          int32_t corner_count, double velocities[KEEPOUT_DELAY + 2][3], int32_t velocity_count,
                          double around, double faster)
{
    double range = keepout_norm(position);
    double fastest = 0.0;
    int32_t i;
    for (i = 0; i < corner_count; i++) {
        range = keepout_maximum(range, keepout_norm(corners[i]));
    }
    for (i = 0; i < velocity_count; i++) {
        fastest = keepout_maximum(fastest, keepout_norm(velocities[i]));
    }
    return (((fastest + guard->velocity_radius) + faster) <= guard->speed_limit)
           && ((range + around) <= guard->range_limit);
}

/* Whether the tube around a path and the braking from its end is free, within range and slow enough. `corners` holds
 * the path's points, with room for one more. In Python: Guard._free. */
static bool is_free(const keepout_mission *mission, const double position[3], double value, double corners[CORNERS][3],
                    int32_t points, double velocities[KEEPOUT_DELAY + 2][3], int32_t velocity_count, double moved,
                    double faster)
{
    const keepout_guard *guard = mission->guard;
    const double sagitta =
        ((sqrt(3.0) * (guard->force_limit / guard->mass)) * (guard->period * guard->period)) / 8.0;
    const double least = ((guard->threshold + (guard->lipschitz * guard->position_radius))
                          + (2.0 * guard->evaluation_error))
                         + (guard->lipschitz * (sagitta + moved));
    double values[CORNERS];
    double furthest = 0.0;
    keepout_cell cell;
    double stop[3];
    bool kept;
    bool free;
    int32_t i;
    stop_of(guard, velocities[velocity_count - 1], stop);
    for (i = 0; i < 3; i++) {
        corners[points][i] = corners[points - 1][i] + stop[i];
    }
    kept = within_limits(guard, position, corners, points + 1, velocities, velocity_count,
                         (sagitta + guard->position_radius) + moved, faster);
    for (i = 0; i <= points; i++) {
        furthest = keepout_maximum(furthest, keepout_distance(corners[i], position));
    }
    free = (value - (guard->lipschitz * furthest)) > least; /* test 1 */
    cell.known = false;
    if (kept && !free) {
        const double *before = position;
        double value_before = value;
        bool stop_free;
        free = true;
        for (i = 0; i < points; i++) { /* test 2 */
            values[i] = keepout_spline_value(mission->guard_spline, corners[i], &cell);
            free = free && (lowest(guard, before, value_before, corners[i], values[i]) > least);
            before = corners[i];
            value_before = values[i];
        }
        values[points] = keepout_spline_value(mission->guard_spline, corners[points], &cell);
        stop_free = lowest(guard, before, value_before, corners[points], values[points]) > least;
        if (free && !stop_free && (value_before > least) && (values[points] > least)) {
            stop_free = free_along(mission, corners[points - 1], value_before, corners[points], values[points], least,
                                   &cell);
        }
        free = free && stop_free;
    }
    return kept && free;
}

/* In Python: Guard._braking_free, of an estimate. */
static bool braking_free(const keepout_mission *mission, const keepout_guard_memory *memory, const double position[3],
                         const double velocity[3])
{
    course_ahead course;
    double corners[CORNERS][3];
    double velocities[KEEPOUT_DELAY + 2][3];
    keepout_cell cell;
    int32_t points = 1;
    int32_t i;
    cell.known = false;
    predict(mission->guard, memory, position, velocity, &course);
    for (i = 0; i <= course.last; i++) {
        keepout_copy(course.velocities[i], velocities[i]);
    }
    keepout_copy(course.path[0], corners[0]);
    if (course.last > 0) {
        points = course.last;
        for (i = 0; i < points; i++) {
            keepout_copy(course.path[i + 1], corners[i]);
        }
    }
    return is_free(mission, position, keepout_spline_value(mission->guard_spline, position, &cell), corners, points,
                   velocities, course.last + 1, 0.0, 0.0);
}

/* In Python: Guard.initial_state. */
void keepout_guard_begin(const keepout_mission *mission, keepout_guard_memory *memory, const keepout_estimate *estimate,
                         const double (*under_way)[3])
{
    const keepout_guard *guard = mission->guard;
    const int32_t delay = delay_of(guard);
    course_ahead course;
    int32_t i;
    int32_t axis;
    for (i = 0; i < KEEPOUT_DELAY; i++) {
        keepout_zero(memory->pending[i]);
        for (axis = 0; (under_way != NULL) && (i < delay) && (axis < 3); axis++) {
            memory->pending[i][axis] = under_way[(KEEPOUT_MOST_DELAY - delay) + i][axis] / guard->mass;
        }
    }
    predict(guard, memory, estimate->position, estimate->velocity, &course);
    keepout_copy(course.path[course.last], memory->plan_position);
    keepout_copy(course.velocities[course.last], memory->plan_velocity);
    memory->certified = braking_free(mission, memory, estimate->position, estimate->velocity);
    keepout_copy(estimate->position, memory->expected_position);
    keepout_copy(estimate->velocity, memory->expected_velocity);
    keepout_copy(estimate->position, memory->seen_position);
    keepout_copy(estimate->velocity, memory->seen_velocity);
    memory->doubts[0] = guard->position_error;
    memory->doubts[1] = guard->velocity_error;
    for (i = 0; i < KEEPOUT_WINDOWS; i++) {
        keepout_zero(memory->unexplained[i]);
        memory->begun_doubts[i] = guard->velocity_error;
    }
    memory->counted = 0;
    memory->begun = false;
    memory->left_out = false;
    memory->steady = true;
}

/* Test one more step against the assumptions. In Python: watch.watch and watch.next_doubts. */
static bool watched(const keepout_guard *guard, const keepout_guard_memory *memory, const double moved[3],
                    const double changed[3], const double known[2], seen_state *seen)
{
    const int32_t windows = windows_of(guard);
    const double T = guard->period;
    double shifted = (2.0 * guard->position_error) + (T * guard->velocity_error);
    bool jumped = false;
    int32_t i;
    int32_t axis;
    if (guard->observes) {
        shifted = (memory->doubts[0] + known[0]) + (T * memory->doubts[1]);
    }
    seen->doubts[0] = known[0];
    seen->doubts[1] = known[1];
    for (i = 0; i < windows; i++) {
        const int32_t place = (guard->window[i] > 0) ? (memory->counted % guard->window[i]) : 0;
        double turned = 2.0 * guard->velocity_error;
        double allowed;
        seen->begun_doubts[i] = (place == 0) ? memory->doubts[1] : memory->begun_doubts[i];
        if (guard->observes) {
            turned = seen->begun_doubts[i] + known[1];
        }
        for (axis = 0; axis < 3; axis++) {
            seen->unexplained[i][axis] = ((place == 0) ? 0.0 : memory->unexplained[i][axis]) + changed[axis];
        }
        allowed = ((guard->disturbance * T) * (double)(place + 1)) + turned;
        jumped = jumped || (keepout_norm(seen->unexplained[i]) > loosened(allowed));
    }
    if (keepout_norm(moved) > loosened(((0.5 * guard->disturbance) * (T * T)) + shifted)) {
        jumped = true;
    }
    seen->counted = 0;
    if ((windows > 0) && (memory->counted < (guard->window[windows - 1] - 1))) {
        seen->counted = memory->counted + 1;
    }
    return jumped;
}

/* In Python: observer._moved. */
static void moved_into(double seen[3], const double told[3], double room)
{
    const double left = keepout_maximum(room, 0.0);
    double away[3];
    double factor;
    int32_t i;
    for (i = 0; i < 3; i++) {
        away[i] = seen[i] - told[i];
    }
    factor = keepout_minimum(1.0, left / keepout_maximum(keepout_norm(away), 1e-300));
    for (i = 0; i < 3; i++) {
        seen[i] = told[i] + (away[i] * factor);
    }
}

/* x^ of what is told. In Python: observer.correct. */
static void corrected(const keepout_guard *guard, const keepout_guard_memory *memory, const double known[2], bool first,
                      bool beyond, seen_state *seen)
{
    const double most[2] = {guard->position_error, guard->velocity_error};
    double share = 1.0;
    bool within = true;
    int32_t i;
    for (i = 0; i < 2; i++) {
        const bool good = known[i] <= most[i];
        within = within && good;
        if (!good) {
            share = keepout_minimum(share, most[i] / known[i]);
        }
    }
    if (first) {
        share = 0.0;
    }
    for (i = 0; i < 3; i++) {
        const double off_r = seen->told_position[i] - memory->seen_position[i];
        const double off_v = seen->told_velocity[i] - memory->seen_velocity[i];
        seen->position[i] =
            memory->seen_position[i]
            + (share
               * ((guard->observer_position * off_r) + (((1.0 - guard->observer_position) * guard->period) * off_v)));
        seen->velocity[i] = memory->seen_velocity[i] + (share * (guard->observer_velocity * off_v));
    }
    if ((!memory->steady || beyond) && within) {
        moved_into(seen->position, seen->told_position, most[0] - known[0]);
        moved_into(seen->velocity, seen->told_velocity, most[1] - known[1]);
    }
}

/* Take what is told. In Python: Guard._see. */
static void see(const keepout_guard *guard, const keepout_guard_memory *memory, const keepout_estimate *estimate,
                const keepout_doubt *doubt, seen_state *seen)
{
    const bool finite = keepout_finite3(estimate->position) && keepout_finite3(estimate->velocity);
    const double *own_position = guard->observes ? memory->seen_position : memory->expected_position;
    const double *own_velocity = guard->observes ? memory->seen_velocity : memory->expected_velocity;
    const double T = guard->period;
    double known[2];
    double moved[3];
    double changed[3];
    bool beyond;
    bool doubtful;
    int32_t i;
    seen->narrow = is_narrow(guard, doubt);
    errors_of(guard, doubt, known);
    if (!finite) {
        known[0] = HUGE_VAL;
        known[1] = HUGE_VAL;
    }
    for (i = 0; i < 3; i++) {
        seen->told_position[i] = finite ? estimate->position[i] : memory->expected_position[i];
        seen->told_velocity[i] = finite ? estimate->velocity[i] : memory->expected_velocity[i];
        moved[i] = seen->told_position[i] - memory->expected_position[i];
        changed[i] = seen->told_velocity[i] - memory->expected_velocity[i];
    }
    seen->jumped = watched(guard, memory, moved, changed, known, seen);
    beyond = seen->jumped && finite;
    if (guard->observes) {
        const double push = guard->disturbance + guard->fault_push;
        const double further = ((known[0] + guard->error_radius) + (T * guard->velocity_error_radius))
                               + ((0.5 * (T * T)) * push);
        const double faster = (known[1] + guard->velocity_error_radius) + (T * push);
        beyond = (keepout_distance(seen->told_position, own_position) > loosened(further))
                 || (keepout_distance(seen->told_velocity, own_velocity) > loosened(faster));
        seen->jumped = seen->jumped || (beyond && (memory->steady || memory->left_out));
    }
    /* One state that nothing explains, and by which the plan could not be followed, is left out. */
    seen->left_out = beyond && memory->begun && memory->certified
                     && off_plan(guard, memory, seen->told_position, seen->told_velocity)
                     && !off_plan(guard, memory, own_position, own_velocity) && !memory->left_out;
    seen->told = finite && !seen->left_out;
    if (seen->left_out) {
        keepout_copy(memory->expected_position, seen->told_position);
        keepout_copy(memory->expected_velocity, seen->told_velocity);
        seen->counted = 0;
    }
    keepout_copy(seen->told_position, seen->position);
    keepout_copy(seen->told_velocity, seen->velocity);
    if (guard->observes) {
        if (!seen->told) {
            known[0] = HUGE_VAL;
            known[1] = HUGE_VAL;
        }
        corrected(guard, memory, known, !memory->begun && !beyond, beyond, seen);
    }
    doubtful = (seen->jumped || beyond) && seen->told;
    seen->spread[0] = doubtful ? keepout_maximum(keepout_distance(seen->position, seen->told_position),
                                                 keepout_distance(seen->position, own_position))
                               : 0.0;
    seen->spread[1] = doubtful ? keepout_maximum(keepout_distance(seen->velocity, seen->told_velocity),
                                                 keepout_distance(seen->velocity, own_velocity))
                               : 0.0;
}

/* Acceleration out of the margin, or back into range, m/s2. In Python: braking.escape. */
static void escape(const keepout_mission *mission, const double position[3], const double velocity[3],
                   double acceleration[3])
{
    const keepout_guard *guard = mission->guard;
    double away[3];
    double size;
    double factor;
    int32_t i;
    if ((keepout_norm(position) + guard->position_radius) > (0.99 * guard->range_limit)) {
        for (i = 0; i < 3; i++) {
            away[i] = -position[i];
        }
    } else {
        (void)keepout_spline_value_and_gradient(mission->guard_spline, position, away);
    }
    size = keepout_maximum(keepout_norm(away), 1e-9);
    for (i = 0; i < 3; i++) {
        const double direction = away[i] / size;
        acceleration[i] =
            (((keepout_finite(direction) ? direction : 0.0) * ESCAPE_SPEED) - velocity[i]) / guard->period;
    }
    factor = keepout_minimum(1.0, (guard->force_limit / guard->mass) / keepout_maximum(keepout_norm(acceleration), 1e-12));
    for (i = 0; i < 3; i++) {
        acceleration[i] = acceleration[i] * factor;
    }
}

/* Whether a candidate leaves a free plan. In Python: Guard._accept. */
static bool accepted_of(const keepout_mission *mission, double here, const seen_state *seen, const course_ahead *course,
                        const double position[3], const double velocity[3])
{
    const keepout_guard *guard = mission->guard;
    const double faster = seen->spread[1];
    const double lever = (((double)(guard->delay + 1) * guard->period)
                          + ((keepout_norm(velocity) + faster) / guard->deceleration))
                         + (0.5 * guard->period);
    double corners[CORNERS][3];
    double velocities[KEEPOUT_DELAY + 2][3];
    int32_t i;
    for (i = 0; i < course->last; i++) {
        keepout_copy(course->path[i + 1], corners[i]);
    }
    for (i = 0; i <= course->last; i++) {
        keepout_copy(course->velocities[i], velocities[i]);
    }
    keepout_copy(position, corners[course->last]);
    keepout_copy(velocity, velocities[course->last + 1]);
    return is_free(mission, seen->position, here, corners, course->last + 1, velocities, course->last + 2,
                   seen->spread[0] + (faster * lever), faster);
}

/* In Python: watch.too_strong and watch.outside_region, and the field's flag. */
static int32_t flags_of(const keepout_guard *guard, const keepout_estimate *estimate, const keepout_doubt *doubt,
                        double here, bool finite, const double disturbance_estimate[3], bool certified,
                        const seen_state *seen, const course_ahead *course)
{
    const double known = 1.5 * guard->mass
                         * ((guard->disturbance - guard->drift) + ((2.0 * guard->velocity_error) / guard->period));
    const double least = guard->observes ? (guard->threshold - (guard->lipschitz * guard->error_radius)) : guard->threshold;
    int32_t flags = 0;
    flags += seen->jumped ? KEEPOUT_FLAG_STATE_JUMP : 0;
    flags += (keepout_norm(disturbance_estimate) <= keepout_maximum(known, guard->mass * guard->drift))
                 ? 0
                 : KEEPOUT_FLAG_DISTURBANCE;
    flags += (here > least) ? 0 : KEEPOUT_FLAG_FIELD;
    flags += ((keepout_norm(seen->told_position) > (guard->range_limit + guard->position_error))
              || (keepout_norm(seen->told_velocity) > (guard->speed_limit + guard->velocity_error)))
                 ? KEEPOUT_FLAG_REGION
                 : 0;
    flags += finite ? 0 : KEEPOUT_FLAG_COMMAND;
    flags += (course->off_plan && certified) ? KEEPOUT_FLAG_OFF_PLAN : 0;
    flags += (seen->told || seen->left_out) ? 0 : KEEPOUT_FLAG_ESTIMATE;
    flags += seen->narrow ? 0 : KEEPOUT_FLAG_WIDE;
    flags += is_contradicted(doubt) ? KEEPOUT_FLAG_CONTRADICTED : 0;
    flags += (estimate->time > guard->valid_until) ? KEEPOUT_FLAG_EXPIRED : 0;
    return flags;
}

/* Remember for the next step. In Python: Guard._remember. */
static void remember(const keepout_guard *guard, keepout_guard_memory *memory, const seen_state *seen, bool accepted,
                     bool follow, const double chosen[3])
{
    const int32_t delay = delay_of(guard);
    double acting[3];
    int32_t i;
    keepout_copy((delay > 0) ? memory->pending[0] : chosen, acting);
    keepout_queue(memory->pending, delay, chosen);
    if (guard->observes) {
        memory->steady = seen->told && seen->narrow && (accepted || (follow && memory->steady));
        keepout_step_ahead(seen->position, seen->velocity, guard->period, acting, memory->seen_position,
                           memory->seen_velocity);
        memory->doubts[0] = seen->doubts[0];
        memory->doubts[1] = seen->doubts[1];
    }
    keepout_step_ahead(seen->told_position, seen->told_velocity, guard->period, acting, memory->expected_position,
                       memory->expected_velocity);
    for (i = 0; i < windows_of(guard); i++) {
        keepout_copy(seen->unexplained[i], memory->unexplained[i]);
        memory->begun_doubts[i] = seen->begun_doubts[i];
    }
    memory->counted = seen->counted;
    memory->certified = accepted || follow;
    memory->begun = true;
    memory->left_out = seen->left_out;
}

/* In Python: Guard.filter. */
int32_t keepout_guard_filter(const keepout_mission *mission, keepout_guard_memory *memory,
                             const keepout_estimate *estimate, const keepout_doubt *doubt, const double force[3],
                             const double disturbance_estimate[3], double filtered[3])
{
    const keepout_guard *guard = mission->guard;
    const double authority = guard->force_limit / guard->mass;
    const bool finite = keepout_finite3(force);
    seen_state seen;
    course_ahead course;
    keepout_cell cell;
    double here;
    double candidate[3];
    double position[3];
    double velocity[3];
    double chosen[3];
    double brake[3];
    double factor;
    double speed;
    bool accepted = false;
    bool follow;
    int32_t status;
    int32_t i;

    see(guard, memory, estimate, doubt, &seen);
    cell.known = false;
    here = keepout_spline_value(mission->guard_spline, seen.position, &cell);

    /* Where the commands under way lead. In Python: Guard._predict. */
    predict(guard, memory, seen.position, seen.velocity, &course);
    for (i = 0; i < 3; i++) {
        course.drifted[i] = course.path[course.last][i] - memory->plan_position[i];
    }
    course.off_plan = keepout_norm(course.drifted) > plan_radius(guard);
    course.planned = memory->certified && !course.off_plan && seen.told;

    /* The command, cut to the box, or the way out. In Python: Guard._candidate. */
    if (course.planned) {
        for (i = 0; i < 3; i++) {
            candidate[i] = keepout_clip(finite ? force[i] : 0.0, -guard->force_limit, guard->force_limit) / guard->mass;
        }
    } else {
        escape(mission, seen.position, course.velocities[course.last], candidate);
    }
    keepout_step_ahead(course.path[course.last], course.velocities[course.last], guard->period, candidate, position,
                       velocity);
    if ((finite || !course.planned) && seen.told && seen.narrow && !is_contradicted(doubt)) {
        accepted = accepted_of(mission, here, &seen, &course, position, velocity);
    }

    /* The plan's next state, and the acceleration that follows it. In Python: Guard._follow and braking.brake. */
    speed = keepout_norm(memory->plan_velocity);
    factor = keepout_minimum(guard->deceleration, speed / guard->period) / keepout_maximum(speed, 1e-12);
    for (i = 0; i < 3; i++) {
        brake[i] = -memory->plan_velocity[i] * factor;
    }
    follow = (course.planned || (memory->certified && !seen.told)) && !accepted;
    for (i = 0; i < 3; i++) {
        const double feedback = (guard->position_gain * course.drifted[i])
                                + (guard->velocity_gain * (course.velocities[course.last][i] - memory->plan_velocity[i]));
        chosen[i] = follow ? keepout_clip(brake[i] - (seen.told ? feedback : 0.0), -authority, authority) : candidate[i];
        filtered[i] = guard->mass * chosen[i];
    }
    if (accepted && course.planned) {
        status = KEEPOUT_GUARD_CLEAR;
    } else if (follow) {
        status = (speed < 1e-9) ? KEEPOUT_GUARD_HOLDING : KEEPOUT_GUARD_BRAKING;
    } else {
        status = KEEPOUT_GUARD_ESCAPING;
    }
    status += flags_of(guard, estimate, doubt, here, finite, disturbance_estimate, memory->certified, &seen, &course);
    remember(guard, memory, &seen, accepted, follow, chosen);
    if (follow) {
        keepout_step_ahead(memory->plan_position, memory->plan_velocity, guard->period, brake, memory->plan_position,
                           memory->plan_velocity);
    } else {
        keepout_copy(position, memory->plan_position);
        keepout_copy(velocity, memory->plan_velocity);
    }
    return status;
}
