/* Direct path of every position: `NumpyLoops` of `loops.py` in C, with the same names. Complex arrays have real and imaginary
   parts interleaved. */
#include "signal.h"

#define SEARCH 256 /* most blocks, and points of the transform, `decimate.SEARCH_FFT` */

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
    float sum[2 * RX * SEARCH]; /* first, so that only one array is taken apart into real and imaginary parts */
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

/* `NumpyLoops.search` for one spectrum, strongest at the bin top: the bins of direct path and second candidate. By powers,
   which rise with magnitudes. */
static inline void choose_peaks(const Table *t, const float *re, const float *im, int top, int nearest, int farthest,
                                double comparable, int bins[2])
{
    int lower = top;
    double best = 0;
    for (int bin = top - nearest; bin >= top - farthest; bin--) {
        double here = power_at(t, re, im, bin);
        if (here > best && here >= power_at(t, re, im, bin - 1) && here >= power_at(t, re, im, bin + 1)) {
            best = here;
            lower = bin & (t->size - 1);
        }
    }
    int is_object = best > comparable * comparable * power_at(t, re, im, top);
    bins[0] = is_object ? lower : top;
    bins[1] = is_object ? top : lower;
}

/* `NumpyLoops.refine` for a position's weighted sum x, y: estimator [row][2][rx][block], real and imaginary part; changes
   frequency, returns the last step. c, s: ramp of the last estimate [block]. */
static double refine(const float *x, const float *y, const float *estimator, int blocks, int rows, int count_steps,
                     float *c, float *s, double *frequency, Complex *estimate)
{
    double step = 0, reach = 1.0 / (blocks * FOLD);
    float re[3 * SEARCH], im[3 * SEARCH]; /* [row][block] */
    memset(re, 0, sizeof *re * rows * blocks);
    memset(im, 0, sizeof *im * rows * blocks);
    for (int i = 0; i < rows * RX; i++) { /* the same demodulation for all RX: sum over them first */
        const float *e = estimator + (i / RX * 2 * RX + i % RX) * blocks, *f = e + RX * blocks;
        const float *u = x + i % RX * blocks, *v = y + i % RX * blocks;
        float *to_re = re + i / RX * blocks, *to_im = im + i / RX * blocks;
        VECTOR
        for (int m = 0; m < blocks; m++) {
            to_re[m] += e[m] * u[m] - f[m] * v[m];
            to_im[m] += e[m] * v[m] + f[m] * u[m];
        }
    }
    for (int i = 0; i <= count_steps; i++) {
        if (i > 0) {
            Complex a = estimate[0], aw = estimate[1];
            double size = squared(a), whole = size > 0 ? (aw.re * a.re + aw.im * a.im) / size / TURN : 0;
            step = whole < -reach ? -reach : whole > reach ? reach : whole;
            *frequency += step;
        }
        ramp(*frequency, blocks, c, s);
        for (int k = 0; k < rows; k++) {
            const float *u = re + k * blocks, *v = im + k * blocks;
            float a = 0, b = 0;
            for (int m = 0; m < blocks; m++) {
                a += u[m] * c[m] - v[m] * s[m];
                b += u[m] * s[m] + v[m] * c[m];
            }
            estimate[k] = (Complex){a, b};
        }
    }
    return step;
}

/* `NumpyLoops.find`: halves [position][2][rx][block]; weights and steering [2][rx][block], real and imaginary part;
   preference [bin], `loops._weigh_bins`; the object is nearest..farthest bins above the direct path; estimator [3][2][rx][block]. Results:
   peaks [2][position], median and frequency [position], estimates [position][3]. Returns 0. */
int NAME(find)(const float *halves, const float *weights, const float *preference, int positions, int blocks, int size,
               int nearest, int farthest, const double *comparable, const float *steering, const float *estimator,
               int count_steps, double *peaks, double *median, double *frequency, double *estimates)
{
    const int count = RX * blocks;
    int bin[SEARCH], place[SEARCH];
    float c[SEARCH], s[SEARCH], root_re[SEARCH], root_im[SEARCH], x[RX * SEARCH], y[RX * SEARCH];
    float re[LANES * SEARCH] = {0}, im[LANES * SEARCH] = {0}, power[LANES * SEARCH];
    Table table = {size, bin, place, root_re, root_im};
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
            int p = first + k, bins[2];
            choose_peaks(&table, re + k, im + k, table.bin[at[k]], nearest, farthest, *comparable, bins);
            for (int i = 0; i < 2; i++)
                peaks[i * positions + p] = (double)(bins[i] < size / 2 ? bins[i] : bins[i] - size) / size / FOLD;
            median[p] = sqrt(middle[k]);
            frequency[p] = peaks[p];
            weighted(halves + 4 * (size_t)p * count, steering, count, x, y);
            refine(x, y, estimator, blocks, 3, count_steps, c, s, frequency + p, (Complex *)estimates + 3 * p);
        }
    }
    return 0;
}

/* `NumpyLoops.remove`: halves [position][2][rx][block], steering [2][rx][block], estimator [2][2][rx][block], scale
   [position][2]; changes frequency [position]. Results: estimates [position][2], steps [position], the sum referenced to
   the direct path out [rx][position][block], the energy of the scaled halves' difference apart [position]. */
int NAME(remove)(const float *halves, const float *steering, const float *estimator, int positions, int blocks,
                 int count_steps, const float *scale, double *frequency, double *estimates, double *steps, float *out,
                 float *apart)
{
    const int count = RX * blocks;
    float x[RX * SEARCH], y[RX * SEARCH], c[SEARCH], s[SEARCH];
    for (int p = 0; p < positions; p++) {
        const float *first = halves + 4 * (size_t)p * count, *second = first + 2 * count;
        Complex *estimate = (Complex *)estimates + 2 * p;
        weighted(first, steering, count, x, y);
        steps[p] = refine(x, y, estimator, blocks, 2, count_steps, c, s, frequency + p, estimate);
        const double size = magnitude(*estimate);
        const float u = size > 0 ? (float)(estimate->re / size) : 0, v = size > 0 ? (float)(-estimate->im / size) : 0;
        float energy = 0;
        for (int i = 0; i < 2 * count; i++) {
            float difference = scale[2 * p] * first[i] - scale[2 * p + 1] * second[i];
            energy += difference * difference;
        }
        apart[p] = energy;
        for (int r = 0; r < RX; r++) {
            const float *re = x + r * blocks, *im = y + r * blocks;
            float *restrict to = out + 2 * ((size_t)r * positions + p) * blocks;
            VECTOR
            for (int m = 0; m < blocks; m++) {
                float a = re[m] * c[m] - im[m] * s[m], b = re[m] * s[m] + im[m] * c[m];
                to[2 * m] = a * u - b * v;
                to[2 * m + 1] = a * v + b * u;
            }
        }
    }
    return 0;
}
