"""Small compiled loops of `compiled.py`, over one chirp of four RX at a time, or one burst of sixteen chirps.

What makes them fast: every loop runs over values that lie next to each other, so it becomes vector instructions. The
card's integers are sorted into that order before they become numbers, since they are half as wide. Strides are
constants, and arrays are handed over as slices that start at 0, for the compiler to see that nothing overlaps. All of a
chirp fits the first-level cache.
"""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import numba
import numpy as np

from polysight.host.sync.numpy_passes import FOLD

RX = 4
LANES = FOLD * RX  # samples that are averaged, of every RX; also chirps that are transformed at once


def _forget_stale() -> None:
    """Numba sees that the file of a cached function changed, but not the files of what was compiled into it."""
    here = Path(__file__).parent
    with suppress(OSError):  # an installation that cannot be written cannot be edited either
        newest = max(
            (here / f"{name}.py").stat().st_mtime for name in ("compiled", "compiled_loops", "numpy_passes", "tone")
        )
        for name in ("compiled", "compiled_loops"):
            for index in (here / "__pycache__").glob(f"{name}.*.nbi"):
                if index.stat().st_mtime < newest:
                    index.unlink(missing_ok=True)


_forget_stale()
compiled = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy", forceinline=True)


@compiled
def largest(words):
    """Largest magnitude of int16 words."""
    low, high = np.int16(0), np.int16(0)
    for i in range(words.size):
        low, high = min(low, words[i]), max(high, words[i])
    return max(np.int32(high), -np.int32(low))


@compiled
def unzip(values, even, odd):
    """Values at even and at odd places."""
    for i in range(even.size):
        even[i] = values[2 * i]
        odd[i] = values[2 * i + 1]


