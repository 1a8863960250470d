/* Passes over the words of a burst, `loops.py` in C, for one position at a time. Words are int16 [chirp][sample][2][RX].

   Chirps lie side by side, LANES to a group: value LANES i + k of a group is value i of its chirp k. So all loops run over
   chirps that need the same operations, no sum crosses lanes until chirps are averaged, and words are used as they are:
   `counts` converts them in registers. */
#ifndef PASSES_H
#define PASSES_H

#include "signal.h"

#define BAND_BINS 9 /* `loops.BAND_BINS` */
#define PARTS 8     /* `loops._BLOCKS` */
#define TAPS 8      /* `decimate.TAPS` */
#define FLAT 7      /* `decimate.FLAT` */
#define BESIDE ((TAPS - FOLD) / 2)
#define WORDS (2 * RX) /* of a sample */

/* As many floats as the processor handles at once: a part of LANES. Compilers do well with these vectors, except for the
   conversion of words, and sums of products, which `-fassociative-math` takes apart. */
#define STEP (WIDTH / 32)
typedef float Vector __attribute__((vector_size(WIDTH / 8), aligned(4), may_alias));
typedef int32_t Whole __attribute__((vector_size(WIDTH / 8)));
#if WIDTH == 512
#include <immintrin.h>
static inline Vector counts(const int16_t *words)
{
    return _mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(_mm256_loadu_si256((const __m256i *)words)));
}
static inline Vector add_product(Vector sum, Vector a, Vector b) { return _mm512_fmadd_ps(a, b, sum); }
#elif WIDTH == 256
#include <immintrin.h>
static inline Vector counts(const int16_t *words)
{
    return _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm_loadu_si128((const __m128i *)words)));
}
static inline Vector add_product(Vector sum, Vector a, Vector b) { return _mm256_fmadd_ps(a, b, sum); }
#elif defined(__aarch64__)
#include <arm_neon.h>
static inline Vector counts(const int16_t *words) { return vcvtq_f32_s32(vmovl_s16(vld1_s16(words))); }
static inline Vector add_product(Vector sum, Vector a, Vector b) { return vfmaq_f32(sum, a, b); }
#else
static inline Vector counts(const int16_t *words) { return (Vector){words[0], words[1], words[2], words[3]}; }
static inline Vector add_product(Vector sum, Vector a, Vector b) { return sum + a * b; }
#endif
static inline Vector load(const float *at) { return *(const Vector *)at; }
static inline void store(float *at, Vector x) { *(Vector *)at = x; }
static inline Vector all(float x) { return x - (Vector){0}; }

/* Sizes, tables and work arrays. */
typedef struct {
    int chirps, samples, a, n, blocks, size, groups; /* n linear samples from a; size of the transform; groups of chirps */
    int parts, edges[PARTS + 1];
    double part_times[PARTS];
    const float *taps, *flat; /* `decimate.Decimator`: [3][TAPS], [4][FLAT] */
    int16_t *words, *silence;     /* [group][word][LANES] of the linear samples; a chirp of zeros */
    float *root_c, *root_s, *turn_c, *turn_s; /* `transform`; twiddle factors of `spectrum` */
    float *same, *turned;                     /* the reference chirp: its words, and those of -j times it */
    float *re, *im;                           /* records to transform [size][LANES] */
    float *phase_c, *phase_s, *row_re, *row_im; /* [block][LANES]; [block][RX][LANES] with a spare block at either end */
    float *folded_re, *folded_im;               /* reduced chirps, [group][block][RX][LANES] */
    float *all_re, *all_im;                     /* sum of the good chirps, [block][RX] */
    double *power, *smooth, *sums, *tones;
    double part_energy[PARTS]; /* of that sum */
    int *bin, *place;
} Work;

/* A number of chirps, rounded up to whole groups. */
static inline size_t whole_lanes(int chirps) { return (size_t)(chirps + LANES - 1) / LANES * LANES; }

/* Interleave four records of words. */
static inline void words_in_turn(const int16_t *const *record, int count, int16_t *restrict out)
{
    const int16_t *a = record[0], *b = record[1], *c = record[2], *d = record[3];
    for (int i = 0; i < count; i++) {
        out[4 * i] = a[i];
        out[4 * i + 1] = b[i];
        out[4 * i + 2] = c[i];
        out[4 * i + 3] = d[i];
    }
}

