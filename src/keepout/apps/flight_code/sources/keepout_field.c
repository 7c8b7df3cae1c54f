/* The learned field, and how every field goes on beyond its domain. */
#include <math.h>

#include "keepout_internal.h"

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
    int32_t j;
    keepout_into_domain(&field->continuation, point, inside);
    for (i = 0; i < 3; i++) {
        now[i] = (inside[i] - field->continuation.centre[i]) / field->scale;
    }
    for (layer = 0; layer < field->layers; layer++) {
        const float *row = field->weights[layer];
        const float *bias = field->biases[layer];
        const int32_t width = field->width[layer];
        for (i = 0; i < width; i++) {
            double z = (double)bias[i];
            for (j = 0; j < inputs; j++) {
                z = z + ((double)row[j] * now[j]);
            }
            next[i] = softplus(z, field->beta, &slopes[layer][i]);
            row = &row[inputs];
        }
        for (i = 0; i < width; i++) {
            now[i] = next[i];
        }
        inputs = width;
    }
    for (i = 0; i < inputs; i++) {
        value = value + ((double)field->last_weights[i] * now[i]);
        now[i] = (double)field->last_weights[i];
    }
    for (layer = field->layers - 1; layer >= 0; layer--) {
        const float *row = field->weights[layer];
        const int32_t width = field->width[layer];
        const int32_t before = (layer > 0) ? field->width[layer - 1] : 3;
        for (j = 0; j < before; j++) {
            next[j] = 0.0;
        }
        for (i = 0; i < width; i++) {
            const double push = now[i] * slopes[layer][i];
            for (j = 0; j < before; j++) {
                next[j] = next[j] + (push * (double)row[j]);
            }
            row = &row[before];
        }
        for (j = 0; j < before; j++) {
            now[j] = next[j];
        }
    }
    keepout_copy(now, gradient);
    keepout_continued_gradient(&field->continuation, point, gradient);
    return keepout_continued(&field->continuation, point, value * field->scale);
}
