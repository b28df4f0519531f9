/* Speed limit of one core for the density constraint: two passes over neighbour lists, and building the lists, on a
 * jittered lattice at rest, sorted by cell; no walls, no forces, no sweeps, no integration.
 *
 * cc -O3 -march=native -ffast-math core_limit.c -lm -o core_limit && ./core_limit 10000
 *
 * Prints nanoseconds of process time for all particles: building full lists, one density iteration with them, building
 * half lists (each pair once), one density iteration with them.
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define REPEATS 21
#define MOST 64 /* capacity of a neighbour list; a particle has about 50 neighbours */

static int n, cells, *cell, *start, *list, *count;
static float *x, *y, *z, *multiplier, *density, *dx, *dy, *dz;
static const float reach = 2.3f, support = 2.0f; /* [spacings]: kernel plus skin, kernel */

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * t.tv_sec + t.tv_nsec;
}

static int place(float a) { return (int)(a / reach); }

static void sort_into_cells(void) {
    float *from[3] = {x, y, z}, *copy = malloc(n * sizeof *copy);
    int *target = malloc(n * sizeof *target), total = cells * cells * cells;
    memset(start, 0, (total + 1) * sizeof *start);
    for (int i = 0; i < n; i++) {
        cell[i] = (place(x[i]) * cells + place(y[i])) * cells + place(z[i]);
        start[cell[i] + 1]++;
    }
    for (int c = 0; c < total; c++) start[c + 1] += start[c];
    for (int i = 0; i < n; i++) target[i] = start[cell[i]]++;
    for (int c = total; c > 0; c--) start[c] = start[c - 1];
    start[0] = 0;
    for (int k = 0; k < 3; k++) {
        memcpy(copy, from[k], n * sizeof *copy);
        for (int i = 0; i < n; i++) from[k][target[i]] = copy[i];
    }
    free(copy);
    free(target);
}

static void build(int all) {
    sort_into_cells();
    for (int i = 0; i < n; i++) {
        int a0 = place(x[i]), b0 = place(y[i]), c0 = place(z[i]), found = 0;
        for (int a = all && a0 > 0 ? a0 - 1 : a0; a <= a0 + 1 && a < cells; a++)
            for (int b = (all || a > a0) && b0 > 0 ? b0 - 1 : b0; b <= b0 + 1 && b < cells; b++) {
                int row = (a * cells + b) * cells, last = c0 + 1 < cells ? c0 + 1 : c0;
                int first = all || a > a0 || b > b0 ? start[row + (c0 > 0 ? c0 - 1 : 0)] : i + 1;
                for (int j = first; j < start[row + last + 1]; j++) {
                    float u = x[i] - x[j], v = y[i] - y[j], w = z[i] - z[j];
                    list[i * MOST + found] = j;
                    found += (u * u + v * v + w * w < reach * reach) & (j != i);
                }
            }
        count[i] = found;
    }
}

static void build_full(void) { build(1); }
static void build_half(void) { build(0); }

static void full_iteration(void) {
    for (int i = 0; i < n; i++) {
        float rho = 1;
        for (int k = 0; k < count[i]; k++) {
            int j = list[i * MOST + k];
            float u = x[i] - x[j], v = y[i] - y[j], w = z[i] - z[j];
            float q = fmaxf(1 - sqrtf(u * u + v * v + w * w) / support, 0);
            rho += q * q * q * q * (5 - 4 * q);
        }
        multiplier[i] = 1e-3f * (rho - 10);
    }
    for (int i = 0; i < n; i++) {
        float mx = 0, my = 0, mz = 0;
        for (int k = 0; k < count[i]; k++) {
            int j = list[i * MOST + k];
            float u = x[i] - x[j], v = y[i] - y[j], w = z[i] - z[j];
            float q = fmaxf(1 - sqrtf(u * u + v * v + w * w) / support, 0);
            float m = (multiplier[i] + multiplier[j]) * 20 * q * q * q;
            mx += m * u, my += m * v, mz += m * w;
        }
        dx[i] = mx, dy[i] = my, dz[i] = mz;
    }
}

static void half_iteration(void) {
    for (int i = 0; i < n; i++) density[i] = 1, dx[i] = dy[i] = dz[i] = 0;
    for (int i = 0; i < n; i++) {
        float rho = 0;
        for (int k = 0; k < count[i]; k++) {
            int j = list[i * MOST + k];
            float u = x[i] - x[j], v = y[i] - y[j], w = z[i] - z[j];
            float q = fmaxf(1 - sqrtf(u * u + v * v + w * w) / support, 0), d = q * q * q * q * (5 - 4 * q);
            rho += d, density[j] += d;
        }
        density[i] += rho;
    }
    for (int i = 0; i < n; i++) multiplier[i] = 1e-3f * (density[i] - 10);
    for (int i = 0; i < n; i++) {
        float mx = 0, my = 0, mz = 0;
        for (int k = 0; k < count[i]; k++) {
            int j = list[i * MOST + k];
            float u = x[i] - x[j], v = y[i] - y[j], w = z[i] - z[j];
            float q = fmaxf(1 - sqrtf(u * u + v * v + w * w) / support, 0);
            float m = (multiplier[i] + multiplier[j]) * 20 * q * q * q;
            mx += m * u, my += m * v, mz += m * w;
            dx[j] -= m * u, dy[j] -= m * v, dz[j] -= m * w;
        }
        dx[i] += mx, dy[i] += my, dz[i] += mz;
    }
}

static int ascending(const void *a, const void *b) {
    double d = *(const double *)a - *(const double *)b;
    return (d > 0) - (d < 0);
}

static double median_of(void (*work)(void)) {
    double times[REPEATS];
    for (int k = 0; k < REPEATS; k++) {
        double begun = now();
        work();
        times[k] = now() - begun;
    }
    qsort(times, REPEATS, sizeof *times, ascending);
    return times[REPEATS / 2];
}

static float *numbers(void) { return calloc(n, sizeof(float)); }

int main(int argc, char **argv) {
    n = argc > 1 ? atoi(argv[1]) : 10000;
    int side = (int)ceil(cbrt(n));
    cells = place(side + 1) + 1;
    float **all[] = {&x, &y, &z, &multiplier, &density, &dx, &dy, &dz};
    for (size_t k = 0; k < sizeof all / sizeof *all; k++) *all[k] = numbers();
    cell = calloc(n, sizeof *cell), count = calloc(n, sizeof *count);
    start = calloc(cells * cells * cells + 1, sizeof *start);
    list = malloc((n + 1) * MOST * sizeof *list);
    srand(1);
    for (int i = 0; i < n; i++) {
        float *at[3] = {x + i, y + i, z + i};
        int grid[3] = {i / (side * side), i / side % side, i % side};
        for (int k = 0; k < 3; k++) *at[k] = grid[k] + 0.5f + 0.1f * ((float)rand() / RAND_MAX - 0.5f);
    }
    double full_lists = median_of(build_full), full = median_of(full_iteration);
    double half_lists = median_of(build_half), halved = median_of(half_iteration);
    float check = 0;
    for (int i = 0; i < n; i++) check += dx[i] + multiplier[i];
    printf("%.0f %.0f %.0f %.0f\n", full_lists, full, half_lists, halved);
    return !isfinite(check);
}
