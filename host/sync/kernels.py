"""Small compiled loops of `host.sync.compiled`, over one chirp of four RX at a time.

A chirp's samples lie in a row, its four RX next to each other, real and imaginary parts apart: float32 [sample * 4 +
rx]. So every loop is long, contiguous and turned into vector instructions, sums over chirps need no rearranging, and
four samples of four RX fill one vector of sixteen. All of a chirp fits the first-level cache.
"""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import numba
import numpy as np

from host.sync.plain import FOLD

RX = 4
LANES = FOLD * RX  # samples that are averaged, of every RX


def _forget_stale() -> None:
    """Numba sees that the file of a cached function changed, but not the files of what was compiled into it."""
    here = Path(__file__).parent
    with suppress(OSError):  # an installation that cannot be written cannot be edited either
        newest = max((here / f"{name}.py").stat().st_mtime for name in ("compiled", "kernels", "plain", "tone"))
        for name in ("compiled", "kernels"):
            for index in (here / "__pycache__").glob(f"{name}.*.nbi"):
                if index.stat().st_mtime < newest:
                    index.unlink(missing_ok=True)


_forget_stale()
compiled = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")


@compiled
def split(words, re, im):
    """Words int16 [sample * 8] of a chirp, I of the RX before Q, as float32 [sample * 4] each."""
    for n in range(words.size // (2 * RX)):
        for r in range(RX):
            re[RX * n + r] = words[2 * RX * n + r]
            im[RX * n + r] = words[2 * RX * n + RX + r]


@compiled
def largest(words):
    """Largest magnitude of int16 words."""
    low, high = np.int16(0), np.int16(0)
    for i in range(words.size):
        low, high = min(low, words[i]), max(high, words[i])
    return max(np.int32(high), -np.int32(low))


@compiled
def correlate(x, y, u, v, re, im):
    """`(x + j y) conj(u + j v)` into re + j im; returns the energy of x + j y."""
    energy = np.float32(0)
    for j in range(re.size):
        f, g = x[j], y[j]
        energy += f * f + g * g
        re[j] = f * u[j] + g * v[j]
        im[j] = g * u[j] - f * v[j]
    return energy


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
def ramp(frequency, origin, within, steps):
    """`exp(-j 2 pi frequency (n - origin))` as a product: `within` [2, LANES] holds it for the first `FOLD` samples
    from 0, every RX alike, and `steps` [2, block] for the first sample of every block, from `origin`. float32.
    """
    turn_re, turn_im = cis(-frequency)
    re, im = 1.0, 0.0
    for q in range(FOLD):
        for r in range(RX):
            within[0, RX * q + r], within[1, RX * q + r] = re, im
        re, im = re * turn_re - im * turn_im, re * turn_im + im * turn_re
    for m in range(steps.shape[1]):
        steps[0, m], steps[1, m] = cis(frequency * (origin - FOLD * m))


@compiled
def mix(x, y, within, steps, re, im):
    """`x + j y` times the ramp, into re + j im, all [block * LANES]."""
    c, s = within[0], within[1]
    for m in range(steps.shape[1]):
        a, b = steps[0, m], steps[1, m]
        for i in range(LANES):
            j = m * LANES + i
            u, v = a * c[i] - b * s[i], a * s[i] + b * c[i]
            re[j] = x[j] * u - y[j] * v
            im[j] = x[j] * v + y[j] * u


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
    """Continue what lies inside by s values to either side, by the parabola through three; as `hpf.shifted` does."""
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
def by_part(values, edges, even, odd):
    """Sums of values [block * RX] over parts, over even and over odd RX, [part]."""
    for i in range(edges.size - 1):
        a, b, c, d = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for m in range(edges[i], edges[i + 1]):
            j = m * RX
            a, b, c, d = a + values[j], b + values[j + 1], c + values[j + 2], d + values[j + 3]
        even[i], odd[i] = a + c, b + d


@compiled
def newton(blocks, times, steps):
    """`tone.refine` of one record of blocks complex128 [block]: radians a sample, and complex amplitude."""
    limit = 2 * np.pi / (times[-1] - times[0])
    w, step, s0, s1, s2 = 0.0, 0.0, 0j, 0j, 0j
    for _ in range(steps):
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


@compiled
def transform(x, y, records, roots):
    """Fourier transforms of interleaved records, complex64 [sample * records], by Stockham's algorithm of radix two.

    Overwrites both, and returns the one that holds the result. `roots` is `exp(-j 2 pi n / size)`.
    """
    n, s, swapped = roots.size, records, False
    while n > 1:
        if swapped:
            _butterflies(y, x, n, s, roots)
        else:
            _butterflies(x, y, n, s, roots)
        n, s, swapped = n // 2, 2 * s, not swapped
    return y if swapped else x


@compiled
def _butterflies(x, y, n, s, roots):
    """A step of :func:`transform`, from x to y: `s` transforms of length n become twice as many of half the length."""
    half, turn = n // 2 * s, roots.size // n
    for p in range(n // 2):
        root, i, o = roots[p * turn], p * s, 2 * p * s
        for q in range(s):
            y[o + q] = x[i + q] + x[i + q + half]
        for q in range(s):
            y[o + s + q] = (x[i + q] - x[i + q + half]) * root
