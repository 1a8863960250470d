/* Passes over the words of a burst, `loops.py` in C, for one position at a time. Words are int16 [chirp][sample][2][RX].

   Chirps lie side by side, LANES to a group. So loops run over chirps that need the same operations, no sum crosses lanes
   until chirps are averaged, and words are used as they are: `counts` converts them in registers. */
#ifndef PASSES_H
#define PASSES_H

#include "signal.h"

#define PARTS 8     /* `loops._BLOCKS` */
#define TAPS 10     /* `decimate.TAPS` */
#define FLAT 9      /* `decimate.FLAT` */
#define BESIDE ((TAPS - FOLD) / 2)
#define WORDS (2 * RX) /* of a sample */

/* Sizes, tables and work arrays. */
typedef struct {
    int chirps, samples, a, n, blocks, groups; /* n linear samples from a; groups of chirps */
    int parts, edges[PARTS + 1];
    double part_times[PARTS];
    const float *taps, *flat;     /* `decimate.Decimator`: [3][TAPS], [FLAT][FLAT] */
    Table table;                  /* of the transform */
    int16_t *words;               /* [group][word][LANES] of the linear samples; a chirp stands in for missing ones */
    float *chosen;                /* words of the reference chirp */
    float *re, *im;               /* records to transform, [size][LANES] */
    float *phase_c, *phase_s, *row_re, *row_im; /* [block][LANES]; [block][RX][LANES] with a spare block at either end */
    float *folded_re, *folded_im;               /* reduced chirps, [group][block][RX][LANES] */
    float *all_re, *all_im;                     /* sum of the good chirps, [block][RX] */
    double part_energy[PARTS];                  /* of that sum */
    double sums[6 * PARTS * MOST], odd_frequency[MOST]; /* [6][part][chirp]; [chirp] */
    Complex even_tone[MOST], odd_tone[MOST];
} Work;

/* Put the words of a group's chirps side by side. */
static inline void side_by_side(const int16_t *const chirp[LANES], int count, int16_t *restrict out)
{
    enum { TILE = 128 }; /* stays in the first cache */
    typedef uint64_t Four __attribute__((may_alias)); /* words, of four chirps */
    int16_t fours[4][4 * TILE] __attribute__((aligned(64)));
    for (int first = 0; first < count; first += TILE) {
        int here = count - first < TILE ? count - first : TILE;
        for (int g = 0; g < 4; g++)
            for (int i = 0; i < here; i++)
                for (int k = 0; k < 4; k++)
                    fours[g][4 * i + k] = chirp[4 * g + k][first + i];
        const Four *four[4] = {(Four *)fours[0], (Four *)fours[1], (Four *)fours[2], (Four *)fours[3]};
        Four *restrict to = (Four *)(out + LANES * first);
        for (int i = 0; i < here; i++)
            for (int k = 0; k < 4; k++)
                to[4 * i + k] = four[k][i];
    }
}

/* Chirps of a group times the conjugate of the reference chirp, summed over the RX, to [sample][LANES]; and their
   energies. */
static inline void correlate(const int16_t *words, const float *chosen, int samples, float *re, float *im, float *energy)
{
    for (int part = 0; part < LANES; part += STEP) {
        Vector e = {0};
        for (int n = 0; n < samples; n++) {
            Vector a = {0}, b = {0}, own = {0};
            for (int r = 0; r < RX; r++) {
                const int i = WORDS * n + r, q = i + RX;
                Vector x = counts(words + LANES * i + part), y = counts(words + LANES * q + part);
                a = add_product(add_product(a, x, all(chosen[i])), y, all(chosen[q]));
                b = add_product(add_product(b, y, all(chosen[i])), x, -all(chosen[q]));
                own = add_product(add_product(own, x, x), y, y);
            }
            e += own;
            store(re + LANES * n + part, a);
            store(im + LANES * n + part, b);
        }
        store(energy + part, e);
    }
}

/* Place of the maximum between three values, relative to the middle one, by a parabola. */
static inline double peak_between(double below, double middle, double above)
{
    double bend = below - 2 * middle + above;
    return bend < 0 ? 0.5 * (below - above) / bend : 0;
}

