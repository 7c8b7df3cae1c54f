/* The guard's field: a cubic spline over a tree of blocks. In Python: fields/grid.py; how the tables are made:
 * apps/flight_code/spline_tables.py. */
#include <string.h>

#include "keepout_internal.h"

#define EDGE 8          /* cells along a block's edge, and nodes along a brick's */
#define VOLUME 512u     /* nodes of a block or brick */
#define NOWHERE -1.0e3f /* m: a coefficient that the tables do not have; nothing is free there */

typedef float window[4][4][4];

/* Numbers of an image lie there byte by byte, the lowest first, on every processor. */
static uint32_t two_bytes(const uint8_t *bytes, uint32_t number)
{
    const uint8_t *at = &bytes[2u * number];
    return (uint32_t)at[0] | ((uint32_t)at[1] << 8);
}

static double signed_two_bytes(const uint8_t *bytes, uint32_t number)
{
    const uint32_t value = two_bytes(bytes, number);
    return (value < 0x8000u) ? (double)value : ((double)value - 65536.0);
}

static double signed_byte(const uint8_t *bytes, uint32_t number)
{
    const uint8_t value = bytes[number];
    return (value < 0x80u) ? (double)value : ((double)value - 256.0);
}

static double single(const uint8_t *bytes, uint32_t number)
{
    const uint32_t bits = two_bytes(bytes, 2u * number) | (two_bytes(bytes, (2u * number) + 1u) << 16);
    float value;
    (void)memcpy(&value, &bits, sizeof value);
    return (double)value;
}

static int32_t halved(int32_t n) /* floor(n/2) of n >= -16 */
{
    return ((n + 16) / 2) - 8;
}

/* Number of the block of `level` at `block` (in blocks of that level), or KEEPOUT_NONE. */
static uint32_t block_at(const keepout_spline *field, int32_t level, const int32_t block[3])
{
    const int32_t coarsest = field->levels - 1;
    uint32_t found = KEEPOUT_NONE;
    int32_t above[3];
    int32_t axis;
    int32_t down;
    bool within = true;
    for (axis = 0; axis < 3; axis++) {
        const int32_t size = 1 << (coarsest - level);
        within = within && (block[axis] >= 0);
        above[axis] = within ? (block[axis] / size) : 0;
        within = within && (above[axis] < field->shape[axis]);
    }
    if (within) {
        found = (uint32_t)((((above[0] * field->shape[1]) + above[1]) * field->shape[2]) + above[2]);
        for (down = coarsest; (down > level) && (found < field->blocks[down]); down--) {
            uint32_t octant = 0u;
            for (axis = 0; axis < 3; axis++) {
                const int32_t number = block[axis] / (1 << ((down - 1) - level));
                octant = (2u * octant) + (uint32_t)(number % 2);
            }
            found = two_bytes(field->children[down], (8u * found) + octant);
        }
        if (found >= field->blocks[level]) {
            found = KEEPOUT_NONE;
        }
    }
    return found;
}

/* Coefficients of the coarsest level at nodes from `start` on. */
static void coarsest_window(const keepout_spline *field, const int32_t start[3], window c)
{
    int32_t i;
    int32_t j;
    int32_t k;
    for (i = 0; i < 4; i++) {
        for (j = 0; j < 4; j++) {
            for (k = 0; k < 4; k++) {
                const int32_t node[3] = {start[0] + i + 1, start[1] + j + 1, start[2] + k + 1};
                uint32_t brick = 0u;
                uint32_t place = 0u;
                uint32_t number = KEEPOUT_NONE;
                bool within = true;
                int32_t axis;
                for (axis = 0; axis < 3; axis++) {
                    within = within && (node[axis] >= 0) && ((node[axis] / EDGE) < field->bricks[axis]);
                    if (within) {
                        brick = (brick * (uint32_t)field->bricks[axis]) + (uint32_t)(node[axis] / EDGE);
                        place = (place * (uint32_t)EDGE) + (uint32_t)(node[axis] % EDGE);
                    }
                }
                if (within) {
                    number = two_bytes(field->brick, brick);
                }
                if (number < field->brick_count) {
                    c[i][j][k] = (float)(single(field->brick_base, number)
                                         + (single(field->brick_scale, number)
                                            * signed_two_bytes(field->brick_values, (number * VOLUME) + place)));
                } else {
                    c[i][j][k] = NOWHERE;
                }
            }
        }
    }
}

