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

/* The eight blocks (or bricks) in which a window of 4 x 4 x 4 nodes may lie: their numbers, or KEEPOUT_NONE. */
typedef struct {
    int32_t lowest[3]; /* the block of the window's first node */
    uint32_t number[2][2][2];
} blocks_around;

/* Where a window's nodes lie along one axis: in the first block or the next, and at which node of it. */
typedef struct {
    int32_t side[4];
    uint32_t node[4];
    int32_t sides; /* blocks that the window reaches, 1 or 2 */
} reach_of_axis;

/* Of nodes from `first` >= 0 on, counted from the first node of the first block. */
static reach_of_axis reach_from(int32_t first)
{
    reach_of_axis reach;
    int32_t i;
    for (i = 0; i < 4; i++) {
        reach.side[i] = ((first + i) < EDGE) ? 0 : 1;
        reach.node[i] = (uint32_t)(first + i) % (uint32_t)EDGE;
    }
    reach.sides = 1 + reach.side[3];
    return reach;
}

/* The block that holds node `start`: floor(start/8) of start >= -8. */
static int32_t block_of(int32_t start)
{
    return ((start + EDGE) / EDGE) - 1;
}

/* Number of a block of the coarsest level, or KEEPOUT_NONE. */
static uint32_t coarsest_block(const keepout_spline *field, const int32_t block[3])
{
    uint32_t found = KEEPOUT_NONE;
    if ((block[0] >= 0) && (block[1] >= 0) && (block[2] >= 0) && (block[0] < field->shape[0])
        && (block[1] < field->shape[1]) && (block[2] < field->shape[2])) {
        found = (uint32_t)((((block[0] * field->shape[1]) + block[1]) * field->shape[2]) + block[2]);
    }
    return found;
}

/* Number of a block of `level`, which lies in block `above` of the next coarser one; or KEEPOUT_NONE. */
static uint32_t child_of(const keepout_spline *field, int32_t level, uint32_t above, const int32_t block[3])
{
    uint32_t found = KEEPOUT_NONE;
    if (above < field->blocks[level + 1]) {
        const uint32_t octant = ((4u * ((uint32_t)block[0] & 1u)) + (2u * ((uint32_t)block[1] & 1u)))
                                + ((uint32_t)block[2] & 1u);
        found = two_bytes(field->children[level + 1], (8u * above) + octant);
        if (found >= field->blocks[level]) {
            found = KEEPOUT_NONE;
        }
    }
    return found;
}

/* Coefficients of the coarsest level at nodes from `start` on. */
static void coarsest_window(const keepout_spline *field, const int32_t start[3], window c)
{
    reach_of_axis reach[3];
    double base[2][2][2];
    double scale[2][2][2];
    uint32_t number[2][2][2];
    int32_t brick[3];
    int32_t i;
    int32_t j;
    int32_t k;
    for (i = 0; i < 3; i++) {
        brick[i] = block_of(start[i] + 1); /* bricks begin at node -1 */
        reach[i] = reach_from((start[i] + 1) - (EDGE * brick[i]));
    }
    for (i = 0; i < 2; i++) {
        for (j = 0; j < 2; j++) {
            for (k = 0; k < 2; k++) {
                const int32_t x = brick[0] + i;
                const int32_t y = brick[1] + j;
                const int32_t z = brick[2] + k;
                uint32_t found = KEEPOUT_NONE;
                if ((i < reach[0].sides) && (j < reach[1].sides) && (k < reach[2].sides) && (x >= 0) && (y >= 0)
                    && (z >= 0) && (x < field->bricks[0]) && (y < field->bricks[1]) && (z < field->bricks[2])) {
                    found = two_bytes(field->brick,
                                      (uint32_t)((((x * field->bricks[1]) + y) * field->bricks[2]) + z));
                }
                number[i][j][k] = found;
                base[i][j][k] = 0.0;
                scale[i][j][k] = 0.0;
                if (found < field->brick_count) {
                    base[i][j][k] = single(field->brick_base, found);
                    scale[i][j][k] = single(field->brick_scale, found);
                }
            }
        }
    }
    for (i = 0; i < 4; i++) {
        for (j = 0; j < 4; j++) {
            const int32_t x = reach[0].side[i];
            const int32_t y = reach[1].side[j];
            const uint32_t row = ((reach[0].node[i] * (uint32_t)EDGE) + reach[1].node[j]) * (uint32_t)EDGE;
            for (k = 0; k < 4; k++) {
                const int32_t z = reach[2].side[k];
                const uint32_t found = number[x][y][z];
                c[i][j][k] = NOWHERE;
                if (found < field->brick_count) {
                    const uint32_t place = ((found * VOLUME) + row) + reach[2].node[k];
                    c[i][j][k] = (float)(base[x][y][z]
                                         + (scale[x][y][z] * signed_two_bytes(field->brick_values, place)));
                }
            }
        }
    }
}

