"""The three passes over a burst's raw samples, in NumPy: what `host.sync.compiled` does, plainly and more slowly.

Frames are int16 [position, chirp, sample, 2, rx] as the card sends them, I before Q; a pass takes what :func:`load`
makes of them. Mixing is by `exp(-j 2 pi f (n - centre))`, with f in cycles a sample and `centre` the middle of the
linear samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from host.sync import hpf
from host.sync.tone import phasor

CHUNK = 8
"""Positions at a time: the working set stays in the second-level cache."""

FOLD = 4
"""Samples that are averaged before the second estimate: tones 2.7 IF bins off the middle lose 0.8 % of their power."""

Frames = NDArray[np.complex64]


def load(words: NDArray[np.int16]) -> Frames:
    """Complex64 [position, chirp, rx, sample] of raw frames."""
    positions, chirps, samples, _, rx = words.shape
    out = np.empty((positions, chirps, rx, samples), np.complex64)
    out.real = words[..., 0, :].swapaxes(2, 3)
    out.imag = words[..., 1, :].swapaxes(2, 3)
    return out


def products(
    frames: Frames, reference: NDArray[np.intp], linear: tuple[int, int], size: int
) -> tuple[NDArray[np.complex64], NDArray[np.complex64], NDArray[np.float32], NDArray[np.int32]]:
    """Conjugate products with a reference chirp, summed over the RX.

    Parameters
    ----------
    frames
        From :func:`load`.
    reference
        int [position]: the reference chirp of each.
    linear
        Linear samples `[a, b)`.
    size
        Length that is padded to with zeros.

    Returns
    -------
    products
        complex64 [position, chirp, size].
    chosen
        complex64 [position, rx, size]: the reference chirps' linear samples.
    energy
        float32 [position, chirp], over RX and linear samples.
    peak
        int32 [position, chirp]: largest |I| or |Q| of the whole chirp.
    """
    a, b = linear
    positions, chirps, rx, _ = frames.shape
    inside = frames[..., a:b]
    chosen = np.zeros((positions, rx, size), np.complex64)
    chosen[..., : b - a] = inside[np.arange(positions), reference]
    out = np.zeros((positions, chirps, size), np.complex64)
    out[..., : b - a] = (inside * chosen[:, None, :, : b - a].conj()).sum(axis=2)
    energy = (inside.real**2 + inside.imag**2).sum(axis=(2, 3))
    parts = frames.view(np.float32)
    peak = np.maximum(parts.max(axis=(2, 3)), -parts.min(axis=(2, 3)))
    return out, chosen, energy, peak.astype(np.int32)


def against_others(
    frames: Frames,
    frequency: NDArray[np.float64],
    taps: NDArray[np.complex64],
    good: NDArray[np.bool_],
    linear: tuple[int, int],
    edges: NDArray[np.intp],
) -> tuple[NDArray[np.complex64], NDArray[np.float32], NDArray[np.float32]]:
    """Mix down, average every `FOLD` samples, filter, and multiply each chirp with the sum of the good ones.

    Parameters
    ----------
    frames
        From :func:`load`.
    frequency
        float64 [position, chirp].
    taps
        complex64 [position, chirp, tap]: one or three, one averaged sample apart (`hpf.Equaliser`).
    good
        bool [position, chirp].
    linear
        Linear samples `[a, b)`, a multiple of `FOLD` many.
    edges
        Where the averaged samples are cut into parts.

    Returns
    -------
    sums
        complex64 [2, position, chirp, part]: products over even and over odd RX.
    own
        float32 [position, chirp, part]: the chirp's own share of them, energy over all RX.
    level
        float32 [position]: energy of the good chirps' sum.
    """
    a, b = linear
    turn = phasor(-frequency, np.zeros(frequency.shape), b - a, (b - a - 1) / 2)
    mixed = frames[..., a:b] * turn[:, :, None]
    folded = hpf.filtered(_fold(mixed), taps)
    positions, chirps, rx, blocks = folded.shape
    total = (good[:, None].astype(np.complex64) @ folded.reshape(positions, chirps, rx * blocks)).reshape(
        positions, 1, rx, blocks
    )
    product = folded * total.conj()
    halves = np.stack([product[:, :, 0::2].sum(axis=2), product[:, :, 1::2].sum(axis=2)])
    own = (folded.real**2 + folded.imag**2).sum(axis=2)
    return (
        np.add.reduceat(halves, edges[:-1], axis=-1),
        np.add.reduceat(own, edges[:-1], axis=-1),
        (total.real**2 + total.imag**2).sum(axis=(1, 2, 3)),
    )


def average(
    frames: Frames,
    frequency: NDArray[np.float64],
    weights: NDArray[np.complex64],
    second_half: NDArray[np.bool_],
    linear: tuple[int, int],
) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Weighted sum over the chirps, each mixed down.

    Parameters
    ----------
    frames
        From :func:`load`.
    frequency
        float64 [position, chirp].
    weights
        complex64 [position, chirp, tap]: one or three, `FOLD` samples apart.
    second_half
        bool [position, chirp]: which of two halves a chirp belongs to.
    linear
        Linear samples `[a, b)`, a multiple of `FOLD` many.

    Returns
    -------
    mean
        complex64 [position, rx, sample].
    halves
        complex64 [position, 2, rx, averaged sample]: each half's part in the mean, every `FOLD` linear samples
        averaged.
    """
    a, b = linear
    positions, chirps, rx, samples = frames.shape
    turn = phasor(-frequency, np.zeros(frequency.shape), samples, (a + b - 1) / 2)
    mixed = (frames * turn[:, :, None]).reshape(positions, chirps, rx * samples)
    split = np.stack([~second_half, second_half], axis=1)[:, :, None] * weights.swapaxes(1, 2)[:, None]
    taps = weights.shape[2]
    terms = (split.reshape(positions, 2 * taps, chirps) @ mixed).reshape(positions * 2, taps, rx, samples)
    parts = hpf.shifted(terms, FOLD).sum(axis=1).reshape(positions, 2, rx, samples)
    return parts.sum(axis=1), _fold(parts[..., a:b])


def _fold(signal: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Averages of every `FOLD` samples along the last axis."""
    out = signal[..., ::FOLD].copy()
    for q in range(1, FOLD):
        out += signal[..., q::FOLD]
    out *= np.float32(1 / FOLD)
    return out
