/* The law's estimate of what the sensors of a suite say: an extended Kalman filter of position, velocity and disturbance.
 * In Python: flights/navigation/estimators.py, KalmanFilter; the sensors: flights/navigation/sensors.py.
 *
 * The state is [r, v, xi], xi by its parts and of each part by axis; P is its covariance, all of it. */
#include <math.h>

#include "keepout_internal.h"

#if KEEPOUT_SENSORS > 0

#define PATIENCE 5           /* samples of a sensor that are left out in a row before P is widened */
#define MOST_WIDENING 100.0  /* largest factor on P for one sample left out */
#define WIDEST_POSITION 1.0e4 /* m2: no sample widens a variance beyond these */
#define WIDEST_VELOCITY 1.0  /* m2/s2 */
#define WIDEST_PUSH 100.0    /* of that at the start */
#define MOST_COUNTED 2147483647

/* In Python: DisturbanceModel.mean, of the part of a state or of a column of P that is xi, along one axis. */
static double mean_of(const keepout_navigation *navigation, const double xi[3 * KEEPOUT_PUSHES], int32_t axis)
{
    double sum = navigation->mean_output[0] * xi[axis];
    int32_t i;
    for (i = 1; i < KEEPOUT_PUSHES; i++) {
        sum = sum + (navigation->mean_output[i] * xi[(3 * i) + axis]);
    }
    return sum;
}

/* exp(A T) xi in its place. In Python: DisturbanceModel.moved. */
static void move_disturbance(const keepout_navigation *navigation, double xi[3 * KEEPOUT_PUSHES])
{
    int32_t i;
    int32_t axis;
    for (i = 1; i < KEEPOUT_PUSHES; i = i + 2) {
        const double cosine = navigation->cosine[i / 2];
        const double sine = navigation->sine[i / 2];
        for (axis = 0; axis < 3; axis++) {
            const double a = xi[(3 * i) + axis];
            const double b = xi[(3 * (i + 1)) + axis];
            xi[(3 * i) + axis] = (cosine * a) + (sine * b);
            xi[(3 * (i + 1)) + axis] = (cosine * b) - (sine * a);
        }
    }
}

static void cross_matrix(const double w[3], double out[3][3])
{
    int32_t i;
    for (i = 0; i < 3; i++) {
        out[i][i] = 0.0;
    }
    out[0][1] = -w[2];
    out[0][2] = w[1];
    out[1][0] = w[2];
    out[1][2] = -w[0];
    out[2][0] = -w[1];
    out[2][1] = w[0];
}

static void matrix_product(const double a[3][3], const double b[3][3], double out[3][3])
{
    int32_t i;
    int32_t j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            out[i][j] = ((a[i][0] * b[0][j]) + (a[i][1] * b[1][j])) + (a[i][2] * b[2][j]);
        }
    }
}

/* The Jacobian of a period's motion by r, v and a held acceleration: the series of r'' = G r + D r' + a. In Python:
 * estimators.transition. */