/* One axis of `inherited`: coefficients at nodes of half the spacing, of those beside them: 1/8 6/8 1/8 where a node
 * stands on a coarse one, else 1/2 1/2. `odd`: the window begins between two coarse nodes. */
static void halved_axis(const double p[4][16], bool odd, double finer[4][16])
{
    int32_t n;
    if (odd) {
        for (n = 0; n < 16; n++) {
            finer[0][n] = 0.5 * (p[0][n] + p[1][n]);
            finer[1][n] = ((0.125 * p[0][n]) + (0.75 * p[1][n])) + (0.125 * p[2][n]);
            finer[2][n] = 0.5 * (p[1][n] + p[2][n]);
            finer[3][n] = ((0.125 * p[1][n]) + (0.75 * p[2][n])) + (0.125 * p[3][n]);
        }
    } else {
        for (n = 0; n < 16; n++) {
            finer[0][n] = ((0.125 * p[0][n]) + (0.75 * p[1][n])) + (0.125 * p[2][n]);
            finer[1][n] = 0.5 * (p[1][n] + p[2][n]);
            finer[2][n] = ((0.125 * p[1][n]) + (0.75 * p[2][n])) + (0.125 * p[3][n]);
            finer[3][n] = 0.5 * (p[2][n] + p[3][n]);
        }
    }
}

/* Of [a][b, c] make [b][c, a]: the next axis comes first. */
static void turned(const double from[4][16], double to[4][16])
{
    int32_t a;
    int32_t b;
    int32_t c;
    for (b = 0; b < 4; b++) {
        for (c = 0; c < 4; c++) {
            for (a = 0; a < 4; a++) {
                to[b][(4 * c) + a] = from[a][(4 * b) + c];
            }
        }
    }
}

/* The coefficients at nodes of half the spacing from `start` on that are the coarser spline's; axis by axis. */
static void inherited(const window c, const int32_t start[3], double finer[4][16])
{
    double p[4][16];
    int32_t axis;
    int32_t i;
    int32_t n;
    for (i = 0; i < 4; i++) {
        for (n = 0; n < 16; n++) {
            p[i][n] = (double)c[i][n / 4][n % 4];
        }
    }
    for (axis = 0; axis < 3; axis++) {
        double half[4][16];
        halved_axis((const double(*)[16])p, (start[axis] & 1) != 0, half);
        turned((const double(*)[16])half, p);
    }
    for (i = 0; i < 4; i++) {
        for (n = 0; n < 16; n++) {
            finer[i][n] = p[i][n];
        }
    }
}

/* Go one level down: what is inherited, and by how much the blocks of `level` differ from it. `around` are the blocks of
 * the coarser window, and then those of this one. */
static void refined(const keepout_spline *field, int32_t level, const int32_t start[3], blocks_around *around, window c)
{
    double finer[4][16];
    double scale[2][2][2];
    reach_of_axis reach[3];
    blocks_around now;
    bool any = false;
    int32_t i;
    int32_t j;
    int32_t k;
    for (i = 0; i < 3; i++) {
        now.lowest[i] = block_of(start[i]);
        reach[i] = reach_from(start[i] - (EDGE * now.lowest[i]));
    }
    for (i = 0; i < 2; i++) {
        for (j = 0; j < 2; j++) {
            for (k = 0; k < 2; k++) {
                const int32_t block[3] = {now.lowest[0] + i, now.lowest[1] + j, now.lowest[2] + k};
                uint32_t number = KEEPOUT_NONE;
                if ((i < reach[0].sides) && (j < reach[1].sides) && (k < reach[2].sides)) {
                    const int32_t x = halved(block[0]) - around->lowest[0];
                    const int32_t y = halved(block[1]) - around->lowest[1];
                    const int32_t z = halved(block[2]) - around->lowest[2];
                    if ((x >= 0) && (y >= 0) && (z >= 0) && (x < 2) && (y < 2) && (z < 2)) {
                        number = child_of(field, level, around->number[x][y][z], block);
                    }
                }
                now.number[i][j][k] = number;
                scale[i][j][k] = 0.0;
                if (number < field->blocks[level]) {
                    scale[i][j][k] = single(field->scale[level], number);
                    any = true;
                }
            }
        }
    }
    *around = now;
    inherited((const float(*)[4][4])c, start, finer);
    for (i = 0; i < 4; i++) {
        for (j = 0; j < 4; j++) {
            const int32_t x = reach[0].side[i];
            const int32_t y = reach[1].side[j];
            const uint32_t row = ((reach[0].node[i] * (uint32_t)EDGE) + reach[1].node[j]) * (uint32_t)EDGE;
            for (k = 0; k < 4; k++) {
                const int32_t z = reach[2].side[k];
                const uint32_t block = any ? now.number[x][y][z] : KEEPOUT_NONE;
                double value = finer[i][(4 * j) + k];
                if (block < field->blocks[level]) {
                    const uint32_t place = ((block * VOLUME) + row) + reach[2].node[k];
                    const double units = (level == 0) ? signed_byte(field->detail[0], place)
                                                      : signed_two_bytes(field->detail[level], place);
                    value = value + (scale[x][y][z] * units);
                }
                c[i][j][k] = (float)value;
            }
        }
    }
}