/* A coefficient at a node of half the spacing, of those beside it: 1/8 6/8 1/8 where it stands on one, else 1/2 1/2.
 * `number` is that of the node in its window, `odd` whether the window begins between two coarse nodes. */
static double between(const double p[4], int32_t number, bool odd)
{
    const int32_t first = (odd ? number : (number + 1)) / 2;
    const bool middle = ((number % 2) == 0) == odd;
    return middle ? (0.5 * (p[first] + p[first + 1]))
                  : (((0.125 * p[first]) + (0.75 * p[first + 1])) + (0.125 * p[first + 2]));
}

/* The coefficients at nodes of half the spacing from `start` on that are the coarser spline's; axis by axis. */
static void inherited(const window c, const int32_t start[3], double finer[4][4][4])
{
    double half[4][4][4];
    double p[4];
    const bool odd[3] = {(start[0] & 1) != 0, (start[1] & 1) != 0, (start[2] & 1) != 0};
    int32_t i;
    int32_t j;
    int32_t k;
    for (j = 0; j < 4; j++) {
        for (k = 0; k < 4; k++) {
            for (i = 0; i < 4; i++) {
                p[i] = (double)c[i][j][k];
            }
            for (i = 0; i < 4; i++) {
                finer[i][j][k] = between(p, i, odd[0]);
            }
        }
    }
    for (i = 0; i < 4; i++) {
        for (k = 0; k < 4; k++) {
            for (j = 0; j < 4; j++) {
                p[j] = finer[i][j][k];
            }
            for (j = 0; j < 4; j++) {
                half[i][j][k] = between(p, j, odd[1]);
            }
        }
    }
    for (i = 0; i < 4; i++) {
        for (j = 0; j < 4; j++) {
            for (k = 0; k < 4; k++) {
                finer[i][j][k] = between(half[i][j], k, odd[2]);
            }
        }
    }
}

/* Go one level down: what is inherited, and by how much the blocks of `level` differ from it. */
static void refined(const keepout_spline *field, int32_t level, const int32_t start[3], window c)
{
    double finer[4][4][4];
    uint32_t number[2][2][2];
    double scale[2][2][2];
    int32_t lowest[3];
    int32_t i;
    int32_t j;
    int32_t k;
    for (i = 0; i < 3; i++) {
        lowest[i] = ((start[i] + EDGE) / EDGE) - 1; /* the block of the first node; start >= -2 */
    }
    for (i = 0; i < 2; i++) {
        for (j = 0; j < 2; j++) {
            for (k = 0; k < 2; k++) {
                const int32_t block[3] = {lowest[0] + i, lowest[1] + j, lowest[2] + k};
                number[i][j][k] = block_at(field, level, block);
                scale[i][j][k] =
                    (number[i][j][k] < field->blocks[level]) ? single(field->scale[level], number[i][j][k]) : 0.0;
            }
        }
    }
    inherited((const float(*)[4][4])c, start, finer);
    for (i = 0; i < 4; i++) {
        const int32_t x = (start[0] + i) - (EDGE * lowest[0]);
        for (j = 0; j < 4; j++) {
            const int32_t y = (start[1] + j) - (EDGE * lowest[1]);
            for (k = 0; k < 4; k++) {
                const int32_t z = (start[2] + k) - (EDGE * lowest[2]);
                const uint32_t block = number[x / EDGE][y / EDGE][z / EDGE];
                double value = finer[i][j][k];
                if (block < field->blocks[level]) {
                    const uint32_t place =
                        (block * VOLUME)
                        + (uint32_t)(((((x % EDGE) * EDGE) + (y % EDGE)) * EDGE) + (z % EDGE));
                    const double units = (level == 0) ? signed_byte(field->detail[0], place)
                                                      : signed_two_bytes(field->detail[level], place);
                    value = value + (scale[x / EDGE][y / EDGE][z / EDGE] * units);
                }
                c[i][j][k] = (float)value;
            }
        }
    }
}

