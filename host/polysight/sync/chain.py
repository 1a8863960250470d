"""Synchronise the rows of a scan: from raw chirps to samples referenced to the direct path, with the residual errors.

Cubes that another program has synchronised are converted in `cubes.py`.

Residuals are frequency, phase and amplitude errors after each stage (Fig. 15 of the POLySIGHT paper). They are measured
on the scan itself, for any scene: an error is half the difference between two measurements with independent noise. For
an aligned chirp and for the direct path these are two halves of the RX, for the object two averages of every other
chirp. As received, and for the amplitude of an aligned chirp, an error is the deviation from the mean.

Aligned chirps are decimated: `FOLD` (4) samples become a *block*. Words are a card's int16; their axis of length 2 is
(I, Q).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture import encode_row_words, valid_frames, view_row_words
from polysight.store import CubeRow, RowData, Source
from polysight.sync import high_pass_filter as hpf, loops
from polysight.sync.cubes import CubeForm, detect_form
from polysight.sync.decimate import FOLD
from polysight.sync.direct_path import DirectPath, prepare
from polysight.sync.loops import Complex, Real, block_edges, block_times, cis, complex64, phasor, refine, signal_energy
from polysight.sync.offsets import (
    AlignedRow,
    Errors,
    ReferencedSamples,
    SyncedRow,
    align_pieces,
    find_dead_rx,
    half_scale,
    reference,
)
from polysight.sync.rx_order import find_rx_order
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.errors import DataError, ErrorCode

# Stages of `SyncedRow.errors`, and the signal whose errors are measured after each.
STAGES = {
    "received": "one chirp as received",
    "aligned": "one chirp after burst alignment",
    "averaged": "the direct path in a position's average",
    "referenced": "the object relative to the direct path in a position's average",
}

PUBLISHED_STD = {"frequency_hz": 138.0, "phase_rad": 0.022}
"""Standard deviations after the last stage on the published rig (POLySIGHT paper, section 9.1)."""

# Rows from which the form of cubes is detected; chosen.
_CUBE_ROWS = 7
# Positions read at a time: 2 MB, which stay in the processor's cache.
_POSITIONS = 32
EXAMINED_POSITIONS = 32
"""Positions per row used for residuals: standard deviations within 13 % for a row, 1 % for 150 rows."""

# Largest int16: a sample with this value was clipped.
_FULL_SCALE = 32767


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
    examined: int = EXAMINED_POSITIONS

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


def synchronise_row(frames: NDArray[Any], valid: NDArray[np.bool_], setup: BoardSetup) -> SyncedRow:
    """Compensate, align, average and reference a row of a board (paper, section 5.2).

    Parameters
    ----------
    frames
        int16 [frame, sample, 2, rx] from `view_row_words`, or complex64 [rx, frame, sample] in ADC counts, which are
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
    words = encode_row_words(frames) if np.iscomplexobj(frames) else frames
    return synchronise_pieces(lambda: [words], valid, setup)


def synchronise_pieces(
    read: Callable[[], Iterable[NDArray[np.int16]]], valid: NDArray[np.bool_], setup: BoardSetup
) -> SyncedRow:
    """Synchronise a row that `read` returns in pieces of whole bursts, int16 words as of :func:`synchronise_row`.

    A piece is not used any more when the next one is asked for, so that pieces may share memory. If an RX is dead, the
    row is read again, and synchronised as if this RX sent zeros.
    """
    if valid.size % setup.pulses:
        raise _mismatch_error(valid.size, setup.path.steering.shape, setup)
    received = valid.reshape(-1, setup.pulses)

    def align(dead: NDArray[np.bool_] | None = None) -> AlignedRow:
        bursts = _group_bursts(read(), valid.size, setup, dead)
        return align_pieces(bursts, received, setup.chirp.linear_samples, setup.equaliser, _FULL_SCALE)

    path = setup.path
    aligned = align()
    # The halves of a burst; a burst of one chirp has no second half.
    halves = aligned.halves.swapaxes(0, 2)
    dead = find_dead_rx(halves[:, 0], halves[:, min(1, setup.pulses - 1)])
    if dead.any():
        path = path.without_rx(dead)
        aligned = align(dead)
    synchronised = reference(aligned, path, setup.chirp)
    order: tuple[int, ...] = ()
    if 2 * np.count_nonzero(synchronised.found) < np.count_nonzero(aligned.good.any(axis=1)):
        # RX in another order may be why there is no direct path.
        order = find_rx_order(aligned, synchronised, path, lambda row, other: reference(row, other, setup.chirp))
    rate = setup.chirp.sample_rate_hz
    return SyncedRow(
        samples=synchronised.samples,
        sweep_hz=path.sweep_hz,
        valid=synchronised.found,
        chirps=aligned.good.sum(axis=1),
        direct_hz=synchronised.frequency * rate,
        direct_amplitude=np.abs(synchronised.amplitude),
        errors=errors(aligned, synchronised, path, rate, setup.examined),
        noise=synchronised.noise,
        turn=_turn_along(synchronised.samples),
        chirps_clipped=int(aligned.clipped.sum()),
        chirps_disturbed=int((received & ~aligned.clipped & ~aligned.good).sum()),
        positions_clipped=int((aligned.clipped.any(axis=1) & (aligned.clipped == received).all(axis=1)).sum()),
        rx_order=order,
    )


