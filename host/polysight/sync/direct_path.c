/* Direct path of every position: `NumpyLoops` of `loops.py` in C, with the same names. Complex arrays have real and imaginary
   parts interleaved. */
#include "signal.h"

/* exp(-j 2 pi frequency FOLD (m - middle)) for m < blocks: conjugate before and behind the middle. */
static inline void ramp(double frequency, int blocks, float *restrict c, float *restrict s)
{
    VECTOR
    for (int m = 0; m < (blocks + 1) / 2; m++) {
        Complex z = cis(frequency * FOLD * ((blocks - 1) / 2.0 - m));
        c[m] = c[blocks - 1 - m] = (float)z.re;
        s[m] = (float)z.im;
        s[blocks - 1 - m] = (float)-z.im;
    }
}

/* Sum of a position's two halves, [rx][block], times weights [2][rx][block], as real part x and imaginary part y. */
static inline void weighted(const float *restrict halves, const float *restrict weights, int count, float *restrict x,
                            float *restrict y)
{
    float sum[2 * RX * MOST]; /* first, so that only one array is taken apart into real and imaginary parts */
    VECTOR
    for (int i = 0; i < 2 * count; i++)
        sum[i] = halves[i] + halves[2 * count + i];
    VECTOR
    for (int i = 0; i < count; i++) {
        float a = sum[2 * i], b = sum[2 * i + 1];
        x[i] = a * weights[i] - b * weights[count + i];
        y[i] = a * weights[count + i] + b * weights[i];
    }
}

/* Upper medians of the magnitudes of sixteen spectra of `size` powers. The bits of positive floats sort like the numbers,
   so each is found bit by bit, by counting smaller ones. */
static inline void medians(const float *powers, int size, float *median)
{
    for (int part = 0; part < LANES; part += STEP) {
        Whole upper = {0};
        for (int bit = 30; bit >= 0; bit--) {
            Whole tried = upper | 1 << bit, even = {0}, odd = {0}; /* minus the numbers of smaller ones */
            for (int i = 0; i < size; i += 2) {
                even += (Whole)load(powers + LANES * i + part) < tried;
                odd += (Whole)load(powers + LANES * (i + 1) + part) < tried;
            }
            upper |= (even + odd >= -(size / 2)) & 1 << bit;
        }
        store(median + part, (Vector)upper);
    }
}

/* `NumpyLoops.search` for one spectrum, strongest at the bin top; by powers, which rise with magnitudes. */
static inline void choose_peaks(const Table *t, const float *re, const float *im, int top, int nearest, int farthest,
                                double comparable, int32_t *first, int32_t *second)
{
    const int last = t->size - 1;
    int lower = top;
    double best = 0, above = squared(value_at(re, im, t->place[(top - nearest + 1) & last]));
    double here = squared(value_at(re, im, t->place[(top - nearest) & last]));
    for (int d = nearest; d <= farthest; d++) {
        double below = squared(value_at(re, im, t->place[(top - d - 1) & last]));
        if (here >= below && here >= above && here > best) {
            best = here;
            lower = (top - d) & last;
        }
        above = here;
        here = below;
    }
    int is_object = best > comparable * comparable * squared(value_at(re, im, t->place[top & last]));
    *first = is_object ? lower : top;
    *second = is_object ? top : lower;
}

/* `NumpyLoops.search`. halves: [position][2][rx][block]; weights [2][rx][block]: beam, steering and window;
   preference [bin]; the object is nearest..farthest bins above the direct path. Results: bins [2][position], median
   magnitude [position]. Returns 0, or 1 if there is not enough memory. */
int NAME(search)(const float *halves, const float *weights, const float *preference, int positions, int blocks,
                 int size, int nearest, int farthest, const double *comparable, int32_t *bins, double *median)
{
    const int count = RX * blocks;
    Memory memory = {NULL, 0};
    Table table;
    take_table(&memory, &table, size);
    memory.used += sizeof(float) * (size_t)(2 * count + 3 * LANES * size);
    if (!reserve(&memory))
        return 1;
    take_table(&memory, &table, size);
    float *re = floats(&memory, LANES * (size_t)size), *im = floats(&memory, LANES * (size_t)size);
    float *power = floats(&memory, LANES * (size_t)size);
    float *x = floats(&memory, 2 * (size_t)count), *y = x + count;
    fill_table(&table);
    for (int first = 0; first < positions; first += LANES) {
        int lanes = positions - first < LANES ? positions - first : LANES;
        int32_t at[LANES];
        float middle[LANES];
        for (int k = 0; k < lanes; k++) {
            weighted(halves + 4 * (size_t)(first + k) * count, weights, count, x, y);
            for (int m = 0; m < blocks; m++) {
                re[LANES * m + k] = (x[m] + x[blocks + m]) + (x[2 * blocks + m] + x[3 * blocks + m]);
                im[LANES * m + k] = (y[m] + y[blocks + m]) + (y[2 * blocks + m] + y[3 * blocks + m]);
            }
        }
        transform(re, im, blocks, size, &table);
        for (int i = 0; i < size; i++) {
            float weight = preference[table.bin[i]];
            VECTOR
            for (int k = LANES * i; k < LANES * (i + 1); k++) {
                power[k] = re[k] * re[k] + im[k] * im[k];
                re[k] *= weight;
                im[k] *= weight;
            }
        }
        medians(power, size, middle);
        strongest(re, im, size, at);
        for (int k = 0; k < lanes; k++) {
            int32_t *peak = bins + first + k;
            median[first + k] = sqrt(middle[k]);
            choose_peaks(&table, re + k, im + k, table.bin[at[k]], nearest, farthest, *comparable, peak, peak + positions);
        }
    }
    free(memory.block);
    return 0;
}