/* Put the words of a group's chirps side by side. */
static inline void side_by_side(const int16_t *const chirp[LANES], int count, int16_t *restrict out)
{
    enum { TILE = 128 }; /* stays in the first cache */
    typedef uint64_t Four __attribute__((may_alias)); /* words, of four chirps */
    int16_t fours[4][4 * TILE] __attribute__((aligned(64)));
    for (int first = 0; first < count; first += TILE) {
        int here = count - first < TILE ? count - first : TILE;
        for (int g = 0; g < 4; g++) {
            const int16_t *const record[4] = {chirp[4 * g] + first, chirp[4 * g + 1] + first, chirp[4 * g + 2] + first,
                                              chirp[4 * g + 3] + first};
            words_in_turn(record, here, fours[g]);
        }
        const Four *a = (Four *)fours[0], *b = (Four *)fours[1], *c = (Four *)fours[2], *d = (Four *)fours[3];
        Four *restrict to = (Four *)(out + LANES * first);
        for (int i = 0; i < here; i++) {
            to[4 * i] = a[i];
            to[4 * i + 1] = b[i];
            to[4 * i + 2] = c[i];
            to[4 * i + 3] = d[i];
        }
    }
}

/* Chirps times the conjugate of the reference chirp, summed over the RX, to [sample][LANES]; and their energies. */
static inline void correlate(const int16_t *words, const float *same, const float *turned, int samples, float *re,
                             float *im, float *energy)
{
    for (int part = 0; part < LANES; part += STEP) {
        Vector e = {0};
        for (int n = 0; n < samples; n++) {
            Vector a = {0}, b = {0}, own = {0};
            for (int j = 0; j < WORDS; j++) {
                Vector x = counts(words + LANES * (WORDS * n + j) + part);
                a = add_product(a, x, all(same[WORDS * n + j]));
                b = add_product(b, x, all(turned[WORDS * n + j]));
                own = add_product(own, x, x);
            }
            e += own;
            store(re + LANES * n + part, a);
            store(im + LANES * n + part, b);
        }
        store(energy + part, e);
    }
}

