/* The guard's estimate of what the sensors of a suite say: two balls that hold position and velocity, moved under a
 * bounded acceleration and cut with what each sample proves. In Python: flights/navigation/known_set.py, SetMembership;
 * docs/motion.md proves each line. */
#include <math.h>

#include "keepout_internal.h"

#if KEEPOUT_SENSORS > 0

#define ROUNDING 1e-13 /* relative allowance for rounding in sums of vectors, squares and roots */
#define PATIENCE 3     /* steps in a row that samples contradict what is known, until one is believed instead */

/* What is known of a quantity while samples are taken in. In Python: known_set._Cutting. */
typedef struct {
    keepout_ball known;
    bool heard;
    bool wrong;
    bool replaced;
} cutting;

/* A ball, wider by what rounding may have done to a centre that is the sum of terms of these lengths together. In Python:
 * known_set._rounded. */
static void set_ball(keepout_ball *ball, const double centre[3], double radius, double size)
{
    keepout_copy(centre, ball->centre);
    ball->radius = (radius * (1.0 + ROUNDING)) + (ROUNDING * size);
}

/* Cut a ball with another: the smallest ball that holds what is in both; whether they meet. In Python: known_set.cut. */
static bool cut(const keepout_ball *first, const keepout_ball *second, keepout_ball *both)
{
    const double R1 = first->radius;
    const double R2 = second->radius;
    const double size = keepout_norm(first->centre) + keepout_norm(second->centre);
    double between[3];
    double square;
    double distance;
    double share;
    double left;
    double scale;
    double radius;
    bool meets;
    int32_t i;
    for (i = 0; i < 3; i++) {
        between[i] = second->centre[i] - first->centre[i];
    }
    square = keepout_dot(between, between);
    distance = sqrt(square);
    meets = keepout_finite(distance) && (R2 >= 0.0) && (distance <= (((R1 + R2) * (1.0 + ROUNDING)) + (ROUNDING * size)));
    share = keepout_clip(0.5 + (((0.5 * (R1 - R2)) * (R1 + R2)) / ((square > 0.0) ? square : 1.0)), 0.0, 1.0);
    left = (((1.0 - share) * (R1 * R1)) + (share * (R2 * R2))) - ((share * (1.0 - share)) * square);
    scale = keepout_maximum(R1, R2) + distance;
    radius = sqrt(keepout_maximum(left, 0.0) + (ROUNDING * (scale * scale))) + (ROUNDING * size);
    *both = *first;
    if (meets && (square > 0.0) && (share > 0.0) && (share < 1.0) && (radius < keepout_minimum(R1, R2))) {
        for (i = 0; i < 3; i++) {
            both->centre[i] = first->centre[i] + (share * between[i]);
        }
        both->radius = radius;
    } else if (meets && !(R1 <= R2)) {
        *both = *second;
    } else {
        /* the first one */
    }
    return meets;
}

/* Cut with a ball that a sample proves; where they do not meet, keep what is known unless the ball is believed. In Python:
 * _Cutting.told. */
static void tell(cutting *quantity, const keepout_ball *ball, bool believe)
{
    keepout_ball both;
    if (cut(&quantity->known, ball, &both)) {
        quantity->known = both;
    } else {
        quantity->wrong = true;
        if (believe && keepout_finite3(ball->centre) && (ball->radius < HUGE_VAL)) {
            quantity->known = *ball;
            quantity->replaced = true;
        }
    }
    quantity->heard = true;
}

/* What a sample proves at its own time. In Python: sensors.py, position_ball, velocity_ball and _in_body. */
static void ball_of(const keepout_sensor *sensor, const double value[4], const double attitude[4], keepout_ball *ball)
{
    const double length = keepout_norm(value);
    double radius = sensor->bound;
    int32_t i;
    if (sensor->kind == KEEPOUT_RANGE_BEARING) {
        radius = sqrt((radius * radius) + (((4.0 * length) * (length + radius)) * sensor->bearing_square));
    }
    if (sensor->in_vvlh) {
        double body_from_vvlh[3][3];
        keepout_matrix(attitude, body_from_vvlh);
        for (i = 0; i < 3; i++) {
            ball->centre[i] = keepout_dot(body_from_vvlh[i], value);
        }
        ball->radius = (radius + (sensor->turned * (length + radius))) + (ROUNDING * (length + radius));
    } else {
        keepout_copy(value, ball->centre);
        ball->radius = radius + (ROUNDING * (length + radius));
    }
}

#if (KEEPOUT_LATENCY > 0) || (KEEPOUT_WINDOW > 0)
static double size_of(double x)
{
    return (x < 0.0) ? -x : x;
}

/* Add what the commands of the last periods did: weights[i] T of each acceleration, the newest last. In Python: the sums of
 * pushes in SetMembership. */
static void pushed_since(const keepout_set_memory *memory, const double weights[KEEPOUT_KEPT], double change[3], double sizes[3])
{
    int32_t i;
    int32_t axis;
    for (axis = 0; axis < 3; axis++) {
        change[axis] = 0.0;
        sizes[axis] = 0.0;
        for (i = 0; i < KEEPOUT_KEPT; i++) {
            const double push = weights[i] * memory->accelerations[i][axis];
            change[axis] = change[axis] + push;
            sizes[axis] = sizes[axis] + size_of(push);
        }
    }
}
#endif

