/* Functions of numbers and of vectors.
 *
 * Only + - * / and, of the library, sqrt, fmod and floor are used: IEEE 754 gives these one answer each, so that every
 * compiler and processor gives the same bits as long as nothing is contracted (no fused multiply-add). What the others
 * give is within a few units in the last place.
 */
#include <math.h>
#include <string.h>

#include "keepout_internal.h"

#if defined(__STDC_IEC_559__) || defined(__GNUC__)
#if defined(__FLT_EVAL_METHOD__) && (__FLT_EVAL_METHOD__ != 0)
#error "Keepout: doubles are computed in a wider format here; compile for IEEE 754 doubles (x86: -msse2 -mfpmath=sse)"
#endif
#endif

#define LN2_HIGH 6.93147180369123816490e-01 /* 33 bits of ln 2, so that a product with a small integer is exact */
#define LN2_LOW 1.90821492927058770002e-10

bool keepout_is_nan(double x)
{
    return x != x;
}

/* Neither infinite nor not a number. */
bool keepout_finite(double x)
{
    return (x - x) == 0.0;
}

bool keepout_finite3(const double x[3])
{
    return keepout_finite(x[0]) && keepout_finite(x[1]) && keepout_finite(x[2]);
}

/* The larger; not a number where one is none (C's fmax drops it). In Python: jnp.maximum. */
double keepout_maximum(double a, double b)
{
    double larger = (a > b) ? a : b;
    if (keepout_is_nan(a)) {
        larger = a;
    }
    return larger;
}

/* In Python: jnp.minimum. */
double keepout_minimum(double a, double b)
{
    double smaller = (a < b) ? a : b;
    if (keepout_is_nan(a)) {
        smaller = a;
    }
    return smaller;
}

/* In Python: jnp.clip. */
double keepout_clip(double x, double low, double high)
{
    return keepout_minimum(keepout_maximum(x, low), high);
}

/* The whole number below x, kept within [low, high]; low where x is not a number. Each conversion goes through here. */
int32_t keepout_to_index(double x, int32_t low, int32_t high)
{
    int32_t index = low;
    const double below = floor(x);
    if ((below == below) && (below > (double)low)) {
        index = (below < (double)high) ? (int32_t)below : high;
    }
    return index;
}

/* 2^k of -1022 <= k <= 1023. */
static double power_of_two(int32_t k)
{
    const uint64_t bits = (uint64_t)(k + 1023) << 52;
    double power;
    (void)memcpy(&power, &bits, sizeof power);
    return power;
}

/* exp(r) - 1 of |r| <= 0.35: the series to r^14. */
static double exponential_series(double r)
{
    static const double inverse[14] = {1.0 / 1.0, 1.0 / 2.0, 1.0 / 3.0, 1.0 / 4.0, 1.0 / 5.0, 1.0 / 6.0, 1.0 / 7.0,
                                       1.0 / 8.0, 1.0 / 9.0, 1.0 / 10.0, 1.0 / 11.0, 1.0 / 12.0, 1.0 / 13.0, 1.0 / 14.0};
    double sum = 1.0;
    int32_t i;
    for (i = 13; i >= 1; i--) {
        sum = 1.0 + (r * inverse[i]) * sum;
    }
    return r * sum;
}

/* k and r of x = k ln 2 + r, |r| <= 0.35, for |x| < 746. */
static int32_t reduced(double x, double *r)
{
    const double k = floor((x * 1.44269504088896340736) + 0.5);
    *r = (x - (k * LN2_HIGH)) - (k * LN2_LOW);
    return keepout_to_index(k, -1080, 1025);
}

double keepout_exp(double x)
{
    double result;
    if (keepout_is_nan(x)) {
        result = x;
    } else if (x > 709.782712893384) {
        result = HUGE_VAL;
    } else if (x < -745.133219101942) {
        result = 0.0;
    } else {
        double r;
        const int32_t k = reduced(x, &r);
        const int32_t half = k / 2;
        result = 1.0 + exponential_series(r);
        result = (result * power_of_two(half)) * power_of_two(k - half);
    }
    return result;
}

