/* Keepout on board: one control step of law, guard and thrusters, in C99.
 *
 * Call keepout_begin once, then keepout_step once a control period. Nothing is allocated, nothing recurses, nothing is
 * global, and every loop is bounded by a constant below. All numbers are SI units; positions and velocities are those
 * of the chaser relative to the target, in the target's body axes.
 *
 * In Python: core/flight/loop.py, `command`. The sources are the same for every mission; `mission_tables.c` and the
 * image of its tables hold what differs.
 */
#ifndef KEEPOUT_H
#define KEEPOUT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined(__FAST_MATH__)
#error "Keepout: -ffast-math changes results; compile without it"
#endif

#include "mission_sizes.h"

#define KEEPOUT_FORMAT 1u        /* of the image of tables */
#define KEEPOUT_MOST_DELAY 8     /* control periods from command to effect */
#define KEEPOUT_MOST_PARTS 15    /* into which the guard cuts a stop segment */
#define KEEPOUT_MOST_SUBSTEPS 64 /* Runge-Kutta steps in a control period */

/* Of the mission, from mission_sizes.h: KEEPOUT_LAYERS hidden layers of a learned field, KEEPOUT_WIDTH neurons in the
 * widest, KEEPOUT_LEVELS of a spline, KEEPOUT_DELAY commands kept, KEEPOUT_WINDOWS over which the guard watches its
 * assumptions, KEEPOUT_MODEL numbers an axis in the disturbance observer, KEEPOUT_THRUSTERS of a layout in
 * KEEPOUT_GROUPS of one direction, KEEPOUT_POINTS of its allocation; each at least 1. KEEPOUT_SENSORS of a suite: where
 * there are none, nothing of navigation is compiled. KEEPOUT_LATENCY control periods from a sample to its arrival,
 * KEEPOUT_PUSHES numbers an axis in the filter's model of the disturbance, KEEPOUT_WINDOW periods between two positions
 * that bound the velocity, KEEPOUT_KEPT periods of which the set keeps the commands. */

/* What a control step is told. */
typedef struct {
    double time;                /* s since the orbit's epoch; within 1e9 s of it */
    double position[3];         /* m */
    double velocity[3];         /* m/s, as seen by one who turns with the body */
    double attitude[4];         /* body from VVLH, unit quaternion, scalar first */
    double angular_velocity[3]; /* rad/s, inertial, body axes */
} keepout_estimate;

#if KEEPOUT_SENSORS > 0
/* What one sensor says at a control step. */
typedef struct {
    bool came;       /* whether a sample arrived that was taken KEEPOUT_LATENCY control periods ago */
    double value[4]; /* of that time, in the sensor's units and axes: as many numbers as it has */
} keepout_sample;

/* What a control step knows by its samples. In Python: core/flight/navigation.py, Knowledge. */
typedef struct {
    keepout_estimate estimate; /* the law's */
    double disturbance[3];     /* mean of the coming period, N */
    int32_t outliers;          /* samples that the estimate left out */
    keepout_estimate known;    /* the guard's: the centre of the set that holds the truth */
    double errors[2];          /* its radii, m and m/s */
    bool contradicted;         /* whether the samples cannot all be within their bounds */
} keepout_knowledge;
#endif

/* What a control step answers. */
typedef struct {
    double force[3];            /* N, body axes: to be held until the next step */
    double commanded_force[3];  /* the law's, before the guard, N */
    double desired_velocity[3]; /* m/s */
    double safe_velocity[3];    /* m/s */
    double disturbance_estimate[3]; /* N */
    double barrier;             /* h, m */
    double backstepping_barrier; /* h_1, m */
    double lyapunov;            /* V_1, m2 */
    int32_t control_status;     /* a KEEPOUT_LAW_* */
    int32_t guard_status;       /* a KEEPOUT_GUARD_* plus KEEPOUT_FLAG_* bits; 0 without a guard */
    double mean_force[3];       /* what the thrusters are to give in the mean, N; without a layout the force, held */
    double pulse[KEEPOUT_THRUSTERS]; /* how long to command each thruster open, in the middle of the period, s */
    double on_time[KEEPOUT_THRUSTERS]; /* how long each is open in the period, s: it opens and closes late */
} keepout_order;

/* In Python: control/law.py, ControlStatus. */
enum {
    KEEPOUT_LAW_NOMINAL = 0,
    KEEPOUT_LAW_SATURATED = 1,
    KEEPOUT_LAW_OUTSIDE_SAFE_SET = 2,
    KEEPOUT_LAW_NOT_FINITE = 4,
    KEEPOUT_LAW_NO_WAY_OUT = 5
};

