/* Loops over one chirp of four RX, or over sixteen records at a time, for burst.c and direct_path.c.

   Samples of a chirp are stored as the card sends them: value 4 n + r is sample n of RX r. Records that are transformed
   together are interleaved: value 16 n + k is sample n of record k. So inner loops run over contiguous values and are
   vectorised by the compiler. The files are compiled once per vector width (`build.py`), with WIDTH in bits at the end of
   the functions' names (`width.c`).

   Complex values are pairs of arrays `re`, `im`; a turn is 2 pi. */
#ifndef SIGNAL_H
#define SIGNAL_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define RX 4    /* of an AWR2243 */
#define FOLD 4  /* samples averaged before fine estimates, `loops.FOLD` */
#define LANES 16  /* FOLD x RX; also the number of records transformed together */

#define JOIN(name, width) name##_##width
#define NAMED(name, width) JOIN(name, width)
#define NAME(name) NAMED(name, WIDTH)

/* Marks a loop with independent iterations. */
#define VECTOR _Pragma("omp simd")

#define TURN 6.283185307179586476925

typedef struct { double re, im; } Complex;

/* Cosine and sine of a number of turns, within 1e-9, by polynomials of half the angle, which the compiler vectorises. */
static inline Complex cis(double turns)
{
    double x = TURN / 2 * (turns - floor(turns + 0.5)), q = x * x, s, c;
    s = -1 / 5040.0 + q * (1 / 362880.0 + q * (-1 / 39916800.0 + q / 6227020800.0));
    s = x * (1 + q * (-1 / 6.0 + q * (1 / 120.0 + q * s)));
    c = 1 / 40320.0 + q * (-1 / 3628800.0 + q / 479001600.0);
    c = 1 + q * (-1 / 2.0 + q * (1 / 24.0 + q * (-1 / 720.0 + q * c)));
    return (Complex){1 - 2 * s * s, 2 * s * c};
}