#if KEEPOUT_LATENCY > 0
/* Carry a velocity over the latency of its sample. In Python: SetMembership._velocity_now. */
static void velocity_now(const keepout_navigation *navigation, const keepout_set_memory *memory, keepout_ball *told)
{
    double weights[KEEPOUT_KEPT];
    double change[3];
    double sizes[3];
    double centre[3];
    int32_t i;
    for (i = 0; i < KEEPOUT_KEPT; i++) {
        weights[i] = (i >= (KEEPOUT_KEPT - KEEPOUT_LATENCY)) ? navigation->period : 0.0;
    }
    pushed_since(memory, weights, change, sizes);
    for (i = 0; i < 3; i++) {
        centre[i] = told->centre[i] + change[i];
    }
    set_ball(told, centre,
             told->radius + (((double)KEEPOUT_LATENCY * navigation->period) * navigation->disturbance),
             keepout_norm(told->centre) + keepout_norm(sizes));
}

/* Carry a position over the latency of its sample, with the velocity now. In Python: SetMembership._position_now. */
static void position_now(const keepout_navigation *navigation, const keepout_set_memory *memory,
                         const keepout_ball *velocity, keepout_ball *told)
{
    const double since = (double)KEEPOUT_LATENCY * navigation->period;
    double weights[KEEPOUT_KEPT];
    double change[3];
    double sizes[3];
    double drift[3];
    double centre[3];
    int32_t i;
    for (i = 0; i < KEEPOUT_KEPT; i++) {
        const int32_t place = i - (KEEPOUT_KEPT - KEEPOUT_LATENCY);
        weights[i] =
            (place >= 0) ? ((navigation->period * navigation->period) * ((double)place + 0.5)) : 0.0;
    }
    pushed_since(memory, weights, change, sizes);
    for (i = 0; i < 3; i++) {
        drift[i] = since * velocity->centre[i];
        centre[i] = (told->centre[i] + drift[i]) - change[i];
    }
    set_ball(told, centre,
             (told->radius + (since * velocity->radius)) + ((0.5 * (since * since)) * navigation->disturbance),
             (keepout_norm(told->centre) + keepout_norm(drift)) + keepout_norm(sizes));
}
#endif

#if KEEPOUT_WINDOW > 0
/* What the positions now and `elapsed` steps ago say of the velocity. In Python: SetMembership._velocity_between. */
static void velocity_between(const keepout_navigation *navigation, const keepout_set_memory *memory,
                             const keepout_ball *position, keepout_ball *told)
{
    const double *before = memory->centres[KEEPOUT_KEPT - KEEPOUT_WINDOW];
    const double since = (double)((memory->elapsed > 1) ? memory->elapsed : 1) * navigation->period;
    double weights[KEEPOUT_KEPT];
    double change[3];
    double sizes[3];
    double centre[3];
    double now[3];
    double then[3];
    int32_t i;
    for (i = 0; i < KEEPOUT_KEPT; i++) {
        const double age = ((double)i - ((double)KEEPOUT_KEPT - (double)memory->elapsed)) + 0.5;
        weights[i] = ((navigation->period * navigation->period) * keepout_maximum(age, 0.0)) / since;
    }
    pushed_since(memory, weights, change, sizes);
    for (i = 0; i < 3; i++) {
        now[i] = position->centre[i] / since;
        then[i] = before[i] / since;
        centre[i] = ((position->centre[i] - before[i]) / since) + change[i];
    }
    set_ball(told, centre,
             ((position->radius + memory->radii[KEEPOUT_KEPT - KEEPOUT_WINDOW]) / since)
                 + ((0.5 * since) * navigation->disturbance),
             (keepout_norm(now) + keepout_norm(then)) + keepout_norm(sizes));
}
#endif

/* Steps in a row that contradict, until one is believed. In Python: SetMembership.correct, counted. */
static int32_t counted(const cutting *quantity, int32_t before)
{
    int32_t count = before;
    if (quantity->heard) {
        count = (quantity->wrong && (before < (PATIENCE - 1))) ? (before + 1) : 0;
    }
    return count;
}

/* In Python: SetMembership.initial_state. */
void keepout_set_begin(const keepout_navigation *navigation, keepout_set_memory *memory, const keepout_estimate *estimate)
{
    int32_t i;
    int32_t axis;
    set_ball(&memory->position, estimate->position, navigation->position_error, keepout_norm(estimate->position));
    set_ball(&memory->velocity, estimate->velocity, navigation->velocity_error, keepout_norm(estimate->velocity));
    for (i = 0; i < KEEPOUT_KEPT; i++) {
        keepout_zero(memory->accelerations[i]);
        keepout_copy(estimate->position, memory->centres[i]);
        memory->radii[i] = navigation->position_error;
    }
    for (i = 0; i <= KEEPOUT_LATENCY; i++) {
        for (axis = 0; axis < 4; axis++) {
            memory->attitudes[i][axis] = estimate->attitude[axis];
        }
    }
    memory->elapsed = 0;
    memory->contradictions[0] = 0;
    memory->contradictions[1] = 0;
}

