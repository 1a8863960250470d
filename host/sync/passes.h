/* Three passes over the words of a burst, `numpy_passes.py` in C, for one position at a time. Words are int16
   [chirp][sample][2][RX]; x + j y are the samples of a chirp, in the order described in `signal.h`. */
#ifndef PASSES_H
#define PASSES_H

#include "signal.h"

#define BAND_BINS 9 /* `numpy_passes.BAND_BINS` */
#define PARTS 8     /* `tone._BLOCKS` */

/* Sizes, tables and work arrays. */
typedef struct {
    int chirps, samples, a, b; /* linear samples [a, b) */
    int n, blocks, size;       /* number of linear samples, of blocks; size of the transform */
    int parts, edges[PARTS + 1];
    double part_times[PARTS];
    int16_t *i, *q; /* I and Q of the burst: [chirp][sample][RX] each */
    float *root_c, *root_s, *phase_c, *phase_s;
    float *one_re, *one_im, *row_re, *row_im, *re, *im; /* one chirp; sixteen records in sequence; sixteen interleaved */
    float *spare, *folded_re, *folded_im, *all_re, *all_im, *total;
    double *power, *smooth, *sums, *newton;
    int *bin, *place;
} Work;

/* Multiply a chirp i + j q by the conjugate of k + j l for every RX; return the energy of the chirp. */
static inline float correlate(const int16_t *restrict i, const int16_t *restrict q, const int16_t *restrict k,
                              const int16_t *restrict l, float *restrict re, float *restrict im, int count)
{
    float energy = 0;
    for (int j = 0; j < count; j++) {
        float x = i[j], y = q[j], u = k[j], v = l[j];
        re[j] = x * u + y * v;
        im[j] = y * u - x * v;
        energy += x * x + y * y;
    }
    return energy;
}

/* Sum over the RX. */
static inline void over_rx(const float *restrict values, float *restrict sums, int samples)
{
    for (int n = 0; n < samples; n++)
        sums[n] = (values[4 * n] + values[4 * n + 1]) + (values[4 * n + 2] + values[4 * n + 3]);
}

/* Interleave four records that are stored one after the other. */
static inline void in_turn(const float *restrict values, float *restrict out, int quarter)
{
    for (int i = 0; i < quarter; i++) {
        out[4 * i] = values[i];
        out[4 * i + 1] = values[quarter + i];
        out[4 * i + 2] = values[2 * quarter + i];
        out[4 * i + 3] = values[3 * quarter + i];
    }
}

/* Transpose records [LANES][n] to [n][LANES], padded with zeros to [size][LANES]. */
static inline void interleave(const float *restrict records, float *restrict spare, float *restrict out, int n,
                              int size)
{
    in_turn(records, spare, LANES / 4 * n);
    in_turn(spare, out, LANES / 4 * n);
    memset(out + LANES * n, 0, sizeof *out * LANES * (size - n));
}

/* Index of the strongest bin of each of sixteen spectra. */
static inline void strongest(const float *restrict re, const float *restrict im, int size, int32_t *restrict at)
{
    float best[LANES];
    for (int k = 0; k < LANES; k++)
        best[k] = -1, at[k] = 0;
    for (int i = 0; i < size; i++)
        for (int k = 0; k < LANES; k++) {
            float power = re[LANES * i + k] * re[LANES * i + k] + im[LANES * i + k] * im[LANES * i + k];
            at[k] = power > best[k] ? i : at[k];
            best[k] = power > best[k] ? power : best[k];
        }
}

static inline Complex bin_value(const float *re, const float *im, int place)
{
    return (Complex){re[LANES * place], im[LANES * place]};
}

/* `tone.strongest`: the tone at the strongest bin of a spectrum; frequency in cycles per sample. */
static inline Complex interpolated(const Work *w, const float *re, const float *im, int at, double *frequency)
{
    int size = w->size, top = w->bin[at];
    Complex peak = bin_value(re, im, at);
    double middle = magnitude(peak);
    double below = magnitude(bin_value(re, im, w->place[(top + size - 1) % size]));
    double above = magnitude(bin_value(re, im, w->place[(top + 1) % size]));
    double bend = below - 2 * middle + above, part = bend < 0 ? 0.5 * (below - above) / bend : 0;
    double whole = (double)(top < size / 2 ? top : top - size) / size;
    *frequency = whole + part / size;
    return times(peak, cis(whole * (w->n - 1) / 2));
}

