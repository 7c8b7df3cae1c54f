/* The control law: guidance, safe velocity, tracking, disturbance observer. In Python: control/controller.py with the
 * default profile (control/profiles.py); with a delay inside control/law.py, AheadOfDelay. */
#include <math.h>

#include "keepout_internal.h"

#define EDGE 1e-11        /* below this much room, in units of speed, the feasible set is one point */
#define FAR 3.0           /* more than any speed in these units */
#define NO_GRADIENT 1e-24

/* Where the safe velocity's program ended. In Python: control/velocity_program.py, ConeStatus. */
enum { SOLVED, INFEASIBLE, NOT_A_NUMBER, NO_WAY_OUT };

/* In Python: SafeVelocity's VelocityPoint. */
typedef struct {
    double barrier;
    double normal[3];
    double desired[3];
    double velocity[3];
    int32_t status;
} velocity_point;

static double one_for_zero(double size)
{
    return (size > 0.0) ? size : 1.0;
}

/* Euclidean norm without overflow. In Python: control/unit_program.py, length. */
static double length_of(const double v[3])
{
    double largest = 0.0;
    double unit;
    double square = 0.0;
    int32_t i;
    for (i = 0; i < 3; i++) {
        largest = keepout_maximum(largest, (v[i] < 0.0) ? -v[i] : v[i]);
    }
    unit = one_for_zero(largest);
    for (i = 0; i < 3; i++) {
        square = square + ((v[i] / unit) * (v[i] / unit));
    }
    return (largest > 0.0) ? (unit * sqrt(square)) : 0.0;
}

/* The vector at length 1, or zero. In Python: control/geodesic.py, _unit. */
static void unit_of(double v[3])
{
    const double size = sqrt(keepout_dot(v, v) + 1e-300);
    int32_t i;
    for (i = 0; i < 3; i++) {
        v[i] = v[i] / size;
    }
}

static void cubic_weights(double t, double w[4])
{
    const double u = 1.0 - t;
    w[0] = ((u * u) * u) / 6.0;
    w[1] = ((4.0 - (6.0 * (t * t))) + (3.0 * ((t * t) * t))) / 6.0;
    w[2] = ((4.0 - (6.0 * (u * u))) + (3.0 * ((u * u) * u))) / 6.0;
    w[3] = ((t * t) * t) / 6.0;
}

/* Along the way to the goal; zero where nothing leads there. In Python: GeodesicGuidance.direction. */
static void direction_at(const keepout_guidance *way, const double position[3], double along[3])
{
    double weights[3][4];
    double outside[3];
    double back[3];
    double blended[3] = {0.0, 0.0, 0.0};
    int32_t first[3];
    bool beyond = false;
    int32_t axis;
    int32_t i;
    int32_t j;
    int32_t k;
    for (axis = 0; axis < 3; axis++) {
        const double place = (position[axis] - way->origin[axis]) / way->spacing;
        const double held = keepout_clip(place, 1.0, ((double)way->nodes[axis] - 2.0) - 1e-9);
        const int32_t cell = keepout_to_index(held, 1, way->nodes[axis] - 3);
        outside[axis] = place - held;
        beyond = beyond || (outside[axis] != 0.0);
        first[axis] = cell - 1;
        cubic_weights(held - (double)cell, weights[axis]);
    }
    for (i = 0; i < 4; i++) {
        for (j = 0; j < 4; j++) {
            for (k = 0; k < 4; k++) {
                const size_t node =
                    ((((size_t)(first[0] + i) * (size_t)way->nodes[1]) + (size_t)(first[1] + j)) * (size_t)way->nodes[2])
                    + (size_t)(first[2] + k);
                const uint8_t *bytes = &way->directions[3u * node];
                const double weight = (weights[0][i] * weights[1][j]) * weights[2][k];
                for (axis = 0; axis < 3; axis++) {
                    const double value = (bytes[axis] < 0x80u) ? (double)bytes[axis] : ((double)bytes[axis] - 256.0);
                    blended[axis] = blended[axis] + (weight * value);
                }
            }
        }
    }
    unit_of(blended);
    for (axis = 0; axis < 3; axis++) {
        back[axis] = outside[axis];
    }
    if (beyond) {
        unit_of(back);
    }
    for (axis = 0; axis < 3; axis++) {
        along[axis] = ((outside[axis] == 0.0) ? blended[axis] : 0.0) - back[axis];
    }
    unit_of(along);
}