/* Cut velocity, then position, then velocity again where two positions bound it. In Python: SetMembership.correct. */
void keepout_set_know(const keepout_navigation *navigation, keepout_set_memory *memory,
                      const keepout_sample samples[KEEPOUT_SENSORS], keepout_knowledge *knowledge)
{
    const bool believe[2] = {memory->contradictions[0] >= (PATIENCE - 1), memory->contradictions[1] >= (PATIENCE - 1)};
    cutting position = {{{0.0, 0.0, 0.0}, 0.0}, false, false, false};
    cutting velocity = position;
    int32_t turn;
    int32_t i;
    int32_t j;
    position.known = memory->position;
    velocity.known = memory->velocity;
    for (j = 0; j < 4; j++) {
        for (i = 1; i <= KEEPOUT_LATENCY; i++) {
            memory->attitudes[i - 1][j] = memory->attitudes[i][j];
        }
        memory->attitudes[KEEPOUT_LATENCY][j] = knowledge->estimate.attitude[j];
    }
    for (turn = 0; turn < 2; turn++) { /* the velocity first */
        for (i = 0; i < KEEPOUT_SENSORS; i++) {
            const keepout_sensor *sensor = &navigation->sensor[i];
            const bool of_velocity = sensor->kind == KEEPOUT_RELATIVE_VELOCITY;
            const bool of_position =
                (sensor->kind == KEEPOUT_RELATIVE_POSITION) || (sensor->kind == KEEPOUT_RANGE_BEARING);
            keepout_ball told;
            if (samples[i].came && ((turn == 0) ? of_velocity : of_position)) {
                ball_of(sensor, samples[i].value, memory->attitudes[0], &told);
#if KEEPOUT_LATENCY > 0
                if (of_velocity) {
                    velocity_now(navigation, memory, &told);
                } else {
                    position_now(navigation, memory, &velocity.known, &told);
                }
#endif
                tell(of_velocity ? &velocity : &position, &told, believe[of_velocity ? 1 : 0]);
            }
        }
    }
#if KEEPOUT_WINDOW > 0
    if (position.replaced) { /* what was believed of the past goes with what was believed of the present */
        memory->elapsed = 0;
    }
    if (memory->elapsed > 0) {
        keepout_ball told;
        velocity_between(navigation, memory, &position.known, &told);
        tell(&velocity, &told, believe[1]);
    }
    for (i = 0; (i < KEEPOUT_KEPT) && position.replaced; i++) {
        keepout_copy(position.known.centre, memory->centres[i]);
        memory->radii[i] = position.known.radius;
    }
#endif
    memory->position = position.known;
    memory->velocity = velocity.known;
    memory->contradictions[0] = counted(&position, memory->contradictions[0]);
    memory->contradictions[1] = counted(&velocity, memory->contradictions[1]);
    knowledge->known = knowledge->estimate;
    keepout_copy(position.known.centre, knowledge->known.position);
    keepout_copy(velocity.known.centre, knowledge->known.velocity);
    knowledge->errors[0] = position.known.radius;
    knowledge->errors[1] = velocity.known.radius;
    knowledge->contradicted = position.wrong || velocity.wrong;
}

/* Move both balls over a period under a force that acts, N. In Python: SetMembership.advance. */
void keepout_set_told(const keepout_navigation *navigation, keepout_set_memory *memory, const double force[3])
{
    const double T = navigation->period;
    const double further = (memory->position.radius + (T * memory->velocity.radius))
                           + ((0.5 * (T * T)) * navigation->disturbance);
    const double faster = memory->velocity.radius + (T * navigation->disturbance);
    double acceleration[3];
    double drift[3];
    double push[3];
    double change[3];
    double place[3];
    double pace[3];
    int32_t i;
    for (i = 1; i < KEEPOUT_KEPT; i++) {
        memory->radii[i - 1] = memory->radii[i];
    }
    for (i = 0; i < 3; i++) {
        acceleration[i] = force[i] / navigation->guard_mass;
        drift[i] = T * memory->velocity.centre[i];
        push[i] = (0.5 * (T * T)) * acceleration[i];
        change[i] = T * acceleration[i];
        place[i] = (memory->position.centre[i] + drift[i]) + push[i];
        pace[i] = memory->velocity.centre[i] + change[i];
    }
    keepout_queue(memory->accelerations, KEEPOUT_KEPT, acceleration);
    keepout_queue(memory->centres, KEEPOUT_KEPT, memory->position.centre);
    memory->radii[KEEPOUT_KEPT - 1] = memory->position.radius;
    set_ball(&memory->position, place, further,
             (keepout_norm(memory->position.centre) + keepout_norm(drift)) + keepout_norm(push));
    set_ball(&memory->velocity, pace, faster, keepout_norm(memory->velocity.centre) + keepout_norm(change));
    memory->elapsed = (memory->elapsed < KEEPOUT_WINDOW) ? (memory->elapsed + 1) : KEEPOUT_WINDOW;
}

#endif