/* Middle of the signal's band in linear samples x + j y, cycles per sample 0..1. */
static double centre_of_band(Work *w, const int16_t *restrict x, const int16_t *restrict y)
{
    int n = w->n, size = w->size, width = BAND_BINS * size / n / 2, top = 0;
    memset(w->re, 0, sizeof *w->re * LANES * size);
    memset(w->im, 0, sizeof *w->im * LANES * size);
    for (int i = 0; i < n; i++)
        for (int r = 0; r < RX; r++) {
            w->re[LANES * i + r] = x[RX * i + r];
            w->im[LANES * i + r] = y[RX * i + r];
        }
    transform(w->re, w->im, size, w->root_c, w->root_s);
    for (int i = 0; i < size; i++) {
        float power = 0;
        for (int r = 0; r < RX; r++) {
            int j = LANES * i + r;
            power += w->re[j] * w->re[j] + w->im[j] * w->im[j];
        }
        w->power[w->bin[i]] = power;
    }
    for (int box = 0; box < 3; box++) { /* three box filters are nearly Gaussian */
        double sum = 0, *other = w->smooth;
        for (int i = 0; i < width; i++)
            sum += w->power[i % size];
        for (int i = 0; i < size; i++) {
            w->smooth[i] = sum; /* sum of the box that starts here */
            sum += w->power[(i + width) & (size - 1)] - w->power[i];
        }
        w->smooth = w->power;
        w->power = other;
    }
    for (int i = 1; i < size; i++)
        top = w->power[i] > w->power[top] ? i : top;
    return (double)((top + 3 * (width / 2)) % size) / size;
}

/* First pass: the tone between each chirp and a reference chirp; see `numpy_passes.match`. Returns the centre. */
static double match(Work *w, int reference, double *frequency, Complex *product, float *energy)
{
    int n = w->n, chirp = RX * w->samples, start = RX * w->a;
    const int16_t *u = w->i + reference * chirp + start, *v = w->q + reference * chirp + start;
    for (int first = 0; first < w->chirps; first += LANES) {
        int count = w->chirps - first < LANES ? w->chirps - first : LANES;
        int32_t at[LANES];
        memset(w->row_re + count * n, 0, sizeof(float) * (LANES - count) * n);
        memset(w->row_im + count * n, 0, sizeof(float) * (LANES - count) * n);
        for (int k = 0; k < count; k++) {
            const int16_t *x = w->i + (first + k) * chirp + start, *y = w->q + (first + k) * chirp + start;
            energy[first + k] = correlate(x, y, u, v, w->one_re, w->one_im, RX * n);
            over_rx(w->one_re, w->row_re + k * n, n);
            over_rx(w->one_im, w->row_im + k * n, n);
        }
        interleave(w->row_re, w->spare, w->re, n, w->size);
        interleave(w->row_im, w->spare, w->im, n, w->size);
        transform(w->re, w->im, w->size, w->root_c, w->root_s);
        strongest(w->re, w->im, w->size, at);
        for (int k = 0; k < count; k++)
            product[first + k] = interpolated(w, w->re + k, w->im + k, at[k], frequency + first + k);
    }
    return centre_of_band(w, u, v);
}

