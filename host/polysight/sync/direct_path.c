/* Direct path of every position: `NumpyLoops` of `loops.py` in C, with the same names. Complex arrays have real and imaginary
   parts interleaved. */
#include "signal.h"

#define STEPS 3 /* `loops._STEPS` */

/* Sum of a position's two halves, [rx][block], times weights, as real part x and imaginary part y. */
static inline void weighted(const float *restrict halves, const float *restrict weights, int count, float *restrict x,
                            float *restrict y)
{
    const float *restrict second = halves + 2 * count;
    VECTOR
    for (int i = 0; i < count; i++) {
        float a = halves[2 * i] + second[2 * i], b = halves[2 * i + 1] + second[2 * i + 1];
        x[i] = a * weights[2 * i] - b * weights[2 * i + 1];
        y[i] = a * weights[2 * i + 1] + b * weights[2 * i];
    }
}

/* Medians of the magnitudes of sixteen spectra of `size` powers, an even number. The bits of positive floats sort like
   the numbers, so the upper of the two middle values is found bit by bit, by counting smaller ones. */
static inline void medians(const int32_t *restrict powers, int size, double *restrict median)
{
    int32_t upper[LANES] = {0}, lower[LANES] = {0}, tried[LANES], count[LANES] = {0};
    for (int bit = 30; bit >= 0; bit--) {
        for (int k = 0; k < LANES; k++)
            tried[k] = upper[k] | 1 << bit, count[k] = 0;
        for (int i = 0; i < size; i++)
            for (int k = 0; k < LANES; k++)
                count[k] += powers[LANES * i + k] < tried[k];
        for (int k = 0; k < LANES; k++)
            upper[k] = count[k] <= size / 2 ? tried[k] : upper[k];
    }
    memset(count, 0, sizeof count);
    for (int i = 0; i < size; i++)
        for (int k = 0; k < LANES; k++) {
            int32_t power = powers[LANES * i + k], below = power < upper[k];
            count[k] += below;
            lower[k] = below && power > lower[k] ? power : lower[k];
        }
    for (int k = 0; k < LANES; k++) {
        float one, other;
        memcpy(&one, count[k] == size / 2 ? &lower[k] : &upper[k], sizeof one);
        memcpy(&other, &upper[k], sizeof other);
        median[k] = (sqrt(one) + sqrt(other)) / 2;
    }
}

/* `NumpyLoops.search` for one spectrum: power [size]. */
static void choose_peaks(const float *power, int size, int nearest, int farthest, float comparable, int32_t *first,
                         int32_t *second)
{
    int top = 0, lower = -1;
    float best = 0;
    for (int i = 1; i < size; i++)
        top = power[i] > power[top] ? i : top;
    for (int d = nearest; d <= farthest; d++) {
        int i = (top - d) & (size - 1);
        float value = power[i];
        if (value > best && value >= power[(i + size - 1) & (size - 1)] && value >= power[(i + 1) & (size - 1)]) {
            best = value;
            lower = i;
        }
    }
    lower = lower < 0 ? top : lower;
    int is_object = best > comparable * comparable * power[top];
    *first = is_object ? lower : top;
    *second = is_object ? top : lower;
}

/* `NumpyLoops.search`. halves: [position][2][rx][block]; weights [rx][block]: beam, steering and window; the
   object is nearest..farthest bins above the direct path. Results: bins [2][position], median magnitude [position].
   Returns 0, or 1 if there is not enough memory. */
int NAME(search)(const float *halves, const float *weights, int positions, int blocks, int size, int nearest,
                 int farthest, const double *comparable, int32_t *bins, double *median)
{
    int count = RX * blocks;
    float *memory = reserve((size_t)(3 * LANES + 5) * size + 2 * (size_t)count + 64);
    if (!memory)
        return 1;
    float *re = memory, *im = re + LANES * size, *c = im + LANES * size, *s = c + size, *power = s + size;
    float *x = power + size, *y = x + count, *nearer = y + count;
    int32_t *bin = (int32_t *)(nearer + size), *bits = bin + size;
    roots_of_unity(size, c, s);
    for (int i = 0; i < size; i++) {
        bin[i] = bin_at(i, size);
        double turn = TURN / 2 * (bin[i] < size / 2 ? bin[i] : bin[i] - size) / size, part = turn == 0 ? 1 : sin(turn) / turn;
        nearer[i] = (float)(part * part);
    }
    for (int first = 0; first < positions; first += LANES) {
        int lanes = positions - first < LANES ? positions - first : LANES;
        memset(re, 0, sizeof *re * 2 * LANES * size);
        for (int k = 0; k < lanes; k++) {
            weighted(halves + 4 * (size_t)(first + k) * count, weights, count, x, y);
            for (int m = 0; m < blocks; m++) {
                re[LANES * m + k] = (x[m] + x[blocks + m]) + (x[2 * blocks + m] + x[3 * blocks + m]);
                im[LANES * m + k] = (y[m] + y[blocks + m]) + (y[2 * blocks + m] + y[3 * blocks + m]);
            }
        }
        transform(re, im, size, c, s, size);
        for (int i = 0; i < LANES * size; i++)
            re[i] = re[i] * re[i] + im[i] * im[i];
        double middle[LANES];
        memcpy(bits, re, sizeof *bits * LANES * size);
        medians(bits, size, middle);
        for (int k = 0; k < lanes; k++) {
            int p = first + k;
            for (int i = 0; i < size; i++)
                power[bin[i]] = re[LANES * i + k] * nearer[i];
            choose_peaks(power, size, nearest, farthest, (float)*comparable, bins + p, bins + positions + p);
            median[p] = middle[k];
        }
    }
    release(memory);
    return 0;
}