/* In Python: guard/safety_layer.py, GuardStatus and GuardFlag; WIDE and CONTRADICTED are of sensors. */
enum {
    KEEPOUT_GUARD_CLEAR = 0,
    KEEPOUT_GUARD_BRAKING = 1,
    KEEPOUT_GUARD_HOLDING = 2,
    KEEPOUT_GUARD_ESCAPING = 3,
    KEEPOUT_FLAG_STATE_JUMP = 4,
    KEEPOUT_FLAG_DISTURBANCE = 8,
    KEEPOUT_FLAG_FIELD = 16,
    KEEPOUT_FLAG_REGION = 32,
    KEEPOUT_FLAG_COMMAND = 64,
    KEEPOUT_FLAG_OFF_PLAN = 128,
    KEEPOUT_FLAG_ESTIMATE = 256,
    KEEPOUT_FLAG_WIDE = 512,
    KEEPOUT_FLAG_CONTRADICTED = 1024,
    KEEPOUT_FLAG_EXPIRED = 2048
};

/* The continuation of a field beyond its domain. In Python: fields/continuation.py, RadialContinuation. */
typedef struct {
    double centre[3];     /* m */
    double target_radius; /* rho_T, m */
    double domain_radius; /* rho_0, m */
    double outer_radius;  /* rho_1, m */
    double allowance;     /* m */
} keepout_continuation;

/* A learned field. In Python: fields/neural.py, NeuralField; the weights are the certified float32 numbers. */
typedef struct {
    int32_t layers;                            /* hidden ones */
    int32_t width[KEEPOUT_LAYERS];        /* neurons of each */
    const float *weights[KEEPOUT_LAYERS]; /* (outputs, inputs), row by row */
    const float *biases[KEEPOUT_LAYERS];
    const float *last_weights;
    float last_bias;
    double beta;
    double scale; /* m */
    keepout_continuation continuation;
} keepout_network;

/* A field on a grid: a cubic spline over a tree of blocks of 8 x 8 x 8 cells. In Python: fields/grid.py, GridField.
 *
 * Level 0 is the finest. The nodes of the coarsest level, from -1 on, lie in bricks of 8 x 8 x 8. A block of a finer level
 * holds for its nodes 0 to 7 by how much they differ from what they inherit of the coarser spline: signed bytes at level
 * 0, signed 16-bit numbers elsewhere. A node of no block differs by nothing. */
typedef struct {
    int32_t levels;
    int32_t shape[3];              /* blocks of the coarsest level along each axis */
    int32_t bricks[3];             /* bricks of its nodes along each axis */
    uint32_t brick_count;          /* those that are there */
    uint32_t blocks[KEEPOUT_LEVELS]; /* of each level */
    const uint8_t *brick;          /* number of each brick, uint16; KEEPOUT_NONE where there is none */
    const uint8_t *brick_base;     /* of each, float32: m */
    const uint8_t *brick_scale;    /* of each, float32: m a unit */
    const uint8_t *brick_values;   /* 512 int16 each */
    const uint8_t *children[KEEPOUT_LEVELS]; /* of each block of a level: 8 uint16, numbers in the level below */
    const uint8_t *scale[KEEPOUT_LEVELS];  /* of each block, float32: m a unit */
    const uint8_t *detail[KEEPOUT_LEVELS]; /* 512 numbers each */
    double origin[3];              /* m */
    double spacing;                /* of level 0, m */
    keepout_continuation continuation;
} keepout_spline;

#define KEEPOUT_NONE 0xFFFFu

enum { KEEPOUT_NETWORK = 0, KEEPOUT_SPLINE = 1 };

/* The way to the goal. In Python: control/geodesic.py, GeodesicGuidance; without directions, StraightGuidance. */
typedef struct {
    double goal[3];        /* m */
    double speed;          /* v_max, m/s */
    double slowing_length; /* k_p, m */
    const uint8_t *directions; /* three signed bytes a node, or NULL */
    int32_t nodes[3];
    double origin[3];      /* m */
    double spacing;        /* m */
    double inner;          /* m */
    double outer;          /* m */
} keepout_guidance;

/* How the target turns. In Python: motion/attitude.py. */
enum { KEEPOUT_VVLH_FIXED = 0, KEEPOUT_INERTIALLY_FIXED = 1, KEEPOUT_TUMBLING = 2 };