/* Newton's method on the periodograms of records [part][record], `tone.refine`; frequency in cycles per sample. */
static void newton(const double *restrict re, const double *restrict im, const double *restrict t, int parts,
                   int count, int steps, double *restrict f, Complex *restrict tone, double *restrict s)
{
    double limit = TURN / (t[parts - 1] - t[0]);
    double *restrict r0 = s, *restrict i0 = s + count, *restrict r1 = s + 2 * count, *restrict i1 = s + 3 * count;
    double *restrict r2 = s + 4 * count, *restrict i2 = s + 5 * count;
    memset(f, 0, sizeof *f * count);
    for (int step = 0; step < steps; step++) {
        memset(s, 0, sizeof *s * 6 * count);
        for (int p = 0; p < parts; p++)
            for (int k = 0; k < count; k++) {
                Complex turn = step ? cis(-f[k] * t[p]) : (Complex){1, 0}; /* f is zero at first */
                double a = re[p * count + k] * turn.re - im[p * count + k] * turn.im;
                double b = re[p * count + k] * turn.im + im[p * count + k] * turn.re;
                r0[k] += a;
                i0[k] += b;
                r1[k] += t[p] * a;
                i1[k] += t[p] * b;
                r2[k] += t[p] * t[p] * a;
                i2[k] += t[p] * t[p] * b;
            }
        for (int k = 0; k < count; k++) {
            double slope = r0[k] * i1[k] - i0[k] * r1[k];
            double curvature = r1[k] * r1[k] + i1[k] * i1[k] - (r0[k] * r2[k] + i0[k] * i2[k]);
            double d = curvature < 0 ? -slope / curvature : 0;
            d = d < -limit ? -limit : d > limit ? limit : d;
            f[k] += d / TURN;
            tone[k].re = r0[k] + d * i1[k] - d * d / 2 * r2[k];
            tone[k].im = i0[k] - d * r1[k] - d * d / 2 * i2[k];
        }
    }
}

/* Extrapolate the `count` values that start at signal + s by s values to either side with the parabola through three
   values, `high_pass_filter.shifted`. */
static inline void extend(float *signal, int count, int s)
{
    float *end = signal + s + count;
    for (int j = 0; j < s; j++) {
        signal[j] = 3 * (signal[s + j] - signal[2 * s + j]) + signal[3 * s + j];
        end[j] = 3 * (end[j - s] - end[j - 2 * s]) + end[j - 3 * s];
    }
}

/* Filter a signal, extended by s values, with one or three taps at a spacing of s, and add it. */
static inline void add_filtered(const float *restrict re, const float *restrict im, const Complex *taps, int count, int s,
                                float *restrict to_re, float *restrict to_im, int values)
{
    const float *restrict re1 = re + s, *restrict re2 = re + 2 * s, *restrict im1 = im + s, *restrict im2 = im + 2 * s;
    float a = (float)taps[0].re, b = (float)taps[0].im;
    if (count == 1) {
        for (int j = 0; j < values; j++) {
            to_re[j] += a * re1[j] - b * im1[j];
            to_im[j] += a * im1[j] + b * re1[j];
        }
        return;
    }
    float c = (float)taps[1].re, d = (float)taps[1].im, e = (float)taps[2].re, f = (float)taps[2].im;
    for (int j = 0; j < values; j++) {
        to_re[j] += a * re[j] - b * im[j] + c * re1[j] - d * im1[j] + e * re2[j] - f * im2[j];
        to_im[j] += a * im[j] + b * re[j] + c * im1[j] + d * re1[j] + e * im2[j] + f * re2[j];
    }
}

/* Mix a chirp's linear samples x + j y by exp(-j 2 pi frequency (n - middle)) and average every FOLD samples, to
   [block][RX] with one spare block at either end. */
static inline void mix_and_fold(Work *w, const int16_t *restrict x, const int16_t *restrict y, double frequency,
                                float *restrict re, float *restrict im)
{
    float c[LANES], s[LANES], *restrict f = w->one_re, *restrict g = w->one_im;
    const float *restrict block_c = w->phase_c, *restrict block_s = w->phase_s;
    phases_within(frequency, 1.0 / FOLD, c, s);
    ramp(frequency, 0, FOLD, (w->n - 1) / 2.0, w->blocks, w->phase_c, w->phase_s);
    for (int m = 0; m < w->blocks; m++)
        for (int i = 0; i < LANES; i++) {
            int j = LANES * m + i;
            f[j] = x[j] * c[i] - y[j] * s[i];
            g[j] = x[j] * s[i] + y[j] * c[i];
        }
    for (int m = 0; m < w->blocks; m++)
        for (int r = 0; r < RX; r++) {
            int j = LANES * m + r;
            float a = (f[j] + f[j + RX]) + (f[j + 2 * RX] + f[j + 3 * RX]);
            float b = (g[j] + g[j + RX]) + (g[j + 2 * RX] + g[j + 3 * RX]);
            re[RX * (1 + m) + r] = a * block_c[m] - b * block_s[m];
            im[RX * (1 + m) + r] = a * block_s[m] + b * block_c[m];
        }
}

