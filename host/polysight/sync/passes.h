/* Three passes over the words of a burst, `loops.py` in C, for one position at a time. Words are int16
   [chirp][sample][2][RX]; x + j y are the samples of a chirp, in the order described in `signal.h`. */
#ifndef PASSES_H
#define PASSES_H

#include "signal.h"

#define BAND_BINS 9 /* `loops.BAND_BINS` */
#define PARTS 8     /* `loops._BLOCKS` */

/* Sizes, tables and work arrays. */
typedef struct {
    int chirps, samples, a, b; /* linear samples [a, b) */
    int n, blocks, size;       /* number of linear samples, of blocks; size of the transform */
    int parts, edges[PARTS + 1];
    double part_times[PARTS];
    float *i, *q; /* I and Q of the burst: [chirp][sample][RX] each */
    float *root_c, *root_s, *phase_c, *phase_s;
    float *turn_c, *turn_s; /* twiddle factors of `spectrum` */
    float *one_re, *one_im, *row_re, *row_im, *re, *im; /* one chirp; sixteen records in sequence; sixteen interleaved */
    float *spare, *folded_re, *folded_im, *all_re, *all_im, *total;
    double *power, *smooth, *sums, *tones;
    int *bin, *place;
} Work;

/* A number of chirps, rounded up to whole groups of LANES. */
static inline size_t whole_lanes(int chirps) { return (size_t)(chirps + LANES - 1) / LANES * LANES; }

/* Multiply a chirp i + j q by the conjugate of k + j l for every RX; return the energy of the chirp. */
static inline float correlate(const float *restrict i, const float *restrict q, const float *restrict k,
                              const float *restrict l, float *restrict re, float *restrict im, int count)
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

/* `loops.strongest`: the tone at the strongest bin of a spectrum; frequency in cycles per sample. */
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

/* Power of a chirp x + j y, summed over the RX, in every bin. Sixteen records, every fourth sample of each RX, are
   transformed; a butterfly joins the four records of an RX. */
static void spectrum(Work *w, const float *restrict x, const float *restrict y)
{
    int quarter = w->size / FOLD, blocks = w->n / FOLD;
    for (int i = 0; i < LANES * blocks; i++) {
        w->re[i] = x[i];
        w->im[i] = y[i];
    }
    memset(w->re + LANES * blocks, 0, sizeof *w->re * LANES * (quarter - blocks));
    memset(w->im + LANES * blocks, 0, sizeof *w->im * LANES * (quarter - blocks));
    transform(w->re, w->im, quarter, w->root_c, w->root_s, w->size);
    for (int i = 0; i < quarter; i++) {
        int bin = w->bin[i] / FOLD;
        const float *re = w->re + LANES * i, *im = w->im + LANES * i;
        const float *c = w->turn_c + LANES * i, *s = w->turn_s + LANES * i;
        float a[LANES], b[LANES], power[FOLD][RX];
        for (int k = 0; k < LANES; k++) {
            a[k] = re[k] * c[k] - im[k] * s[k];
            b[k] = re[k] * s[k] + im[k] * c[k];
        }
        for (int r = 0; r < RX; r++) {
            const float *u = a + r, *v = b + r;
            float c = u[0] + u[8], d = v[0] + v[8], e = u[0] - u[8], f = v[0] - v[8];
            float g = u[4] + u[12], h = v[4] + v[12], k = u[4] - u[12], l = v[4] - v[12];
            power[0][r] = (c + g) * (c + g) + (d + h) * (d + h);
            power[1][r] = (e + l) * (e + l) + (f - k) * (f - k);
            power[2][r] = (c - g) * (c - g) + (d - h) * (d - h);
            power[3][r] = (e - l) * (e - l) + (f + k) * (f + k);
        }
        for (int q = 0; q < FOLD; q++)
            w->power[bin + q * quarter] = (power[q][0] + power[q][1]) + (power[q][2] + power[q][3]);
    }
}

/* Middle of the signal's band in linear samples x + j y, cycles per sample 0..1. */
static double centre_of_band(Work *w, const float *restrict x, const float *restrict y)
{
    int size = w->size, width = BAND_BINS * size / w->n / 2;
    spectrum(w, x, y);
    for (int box = 0; box < 3; box++) { /* three box filters are nearly Gaussian */
        double *other = w->smooth;
        for (int i = 0; i < width; i++)
            w->power[size + i] = w->power[i];
        memset(other, 0, sizeof *other * size);
        for (int j = 0; j < width; j++)
            for (int i = 0; i < size; i++)
                other[i] += w->power[i + j]; /* sum of the box that starts here */
        w->smooth = w->power;
        w->power = other;
    }
    return (double)((maximum(w->power, size) + 3 * (width / 2)) % size) / size;
}