/* In Python: motion/relative.py, RelativeMotion, with an Orbit and an AttitudeMotion. */
typedef struct {
    double semi_major_axis; /* m */
    double eccentricity;
    double true_anomaly;    /* at the epoch, rad */
    double gravitational_parameter; /* m3/s2 */
    double centre_of_mass[3]; /* m */
    int32_t turning;        /* KEEPOUT_VVLH_FIXED, ... */
    double inertia[3][3];   /* kg m2; of a tumbling target */
    bool gravity_gradient;
    int32_t substeps;       /* Runge-Kutta steps in a control period */
} keepout_motion;

/* In Python: control/profiles.py, `default`: a Controller of SafeVelocity, Tracking and SampledObserver. */
typedef struct {
    double offset;          /* of the barrier, m */
    double nominal_offset;  /* the law's own part of it, m */
    double class_k_rate;    /* 1/s */
    double class_k_braking; /* m/s2 */
    double speed_limit;     /* m/s */
    double speed_authority; /* m/s2 */
    double speed_reserve;   /* m */
    double gain;            /* lambda, 1/s */
    double position_weight[3][3];
    double lyapunov_ratio;
    double barrier_ratio;
    double estimation_weight;
    double estimation_rate;
    double barrier_rate;
    double sharpness;
    double acceleration_limit; /* m/s2 */
    double mass;            /* kg */
    double period;          /* s */
    double force_limit[3];  /* N */
    int32_t delay;          /* control periods from command to effect */
    int32_t model;          /* numbers per axis in the observer; 0: none */
    double transition[KEEPOUT_MODEL][KEEPOUT_MODEL];
    double mean_output[KEEPOUT_MODEL];
    double output[KEEPOUT_MODEL];
    double model_gain[KEEPOUT_MODEL];
    int32_t field;          /* KEEPOUT_NETWORK or KEEPOUT_SPLINE */
} keepout_law;

/* In Python: guard/guard.py, Guard, with its GuardAssumptions and its BrakingDesign. */
typedef struct {
    bool present;
    double threshold;        /* m */
    double lipschitz;
    double evaluation_error; /* m */
    double mass;             /* kg */
    double force_limit;      /* N */
    double period;           /* s */
    double disturbance;      /* D, m/s2 */
    double drift;            /* m/s2 */
    double fault_push;       /* m/s2 */
    double range_limit;      /* m */
    double speed_limit;      /* m/s */
    double position_error;   /* m */
    double velocity_error;   /* m/s */
    double valid_until;      /* s */
    int32_t delay;
    int32_t parts;
    int32_t windows;
    int32_t window[KEEPOUT_WINDOWS]; /* steps */
    double position_gain;    /* k_p, 1/s2 */
    double velocity_gain;    /* k_d, 1/s */
    double deceleration;     /* a_b, m/s2 */
    double position_radius;  /* rho, m */
    double velocity_radius;  /* sigma, m/s */
    bool observes;           /* whether the estimate has errors, and the guard an observer */
    double observer_position; /* l_r */
    double observer_velocity; /* l_v */
    double error_radius;     /* m */
    double velocity_error_radius; /* m/s */
    double plan_radius;      /* m */
} keepout_guard;

/* Thrusters that are on or off, and the allocation of a force to them: the list of points at which the linear program of
 * least propellant can be solved. In Python: flights/thrusters/on_off.py, OnOffThrusters and Allocation. */
typedef struct {
    int32_t count;          /* 0: no layout; a force is held */
    int32_t groups;         /* of thrusters with one direction */
    int32_t points;
    bool delta_sigma;       /* whether what a pulse gives too much or too little is made up for later */
    double force_limit;     /* an axis, N */
    double period;          /* s */
    double least_on_time;   /* s */
    double rise_delay;      /* by which a pulse begins and ends late, s */
    double price[KEEPOUT_POINTS][3]; /* lambda */
    double fee[KEEPOUT_POINTS];      /* N */
    double slope[KEEPOUT_POINTS][KEEPOUT_GROUPS][3]; /* of the groups' forces by the force asked for */
    double offset[KEEPOUT_POINTS][KEEPOUT_GROUPS];   /* of the groups' forces, N */
    double largest[KEEPOUT_GROUPS];  /* F_g, N */
    double balanced[KEEPOUT_GROUPS]; /* as much of it as comes without torque, N */
    int32_t group[KEEPOUT_THRUSTERS];
    double paired[KEEPOUT_THRUSTERS]; /* share of the period for each newton of its group up to `balanced`, 1/N */
    double alone[KEEPOUT_THRUSTERS];  /* the same beyond it */
    double push[KEEPOUT_THRUSTERS][3]; /* N */
} keepout_thrusters;