/* `loops.strongest`: the tone at an index of a spectrum; frequency in cycles per sample. */
static inline Complex interpolated(const Work *w, const float *re, const float *im, int at, double *frequency)
{
    const int size = w->table.size, top = w->table.bin[at];
    Complex peak = value_at(re, im, at);
    double below = sqrt(power_at(&w->table, re, im, top - 1)), above = sqrt(power_at(&w->table, re, im, top + 1));
    double whole = (double)(top < size / 2 ? top : top - size) / size;
    *frequency = whole + peak_between(below, magnitude(peak), above) / size;
    return times(peak, cis(whole * (w->n - 1) / 2));
}

/* `loops.find_band`: middle of the band of a chirp of words, cycles per sample 0..1. The sixteen records are the quarters of
   the chirp, of each RX; the spectra are summed in memory that other passes use for rows. */
static double centre_of_band(Work *w, const int16_t *chirp)
{
    const int size = w->table.size / 4, samples = w->n / 4;
    for (int m = 0; m < samples; m++)
        for (int quarter = 0; quarter < 4; quarter++)
            for (int r = 0; r < RX; r++) {
                const int16_t *word = chirp + WORDS * (samples * quarter + m) + r;
                w->re[LANES * m + RX * quarter + r] = word[0];
                w->im[LANES * m + RX * quarter + r] = word[RX];
            }
    transform(w->re, w->im, samples, size, &w->table);
    float *power = w->row_re, *smooth = w->row_im;
    for (int i = 0; i < size; i++) {
        float sum = 0;
        for (int k = 0; k < LANES; k++)
            sum += w->re[LANES * i + k] * w->re[LANES * i + k] + w->im[LANES * i + k] * w->im[LANES * i + k];
        power[w->table.bin[i] / 4] = sum;
    }
    int top = 0;
    for (int i = 0; i < size; i++) {
        smooth[i] = power[(i + size - 1) % size] + 2 * power[i] + power[(i + 1) % size];
        top = smooth[i] > smooth[top] ? i : top;
    }
    double centre = (top + peak_between(smooth[(top + size - 1) % size], smooth[top], smooth[(top + 1) % size])) / size;
    return centre - floor(centre);
}

/* First pass: the tone between each chirp and a reference chirp; see `loops.match`. Returns the middle of the band. */
static double match(Work *w, const int16_t *burst, int reference, double *frequency, Complex *product, float *energy)
{
    const int16_t *chosen = burst + WORDS * ((size_t)reference * w->samples + w->a);
    for (int i = 0; i < WORDS * w->n; i++)
        w->chosen[i] = chosen[i];
    for (int first = 0; first < w->chirps; first += LANES) {
        int32_t at[LANES];
        correlate(w->words + (size_t)first * WORDS * w->n, w->chosen, w->n, w->re, w->im, energy + first);
        transform(w->re, w->im, w->n, w->table.size, &w->table);
        strongest(w->re, w->im, w->table.size, at);
        for (int k = 0; k < LANES; k++)
            product[first + k] = interpolated(w, w->re + k, w->im + k, at[k], frequency + first + k);
    }
    return centre_of_band(w, chosen);
}

/* exp(-j 2 pi (frequency (origin + step m) + turns)) for m < count and the chirps of a group, [m][LANES]: each is the one
   before times a constant. */
static inline void ramps(const double *restrict frequency, const double *restrict turns, double origin, double step,
                         int count, float *restrict c, float *restrict s)
{
    double re[LANES], im[LANES], turn_re[LANES], turn_im[LANES];
    VECTOR
    for (int k = 0; k < LANES; k++) {
        Complex start = cis(-frequency[k] * origin - turns[k]), turn = cis(-frequency[k] * step);
        re[k] = start.re, im[k] = start.im, turn_re[k] = turn.re, turn_im[k] = turn.im;
    }
    for (int m = 0; m < count; m++) {
        VECTOR
        for (int k = 0; k < LANES; k++) {
            double x = re[k], y = im[k];
            c[LANES * m + k] = (float)x;
            s[LANES * m + k] = (float)y;
            re[k] = x * turn_re[k] - y * turn_im[k];
            im[k] = x * turn_im[k] + y * turn_re[k];
        }
    }
}

