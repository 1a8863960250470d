"""The passes of `host.sync.plain`, compiled: a chirp is taken from the card's words into the cache and used there.

Each pass reads the words anew, which costs less than any copy of them in memory would. For four RX. Compiled at the
first call and cached on disk.
"""

from __future__ import annotations

import numpy as np

from host.sync import kernels
from host.sync.kernels import LANES, RX, compiled
from host.sync.plain import BAND_BINS, FOLD
from host.sync.tone import block_edges, block_times, search_size

CHUNK = 512
"""Positions at a time: as many as NumPy needs for its calls to cost little; reading words from memory costs less."""


def match(words, reference, linear):
    """See `plain.match`."""
    size = search_size(linear[1] - linear[0])
    roots = np.exp(-2j * np.pi * np.arange(size) / size).astype(np.complex64)
    return _match(words, reference, linear, roots)


@compiled
def _match(words, reference, linear, roots):
    positions, chirps, samples, _, _ = words.shape
    a, b = linear[0] * RX, linear[1] * RX
    n, size, records = linear[1] - linear[0], roots.size, chirps + RX
    frequency, amplitude = np.empty((positions, chirps)), np.empty((positions, chirps), np.complex128)
    energy, peak = np.empty((positions, chirps), np.float32), np.empty((positions, chirps), np.int32)
    centre = np.empty(positions)
    x, y = np.empty(samples * RX, np.float32), np.empty(samples * RX, np.float32)
    u, v = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    re, im = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    first, second = np.empty(size * records, np.complex64), np.empty(size * records, np.complex64)
    best, top = np.empty(chirps, np.float32), np.empty(chirps, np.int32)
    band, smooth = np.empty(size), np.empty(size)
    for p in range(positions):
        kernels.split(words[p, reference[p]].reshape(-1), x, y)
        u[:] = x[a:b]
        v[:] = y[a:b]
        first[n * records :] = 0
        for i in range(n):  # the reference chirp itself comes behind the products
            for r in range(RX):
                first[i * records + chirps + r] = complex(u[i * RX + r], v[i * RX + r])
        for k in range(chirps):
            chirp = words[p, k].reshape(-1)
            kernels.split(chirp, x, y)
            peak[p, k] = kernels.largest(chirp)
            energy[p, k] = kernels.correlate(x[a:b], y[a:b], u, v, re, im)
            for i in range(n):
                j = i * RX
                real, imag = re[j] + re[j + 1] + re[j + 2] + re[j + 3], im[j] + im[j + 1] + im[j + 2] + im[j + 3]
                first[i * records + k] = complex(real, imag)
        spectrum = kernels.transform(first, second, records, roots)
        best[:] = -1
        for f in range(size):
            for k in range(chirps):
                z = spectrum[f * records + k]
                power = z.real * z.real + z.imag * z.imag
                if power > best[k]:
                    best[k], top[k] = power, f
            total = np.float32(0)
            for r in range(RX):
                z = spectrum[f * records + chirps + r]
                total += z.real * z.real + z.imag * z.imag
            band[f] = total
        for k in range(chirps):
            frequency[p, k], amplitude[p, k] = _interpolated(spectrum[k::records], top[k], n)
        centre[p] = _highest(band, smooth, BAND_BINS * size // n // 2) / size
    return frequency, amplitude, centre, energy, peak


@compiled
def _interpolated(spectrum, top, samples):
    """`tone.strongest`, given the strongest bin."""
    size = spectrum.size
    at = spectrum[top]
    below, peak, above = abs(spectrum[(top - 1) % size]), abs(at), abs(spectrum[(top + 1) % size])
    bend = below - 2 * peak + above
    part = 0.5 * (below - above) / bend if bend < 0 else 0.0
    whole = (top if top < size // 2 else top - size) / size
    c, s = kernels.cis(whole * (samples - 1) / 2)
    return whole + part / size, at * complex(c, s)


@compiled
def _highest(power, smooth, width):
    """Where the power is highest after three boxes of a width; overwrites both."""
    size = power.size
    for _ in range(3):
        total = 0.0
        for i in range(width):
            total += power[(i - width // 2) % size]
        for i in range(size):
            smooth[i] = total
            total += power[(i - width // 2 + width) % size] - power[(i - width // 2) % size]
        power, smooth = smooth, power
    return np.argmax(power)


def against_others(words, frequency, taps, good, linear):
    """See `plain.against_others`."""
    edges = block_edges((linear[1] - linear[0]) // FOLD)
    return _against_others(words, frequency, taps, good, linear, edges, block_times(edges) * FOLD)


@compiled
def _against_others(words, frequency, taps, good, linear, edges, times):
    positions, chirps, samples, _, _ = words.shape
    a, b = linear[0] * RX, linear[1] * RX
    blocks, parts = (b - a) // LANES, times.size
    origin = (linear[1] - linear[0] - 1) / 2
    found, amplitude = np.empty((positions, chirps)), np.empty((positions, chirps), np.complex128)
    own, level = np.empty((positions, chirps), np.float32), np.empty(positions, np.float32)
    apart = np.empty((2, positions, chirps))
    x, y = np.empty(samples * RX, np.float32), np.empty(samples * RX, np.float32)
    mixed_re, mixed_im = np.empty(b - a, np.float32), np.empty(b - a, np.float32)
    raw_re, raw_im = np.empty((blocks + 2) * RX, np.float32), np.empty((blocks + 2) * RX, np.float32)
    re, im = np.empty((chirps, blocks * RX), np.float32), np.empty((chirps, blocks * RX), np.float32)
    all_re, all_im = np.empty(blocks * RX, np.float32), np.empty(blocks * RX, np.float32)
    within, steps = np.empty((2, LANES), np.float32), np.empty((2, blocks), np.float32)
    product_re, product_im = np.empty(blocks * RX, np.float32), np.empty(blocks * RX, np.float32)
    energy = np.empty(blocks * RX, np.float32)
    part = np.empty((3, 2, parts), np.float32)  # real, imaginary, energy; of even and of odd RX
    even, odd = np.empty(parts, np.complex128), np.empty(parts, np.complex128)
    rest = np.empty(parts, np.complex128)
    for p in range(positions):
        re[:] = 0
        im[:] = 0
        all_re[:] = 0
        all_im[:] = 0
        for k in range(chirps):
            kernels.split(words[p, k].reshape(-1), x, y)
            kernels.ramp(frequency[p, k], origin, within, steps)
            kernels.mix(x[a:b], y[a:b], within, steps, mixed_re, mixed_im)
            kernels.fold(mixed_re, raw_re[RX:-RX])
            kernels.fold(mixed_im, raw_im[RX:-RX])
            kernels.extend(raw_re, RX)
            kernels.extend(raw_im, RX)
            kernels.add_filtered(raw_re, raw_im, taps[p, k], RX, re[k], im[k])
            if good[p, k]:
                all_re += re[k]
                all_im += im[k]
        total = np.float32(0)
        for j in range(blocks * RX):
            total += all_re[j] * all_re[j] + all_im[j] * all_im[j]
        level[p] = total
        for k in range(chirps):
            own[p, k] = kernels.correlate(re[k], im[k], all_re, all_im, product_re, product_im)
            for j in range(blocks * RX):
                energy[j] = re[k, j] * re[k, j] + im[k, j] * im[k, j]
            kernels.by_part(product_re, edges, part[0, 0], part[0, 1])
            kernels.by_part(product_im, edges, part[1, 0], part[1, 1])
            kernels.by_part(energy, edges, part[2, 0], part[2, 1])
            for i in range(parts):
                even[i], odd[i] = complex(part[0, 0, i], part[1, 0, i]), complex(part[0, 1, i], part[1, 1, i])
                rest[i] = even[i] + odd[i] - (part[2, 0, i] + part[2, 1, i]) * good[p, k]
            w, amplitude[p, k] = kernels.newton(rest, times, 2)
            found[p, k] = w / (2 * np.pi)
            for i in range(parts):
                c, s = kernels.cis(-w * times[i] / (2 * np.pi))
                even[i] *= complex(c, s)
                odd[i] *= complex(c, s)
            w, z = kernels.newton(even, times, 1)
            w_odd, z_odd = kernels.newton(odd, times, 1)
            z *= z_odd.conjugate()
            apart[0, p, k], apart[1, p, k] = (w - w_odd) / (2 * np.pi), np.arctan2(z.imag, z.real)
    return found, amplitude, own, level, apart


@compiled
def average(words, frequency, weights, second_half, linear):
    """See `plain.average`."""
    positions, chirps, samples, _, _ = words.shape
    a, b = linear
    full, blocks, count = -(-samples // FOLD), (b - a) // FOLD, weights.shape[2]
    mean = np.zeros((positions, RX, samples), np.complex64)
    halves = np.empty((positions, 2, RX, blocks), np.complex64)
    x, y = np.zeros(full * LANES, np.float32), np.zeros(full * LANES, np.float32)
    re, im = np.empty((full + 2) * LANES, np.float32), np.empty((full + 2) * LANES, np.float32)
    within, steps = np.empty((2, LANES), np.float32), np.empty((2, full), np.float32)
    total = np.empty((2, 2, samples * RX), np.float32)
    block_re, block_im = np.empty(blocks * RX, np.float32), np.empty(blocks * RX, np.float32)
    inside = slice(LANES, LANES + full * LANES)
    for p in range(positions):
        total[:] = 0
        for k in range(chirps):
            if weights[p, k, count // 2] == 0:
                continue
            kernels.split(words[p, k].reshape(-1), x, y)
            kernels.ramp(frequency[p, k], (a + b - 1) / 2, within, steps)
            kernels.mix(x, y, within, steps, re[inside], im[inside])
            kernels.extend(re[: samples * RX + 2 * LANES], LANES)
            kernels.extend(im[: samples * RX + 2 * LANES], LANES)
            h = 1 if second_half[p, k] else 0
            kernels.add_filtered(re, im, weights[p, k], LANES, total[h, 0], total[h, 1])
        for h in range(2):
            kernels.fold(total[h, 0, a * RX : b * RX], block_re)
            kernels.fold(total[h, 1, a * RX : b * RX], block_im)
            for r in range(RX):
                for m in range(blocks):
                    halves[p, h, r, m] = complex(block_re[m * RX + r], block_im[m * RX + r])
        for r in range(RX):
            for n in range(samples):
                j = n * RX + r
                mean[p, r, n] = complex(total[0, 0, j] + total[1, 0, j], total[0, 1, j] + total[1, 1, j])
    return mean, halves