@compiled
def _halves(values, out):
    """Values at even places, then those at odd ones: of what an index means, the last factor of two comes first."""
    unzip(values, out[: values.size // 2], out[values.size // 2 :])


@compiled
def by_channel(words, out, spare):
    """Words [sample, 2, rx] of a chirp in the order [2, rx, sample]; all flat, int16 [sample * 8]."""
    _halves(words, out)
    _halves(out, spare)
    _halves(spare, out)


@compiled
def by_phase(words, out, spare):
    """Words [block, FOLD, 2, rx] of a chirp in the order [FOLD, 2, rx, block]; all flat."""
    _halves(words, out)
    _halves(out, spare)
    _halves(spare, out)
    _halves(out, spare)
    _halves(spare, out)


@compiled
def correlate(x, u, re, im):
    """Products of a chirp x int16 [2 * rx, sample] with the conjugate of u float32 (alike), summed over RX, into re and
    im [sample]; returns the energy of x.
    """
    energy = np.float32(0)
    for i in range(re.size):
        power, f, g = np.float32(0), np.float32(0), np.float32(0)
        for r in range(RX):
            a, b = np.float32(x[r, i]), np.float32(x[RX + r, i])
            power += a * a + b * b
            f += a * u[r, i] + b * u[RX + r, i]
            g += b * u[r, i] - a * u[RX + r, i]
        energy += power
        re[i] = f
        im[i] = g
    return energy


@compiled
def _quarters(values, out):
    """Four records, flat, into one with theirs in turn."""
    q = values.size // 4
    for i in range(q):
        out[4 * i] = values[i]
        out[4 * i + 1] = values[q + i]
        out[4 * i + 2] = values[2 * q + i]
        out[4 * i + 3] = values[3 * q + i]


@compiled
def interleave(values, spare, out):
    """Records [LANES, sample] in the order [sample, LANES], all flat; zeros behind them."""
    _quarters(values, spare)
    _quarters(spare, out[: values.size])
    out[values.size :] = 0


def roots(size):
    """What :func:`transform` needs: cosines and sines of its steps, float32, and the order of its results, int32 [bin].

    Bin `order[i]` of the transforms comes out at place i.
    """
    turns, radices, n = [], [], size
    while n > 1:
        radix = 4 if n in (256, 64, 16, 4) else 2
        turns += [r * np.arange(n // radix) / n for r in range(1, radix)]
        radices.append(radix)
        n //= radix
    angles = 2 * np.pi * np.repeat(np.concatenate(turns), LANES)
    order = np.arange(size, dtype=np.int32).reshape(radices[::-1]).T.ravel()
    return np.cos(angles).astype(np.float32), -np.sin(angles).astype(np.float32), order


@compiled
def transform(re, im, c, s):
    """Fourier transforms of interleaved records [size * LANES], in place, by decimation in frequency.

    Radix four, after steps of radix two down to a size whose strides are constants. `c` and `s` as of :func:`roots`.
    """
    n, at = re.size // LANES, 0
    while n not in (256, 64, 16, 4):
        q = n // 2 * LANES
        for i in range(0, re.size, 2 * q):
            j, k = i + q, i + 2 * q
            _step_of_two(re[i:j], im[i:j], re[j:k], im[j:k], c[at:], s[at:])
        n, at = n // 2, at + q
    if n == 256:
        _step_of_four(re, im, c[at:], s[at:], 64 * LANES)
        at += 3 * 64 * LANES
    if n >= 64:
        _step_of_four(re, im, c[at:], s[at:], 16 * LANES)
        at += 3 * 16 * LANES
    if n >= 16:
        _step_of_four(re, im, c[at:], s[at:], 4 * LANES)
        at += 3 * 4 * LANES
    _step_of_four(re, im, c[at:], s[at:], LANES)


@compiled
def _step_of_two(re, im, f, g, c, s):
    for j in range(re.size):
        x, y = re[j] - f[j], im[j] - g[j]
        re[j] += f[j]
        im[j] += g[j]
        f[j] = x * c[j] - y * s[j]
        g[j] = x * s[j] + y * c[j]


@compiled
def _step_of_four(all_re, all_im, c, s, q):
    for first in range(0, all_re.size, 4 * q):
        re, im = all_re[first : first + 4 * q], all_im[first : first + 4 * q]
        for j in range(q):
            a, b = re[j] + re[2 * q + j], im[j] + im[2 * q + j]
            d, e = re[j] - re[2 * q + j], im[j] - im[2 * q + j]
            f, g = re[q + j] + re[3 * q + j], im[q + j] + im[3 * q + j]
            h, k = im[q + j] - im[3 * q + j], re[3 * q + j] - re[q + j]
            re[j] = a + f
            im[j] = b + g
            re[q + j] = (d + h) * c[j] - (e + k) * s[j]
            im[q + j] = (d + h) * s[j] + (e + k) * c[j]
            re[2 * q + j] = (a - f) * c[q + j] - (b - g) * s[q + j]
            im[2 * q + j] = (a - f) * s[q + j] + (b - g) * c[q + j]
            re[3 * q + j] = (d - h) * c[2 * q + j] - (e - k) * s[2 * q + j]
            im[3 * q + j] = (d - h) * s[2 * q + j] + (e - k) * c[2 * q + j]


@compiled
def strongest(power, index):
    """The largest power of each interleaved record [place * LANES], and its index, come first; overwrites both."""
    half = power.size // 2
    while half >= LANES:
        a, b, first, second = power[:half], power[half:], index[:half], index[half:]
        for j in range(half):
            u, v, i, k = a[j], b[j], first[j], second[j]
            first[j] = k if v > u else i
            a[j] = max(u, v)
        half //= 2


@compiled
def cis(turns):
    """Cosine and sine of 2 pi turns, within 1e-9: polynomials of half the angle, so that loops of it are vectorised."""
    x = np.pi * (turns - math.floor(turns + 0.5))
    q = x * x
    s = -1 / 5040 + q * (1 / 362880 + q * (-1 / 39916800 + q / 6227020800))
    s = x * (1 + q * (-1 / 6 + q * (1 / 120 + q * s)))
    c = 1 / 40320 + q * (-1 / 3628800 + q / 479001600)
    c = 1 + q * (-1 / 2 + q * (1 / 24 + q * (-1 / 720 + q * c)))
    return 1 - 2 * s * s, 2 * s * c


@compiled
def steps(frequency, origin, re, im):
    """`exp(-j 2 pi frequency (n - origin))` for the first sample n of every block, float32 [block]."""
    for m in range(re.size):
        re[m], im[m] = cis(frequency * (origin - FOLD * m))


@compiled
def mix_and_fold(x, frequency, c, s, re, im):
    """Words int16 [FOLD, 2, rx, block] mixed down and averaged over every `FOLD` samples, into [rx * (1 + block + 1)].

    `c` and `s` are :func:`steps`; the blocks are continued by one at either end.
    """
    c1, s1 = cis(-frequency)
    c2, s2 = cis(-2 * frequency)
    c3, s3 = cis(-3 * frequency)
    part, n = np.float32(1 / FOLD), c.size
    a1, a2, a3 = part * np.float32(c1), part * np.float32(c2), part * np.float32(c3)
    b1, b2, b3 = part * np.float32(s1), part * np.float32(s2), part * np.float32(s3)
    for r in range(RX):
        to_re, to_im = re[r * (n + 2) : (r + 1) * (n + 2)], im[r * (n + 2) : (r + 1) * (n + 2)]
        for m in range(n):
            x0, y0 = np.float32(x[0, 0, r, m]), np.float32(x[0, 1, r, m])
            x1, y1 = np.float32(x[1, 0, r, m]), np.float32(x[1, 1, r, m])
            x2, y2 = np.float32(x[2, 0, r, m]), np.float32(x[2, 1, r, m])
            x3, y3 = np.float32(x[3, 0, r, m]), np.float32(x[3, 1, r, m])
            f = x0 * part + x1 * a1 - y1 * b1 + x2 * a2 - y2 * b2 + x3 * a3 - y3 * b3
            g = y0 * part + y1 * a1 + x1 * b1 + y2 * a2 + x2 * b2 + y3 * a3 + x3 * b3
            to_re[1 + m] = f * c[m] - g * s[m]
            to_im[1 + m] = f * s[m] + g * c[m]
        extend(to_re, 1)
        extend(to_im, 1)


@compiled
def mix(x, y, frequency, c, s, re, im):
    """Words x + j y int16 [block * LANES] mixed down, into re + j im. `c` and `s` are :func:`steps`."""
    turn_re, turn_im = cis(-frequency)
    within = np.empty((2, LANES), np.float32)
    u, v = 1.0, 0.0
    for q in range(FOLD):
        for r in range(RX):
            within[0, RX * q + r], within[1, RX * q + r] = u, v
        u, v = u * turn_re - v * turn_im, u * turn_im + v * turn_re
    d, e = within[0], within[1]
    for m in range(c.size):
        a, b = c[m], s[m]
        for i in range(LANES):
            j = m * LANES + i
            f, g = a * d[i] - b * e[i], a * e[i] + b * d[i]
            re[j] = x[j] * f - y[j] * g
            im[j] = x[j] * g + y[j] * f


@compiled
def fold(signal, out):
    """Averages of every `FOLD` samples: [block * LANES] to [block * RX]."""
    for m in range(out.size // RX):
        for r in range(RX):
            i = m * LANES + r
            pairs = (signal[i] + signal[i + RX]) + (signal[i + 2 * RX] + signal[i + 3 * RX])
            out[m * RX + r] = pairs * np.float32(1 / FOLD)


@compiled
def extend(signal, s):
    """Continue what lies inside by s values to either side, by the parabola through three, as `high_pass.shifted`."""
    n = signal.size
    for j in range(s):
        signal[j] = 3 * (signal[s + j] - signal[2 * s + j]) + signal[3 * s + j]
        signal[n - s + j] = 3 * (signal[n - 2 * s + j] - signal[n - 3 * s + j]) + signal[n - 4 * s + j]


@compiled
def add_filtered(re, im, taps, s, to_re, to_im):
    """Add a signal, which has s values more at either end, through its taps, s values apart, one or three of them."""
    if taps.size == 1:
        e, f = taps[0].real, taps[0].imag
        for j in range(to_re.size):
            to_re[j] += e * re[s + j] - f * im[s + j]
            to_im[j] += e * im[s + j] + f * re[s + j]
        return
    a, b, e, f, g, h = taps[0].real, taps[0].imag, taps[1].real, taps[1].imag, taps[2].real, taps[2].imag
    for j in range(to_re.size):
        x0, y0, x1, y1, x2, y2 = re[j], im[j], re[s + j], im[s + j], re[2 * s + j], im[2 * s + j]
        to_re[j] += a * x0 - b * y0 + e * x1 - f * y1 + g * x2 - h * y2
        to_im[j] += a * y0 + b * x0 + e * y1 + f * x1 + g * y2 + h * x2


@compiled
def add_products(x, y, u, v, re, im, energy):
    """Add `(x + j y) conj(u + j v)` to re + j im, and the energy of x + j y to energy."""
    for m in range(re.size):
        re[m] += x[m] * u[m] + y[m] * v[m]
        im[m] += y[m] * u[m] - x[m] * v[m]
        energy[m] += x[m] * x[m] + y[m] * y[m]


@compiled
def add_up(values, edges, part):
    """Sums of float32 values between neighbouring edges, into part."""
    for i in range(part.size):
        total = np.float32(0)
        for m in range(edges[i], edges[i + 1]):
            total += values[m]
        part[i] = total


@compiled
def newton(blocks, times, count):
    """`tone.refine` of one record of blocks complex128 [block]: radians a sample, and complex amplitude."""
    limit = 2 * np.pi / (times[-1] - times[0])
    w, step, s0, s1, s2 = 0.0, 0.0, 0j, 0j, 0j
    for _ in range(count):
        s0, s1, s2 = 0j, 0j, 0j
        for i in range(times.size):
            c, s = cis(-w * times[i] / (2 * np.pi))
            y = blocks[i] * complex(c, s)
            s0 += y
            s1 += times[i] * y
            s2 += times[i] ** 2 * y
        slope = s0.real * s1.imag - s0.imag * s1.real
        curvature = s1.real**2 + s1.imag**2 - (s0.real * s2.real + s0.imag * s2.imag)
        step = -slope / curvature if curvature < 0 else 0.0
        step = min(max(step, -limit), limit)
        w += step
    return w, s0 - 1j * step * s1 - step**2 / 2 * s2
