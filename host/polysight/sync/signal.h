/* Loops over sixteen records at a time, for burst.c and direct_path.c.

   Records lie side by side: value 16 n + k is sample n of record k. So inner loops run over contiguous values and are
   vectorised by the compiler. The files are compiled once per vector width (`build.py`), with WIDTH in bits at the end of
   the functions' names (`width.c`).

   Complex values are pairs of arrays `re`, `im`; a turn is 2 pi. */
#ifndef SIGNAL_H
#define SIGNAL_H

#define _POSIX_C_SOURCE 200112L /* posix_memalign */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define RX 4    /* of an AWR2243 */
#define FOLD 4  /* samples of a block, which decimation makes one, `decimate.FOLD` */
#define MOST 256 /* chirps of a burst, whole groups, `loops.MOST_CHIRPS` */
#define LANES 16  /* FOLD x RX; also the number of records transformed together */

#define JOIN(name, width) name##_##width
#define NAMED(name, width) JOIN(name, width)
#define NAME(name) NAMED(name, WIDTH)

/* Marks a loop with independent iterations. */
#define VECTOR _Pragma("omp simd")

#define TURN 6.283185307179586476925

typedef struct { double re, im; } Complex;

/* Cosine and sine of a number of turns, within 2e-8, by polynomials of half the angle, which the compiler vectorises. */
static inline Complex cis(double turns)
{
    double x = TURN / 2 * (turns - floor(turns + 0.5)), q = x * x, s, c;
    s = -1 / 5040.0 + q * (1 / 362880.0 + q * (-1 / 39916800.0 + q * (1 / 6227020800.0)));
    s = x * (1 + q * (-1 / 6.0 + q * (1 / 120.0 + q * s)));
    c = 1 / 40320.0 + q * (-1 / 3628800.0 + q * (1 / 479001600.0));
    c = 1 + q * (-1 / 2.0 + q * (1 / 24.0 + q * (-1 / 720.0 + q * c)));
    return (Complex){1 - 2 * s * s, 2 * s * c};
}

