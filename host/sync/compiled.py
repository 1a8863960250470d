"""The passes of `numpy_passes.py`, compiled: a chirp is taken from the card's words into the cache and used there.

Each pass reads the words anew, which costs less than any copy of them in memory would, and all of a chirp even where
only its linear samples are needed: memory is fetched ahead only where it is read in line. For four RX. Compiled at the
first call and cached on disk.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from polysight.host.sync import compiled_loops as kernels
from polysight.host.sync.compiled_loops import LANES, RX, compiled
from polysight.host.sync.numpy_passes import BAND_BINS, FOLD
from polysight.host.sync.tone import block_edges, block_times, search_size

CHUNK = 512
"""Positions at a time: as many as NumPy needs for its calls to cost little; reading words from memory costs less."""

_roots = lru_cache(kernels.roots)


def match(words, reference, linear):
    """See `numpy_passes.match`."""
    n = linear[1] - linear[0]
    c, s, order = _roots(search_size(n))
    frequency, amplitude, energy, peak = _offsets(words, reference, linear, c, s, order)
    centre = _centres(words, reference, linear, c, s, order, BAND_BINS * order.size // n // 2)
    return frequency, amplitude, centre, energy, peak


@compiled
def _offsets(words, reference, linear, c, s, order):
    """What :func:`match` returns, but for the centre."""
    positions, chirps, _, _, _ = words.shape
    a, b = linear
    n, size = b - a, order.size
    frequency, amplitude = np.empty((positions, chirps)), np.empty((positions, chirps), np.complex128)
    energy, peak = np.empty((positions, chirps), np.float32), np.empty((positions, chirps), np.int32)
    flat, spare = np.empty(n * 2 * RX, np.int16), np.empty(n * 2 * RX, np.int16)
    x, u = flat.reshape(2 * RX, n), np.empty((2 * RX, n), np.float32)
    product_re, product_im = np.empty(LANES * n, np.float32), np.empty(LANES * n, np.float32)
    re, im = np.empty(LANES * size, np.float32), np.empty(LANES * size, np.float32)
    power, between = np.empty(LANES * size, np.float32), np.empty(LANES * n, np.float32)
    bins, best = order.repeat(LANES), np.empty(LANES * size, np.int32)
    place = np.argsort(order)
    for p in range(positions):
        kernels.by_channel(words[p, reference[p], a:b].reshape(-1), flat, spare)
        for i in range(2 * RX):
            for j in range(n):
                u[i, j] = x[i, j]
        for first in range(0, chirps, LANES):
            count = min(LANES, chirps - first)
            product_re[count * n :] = 0
            product_im[count * n :] = 0
            for k in range(count):
                peak[p, first + k] = kernels.largest(words[p, first + k].reshape(-1))
                kernels.by_channel(words[p, first + k, a:b].reshape(-1), flat, spare)
                own = slice(k * n, (k + 1) * n)
                energy[p, first + k] = kernels.correlate(x, u, product_re[own], product_im[own])
            kernels.interleave(product_re, between, re)
            kernels.interleave(product_im, between, im)
            kernels.transform(re, im, c, s)
            for j in range(power.size):
                power[j] = re[j] * re[j] + im[j] * im[j]
                best[j] = bins[j]
            kernels.strongest(power, best)
            for k in range(count):
                tone = _interpolated(re[k::LANES], im[k::LANES], place, best[k], n)
                frequency[p, first + k], amplitude[p, first + k] = tone
    return frequency, amplitude, energy, peak


@compiled
def _interpolated(re, im, place, top, samples):
    """`tone.strongest`, given the strongest bin; bins of the spectrum are at `place`."""
    size, at = re.size, place[top]
    i, j = place[(top - 1) % size], place[(top + 1) % size]
    below, peak, above = math.hypot(re[i], im[i]), math.hypot(re[at], im[at]), math.hypot(re[j], im[j])
    bend = below - 2 * peak + above
    part = 0.5 * (below - above) / bend if bend < 0 else 0.0
    whole = (top if top < size // 2 else top - size) / size
    c, s = kernels.cis(whole * (samples - 1) / 2)
    return whole + part / size, complex(re[at], im[at]) * complex(c, s)


@compiled
def _centres(words, reference, linear, c, s, order, width):
    """The centre that :func:`match` returns, of as many positions at once as fill the transform with their RX."""
    positions, at_once = words.shape[0], LANES // RX
    a, b = linear
    n, size = b - a, order.size
    centre = np.empty(positions)
    flat, spare = np.empty(n * 2 * RX, np.int16), np.empty(n * 2 * RX, np.int16)
    signal_re, signal_im = np.zeros(LANES * n, np.float32), np.zeros(LANES * n, np.float32)
    re, im = np.empty(LANES * size, np.float32), np.empty(LANES * size, np.float32)
    between, power, smooth = np.empty(LANES * n, np.float32), np.empty(size + width), np.empty(size + width)
    for first in range(0, positions, at_once):
        count = min(at_once, positions - first)
        for p in range(count):
            kernels.by_channel(words[first + p, reference[first + p], a:b].reshape(-1), flat, spare)
            start = p * RX * n
            for j in range(RX * n):
                signal_re[start + j], signal_im[start + j] = flat[j], flat[RX * n + j]
        kernels.interleave(signal_re, between, re)
        kernels.interleave(signal_im, between, im)
        kernels.transform(re, im, c, s)
        for p in range(count):
            for i in range(size):
                total = np.float32(0)
                for r in range(RX):
                    j = i * LANES + p * RX + r
                    total += re[j] * re[j] + im[j] * im[j]
                power[order[i]] = total
            centre[first + p] = _highest(power, smooth, width) / size
    return centre


@compiled
def _highest(power, smooth, width):
    """Where the power, which has `width` values of room behind it, is highest after three boxes; overwrites both."""
    size = power.size - width
    for _ in range(3):
        power[size:] = power[:width]
        total = 0.0
        for i in range(width):
            total += power[i]
        for i in range(size):
            smooth[i] = total  # of the box that begins here
            total += power[i + width] - power[i]
        power, smooth = smooth, power
    return (np.argmax(power[:size]) + 3 * (width // 2)) % size


def against_others(words, frequency, taps, good, linear):
    """See `numpy_passes.against_others`."""
    edges = block_edges((linear[1] - linear[0]) // FOLD)
    return _against_others(words, frequency, taps, good, linear, edges, block_times(edges) * FOLD)


@compiled
def _against_others(words, frequency, taps, good, linear, edges, times):
    positions, chirps, samples, _, _ = words.shape
    a, b = linear
    blocks, parts, origin = (b - a) // FOLD, times.size, (b - a - 1) / 2
    found, amplitude = np.empty((positions, chirps)), np.empty((positions, chirps), np.complex128)
    own, level = np.empty((positions, chirps), np.float32), np.empty(positions, np.float32)
    apart = np.empty((2, positions, chirps))
    read = (samples - a) // FOLD  # blocks to the chirp's end
    flat, spare = np.empty(read * LANES * 2, np.int16), np.empty(read * LANES * 2, np.int16)
    x = flat.reshape(FOLD, 2, RX, read)
    c, s = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    # RX behind each other, two values between them that mean nothing.
    mixed_re, mixed_im = np.empty(RX * (blocks + 2), np.float32), np.empty(RX * (blocks + 2), np.float32)
    n = mixed_re.size - 2
    re, im = np.empty((chirps, n), np.float32), np.empty((chirps, n), np.float32)
    all_re, all_im = np.empty(n, np.float32), np.empty(n, np.float32)
    product = np.empty((5, blocks), np.float32)  # real, imaginary of even RX, of odd RX; energy
    part = np.empty((5, parts), np.float32)
    even, odd = np.empty(parts, np.complex128), np.empty(parts, np.complex128)
    rest = np.empty(parts, np.complex128)
    for p in range(positions):
        re[:] = 0
        im[:] = 0
        all_re[:] = 0
        all_im[:] = 0
        for k in range(chirps):
            kernels.by_phase(words[p, k, a : a + read * FOLD].reshape(-1), flat, spare)
            kernels.steps(frequency[p, k], origin, c, s)
            kernels.mix_and_fold(x, frequency[p, k], c, s, mixed_re, mixed_im)
            kernels.add_filtered(mixed_re, mixed_im, taps[p, k], 1, re[k], im[k])
            if good[p, k]:
                all_re += re[k]
                all_im += im[k]
        total = np.float32(0)
        for r in range(RX):
            for j in range(r * (blocks + 2), r * (blocks + 2) + blocks):
                total += all_re[j] * all_re[j] + all_im[j] * all_im[j]
        level[p] = total
        for k in range(chirps):
            product[:] = 0
            for r in range(RX):
                j, h = slice(r * (blocks + 2), r * (blocks + 2) + blocks), r % 2 * 2
                kernels.add_products(re[k, j], im[k, j], all_re[j], all_im[j], product[h], product[h + 1], product[4])
            for h in range(5):
                kernels.add_up(product[h], edges, part[h])
            own[p, k] = part[4].sum()
            for i in range(parts):
                even[i], odd[i] = complex(part[0, i], part[1, i]), complex(part[2, i], part[3, i])
                rest[i] = even[i] + odd[i] - part[4, i] * good[p, k]
            w, amplitude[p, k] = kernels.newton(rest, times, 2)
            found[p, k] = w / (2 * np.pi)
            for i in range(parts):
                turn_re, turn_im = kernels.cis(-w * times[i] / (2 * np.pi))
                even[i] *= complex(turn_re, turn_im)
                odd[i] *= complex(turn_re, turn_im)
            w, z = kernels.newton(even, times, 1)
            w_odd, z_odd = kernels.newton(odd, times, 1)
            z *= z_odd.conjugate()
            apart[0, p, k], apart[1, p, k] = (w - w_odd) / (2 * np.pi), np.arctan2(z.imag, z.real)
    return found, amplitude, own, level, apart


@compiled
def average(words, frequency, weights, second_half, linear):
    """See `numpy_passes.average`."""
    positions, chirps, samples, _, _ = words.shape
    a, b = linear
    full, blocks, count = -(-samples // FOLD), (b - a) // FOLD, weights.shape[2]
    mean = np.empty((positions, RX, samples), np.complex64)
    halves = np.empty((positions, 2, RX, blocks), np.complex64)
    fours_x, fours_y = np.zeros(full * FOLD, np.int64), np.zeros(full * FOLD, np.int64)  # words of four RX in one
    x, y = fours_x.view(np.int16), fours_y.view(np.int16)
    re, im = np.empty((full + 2) * LANES, np.float32), np.empty((full + 2) * LANES, np.float32)
    c, s = np.empty(full, np.float32), np.empty(full, np.float32)
    total = np.empty((2, 2, samples * RX), np.float32)
    block_re, block_im = np.empty(blocks * RX, np.float32), np.empty(blocks * RX, np.float32)
    inside = slice(LANES, LANES + full * LANES)
    for p in range(positions):
        total[:] = 0
        for k in range(chirps):
            if weights[p, k, count // 2] == 0:
                continue
            kernels.unzip(words[p, k].reshape(-1).view(np.int64), fours_x[:samples], fours_y[:samples])
            kernels.steps(frequency[p, k], (a + b - 1) / 2, c, s)
            kernels.mix(x, y, frequency[p, k], c, s, re[inside], im[inside])
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