/* First pass: the tone between each chirp and a reference chirp; see `loops.match`. Returns the centre. */
static double match(Work *w, int reference, double *frequency, Complex *product, float *energy)
{
    int n = w->n, chirp = RX * w->samples, start = RX * w->a;
    const float *u = w->i + reference * chirp + start, *v = w->q + reference * chirp + start;
    for (int first = 0; first < w->chirps; first += LANES) {
        int count = w->chirps - first < LANES ? w->chirps - first : LANES;
        int32_t at[LANES];
        memset(w->row_re + count * n, 0, sizeof(float) * (LANES - count) * n);
        memset(w->row_im + count * n, 0, sizeof(float) * (LANES - count) * n);
        for (int k = 0; k < count; k++) {
            const float *x = w->i + (first + k) * chirp + start, *y = w->q + (first + k) * chirp + start;
            energy[first + k] = correlate(x, y, u, v, w->one_re, w->one_im, RX * n);
            over_rx(w->one_re, w->row_re + k * n, n);
            over_rx(w->one_im, w->row_im + k * n, n);
        }
        interleave(w->row_re, w->spare, w->re, n, w->size);
        interleave(w->row_im, w->spare, w->im, n, w->size);
        transform(w->re, w->im, w->size, w->root_c, w->root_s, w->size);
        strongest(w->re, w->im, w->size, at);
        for (int k = 0; k < count; k++)
            product[first + k] = interpolated(w, w->re + k, w->im + k, at[k], frequency + first + k);
    }
    return centre_of_band(w, u, v);
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
static inline void mix_and_fold(Work *w, const float *restrict x, const float *restrict y, double frequency,
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

/* Correlate sixteen records re + j im [value][LANES] with another: sums over the values [from, to), of even and odd RX
   apart, and the energy of the records. */
static inline void correlate_part(const float *restrict re, const float *restrict im, const float *restrict all_re,
                                  const float *restrict all_im, int from, int to, float sums[5][LANES])
{
    memset(sums, 0, sizeof *sums * 5);
    for (int j = from; j < to; j += 2)
        for (int k = 0; k < LANES; k++) {
            float x = re[LANES * j + k], y = im[LANES * j + k];
            float u = re[LANES * (j + 1) + k], v = im[LANES * (j + 1) + k];
            sums[0][k] += x * all_re[j] + y * all_im[j];
            sums[1][k] += y * all_re[j] - x * all_im[j];
            sums[2][k] += u * all_re[j + 1] + v * all_im[j + 1];
            sums[3][k] += v * all_re[j + 1] - u * all_im[j + 1];
            sums[4][k] += (x * x + y * y) + (u * u + v * v);
        }
}

/* Second pass: the tone between each chirp, mixed down, folded and filtered, and the sum of the good others; see
   `loops.against_others`. Returns the energy of that sum. */
static float against_others(Work *w, const double *frequency, const Complex *taps, int count,
                            const uint8_t *good, double *found, Complex *tone, float *energy, double *apart_f,
                            double *apart_phase)
{
    int values = RX * w->blocks, chirps = w->chirps, all = w->parts * chirps;
    double *even_re = w->sums, *even_im = even_re + all, *odd_re = even_im + all, *odd_im = odd_re + all;
    double *rest_re = odd_im + all, *rest_im = rest_re + all, *odd_f = w->tones;
    Complex *odd_tone = (Complex *)(odd_f + chirps);
    float level = 0, *all_re = w->all_re, *all_im = w->all_im;
    memset(w->folded_re, 0, sizeof(float) * whole_lanes(chirps) * values);
    memset(w->folded_im, 0, sizeof(float) * whole_lanes(chirps) * values);
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
    memset(energy, 0, sizeof *energy * chirps);
    for (int first = 0; first < chirps; first += LANES) {
        int here = chirps - first < LANES ? chirps - first : LANES;
        float sums[5][LANES];
        interleave(w->folded_re + first * values, w->spare, w->re, values, values);
        interleave(w->folded_im + first * values, w->spare, w->im, values, values);
        for (int p = 0; p < w->parts; p++) {
            correlate_part(w->re, w->im, all_re, all_im, RX * w->edges[p], RX * w->edges[p + 1], sums);
            for (int i = 0; i < here; i++) {
                int k = first + i, j = p * chirps + k;
                even_re[j] = sums[0][i];
                even_im[j] = sums[1][i];
                odd_re[j] = sums[2][i];
                odd_im[j] = sums[3][i];
                rest_re[j] = even_re[j] + odd_re[j] - (good[k] ? sums[4][i] : 0);
                rest_im[j] = even_im[j] + odd_im[j];
                energy[k] += sums[4][i];
            }
        }
    }
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, 1, found, tone);
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, 0, found, tone);
    for (int p = 0; p < w->parts; p++)
        turn_back(found, w->part_times[p], chirps, even_re + p * chirps, even_im + p * chirps, odd_re + p * chirps,
                  odd_im + p * chirps);
    Complex *even_tone = odd_tone + chirps;
    newton_step(even_re, even_im, w->part_times, w->parts, chirps, 1, apart_f, even_tone);
    newton_step(odd_re, odd_im, w->part_times, w->parts, chirps, 1, odd_f, odd_tone);
    for (int k = 0; k < chirps; k++) {
        apart_f[k] -= odd_f[k];
        apart_phase[k] = angle(times(even_tone[k], conjugate(odd_tone[k])));
    }
    return level;
}

/* Mix a whole chirp x + j y by exp(-j 2 pi frequency (n - middle of the linear samples)). */
static inline void mix(Work *w, const float *restrict x, const float *restrict y, double frequency, int blocks,
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
   `loops.average`. mean is complex [RX][sample], halves complex [2][RX][block]. */
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
    for (int j = 0; j < values; j++) {
        w->row_re[j] = w->total[j] + w->total[2 * values + j];
        w->row_im[j] = w->total[values + j] + w->total[3 * values + j];
    }
    by_rx(w->row_re, w->row_im, w->samples, mean, mean + 2 * w->samples, mean + 4 * w->samples, mean + 6 * w->samples);
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