static inline Complex times(Complex a, Complex b)
{
    return (Complex){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

/* a + factor b */
static inline Complex plus(Complex a, double factor, Complex b) { return (Complex){a.re + factor * b.re, a.im + factor * b.im}; }
static inline Complex conjugate(Complex a) { return (Complex){a.re, -a.im}; }
static inline double squared(Complex a) { return a.re * a.re + a.im * a.im; }
static inline double magnitude(Complex a) { return sqrt(squared(a)); }

/* Angle, within 1e-10: the arc tangent's series below an eighth of a turn; without calls, which the compiler vectorises. */
static inline double angle(Complex a)
{
    double x = fabs(a.re), y = fabs(a.im), high = x > y ? x : y, low = x > y ? y : x;
    int steep = low > 0.41421356 * high; /* tan(pi / 8) */
    double top = steep ? low - high : low, bottom = steep ? low + high : high;
    double t = bottom > 0 ? top / bottom : 0, q = t * t, sum = 1 / 21.0;
    for (int n = 19; n > 0; n -= 2)
        sum = 1.0 / n - q * sum;
    sum = t * sum + (steep ? TURN / 8 : 0);
    sum = x > y ? sum : TURN / 4 - sum;
    sum = a.re < 0 ? TURN / 2 - sum : sum;
    return a.im < 0 ? -sum : sum;
}

/* As many floats as the processor handles at once: a part of LANES. Compilers do well with these vectors, except for the
   conversion of words to floats (`counts`), and sums of products (`add_product`), which `-fassociative-math` takes apart. */
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
static inline Vector all(float x) { return x - (Vector){0}; } /* x in every place */
static inline float total(Vector x)
{
    float sum = 0;
    for (int k = 0; k < STEP; k++)
        sum += x[k];
    return sum;
}

/* Size of a transform, a power of four; roots of unity exp(-j 2 pi k / size), the bin at each index of its output, the index of each bin. */
typedef struct { int size, *bin, *place; float *c, *s; } Table;

/* Fill a table: the output of the transform is in the order of reversed digits, to base four. */
static inline void fill_table(Table *t)
{
    for (int i = 0; i < t->size; i++) {
        Complex root = cis(-(double)i / t->size);
        t->c[i] = (float)root.re;
        t->s[i] = (float)root.im;
        int bin = 0;
        for (int scale = 1, rest = i; scale < t->size; scale *= 4, rest /= 4)
            bin = 4 * bin + rest % 4;
        t->bin[i] = bin;
        t->place[bin] = i;
    }
}

/* Fourier transform of length four across four rows of sixteen values, times powers one to three of w. */
static inline void butterfly(float *restrict re, float *restrict im, int row, const float w[6])
{
    float *restrict re1 = re + row, *restrict re2 = re + 2 * row, *restrict re3 = re + 3 * row;
    float *restrict im1 = im + row, *restrict im2 = im + 2 * row, *restrict im3 = im + 3 * row;
    VECTOR
    for (int k = 0; k < LANES; k++) {
        float a = re[k] + re2[k], b = im[k] + im2[k], d = re[k] - re2[k], e = im[k] - im2[k];
        float f = re1[k] + re3[k], g = im1[k] + im3[k], h = im1[k] - im3[k], l = re3[k] - re1[k];
        re[k] = a + f;
        im[k] = b + g;
        re1[k] = (d + h) * w[0] - (e + l) * w[1];
        im1[k] = (d + h) * w[1] + (e + l) * w[0];
        re2[k] = (a - f) * w[2] - (b - g) * w[3];
        im2[k] = (a - f) * w[3] + (b - g) * w[2];
        re3[k] = (d - h) * w[4] - (e - l) * w[5];
        im3[k] = (d - h) * w[5] + (e - l) * w[4];
    }
}

/* Fourier transforms of sixteen records [size][LANES] in place, decimation in frequency; zeros follow the samples. The
   table may be that of four times the size: then its bins are, too. */
static inline void transform(float *restrict re, float *restrict im, int samples, int size, const Table *table)
{
    memset(re + LANES * samples, 0, sizeof *re * LANES * (size - samples));
    memset(im + LANES * samples, 0, sizeof *im * LANES * (size - samples));
    const float *c = table->c, *s = table->s;
    for (int n = size; n > 1; n /= 4) {
        int q = n / 4, turn = table->size / n;
        for (int first = 0; first < size; first += n)
            for (int j = 0; j < q; j++) {
                int i = (first + j) * LANES, k = j * turn;
                const float w[6] = {c[k], s[k], c[2 * k], s[2 * k], c[3 * k], s[3 * k]};
                butterfly(re + i, im + i, q * LANES, w);
            }
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

/* The value of a record at index i; re and im begin at the record's lane. */
static inline Complex value_at(const float *re, const float *im, int i) { return (Complex){re[LANES * i], im[LANES * i]}; }

/* The power of a bin of a record's spectrum, counted round the circle. */
static inline double power_at(const Table *t, const float *re, const float *im, int bin)
{
    return squared(value_at(re, im, t->place[bin & (t->size - 1)]));
}

/* A step of Newton's method on the periodograms of `count` records [part][record], `loops.refine`: from frequencies `start`
   to f, in cycles per sample (both may be one array); t: times of the parts in samples. tone: sums at f. */
static inline void newton_step(const double *restrict re, const double *restrict im, const double *restrict t, int parts,
                               int count, const double *start, double *f, Complex *restrict tone)
{
    double limit = TURN / (t[parts - 1] - t[0]);
    Complex sums[3][MOST]; /* of the demodulated parts, times powers zero to two of the time */
    for (int k = 0; k < count; k++)
        sums[0][k] = sums[1][k] = sums[2][k] = (Complex){0, 0};
    for (int p = 0; p < parts; p++) {
        VECTOR
        for (int k = 0; k < count; k++) {
            Complex value = times((Complex){re[p * count + k], im[p * count + k]}, cis(-start[k] * t[p]));
            sums[0][k] = plus(sums[0][k], 1, value);
            sums[1][k] = plus(sums[1][k], t[p], value);
            sums[2][k] = plus(sums[2][k], t[p] * t[p], value);
        }
    }
    VECTOR
    for (int k = 0; k < count; k++) {
        Complex s0 = sums[0][k], s1 = sums[1][k], s2 = sums[2][k];
        double slope = s0.re * s1.im - s0.im * s1.re;
        double curvature = squared(s1) - (s0.re * s2.re + s0.im * s2.im);
        double d = curvature < 0 ? -slope / curvature : 0;
        d = d < -limit ? -limit : d > limit ? limit : d;
        f[k] = start[k] + d / TURN;
        tone[k] = plus(plus(s0, d, (Complex){s1.im, -s1.re}), -d * d / 2, s2);
    }
}

#endif
