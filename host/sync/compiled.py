"""The passes of `host.sync.plain`, compiled: one position at a time in the cache, real and imaginary parts apart.

Compiled at the first call and cached on disk.
"""

from __future__ import annotations

import numba
import numpy as np

from host.sync.plain import FOLD

CHUNK = 32
"""Positions at a time: what the passes hand to each other stays in the second-level cache."""

_compile = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")


@_compile
def load(words):
    """int16 [position, chirp, 2, rx, sample] of raw frames: samples in a row, for vector arithmetic."""
    positions, chirps, samples, _, receivers = words.shape
    out = np.empty((positions, chirps, 2, receivers, samples), np.int16)
    for p in range(positions):
        for k in range(chirps):
            for part in range(2):
                for r in range(receivers):
                    for n in range(samples):
                        out[p, k, part, r, n] = words[p, k, n, part, r]
    return out


@_compile
def _ramp(frequency, origin, re, im):
    """`exp(-j 2 pi frequency (n - origin))`, by doubling: 8 multiplications deep, so float32 stays exact to 1e-6."""
    samples = re.size
    start = np.exp(2j * np.pi * frequency * origin)
    turn = np.exp(-2j * np.pi * frequency)
    re[0], im[0] = start.real, start.imag
    done = 1
    while done < samples:
        c, s = np.float32(turn.real), np.float32(turn.imag)
        for n in range(min(done, samples - done)):
            re[done + n] = re[n] * c - im[n] * s
            im[done + n] = re[n] * s + im[n] * c
        turn *= turn
        done *= 2


@_compile
def products(frames, reference, linear, size):
    """See `plain.products`."""
    positions, chirps, _, receivers, samples = frames.shape
    a, b = linear
    out = np.zeros((positions, chirps, size), np.complex64)
    chosen = np.zeros((positions, receivers, size), np.complex64)
    energy = np.empty((positions, chirps), np.float32)
    peak = np.empty((positions, chirps), np.int32)
    ref_re, ref_im = np.empty((receivers, b - a), np.float32), np.empty((receivers, b - a), np.float32)
    z_re, z_im = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    for p in range(positions):
        for r in range(receivers):
            for n in range(b - a):
                ref_re[r, n] = frames[p, reference[p], 0, r, a + n]
                ref_im[r, n] = frames[p, reference[p], 1, r, a + n]
            for n in range(b - a):
                chosen[p, r, n] = complex(ref_re[r, n], ref_im[r, n])
        for k in range(chirps):
            z_re[:] = 0
            z_im[:] = 0
            total = np.float32(0)
            low, high = np.int16(0), np.int16(0)
            for r in range(receivers):
                re, im, u, v = frames[p, k, 0, r], frames[p, k, 1, r], ref_re[r], ref_im[r]
                for n in range(b - a):
                    x, y = np.float32(re[a + n]), np.float32(im[a + n])
                    total += x * x + y * y
                    z_re[n] += x * u[n] + y * v[n]
                    z_im[n] += y * u[n] - x * v[n]
                for n in range(samples):
                    low, high = min(low, re[n], im[n]), max(high, re[n], im[n])
            for n in range(b - a):
                out[p, k, n] = complex(z_re[n], z_im[n])
            energy[p, k] = total
            peak[p, k] = max(np.int32(high), -np.int32(low))
    return out, chosen, energy, peak


@_compile
def _mix(frame, r, first, c, s, x, y):
    """Samples of one RX from `first`, times `c + j s`, into x, y."""
    re, im = frame[0, r, first:], frame[1, r, first:]
    for n in range(x.size):
        x[n] = re[n] * c[n] - im[n] * s[n]
        y[n] = re[n] * s[n] + im[n] * c[n]


@_compile
def _fold(x, out):
    """Averages of every `FOLD` samples."""
    for m in range(out.size):
        total = np.float32(0)
        for q in range(FOLD):
            total += x[m * FOLD + q]
        out[m] = total * np.float32(1 / FOLD)


@_compile
def _add_shifted(x, y, tap, shift, re, im):
    """Add `tap * (x + j y)` [sample] to re, im, from `shift` samples later; beyond the ends as in `hpf.shifted`."""
    n, u, v = x.size, np.float32(tap.real), np.float32(tap.imag)
    for m in range(max(0, -shift), min(n, n - shift)):
        re[m] += u * x[m + shift] - v * y[m + shift]
        im[m] += u * y[m + shift] + v * x[m + shift]
    s = abs(shift)
    one = s if shift < 0 else -s
    for m in range(0 if shift < 0 else n - s, s if shift < 0 else n):
        e = 3 * (x[m] - x[m + one]) + x[m + 2 * one]
        f = 3 * (y[m] - y[m + one]) + y[m + 2 * one]
        re[m] += u * e - v * f
        im[m] += u * f + v * e