/* v_c, m/s. In Python: GeodesicGuidance.desired_velocity and StraightGuidance.desired_velocity. */
static void desired_velocity(const keepout_guidance *way, const double position[3], double desired[3])
{
    double error[3];
    double square;
    double distance = 0.0;
    double factor;
    int32_t i;
    for (i = 0; i < 3; i++) {
        error[i] = way->goal[i] - position[i];
    }
    square = keepout_dot(error, error);
    if (square > 1e-24) {
        distance = sqrt(square);
        factor = keepout_tanh(distance / way->slowing_length) / distance;
    } else {
        factor = 1.0 / way->slowing_length;
    }
    if (way->directions == NULL) {
        for (i = 0; i < 3; i++) {
            desired[i] = way->speed * (factor * error[i]);
        }
    } else {
        double along[3];
        const double s = keepout_clip((distance - way->inner) / (way->outer - way->inner), 0.0, 1.0);
        const double weight = (s * s) * (3.0 - (2.0 * s));
        const double slowed = keepout_tanh(distance / way->slowing_length);
        direction_at(way, position, along);
        for (i = 0; i < 3; i++) {
            desired[i] = way->speed * ((weight * (along[i] * slowed)) + ((1.0 - weight) * (factor * error[i])));
        }
    }
}

/* alpha(h), m/s. In Python: control/velocity.py, ClassK. */
static double class_k(const keepout_law *law, double barrier)
{
    const double knee = law->class_k_braking / law->class_k_rate;
    const double root =
        sqrt(((2.0 * law->class_k_braking) * keepout_maximum(barrier, 0.0)) + (knee * knee));
    return (barrier >= 0.0) ? (root - knee) : (law->class_k_rate * barrier);
}

/* s(h), m/s. In Python: control/velocity.py, SpeedCone. */
static double speed_at(const keepout_law *law, double barrier)
{
    return keepout_minimum(law->speed_limit,
                           sqrt((2.0 * law->speed_authority)
                                        * (keepout_maximum(barrier, 0.0) + law->speed_reserve)));
}

/* Project onto a half-space and a ball. In Python: control/velocity_program.py, _project; velocities in units of speed. */
static void project(const double n[3], const double desired[3], double rate, double limit, double velocity[3])
{
    const double square = one_for_zero(keepout_dot(n, n));
    const double shrink = keepout_minimum(1.0, limit / one_for_zero(length_of(desired)));
    const double along = keepout_dot(n, desired);
    double in_ball[3];
    double on_plane[3];
    double foot[3];
    double tangent[3];
    int32_t i;
    for (i = 0; i < 3; i++) {
        in_ball[i] = desired[i] * shrink;
        on_plane[i] = desired[i] - (((along + rate) / square) * n[i]);
        foot[i] = (-rate / square) * n[i];
        tangent[i] = desired[i] - ((along / square) * n[i]);
    }
    if ((keepout_dot(n, in_ball) + rate) >= 0.0) {
        keepout_copy(in_ball, velocity);
    } else if (length_of(on_plane) <= limit) {
        keepout_copy(on_plane, velocity);
    } else {
        const double radius = sqrt(keepout_maximum((limit * limit) - keepout_dot(foot, foot), 0.0));
        const double spread = one_for_zero(length_of(tangent));
        for (i = 0; i < 3; i++) {
            velocity[i] = foot[i] + ((radius * tangent[i]) / spread);
        }
    }
}

