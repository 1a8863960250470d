"""Synchronise the rows of a scan: from raw chirps to samples referenced to the direct path, with the residual errors.

`synchronise_row` processes raw chirps; `RowSynchroniser` reads every row of a source, and converts cubes that another
program has synchronised.

Residuals are frequency, phase and amplitude errors after each stage (Fig. 15 of the POLySIGHT paper). They are measured
on the scan itself, for any scene: an error is half the difference between two measurements with independent noise. For
an aligned chirp and for the direct path these are two halves of the RX, for the object two averages of every other
chirp. As received, and for the amplitude of an aligned chirp, an error is the deviation from the mean.

Aligned chirps are decimated: `FOLD` (4) samples become a *block*. Words are a card's int16; their axis of length 2 is
(I, Q).

Cubes: our convention is that an echo of excess path d is `a exp(+j 2 pi f d / c)`, and the direct path is constant. The
conventions of a cube are unknown, but the geometry determines where direct path and object must lie. From that
`detect_form` finds the sign of the phase, whether delays count from the transmitter or from the direct path, whether
each RX is referenced to its own direct path or all to that of RX1, and whether the direct path was removed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.capture import raw_words, row_words, valid_frames
from polysight.store import CubeRow, RowData, Source
from polysight.sync import high_pass_filter as hpf, loops
from polysight.sync.decimate import FOLD, flatten, fold
from polysight.sync.loops import Complex, Real, block_edges, block_times, cis, complex64, phasor, refine, signal_energy
from polysight.sync.offsets import (
    AlignedRow,
    DirectPath,
    Referenced,
    align_pieces,
    excess_path_m,
    half_scale,
    prepare,
    reference,
    sample_frequencies_hz,
    whole_blocks,
)
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Stages of `SyncedRow.errors`, and of what each one's errors are.
STAGES = {
    "received": "one chirp as received",
    "aligned": "one chirp after burst alignment",
    "averaged": "the direct path in a position's average",
    "referenced": "the object beside the direct path in a position's average",
}

PUBLISHED_STD = {"frequency_hz": 138.0, "phase_rad": 0.022}
"""Standard deviations after the last stage on the published rig (POLySIGHT paper, section 9.1)."""

EXAMINED = 32
"""Positions per row used for residuals: standard deviations within 13 % for a row, 1 % for 150 rows."""

Errors = dict[str, NDArray[np.float64]]

# Largest int16: a sample with this value was clipped.
_FULL_SCALE = 32767
# Positions read at a time: 2 MB, which stay in the processor's cache.
_POSITIONS = 32

# The numbers for cubes are chosen.
# Cubes: rows from which their form is detected, and about how many of their positions.
_CUBE_ROWS = 7
_FORM_POSITIONS = 300
# Echoes come from within this distance of the mirror point; chosen.
_SPREAD_M = 0.15
# Noise power of a sample relative to the object, for the estimate of the direct path; chosen.
_NOISE = 1e-3
# The simplest convention is kept if it explains this part of the best one's power.
_PREFER_SIMPLE = 0.7
# Smallest constant share of the direct path's power if the cube is referenced to it.
_COHERENT = 0.5
# Smallest share of positions with a direct path; chosen.
_MIN_FOUND = 0.5
# Share of power at the object above which the cube contains nothing else: its direct path was removed.
_ALONE = 0.8


@dataclass(frozen=True)
class BoardSetup:
    """Parameters of synchronisation for a board and a whole scan. Create with :meth:`from_rig`.

    `pulses` are the chirps of a position, `equaliser` compensates the high-pass filter (None: no filter), `path` finds
    the direct path. `examined` is the largest number of positions per row used for residuals (`errors`).
    """

    chirp: Chirp
    pulses: int
    equaliser: hpf.Equaliser | None
    path: DirectPath
    examined: int = EXAMINED

    @classmethod
    def from_rig(
        cls, rig: Instrument, board: Board, compensate_filter: bool = True, model: hpf.HighPass | None = None
    ) -> BoardSetup:
        """Return the setup of a board of a rig.

        `model` is the measured high-pass filter (`fit_high_pass`); None: the corners in the chirp profile.
        `compensate_filter=False` does not compensate the filter.
        """
        model = model or hpf.high_pass(rig.chirp)
        equaliser = None
        if compensate_filter and model.corners_hz:
            equaliser = hpf.Equaliser.from_model(model, rig.chirp, FOLD)
        return cls(rig.chirp, rig.burst.chirps_a_position, equaliser, prepare(rig, board))


@dataclass(frozen=True)
class SyncedRow:
    """A row of a board with every position referenced to its direct path.

    Attributes
    ----------
    samples
        complex64 [rx, position, sample]: an echo of excess path d is `a exp(+j 2 pi f d / c)`; zero where not valid.
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
        the next. Burst alignment removes it within a burst, see `imaging.samples.undo_burst_motion`. None: not aligned.
    chirps_clipped, chirps_disturbed
        Received chirps that were left out because the receiver clipped, or because they differ from the others of their
        burst (interference, silence).
    positions_clipped
        Positions without data because all their received chirps were clipped.
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

    @property
    def stages(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations of frequency (Hz), phase (rad) and relative amplitude after each stage."""
        return {name: _spread(values) for name, values in self.errors.items() if values.size}

    def through(self, weights: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the echo of the row, complex64 [rx, position], in order of recording.

        `weights` [sample] are those of :func:`polysight.sync.backlash.object_filter`.
        """
        return (self.samples @ weights) * self.valid


def synchronise_row(frames: NDArray[Any], valid: NDArray[np.bool_], setup: BoardSetup) -> SyncedRow:
    """Compensate, align, average and reference a row of a board (paper, section 5.2).

    Parameters
    ----------
    frames
        int16 [frame, sample, 2, rx] from `row_words`, or complex64 [rx, frame, sample] in ADC counts, which are
        converted first; positions in order of recording, `setup.pulses` frames each (single chirps here).
    valid
        bool [frame]: frames received whole.
    setup
        Setup of the board.

    Raises
    ------
    DataError
        if the frames are not whole bursts of the configured chirp.
    """
    words = raw_words(frames) if np.iscomplexobj(frames) else frames
    return synchronise_pieces([words], valid, setup)


def synchronise_pieces(pieces: Iterable[NDArray[np.int16]], valid: NDArray[np.bool_], setup: BoardSetup) -> SyncedRow:
    """Synchronise a row given in pieces of whole bursts, int16 words as of :func:`synchronise_row`.

    A piece is not used any more when the next one is asked for, so that pieces may share memory.
    """
    if valid.size % setup.pulses:
        raise _mismatch_error(valid.size, setup.path.steering.shape, setup)
    received = valid.reshape(-1, setup.pulses)
    aligned = align_pieces(
        _group_bursts(pieces, valid.size, setup),
        received,
        setup.chirp.linear_samples,
        setup.equaliser,
        _FULL_SCALE,
    )
    synchronised = reference(aligned, setup.path, setup.chirp)
    rate = setup.chirp.sample_rate_hz
    return SyncedRow(
        samples=synchronised.samples,
        sweep_hz=setup.path.sweep_hz,
        valid=synchronised.found,
        chirps=aligned.good.sum(axis=1),
        direct_hz=synchronised.frequency * rate,
        direct_amplitude=np.abs(synchronised.amplitude),
        errors=errors(aligned, synchronised, setup.path, rate, setup.examined),
        noise=synchronised.noise,
        turn=_turn_along(synchronised.samples),
        chirps_clipped=int(aligned.clipped.sum()),
        chirps_disturbed=int((received & ~aligned.clipped & ~aligned.good).sum()),
        positions_clipped=int((aligned.clipped.any(axis=1) & (aligned.clipped == received).all(axis=1)).sum()),
    )


def _group_bursts(pieces: Iterable[NDArray[np.int16]], frames: int, setup: BoardSetup) -> Iterator[NDArray[np.int16]]:
    """Return pieces [frame, sample, 2, rx] as bursts [position, chirp, sample, 2, rx]; check that they are whole."""
    for words in pieces:
        chirps, samples, _, rx = words.shape
        frames -= chirps
        if (rx, samples) != setup.path.steering.shape or chirps % setup.pulses or frames < 0:
            raise _mismatch_error(chirps, (rx, samples), setup)
        yield words.reshape(-1, setup.pulses, samples, 2, rx)
    if frames:
        raise DataError(
            f"the recording ends {frames} frames before the end of its row",
            "it is truncated, or was recorded with another rig file",
            "use the rig file of this scan",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )


def _mismatch_error(frames: int, shape: tuple[int, ...], setup: BoardSetup) -> DataError:
    """Return the error for frames of a `shape` (rx, samples) that are not whole bursts of the setup."""
    rx, samples = setup.path.steering.shape
    return DataError(
        f"{frames} frames of {shape[0]} RX x {shape[1]} samples are not bursts of {setup.pulses} frames"
        f" of {rx} RX x {samples} samples",
        "the data were recorded with another rig file",
        "use the rig file of this scan",
        code=ErrorCode.MISMATCH,
    )


def _turn_along(samples: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return `SyncedRow.turn` of samples [rx, position, block], from the valid neighbours; 0 without any."""
    # Phase step from each position to the next.
    step = np.vecdot(samples[:, :-1], samples[:, 1:]).sum(axis=0)
    return np.angle(np.pad(step, (1, 0)) + np.pad(step, (0, 1)))


class RowSynchroniser:
    """Synchronises the rows of one scan.

    Parameters
    ----------
    source
        The scan.
    rig
        Its calibrated rig.
    filters
        Measured high-pass filter of each receiver, by board name; None: as the chirp profile programs it.
    """

    def __init__(self, source: Source, rig: Instrument, filters: Mapping[str, hpf.HighPass | None]) -> None:
        # Compiled loops: loaded now, with the warning if there are none, and not by the first of several threads.
        loops.library()
        self._source = source
        self.setups = {b.name: BoardSetup.from_rig(rig, b, model=filters.get(b.name)) for b in rig.receivers}
        self._forms: dict[str, CubeForm] = {}

    def synchronise(self, board: str, recorded: RowData | CubeRow) -> tuple[SyncedRow, int]:
        """Synchronise a row of a board; return it and the number of whole frames, of cubes of valid positions.

        Raises DataError.
        """
        rig = self._source.instrument
        if isinstance(recorded, CubeRow):
            synced = self._form(board).convert_row(recorded.cube, rig.burst.chirps_a_position)
            return synced, int(synced.valid.sum())
        # Chirps count as frames here, in `frames_expected` too.
        valid = valid_frames(recorded.missing, recorded.frames_expected, rig.frame_bytes // rig.burst.chirps)
        return synchronise_pieces(self._words(recorded), valid, self.setups[board]), int(valid.sum())

    def _words(self, recorded: RowData) -> Iterator[NDArray[np.int16]]:
        """Iterate over the words of a row, [chirp, sample, 2, rx], some positions at a time."""
        rig = self._source.instrument
        chirp_bytes = rig.frame_bytes // rig.burst.chirps
        for piece in recorded.pieces(_POSITIONS * rig.burst.chirps_a_position * chirp_bytes):
            # Without a list of missing bytes: `synchronise` finds the valid chirps.
            yield row_words(piece, (), piece.size // chirp_bytes, rig.chirp.samples, len(rig.antennas.rx_mm))[0]

    @property
    def direct_path_known(self) -> bool:
        """True if amplitudes are relative to the direct path; False for cubes without it."""
        return not any(form.constant.any() for form in self._forms.values())

    def recording_facts(self) -> dict[str, Any]:
        """Return the entry on recording of quality.json, with the form of cubes."""
        facts = self._source.recording_facts()
        if self._forms:
            cubes = {name: form.how for name, form in self._forms.items()}
            facts["recording"] = msgspec.structs.replace(facts["recording"], cubes=cubes)
        return facts

    def _form(self, board: str) -> CubeForm:
        """Return the form of a board's cube, detected from a few of its rows."""
        if board not in self._forms:
            rig = self._source.instrument
            rows = self._source.plan.rows
            row_numbers = sorted({int(r) for r in np.linspace(0, rows - 1, _CUBE_ROWS)})
            cubes = [row.cube for r in row_numbers if isinstance(row := self._source.read_row(board, r), CubeRow)]
            self._forms[board] = detect_form(cubes, rig, rig.by_name(board))
        return self._forms[board]


def errors(
    aligned: AlignedRow, referenced: Referenced, path: DirectPath, sample_rate_hz: float, most: int = EXAMINED
) -> Errors:
    """Return the errors after each stage, float64 [3, n]: Hz, rad, and amplitude relative to its mean.

    At most `most` valid positions are used, evenly spaced. Empty if no position is valid. The stage "referenced" has
    only positions with an echo.
    """
    if not referenced.found.any():
        return {}
    referenced_positions = np.flatnonzero(referenced.found)
    examined = referenced_positions[_spread_evenly(referenced_positions.size, most)]
    good = aligned.good[examined]
    amplitude = referenced.amplitude[examined, None]
    relative_amplitude = aligned.amplitude[examined]

    # As received: offsets of the chirps, with those of their positions added, from their mean. Amplitudes are without
    # the gain that compensated the receiver's filter.
    frequency = (referenced.frequency[examined, None] + aligned.frequency[examined])[good]
    phase = (np.angle(amplitude) + aligned.phase[examined])[good]
    size = (np.abs(amplitude) * relative_amplitude / aligned.gain[examined])[good]
    turns = (phase - np.angle(cis(phase).mean())) / (2 * np.pi)
    received = np.array([frequency - frequency.mean(), 2 * np.pi * (turns - np.rint(turns)), size / size.mean() - 1])

    mean_amplitude = (relative_amplitude * good).sum(axis=1, keepdims=True) / good.sum(axis=1, keepdims=True)
    amplitude_error = relative_amplitude / mean_amplitude - 1
    # `aligned.error` has frequency and phase on its second axis; the masks leave [2, n] and [n].
    chirp_errors = np.array([*aligned.error[examined].swapaxes(0, 1)[:, good], amplitude_error[good]])

    with_several_chirps = examined[good.sum(axis=1) > 1]
    # A dead RX has no direct path: its figures are not finite.
    with np.errstate(divide="ignore", invalid="ignore"):
        out = {
            "received": received,
            "aligned": chirp_errors,
            "averaged": _estimate_direct_path_errors(referenced.samples[:, examined], path),
            "referenced": _estimate_object_errors(_reference_halves(aligned, referenced, with_several_chirps), path)
            if with_several_chirps.size
            else np.zeros((3, 0)),
        }
    for values in out.values():
        values[0] *= sample_rate_hz
    return out


@lru_cache(maxsize=8)
def _spread_evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return at most `most` of `count` indices, evenly spaced."""
    return np.linspace(0, count - 1, min(most, count)).astype(np.intp)


def _reference_halves(
    aligned: AlignedRow, referenced: Referenced, positions: NDArray[np.intp]
) -> NDArray[np.complex64]:
    """Return the halves of some positions' bursts as averages, referenced like `samples`: [position, 2, rx, block]."""
    blocks = aligned.halves.shape[-1]
    frequency = referenced.frequency[positions] - aligned.centre[positions]
    # What removes the rest of the direct path's frequency (cycles a sample) and its phase, [position, block].
    turn = phasor(-frequency * FOLD, -np.angle(referenced.amplitude[positions]), blocks, (blocks - 1) / 2)
    # Factors [position, 2] make each half the average of its chirps.
    scale = half_scale(aligned.good[positions].sum(axis=1))[..., None, None]
    return complex64(aligned.halves[positions] * (scale * (referenced.steering * turn[:, None])[:, None]))


def _estimate_direct_path_errors(mean: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the direct path [3, n] in averages [rx, position, block], from two halves of the RX."""
    halves = [_estimate(mean[h::2].swapaxes(0, 1), path.half_estimators[h]) for h in (0, 1)]
    amplitude = np.array([amplitude for amplitude, _ in halves])
    w = [w for _, w in halves]
    amplitude_size = np.abs(amplitude)
    # Remove the constant phase difference between the RX.
    phase = np.angle(amplitude * amplitude.mean(axis=1, keepdims=True).conj())
    size = amplitude_size / amplitude_size.mean(axis=1, keepdims=True)
    return np.array([(w[0] - w[1]) / (2 * np.pi), phase[0] - phase[1], size[0] - size[1]]) / 2


def _estimate(signal: NDArray[np.complex64], estimator: NDArray[np.complex128]) -> tuple[Complex, Real]:
    """Return amplitude and frequency (radians per sample) [...] of the direct path in signals [..., rx, block].

    The rows of `estimator` [2, rx * block] give the amplitude A and A times the frequency.
    """
    estimate = signal.reshape(*signal.shape[:-2], -1) @ estimator.T.astype(np.complex64)
    return estimate[..., 0].astype(complex), np.real(estimate[..., 1] / estimate[..., 0])


def _estimate_object_errors(halves: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the object [3, n] from two averages [position, 2, rx, block], for positions with an echo."""
    rx, n = halves.shape[2:]
    # Reference each half to its own direct path and subtract it; the object remains.
    amplitude, w = _estimate(halves, path.estimator)
    back = phasor(-w * FOLD / (2 * np.pi), -np.angle(amplitude), n, (n - 1) / 2)
    echo = halves * back[:, :, None]
    echo -= np.abs(amplitude).astype(np.float32)[..., None, None]
    product = (echo[:, 0] * echo[:, 1].conj()).sum(axis=1)
    # The product of the halves is a tone of their difference in frequency and phase; it is fitted to a few sums of it.
    edges = block_edges(n)
    tone = refine(np.add.reduceat(product, edges[:-1], axis=-1).astype(complex), block_times(edges) * FOLD, steps=2)
    # Amplitude of each half: its projection on the sum of both, in which its own energy and the product with the other
    # half add up.
    energy = signal_energy(echo.reshape(-1, rx, n)).reshape(-1, 2)
    mean_product = product.sum(axis=1)
    size = np.abs(energy + np.array([mean_product, mean_product.conj()]).T)
    contrast = (size[:, 0] - size[:, 1]) / np.maximum(size.sum(axis=1), 1e-30)
    # Keep positions whose halves are more coherent than noise would be by chance.
    echoing = np.abs(tone.amplitude) > 4 / np.sqrt(rx * n) * np.sqrt(energy.prod(axis=1))
    return np.array([tone.frequency / 2, np.angle(tone.amplitude) / 2, contrast])[:, echoing]


def _spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the RMS of errors [3, n]."""
    f, p, a = np.sqrt((values**2).mean(axis=1))
    return float(f), float(p), float(a)


@dataclass(frozen=True)
class CubeForm:
    """Conversion of a board's cube to our convention. Create with :func:`detect_form`.

    Attributes
    ----------
    conjugate
        True if the phases have the opposite sign.
    turn
        complex64 [rx, sample]: multiplies the cube after that.
    constant
        complex64 [rx]: direct path to add if it was removed (equal RX are assumed); otherwise zero.
    path
        Estimator to reference every position to its direct path; None if the cube is referenced already.
    chirp
        Chirp of the scan.
    how
        One sentence for quality.json.
    """

    conjugate: bool
    turn: NDArray[np.complex64]
    constant: NDArray[np.complex64]
    path: DirectPath | None
    chirp: Chirp
    how: str

    def convert_row(self, cube: NDArray[np.complex64], pulses: int) -> SyncedRow:
        """Convert a row of the cube, complex64 [rx, position, sample] in order of recording; zeros are masked.

        The receiver's filter is not compensated.
        """
        valid = _find_positions_with_data(cube)
        if not valid.all():
            cube = np.where(valid[:, None], cube, np.complex64(0))
        if self.conjugate:
            cube = cube.conj()
        samples = cube * self.turn[:, None]
        samples += self.constant[:, None, None]
        samples[:, ~valid] = 0
        if self.path is not None:
            samples, valid, hz, amplitude = _reference_cube(samples, valid, self.path, self.chirp)
        else:
            hz = np.zeros(valid.size)
            amplitude = np.abs(samples.mean(axis=(0, 2))).astype(np.float64)
        return SyncedRow(
            samples=samples,
            sweep_hz=sample_frequencies_hz(self.chirp),
            valid=valid,
            chirps=np.where(valid, pulses, 0),
            direct_hz=hz,
            direct_amplitude=amplitude,
        )


def _find_positions_with_data(cube: NDArray[np.complex64]) -> NDArray[np.bool_]:
    """Return the positions of a row [rx, position, sample] that are finite and not all zero, [position]."""
    numbers = np.ascontiguousarray(cube, np.complex64).view(np.float32)
    # The largest and the smallest of numbers with a NaN are NaN.
    highest = numbers.max(axis=2).max(axis=0)
    lowest = numbers.min(axis=2).min(axis=0)
    return np.isfinite(highest) & np.isfinite(lowest) & ((highest != 0) | (lowest != 0))


def detect_form(rows: Sequence[NDArray[np.complex64]], rig: Instrument, board: Board) -> CubeForm:
    """Detect the conventions of a board's cube.

    Parameters
    ----------
    rows
        Some of its rows, complex64 [rx, position, sample] each.
    rig, board
        Rig of the scan, and the board.

    Raises
    ------
    DataError
        if the rows have no data.
    """
    cube = np.concatenate([r[:, _find_positions_with_data(r)] for r in rows], axis=1)
    cube = cube[:, :: max(1, cube.shape[1] // _FORM_POSITIONS)]
    if cube.shape[1] == 0:
        raise DataError(
            f"the cube of board {board.name} has no data",
            "all samples are zero",
            "copy it again",
            code=ErrorCode.NO_DATA,
        )
    chirp = rig.chirp
    a, b = chirp.linear_samples
    sweep = sample_frequencies_hz(chirp)
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    gate = _gate_echoes(sweep[a:b], _gate_m(rig, board, tx, rx))
    # Removes the delay of each RX's direct path, if delays count from the transmitter.
    undo_delay = np.exp(-2j * np.pi * np.outer(direct_m, sweep) / SPEED_OF_LIGHT_M_S)
    conjugate, counted_from_tx = _find_sign_and_origin(cube, undo_delay, gate, (a, b))
    form = []
    if conjugate:
        cube = cube.conj()
        form.append("conjugated")
    turn = np.ones_like(undo_delay)
    if counted_from_tx:
        turn = undo_delay
        form.append("delays counted from the transmitter")
    cube = cube * turn[:, None]

    constant = np.zeros(len(rx))
    path = None
    mean, coherent = _average_direct_path(cube[..., a:b], gate)
    if coherent > _COHERENT:
        lag = np.exp(2j * np.pi * np.outer(direct_m - direct_m[0], sweep) / SPEED_OF_LIGHT_M_S)
        phasors = mean / np.abs(mean)
        # If all RX are referenced to the first, each keeps its lag behind it: their phases agree only without the lags
        # (at the middle frequency). Otherwise they agree as they are.
        if abs((phasors * lag[:, (a + b) // 2].conj()).sum()) > abs(phasors.sum()):
            turn = turn * lag.conj()
            form.append("all RX referenced to the direct path of one")
        else:
            form.append("each RX referenced to its own direct path")
    else:
        direct_path = prepare(rig, board)
        _, is_found, _, _ = _reference_cube(cube.astype(np.complex64), np.ones(cube.shape[1], bool), direct_path, chirp)
        if is_found.mean() > _MIN_FOUND and _share(cube[..., a:b], gate) < _ALONE:
            path = direct_path
            form.append("not referenced to a direct path; referenced here")
        else:
            # Any level would do, as amplitudes relative to the direct path mean nothing then. Chosen: the cube's rms
            # for the first RX, less for those farther away.
            level = np.sqrt(np.mean(np.abs(cube) ** 2))
            constant = level * direct_m[0] / direct_m
            form.append("the direct path was removed; equal RX are assumed")
    description = "; ".join(form) + "; the receiver's filter is not compensated"
    return CubeForm(conjugate, turn.astype(np.complex64), constant.astype(np.complex64), path, chirp, description)


def _find_sign_and_origin(
    cube: NDArray[np.complexfloating],
    undo_delay: NDArray[np.complex128],
    gate: NDArray[np.complex128],
    linear: tuple[int, int],
) -> tuple[bool, bool]:
    """Return two flags: the cube is conjugated, and its delays count from the transmitter.

    `undo_delay` [rx, sample] removes the delay of the direct path, `gate` [path, sample] are echoes from the object.
    The combination with the most power at the object is chosen; in doubt the simplest one.
    """
    a, b = linear
    readings = list(itertools.product((False, True), (False, True)))
    power = []
    for conjugate, counted_from_tx in readings:
        part = cube.conj() if conjugate else cube
        if counted_from_tx:
            part = part * undo_delay[:, None]
        part = part[..., a:b]
        power.append(float((np.abs((part * np.hanning(b - a)) @ gate.conj().T) ** 2).mean()))
    if power[0] >= _PREFER_SIMPLE * max(power):
        return readings[0]
    return readings[int(np.argmax(power))]


def _average_direct_path(
    part: NDArray[np.complexfloating], gate: NDArray[np.complex128]
) -> tuple[NDArray[np.complexfloating], float]:
    """Return the mean direct path [rx] in samples [rx, position, sample], and the share of its power that is constant.

    Each position's direct path is estimated by generalised least squares, which suppress the object.
    """
    samples = part.shape[-1]
    covariance = gate.T @ gate.conj() / len(gate) + _NOISE * np.eye(samples)
    weights = scipy.linalg.solve(covariance, np.ones(samples), assume_a="pos").conj()
    # Complex [rx, position].
    direct = part @ (weights / weights.sum())
    mean = direct.mean(axis=1)
    return mean, float(np.mean(np.abs(mean) ** 2 / np.mean(np.abs(direct) ** 2, axis=1)))


def _gate_m(rig: Instrument, board: Board, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> tuple[float, float]:
    """Return the smallest and largest excess path of echoes from the object plane."""
    # Nine places along each axis; chosen.
    offsets_m = np.linspace(-1, 1, 9) * _SPREAD_M
    dx, dy = (m.ravel() for m in np.meshgrid(offsets_m, offsets_m))
    excess = excess_path_m(tx, rx, np.array(specular_midpoint_m(rig, board)) + np.stack([dx, dy, 0 * dx], axis=1))
    return float(excess.min()), float(excess.max())


def _gate_echoes(sweep_hz: NDArray[np.floating], gate_m: tuple[float, float]) -> NDArray[np.complex128]:
    """Return echoes of evenly spaced paths in the gate (33, chosen), [path, sample]."""
    paths = np.linspace(*gate_m, 33)
    return np.exp(2j * np.pi * np.outer(paths, sweep_hz) / SPEED_OF_LIGHT_M_S)


def _share(samples: NDArray[np.complexfloating], gate: NDArray[np.complex128]) -> float:
    """Return the share of the power of samples [..., sample] explained by echoes in the gate."""
    _, strength, basis = np.linalg.svd(gate, full_matrices=False)
    # Weaker directions (by 40 dB, chosen) hold hardly any echo, only noise.
    in_gate = samples @ basis[strength > 1e-2 * strength[0]].conj().T
    return float((np.abs(in_gate) ** 2).sum() / (np.abs(samples) ** 2).sum())


def _reference_cube(
    cube: NDArray[np.complex64], valid: NDArray[np.bool_], path: DirectPath, chirp: Chirp
) -> tuple[NDArray[np.complex64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Reference positions to their direct path; return samples, mask of found positions, IF (Hz) and amplitude.

    Each position of the cube is treated as the average of one chirp.
    """
    samples = cube.shape[2]
    a, b = whole_blocks(chirp.linear_samples)
    # Mix each position down by its strongest bin, and present it as an aligned row of one chirp, in two equal halves.
    power = (np.abs(np.fft.fft(cube[..., a:b], axis=-1)) ** 2).sum(axis=0)
    centre = np.fft.fftfreq(b - a)[np.argmax(power, axis=-1)].astype(np.float64)
    middle = (a + b - 1) / 2
    zero_phase = np.zeros(centre.size)
    mixed = cube * phasor(-centre, zero_phase, samples, middle)
    halves = flatten(fold(mixed[..., a:b])).swapaxes(0, 1) / 2
    only_chirp_good = valid[:, None]
    zeros = np.zeros((centre.size, 1))
    aligned = AlignedRow(
        halves=np.ascontiguousarray(np.stack([halves, halves], axis=1), np.complex64),
        centre=centre,
        good=only_chirp_good,
        frequency=zeros,
        phase=zeros,
        amplitude=zeros + 1,
        gain=zeros + 1,
        error=np.zeros((centre.size, 2, 1)),
        coherence=zeros + 1,
        clipped=~only_chirp_good,
    )
    # A signal that is mixed down already has an IF of about zero (within 0.4 cycles per sample, chosen), of either
    # sign: it is searched for in the band of complex 2x.
    near_zero = bool(abs(np.median(centre)) < 0.4)
    if near_zero:
        done = reference(aligned, path, msgspec.structs.replace(chirp, if_mode="complex2x"))
    else:
        done = reference(aligned, path, chirp)
    # `reference` found how the IF drifts along a chirp: a phase that grows with the square of time, removed here too.
    time = np.arange(samples) - middle
    steering = path.steering * np.exp(-0.5j * done.drift * time**2)
    residual_cycles = (done.frequency - centre + 0.5) % 1.0 - 0.5
    turn = phasor(-residual_cycles, -np.angle(done.amplitude), samples, middle) * done.found[:, None]
    referenced = (mixed * steering[:, None] * turn).astype(np.complex64)
    return referenced, done.found, done.frequency * chirp.sample_rate_hz, np.abs(done.amplitude)