@_compile
def against_others(frames, frequency, taps, good, linear, edges):
    """See `plain.against_others`."""
    positions, chirps, _, receivers, _ = frames.shape
    a, b = linear
    blocks, parts, count = (b - a) // FOLD, edges.size - 1, taps.shape[2]
    sums = np.empty((2, positions, chirps, parts), np.complex64)
    own = np.empty((positions, chirps, parts), np.float32)
    level = np.empty(positions, np.float32)
    c, s = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    x, y = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    raw_re, raw_im = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    re, im = np.empty((chirps, receivers, blocks), np.float32), np.empty((chirps, receivers, blocks), np.float32)
    all_re, all_im = np.empty((receivers, blocks), np.float32), np.empty((receivers, blocks), np.float32)
    z_re, z_im = np.empty((2, blocks), np.float32), np.empty((2, blocks), np.float32)
    energy = np.empty(blocks, np.float32)
    for p in range(positions):
        re[:] = 0
        im[:] = 0
        all_re[:] = 0
        all_im[:] = 0
        for k in range(chirps):
            _ramp(frequency[p, k], (b - a - 1) / 2, c, s)
            for r in range(receivers):
                _mix(frames[p, k], r, a, c, s, x, y)
                _fold(x, raw_re)
                _fold(y, raw_im)
                for i in range(count):
                    _add_shifted(raw_re, raw_im, taps[p, k, i], i - count // 2, re[k, r], im[k, r])
                if good[p, k]:
                    for m in range(blocks):
                        all_re[r, m] += re[k, r, m]
                        all_im[r, m] += im[k, r, m]
        total = np.float32(0)
        for r in range(receivers):
            for m in range(blocks):
                total += all_re[r, m] * all_re[r, m] + all_im[r, m] * all_im[r, m]
        level[p] = total
        for k in range(chirps):
            z_re[:] = 0
            z_im[:] = 0
            energy[:] = 0
            for r in range(receivers):
                f, g, u, v, to_re, to_im = re[k, r], im[k, r], all_re[r], all_im[r], z_re[r % 2], z_im[r % 2]
                for m in range(blocks):
                    to_re[m] += f[m] * u[m] + g[m] * v[m]
                    to_im[m] += g[m] * u[m] - f[m] * v[m]
                    energy[m] += f[m] * f[m] + g[m] * g[m]
            for i in range(parts):
                e, even, odd = np.float32(0), np.complex64(0), np.complex64(0)
                for m in range(edges[i], edges[i + 1]):
                    e += energy[m]
                    even += complex(z_re[0, m], z_im[0, m])
                    odd += complex(z_re[1, m], z_im[1, m])
                own[p, k, i], sums[0, p, k, i], sums[1, p, k, i] = e, even, odd
    return sums, own, level


@_compile
def average(frames, frequency, weights, second_half, linear):
    """See `plain.average`."""
    positions, chirps, _, receivers, samples = frames.shape
    a, b = linear
    count, blocks = weights.shape[2], (b - a) // FOLD
    mean = np.zeros((positions, receivers, samples), np.complex64)
    halves = np.empty((positions, 2, receivers, blocks), np.complex64)
    c, s = np.empty(samples, np.float32), np.empty(samples, np.float32)
    x, y = np.empty(samples, np.float32), np.empty(samples, np.float32)
    block_re, block_im = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    terms_re = np.empty((2, count, receivers, samples), np.float32)
    terms_im = np.empty((2, count, receivers, samples), np.float32)
    for p in range(positions):
        terms_re[:] = 0
        terms_im[:] = 0
        for k in range(chirps):
            if weights[p, k, count // 2] == 0:
                continue
            h = 1 if second_half[p, k] else 0
            _ramp(frequency[p, k], (a + b - 1) / 2, c, s)
            for r in range(receivers):
                _mix(frames[p, k], r, 0, c, s, x, y)
                for i in range(count):
                    u, v = weights[p, k, i].real, weights[p, k, i].imag
                    to_re, to_im = terms_re[h, i, r], terms_im[h, i, r]
                    for n in range(samples):
                        to_re[n] += u * x[n] - v * y[n]
                        to_im[n] += u * y[n] + v * x[n]
        for h in range(2):
            for r in range(receivers):
                x[:] = 0
                y[:] = 0
                for i in range(count):
                    _add_shifted(terms_re[h, i, r], terms_im[h, i, r], 1.0 + 0.0j, (i - count // 2) * FOLD, x, y)
                _fold(x[a:b], block_re)
                _fold(y[a:b], block_im)
                for n in range(samples):
                    mean[p, r, n] += complex(x[n], y[n])
                for m in range(blocks):
                    halves[p, h, r, m] = complex(block_re[m], block_im[m])
    return mean, halves