/* Extrapolate the `count` values that start at signal + s by s values to either side, with the parabola through three
   values at distance s, as `high_pass_filter.apply_filter` does. */
static inline void extend(float *signal, int count, int s)
{
    float *end = signal + s + count;
    for (int j = 0; j < s; j++) {
        signal[j] = 3 * (signal[s + j] - signal[2 * s + j]) + signal[3 * s + j];
        end[j] = 3 * (end[j - s] - end[j - 2 * s]) + end[j - 3 * s];
    }
}

/* Mix the chirps of a group by exp(-j 2 pi frequency (n - middle)) and decimate them, `decimate.fold`, to
   [block][RX][LANES]. */
static inline void mix_and_fold(Work *w, const int16_t *words, const double *frequency, float *re, float *im)
{
    static const double none[LANES];
    float turn_c[TAPS * LANES], turn_s[TAPS * LANES], all_c[3][TAPS * LANES], all_s[3][TAPS * LANES];
    ramps(frequency, none, (FOLD - w->n) / 2.0, FOLD, w->blocks, w->phase_c, w->phase_s);
    ramps(frequency, none, -(TAPS - 1) / 2.0, 1, TAPS, turn_c, turn_s);
    for (int set = 0; set < 3; set++)
        for (int i = 0; i < TAPS * LANES; i++) {
            all_c[set][i] = turn_c[i] * w->taps[TAPS * set + i / LANES];
            all_s[set][i] = turn_s[i] * w->taps[TAPS * set + i / LANES];
        }
    for (int m = 0; m < w->blocks; m++) {
        const int last = m == w->blocks - 1, from = m == 0 ? BESIDE : 0, to = last ? TAPS - BESIDE : TAPS;
        const float *c = all_c[m == 0 ? 0 : last ? 2 : 1], *s = all_s[m == 0 ? 0 : last ? 2 : 1];
        for (int part = 0; part < LANES; part += STEP) {
            Vector x[RX] = {{0}}, y[RX] = {{0}}, u = load(w->phase_c + LANES * m + part), v = load(w->phase_s + LANES * m + part);
            for (int q = from; q < to; q++) {
                const int16_t *sample = words + LANES * WORDS * (FOLD * m - BESIDE + q) + part;
                Vector f = load(c + LANES * q + part), g = load(s + LANES * q + part);
                for (int r = 0; r < RX; r++) {
                    Vector i = counts(sample + LANES * r), j = counts(sample + LANES * (RX + r));
                    x[r] = add_product(add_product(x[r], i, f), j, -g);
                    y[r] = add_product(add_product(y[r], i, g), j, f);
                }
            }
            for (int r = 0; r < RX; r++) {
                store(re + LANES * (RX * m + r) + part, x[r] * u - y[r] * v);
                store(im + LANES * (RX * m + r) + part, x[r] * v + y[r] * u);
            }
        }
    }
}

/* Filter with three taps for each chirp, one block apart, `high_pass_filter.apply_filter`; the signal has a spare block at
   either end. */
static inline void equalise(const float *re, const float *im, const Complex *taps, int values, float *to_re, float *to_im)
{
    float f[3][LANES], g[3][LANES];
    for (int t = 0; t < 3; t++)
        for (int k = 0; k < LANES; k++) {
            f[t][k] = (float)taps[3 * k + t].re;
            g[t][k] = (float)taps[3 * k + t].im;
        }
    for (int part = 0; part < LANES; part += STEP)
        for (int i = 0; i < values; i++) {
            Vector a = {0}, b = {0};
            for (int t = 0; t < 3; t++) {
                Vector x = load(re + LANES * (i + RX * t) + part), y = load(im + LANES * (i + RX * t) + part);
                Vector u = load(f[t] + part), v = load(g[t] + part);
                a = add_product(add_product(a, x, u), y, -v);
                b = add_product(add_product(b, x, v), y, u);
            }
            store(to_re + LANES * i + part, a);
            store(to_im + LANES * i + part, b);
        }
}

