/* What the sources of Keepout share among themselves. */
#ifndef KEEPOUT_INTERNAL_H
#define KEEPOUT_INTERNAL_H

#include "keepout.h"

#define KEEPOUT_PI 3.14159265358979323846

#if KEEPOUT_KEPT > KEEPOUT_MOST_DELAY
#define KEEPOUT_MOST_QUEUED KEEPOUT_KEPT /* vectors in a queue */
#else
#define KEEPOUT_MOST_QUEUED KEEPOUT_MOST_DELAY
#endif

/* keepout_math.c: functions of our own, since libraries differ in the last digits of theirs. */
bool keepout_is_nan(double x);
bool keepout_finite(double x);
bool keepout_finite3(const double x[3]);
double keepout_exp(double x);
double keepout_log(double x);
double keepout_log1p(double x);
double keepout_expm1(double x);
double keepout_tanh(double x);
double keepout_sin(double x);
double keepout_cos(double x);
double keepout_atan2(double y, double x);
double keepout_acos(double x);
double keepout_cbrt(double x);
double keepout_maximum(double a, double b);
double keepout_minimum(double a, double b);
double keepout_clip(double x, double low, double high);
int32_t keepout_to_index(double x, int32_t low, int32_t high);
double keepout_dot(const double a[3], const double b[3]);
double keepout_norm(const double a[3]);
double keepout_distance(const double a[3], const double b[3]);
void keepout_cross(const double a[3], const double b[3], double out[3]);
void keepout_copy(const double from[3], double to[3]);
void keepout_zero(double out[3]);
void keepout_queue(double pending[][3], int32_t count, const double newest[3]);
void keepout_step_ahead(const double position[3], const double velocity[3], double period, const double acceleration[3],
                        double position_out[3], double velocity_out[3]);

/* keepout_field.c */
void keepout_into_domain(const keepout_continuation *c, const double point[3], double inside[3]);
double keepout_continued(const keepout_continuation *c, const double point[3], double value);
void keepout_continued_gradient(const keepout_continuation *c, const double point[3], double gradient[3]);
double keepout_network_value_and_gradient(const keepout_network *field, const double point[3], double gradient[3]);

/* keepout_spline.c. Points of one step lie close together: the cell found last is kept for the next one. */
typedef struct {
    bool known;
    int32_t level;
    int32_t start[3];            /* its first coefficient's node */
    float coefficients[4][4][4]; /* m */
} keepout_cell;

double keepout_spline_value(const keepout_spline *field, const double point[3], keepout_cell *cell);
double keepout_spline_value_and_gradient(const keepout_spline *field, const double point[3], double gradient[3]);

/* keepout_motion.c */
void keepout_drift(const keepout_motion *motion, const keepout_estimate *state, double drift[3]);
void keepout_move(const keepout_motion *motion, keepout_estimate *state, const double force[3], double period,
                  double mass);
#if KEEPOUT_SENSORS > 0
void keepout_matrix(const double attitude[4], double body_from_vvlh[3][3]);
double keepout_turning(const keepout_motion *motion, const keepout_estimate *state, double body_from_vvlh[3][3],
                       double rate[3], double acceleration[3]);
#endif

/* keepout_law.c */
void keepout_law_begin(const keepout_mission *mission, keepout_law_memory *memory, const keepout_estimate *estimate,
                       const double (*under_way)[3]);
void keepout_law_step(const keepout_mission *mission, keepout_law_memory *memory, const keepout_estimate *estimate,
                      keepout_order *order);
void keepout_law_told(const keepout_law *law, keepout_law_memory *memory, const double force[3]);

/* keepout_guard.c. How much of an estimate by sensors is known: bounds of its errors in position (m) and velocity (m/s),
 * and whether what it is made of contradicts itself. Without sensors nothing of it is looked at. */
typedef struct {
    double errors[2];
    bool contradicted;
} keepout_doubt;

void keepout_guard_begin(const keepout_mission *mission, keepout_guard_memory *memory, const keepout_estimate *estimate,
                         const double (*under_way)[3]);
int32_t keepout_guard_filter(const keepout_mission *mission, keepout_guard_memory *memory,
                             const keepout_estimate *estimate, const keepout_doubt *doubt, const double force[3],
                             const double disturbance_estimate[3], double filtered[3]);

#if KEEPOUT_SENSORS > 0
/* keepout_navigation.c */
int32_t keepout_expected(const keepout_sensor *sensor, const keepout_estimate *state, double value[4],
                         double slopes[3][6]);
void keepout_navigation_begin(const keepout_mission *mission, keepout_navigation_memory *memory,
                              const keepout_estimate *estimate, const double (*under_way)[3]);
void keepout_navigation_know(const keepout_mission *mission, keepout_navigation_memory *memory,
                             const keepout_sample samples[KEEPOUT_SENSORS], keepout_knowledge *knowledge);
void keepout_navigation_told(const keepout_mission *mission, keepout_navigation_memory *memory, const double force[3]);

/* keepout_known_set.c */
void keepout_set_begin(const keepout_navigation *navigation, keepout_set_memory *memory,
                       const keepout_estimate *estimate);
void keepout_set_know(const keepout_navigation *navigation, keepout_set_memory *memory,
                      const keepout_sample samples[KEEPOUT_SENSORS], keepout_knowledge *knowledge);
void keepout_set_told(const keepout_navigation *navigation, keepout_set_memory *memory, const double force[3]);
#endif

/* keepout_thrusters.c */
void keepout_thrusters_begin(keepout_thruster_memory *memory);
void keepout_thrusters_fire(const keepout_thrusters *thrusters, keepout_thruster_memory *memory, keepout_order *order);

#endif