def _group_bursts(
    pieces: Iterable[NDArray[np.int16]], frames: int, setup: BoardSetup, dead: NDArray[np.bool_] | None
) -> Iterator[NDArray[np.int16]]:
    """Return pieces [frame, sample, 2, rx] as bursts [position, chirp, sample, 2, rx]; check that they are whole.

    Words of `dead` RX are replaced by zeros, and those of RX that are stuck, whose words do not change in a chirp: a
    constant is a tone in all chirps.
    """
    for words in pieces:
        chirps, samples, _, rx = words.shape
        frames -= chirps
        # The first chirp of a piece shows whether an RX is stuck.
        silent = (words[:1] == words[:1, :1]).all(axis=(0, 1, 2))
        if dead is not None:
            silent |= dead
        if silent.any() and not silent.all():
            words = words * ~silent
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
        loops.load_library()
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
        return synchronise_pieces(lambda: self._iterate_words(recorded), valid, self.setups[board]), int(valid.sum())

    def _iterate_words(self, recorded: RowData) -> Iterator[NDArray[np.int16]]:
        """Iterate over the words of a row, [chirp, sample, 2, rx], some positions at a time."""
        rig = self._source.instrument
        chirp_bytes = rig.frame_bytes // rig.burst.chirps
        for piece in recorded.pieces(_POSITIONS * rig.burst.chirps_a_position * chirp_bytes):
            # Without a list of missing bytes: `synchronise` finds the valid chirps.
            yield view_row_words(piece, (), piece.size // chirp_bytes, rig.chirp.samples, len(rig.antennas.rx_mm))[0]

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
    aligned: AlignedRow,
    referenced: ReferencedSamples,
    path: DirectPath,
    sample_rate_hz: float,
    max_positions: int = EXAMINED_POSITIONS,
) -> Errors:
    """Return the errors after each stage, float64 [3, n]: Hz, rad, and amplitude relative to its mean.

    At most `max_positions` valid positions are used, evenly spaced. Empty if no position is valid. The stage
    "referenced" has only positions with an echo.
    """
    if not referenced.found.any():
        return {}
    referenced_positions = np.flatnonzero(referenced.found)
    examined = referenced_positions[_spread_evenly(referenced_positions.size, max_positions)]
    good = aligned.good[examined]
    amplitude = referenced.amplitude[examined, None]
    relative_amplitude = aligned.amplitude[examined]

    # Errors of the received chirps: their offsets, plus those of their positions, from the mean. The gain that
    # compensated the receiver's filter is removed from the amplitudes.
    frequency = (referenced.frequency[examined, None] + aligned.frequency[examined])[good]
    phase = (np.angle(amplitude) + aligned.phase[examined])[good]
    size = (np.abs(amplitude) * relative_amplitude / aligned.gain[examined])[good]
    turns = (phase - np.angle(cis(phase).mean())) / (2 * np.pi)
    received = np.array([frequency - frequency.mean(), 2 * np.pi * (turns - np.rint(turns)), size / size.mean() - 1])

    mean_amplitude = (relative_amplitude * good).sum(axis=1, keepdims=True) / good.sum(axis=1, keepdims=True)
    amplitude_error = relative_amplitude / mean_amplitude - 1
    # `aligned.error` has frequency and phase on its second axis; the masks leave [2, n] and [n].
    chirp_errors = np.array([*aligned.error[examined].swapaxes(0, 1)[:, good], amplitude_error[good]])

    positions_with_several_chirps = examined[good.sum(axis=1) > 1]
    object_errors = np.zeros((3, 0))
    # A dead RX has no direct path: its figures are not finite.
    with np.errstate(divide="ignore", invalid="ignore"):
        direct_path_errors = _estimate_direct_path_errors(referenced.samples[:, examined], path)
        if positions_with_several_chirps.size:
            halves = _reference_halves(aligned, referenced, positions_with_several_chirps)
            object_errors = _estimate_object_errors(halves, path)
    out = {
        "received": received,
        "aligned": chirp_errors,
        "averaged": direct_path_errors,
        "referenced": object_errors,
    }
    # From cycles per sample to Hz.
    for values in out.values():
        values[0] *= sample_rate_hz
    return out


@lru_cache(maxsize=8)
def _spread_evenly(count: int, max_count: int) -> NDArray[np.intp]:
    """Return at most `max_count` of `count` indices, evenly spaced."""
    return np.linspace(0, count - 1, min(max_count, count)).astype(np.intp)


def _reference_halves(
    aligned: AlignedRow, referenced: ReferencedSamples, positions: NDArray[np.intp]
) -> NDArray[np.complex64]:
    """Return the halves of some positions' bursts as averages, referenced like `samples`: [position, 2, rx, block]."""
    blocks = aligned.halves.shape[-1]
    frequency = referenced.frequency[positions] - aligned.centre[positions]
    # Factor that removes the rest of the direct path's frequency (cycles a sample) and its phase, [position, block].
    turn = phasor(-frequency * FOLD, -np.angle(referenced.amplitude[positions]), blocks, (blocks - 1) / 2)
    # Factors [position, 2] make each half the average of its chirps.
    scale = half_scale(aligned.good[positions].sum(axis=1))[..., None, None]
    return complex64(aligned.halves[positions] * (scale * (referenced.steering * turn[:, None])[:, None]))


def _estimate_direct_path_errors(mean: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the direct path [3, n] in averages [rx, position, block], from two halves of the RX."""
    halves = [_estimate(mean.swapaxes(0, 1), estimator) for estimator in path.half_estimators]
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