/* The cell of a place: its level, the block of it, the cell's lowest node, and its coefficients. */
static void fill(const keepout_spline *field, keepout_cell *cell)
{
    int32_t start[KEEPOUT_LEVELS][3];
    blocks_around around;
    int32_t axis;
    int32_t at;
    int32_t i;
    int32_t j;
    int32_t k;
    const int32_t coarsest = field->levels - 1;
    for (axis = 0; axis < 3; axis++) {
        int32_t node = cell->start[axis];
        for (at = 0; at <= coarsest; at++) {
            start[at][axis] = node; /* below the cell's level nothing is asked for */
            node = (at < cell->level) ? node : halved(node - 1);
        }
        around.lowest[axis] = block_of(start[coarsest][axis]);
    }
    for (i = 0; i < 2; i++) {
        for (j = 0; j < 2; j++) {
            for (k = 0; k < 2; k++) {
                const int32_t block[3] = {around.lowest[0] + i, around.lowest[1] + j, around.lowest[2] + k};
                around.number[i][j][k] = coarsest_block(field, block);
            }
        }
    }
    coarsest_window(field, start[coarsest], cell->coefficients);
    for (at = coarsest - 1; at >= cell->level; at--) {
        refined(field, at, start[at], &around, cell->coefficients);
    }
}

/* Find the cell of a place, if it is not the one that is there already; where the place lies in it, and its size (m). */
static double cell_of(const keepout_spline *field, const double point[3], keepout_cell *cell, double t[3])
{
    double inside[3];
    double u[3];
    int32_t block[3];
    double size = 1.0;
    int32_t level = field->levels - 1;
    int32_t axis;
    int32_t at;
    uint32_t number;
    bool deeper = true;
    bool same;
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
    number = coarsest_block(field, block);
    for (at = level - 1; deeper && (at >= 0); at--) {
        const double half = 0.5 * size;
        int32_t below[3];
        uint32_t found;
        for (axis = 0; axis < 3; axis++) {
            /* Within the block found: a place on its upper face belongs to the next one, if there is one. */
            const int32_t first = 2 * block[axis];
            below[axis] = keepout_to_index((u[axis] / half) / (double)EDGE, first, first + 1);
        }
        found = child_of(field, at, number, below);
        deeper = found != KEEPOUT_NONE;
        if (deeper) {
            number = found;
            level = at;
            size = half;
            for (axis = 0; axis < 3; axis++) {
                block[axis] = below[axis];
            }
        }
    }
    same = cell->known && (cell->level == level);
    for (axis = 0; axis < 3; axis++) {
        const double place = (u[axis] / size) - (double)(EDGE * block[axis]);
        const int32_t index = keepout_to_index(place, 0, EDGE - 1);
        const int32_t start = ((EDGE * block[axis]) + index) - 1;
        t[axis] = place - (double)index;
        same = same && (cell->start[axis] == start);
        cell->start[axis] = start;
    }
    if (!same) {
        cell->known = true;
        cell->level = level;
        fill(field, cell);
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
double keepout_spline_value(const keepout_spline *field, const double point[3], keepout_cell *cell)
{
    double t[3];
    double value[3][4];
    double slope[4];
    int32_t axis;
    (void)cell_of(field, point, cell, t);
    for (axis = 0; axis < 3; axis++) {
        weights_of(t[axis], value[axis], slope);
    }
    return keepout_continued(&field->continuation, point,
                             contracted((const float(*)[4][4])cell->coefficients, value[0], value[1], value[2]));
}

/* In Python: GridField.value_and_gradient. */
double keepout_spline_value_and_gradient(const keepout_spline *field, const double point[3], double gradient[3])
{
    keepout_cell cell;
    const float(*c)[4][4] = (const float(*)[4][4])cell.coefficients;
    double t[3];
    double value[3][4];
    double slope[3][4];
    double size;
    double here;
    int32_t axis;
    cell.known = false;
    size = cell_of(field, point, &cell, t);
    for (axis = 0; axis < 3; axis++) {
        weights_of(t[axis], value[axis], slope[axis]);
    }
    here = contracted(c, value[0], value[1], value[2]);
    gradient[0] = contracted(c, slope[0], value[1], value[2]) / size;
    gradient[1] = contracted(c, value[0], slope[1], value[2]) / size;
    gradient[2] = contracted(c, value[0], value[1], slope[2]) / size;
    keepout_continued_gradient(&field->continuation, point, gradient);
    return keepout_continued(&field->continuation, point, here);
}