#if KEEPOUT_SENSORS > 0
/* What a sensor measures. In Python: flights/navigation/sensors.py. */
enum {
    KEEPOUT_RELATIVE_POSITION = 0, /* three numbers, m */
    KEEPOUT_RELATIVE_VELOCITY = 1, /* three numbers, m/s, as seen by one who turns with the body */
    KEEPOUT_RANGE_BEARING = 2,     /* three numbers: the range times the measured direction, m */
    KEEPOUT_RANGE_RATE = 3,        /* one number, m/s */
    KEEPOUT_TARGET_ATTITUDE = 4    /* four numbers: body from VVLH, a quaternion, scalar first */
};

typedef struct {
    int32_t kind;             /* a KEEPOUT_* of these */
    bool in_vvlh;             /* measured in axes of VVLH, else in those of the body */
    double variance;          /* of each component of the error, or of the range's, m2 or (m/s)2 */
    double bearing_variance;  /* of each component of the bearing's, rad2 */
    double attitude_variance; /* of each component of the attitude's, rad2; 0 in axes of the body */
    double gate;              /* largest normalised square of a sample that is believed */
    double bound;             /* of the error, or of the range's, m or m/s */
    double bearing_square;    /* sin2 of half the bound of the bearing's error */
    double turned;            /* by which the attitude's error turns a vector, over its length; 0 in axes of the body */
} keepout_sensor;

#define KEEPOUT_STATES (6 + (3 * KEEPOUT_PUSHES)) /* of the filter: r, v, xi */

/* The sensors, the filter of what they say and the set. In Python: flights/navigation/estimators.py, KalmanFilter, and
 * flights/navigation/known_set.py, SetMembership. */
typedef struct {
    keepout_sensor sensor[KEEPOUT_SENSORS];
    double mass;                        /* kg */
    double period;                      /* s */
    double cosine[KEEPOUT_PUSHES];      /* cos omega T of the disturbance's sinusoids */
    double sine[KEEPOUT_PUSHES];        /* sin omega T */
    double mean_output[KEEPOUT_PUSHES]; /* of xi, in the mean over a period */
    double noise[2][2];                 /* of position and velocity, that a period adds: m2, m2/s, m2/s2 */
    double walk;                        /* of each component of xi, that a period adds, N2 */
    double position_error;              /* of the first estimate at most, m */
    double velocity_error;              /* likewise, m/s */
    double disturbance_variance;        /* of each component of xi at the start, N2 */
    double attitude_share;              /* of the way to a sampled attitude that is gone */
    double guard_mass;                  /* that turns forces into the set's accelerations, kg */
    double disturbance;                 /* D, of every other acceleration, m/s2 */
} keepout_navigation;
#endif

typedef struct {
    const keepout_motion *motion;
    const keepout_law *law;
    const keepout_guard *guard;
    const keepout_thrusters *thrusters;
#if KEEPOUT_SENSORS > 0
    const keepout_navigation *navigation;
#endif
    const keepout_guidance *guidance;
    const keepout_network *network; /* of the law, where its field is one */
    const keepout_spline *law_spline; /* likewise */
    const keepout_spline *guard_spline;
} keepout_mission;

/* What law, guard and thrusters remember. Set by keepout_begin; its contents are Keepout's own. */
typedef struct {
    double velocity[3];
    double drift[3];
    double force[3];
    double model[3][KEEPOUT_MODEL];
    double pending[KEEPOUT_DELAY][3];
#if KEEPOUT_SENSORS > 0
    double push[3]; /* the disturbance by the filter, N */
#endif
    bool started;
} keepout_law_memory;

typedef struct {
    double plan_position[3];
    double plan_velocity[3];
    double pending[KEEPOUT_DELAY][3];
    double expected_position[3];
    double expected_velocity[3];
    double unexplained[KEEPOUT_WINDOWS][3];
    double seen_position[3]; /* of the guard's observer: what it expects */
    double seen_velocity[3];
    double doubts[2];        /* bounds of the errors of the estimate told last, m and m/s */
    double begun_doubts[KEEPOUT_WINDOWS];
    int32_t counted;
    bool certified;
    bool begun;
    bool left_out;
    bool steady;
} keepout_guard_memory;

typedef struct {
    double owed[KEEPOUT_THRUSTERS]; /* on-time that was asked for and not given, s; of delta-sigma */
    double tail[KEEPOUT_THRUSTERS]; /* for which a thruster is still open in the coming period, s */
} keepout_thruster_memory;