double keepout_expm1(double x)
{
    double result;
    if ((x > -0.35) && (x < 0.35)) {
        result = exponential_series(x);
    } else {
        result = keepout_exp(x) - 1.0;
    }
    return result;
}

/* 2 artanh(s) of |s| <= 0.172: the series to s^23. */
static double logarithm_series(double s)
{
    static const double inverse[12] = {1.0, 1.0 / 3.0, 1.0 / 5.0, 1.0 / 7.0, 1.0 / 9.0, 1.0 / 11.0, 1.0 / 13.0,
                                       1.0 / 15.0, 1.0 / 17.0, 1.0 / 19.0, 1.0 / 21.0, 1.0 / 23.0};
    const double square = s * s;
    double sum = 0.0;
    int32_t i;
    for (i = 11; i >= 1; i--) {
        sum = (sum + inverse[i]) * square;
    }
    return (2.0 * s) + ((2.0 * s) * sum);
}

double keepout_log(double x)
{
    double result;
    if (keepout_is_nan(x)) {
        result = x;
    } else if (x < 0.0) {
        result = NAN;
    } else if (x == 0.0) {
        result = -HUGE_VAL;
    } else if (!keepout_finite(x)) {
        result = x;
    } else {
        double number = x;
        int32_t k = 0;
        uint64_t bits;
        if (number < 2.2250738585072014e-308) {
            number = number * 18014398509481984.0; /* 2^54: no subnormal number any more */
            k = -54;
        }
        (void)memcpy(&bits, &number, sizeof bits);
        k = k + ((int32_t)((bits >> 52) & 0x7FFu) - 1023);
        bits = (bits & 0x000FFFFFFFFFFFFFu) | 0x3FF0000000000000u;
        (void)memcpy(&number, &bits, sizeof number);
        if (number > 1.4142135623730951) {
            number = 0.5 * number;
            k = k + 1;
        }
        result = ((double)k * LN2_HIGH)
                 + (logarithm_series((number - 1.0) / (number + 1.0)) + ((double)k * LN2_LOW));
    }
    return result;
}

double keepout_log1p(double x)
{
    double result;
    if ((x > -0.29) && (x < 0.41)) {
        result = logarithm_series(x / (2.0 + x));
    } else {
        result = keepout_log(1.0 + x);
    }
    return result;
}

double keepout_tanh(double x)
{
    double result;
    const double size = (x < 0.0) ? -x : x;
    if (keepout_is_nan(x)) {
        result = x;
    } else {
        double grown = 1.0;
        if (size < 22.0) {
            grown = keepout_expm1(2.0 * size);
            grown = grown / (grown + 2.0);
        }
        result = (x < 0.0) ? -grown : grown;
    }
    return result;
}

/* Quadrant of x, and what is left of it, within pi/4 of 0. Beyond 1e6 the remainder is that of the double 2 pi: what is
 * asked for are anomalies, which lie within two turns. */
static int32_t quadrant(double x, double *left)
{
    double angle = x;
    double turns;
    if ((angle > 1.0e6) || (angle < -1.0e6)) {
        angle = fmod(angle, 2.0 * KEEPOUT_PI);
    }
    turns = floor((angle * (2.0 / KEEPOUT_PI)) + 0.5);
    /* pi/2 in three parts, the first two of 33 bits. */
    *left = ((angle - (turns * 1.57079632673412561417e+00)) - (turns * 6.07710050630396597660e-11))
            - (turns * 2.02226624879595063154e-21);
    return keepout_to_index(turns - (4.0 * floor(turns * 0.25)), 0, 3);
}

static double sine_series(double r)
{
    const double square = r * r;
    double sum = 1.0;
    int32_t i;
    for (i = 8; i >= 1; i--) {
        sum = 1.0 - ((square / (double)((2 * i) * ((2 * i) + 1))) * sum);
    }
    return r * sum;
}

static double cosine_series(double r)
{
    const double square = r * r;
    double sum = 1.0;
    int32_t i;
    for (i = 9; i >= 1; i--) {
        sum = 1.0 - ((square / (double)(((2 * i) - 1) * (2 * i))) * sum);
    }
    return sum;
}

