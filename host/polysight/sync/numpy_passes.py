"""Three passes over the raw samples of a burst, in NumPy: the readable form of `passes.h`, with equal results.

Words are int16 [position, chirp, sample, 2, rx] as the card sends them, I before Q. Mixing multiplies by
`exp(-j 2 pi f (n - centre))`, with f in cycles per sample and `centre` the middle of the linear samples.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.sync import high_pass_filter as hpf
from polysight.sync.tone import block_edges, block_times, cis, phasor, refine, search_size, strongest

CHUNK = 8
"""Positions per chunk: the working set fits in the second-level cache."""

FOLD = 4
"""Samples averaged before the second estimate: tones 2.7 IF bins off the middle lose 0.8 % of their power."""

BAND_BINS = 9
"""Width in IF bins of the signal's band: direct path and object lie within it."""


def match(
    words: NDArray[np.int16], reference: NDArray[np.intp], linear: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]:
    """Find the tone between each chirp and a reference chirp: the strongest in their conjugate product over all RX.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx].
    reference
        int [position]: the reference chirp of each.
    linear
        Linear samples `[a, b)`.

    Returns
    -------
    frequency
        float64 [position, chirp], cycles per sample, within some hundredths of a bin.
    amplitude
        complex128 [position, chirp]: the tone's sum over RX and linear samples, at their middle.
    centre
        float64 [position]: middle of the band of the reference chirp, cycles per sample 0..1: maximum of the power
        spectrum of all RX after three passes of a box filter of half `BAND_BINS`.
    energy
        float32 [position, chirp], over RX and linear samples.
    peak
        int32 [position, chirp]: largest |I| or |Q| of the whole chirp.
    """
    frames = _complex(words)
    n, (positions, chirps, rx, _) = linear[1] - linear[0], frames.shape
    size = search_size(n)
    inside = frames[..., slice(*linear)]
    chosen = np.zeros((positions, rx, size), np.complex64)
    chosen[..., :n] = inside[np.arange(positions), reference]
    products = np.zeros((positions, chirps, size), np.complex64)
    products[..., :n] = (inside * chosen[:, None, :, :n].conj()).sum(axis=2)
    tone = strongest(products, n)

    spectrum: NDArray[np.complex64] = np.asarray(scipy.fft.fft(chosen, axis=-1))
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1)
    for _ in range(3):  # nearly Gaussian: two tones give one peak between them
        power = scipy.ndimage.uniform_filter1d(power, BAND_BINS * size // n // 2, axis=-1, mode="wrap")
    energy = (inside.real**2 + inside.imag**2).sum(axis=(2, 3))
    parts = frames.view(np.float32)
    peak = np.maximum(parts.max(axis=(2, 3)), -parts.min(axis=(2, 3))).astype(np.int32)
    return tone.frequency, tone.amplitude.astype(complex), np.argmax(power, axis=-1) / size, energy, peak


def against_others(
    words: NDArray[np.int16],
    frequency: NDArray[np.float64],
    taps: NDArray[np.complex64],
    good: NDArray[np.bool_],
    linear: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Mix down, average every `FOLD` samples, filter; find the tone between each chirp and the sum of all others.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx].
    frequency
        float64 [position, chirp].
    taps
        complex64 [position, chirp, tap]: one or three, one averaged sample apart (`high_pass.Equaliser`).
    good
        bool [position, chirp]: chirps in the sum.
    linear
        Linear samples `[a, b)`, a multiple of `FOLD` many.

    Returns
    -------
    frequency, amplitude
        float64 and complex128 [position, chirp]: the tone from `tone.refine`, two Newton steps from zero.
    energy
        float32 [position, chirp]: energy of the chirp, over RX and averaged samples.
    level
        float32 [position]: energy of the good chirps' sum.
    apart
        float64 [2, position, chirp]: difference of the tones from even and from odd RX, with the chirp itself in the
        sum: cycles per sample, and radians.
    """
    a, b = linear
    turn = phasor(-frequency, np.zeros(frequency.shape), b - a, (b - a - 1) / 2)
    folded = hpf.filtered(_fold(_complex(words)[..., a:b] * turn[:, :, None]), taps)
    positions, chirps, rx, blocks = folded.shape
    total = (good[:, None].astype(np.complex64) @ folded.reshape(positions, chirps, rx * blocks)).reshape(
        positions, 1, rx, blocks
    )
    edges = block_edges(blocks)
    times, starts = block_times(edges) * FOLD, edges[:-1]
    product = folded * total.conj()
    halves = np.stack([product[:, :, 0::2].sum(axis=2), product[:, :, 1::2].sum(axis=2)])
    sums = np.add.reduceat(halves, starts, axis=-1).astype(complex)
    own = np.add.reduceat((folded.real**2 + folded.imag**2).sum(axis=2), starts, axis=-1)
    tone = refine(sums[0] + sums[1] - np.where(good[..., None], own, 0), times, steps=2)
    split = refine(sums * cis(-2 * np.pi * tone.frequency[..., None] * times), times, steps=1)
    apart = split.frequency[0] - split.frequency[1], np.angle(split.amplitude[0] * split.amplitude[1].conj())
    return (
        tone.frequency,
        tone.amplitude.astype(complex),
        own.sum(axis=-1),
        (total.real**2 + total.imag**2).sum(axis=(1, 2, 3)),
        np.stack(apart),
    )


def average(
    words: NDArray[np.int16],
    frequency: NDArray[np.float64],
    weights: NDArray[np.complex64],
    second_half: NDArray[np.bool_],
    linear: tuple[int, int],
) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Return the weighted sum of the chirps, each mixed down.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx].
    frequency
        float64 [position, chirp].
    weights
        complex64 [position, chirp, tap]: one or three, `FOLD` samples apart.
    second_half
        bool [position, chirp]: True for chirps of the second half.
    linear
        Linear samples `[a, b)`, a multiple of `FOLD` many.

    Returns
    -------
    mean
        complex64 [position, rx, sample].
    halves
        complex64 [position, 2, rx, block]: contribution of each half to the mean, averaged over `FOLD` linear samples.
    """
    a, b = linear
    frames = _complex(words)
    positions, chirps, rx, samples = frames.shape
    turn = phasor(-frequency, np.zeros(frequency.shape), samples, (a + b - 1) / 2)
    mixed = (frames * turn[:, :, None]).reshape(positions, chirps, rx * samples)
    split = np.stack([~second_half, second_half], axis=1)[:, :, None] * weights.swapaxes(1, 2)[:, None]
    taps = weights.shape[2]
    terms = (split.reshape(positions, 2 * taps, chirps) @ mixed).reshape(positions * 2, taps, rx, samples)
    parts = hpf.shifted(terms, FOLD).sum(axis=1).reshape(positions, 2, rx, samples)
    return parts.sum(axis=1), _fold(parts[..., a:b])


def _complex(words: NDArray[np.int16]) -> NDArray[np.complex64]:
    """Return raw words as complex64 [position, chirp, rx, sample]."""
    positions, chirps, samples, _, rx = words.shape
    out = np.empty((positions, chirps, rx, samples), np.complex64)
    out.real = words[..., 0, :].swapaxes(2, 3)
    out.imag = words[..., 1, :].swapaxes(2, 3)
    return out


def _fold(signal: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Return the averages of every `FOLD` samples along the last axis."""
    out = signal[..., ::FOLD].copy()
    for q in range(1, FOLD):
        out += signal[..., q::FOLD]
    out *= np.float32(1 / FOLD)
    return out