/* Coefficients of the cell of a place, where it lies in the cell, and the cell's size (m). */
static double cell_of(const keepout_spline *field, const double point[3], window c, double t[3])
{
    double inside[3];
    double u[3];
    int32_t start[KEEPOUT_LEVELS][3];
    int32_t block[3];
    double size = 1.0;
    int32_t level = field->levels - 1;
    int32_t axis;
    int32_t at;
    bool deeper = true;
    keepout_into_domain(&field->continuation, point, inside);
    for (axis = 0; axis < 3; axis++) {
        u[axis] = (inside[axis] - field->origin[axis]) / field->spacing;
    }
    for (at = 0; at < level; at++) {
        size = 2.0 * size;
    }
    for (axis = 0; axis < 3; axis++) {
        block[axis] = keepout_to_index((u[axis] / size) / (double)EDGE, 0, field->shape[axis] - 1);
    }
    while (deeper && (level > 0)) {
        const double half = 0.5 * size;
        int32_t below[3];
        for (axis = 0; axis < 3; axis++) {
            /* Within the block found: a place on its upper face belongs to the next one, if there is one. */
            const int32_t first = 2 * block[axis];
            below[axis] = keepout_to_index((u[axis] / half) / (double)EDGE, first, first + 1);
        }
        deeper = block_at(field, level - 1, below) != KEEPOUT_NONE;
        if (deeper) {
            level = level - 1;
            size = half;
            for (axis = 0; axis < 3; axis++) {
                block[axis] = below[axis];
            }
        }
    }
    for (axis = 0; axis < 3; axis++) {
        const double place = (u[axis] / size) - (double)(EDGE * block[axis]);
        const int32_t cell = keepout_to_index(place, 0, EDGE - 1);
        t[axis] = place - (double)cell;
        start[level][axis] = ((EDGE * block[axis]) + cell) - 1;
        for (at = level + 1; at < field->levels; at++) {
            start[at][axis] = halved(start[at - 1][axis] - 1);
        }
    }
    coarsest_window(field, start[field->levels - 1], c);
    for (at = field->levels - 2; at >= level; at--) {
        refined(field, at, start[at], c);
    }
    return field->spacing * size;
}

/* In Python: fields/grid.py, _weights. */
static void weights_of(double t, double value[4], double slope[4])
{
    const double s = 1.0 - t;
    value[0] = ((s * s) * s) / 6.0;
    value[1] = (((3.0 * ((t * t) * t)) - (6.0 * (t * t))) + 4.0) / 6.0;
    value[2] = (((3.0 * ((s * s) * s)) - (6.0 * (s * s))) + 4.0) / 6.0;
    value[3] = ((t * t) * t) / 6.0;
    slope[0] = -(s * s) / 2.0;
    slope[1] = ((3.0 * (t * t)) - (4.0 * t)) / 2.0;
    slope[2] = -((3.0 * (s * s)) - (4.0 * s)) / 2.0;
    slope[3] = (t * t) / 2.0;
}

static double contracted(const window c, const double x[4], const double y[4], const double z[4])
{
    double sum = 0.0;
    int32_t i;
    int32_t j;
    int32_t k;
    for (k = 0; k < 4; k++) {
        double along = 0.0;
        for (j = 0; j < 4; j++) {
            double row = 0.0;
            for (i = 0; i < 4; i++) {
                row = row + ((double)c[i][j][k] * x[i]);
            }
            along = along + (row * y[j]);
        }
        sum = sum + (along * z[k]);
    }
    return sum;
}

/* In Python: GridField.value. */
double keepout_spline_value(const keepout_spline *field, const double point[3])
{
    window c;
    double t[3];
    double value[3][4];
    double slope[4];
    int32_t axis;
    (void)cell_of(field, point, c, t);
    for (axis = 0; axis < 3; axis++) {
        weights_of(t[axis], value[axis], slope);
    }
    return keepout_continued(&field->continuation, point,
                             contracted((const float(*)[4][4])c, value[0], value[1], value[2]));
}

/* In Python: GridField.value_and_gradient. */
double keepout_spline_value_and_gradient(const keepout_spline *field, const double point[3], double gradient[3])
{
    window c;
    double t[3];
    double value[3][4];
    double slope[3][4];
    double size;
    double here;
    int32_t axis;
    size = cell_of(field, point, c, t);
    for (axis = 0; axis < 3; axis++) {
        weights_of(t[axis], value[axis], slope[axis]);
    }
    here = contracted((const float(*)[4][4])c, value[0], value[1], value[2]);
    gradient[0] = contracted((const float(*)[4][4])c, slope[0], value[1], value[2]) / size;
    gradient[1] = contracted((const float(*)[4][4])c, value[0], slope[1], value[2]) / size;
    gradient[2] = contracted((const float(*)[4][4])c, value[0], value[1], slope[2]) / size;
    keepout_continued_gradient(&field->continuation, point, gradient);
    return keepout_continued(&field->continuation, point, here);
}