static inline Complex times(Complex a, Complex b)
{
    return (Complex){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

static inline Complex conjugate(Complex a) { return (Complex){a.re, -a.im}; }
static inline double magnitude(Complex a) { return sqrt(a.re * a.re + a.im * a.im); }

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

/* Allocate zeroed memory for `count` floats on its own cache lines; free it with `release`. */
static inline float *reserve(size_t count)
{
    char *block = calloc(count * sizeof(float) + 128, 1);
    if (!block)
        return NULL;
    char *aligned = block + 64 + (64 - (uintptr_t)block % 64);
    memcpy(aligned - sizeof block, &block, sizeof block);
    return (float *)aligned;
}

static inline void release(float *memory)
{
    char *block;
    if (!memory)
        return;
    memcpy(&block, (char *)memory - sizeof block, sizeof block);
    free(block);
}

/* Convert the words of some samples (I of four RX, then Q of four RX) to x + j y. */
static inline void part_iq(const int16_t *restrict words, int samples, float *restrict x, float *restrict y)
{
    for (int n = 0; n < samples; n++)
        for (int r = 0; r < RX; r++) {
            x[RX * n + r] = words[2 * RX * n + r];
            y[RX * n + r] = words[2 * RX * n + RX + r];
        }
}

/* Largest magnitude of words. */
static inline int32_t largest(const int16_t *restrict words, int count)
{
    int16_t low = 0, high = 0;
    for (int i = 0; i < count; i++) {
        low = words[i] < low ? words[i] : low;
        high = words[i] > high ? words[i] : high;
    }
    return high > -(int32_t)low ? high : -(int32_t)low;
}

/* Index of the first maximum. */
static inline int maximum(const double *values, int count)
{
    double highest = values[0];
    int i = 0;
    for (int j = 1; j < count; j++)
        highest = values[j] > highest ? values[j] : highest;
    while (i < count - 1 && values[i] != highest)
        i++;
    return i;
}

/* exp(-j 2 pi (frequency (step m - origin) + turns)) for m < count, as an outer product of coarse and fine steps like
   `loops.phasor`. Writes up to seven more values. */
static inline void ramp(double frequency, double turns, int step, double origin, int count, float *restrict c,
                        float *restrict s)
{
    enum { FINE = 8 };
    float fine_c[FINE], fine_s[FINE], coarse_c[FINE], coarse_s[FINE];
    for (int m = 0; m < FINE; m++) {
        Complex z = cis(-frequency * step * m);
        fine_c[m] = (float)z.re;
        fine_s[m] = (float)z.im;
    }
    for (int first = 0; first < count; first += FINE * FINE) {
        for (int i = 0; i < FINE; i++) {
            Complex z = cis(-frequency * (step * (first + i * FINE) - origin) - turns);
            coarse_c[i] = (float)z.re;
            coarse_s[i] = (float)z.im;
        }
        for (int i = 0; i < FINE && first + i * FINE < count; i++) {
            float *restrict to_c = c + first + i * FINE, *restrict to_s = s + first + i * FINE;
            VECTOR
            for (int m = 0; m < FINE; m++) {
                to_c[m] = coarse_c[i] * fine_c[m] - coarse_s[i] * fine_s[m];
                to_s[m] = coarse_c[i] * fine_s[m] + coarse_s[i] * fine_c[m];
            }
        }
    }
}

/* exp(-j 2 pi k / size), k < size. */
static inline void roots_of_unity(int size, float *c, float *s)
{
    for (int k = 0; k < size; k++) {
        Complex z = cis(-(double)k / size);
        c[k] = (float)z.re;
        s[k] = (float)z.im;
    }
}

/* The bin at an index of the output of `transform`. */
static inline int bin_at(int place, int size)
{
    int bin = 0, scale = 1;
    for (; size >= 4; size /= 4, scale *= 4) {
        bin += scale * (place / (size / 4));
        place %= size / 4;
    }
    return bin + scale * place;
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

/* Fourier transforms of sixteen records [size][LANES] in place, decimation in frequency; bin order as in `bin_at`. c, s
   are the roots of unity of a multiple of the size, `roots`. */
static inline void transform(float *restrict re, float *restrict im, int size, const float *c, const float *s, int roots)
{
    int n = size;
    for (; n >= 4; n /= 4) {
        int q = n / 4, turn = roots / n;
        for (int first = 0; first < size; first += n)
            for (int j = 0; j < q; j++) {
                int i = (first + j) * LANES, k = j * turn;
                const float w[6] = {c[k], s[k], c[2 * k], s[2 * k], c[3 * k], s[3 * k]};
                butterfly(re + i, im + i, q * LANES, w);
            }
    }
    if (n == 2)
        for (int i = 0; i < size * LANES; i += 2 * LANES)
            for (int k = 0; k < LANES; k++) {
                float a = re[i + k], b = im[i + k], d = re[i + LANES + k], e = im[i + LANES + k];
                re[i + k] = a + d;
                im[i + k] = b + e;
                re[i + LANES + k] = a - d;
                im[i + LANES + k] = b - e;
            }
}

/* A step of Newton's method on the periodograms of records [part][record], `loops.refine`: changes the frequency, cycles
   per sample. `first`: the frequency is still zero. */
static inline void newton_step(const double *restrict re, const double *restrict im, const double *restrict t, int parts,
                               int count, int first, double *restrict f, Complex *restrict tone)
{
    double limit = TURN / (t[parts - 1] - t[0]);
    VECTOR
    for (int k = 0; k < count; k++) {
        double r0 = 0, i0 = 0, r1 = 0, i1 = 0, r2 = 0, i2 = 0, start = first ? 0 : f[k];
        for (int p = 0; p < parts; p++) {
            Complex turn = first ? (Complex){1, 0} : cis(-start * t[p]);
            double a = re[(size_t)p * count + k] * turn.re - im[(size_t)p * count + k] * turn.im;
            double b = re[(size_t)p * count + k] * turn.im + im[(size_t)p * count + k] * turn.re;
            r0 += a;
            i0 += b;
            r1 += t[p] * a;
            i1 += t[p] * b;
            r2 += t[p] * t[p] * a;
            i2 += t[p] * t[p] * b;
        }
        double slope = r0 * i1 - i0 * r1, curvature = r1 * r1 + i1 * i1 - (r0 * r2 + i0 * i2);
        double d = curvature < 0 ? -slope / curvature : 0;
        d = d < -limit ? -limit : d > limit ? limit : d;
        f[k] = start + d / TURN;
        tone[k].re = r0 + d * i1 - d * d / 2 * r2;
        tone[k].im = i0 - d * r1 - d * d / 2 * i2;
    }
}

/* Multiply values a + j b and c + j d by exp(-j 2 pi frequency time). */
static inline void turn_back(const double *restrict frequency, double time, int count, double *restrict a,
                             double *restrict b, double *restrict c, double *restrict d)
{
    VECTOR
    for (int k = 0; k < count; k++) {
        Complex turn = cis(-frequency[k] * time), one = {a[k], b[k]}, other = {c[k], d[k]};
        a[k] = one.re * turn.re - one.im * turn.im;
        b[k] = one.re * turn.im + one.im * turn.re;
        c[k] = other.re * turn.re - other.im * turn.im;
        d[k] = other.re * turn.im + other.im * turn.re;
    }
}

#endif
