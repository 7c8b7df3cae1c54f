/* Motion of the chaser relative to the target, in the target's turning body frame. In Python: motion/relative.py. */
#include <math.h>

#include "keepout_internal.h"

/* VVLH at one moment: the target's distance from the Earth's centre, and its rate and its change about -y. */
typedef struct {
    double radius;       /* m */
    double rate;         /* theta', rad/s */
    double acceleration; /* theta'', rad/s2 */
} orbital_frame;

static double squared(double x)
{
    return x * x;
}

static double cubed(double x)
{
    return (x * x) * x;
}

/* E of E - e sin E = M: Markley's cubic and two of his corrections. In Python: motion/orbit.py, eccentric_anomaly. */
static double eccentric_anomaly(double mean_anomaly, double e)
{
    const double two_pi = 2.0 * KEEPOUT_PI;
    const double square = KEEPOUT_PI * KEEPOUT_PI;
    double turns = mean_anomaly / two_pi;
    double m;
    double size;
    double alpha;
    double d;
    double q;
    double r;
    double w;
    double anomaly;
    int32_t i;
    /* To the nearest whole number: the two doubles beside a half need no care, as any whole number will do there. */
    turns = ((turns < 0.0) ? -1.0 : 1.0) * (double)keepout_to_index(((turns < 0.0) ? -turns : turns) + 0.5, 0, 2147483647);
    m = mean_anomaly - (two_pi * turns);
    size = (m < 0.0) ? -m : m;
    alpha = ((3.0 * square) + (((1.6 * KEEPOUT_PI) * (KEEPOUT_PI - size)) / (1.0 + e))) / (square - 6.0);
    d = (3.0 * (1.0 - e)) + (alpha * e);
    q = (((2.0 * alpha) * d) * (1.0 - e)) - (m * m);
    r = ((((3.0 * alpha) * d) * ((d - 1.0) + e)) * m) + cubed(m);
    w = squared(keepout_cbrt(((r < 0.0) ? -r : r) + sqrt(cubed(q) + (r * r))));
    anomaly = ((((2.0 * r) * w) / (((w * w) + (w * q)) + (q * q))) + m) / d;
    for (i = 0; i < 2; i++) {
        const double sine = e * keepout_sin(anomaly);
        const double cosine = e * keepout_cos(anomaly);
        const double f0 = (anomaly - sine) - m;
        const double f1 = 1.0 - cosine;
        const double d3 = -f0 / (f1 - (((0.5 * f0) * sine) / f1));
        const double d4 = -f0 / ((f1 + ((0.5 * d3) * sine)) + (((d3 * d3) * cosine) / 6.0));
        anomaly = anomaly + d4;
    }
    return anomaly;
}

/* In Python: Orbit.true_anomaly_at. */
static double true_anomaly_at(const keepout_motion *motion, double time)
{
    const double e = motion->eccentricity;
    const double half = motion->true_anomaly / 2.0;
    const double start = 2.0 * keepout_atan2(sqrt(1.0 - e) * keepout_sin(half),
                                             sqrt(1.0 + e) * keepout_cos(half));
    const double mean_motion = sqrt(motion->gravitational_parameter / cubed(motion->semi_major_axis));
    const double mean = (start - (e * keepout_sin(start))) + (mean_motion * time);
    const double anomaly = eccentric_anomaly(mean, e);
    const double beta = e / (1.0 + sqrt(1.0 - (e * e)));
    return anomaly
           + (2.0 * keepout_atan2(beta * keepout_sin(anomaly), 1.0 - (beta * keepout_cos(anomaly))));
}

/* In Python: Orbit.frame. */
static orbital_frame frame_at(const keepout_motion *motion, double time)
{
    const double e = motion->eccentricity;
    const double parameter = motion->semi_major_axis * (1.0 - (e * e));
    const double ratio = motion->gravitational_parameter / cubed(parameter);
    orbital_frame frame;
    double swell = 1.0;
    double sine = 0.0;
    if (e > 0.0) {
        const double theta = true_anomaly_at(motion, time);
        swell = 1.0 + (e * keepout_cos(theta));
        sine = keepout_sin(theta);
    }
    frame.radius = parameter / swell;
    frame.rate = sqrt(ratio) * squared(swell);
    frame.acceleration = (((-2.0 * ratio) * e) * sine) * cubed(swell);
    /* A time that is no number is none on a circle either. */
    if (!keepout_finite(time)) {
        frame.radius = time - time;
    }
    return frame;
}