static void transition(const keepout_motion *motion, const keepout_estimate *state, double t, double top[6][9])
{
    const double t2 = (t * t) / 2.0;
    const double t3 = ((t * t) * t) / 6.0;
    const double t4 = ((t * t) * (t * t)) / 24.0;
    double body_from_vvlh[3][3];
    double rate[3];
    double acceleration[3];
    double turn[3][3];
    double speeding[3][3];
    double twice[3][3];
    double D[3][3];
    double G[3][3];
    double DG[3][3];
    double E[3][3];
    double tide;
    int32_t i;
    int32_t j;
    const double radius = keepout_turning(motion, state, body_from_vvlh, rate, acceleration);
    tide = motion->gravitational_parameter / ((radius * radius) * radius);
    for (i = 0; i < 3; i++) {
        rate[i] = rate[i] + ((0.5 * t) * acceleration[i]); /* that of the period's middle */
    }
    cross_matrix(rate, turn);
    cross_matrix(acceleration, speeding);
    matrix_product((const double(*)[3])turn, (const double(*)[3])turn, twice);
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            const double one = (i == j) ? 1.0 : 0.0;
            D[i][j] = -2.0 * turn[i][j];
            G[i][j] = (-speeding[i][j] - twice[i][j])
                      - (tide * (one - ((3.0 * body_from_vvlh[i][2]) * body_from_vvlh[j][2])));
        }
    }
    matrix_product((const double(*)[3])D, (const double(*)[3])G, DG);
    matrix_product((const double(*)[3])D, (const double(*)[3])D, E);
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            const double one = (i == j) ? 1.0 : 0.0;
            const double e = E[i][j] + G[i][j];
            const double by_velocity = ((t * one) + (t2 * D[i][j])) + (t3 * e);
            top[i][j] = (one + (t2 * G[i][j])) + (t3 * DG[i][j]);
            top[i][3 + j] = by_velocity;
            top[i][6 + j] = ((t2 * one) + (t3 * D[i][j])) + (t4 * e);
            top[3 + i][j] = (t * G[i][j]) + (t2 * DG[i][j]);
            top[3 + i][3 + j] = (one + (t * D[i][j])) + (t2 * e);
            top[3 + i][6 + j] = by_velocity;
        }
    }
}

/* F x in its place, of a column of P. In Python: KalmanFilter.predicted, moved. */
static void move_column(const keepout_navigation *navigation, const double top[6][9], double x[KEEPOUT_STATES])
{
    double held[9];
    int32_t i;
    int32_t j;
    for (i = 0; i < 6; i++) {
        held[i] = x[i];
    }
    for (i = 0; i < 3; i++) {
        held[6 + i] = mean_of(navigation, &x[6], i);
    }
    for (i = 0; i < 6; i++) {
        double sum = 0.0;
        for (j = 0; j < 9; j++) {
            sum = sum + (top[i][j] * held[j]);
        }
        x[i] = sum;
    }
    move_disturbance(navigation, &x[6]);
}

/* What a period adds to an entry of P. In Python: estimators.kalman_filter, process_noise. */
static double noise_of(const keepout_navigation *navigation, int32_t i, int32_t j)
{
    double noise = 0.0;
    if ((i < 6) && (j < 6) && ((i % 3) == (j % 3))) {
        noise = navigation->noise[i / 3][j / 3];
    }
    if ((i >= 6) && (i == j)) {
        noise = navigation->walk;
    }
    return noise;
}

/* P a period later: F P F^T and what a period adds, of the state before it moves. In Python: KalmanFilter.predicted. */
static void widen_by_motion(const keepout_mission *mission, keepout_belief *belief)
{
    const keepout_navigation *navigation = mission->navigation;
    double (*P)[KEEPOUT_STATES] = belief->covariance;
    double top[6][9];
    int32_t i;
    int32_t j;
    transition(mission->motion, &belief->motion, navigation->period, top);
    for (i = 0; i < 6; i++) {
        for (j = 6; j < 9; j++) {
            top[i][j] = top[i][j] / navigation->mass;
        }
    }
    for (j = 0; j < KEEPOUT_STATES; j++) {
        double column[KEEPOUT_STATES];
        for (i = 0; i < KEEPOUT_STATES; i++) {
            column[i] = P[i][j];
        }
        move_column(navigation, (const double(*)[9])top, column);
        for (i = 0; i < KEEPOUT_STATES; i++) {
            P[i][j] = column[i];
        }
    }
    for (i = 0; i < KEEPOUT_STATES; i++) { /* F (F P)^T */
        move_column(navigation, (const double(*)[9])top, P[i]);
    }
    for (i = 0; i < KEEPOUT_STATES; i++) {
        for (j = 0; j <= i; j++) {
            P[i][j] = (0.5 * (P[i][j] + P[j][i])) + noise_of(navigation, i, j);
            P[j][i] = P[i][j];
        }
    }
}