/* v_s, m/s. In Python: control/velocity_program.py, _solve_unit, of a half-space and a speed limit. */
static int32_t safe_velocity(const double desired[3], const double normal[3], double barrier_rate, double speed,
                             double velocity[3])
{
    int32_t status = SOLVED;
    if (!(keepout_finite3(desired) && keepout_finite3(normal) && keepout_finite(barrier_rate)
          && keepout_finite(speed))) {
        keepout_zero(velocity);
        status = NOT_A_NUMBER;
    } else {
        const double size = one_for_zero(speed);
        const double row = one_for_zero(length_of(normal));
        const double rate = keepout_clip(barrier_rate / (row * size), -1e6, FAR);
        const double limit = keepout_minimum(speed / size, FAR);
        double n[3];
        double wanted[3];
        double steep;
        double gain;
        int32_t i;
        for (i = 0; i < 3; i++) {
            n[i] = normal[i] / row;
            wanted[i] = desired[i] / size;
        }
        steep = length_of(n);
        gain = limit * keepout_maximum(steep, 0.0);
        if ((rate + gain) <= EDGE) {
            for (i = 0; i < 3; i++) {
                velocity[i] = (gain > 0.0) ? ((limit * n[i]) / one_for_zero(steep)) : 0.0;
            }
        } else {
            project(n, wanted, rate, limit, velocity);
        }
        for (i = 0; i < 3; i++) {
            velocity[i] = size * velocity[i];
        }
        if ((rate + gain) < 0.0) {
            status = (gain > 0.0) ? INFEASIBLE : NO_WAY_OUT;
        }
    }
    return status;
}

/* In Python: control/velocity.py, SafeVelocity. */
static void velocity_at(const keepout_mission *mission, const double position[3], velocity_point *point)
{
    const keepout_law *law = mission->law;
    double value;
    if (law->field == KEEPOUT_NETWORK) {
        value = keepout_network_value_and_gradient(mission->network, position, point->normal);
    } else {
        value = keepout_spline_value_and_gradient(mission->law_spline, position, point->normal);
    }
    point->barrier = value - law->offset;
    desired_velocity(mission->guidance, position, point->desired);
    point->status = safe_velocity(point->desired, point->normal, class_k(law, point->barrier),
                                  speed_at(law, point->barrier), point->velocity);
}

/* Lambda(a, b). In Python: control/controller.py, safety_gain. */
static double safety_gain(double a, double b, double sharpness)
{
    double gain = 0.0;
    if (b > NO_GRADIENT) {
        const double ratio = (-sharpness * a) / b;
        const double size = (ratio < 0.0) ? -ratio : ratio;
        gain = (keepout_maximum(ratio, 0.0) + keepout_log1p(keepout_exp(-size))) / sharpness;
    }
    return gain;
}

/* The force before the disturbance is compensated, N. In Python: control/controller.py, Tracking. */
static void tracked(const keepout_law *law, const velocity_point *point, const double position_error[3],
                    const double velocity[3], const double drift[3], double control[3], keepout_order *order)
{
    double error[3];
    double pull[3];
    double feedback[3];
    double gradient[3];
    double size;
    double square;
    double b;
    double a;
    double gain;
    int32_t i;
    for (i = 0; i < 3; i++) {
        error[i] = velocity[i] - point->velocity[i];
        pull[i] = keepout_dot(law->position_weight[i], position_error);
    }
    square = keepout_dot(error, error);
    for (i = 0; i < 3; i++) {
        feedback[i] = (-law->lyapunov_ratio * pull[i]) - ((0.5 * law->gain) * error[i]);
    }
    size = sqrt(keepout_dot(feedback, feedback) + 1e-300);
    for (i = 0; i < 3; i++) {
        feedback[i] = feedback[i] * keepout_minimum(1.0, law->acceleration_limit / size);
        gradient[i] = -error[i] / (law->mass * law->barrier_ratio);
    }
    b = keepout_dot(gradient, gradient);
    order->backstepping_barrier = point->barrier - (square / (2.0 * law->barrier_ratio));
    a = ((-keepout_dot(error, feedback) / law->barrier_ratio) + keepout_dot(point->normal, velocity))
        + (law->barrier_rate * order->backstepping_barrier);
    a = a - (b / ((2.0 * law->estimation_weight) * ((2.0 * law->estimation_rate) - law->barrier_rate)));
    gain = safety_gain(a, b, law->sharpness);
    for (i = 0; i < 3; i++) {
        control[i] = (law->mass * (feedback[i] - drift[i])) + (gain * gradient[i]);
    }
    order->lyapunov = (0.5 * keepout_dot(position_error, pull)) + (square / (2.0 * law->lyapunov_ratio));
}