/* The matrix of a unit quaternion. In Python: motion/rotation.py, matrix. */
static void matrix_of(const double q[4], double m[3][3])
{
    const double w = q[0];
    const double x = q[1];
    const double y = q[2];
    const double z = q[3];
    m[0][0] = 1.0 - (2.0 * ((y * y) + (z * z)));
    m[0][1] = 2.0 * ((x * y) - (w * z));
    m[0][2] = 2.0 * ((x * z) + (w * y));
    m[1][0] = 2.0 * ((x * y) + (w * z));
    m[1][1] = 1.0 - (2.0 * ((x * x) + (z * z)));
    m[1][2] = 2.0 * ((y * z) - (w * x));
    m[2][0] = 2.0 * ((x * z) - (w * y));
    m[2][1] = 2.0 * ((y * z) + (w * x));
    m[2][2] = 1.0 - (2.0 * ((x * x) + (y * y)));
}

static void times(const double m[3][3], const double v[3], double out[3])
{
    int32_t i;
    for (i = 0; i < 3; i++) {
        out[i] = keepout_dot(m[i], v);
    }
}

/* omega and omega' of the body, rad/s and rad/s2, in its axes. In Python: motion/attitude.py, rates. */
static void rates_of(const keepout_motion *motion, const keepout_estimate *state, const double body_from_vvlh[3][3],
                     const orbital_frame *frame, double rate[3], double acceleration[3])
{
    int32_t i;
    if (motion->turning == KEEPOUT_VVLH_FIXED) {
        for (i = 0; i < 3; i++) {
            rate[i] = -(body_from_vvlh[i][1] * frame->rate);
            acceleration[i] = -(body_from_vvlh[i][1] * frame->acceleration);
        }
    } else if (motion->turning == KEEPOUT_TUMBLING) {
        double turned[3];
        double torque[3];
        double column[3][3];
        double cofactor[3][3];
        double determinant;
        int32_t j;
        keepout_copy(state->angular_velocity, rate);
        times(motion->inertia, rate, turned);
        keepout_cross(turned, rate, torque); /* -omega x J omega */
        if (motion->gravity_gradient) {
            const double nadir[3] = {body_from_vvlh[0][2], body_from_vvlh[1][2], body_from_vvlh[2][2]};
            const double strength = (3.0 * motion->gravitational_parameter) / cubed(frame->radius);
            double pull[3];
            times(motion->inertia, nadir, turned);
            keepout_cross(nadir, turned, pull);
            for (i = 0; i < 3; i++) {
                torque[i] = torque[i] + (strength * pull[i]);
            }
        }
        for (i = 0; i < 3; i++) {
            for (j = 0; j < 3; j++) {
                column[i][j] = motion->inertia[j][i];
            }
        }
        keepout_cross(column[1], column[2], cofactor[0]);
        keepout_cross(column[2], column[0], cofactor[1]);
        keepout_cross(column[0], column[1], cofactor[2]);
        determinant = keepout_dot(column[0], cofactor[0]);
        for (i = 0; i < 3; i++) {
            acceleration[i] = keepout_dot(cofactor[i], torque) / determinant;
        }
    } else {
        keepout_zero(rate);
        keepout_zero(acceleration);
    }
}

/* Acceleration without force and disturbance, m/s2. In Python: RelativeMotion._drift and gravity_difference. */
static void drift_of(const keepout_motion *motion, const keepout_estimate *state, const double body_from_vvlh[3][3],
                     const orbital_frame *frame, const double rate[3], const double acceleration[3], double drift[3])
{
    double r[3];
    double target[3];
    double coriolis[3];
    double euler[3];
    double swung[3];
    double centrifugal[3];
    double q = 0.0;
    double square;
    double shrink;
    double cube;
    int32_t i;
    for (i = 0; i < 3; i++) {
        r[i] = state->position[i] - motion->centre_of_mass[i];
        target[i] = -(body_from_vvlh[i][2] * frame->radius);
    }
    keepout_cross(rate, state->velocity, coriolis);
    keepout_cross(acceleration, r, euler);
    keepout_cross(rate, r, swung);
    keepout_cross(rate, swung, centrifugal);
    square = keepout_dot(target, target);
    for (i = 0; i < 3; i++) {
        q = q + (r[i] * (r[i] + (2.0 * target[i])));
    }
    shrink = keepout_expm1(-1.5 * keepout_log1p(q / square));
    cube = square * sqrt(square);
    for (i = 0; i < 3; i++) {
        const double gravity = ((r[i] * (1.0 + shrink)) + (target[i] * shrink)) / cube;
        drift[i] = (((-2.0 * coriolis[i]) - euler[i]) - centrifugal[i]) - (motion->gravitational_parameter * gravity);
    }
}

/* In Python: RelativeMotion.drift_acceleration. */
void keepout_drift(const keepout_motion *motion, const keepout_estimate *state, double drift[3])
{
    const orbital_frame frame = frame_at(motion, state->time);
    double body_from_vvlh[3][3];
    double rate[3];
    double acceleration[3];
    matrix_of(state->attitude, body_from_vvlh);
    rates_of(motion, state, (const double(*)[3])body_from_vvlh, &frame, rate, acceleration);
    drift_of(motion, state, (const double(*)[3])body_from_vvlh, &frame, rate, acceleration, drift);
}