static double of_quadrant(int32_t number, double left)
{
    const double size = ((number % 2) == 0) ? sine_series(left) : cosine_series(left);
    return (number >= 2) ? -size : size;
}

double keepout_sin(double x)
{
    double left;
    const int32_t number = quadrant(x, &left);
    return of_quadrant(number, left);
}

double keepout_cos(double x)
{
    double left;
    const int32_t number = quadrant(x, &left);
    return of_quadrant((number + 1) % 4, left);
}

/* arctan of 0 <= t <= 1. */
static double arctangent(double t)
{
    const double turned = 0.26794919243112270647; /* tan(pi/12) */
    double base = 0.0;
    double r = t;
    double square;
    double sum = 0.0;
    int32_t i;
    if (r > turned) {
        base = KEEPOUT_PI / 6.0;
        r = ((t * 1.73205080756887729353) - 1.0) / (1.73205080756887729353 + t);
    }
    square = r * r;
    for (i = 15; i >= 1; i--) {
        sum = ((1.0 / (double)((2 * i) + 1)) - sum) * square;
    }
    return base + (r - (r * sum));
}

double keepout_atan2(double y, double x)
{
    double result;
    const double rise = (y < 0.0) ? -y : y;
    const double run = (x < 0.0) ? -x : x;
    if (keepout_is_nan(x) || keepout_is_nan(y)) {
        result = x + y;
    } else if ((rise == 0.0) && (run == 0.0)) {
        result = 0.0;
    } else if (rise <= run) {
        result = arctangent(rise / run);
    } else {
        result = (KEEPOUT_PI / 2.0) - arctangent(run / rise);
    }
    if (x < 0.0) {
        result = KEEPOUT_PI - result;
    }
    return (y < 0.0) ? -result : result;
}

double keepout_acos(double x)
{
    return 2.0 * keepout_atan2(sqrt(1.0 - x), sqrt(1.0 + x));
}

/* Of x >= 0. */
double keepout_cbrt(double x)
{
    double root = x;
    if ((x > 0.0) && keepout_finite(x)) {
        root = keepout_exp(keepout_log(x) / 3.0);
        root = root - ((root - (x / (root * root))) / 3.0);
    }
    return root;
}

double keepout_dot(const double a[3], const double b[3])
{
    return ((a[0] * b[0]) + (a[1] * b[1])) + (a[2] * b[2]);
}

double keepout_norm(const double a[3])
{
    return sqrt(keepout_dot(a, a));
}

double keepout_distance(const double a[3], const double b[3])
{
    const double apart[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return keepout_norm(apart);
}

void keepout_cross(const double a[3], const double b[3], double out[3])
{
    out[0] = (a[1] * b[2]) - (a[2] * b[1]);
    out[1] = (a[2] * b[0]) - (a[0] * b[2]);
    out[2] = (a[0] * b[1]) - (a[1] * b[0]);
}

void keepout_copy(const double from[3], double to[3])
{
    int32_t i;
    for (i = 0; i < 3; i++) {
        to[i] = from[i];
    }
}

void keepout_zero(double out[3])
{
    int32_t i;
    for (i = 0; i < 3; i++) {
        out[i] = 0.0;
    }
}

/* Drop the oldest of `count` vectors and put the newest at the end. */
void keepout_queue(double pending[][3], int32_t count, const double newest[3])
{
    int32_t i;
    for (i = 1; (i < count) && (i < KEEPOUT_MOST_QUEUED); i++) {
        keepout_copy(pending[i], pending[i - 1]);
    }
    if ((count > 0) && (count <= KEEPOUT_MOST_QUEUED)) {
        keepout_copy(newest, pending[count - 1]);
    }
}

/* Position and velocity a period later, under a constant acceleration; `out` may be what it starts from. */
void keepout_step_ahead(const double position[3], const double velocity[3], double period, const double acceleration[3],
                        double position_out[3], double velocity_out[3])
{
    const double half = (0.5 * (period * period));
    int32_t i;
    for (i = 0; i < 3; i++) {
        position_out[i] = (position[i] + (period * velocity[i])) + (half * acceleration[i]);
        velocity_out[i] = velocity[i] + (period * acceleration[i]);
    }
}