/* The state a period later, of a chaser under a force, N. In Python: KalmanFilter.predicted. */
static void move_belief(const keepout_mission *mission, const double force[3], keepout_belief *belief)
{
    const keepout_navigation *navigation = mission->navigation;
    double push[3];
    int32_t i;
    for (i = 0; i < 3; i++) {
        push[i] = force[i] + mean_of(navigation, belief->disturbance, i);
    }
    keepout_move(mission->motion, &belief->motion, push, navigation->period, navigation->mass);
    move_disturbance(navigation, belief->disturbance);
}

/* What a sensor would say of a state, and its slopes by position and velocity; how many numbers that is. Of the attitude
 * there are no slopes. In Python: estimators.linearised and Sensor.ideal. */
int32_t keepout_expected(const keepout_sensor *sensor, const keepout_estimate *state, double value[4], double slopes[3][6])
{
    int32_t count = 3;
    int32_t i;
    int32_t j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 6; j++) {
            slopes[i][j] = 0.0;
        }
    }
    for (i = 0; i < 4; i++) {
        value[i] = 0.0;
    }
    if (sensor->kind == KEEPOUT_TARGET_ATTITUDE) {
        count = 4;
        for (i = 0; i < 4; i++) {
            value[i] = state->attitude[i];
        }
    } else if (sensor->kind == KEEPOUT_RANGE_RATE) {
        const double distance = keepout_norm(state->position);
        const double range = keepout_maximum(distance, 1e-12);
        count = 1;
        value[0] = keepout_dot(state->position, state->velocity) / range;
        for (i = 0; i < 3; i++) {
            const double along = state->position[i] / range;
            slopes[0][i] = (state->velocity[i] - ((distance > 1e-12) ? (value[0] * along) : 0.0)) / range;
            slopes[0][3 + i] = along;
        }
    } else {
        const int32_t first = (sensor->kind == KEEPOUT_RELATIVE_VELOCITY) ? 3 : 0;
        const double *vector = (first == 3) ? state->velocity : state->position;
        double body_from_vvlh[3][3];
        keepout_matrix(state->attitude, body_from_vvlh);
        for (i = 0; i < 3; i++) {
            for (j = 0; j < 3; j++) {
                slopes[i][first + j] = sensor->in_vvlh ? body_from_vvlh[j][i] : ((i == j) ? 1.0 : 0.0);
            }
            value[i] = keepout_dot(&slopes[i][first], vector);
        }
    }
    return count;
}

/* The covariance of a sample's error. In Python: Sensor.covariance. */
static void covariance_of(const keepout_sensor *sensor, const double value[4], double R[3][3])
{
    const double square = keepout_dot(value, value);
    int32_t i;
    int32_t j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            const double one = (i == j) ? 1.0 : 0.0;
            const double outer = value[i] * value[j];
            R[i][j] = sensor->variance * one;
            if (sensor->kind == KEEPOUT_RANGE_BEARING) {
                const double along = outer / keepout_maximum(square, 1e-24);
                R[i][j] = (sensor->variance * along) + ((square * sensor->bearing_variance) * (one - along));
            }
            if (sensor->in_vvlh) {
                R[i][j] = R[i][j] + (sensor->attitude_variance * ((square * one) - outer));
            }
        }
    }
}

/* L of S = L L^T (Cholesky), of the lower triangle of the first rows of S. In Python: estimators.factorised. */
static void factorise(const double S[3][3], int32_t count, double lower[3][3])
{
    int32_t i;
    int32_t j;
    int32_t k;
    for (i = 0; i < count; i++) {
        for (j = 0; j <= i; j++) {
            double rest = S[i][j];
            for (k = 0; k < j; k++) {
                rest = rest - (lower[i][k] * lower[j][k]);
            }
            lower[i][j] = (i == j) ? sqrt(rest) : (rest / lower[j][j]);
        }
    }
}

/* L^-1 b in its place. In Python: estimators.solved. */
static void solve(const double lower[3][3], int32_t count, double b[3])
{
    int32_t i;
    int32_t k;
    for (i = 0; i < count; i++) {
        for (k = 0; k < i; k++) {
            b[i] = b[i] - (lower[i][k] * b[k]);
        }
        b[i] = b[i] / lower[i][i];
    }
}

