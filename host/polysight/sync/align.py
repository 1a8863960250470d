"""Burst alignment: estimate and remove the frequency and phase offset of each chirp in a burst, then average.

A board samples SYNC_IN with its own clock, so each chirp is the same signal times `exp(j(2 pi df t + dphi))` (paper,
eq. 4). The conjugate product with a reference chirp, summed over the RX, is a tone with the positive envelope
`|s(t)|^2`; the maximum of its spectrum is the maximum-likelihood offset for any signal `s`. The paper divides by the
reference chirp instead, which amplifies noise where direct path and object cancel.

After mixing each chirp to zero frequency, its signal fills only a few range bins, so four consecutive samples can be
averaged. Filter compensation and a second estimate (each chirp against the sum of all others) use these averages. Only
the final average of the chirps is computed at the full sample rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.sync import high_pass_filter as hpf
from polysight.sync import loops
from polysight.sync.loops import FOLD, Real, Tone, cis, complex64

_REFERENCES = 4  # reference chirps tried per position
_GOOD = 0.5  # a good chirp has at least this part of the coherence of the position's median chirp


class AlignedRow(NamedTuple):
    """The averaged chirps of every position of a row, mixed down by `centre`.

    Attributes
    ----------
    mean
        complex64 [position, rx, sample], in the frame of each position's reference chirp.
    halves
        complex64 [position, 2, rx, block]: contributions of alternate good chirps to `mean`, averaged over blocks of
        `FOLD` linear samples.
    centre
        float64 [position]: middle of the signal's band in the reference chirp, cycles per sample.
    good
        bool [position, chirp]: chirps in the average.
    frequency, phase
        float64 [position, chirp]: offset of each chirp from the average, cycles per sample, and radians at the
        centre of the linear samples.
    amplitude
        float64 [position, chirp]: amplitude relative to the average, after compensation.
    gain
        float64 [position, chirp]: gain of the filter compensation at the chirp's centre.
    error
        float64 [position, 2, chirp]: frequency (cycles per sample) and phase (rad) error of a chirp after alignment:
        half the difference between two halves of the RX; zero where not good.
    coherence
        float64 [position, chirp]: normalised correlation with the average, 0..1.
    peak
        int32 [position, chirp]: largest |I| or |Q|, ADC counts.
    """

    mean: NDArray[np.complex64]
    halves: NDArray[np.complex64]
    centre: NDArray[np.float64]
    good: NDArray[np.bool_]
    frequency: NDArray[np.float64]
    phase: Real
    amplitude: NDArray[np.float64]
    gain: NDArray[np.float64]
    error: NDArray[np.float64]
    coherence: NDArray[np.float64]
    peak: NDArray[np.int32]

    def part(self, positions: slice) -> AlignedRow:
        """Return views of some positions."""
        return AlignedRow._make(field[positions] for field in self)


Align = Callable[
    [NDArray[np.int16], NDArray[np.bool_], tuple[int, int], hpf.Equaliser | None, int, AlignedRow],
    None,
]
"""Aligns positions: words, valid, linear samples in whole blocks, filter compensation, full scale; into a row."""


def align_row(
    words: NDArray[np.int16],
    valid: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None = None,
    full_scale: int = 32767,
) -> AlignedRow:
    """Align and average the burst of every position: compiled (`burst.c`) if possible, otherwise in NumPy.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx]: raw frames, I before Q.
    valid
        bool [position, chirp]: chirps received whole.
    linear
        Samples `[a, b)` in which the chirp is linear; estimates use only these, the average all samples.
    equaliser
        Compensates the receiver's high-pass filter; None: no compensation.
    full_scale
        Value of a clipped sample; clipped chirps are left out, for clipping creates false tones.
    """
    return align_pieces([words], valid, linear, equaliser, full_scale)


def align_pieces(
    pieces: Iterable[NDArray[np.int16]],
    valid: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None = None,
    full_scale: int = 32767,
    by: Align | None = None,
) -> AlignedRow:
    """Align and average a row that comes in pieces of some positions; parameters as of :func:`align_row`.

    A piece is not used after the next one is taken, so all may share their memory. `by` is compiled or
    :func:`align_in_numpy`, with equal results; None: compiled if possible.

    Raises
    ------
    ValueError
        if there is no piece, or the pieces are not the positions of `valid`.
    """
    linear, row, done = whole_blocks(linear), None, 0
    for words in pieces:
        if row is None:
            row = _empty_row(valid.shape, words.shape, (linear[1] - linear[0]) // FOLD)
        here = slice(done, done + len(words))
        if words.shape[:2] != valid[here].shape:
            raise ValueError(f"bursts {words.shape[:2]} at position {done} of {valid.shape}")
        align = by or _choose_loop(words.shape[-1])
        align(words, valid[here], linear, equaliser, full_scale, row.part(here))
        done = here.stop
    if row is None or done != len(valid):
        raise ValueError(f"{done} of {len(valid)} positions")
    return row


def _choose_loop(rx: int) -> Align:
    library = loops.library() if rx == loops.RX else None
    return library.align if library else align_in_numpy


def align_in_numpy(
    words: NDArray[np.int16],
    valid: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None,
    full_scale: int,
    into: AlignedRow,
) -> None:
    """Align and average positions in NumPy, for any number of RX: the readable form of `burst.c`."""
    words = np.ascontiguousarray(words)
    for i in range(0, len(valid), loops.CHUNK):
        here = slice(i, i + loops.CHUNK)
        for field, values in zip(into, _align(words[here], valid[here], linear, equaliser, full_scale), strict=True):
            field[here] = values


def _empty_row(bursts: tuple[int, ...], words: tuple[int, ...], blocks: int) -> AlignedRow:
    """Return memory for the row: bursts [position, chirp], words [position, chirp, sample, 2, rx]."""
    (positions, chirps), samples, rx = bursts, words[2], words[-1]
    return AlignedRow(
        mean=np.empty((positions, rx, samples), np.complex64),
        halves=np.empty((positions, 2, rx, blocks), np.complex64),
        centre=np.empty(positions),
        good=np.empty(bursts, np.bool_),
        frequency=np.empty(bursts),
        phase=np.empty(bursts),
        amplitude=np.empty(bursts),
        gain=np.empty(bursts),
        error=np.empty((positions, 2, chirps)),
        coherence=np.empty(bursts),
        peak=np.empty(bursts, np.int32),
    )


def _align(
    words: NDArray[np.int16],
    valid: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None,
    full_scale: int,
) -> AlignedRow:
    """Align and average a few positions."""
    first, centre, coherence, usable, peak = _against_one(words, valid, linear, full_scale)
    good = _coherent(coherence, usable)
    frequency = centre[:, None] + first.frequency
    taps = _taps(equaliser, frequency)
    start = np.angle(first.amplitude * taps.sum(axis=-1))

    # Second pass: each chirp against the sum of the others.
    turned = taps * cis(-start)[..., None]
    off, product, own, level, apart = loops.against_others(words, frequency, complex64(turned), good, linear)
    n = good.sum(axis=1)
    level = np.maximum(level / np.maximum(n, 1) ** 2, 1e-30)[:, None]
    others = n[:, None] - good
    # A single chirp is the mean itself.
    amplitude = np.where(others > 0, np.abs(product) / np.maximum(others, 1) / level, 1.0)
    # The difference from the mean of all chirps is smaller than that from the mean of the others.
    part = others / np.maximum(n, 1)[:, None]
    correction, shift = part * off, part * np.angle(product)
    coherence = amplitude * np.sqrt(level / np.maximum(own, 1e-30))
    good = _coherent(coherence, usable)

    # Filtering and then turning by the correction equals turning and then filtering with turned taps.
    lag = np.arange(taps.shape[-1]) - taps.shape[-1] // 2
    turned *= cis(2 * np.pi * FOLD * lag * correction[..., None] - shift[..., None])
    weights = turned * (good / np.maximum(good.sum(axis=1), 1)[:, None])[..., None]
    second_half = np.cumsum(good, axis=1) % 2 == 0
    mean, halves = loops.average(words, frequency + correction, complex64(weights), second_half, linear)
    return AlignedRow(
        mean,
        halves,
        centre,
        good,
        first.frequency + correction,
        np.angle(cis(start + shift)),
        amplitude,
        np.abs(taps.sum(axis=-1)),
        _centred(apart / 2, good).swapaxes(0, 1),
        coherence,
        peak,
    )


def whole_blocks(linear: tuple[int, int]) -> tuple[int, int]:
    """Return the linear samples that fill whole blocks of `FOLD`; estimates count time from their middle."""
    a, b = linear
    return a, b - (b - a) % FOLD


def _against_one(
    words: NDArray[np.int16], valid: NDArray[np.bool_], linear: tuple[int, int], full_scale: int
) -> tuple[Tone, NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.int32]]:
    """Estimate offsets relative to one chirp per position; try another one if it is unusable or matches few others.

    Returns the offsets, the middle of the signal's band [position], and [position, chirp]: coherence with the reference
    chirp, usable chirps (received whole, not clipped, not silent), and the largest count.
    """
    positions, chirps = valid.shape
    # Threshold for two records of noise: four times the RMS of a sum of random phases.
    noise = 4.0 / np.sqrt(words.shape[-1] * (linear[1] - linear[0]))
    order = np.argsort(~valid, axis=1, kind="stable")  # the valid ones, first to last
    reference, todo, every = order[:, 0], np.arange(positions), np.arange(positions)
    frequency, amplitude, centre = np.zeros(valid.shape), np.zeros(valid.shape, complex), np.zeros(positions)
    coherence, usable, peak = np.zeros(valid.shape), valid, np.zeros(valid.shape, np.int32)
    best_sum = np.full(positions, -1.0)
    for attempt in range(min(_REFERENCES, chirps)):
        tried = order[todo, attempt]
        offset, product, middle, energy, highest = loops.match(words if attempt == 0 else words[todo], tried, linear)
        if attempt == 0:
            usable, peak = valid & (highest < full_scale) & (energy > 0), highest
            rank = np.where(usable, 1, 2)
            rank[every, tried] = 0
            order = np.argsort(rank, axis=1, kind="stable")  # the one tried, then the usable ones
        at = np.arange(todo.size), tried
        c = np.abs(product) / np.sqrt(np.maximum(energy * energy[at][:, None], 1e-30)) * usable[todo]
        c[at] = 0  # a chirp always matches itself
        total = np.where(usable[todo, tried], c.sum(axis=1), -1.0)
        better = total >= best_sum[todo]
        won = todo[better]
        reference[won], coherence[won], best_sum[won] = tried[better], c[better], total[better]
        frequency[won], amplitude[won], centre[won] = offset[better], product[better], middle[better]
        count, matching = usable[todo].sum(axis=1), (c > noise).sum(axis=1)
        todo = todo[(count > 0) & (~usable[todo, tried] | (2 * matching < count - 1))]
        if todo.size == 0:
            break
    best = coherence.max(axis=1)
    coherence[every, reference] = np.where(usable[every, reference], best, 0)  # as good as its best match
    return Tone(frequency, amplitude), centre, coherence, usable, peak


def _taps(equaliser: hpf.Equaliser | None, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the filter taps of every chirp, [position, chirp, tap]; one tap without an equaliser."""
    return np.ones((*frequency.shape, 1), complex) if equaliser is None else equaliser.taps(frequency)


def _coherent(coherence: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the usable chirps with at least `_GOOD` of the median coherence of their position."""
    rising = np.sort(np.where(usable, coherence, np.inf), axis=1)
    middle = np.maximum(usable.sum(axis=1) - 1, 0) // 2
    median = np.take_along_axis(rising, middle[:, None], axis=1)
    return usable & (coherence >= _GOOD * median)


def _centred(values: NDArray[np.float64], good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Subtract the mean over a position's good chirps from values [..., position, chirp]; zero where not good."""
    mean = (values * good).sum(axis=-1) / np.maximum(good.sum(axis=-1), 1)
    return (values - mean[..., None]) * good