/* Add one signal to another. */
static inline void add(const float *restrict re, const float *restrict im, float *restrict to_re, float *restrict to_im,
                       int values)
{
    for (int j = 0; j < values; j++) {
        to_re[j] += re[j];
        to_im[j] += im[j];
    }
}

/* Multiply x + j y by the conjugate of u + j v; also the energy of x + j y. */
static inline void multiply(const float *restrict x, const float *restrict y, const float *restrict u,
                            const float *restrict v, float *restrict re, float *restrict im, float *restrict energy,
                            int values)
{
    for (int j = 0; j < values; j++) {
        re[j] = x[j] * u[j] + y[j] * v[j];
        im[j] = y[j] * u[j] - x[j] * v[j];
        energy[j] = x[j] * x[j] + y[j] * y[j];
    }
}

/* Second pass: the tone between each chirp, mixed down, folded and filtered, and the sum of the good others; see
   `numpy_passes.against_others`. Returns the energy of that sum. */
static float against_others(Work *w, const double *frequency, const Complex *taps, int count,
                            const uint8_t *good, double *found, Complex *tone, float *energy, double *apart_f,
                            double *apart_phase)
{
    int values = RX * w->blocks, chirps = w->chirps, all = w->parts * chirps;
    double *even_re = w->sums, *even_im = even_re + all, *odd_re = even_im + all, *odd_im = odd_re + all;
    double *rest_re = odd_im + all, *rest_im = rest_re + all, *odd_f = w->newton + 6 * chirps;
    Complex *odd_tone = (Complex *)(odd_f + chirps);
    float level = 0, *all_re = w->all_re, *all_im = w->all_im;
    memset(w->folded_re, 0, sizeof(float) * chirps * values);
    memset(w->folded_im, 0, sizeof(float) * chirps * values);
    memset(w->all_re, 0, sizeof(float) * values);
    memset(w->all_im, 0, sizeof(float) * values);
    for (int k = 0; k < chirps; k++) {
        float *re = w->folded_re + k * values, *im = w->folded_im + k * values;
        int start = RX * (k * w->samples + w->a);
        mix_and_fold(w, w->i + start, w->q + start, frequency[k], w->row_re, w->row_im);
        extend(w->row_re, values, RX);
        extend(w->row_im, values, RX);
        add_filtered(w->row_re, w->row_im, taps + k * count, count, RX, re, im, values);
        if (good[k])
            add(re, im, all_re, all_im, values);
    }
    for (int j = 0; j < values; j++)
        level += all_re[j] * all_re[j] + all_im[j] * all_im[j];
    for (int k = 0; k < chirps; k++) {
        multiply(w->folded_re + k * values, w->folded_im + k * values, all_re, all_im, w->one_re, w->one_im, w->spare,
                 values);
        energy[k] = 0;
        for (int p = 0; p < w->parts; p++) {
            float f[RX] = {0}, g[RX] = {0}, own[RX] = {0};
            for (int m = w->edges[p]; m < w->edges[p + 1]; m++)
                for (int r = 0; r < RX; r++) {
                    f[r] += w->one_re[RX * m + r];
                    g[r] += w->one_im[RX * m + r];
                    own[r] += w->spare[RX * m + r];
                }
            float part = (own[0] + own[1]) + (own[2] + own[3]);
            int j = p * chirps + k;
            even_re[j] = f[0] + f[2];
            even_im[j] = g[0] + g[2];
            odd_re[j] = f[1] + f[3];
            odd_im[j] = g[1] + g[3];
            rest_re[j] = even_re[j] + odd_re[j] - (good[k] ? part : 0);
            rest_im[j] = even_im[j] + odd_im[j];
            energy[k] += part;
        }
    }
    newton(rest_re, rest_im, w->part_times, w->parts, chirps, 2, found, tone, w->newton);
    for (int p = 0; p < w->parts; p++)
        for (int k = 0; k < chirps; k++) {
            int j = p * chirps + k;
            Complex turn = cis(-found[k] * w->part_times[p]);
            Complex even = times((Complex){even_re[j], even_im[j]}, turn);
            Complex odd = times((Complex){odd_re[j], odd_im[j]}, turn);
            even_re[j] = even.re, even_im[j] = even.im;
            odd_re[j] = odd.re, odd_im[j] = odd.im;
        }
    Complex *even_tone = odd_tone + chirps;
    newton(even_re, even_im, w->part_times, w->parts, chirps, 1, apart_f, even_tone, w->newton);
    newton(odd_re, odd_im, w->part_times, w->parts, chirps, 1, odd_f, odd_tone, w->newton);
    for (int k = 0; k < chirps; k++) {
        apart_f[k] -= odd_f[k];
        apart_phase[k] = angle(times(even_tone[k], conjugate(odd_tone[k])));
    }
    return level;
}

