"""Estimate and remove offsets of frequency and phase: of each chirp in its burst, then of each position.

Burst alignment (`align_row`). A board samples SYNC_IN with its own clock. So each chirp of a burst is the same signal
s(t) times `exp(j(2 pi df t + dphi))`, with its own df and dphi (POLySIGHT paper, Eq. 4). Its product with the conjugate
of a reference chirp, summed over the RX, is a tone of frequency df with the positive envelope `|s(t)|^2`. The maximum
of this tone's spectrum is the maximum-likelihood df for any s. The paper divides by the reference chirp instead, which
amplifies noise where direct path and object cancel. Each chirp is then mixed to zero frequency. Its signal fills only a
few range bins there, so one sample in four is kept (`decimate.py`). Filter compensation, a second estimate (each chirp
against the sum of all others) and all later steps use these decimated samples.

Disturbed chirps are left out. The part of a chirp that is not in the sum of the others is compared among the chirps of
the burst, in eight parts of the chirp: another radar is heard while its chirp crosses the receiver's band. A burst with
disturbed chirps is aligned again without them, as if they had not been received.

Direct path from TX to RX (`reference`). It is estimated in the average of the burst of every position, and its
frequency and phase are removed. The object's echo is as strong and lies only 3.5 IF bins above it, so the estimate must
suppress the object. The geometry gives both: the direct path's delays along the RX array, and the object plane. The
samples x of all RX are modelled as `x = A g + A w (j t g)`: a direct path `A exp(j w t)` with complex amplitude A and a
small frequency w (radians per sample), g its phases at the RX (1 after steering), t the time in samples from the
middle. With the object as coloured noise of covariance R, the best linear unbiased estimate is

    [A, A w] = (G^H R^-1 G)^-1 G^H R^-1 x,   G = [g, j t g]

(generalised least squares; Kay 1993, section 6.4). This is a fixed matrix, 2 x (RX * decimated samples): a beamformer
in space and frequency with nulls at the object. R also holds weak clutter behind the object (walls, a table); otherwise
the sidelobes there would be those of a rectangular window. Gauss-Newton steps `w += Re(A w / A)` converge.

The crystals of the boards differ by some ppm, and with them the chirp slopes. So the IF drifts by some kilohertz within
a chirp, equally for all paths and positions. A third column `j t^2 / 2 g` estimates this drift; its median over the row
is removed before the second, final estimate.

The amplitude of the direct path is constant during a scan. If a position's amplitude is an outlier in its row, the
second of the two strongest peaks is tried. Nothing is smoothed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.sync import high_pass_filter as hpf, loops
from polysight.sync.decimate import FOLD, SEARCH_FFT, decimator, search_window, whole_blocks
from polysight.sync.direct_path import DirectPath
from polysight.sync.loops import Library, NumpyLoops, Real, Removed, Tone, cis, complex64
from polysight_shared.config import Chirp

# Burst alignment: reference chirps tried per position; chosen.
_REFERENCES = 4
# A chirp is averaged if its coherence is at least this part of the median over the chirps of its position; chosen.
_GOOD_COHERENCE = 0.5
# A chirp is disturbed if, in one of its eight parts, the energy that the sum of the others does not explain is this
# many times the usual of the burst (chosen); noise reaches twice the usual.
_UNEXPLAINED_RATIO = 8.0
# Unexplained share of a part's energy that is never a disturbance: -30 dB, above the effect of 0.1 bins of frequency.
_NEGLIGIBLE_SHARE = 1e-3
# Times that a burst is aligned, each without the chirps found disturbed before; chosen.
_ROUNDS = 4
# An amplifier may clip below full scale: smallest magnitude at which it is taken to do so; chosen.
_LEAST_LIMIT = 1024
# It clips a chirp if more than one in so many of the chirp's words lie at the largest magnitude of the burst; chosen.
_AT_LIMIT = 32

# Gauss-Newton steps to the direct path's frequency. In noise the last one stays large: no direct path is found.
_STEPS = 3
# The strongest peak is that of the object, and a second one below it that of the direct path, if they are as far apart
# as the geometry says (within 10 %) and the second has at least this relative amplitude; chosen.
_COMPARABLE_AMPLITUDE = 0.35
# Smallest amplitude of a direct path, relative to the row's median; chosen.
_LEAST_AMPLITUDE = 0.3
# Standard deviations from the row's amplitude beyond which a position's second peak is tried; chosen.
_OUTLIER_STDS = 5.0
# Smallest power of a direct path relative to the noise; noise reaches 12 once in 100,000 positions.
_LEAST_SNR = 30.0

# An RX is dead if its power without noise is less than this part (-23 dB, chosen) of that of the strongest RX.
_DEAD_SHARE = 0.005
# No RX is called dead where a smaller part of the strongest one's power is signal, and the rest noise; chosen.
_LEAST_SIGNAL_SHARE = 0.5
# Neighbouring positions whose powers are summed to find dead RX; chosen.
JUDGED_POSITIONS = 4
# The same number for signals without the direct path: the echoes of several plates cancel at single positions.
JUDGED_ECHOES = 16

Errors = dict[str, NDArray[np.float64]]
"""Error samples after each stage of synchronisation, float64 [3, n]: frequency, phase, relative amplitude."""
Loops = Library | type[NumpyLoops]
"""Loops that find the direct path."""


class AlignedRow(NamedTuple):
    """The averaged chirps of every position of a row, mixed down by `centre` and decimated.

    Attributes
    ----------
    halves
        complex64 [position, 2, rx, block]: contributions of the first, third, ... and of the second, fourth, ... good
        chirp to the average, their sum, in the frame of the reference chirp; one sample per `FOLD` (`decimate.py`).
    centre
        float64 [position]: middle of the signal's band in the reference chirp, cycles per sample.
    good
        bool [position, chirp]: chirps in the average.
    frequency, phase
        float64 [position, chirp]: offset of each chirp from the average, cycles per sample, and radians at the
        centre of the linear samples.
    amplitude
        float64 [position, chirp]: amplitude relative to the average, after filter compensation.
    gain
        float64 [position, chirp]: gain of the filter compensation at the chirp's centre.
    error
        float64 [position, 2, chirp]: frequency (cycles per sample) and phase (rad) error of a chirp after alignment:
        half the difference between two halves of the RX, less its mean over good chirps; zero where not good.
    coherence
        float64 [position, chirp]: normalised correlation with the average, 0..1.
    clipped
        bool [position, chirp]: chirps left out because the receiver clipped (:func:`find_clipped`).
    """

    halves: NDArray[np.complex64]
    centre: NDArray[np.float64]
    good: NDArray[np.bool_]
    frequency: NDArray[np.float64]
    phase: Real
    amplitude: NDArray[np.float64]
    gain: NDArray[np.float64]
    error: NDArray[np.float64]
    coherence: NDArray[np.float64]
    clipped: NDArray[np.bool_]

    def part(self, positions: slice) -> AlignedRow:
        """Return views of some positions."""
        return AlignedRow._make(field[positions] for field in self)


Align = Callable[[NDArray[np.int16], NDArray[np.bool_], tuple[int, int], hpf.Equaliser | None, int, AlignedRow], None]
"""Function that aligns positions. Arguments: words, valid, linear samples in whole blocks, equaliser, full scale (as of
`align_row`), and the part of the row that it fills."""


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
        Samples `[a, b)` in which the chirp is linear; only whole blocks of these are used.
    equaliser
        Compensates the receiver's high-pass filter; None: no compensation.
    full_scale
        Value of a clipped sample; clipped chirps (:func:`find_clipped`) are left out, for clipping creates false tones.
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
    linear = whole_blocks(linear)
    row = None
    next_position = 0
    for words in pieces:
        if row is None:
            row = _empty_row(valid.shape, words.shape, (linear[1] - linear[0]) // FOLD)
        rows = slice(next_position, next_position + len(words))
        if words.shape[:2] != valid[rows].shape:
            raise ValueError(f"bursts {words.shape[:2]} at position {next_position} of {valid.shape}")
        align = by or _choose_loop(words.shape[1], words.shape[-1])
        align(words, valid[rows], linear, equaliser, full_scale, row.part(rows))
        next_position = rows.stop
    if row is None or next_position != len(valid):
        raise ValueError(f"{next_position} of {len(valid)} positions")
    return row


def _choose_loop(chirps: int, rx: int) -> Align:
    """Return the compiled alignment if it supports these numbers, otherwise that in NumPy."""
    is_supported = rx == loops.RX and chirps <= loops.MOST_CHIRPS
    library = loops.load_library() if is_supported else None
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
        rows = slice(i, i + loops.CHUNK)
        for target, values in zip(into, _align(words[rows], valid[rows], linear, equaliser, full_scale), strict=True):
            target[rows] = values


def _empty_row(bursts: tuple[int, ...], words: tuple[int, ...], blocks: int) -> AlignedRow:
    """Return memory for a row; arguments are the shapes (position, chirp) and (position, chirp, sample, 2, rx)."""
    positions, chirps = bursts
    rx = words[-1]
    return AlignedRow(
        halves=np.empty((positions, 2, rx, blocks), np.complex64),
        centre=np.empty(positions),
        good=np.empty(bursts, np.bool_),
        frequency=np.empty(bursts),
        phase=np.empty(bursts),
        amplitude=np.empty(bursts),
        gain=np.empty(bursts),
        error=np.empty((positions, 2, chirps)),
        coherence=np.empty(bursts),
        clipped=np.empty(bursts, np.bool_),
    )


def _align(
    words: NDArray[np.int16],
    valid: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None,
    full_scale: int,
) -> AlignedRow:
    """Align and average a few positions; bursts with disturbed chirps again without these."""
    clipped = find_clipped(words, valid, full_scale)
    usable = valid & ~clipped
    row, disturbed = _align_round(words, usable, clipped, linear, equaliser)
    for _ in range(_ROUNDS - 1):
        todo = np.flatnonzero(disturbed.any(axis=1))
        if todo.size == 0:
            break
        usable[todo] &= ~disturbed[todo]
        redone, still_disturbed = _align_round(words[todo], usable[todo], clipped[todo], linear, equaliser)
        disturbed[:] = False
        disturbed[todo] = still_disturbed
        for target, values in zip(row, redone, strict=True):
            target[todo] = values
    return row


def find_clipped(words: NDArray[np.int16], valid: NDArray[np.bool_], full_scale: int) -> NDArray[np.bool_]:
    """Return which of the received chirps [position, chirp] were clipped by the receiver.

    A clipped chirp reaches full scale; or, if an amplifier saturates earlier, more than one in `_AT_LIMIT` of its words
    lie within 1/2048 of the burst's largest magnitude. An unclipped tone has 2 % of its words there, fewer with noise
    or an echo.
    """
    magnitude: NDArray[np.int32] = np.abs(words.reshape(*words.shape[:2], -1).astype(np.int32))
    peak = magnitude.max(axis=-1)
    highest = np.where(valid & (peak < full_scale), peak, 0).max(axis=1)
    words_at_limit = (magnitude >= (highest - highest // 2048)[:, None, None]).sum(axis=-1)
    piled: NDArray[np.bool_] = (highest >= _LEAST_LIMIT)[:, None] & (words_at_limit > magnitude.shape[-1] // _AT_LIMIT)
    return valid & ((peak >= full_scale) | piled)


def _align_round(
    words: NDArray[np.int16],
    is_complete: NDArray[np.bool_],
    clipped: NDArray[np.bool_],
    linear: tuple[int, int],
    equaliser: hpf.Equaliser | None,
) -> tuple[AlignedRow, NDArray[np.bool_]]:
    """Align and average the whole chirps of a few positions; return which of them are disturbed, too."""
    # First pass: each chirp against a reference chirp; its frequency and, after the filter, its phase are removed.
    first, centre, coherence, usable = _refer_to_one(words, is_complete, linear)
    good = _find_coherent(coherence, usable)
    frequency = centre[:, None] + first.frequency
    taps = _find_taps(equaliser, frequency)
    first_phase = np.angle(first.amplitude * taps.sum(axis=-1))
    reduced = loops.reduce_chirps(words, frequency, complex64(taps * cis(-first_phase)[..., None]), linear)
    # Second pass: each chirp against the sum of the others. Energies of parts of a chirp are [position, part].
    tone, own_energy, sum_energy, half_difference, residual_energy = loops.against_others(reduced, good)
    n = good.sum(axis=1)
    disturbed = is_complete & _find_disturbed(residual_energy, sum_energy / np.maximum(n, 1)[:, None] ** 2, usable)
    level = np.maximum(sum_energy.sum(axis=1) / np.maximum(n, 1) ** 2, 1e-30)[:, None]
    other_chirps = n[:, None] - good
    # Product with the mean of the others, over the energy of the mean of all; a single chirp is the mean itself.
    amplitude = np.where(other_chirps > 0, np.abs(tone.amplitude) / np.maximum(other_chirps, 1) / level, 1.0)
    # The difference from the mean of all chirps is smaller than that from the mean of the others.
    share = other_chirps / np.maximum(n, 1)[:, None]
    correction = share * tone.frequency
    shift = share * np.angle(tone.amplitude)
    coherence = amplitude * np.sqrt(level / np.maximum(own_energy, 1e-30))
    good = _find_coherent(coherence, usable)
    second_half = np.cumsum(good, axis=1) % 2 == 0
    weights = good / np.maximum(good.sum(axis=1), 1)[:, None]
    split = np.stack([weights * ~second_half, weights * second_half], axis=1).astype(np.float32)
    row = AlignedRow(
        halves=loops.average(reduced, correction, shift, split),
        centre=centre,
        good=good,
        frequency=first.frequency + correction,
        phase=np.angle(cis(first_phase + shift)),
        amplitude=amplitude,
        gain=np.abs(taps.sum(axis=-1)),
        error=_subtract_mean(half_difference / 2, good).swapaxes(0, 1),
        coherence=coherence,
        clipped=clipped,
    )
    return row, disturbed


def _find_disturbed(
    unexplained: NDArray[np.float64], level: NDArray[np.float64], usable: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the chirps [position, chirp] with a part that the sum of the others does not explain: interference.

    `unexplained` [position, chirp, part] is the energy that the sum of the others does not explain, `level` [position,
    part] the energy of the average. The usual unexplained energy is the larger of two: its median over the chirps, and
    the smallest of the two chirps on either side, as the stage's motion raises it in neighbouring chirps alike. With
    fewer than four chirps none is disturbed.
    """
    median = _take_lower_median(unexplained, usable[..., None])[:, None]
    padded = np.pad(np.where(usable[..., None], unexplained, np.inf), ((0, 0), (2, 2), (0, 0)), constant_values=np.inf)
    chirps = unexplained.shape[1]
    # Chirps -2, -1, +1 and +2 from each.
    neighbour = np.minimum.reduce([padded[:, k : k + chirps] for k in (0, 1, 3, 4)])
    usual = np.maximum(median, np.where(np.isfinite(neighbour), neighbour, 0.0))
    limit = _UNEXPLAINED_RATIO * usual + _NEGLIGIBLE_SHARE * level[:, None]
    has_enough_chirps = usable.sum(axis=1) >= 4
    return usable & has_enough_chirps[:, None] & (unexplained > limit).any(axis=2)