/* Reduce all chirps: mix down, decimate, filter; see `loops.reduce_chirps`. frequency and taps are padded to groups. */
static void reduce(Work *w, const double *frequency, const Complex *taps)
{
    int values = RX * w->blocks;
    for (int g = 0; g < w->groups; g++) {
        size_t first = (size_t)g * LANES;
        mix_and_fold(w, w->words + first * WORDS * w->n, frequency + first, w->row_re + LANES * RX, w->row_im + LANES * RX);
        extend(w->row_re, LANES * values, LANES * RX);
        extend(w->row_im, LANES * values, LANES * RX);
        equalise(w->row_re, w->row_im, taps + 3 * first, values, w->folded_re + first * values, w->folded_im + first * values);
    }
}

/* Correlate the chirps of a group with the sum of all: over the values [from, to), of even and odd RX apart, and the
   energy of the chirps. */
static inline void correlate_part(const float *re, const float *im, const float *all_re, const float *all_im, int from,
                                  int to, float sums[5][LANES])
{
    for (int part = 0; part < LANES; part += STEP) {
        Vector a = {0}, b = {0}, c = {0}, d = {0}, e = {0};
        for (int j = from; j < to; j += 2) {
            Vector x = load(re + LANES * j + part), y = load(im + LANES * j + part);
            Vector u = load(re + LANES * (j + 1) + part), v = load(im + LANES * (j + 1) + part);
            a += x * all_re[j] + y * all_im[j];
            b += y * all_re[j] - x * all_im[j];
            c += u * all_re[j + 1] + v * all_im[j + 1];
            d += v * all_re[j + 1] - u * all_im[j + 1];
            e += (x * x + y * y) + (u * u + v * v);
        }
        store(sums[0] + part, a), store(sums[1] + part, b), store(sums[2] + part, c), store(sums[3] + part, d);
        store(sums[4] + part, e);
    }
}

/* Second pass: the tone between each reduced chirp and the sum of the good others, and what that sum does not explain of
   its energy in each part of the chirp, left [part][chirp]; see `loops.against_others`. apart_f and apart_phase: tone of
   the even RX minus that of the odd ones. Returns the energy of the sum. */
static double against_others(Work *w, const uint8_t *good, double *frequency, Complex *tone, float *energy,
                             double *apart_f, double *apart_phase, double *left)
{
    int values = RX * w->blocks, chirps = w->chirps, all = w->parts * chirps;
    double *even_re = w->sums, *even_im = even_re + all, *odd_re = even_im + all, *odd_im = odd_re + all;
    double *rest_re = odd_im + all, *rest_im = rest_re + all, level = 0;
    static const double at_zero[MOST];
    float used[MOST];
    for (int k = 0; k < LANES * w->groups; k++)
        used[k] = k < chirps && good[k];
    memset(w->all_re, 0, sizeof(float) * values);
    memset(w->all_im, 0, sizeof(float) * values);
    for (int first = 0; first < chirps; first += LANES)
        for (int i = 0; i < values; i++) {
            const size_t at = (size_t)first * values + LANES * i;
            Vector x = {0}, y = {0};
            for (int part = 0; part < LANES; part += STEP) {
                x += load(w->folded_re + at + part) * load(used + first + part);
                y += load(w->folded_im + at + part) * load(used + first + part);
            }
            w->all_re[i] += total(x);
            w->all_im[i] += total(y);
        }
    memset(energy, 0, sizeof *energy * chirps);
    for (int p = 0; p < w->parts; p++) {
        int from = RX * w->edges[p], to = RX * w->edges[p + 1];
        float sums[5][LANES], whole = 0;
        for (int i = from; i < to; i++)
            whole += w->all_re[i] * w->all_re[i] + w->all_im[i] * w->all_im[i];
        w->part_energy[p] = whole;
        level += whole;
        for (int first = 0; first < chirps; first += LANES) {
            int count = chirps - first < LANES ? chirps - first : LANES, j = p * chirps + first;
            size_t group = (size_t)first * values;
            correlate_part(w->folded_re + group, w->folded_im + group, w->all_re, w->all_im, from, to, sums);
            VECTOR
            for (int k = 0; k < count; k++) {
                double a = sums[0][k], b = sums[1][k], c = sums[2][k], d = sums[3][k], own = sums[4][k];
                double re = a + c - used[first + k] * own, im = b + d;
                double others = whole - used[first + k] * (2 * (a + c) - own);
                even_re[j + k] = a, even_im[j + k] = b, odd_re[j + k] = c, odd_im[j + k] = d;
                rest_re[j + k] = re, rest_im[j + k] = im;
                left[j + k] = own - (others > 1e-30 ? (re * re + im * im) / others : own);
                energy[first + k] += sums[4][k];
            }
        }
    }
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, at_zero, frequency, tone);
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, frequency, frequency, tone);
    newton_step(even_re, even_im, w->part_times, w->parts, chirps, frequency, apart_f, w->even_tone);
    newton_step(odd_re, odd_im, w->part_times, w->parts, chirps, frequency, w->odd_frequency, w->odd_tone);
    VECTOR
    for (int k = 0; k < chirps; k++) {
        apart_f[k] -= w->odd_frequency[k];
        apart_phase[k] = angle(times(w->even_tone[k], conjugate(w->odd_tone[k])));
    }
    return level;
}