/* Estimates A, A w and (third row) A q at a frequency: demodulated sums over the blocks of g [row][block]. */
static void estimate_at(const float *g_re, const float *g_im, int rows, int blocks, double frequency, float *c, float *s,
                        Complex *estimate)
{
    ramp(frequency, 0, FOLD, FOLD * (blocks - 1) / 2.0, blocks, c, s);
    for (int k = 0; k < rows; k++) {
        const float *re = g_re + k * blocks, *im = g_im + k * blocks;
        float x = 0, y = 0;
        for (int m = 0; m < blocks; m++) {
            x += re[m] * c[m] - im[m] * s[m];
            y += re[m] * s[m] + im[m] * c[m];
        }
        estimate[k] = (Complex){x, y};
    }
}

/* `NumpyLoops.refine`: steering [rx][block], estimator [row][rx][block]; changes frequency [position]. */
int NAME(refine)(const float *halves, const float *steering, const float *estimator, int positions, int blocks, int rows,
                 double *frequency, double *estimates, double *steps)
{
    int count = RX * blocks;
    double reach = 1.0 / (blocks * FOLD);
    float *memory = reserve((size_t)2 * count + (size_t)(2 * rows + 2) * blocks + 64);
    if (!memory)
        return 1;
    float *x = memory, *y = x + count, *re = y + count, *im = re + rows * blocks, *c = im + rows * blocks;
    float *s = c + blocks + 16;
    for (int p = 0; p < positions; p++) {
        Complex *estimate = (Complex *)(estimates + 2 * (size_t)p * rows);
        weighted(halves + 4 * (size_t)p * count, steering, count, x, y);
        memset(re, 0, sizeof *re * 2 * rows * blocks);
        for (int k = 0; k < rows; k++)
            for (int r = 0; r < RX; r++) {
                const float *e = estimator + 2 * (k * count + r * blocks), *u = x + r * blocks, *v = y + r * blocks;
                float *to_re = re + k * blocks, *to_im = im + k * blocks;
                VECTOR
                for (int m = 0; m < blocks; m++) {
                    to_re[m] += e[2 * m] * u[m] - e[2 * m + 1] * v[m];
                    to_im[m] += e[2 * m] * v[m] + e[2 * m + 1] * u[m];
                }
            }
        steps[p] = 0;
        estimate_at(re, im, rows, blocks, frequency[p], c, s, estimate);
        for (int i = 0; i < STEPS; i++) {
            Complex a = estimate[0], aw = estimate[1];
            double size = a.re * a.re + a.im * a.im;
            double step = size > 0 ? (aw.re * a.re + aw.im * a.im) / size / TURN : 0;
            steps[p] = step < -reach ? -reach : step > reach ? reach : step;
            frequency[p] += steps[p];
            estimate_at(re, im, rows, blocks, frequency[p], c, s, estimate);
        }
    }
    release(memory);
    return 0;
}

/* Complex values times complex weights times c + j s. */
static inline void turned(const float *restrict values, const float *restrict weights, const float *restrict c,
                          const float *restrict s, int count, float *restrict out)
{
    VECTOR
    for (int n = 0; n < count; n++) {
        float a = weights[2 * n] * c[n] - weights[2 * n + 1] * s[n], b = weights[2 * n] * s[n] + weights[2 * n + 1] * c[n];
        out[2 * n] = values[2 * n] * a - values[2 * n + 1] * b;
        out[2 * n + 1] = values[2 * n] * b + values[2 * n + 1] * a;
    }
}

/* `NumpyLoops.turn`: halves [position][2][RX][block], steering [RX][block], phase in turns; their sum to out
   [RX][position][block]. */
int NAME(turn)(const float *halves, const float *steering, int positions, int blocks, const double *frequency,
               const double *phase, const uint8_t *found, float *out, float *halves_out)
{
    float *memory = reserve((size_t)2 * blocks + 64);
    if (!memory)
        return 1;
    float *c = memory, *s = c + blocks + 16;
    for (int p = 0; p < positions; p++) {
        const size_t values = (size_t)2 * RX * blocks, at = 2 * values * p;
        float *one = halves_out + at, *other = one + values;
        ramp(frequency[p], phase[p], FOLD, FOLD * (blocks - 1) / 2.0, blocks, c, s);
        for (int m = 0; m < blocks && !found[p]; m++)
            c[m] = s[m] = 0;
        for (int i = 0; i < 2 * RX; i++)
            turned(halves + at + 2 * i * blocks, steering + 2 * (i % RX) * blocks, c, s, blocks, one + 2 * i * blocks);
        for (int r = 0; r < RX; r++) {
            float *to = out + 2 * ((size_t)r * positions + p) * blocks;
            for (int i = 0; i < 2 * blocks; i++)
                to[i] = one[2 * r * blocks + i] + other[2 * r * blocks + i];
        }
    }
    release(memory);
    return 0;
}
