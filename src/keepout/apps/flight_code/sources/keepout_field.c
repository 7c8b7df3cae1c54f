/* The learned field, and how every field goes on beyond its domain. */
#include <math.h>

#include "keepout_internal.h"

#define LANES 8 /* sums of a product of matrix and vector that go on side by side */
#define FARTHEST 1e150 /* m along an axis: what is farther counts as if it were here (fields/field.py) */

/* y = p - c, and whether it lies beyond `radius`; in its stead a harmless place where it does not. */
static bool away_from(const keepout_continuation *c, const double point[3], double radius, double away[3], double *r)
{
    bool beyond;
    int32_t i;
    for (i = 0; i < 3; i++) {
        away[i] = keepout_clip(point[i], -FARTHEST, FARTHEST) - c->centre[i];
    }
    beyond = keepout_dot(away, away) > (radius * radius);
    if (!beyond) {
        away[0] = radius;
        away[1] = 0.0;
        away[2] = 0.0;
    }
    *r = keepout_norm(away);
    return beyond;
}

/* psi(r) and psi'(r). In Python: RadialContinuation._radial. */
static double psi_of(const keepout_continuation *c, double r, double *slope)
{
    const double width = c->outer_radius - c->domain_radius;
    const double t = keepout_clip((r - c->domain_radius) / width, 0.0, 1.0);
    *slope = 1.0 - ((t * t) * (3.0 - (2.0 * t)));
    return c->domain_radius + (width * ((t - ((t * t) * t)) + (0.5 * ((t * t) * (t * t)))));
}

/* F(s). In Python: RadialContinuation._rise. */
static double rise(const keepout_continuation *c, double s)
{
    return sqrt((s * s) - (c->target_radius * c->target_radius))
           - (c->target_radius * keepout_acos(c->target_radius / s));
}

/* F'(s). */
static double rise_slope(const keepout_continuation *c, double s)
{
    const double ratio = c->target_radius / s;
    return sqrt(1.0 - (ratio * ratio));
}

/* The place at which the field is asked. In Python: RadialContinuation.into_domain. */
void keepout_into_domain(const keepout_continuation *c, const double point[3], double inside[3])
{
    double away[3];
    double r;
    const bool outside = away_from(c, point, c->domain_radius, away, &r);
    int32_t i;
    if (outside) {
        double slope;
        const double factor = psi_of(c, r, &slope) / r;
        for (i = 0; i < 3; i++) {
            inside[i] = c->centre[i] + (away[i] * factor);
        }
    } else {
        keepout_copy(point, inside);
    }
}

/* The value at `point` of one at `keepout_into_domain`; -inf where the point is none. In Python: .value. */
double keepout_continued(const keepout_continuation *c, const double point[3], double value)
{
    double away[3];
    double r;
    double result = value;
    if (!keepout_finite3(point)) {
        result = -HUGE_VAL;
    } else {
        if (away_from(c, point, c->domain_radius, away, &r)) {
            double slope;
            result = result + (rise(c, r) - rise(c, psi_of(c, r, &slope)));
        }
        if (away_from(c, point, c->target_radius, away, &r)) {
            const double t =
                keepout_clip((r - c->target_radius) / (c->domain_radius - c->target_radius), 0.0, 1.0);
            result = result - ((c->allowance * ((t * t) * t)) * ((10.0 - (15.0 * t)) + ((6.0 * t) * t)));
        }
    }
    return result;
}

/* The gradient at `point` of one at `keepout_into_domain`, in place. In Python: .gradient. */
void keepout_continued_gradient(const keepout_continuation *c, const double point[3], double gradient[3])
{
    double away[3];
    double r;
    int32_t i;
    if (away_from(c, point, c->domain_radius, away, &r)) {
        double slope;
        const double psi = psi_of(c, r, &slope);
        const double radial = keepout_dot(gradient, away) / r;
        const double along = (slope * radial) + (rise_slope(c, r) - (rise_slope(c, psi) * slope));
        for (i = 0; i < 3; i++) {
            const double u = away[i] / r;
            gradient[i] = ((psi / r) * (gradient[i] - (radial * u))) + (along * u);
        }
    }
    if (away_from(c, point, c->target_radius, away, &r)) {
        const double width = c->domain_radius - c->target_radius;
        const double t = keepout_clip((r - c->target_radius) / width, 0.0, 1.0);
        const double bell = t * (1.0 - t);
        const double first = ((c->allowance * 30.0) * (bell * bell)) / width;
        for (i = 0; i < 3; i++) {
            gradient[i] = gradient[i] - (first * (away[i] / r));
        }
    }
}

/* sigma and sigma'. In Python: fields/neural.py, softplus_and_slope. */
static double softplus(double z, double beta, double *slope)
{
    const double t = beta * z;
    const double e = keepout_exp((t > 0.0) ? -t : t);
    const double both = 1.0 + e;
    *slope = ((t > 0.0) ? 1.0 : e) / both;
    return (keepout_maximum(t, 0.0) + keepout_log(both)) / beta;
}

/* out[i] = bias[i] + sum of row i times `in`, for the `rows` rows of a matrix. LANES sums go on side by side, each in the
 * order of its own row, so that `in` is read once for all of them; what is left over goes one by one. */