/* Undo the attenuation by the decimation in complex averages [block], `decimate.flatten`. */
static inline void flatten(const float *flat, const float *restrict in, int blocks, float *restrict out)
{
    const int edge = FLAT / 2;
    const float *inner = flat + FLAT * edge;
    memcpy(out, in, sizeof *in * 2 * blocks);
    if (blocks < FLAT)
        return;
    for (int row = 0; row < FLAT; row++) { /* blocks near the ends */
        const int first = row < edge ? 0 : blocks - FLAT;
        for (int part = 0; part < 2; part++) {
            float sum = 0;
            for (int t = 0; t < FLAT; t++)
                sum += flat[FLAT * row + t] * in[2 * (first + t) + part];
            out[2 * (first + row) + part] = sum;
        }
    }
    for (int i = 2 * edge; i < 2 * (blocks - edge); i++) {
        const float *x = in + i - 2 * edge;
        float sum = inner[edge] * x[2 * edge];
        for (int t = 0; t < edge; t++)
            sum += inner[t] * (x[2 * t] + x[2 * (FLAT - 1 - t)]);
        out[i] = sum;
    }
}

/* Third pass: the sum of the reduced chirps, turned by frequency and turns, in two halves with the weights first and
   second of each chirp (all padded to groups), flat; see `loops.average`. halves is complex [2][RX][block]. */
static void average(Work *w, const double *frequency, const double *turns, const float *first, const float *second,
                    float *halves)
{
    int values = RX * w->blocks, blocks = w->blocks;
    float *sums = w->row_re; /* complex [2][RX][block] */
    memset(sums, 0, sizeof *sums * 4 * values);
    for (int g = 0; g < w->groups; g++) {
        size_t from = (size_t)g * LANES;
        ramps(frequency + from, turns + from, FOLD * (1 - blocks) / 2.0, FOLD, blocks, w->phase_c, w->phase_s);
        for (int i = 0; i < values; i++) {
            const float *c = w->phase_c + LANES * (i / RX), *s = w->phase_s + LANES * (i / RX);
            const float *re = w->folded_re + (from * values + LANES * (size_t)i), *im = w->folded_im + (from * values + LANES * (size_t)i);
            float a = 0, b = 0, d = 0, e = 0, *to = sums + 2 * (i % RX * blocks + i / RX);
            for (int k = 0; k < LANES; k++) {
                float x = re[k] * c[k] - im[k] * s[k], y = re[k] * s[k] + im[k] * c[k];
                a += x * first[from + k];
                b += y * first[from + k];
                d += x * second[from + k];
                e += y * second[from + k];
            }
            to[0] += a, to[1] += b, to[2 * values] += d, to[2 * values + 1] += e;
        }
    }
    for (int i = 0; i < 2 * RX; i++)
        flatten(w->flat, sums + 2 * i * blocks, blocks, halves + 2 * i * blocks);
}

#endif