/* Mix a whole chirp x + j y by exp(-j 2 pi frequency (n - middle of the linear samples)). */
static inline void mix(Work *w, const int16_t *restrict x, const int16_t *restrict y, double frequency, int blocks,
                       float *restrict re, float *restrict im)
{
    float c[LANES], s[LANES];
    phases_within(frequency, 1, c, s);
    ramp(frequency, 0, FOLD, (w->a + w->b - 1) / 2.0, blocks, w->phase_c, w->phase_s);
    for (int m = 0; m < blocks; m++) {
        float u = w->phase_c[m], v = w->phase_s[m];
        for (int i = 0; i < LANES; i++) {
            int j = LANES * m + i;
            float f = u * c[i] - v * s[i], g = u * s[i] + v * c[i];
            re[j] = x[j] * f - y[j] * g;
            im[j] = x[j] * g + y[j] * f;
        }
    }
}

/* Third pass: the sum of the chirps, mixed down and filtered, and the contributions of two halves; see
   `numpy_passes.average`. mean is complex [RX][sample], halves complex [2][RX][block]. */
static void average(Work *w, const double *frequency, const Complex *weights, int count,
                    const uint8_t *good, const uint8_t *second_half, float *mean, float *halves)
{
    int values = RX * w->samples, blocks = (w->samples + FOLD - 1) / FOLD;
    memset(w->total, 0, sizeof(float) * 4 * values);
    for (int k = 0; k < w->chirps; k++) {
        float *to = w->total + 2 * values * second_half[k];
        if (!good[k])
            continue;
        mix(w, w->i + k * values, w->q + k * values, frequency[k], blocks, w->row_re + LANES, w->row_im + LANES);
        extend(w->row_re, values, LANES);
        extend(w->row_im, values, LANES);
        add_filtered(w->row_re, w->row_im, weights + k * count, count, LANES, to, to + values, values);
    }
    const float *first = w->total, *second = w->total + 2 * values;
    for (int r = 0; r < RX; r++)
        for (int n = 0; n < w->samples; n++)
            for (int part = 0; part < 2; part++) {
                int j = part * values + RX * n + r;
                mean[2 * (r * w->samples + n) + part] = first[j] + second[j];
            }
    for (int h = 0; h < 2; h++)
        for (int r = 0; r < RX; r++)
            for (int m = 0; m < w->blocks; m++)
                for (int part = 0; part < 2; part++) {
                    const float *v = w->total + (2 * h + part) * values + RX * (w->a + FOLD * m) + r;
                    float sum = (v[0] + v[RX]) + (v[2 * RX] + v[3 * RX]);
                    halves[2 * ((h * RX + r) * w->blocks + m) + part] = sum * (1.0f / FOLD);
                }
}

#endif