def _take_lower_median(values: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the lower median [position, ...] of the usable values [position, chirp, ...]; 0 without any."""
    rising = np.sort(np.where(usable, values, np.inf), axis=1)
    middle = np.maximum(usable.sum(axis=1, keepdims=True) - 1, 0) // 2
    median = np.take_along_axis(rising, np.broadcast_to(middle, (*middle.shape[:2], *values.shape[2:])), axis=1)
    return np.where(np.isfinite(median), median, 0.0).squeeze(1).astype(np.float64)


def _refer_to_one(
    words: NDArray[np.int16], is_complete: NDArray[np.bool_], linear: tuple[int, int]
) -> tuple[Tone, NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Estimate offsets relative to one usable chirp per position; try another one if it matches few others.

    Return the offsets, the middle of the signal's band [position] (cycles per sample), and [position, chirp]: coherence
    with the reference chirp, and True for usable chirps (whole, not silent).
    """
    positions, chirps = is_complete.shape
    # Threshold for two records of noise: four times the RMS of a sum of random phases.
    noise = 4.0 / np.sqrt(words.shape[-1] * (linear[1] - linear[0]))
    usable = is_complete & words.any(axis=(2, 3, 4))
    count = usable.sum(axis=1)
    order = np.argsort(~usable, axis=1, kind="stable")
    reference = order[:, 0].copy()
    all_positions = np.arange(positions)
    frequency = np.zeros(is_complete.shape)
    amplitude = np.zeros(is_complete.shape, complex)
    centre = np.zeros(positions)
    coherence = np.zeros(is_complete.shape)
    best_sum = np.full(positions, -1.0)
    # Positions that still need a reference chirp: their latest one matches fewer than half of the others.
    todo = np.flatnonzero(count)
    for attempt in range(min(_REFERENCES, chirps)):
        if todo.size == 0:
            break
        tried = order[todo, attempt]
        offset, product, middle, energy = loops.match(words[todo], tried, linear)
        tried_pair = np.arange(todo.size), tried
        c = np.abs(product) / np.sqrt(np.maximum(energy * energy[tried_pair][:, None], 1e-30)) * usable[todo]
        # A chirp always matches itself.
        c[tried_pair] = 0
        total = c.sum(axis=1)
        better = total > best_sum[todo]
        won = todo[better]
        reference[won] = tried[better]
        coherence[won] = c[better]
        best_sum[won] = total[better]
        frequency[won] = offset[better]
        amplitude[won] = product[better]
        centre[won] = middle[better]
        matching = (c > noise).sum(axis=1)
        todo = todo[(2 * matching < count[todo] - 1) & (attempt + 1 < count[todo])]
    best = coherence.max(axis=1)
    # A reference is as good as its best match.
    coherence[all_positions, reference] = np.where(usable[all_positions, reference], best, 0)
    return Tone(frequency, amplitude), centre, coherence, usable


def _find_taps(equaliser: hpf.Equaliser | None, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the filter taps of every chirp, [position, chirp, 3]; without an equaliser those of no filter."""
    if equaliser is None:
        return np.broadcast_to(np.array([0, 1, 0], complex), (*frequency.shape, 3))
    return equaliser.taps(frequency)


def _find_coherent(coherence: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the usable chirps with at least `_GOOD_COHERENCE` of the median coherence of their position."""
    return usable & (coherence >= _GOOD_COHERENCE * _take_lower_median(coherence, usable)[:, None])


def _subtract_mean(values: NDArray[np.float64], good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Subtract the mean over a position's good chirps from values [..., position, chirp]; zero where not good."""
    mean = (values * good).sum(axis=-1) / np.maximum(good.sum(axis=-1), 1)
    return (values - mean[..., None]) * good


class ReferencedSamples(NamedTuple):
    """Samples referenced to the direct path.

    Attributes
    ----------
    samples
        complex64 [rx, position, block]: an echo of excess path d is `exp(j 2 pi f(t) d / c)`, with t the middle of the
        block; the direct path is a constant.
    frequency
        float64 [position]: IF of the direct path in cycles per sample, 0..1 (complex 1x) or -1/2..1/2.
    amplitude
        complex128 [position]: its amplitude, phase at the centre of the linear samples.
    found
        bool [position]: False without a credible direct path.
    drift
        IF drift of the row, radians per sample squared.
    noise
        float64 [position]: noise power of a sample of one RX in one chirp; NaN with fewer than two good chirps.
    steering
        complex64 [rx, block]: factors that steer the aligned averages to the direct path and remove the drift.
    """

    samples: NDArray[np.complex64]
    frequency: NDArray[np.float64]
    amplitude: NDArray[np.complex128]
    found: NDArray[np.bool_]
    drift: float
    noise: NDArray[np.float64]
    steering: NDArray[np.complex64]


@dataclass(frozen=True)
class SyncedRow:
    """A row of a board with every position referenced to its direct path.

    Attributes
    ----------
    samples
        complex64 [rx, position, sample]: an echo of excess path d is `a exp(+j 2 pi f d / c)`; zero where not valid,
        and of a dead RX (`find_dead_rx`).
    sweep_hz
        float64 [sample]: transmit frequency f of each. Raw chirps have one sample for every four (`decimate.py`), cubes
        of other programs all of them.
    valid
        bool [position].
    chirps
        int [position]: chirps in each average.
    direct_hz, direct_amplitude
        float64 [position]: IF and amplitude (ADC counts) of the direct path. Of cubes in their units: of one that came
        referenced the IF is 0, of one without its direct path the amplitude is what :func:`detect_form` made up.
    noise
        float64 [position]: noise power of a sample of one channel of one chirp (ADC counts squared), NaN with fewer
        than two good chirps; None: unknown.
    turn
        float64 [position]: phase change, radians, of the whole signal (direct path and echoes) from one position to
        the next. Burst alignment removes it within a burst, see `imaging.geometry`. None: not aligned.
    chirps_clipped, chirps_disturbed
        Received chirps that were left out because the receiver clipped, or because they differ from the others of their
        burst (interference, silence).
    positions_clipped
        Positions without data because all their received chirps were clipped.
    rx_order
        Places in the rig file of the recorded RX, counted from 1, if the row has no direct path in the rig file's order
        but in this one (`rx_order.find_rx_order`); empty otherwise.
    errors
        Error samples of the row after each stage (`errors`), {stage: float64 [3, n]}.
    """

    samples: NDArray[np.complex64]
    sweep_hz: NDArray[np.float64]
    valid: NDArray[np.bool_]
    chirps: NDArray[np.int64]
    direct_hz: NDArray[np.float64]
    direct_amplitude: NDArray[np.float64]
    errors: Errors = field(default_factory=dict)
    noise: NDArray[np.float64] | None = None
    turn: NDArray[np.float64] | None = None
    chirps_clipped: int = 0
    chirps_disturbed: int = 0
    positions_clipped: int = 0
    rx_order: tuple[int, ...] = ()

    @property
    def dead_rx(self) -> list[int]:
        """RX that gave no signal in this row, counted from 1; none if no position is valid."""
        has_signal = np.array([rx.any() for rx in self.samples])
        return (np.flatnonzero(~has_signal & has_signal.any()) + 1).tolist()

    @property
    def stages(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations of frequency (Hz), phase (rad) and relative amplitude after each stage."""
        return {name: _spread(values) for name, values in self.errors.items() if values.size}

    def through(self, weights: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the echo of the row, complex64 [rx, position], in order of recording.

        `weights` [sample] are those of :func:`polysight.sync.backlash.object_filter`.
        """
        return (self.samples @ weights) * self.valid


def _spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the RMS of errors [3, n]."""
    f, p, a = np.sqrt((values**2).mean(axis=1))
    return float(f), float(p), float(a)


def reference(aligned: AlignedRow, path: DirectPath, chirp: Chirp, by: Loops | None = None) -> ReferencedSamples:
    """Find the direct path of every position and remove its frequency and phase from all RX.

    Parameters
    ----------
    aligned
        Aligned averages of a row. Positions without a good chirp are not found.
    path
        From :func:`polysight.sync.direct_path.prepare`.
    chirp
        The chirp the samples were taken with.
    by
        Compiled loops or those in NumPy, with equal results; None: compiled ones where possible.
    """
    a, b = whole_blocks(chirp.linear_samples)
    n = (b - a) // FOLD
    # The compiled search has room for as many blocks as its transform.
    is_supported = len(path.beam) == loops.RX and n <= SEARCH_FFT
    run = by or (loops.load_library() if is_supported else None) or NumpyLoops
    good_chirps = aligned.good.sum(axis=1)
    usable = good_chirps > 0
    first = run.find(
        halves=aligned.halves,
        weights=path.search_weights,
        size=SEARCH_FFT,
        object_bins=(int(path.object_bins[0] * 0.9), int(path.object_bins[1] * 1.1)),
        comparable=_COMPARABLE_AMPLITUDE,
        steering=path.folded_steering,
        estimator=complex64(path.drift_estimator),
        steps=_STEPS,
    )
    # Noise power, from the median bin, as tones fill few bins; the median power of noise is ln 2 of its mean.
    floor = first.median**2 / np.log(2) / (search_window(n) ** 2).sum()
    drifts = _divide(first.estimate[:, 2], first.estimate[:, 0])[usable]
    drift = _find_middle(drifts) if usable.any() else 0.0
    steering = complex64(path.folded_steering * cis(-0.5 * drift * ((np.arange(n) - (n - 1) / 2) * FOLD) ** 2))
    scale = half_scale(good_chirps)

    def remove(chosen: slice | NDArray[np.intp], start: NDArray[np.float64]) -> Removed:
        return run.remove(aligned.halves[chosen], steering, complex64(path.estimator), start, _STEPS, scale[chosen])

    removed = remove(slice(None), first.frequency)
    _try_second_peaks(removed, first.peaks, usable, remove)
    frequency, estimate, step, samples, half_difference = removed

    # An IF outside the receiver's passband (AWR2243) is an alias; with a last step above 0.02 bins no tone was found.
    amplitude = estimate[:, 0]
    if_frequency = aligned.centre + frequency
    if_frequency = if_frequency % 1.0 if chirp.if_mode == "complex1x" else (if_frequency + 0.5) % 1.0 - 0.5
    is_in_passband = if_frequency < 0.9 if chirp.if_mode == "complex1x" else np.abs(if_frequency) < 0.45
    strength = np.abs(amplitude)
    chirps = np.maximum(good_chirps, 1)
    # All chirps of a row have the same noise; `averaged_noise` is the power in an averaged sample of one RX.
    floor = _find_middle((floor * chirps)[usable]) / chirps if usable.any() else floor
    averaged_noise = floor / (np.abs(path.beam) ** 2).sum()
    present = strength**2 > _LEAST_SNR * averaged_noise * (np.abs(path.estimator[0]) ** 2).sum()
    is_found = usable & is_in_passband & present & (np.abs(step) < 0.02 / (b - a))
    if is_found.any():
        is_found &= strength > _LEAST_AMPLITUDE * _find_middle(strength[is_found])

    samples[:, ~is_found] = 0
    # Noise of one chirp: averages of the halves, of k and l of the K good chirps, differ by 1 / k + 1 / l of its power,
    # the sum of `scale` over K. `half_difference` is the difference's energy in all RX and blocks, after decimation.
    has_two_halves = good_chirps > 1
    noise_power = np.full(len(has_two_halves), np.nan)
    chirp_noise = half_difference * chirps / (np.count_nonzero(path.beam) * n) / decimator().noise
    noise_power[has_two_halves] = chirp_noise[has_two_halves] / scale[has_two_halves].sum(axis=1)
    return ReferencedSamples(
        samples=samples,
        frequency=if_frequency,
        amplitude=amplitude,
        found=is_found,
        drift=drift,
        noise=noise_power,
        steering=steering,
    )


def find_dead_rx(
    signal: NDArray[np.complexfloating], again: NDArray[np.complexfloating], judged: int = JUDGED_POSITIONS
) -> NDArray[np.bool_]:
    """Find the RX that receive noise or nothing in some part of a row while another one receives a signal, bool [rx].

    `signal` and `again` [rx, position, sample] hold the same signals, up to a phase of each position, with independent
    noise. The power of an RX without its noise is the part of their product that is in phase in all RX. Powers are
    summed over each `judged` neighbouring positions.
    """
    product = np.vecdot(signal, again)
    total = product.sum(axis=0)
    if not total.any():
        return np.zeros(len(product), bool)
    in_phase_power = np.real(product * np.exp(-1j * np.angle(total)))
    power = np.sqrt(np.vecdot(signal, signal).real * np.vecdot(again, again).real)
    width = min(judged, total.size)
    in_phase_power, power = (_sum_neighbours(values, width) for values in (in_phase_power, power))
    strongest = in_phase_power.max(axis=0)
    has_signal = strongest > _LEAST_SIGNAL_SHARE * power[in_phase_power.argmax(axis=0), np.arange(power.shape[1])]
    return ((in_phase_power < _DEAD_SHARE * strongest) & has_signal).any(axis=1)


def _sum_neighbours(values: NDArray[np.floating], width: int) -> NDArray[np.float64]:
    """Return sums [rx, start] of `width` neighbouring values [rx, position]."""
    sums = np.cumsum(values, axis=1, dtype=np.float64)
    sums_before = np.pad(sums, ((0, 0), (1, 0)))[:, :-width]
    return sums[:, width - 1 :] - sums_before


def half_scale(good_chirps: NDArray[np.int_]) -> NDArray[np.float32]:
    """Return the factors that make each of `AlignedRow.halves` the average of its chirps, float32 [position, 2]."""
    chirps = good_chirps[:, None]
    chirps_of_half = (chirps + np.array([1, 0])) // 2
    return (chirps / np.maximum(chirps_of_half, 1)).astype(np.float32)


def _try_second_peaks(
    removed: Removed,
    peaks: NDArray[np.float64],
    usable: NDArray[np.bool_],
    remove: Callable[[NDArray[np.intp], NDArray[np.float64]], Removed],
) -> None:
    """Use the second peak where ln of the amplitude is an outlier in its row; changes `removed` in place.

    `remove` repeats the estimate of given positions from given frequencies. An outlier is beyond `_OUTLIER_STDS`
    standard deviations from the row's median; the amplitude of the second peak has to be nearer to the median, and no
    outlier.
    """
    level = np.log(np.maximum(np.abs(removed.estimate[:, 0]), 1e-30))
    if not usable.any():
        return
    middle = _find_middle(level[usable])
    # 1.4826 turns the median deviation of a normal distribution into its standard deviation.
    spread = 1.4826 * _find_middle(np.abs(level[usable] - middle))
    odd_positions = np.flatnonzero(usable & (np.abs(level - middle) > _OUTLIER_STDS * spread) & (peaks[0] != peaks[1]))
    if odd_positions.size == 0:
        return
    second_try = remove(odd_positions, peaks[1, odd_positions])
    other_level = np.log(np.maximum(np.abs(second_try.estimate[:, 0]), 1e-30))
    better = np.abs(other_level - middle) < np.minimum(_OUTLIER_STDS * spread, np.abs(level[odd_positions] - middle))
    replaced = odd_positions[better]
    removed.frequency[replaced] = second_try.frequency[better]
    removed.estimate[replaced] = second_try.estimate[better]
    removed.step[replaced] = second_try.step[better]
    removed.samples[:, replaced] = second_try.samples[:, better]


def _find_middle(values: NDArray[np.floating]) -> float:
    """Return the median of at least one value; for some hundred values `np.median` takes four times as long."""
    rising = np.sort(values)
    return float(rising[(rising.size - 1) // 2] + rising[rising.size // 2]) / 2


def _divide(moment: NDArray[np.complex128], amplitude: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return Re(moment / amplitude); 0 where the amplitude is 0."""
    ratio = np.zeros(amplitude.shape, complex)
    np.divide(moment, amplitude, out=ratio, where=amplitude != 0)
    return np.real(ratio)