/* L^-T b in its place. In Python: estimators.solved_back. */
static void solve_back(const double lower[3][3], int32_t count, double b[3])
{
    int32_t i;
    int32_t k;
    for (i = count - 1; i >= 0; i--) {
        for (k = i + 1; k < count; k++) {
            b[i] = b[i] - (lower[k][i] * b[k]);
        }
        b[i] = b[i] / lower[i][i];
    }
}

/* Take a sample in, in Joseph's form. In Python: KalmanFilter._corrected, of a sample that is used. */
static void take(keepout_belief *belief, const double slopes[3][6], const double R[3][3], const double lower[3][3],
                 int32_t count, const double PH[KEEPOUT_STATES][3], const double innovation[3])
{
    double (*P)[KEEPOUT_STATES] = belief->covariance;
    double K[KEEPOUT_STATES][3];
    int32_t i;
    int32_t j;
    int32_t k;
    int32_t m;
    for (i = 0; i < KEEPOUT_STATES; i++) {
        keepout_copy(PH[i], K[i]);
        solve(lower, count, K[i]);
        solve_back(lower, count, K[i]);
    }
    for (i = 0; i < KEEPOUT_STATES; i++) {
        double turned[3];
        double change = 0.0;
        for (j = 0; j < KEEPOUT_STATES; j++) {
            double sum = 0.0;
            for (m = 0; m < count; m++) {
                sum = sum + (K[i][m] * PH[j][m]);
            }
            P[i][j] = P[i][j] - sum; /* M */
        }
        for (m = 0; m < count; m++) { /* M H^T - K R */
            turned[m] = 0.0;
            for (k = 0; k < 6; k++) {
                turned[m] = turned[m] + (P[i][k] * slopes[m][k]);
            }
            for (k = 0; k < count; k++) {
                turned[m] = turned[m] - (K[i][k] * R[k][m]);
            }
            change = change + (K[i][m] * innovation[m]);
        }
        for (j = 0; j < KEEPOUT_STATES; j++) {
            double sum = 0.0;
            for (m = 0; m < count; m++) {
                sum = sum + (turned[m] * K[j][m]);
            }
            P[i][j] = P[i][j] - sum;
        }
        if (i < 3) {
            belief->motion.position[i] = belief->motion.position[i] + change;
        } else if (i < 6) {
            belief->motion.velocity[i - 3] = belief->motion.velocity[i - 3] + change;
        } else {
            belief->disturbance[i - 6] = belief->disturbance[i - 6] + change;
        }
    }
}

/* Widen P after samples that were left out in a row, as many times as is wanted and allowed. In Python:
 * KalmanFilter._widening. */
static void widen(const keepout_navigation *navigation, double P[KEEPOUT_STATES][KEEPOUT_STATES], double wanted)
{
    double factors[KEEPOUT_STATES];
    int32_t i;
    int32_t j;
    for (i = 0; i < KEEPOUT_STATES; i++) {
        double widest = WIDEST_PUSH * navigation->disturbance_variance;
        double room = 1.0;
        if (i < 6) {
            widest = (i < 3) ? WIDEST_POSITION : WIDEST_VELOCITY;
        }
        if (P[i][i] > 0.0) {
            room = widest / P[i][i];
        }
        factors[i] = sqrt(keepout_maximum(keepout_minimum(wanted, room), 1.0));
    }
    for (i = 0; i < KEEPOUT_STATES; i++) {
        for (j = 0; j < KEEPOUT_STATES; j++) {
            P[i][j] = (factors[i] * P[i][j]) * factors[j];
        }
    }
}