/* d/dt of position, velocity, attitude and angular velocity. */
typedef struct {
    double position[3];
    double velocity[3];
    double attitude[4];
    double angular_velocity[3];
} slope_of_state;

/* In Python: RelativeMotion._runge_kutta, derivative; `push` is force over mass. */
static void slope_at(const keepout_motion *motion, const keepout_estimate *state, const double push[3],
                     slope_of_state *slope)
{
    const orbital_frame frame = frame_at(motion, state->time);
    double body_from_vvlh[3][3];
    double rate[3];
    double relative[3];
    double across[3];
    int32_t i;
    matrix_of(state->attitude, body_from_vvlh);
    rates_of(motion, state, (const double(*)[3])body_from_vvlh, &frame, rate, slope->angular_velocity);
    drift_of(motion, state, (const double(*)[3])body_from_vvlh, &frame, rate, slope->angular_velocity, slope->velocity);
    for (i = 0; i < 3; i++) {
        slope->position[i] = state->velocity[i];
        slope->velocity[i] = slope->velocity[i] + push[i];
        relative[i] = rate[i] + (body_from_vvlh[i][1] * frame.rate);
    }
    /* -1/2 (0, omega) x q. In Python: motion/rotation.py, rate. */
    keepout_cross(relative, &state->attitude[1], across);
    slope->attitude[0] = 0.5 * keepout_dot(relative, &state->attitude[1]);
    for (i = 0; i < 3; i++) {
        slope->attitude[i + 1] = -0.5 * ((state->attitude[0] * relative[i]) + across[i]);
    }
}

static void moved_by(const keepout_estimate *from, const slope_of_state *slope, double duration, keepout_estimate *to)
{
    int32_t i;
    to->time = from->time + duration;
    for (i = 0; i < 3; i++) {
        to->position[i] = from->position[i] + (duration * slope->position[i]);
        to->velocity[i] = from->velocity[i] + (duration * slope->velocity[i]);
        to->angular_velocity[i] = from->angular_velocity[i] + (duration * slope->angular_velocity[i]);
    }
    for (i = 0; i < 4; i++) {
        to->attitude[i] = from->attitude[i] + (duration * slope->attitude[i]);
    }
}

/* Move a state a control period on under a force (N) that is held. In Python: RelativeMotion.step. */
void keepout_move(const keepout_motion *motion, keepout_estimate *state, const double force[3], double period,
                  double mass)
{
    static const double share[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    static const double ahead[4] = {0.0, 0.5, 0.5, 1.0};
    const double h = period / (double)motion->substeps;
    const double push[3] = {force[0] / mass, force[1] / mass, force[2] / mass};
    int32_t step;
    for (step = 0; (step < motion->substeps) && (step < KEEPOUT_MOST_SUBSTEPS); step++) {
        keepout_estimate there = *state;
        keepout_estimate end = *state;
        slope_of_state slope = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
        double length = 0.0;
        int32_t stage;
        int32_t i;
        for (stage = 0; stage < 4; stage++) {
            moved_by(state, &slope, ahead[stage] * h, &there);
            slope_at(motion, &there, push, &slope);
            moved_by(&end, &slope, share[stage] * h, &end);
        }
        end.time = state->time + h;
        for (i = 0; i < 4; i++) {
            length = length + (end.attitude[i] * end.attitude[i]);
        }
        length = sqrt(length);
        for (i = 0; i < 4; i++) {
            end.attitude[i] = end.attitude[i] / length;
        }
        if (motion->turning != KEEPOUT_TUMBLING) {
            const orbital_frame frame = frame_at(motion, end.time);
            double body_from_vvlh[3][3];
            double change[3];
            matrix_of(end.attitude, body_from_vvlh);
            rates_of(motion, &end, (const double(*)[3])body_from_vvlh, &frame, end.angular_velocity, change);
        }
        *state = end;
    }
}

#if KEEPOUT_SENSORS > 0
/* In Python: motion/rotation.py, matrix. */
void keepout_matrix(const double attitude[4], double body_from_vvlh[3][3])
{
    matrix_of(attitude, body_from_vvlh);
}

/* How the target turns, and its distance from the Earth's centre, m. In Python: RelativeMotion.orbital_frame and rates. */
double keepout_turning(const keepout_motion *motion, const keepout_estimate *state, double body_from_vvlh[3][3],
                       double rate[3], double acceleration[3])
{
    const orbital_frame frame = frame_at(motion, state->time);
    matrix_of(state->attitude, body_from_vvlh);
    rates_of(motion, state, (const double(*)[3])body_from_vvlh, &frame, rate, acceleration);
    return frame.radius;
}
#endif
