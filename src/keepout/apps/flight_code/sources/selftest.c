/* Self-test of the flight code on the machine it runs on: `selftest tables.bin`.
 *
 * It refuses a compiler or processor that rounds otherwise (a fused multiply-add, a wider format, -ffast-math), and one
 * that answers the stored steps of selftest_steps.h otherwise than Python does. The last line is a hash of all bits of
 * the answers: the same for every compiler and processor. Not for flight: it reads a file. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "keepout_internal.h"
#include "mission_tables.h"
#include "selftest_steps.h"

#define ROUNDING 0x6c21fb8c19ce627cu /* hash of the functions' answers below */
#define CLOSE 1e-9                   /* to which the answers of Python must agree, relative or in SI units */

static uint64_t hash_of(uint64_t hash, double x)
{
    uint64_t bits;
    uint64_t sum = hash;
    int i;
    (void)memcpy(&bits, &x, sizeof bits);
    if (x != x) {
        bits = 0x7FF8000000000000u; /* the sign of what is not a number means nothing */
    }
    for (i = 0; i < 8; i++) {
        sum = (sum ^ ((bits >> (8 * i)) & 255u)) * 1099511628211u;
    }
    return sum;
}

static uint64_t hash_of_functions(void)
{
    uint64_t hash = 14695981039346656037u;
    double x = 1.0e-3;
    int i;
    for (i = 0; i < 4096; i++) {
        const double a[3] = {x, -0.3 * x, 1.0 / x};
        const double b[3] = {0.7, x * x, x};
        double across[3];
        x = (x > 700.0) ? 1.0e-3 : (x * 1.003) + 1.0e-4;
        hash = hash_of(hash, keepout_exp(-x));
        hash = hash_of(hash, keepout_exp(x));
        hash = hash_of(hash, keepout_expm1(0.001 * x));
        hash = hash_of(hash, keepout_log(x));
        hash = hash_of(hash, keepout_log1p(0.01 * x));
        hash = hash_of(hash, keepout_tanh(0.1 * x));
        hash = hash_of(hash, keepout_sin(x));
        hash = hash_of(hash, keepout_cos(x));
        hash = hash_of(hash, keepout_atan2(x - 3.0, 2.0 - x));
        hash = hash_of(hash, keepout_acos(1.0 / (1.0 + x)));
        hash = hash_of(hash, keepout_cbrt(x));
        hash = hash_of(hash, keepout_dot(a, b));
        hash = hash_of(hash, keepout_distance(a, b));
        keepout_cross(a, b, across);
        hash = hash_of(hash, across[1]);
    }
    return hash;
}

static int far_from(double a, double b)
{
    const double apart = (a < b) ? (b - a) : (a - b);
    const double size = (a < 0.0) ? -a : a;
    return !((a == b) || ((a != a) && (b != b)) || (apart <= CLOSE) || (apart <= (CLOSE * size)));
}

/* Numbers of an order that do not agree; the hash of all goes on. */
static int compare(const keepout_order *found, const keepout_order *told, uint64_t *hash)
{
    const double *a[6] = {found->force,         found->commanded_force,      found->desired_velocity,
                          found->safe_velocity, found->disturbance_estimate, found->mean_force};
    const double *b[6] = {told->force,         told->commanded_force,      told->desired_velocity,
                          told->safe_velocity, told->disturbance_estimate, told->mean_force};
    const double c[3] = {found->barrier, found->backstepping_barrier, found->lyapunov};
    const double d[3] = {told->barrier, told->backstepping_barrier, told->lyapunov};
    int wrong = 0;
    int i;
    int j;
    for (i = 0; i < 6; i++) {
        for (j = 0; j < 3; j++) {
            wrong += far_from(a[i][j], b[i][j]);
            *hash = hash_of(*hash, a[i][j]);
        }
    }
    for (i = 0; i < 3; i++) {
        wrong += far_from(c[i], d[i]);
        *hash = hash_of(*hash, c[i]);
    }
    for (i = 0; i < KEEPOUT_THRUSTERS; i++) {
        wrong += far_from(found->pulse[i], told->pulse[i]) + far_from(found->on_time[i], told->on_time[i]);
        *hash = hash_of(hash_of(*hash, found->pulse[i]), found->on_time[i]);
    }
    wrong += (found->control_status != told->control_status) ? 1 : 0;
    wrong += (found->guard_status != told->guard_status) ? 1 : 0;
    *hash = hash_of(*hash, (double)found->guard_status);
    return wrong;
}

static uint8_t *read_file(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    uint8_t *bytes = NULL;
    long length = -1;
    if (file != NULL) {
        if (fseek(file, 0L, SEEK_END) == 0) {
            length = ftell(file);
        }
        if ((length >= 0) && (fseek(file, 0L, SEEK_SET) == 0)) {
            bytes = malloc((size_t)length + 1u);
        }
        if ((bytes != NULL) && (fread(bytes, 1u, (size_t)length, file) != (size_t)length)) {
            free(bytes);
            bytes = NULL;
        }
        (void)fclose(file);
        *size = (size_t)length;
    }
    return bytes;
}

int main(int count, char **words)
{
    static keepout_tables tables;
    static keepout_mission mission;
    static keepout_memory memory;
    const uint64_t functions = hash_of_functions();
    uint64_t hash = 14695981039346656037u;
    uint8_t *image;
    size_t size = 0u;
    int32_t answer;
    int wrong = 0;
    int i;
    if (count != 2) {
        (void)fprintf(stderr, "selftest: give the path of tables.bin\n");
        return 2;
    }
    if (functions != ROUNDING) {
        (void)fprintf(stderr,
                      "selftest: this build rounds otherwise (%08lx%08lx); compile without -ffast-math and with "
                      "-ffp-contract=off\n",
                      (unsigned long)(functions >> 32), (unsigned long)(functions & 0xFFFFFFFFu));
        return 1;
    }
    image = read_file(words[1], &size);
    if (image == NULL) {
        (void)fprintf(stderr, "selftest: %s: cannot be read\n", words[1]);
        return 2;
    }
    answer = keepout_open(image, size, &keepout_mission_layout, keepout_mission_digest, &tables);
    if (answer != KEEPOUT_IMAGE_GOOD) {
        (void)fprintf(stderr, "selftest: %s: refused, KEEPOUT_IMAGE %d\n", words[1], (int)answer);
        free(image);
        return 1;
    }
    keepout_mission_with(&tables, &mission);
#if KEEPOUT_SENSORS > 0
    keepout_begin(&mission, &memory, &selftest_begin, selftest_told[0], NULL);
#else
    keepout_begin(&mission, &memory, &selftest_begin, NULL);
#endif
    for (i = 0; i < SELFTEST_STEPS; i++) {
        keepout_order order;
#if KEEPOUT_SENSORS > 0
        keepout_knowledge known;
        keepout_step(&mission, &memory, selftest_told[i], &known, &order);
#else
        keepout_step(&mission, &memory, &selftest_told[i], &order);
#endif
        wrong += compare(&order, &selftest_orders[i], &hash);
    }
    free(image);
    (void)printf("%d steps, %d numbers that Python gives otherwise, hash %08lx%08lx\n", SELFTEST_STEPS, wrong,
                 (unsigned long)(hash >> 32), (unsigned long)(hash & 0xFFFFFFFFu));
    return (wrong == 0) ? 0 : 1;
}