/* xi a period later, along each axis. In Python: control/observer.py, SampledObserver.update. */
static void observed(const keepout_law *law, const keepout_law_memory *memory, const double velocity[3],
                     const double drift[3], double model[3][KEEPOUT_MODEL])
{
    int32_t axis;
    int32_t i;
    int32_t j;
    for (axis = 0; axis < 3; axis++) {
        const double *state = memory->model[axis];
        double residual = (law->mass * (((velocity[axis] - memory->velocity[axis]) / law->period)
                                        - (0.5 * (memory->drift[axis] + drift[axis]))))
                          - memory->force[axis];
        for (j = 0; j < law->model; j++) {
            residual = residual - (law->mean_output[j] * state[j]);
        }
        for (i = 0; i < law->model; i++) {
            double sum = 0.0;
            for (j = 0; j < law->model; j++) {
                sum = sum + (law->transition[i][j] * state[j]);
            }
            model[axis][i] = sum + (law->model_gain[i] * residual);
        }
    }
}

static double output_of(const keepout_law *law, const double weights[KEEPOUT_MODEL], const double state[KEEPOUT_MODEL])
{
    double sum = 0.0;
    int32_t j;
    for (j = 0; j < law->model; j++) {
        sum = sum + (weights[j] * state[j]);
    }
    return sum;
}

/* A force and the disturbance that a filter has estimated, N. */
static double pushed(const keepout_law_memory *memory, int32_t axis, double force)
{
#if KEEPOUT_SENSORS > 0
    return force + memory->push[axis];
#else
    (void)memory;
    (void)axis;
    return force;
#endif
}

static int32_t status_of(const velocity_point *point, bool finite, bool saturated)
{
    int32_t status = saturated ? KEEPOUT_LAW_SATURATED : KEEPOUT_LAW_NOMINAL;
    if (!finite) {
        status = KEEPOUT_LAW_NOT_FINITE;
    } else if (point->status == NO_WAY_OUT) {
        status = KEEPOUT_LAW_NO_WAY_OUT;
    } else if (point->status == INFEASIBLE) {
        status = KEEPOUT_LAW_OUTSIDE_SAFE_SET;
    } else {
        /* as it is */
    }
    return status;
}