#if KEEPOUT_SENSORS > 0
/* What is believed of one moment. In Python: flights/navigation/estimators.py, Belief. */
typedef struct {
    keepout_estimate motion;
    double disturbance[3 * KEEPOUT_PUSHES];            /* xi, of each part by axis, N */
    double covariance[KEEPOUT_STATES][KEEPOUT_STATES]; /* of r, v, xi: m, m/s, N */
    int32_t left_out[KEEPOUT_SENSORS];                 /* samples of each sensor that were left out in a row */
} keepout_belief;

/* A vector is within a radius of a centre. */
typedef struct {
    double centre[3]; /* m or m/s */
    double radius;    /* likewise */
} keepout_ball;

/* In Python: flights/navigation/known_set.py, KnownMotion; of what is kept the newest stands last. */
typedef struct {
    keepout_ball position;
    keepout_ball velocity;
    double accelerations[KEEPOUT_KEPT][3];  /* of the commands, m/s2 */
    double attitudes[KEEPOUT_LATENCY + 1][4];
    double centres[KEEPOUT_KEPT][3];        /* of the position's balls, m */
    double radii[KEEPOUT_KEPT];             /* of those balls, m */
    int32_t elapsed;                        /* steps since the oldest ball that counts, KEEPOUT_WINDOW at most */
    int32_t contradictions[2];              /* steps in a row that contradicted position and velocity */
} keepout_set_memory;

typedef struct {
    keepout_belief settled; /* at the newest time of which every sample has come */
    double forces[KEEPOUT_LATENCY + 1][3]; /* held since then, N */
    double pending[KEEPOUT_DELAY][3]; /* commands that do not act yet, N */
    int32_t steps;                    /* how many of the forces are real */
    keepout_set_memory set;
} keepout_navigation_memory;
#endif

typedef struct {
    keepout_law_memory law;
    keepout_guard_memory guard;
    keepout_thruster_memory thrusters;
#if KEEPOUT_SENSORS > 0
    keepout_navigation_memory navigation;
#endif
} keepout_memory;

#if KEEPOUT_SENSORS > 0
/* Begin: navigation from a first estimate of the motion now, law and guard from what the first step's samples make of it;
 * tell that step the same samples. `under_way` are the forces (N) commanded before that have not taken effect yet, the
 * oldest first, KEEPOUT_MOST_DELAY of them with the last ones at the end; NULL: none. */
void keepout_begin(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                   const keepout_sample samples[KEEPOUT_SENSORS], const double (*under_way)[3]);

/* Run one control step on what each sensor says now. A sample that is not finite, or too far off, is left out. */
void keepout_step(const keepout_mission *mission, keepout_memory *memory, const keepout_sample samples[KEEPOUT_SENSORS],
                  keepout_knowledge *knowledge, keepout_order *order);
#else
/* Begin: law and guard from an estimate of the motion now. `under_way` are the forces (N) commanded before that have
 * not taken effect yet, the oldest first, KEEPOUT_MOST_DELAY of them with the last ones at the end; NULL: none. */
void keepout_begin(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                   const double (*under_way)[3]);

/* Run one control step. Numbers of the estimate that are not finite are answered as in Python: the law commands no
 * force, the guard follows its plan blind. With a layout of thrusters fire each pulse in the middle of the period, in the
 * place of `order->force`; do not open a thruster whose pulse is not a number. */
void keepout_step(const keepout_mission *mission, keepout_memory *memory, const keepout_estimate *estimate,
                  keepout_order *order);
#endif

/* A mission as its image holds it: mission_tables.c has room for one. */
typedef struct {
    keepout_guidance guidance;
    keepout_spline law_spline;
    keepout_spline guard_spline;
} keepout_tables;

enum {
    KEEPOUT_IMAGE_GOOD = 0,
    KEEPOUT_IMAGE_SHORT = 1,    /* fewer bytes than it says */
    KEEPOUT_IMAGE_NOT_ONE = 2,  /* it does not begin as an image does */
    KEEPOUT_IMAGE_VERSION = 3,  /* of another format */
    KEEPOUT_IMAGE_DAMAGED = 4,  /* its checksum does not hold */
    KEEPOUT_IMAGE_OF_ANOTHER = 5, /* it belongs to another mission_tables.c */
    KEEPOUT_IMAGE_WRONG = 6     /* its parts are not as long as the layout says */
};

/* Check an image of tables, `size` bytes, and point `tables` into it; the image must stay where it is. `layout` and
 * `digest`, the image's CRC-32, are those of mission_tables.c. Returns a KEEPOUT_IMAGE_*; `tables` is untouched unless
 * it is KEEPOUT_IMAGE_GOOD. */
int32_t keepout_open(const uint8_t *image, size_t size, const keepout_tables *layout, uint32_t digest,
                     keepout_tables *tables);

#endif