/* Index of the strongest bin of each of sixteen spectra. */
static inline void strongest(const float *re, const float *im, int size, int32_t *at)
{
    for (int part = 0; part < LANES; part += STEP) {
        Vector best = all(-1);
        Whole place = {0};
        for (int i = 0; i < size; i++) {
            Vector x = load(re + LANES * i + part), y = load(im + LANES * i + part), power = x * x + y * y;
            Whole higher = power > best;
            best = (Vector)(((Whole)power & higher) | ((Whole)best & ~higher));
            place = (i & higher) | (place & ~higher);
        }
        memcpy(at + part, &place, sizeof place);
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

/* First pass: the tone between each chirp and a reference chirp; see `loops.match`. Returns the middle of the band. */
static double match(Work *w, const int16_t *burst, int reference, double *frequency, Complex *product, float *energy)
{
    const int16_t *chosen = burst + WORDS * ((size_t)reference * w->samples + w->a);
    for (int n = 0; n < w->n; n++)
        for (int r = 0; r < RX; r++) {
            float i = chosen[WORDS * n + r], q = chosen[WORDS * n + RX + r];
            w->same[WORDS * n + r] = i, w->same[WORDS * n + RX + r] = q;
            w->turned[WORDS * n + r] = -q, w->turned[WORDS * n + RX + r] = i;
        }
    for (int g = 0; g < w->groups; g++) {
        int first = g * LANES, count = w->chirps - first < LANES ? w->chirps - first : LANES;
        int32_t at[LANES];
        correlate(w->words + (size_t)first * WORDS * w->n, w->same, w->turned, w->n, w->re, w->im, energy + first);
        memset(w->re + LANES * w->n, 0, sizeof(float) * LANES * (w->size - w->n));
        memset(w->im + LANES * w->n, 0, sizeof(float) * LANES * (w->size - w->n));
        transform(w->re, w->im, w->size, w->root_c, w->root_s, w->size);
        strongest(w->re, w->im, w->size, at);
        for (int k = 0; k < count; k++)
            product[first + k] = interpolated(w, w->re + k, w->im + k, at[k], frequency + first + k);
    }
    part_iq(chosen, w->n, w->row_re, w->row_im);
    return centre_of_band(w, w->row_re, w->row_im);
}

/* exp(-j 2 pi (frequency (origin + step m) + turns)) for m < count and the chirps of a group, [m][LANES]; outer products
   of coarse and fine steps. */
static inline void ramps(const double *restrict frequency, const double *restrict turns, double origin, double step,
                         int count, float *restrict c, float *restrict s)
{
    enum { FINE = 8 };
    float fine_c[FINE][LANES], fine_s[FINE][LANES], coarse_c[LANES], coarse_s[LANES];
    for (int m = 0; m < FINE; m++) {
        VECTOR
        for (int k = 0; k < LANES; k++) {
            Complex z = cis(-frequency[k] * (step * m));
            fine_c[m][k] = (float)z.re;
            fine_s[m][k] = (float)z.im;
        }
    }
    for (int first = 0; first < count; first += FINE) {
        VECTOR
        for (int k = 0; k < LANES; k++) {
            Complex z = cis(-frequency[k] * (origin + step * first) - turns[k]);
            coarse_c[k] = (float)z.re;
            coarse_s[k] = (float)z.im;
        }
        for (int m = 0; m < FINE && first + m < count; m++)
            for (int k = 0; k < LANES; k++) {
                c[LANES * (first + m) + k] = coarse_c[k] * fine_c[m][k] - coarse_s[k] * fine_s[m][k];
                s[LANES * (first + m) + k] = coarse_c[k] * fine_s[m][k] + coarse_s[k] * fine_c[m][k];
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

/* Filter with three taps for each chirp, one block apart; the signal has a spare block at either end. */
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
        float *re = w->row_re + LANES * RX, *im = w->row_im + LANES * RX;
        mix_and_fold(w, w->words + first * WORDS * w->n, frequency + first, re, im);
        extend(w->row_re, LANES * values, LANES * RX);
        extend(w->row_im, LANES * values, LANES * RX);
        equalise(w->row_re, w->row_im, taps + 3 * first, values, w->folded_re + first * values, w->folded_im + first * values);
    }
}

/* Sum over the chirps of a group with weights. */
static inline float weighted_sum(const float *restrict x, const float *restrict weights)
{
    float sum = 0;
    for (int k = 0; k < LANES; k++)
        sum += x[k] * weights[k];
    return sum;
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
   its energy in each part of the chirp, [part][chirp]; see `loops.against_others`. Returns the energy of the sum. */
static double against_others(Work *w, const uint8_t *good, double *found, Complex *tone, float *energy, double *apart_f,
                             double *apart_phase, double *left)
{
    int values = RX * w->blocks, chirps = w->chirps, all = w->parts * chirps;
    double *even_re = w->sums, *even_im = even_re + all, *odd_re = even_im + all, *odd_im = odd_re + all;
    double *rest_re = odd_im + all, *rest_im = rest_re + all, *odd_f = w->tones, level = 0;
    Complex *odd_tone = (Complex *)(odd_f + chirps), *even_tone = odd_tone + chirps;
    memset(w->all_re, 0, sizeof(float) * values);
    memset(w->all_im, 0, sizeof(float) * values);
    for (int g = 0; g < w->groups; g++) {
        float used[LANES];
        for (int k = 0; k < LANES; k++)
            used[k] = g * LANES + k < chirps && good[g * LANES + k];
        for (int i = 0; i < values; i++) {
            w->all_re[i] += weighted_sum(w->folded_re + LANES * ((size_t)g * values + i), used);
            w->all_im[i] += weighted_sum(w->folded_im + LANES * ((size_t)g * values + i), used);
        }
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
                double inside = good[first + k] ? own : 0, re = a + c - inside, im = b + d;
                double others = whole - (good[first + k] ? 2 * (a + c) - own : 0);
                even_re[j + k] = a, even_im[j + k] = b, odd_re[j + k] = c, odd_im[j + k] = d;
                rest_re[j + k] = re, rest_im[j + k] = im;
                left[j + k] = own - (others > 1e-30 ? (re * re + im * im) / others : own);
                energy[first + k] += sums[4][k];
            }
        }
    }
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, 1, found, tone);
    newton_step(rest_re, rest_im, w->part_times, w->parts, chirps, 0, found, tone);
    for (int p = 0; p < w->parts; p++)
        turn_back(found, w->part_times[p], chirps, even_re + p * chirps, even_im + p * chirps, odd_re + p * chirps,
                  odd_im + p * chirps);
    newton_step(even_re, even_im, w->part_times, w->parts, chirps, 1, apart_f, even_tone);
    newton_step(odd_re, odd_im, w->part_times, w->parts, chirps, 1, odd_f, odd_tone);
    VECTOR
    for (int k = 0; k < chirps; k++) {
        apart_f[k] -= odd_f[k];
        apart_phase[k] = angle(times(even_tone[k], conjugate(odd_tone[k])));
    }
    return level;
}

/* Undo the attenuation by the decimation in complex averages [block], `decimate.flatten`. */
static inline void flatten(const float *flat, const float *restrict in, int blocks, float *restrict out)
{
    const int edge = FLAT / 2;
    if (blocks < FLAT) {
        memcpy(out, in, sizeof *in * 2 * blocks);
        return;
    }
    const float *inner = flat + FLAT * edge;
    for (int i = 2 * edge; i < 2 * (blocks - edge); i++) {
        const float *x = in + i - 2 * edge;
        out[i] = inner[0] * (x[0] + x[12]) + inner[1] * (x[2] + x[10]) + inner[2] * (x[4] + x[8]) + inner[3] * x[6];
    }
    for (int m = 0; m < edge; m++)
        for (int part = 0; part < 2; part++) {
            float first = 0, last = 0;
            for (int t = 0; t < FLAT; t++) {
                first += flat[FLAT * m + t] * in[2 * t + part];
                last += flat[FLAT * m + t] * in[2 * (blocks - 1 - t) + part];
            }
            out[2 * m + part] = first;
            out[2 * (blocks - 1 - m) + part] = last;
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