/* Estimates A, A w and (third row) A q at a frequency: demodulated sums over the blocks of g [row][block]. */
static void estimate_at(const float *g_re, const float *g_im, int rows, int blocks, double frequency, float *c, float *s,
                        Complex *estimate)
{
    ramp(frequency, blocks, c, s);
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

/* `NumpyLoops.refine`: steering [2][rx][block], estimator [row][2][rx][block], real and imaginary part; changes frequency
   [position]. */
int NAME(refine)(const float *halves, const float *steering, const float *estimator, int positions, int blocks, int rows,
                 int count_steps, double *frequency, double *estimates, double *steps)
{
    const int count = RX * blocks;
    const double reach = 1.0 / (blocks * FOLD);
    Memory memory = {NULL, 2 * sizeof(float) * ((size_t)count + rows * blocks + blocks)};
    if (!reserve(&memory))
        return 1;
    float *x = (float *)memory.block, *y = x + count, *re = y + count, *im = re + rows * blocks;
    float *c = im + rows * blocks, *s = c + blocks;
    for (int p = 0; p < positions; p++) {
        Complex *estimate = (Complex *)(estimates + 2 * (size_t)p * rows);
        weighted(halves + 4 * (size_t)p * count, steering, count, x, y);
        memset(re, 0, sizeof *re * 2 * rows * blocks);
        for (int i = 0; i < rows * RX; i++) { /* the same demodulation for all RX: sum over them first */
            const float *e = estimator + (i / RX * 2 * RX + i % RX) * blocks, *f = e + count;
            const float *u = x + i % RX * blocks, *v = y + i % RX * blocks;
            float *to_re = re + i / RX * blocks, *to_im = im + i / RX * blocks;
            VECTOR
            for (int m = 0; m < blocks; m++) {
                to_re[m] += e[m] * u[m] - f[m] * v[m];
                to_im[m] += e[m] * v[m] + f[m] * u[m];
            }
        }
        estimate_at(re, im, rows, blocks, frequency[p], c, s, estimate);
        for (int i = 0; i < count_steps; i++) {
            Complex a = estimate[0], aw = estimate[1];
            double size = squared(a);
            double step = size > 0 ? (aw.re * a.re + aw.im * a.im) / size / TURN : 0;
            steps[p] = step < -reach ? -reach : step > reach ? reach : step;
            frequency[p] += steps[p];
            estimate_at(re, im, rows, blocks, frequency[p], c, s, estimate);
        }
    }
    free(memory.block);
    return 0;
}

/* `NumpyLoops.turn`: halves [position][2][RX][block], steering [2][RX][block], phase in turns, scale [position][2]; the sum
   to out [RX][position][block], the energy of the scaled halves' difference to apart [position]. */
int NAME(turn)(const float *halves, const float *steering, int positions, int blocks, const double *frequency,
               const double *phase, const uint8_t *found, const float *scale, float *out, float *apart)
{
    const int count = RX * blocks;
    Memory memory = {NULL, 2 * sizeof(float) * ((size_t)count + blocks)};
    if (!reserve(&memory))
        return 1;
    float *x = (float *)memory.block, *y = x + count, *c = y + count, *s = c + blocks;
    for (int p = 0; p < positions; p++) {
        const float *first = halves + 4 * (size_t)p * count, *second = first + 2 * count;
        float energy = 0;
        for (int i = 0; i < 2 * count; i++) {
            float difference = scale[2 * p] * first[i] - scale[2 * p + 1] * second[i];
            energy += difference * difference;
        }
        apart[p] = energy;
        ramp(frequency[p], blocks, c, s);
        weighted(first, steering, count, x, y);
        Complex start = cis(-phase[p]);
        float u = (float)start.re, v = (float)start.im;
        for (int r = 0; r < RX; r++) {
            const float *re = x + r * blocks, *im = y + r * blocks;
            float *restrict to = out + 2 * ((size_t)r * positions + p) * blocks;
            VECTOR
            for (int m = 0; m < blocks; m++) {
                float a = re[m] * c[m] - im[m] * s[m], b = re[m] * s[m] + im[m] * c[m];
                to[2 * m] = found[p] ? a * u - b * v : 0;
                to[2 * m + 1] = found[p] ? a * v + b * u : 0;
            }
        }
    }
    free(memory.block);
    return 0;
}