/* In Python: Controller.step. */
static void controlled(const keepout_mission *mission, keepout_law_memory *memory, const keepout_estimate *estimate,
                       keepout_order *order)
{
    const keepout_law *law = mission->law;
    const double *velocity = estimate->velocity;
    double model[3][KEEPOUT_MODEL];
    double drift[3];
    double position_error[3];
    double wanted[3];
    velocity_point point;
    bool finite;
    bool whole;
    bool saturated = false;
    int32_t axis;
    int32_t i;
    keepout_drift(mission->motion, estimate, drift);
    for (axis = 0; axis < 3; axis++) {
        for (i = 0; i < law->model; i++) {
            model[axis][i] = memory->model[axis][i];
        }
    }
    if (memory->started) {
        observed(law, memory, velocity, drift, model);
    }
    velocity_at(mission, estimate->position, &point);
    for (axis = 0; axis < 3; axis++) {
        position_error[axis] = estimate->position[axis] - mission->guidance->goal[axis];
    }
    tracked(law, &point, position_error, velocity, drift, wanted, order);
    for (axis = 0; axis < 3; axis++) {
        order->disturbance_estimate[axis] = pushed(memory, axis, output_of(law, law->output, model[axis]));
        wanted[axis] = wanted[axis] - pushed(memory, axis, output_of(law, law->mean_output, model[axis]));
        saturated = saturated || (((wanted[axis] < 0.0) ? -wanted[axis] : wanted[axis]) > law->force_limit[axis]);
    }
    finite = keepout_finite3(wanted) && (point.status != NOT_A_NUMBER);
    whole = finite && keepout_finite3(velocity) && keepout_finite3(drift);
    for (axis = 0; axis < 3; axis++) {
        order->commanded_force[axis] =
            finite ? keepout_clip(wanted[axis], -law->force_limit[axis], law->force_limit[axis]) : 0.0;
        for (i = 0; i < law->model; i++) {
            whole = whole && keepout_finite(model[axis][i]);
        }
    }
    keepout_copy(point.desired, order->desired_velocity);
    keepout_copy(point.velocity, order->safe_velocity);
    order->barrier = point.barrier + law->nominal_offset;
    order->control_status = status_of(&point, finite, saturated);
    /* A sample that is not a number must not stay in the memory. */
    keepout_copy(order->commanded_force, memory->force);
    memory->started = whole;
    if (whole) {
        keepout_copy(velocity, memory->velocity);
        keepout_copy(drift, memory->drift);
        for (axis = 0; axis < 3; axis++) {
            for (i = 0; i < law->model; i++) {
                memory->model[axis][i] = model[axis][i];
            }
        }
    }
}

/* Move an estimate to where the next command takes effect. In Python: AheadOfDelay.ahead. */
static void move_ahead(const keepout_mission *mission, const keepout_law_memory *memory, keepout_estimate *estimate)
{
    int32_t i;
    for (i = 0; (i < mission->law->delay) && (i < KEEPOUT_DELAY); i++) {
        double force[3];
        int32_t axis;
        for (axis = 0; axis < 3; axis++) {
            force[axis] = pushed(memory, axis, memory->pending[i][axis]);
        }
        keepout_move(mission->motion, estimate, force, mission->law->period, mission->law->mass);
    }
}

/* In Python: AheadOfDelay.begun_with and Controller.initial_state. */
void keepout_law_begin(const keepout_mission *mission, keepout_law_memory *memory, const keepout_estimate *estimate,
                       const double (*under_way)[3])
{
    keepout_estimate ahead = *estimate;
    int32_t i;
    int32_t axis;
    for (i = 0; i < KEEPOUT_DELAY; i++) {
        keepout_zero(memory->pending[i]);
        if ((under_way != NULL) && (i < mission->law->delay)) {
            keepout_copy(under_way[(KEEPOUT_MOST_DELAY - mission->law->delay) + i], memory->pending[i]);
        }
    }
    move_ahead(mission, memory, &ahead);
    keepout_copy(ahead.velocity, memory->velocity);
    keepout_drift(mission->motion, &ahead, memory->drift);
    keepout_zero(memory->force);
    for (axis = 0; axis < 3; axis++) {
        for (i = 0; i < KEEPOUT_MODEL; i++) {
            memory->model[axis][i] = 0.0;
        }
    }
    memory->started = false;
}

/* In Python: AheadOfDelay.step. */
void keepout_law_step(const keepout_mission *mission, keepout_law_memory *memory, const keepout_estimate *estimate,
                      keepout_order *order)
{
    const int32_t delay = (mission->law->delay < KEEPOUT_DELAY) ? mission->law->delay : KEEPOUT_DELAY;
    keepout_estimate ahead = *estimate;
    move_ahead(mission, memory, &ahead);
    controlled(mission, memory, &ahead, order);
    keepout_queue(memory->pending, delay, order->commanded_force);
}

/* Tell the law that `force` (N) was commanded in the place of its own. In Python: with_applied_force. */
void keepout_law_told(const keepout_law *law, keepout_law_memory *memory, const double force[3])
{
    const int32_t delay = (law->delay < KEEPOUT_DELAY) ? law->delay : KEEPOUT_DELAY;
    keepout_copy(force, memory->force);
    if (delay > 0) {
        keepout_copy(force, memory->pending[delay - 1]);
    }
}