static void forward(const float *weights, const float *bias, int32_t rows, int32_t columns, const double *in, double *out)
{
    const float *row = weights;
    int32_t i = 0;
    int32_t j;
    for (; (i + LANES) <= rows; i = i + LANES) {
        double z0 = (double)bias[i];
        double z1 = (double)bias[i + 1];
        double z2 = (double)bias[i + 2];
        double z3 = (double)bias[i + 3];
        double z4 = (double)bias[i + 4];
        double z5 = (double)bias[i + 5];
        double z6 = (double)bias[i + 6];
        double z7 = (double)bias[i + 7];
        for (j = 0; j < columns; j++) {
            const double a = in[j];
            const float *w = &row[j];
            z0 = z0 + ((double)w[0] * a);
            z1 = z1 + ((double)w[columns] * a);
            z2 = z2 + ((double)w[2 * columns] * a);
            z3 = z3 + ((double)w[3 * columns] * a);
            z4 = z4 + ((double)w[4 * columns] * a);
            z5 = z5 + ((double)w[5 * columns] * a);
            z6 = z6 + ((double)w[6 * columns] * a);
            z7 = z7 + ((double)w[7 * columns] * a);
        }
        out[i] = z0;
        out[i + 1] = z1;
        out[i + 2] = z2;
        out[i + 3] = z3;
        out[i + 4] = z4;
        out[i + 5] = z5;
        out[i + 6] = z6;
        out[i + 7] = z7;
        row = &row[LANES * columns];
    }
    for (; i < rows; i++) {
        double z = (double)bias[i];
        for (j = 0; j < columns; j++) {
            z = z + ((double)row[j] * in[j]);
        }
        out[i] = z;
        row = &row[columns];
    }
}

/* out[j] = sum of column j times `in`; likewise. */
static void backward(const float *weights, int32_t rows, int32_t columns, const double *in, double *out)
{
    int32_t i;
    int32_t j = 0;
    for (; (j + LANES) <= columns; j = j + LANES) {
        const float *w = &weights[j];
        double z0 = 0.0;
        double z1 = 0.0;
        double z2 = 0.0;
        double z3 = 0.0;
        double z4 = 0.0;
        double z5 = 0.0;
        double z6 = 0.0;
        double z7 = 0.0;
        for (i = 0; i < rows; i++) {
            const double a = in[i];
            z0 = z0 + (a * (double)w[0]);
            z1 = z1 + (a * (double)w[1]);
            z2 = z2 + (a * (double)w[2]);
            z3 = z3 + (a * (double)w[3]);
            z4 = z4 + (a * (double)w[4]);
            z5 = z5 + (a * (double)w[5]);
            z6 = z6 + (a * (double)w[6]);
            z7 = z7 + (a * (double)w[7]);
            w = &w[columns];
        }
        out[j] = z0;
        out[j + 1] = z1;
        out[j + 2] = z2;
        out[j + 3] = z3;
        out[j + 4] = z4;
        out[j + 5] = z5;
        out[j + 6] = z6;
        out[j + 7] = z7;
    }
    for (; j < columns; j++) {
        double z = 0.0;
        for (i = 0; i < rows; i++) {
            z = z + (in[i] * (double)weights[(i * columns) + j]);
        }
        out[j] = z;
    }
}

/* One forward and one reverse sweep. In Python: fields/neural.py, sweeps. */
double keepout_network_value_and_gradient(const keepout_network *field, const double point[3], double gradient[3])
{
    double slopes[KEEPOUT_LAYERS][KEEPOUT_WIDTH];
    double now[KEEPOUT_WIDTH];
    double next[KEEPOUT_WIDTH];
    double value = (double)field->last_bias;
    double inside[3];
    int32_t inputs = 3;
    int32_t layer;
    int32_t i;
    for (layer = 0; layer < KEEPOUT_LAYERS; layer++) {
        for (i = 0; i < KEEPOUT_WIDTH; i++) {
            slopes[layer][i] = 0.0;
        }
    }
    keepout_into_domain(&field->continuation, point, inside);
    for (i = 0; i < 3; i++) {
        now[i] = (inside[i] - field->continuation.centre[i]) / field->scale;
    }
    for (layer = 0; layer < field->layers; layer++) {
        const int32_t width = field->width[layer];
        forward(field->weights[layer], field->biases[layer], width, inputs, now, next);
        for (i = 0; i < width; i++) {
            double slope;
            now[i] = softplus(next[i], field->beta, &slope);
            slopes[layer][i] = slope;
        }
        inputs = width;
    }
    for (i = 0; i < inputs; i++) {
        value = value + ((double)field->last_weights[i] * now[i]);
        now[i] = (double)field->last_weights[i];
    }
    for (layer = field->layers - 1; layer >= 0; layer--) {
        const int32_t width = field->width[layer];
        const int32_t before = (layer > 0) ? field->width[layer - 1] : 3;
        for (i = 0; i < width; i++) {
            next[i] = now[i] * slopes[layer][i];
        }
        backward(field->weights[layer], width, before, next, now);
    }
    keepout_copy(now, gradient);
    keepout_continued_gradient(&field->continuation, point, gradient);
    return keepout_continued(&field->continuation, point, value * field->scale);
}