/* Update by a sample that came, or leave it out; whether it was. In Python: KalmanFilter._corrected. */
static bool correct(const keepout_navigation *navigation, const keepout_sensor *sensor, const keepout_sample *sample,
                    keepout_belief *belief, int32_t *left_out)
{
    double expected[4];
    double value[4] = {0.0, 0.0, 0.0, 0.0};
    double slopes[3][6];
    double R[3][3];
    double S[3][3];
    double lower[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    double PH[KEEPOUT_STATES][3];
    double innovation[3] = {0.0, 0.0, 0.0};
    double whitened[3];
    double square;
    const int32_t count = keepout_expected(sensor, &belief->motion, expected, slopes);
    bool finite = true;
    bool use;
    int32_t i;
    int32_t k;
    int32_t m;
    for (m = 0; (m < count) && (m < 3); m++) {
        value[m] = sample->value[m];
        finite = finite && keepout_finite(value[m]);
        innovation[m] = value[m] - expected[m];
    }
    covariance_of(sensor, value, R);
    for (i = 0; i < KEEPOUT_STATES; i++) {
        for (m = 0; m < 3; m++) {
            PH[i][m] = 0.0;
            for (k = 0; k < 6; k++) {
                PH[i][m] = PH[i][m] + (belief->covariance[i][k] * slopes[m][k]);
            }
        }
    }
    for (i = 0; i < 3; i++) {
        for (m = 0; m < 3; m++) {
            S[i][m] = 0.0;
            for (k = 0; k < 6; k++) {
                S[i][m] = S[i][m] + (slopes[i][k] * PH[k][m]);
            }
            S[i][m] = S[i][m] + R[i][m];
        }
    }
    factorise((const double(*)[3])S, count, lower);
    keepout_copy(innovation, whitened);
    solve((const double(*)[3])lower, count, whitened);
    square = keepout_dot(whitened, whitened);
    use = finite && (square <= sensor->gate);
    if (use) {
        take(belief, (const double(*)[6])slopes, (const double(*)[3])R, (const double(*)[3])lower, count,
             (const double(*)[3])PH, innovation);
        *left_out = 0;
    } else {
        if (finite && (*left_out >= PATIENCE)) {
            const double wanted = (2.0 * square) / sensor->gate;
            widen(navigation, belief->covariance, (wanted < MOST_WIDENING) ? wanted : MOST_WIDENING);
        }
        if (*left_out < MOST_COUNTED) {
            *left_out = *left_out + 1;
        }
    }
    return !use;
}

/* Turn an attitude by a share of the way to a sampled one, the shorter one; whether that was none. In Python:
 * estimators.turned. */
static bool turn_attitude(double attitude[4], const double sampled[4], double share)
{
    double square = 0.0;
    double length;
    bool valid;
    int32_t i;
    for (i = 0; i < 4; i++) {
        square = square + (sampled[i] * sampled[i]);
    }
    length = sqrt(square);
    valid = keepout_finite(length) && (length > 0.0);
    if (valid) {
        double along = 0.0;
        double pulled[4];
        for (i = 0; i < 4; i++) {
            along = along + ((sampled[i] / length) * attitude[i]);
        }
        square = 0.0;
        for (i = 0; i < 4; i++) {
            const double wanted = (along < 0.0) ? -(sampled[i] / length) : (sampled[i] / length);
            pulled[i] = attitude[i] + (share * (wanted - attitude[i]));
            square = square + (pulled[i] * pulled[i]);
        }
        for (i = 0; i < 4; i++) {
            attitude[i] = pulled[i] / sqrt(square);
        }
    }
    return !valid;
}

/* Take the samples of the belief's own time; how many were left out. In Python: KalmanFilter.updated. */
static int32_t update(const keepout_navigation *navigation, const keepout_sample samples[KEEPOUT_SENSORS],
                      keepout_belief *belief)
{
    int32_t outliers = 0;
    int32_t i;
    for (i = 0; i < KEEPOUT_SENSORS; i++) {
        const keepout_sensor *sensor = &navigation->sensor[i];
        bool out = false;
        if (samples[i].came) {
            if (sensor->kind == KEEPOUT_TARGET_ATTITUDE) {
                out = turn_attitude(belief->motion.attitude, samples[i].value, navigation->attitude_share);
            } else {
                out = correct(navigation, sensor, &samples[i], belief, &belief->left_out[i]);
            }
        }
        outliers += out ? 1 : 0;
    }
    return outliers;
}

/* In Python: KalmanFilter.initial_state and of Navigation.begin the commands under way. */
void keepout_navigation_begin(const keepout_mission *mission, keepout_navigation_memory *memory,
                              const keepout_estimate *estimate, const double (*under_way)[3])
{
    const keepout_navigation *navigation = mission->navigation;
    const int32_t delay = (mission->law->delay < KEEPOUT_DELAY) ? mission->law->delay : KEEPOUT_DELAY;
    keepout_belief *belief = &memory->settled;
    int32_t i;
    int32_t j;
    belief->motion = *estimate;
    for (i = 0; i < KEEPOUT_STATES; i++) {
        for (j = 0; j < KEEPOUT_STATES; j++) {
            belief->covariance[i][j] = 0.0;
        }
        belief->covariance[i][i] = navigation->disturbance_variance;
        if (i < 6) {
            const double error = (i < 3) ? navigation->position_error : navigation->velocity_error;
            belief->covariance[i][i] = (error * error) / 5.0; /* even in a ball */
        }
    }
    for (i = 0; i < (3 * KEEPOUT_PUSHES); i++) {
        belief->disturbance[i] = 0.0;
    }
    for (i = 0; i < KEEPOUT_SENSORS; i++) {
        belief->left_out[i] = 0;
    }
    for (i = 0; i <= KEEPOUT_LATENCY; i++) {
        keepout_zero(memory->forces[i]);
    }
    for (i = 0; i < KEEPOUT_DELAY; i++) {
        keepout_zero(memory->pending[i]);
        if ((under_way != NULL) && (i < delay)) {
            keepout_copy(under_way[(KEEPOUT_MOST_DELAY - delay) + i], memory->pending[i]);
        }
    }
    memory->steps = 0;
    keepout_set_begin(navigation, &memory->set, estimate);
}

/* Take the samples that arrived, all of them KEEPOUT_LATENCY periods old, and run ahead to now. Before the start there was
 * nothing to believe, to move or to sample. In Python: Navigation.know and KalmanFilter.correct. */
void keepout_navigation_know(const keepout_mission *mission, keepout_navigation_memory *memory,
                             const keepout_sample samples[KEEPOUT_SENSORS], keepout_knowledge *knowledge)
{
    keepout_belief belief = memory->settled;
    int32_t i;
    knowledge->outliers = 0;
    for (i = 0; i <= KEEPOUT_LATENCY; i++) {
        const bool moved = memory->steps > (KEEPOUT_LATENCY - i);
        if (moved && (i == 0)) {
            widen_by_motion(mission, &belief); /* later on nobody asks for P: no sample is taken there */
        }
        if (moved) {
            move_belief(mission, memory->forces[i], &belief);
        }
        if (i == 0) {
            if (memory->steps >= KEEPOUT_LATENCY) {
                knowledge->outliers = update(mission->navigation, samples, &belief);
            }
            memory->settled = belief;
        }
    }
    knowledge->estimate = belief.motion;
    for (i = 0; i < 3; i++) {
        knowledge->disturbance[i] = mean_of(mission->navigation, belief.disturbance, i);
    }
    keepout_set_know(mission->navigation, &memory->set, samples, knowledge);
}

/* Be told of the force (N) that was commanded. In Python: Navigation.told and KalmanFilter.advance. */
void keepout_navigation_told(const keepout_mission *mission, keepout_navigation_memory *memory, const double force[3])
{
    const int32_t delay = (mission->law->delay < KEEPOUT_DELAY) ? mission->law->delay : KEEPOUT_DELAY;
    double acting[3];
    keepout_copy((delay > 0) ? memory->pending[0] : force, acting);
    keepout_queue(memory->forces, KEEPOUT_LATENCY + 1, acting);
    keepout_queue(memory->pending, delay, force);
    keepout_set_told(mission->navigation, &memory->set, acting);
    if (memory->steps <= KEEPOUT_LATENCY) {
        memory->steps = memory->steps + 1;
    }
}

#endif
