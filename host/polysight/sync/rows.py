"""Synchronise the rows of a source: raw rows with `synchronise_row`, rows of cubes by converting their form.

Cubes that another program has synchronised: detect their conventions and convert them to ours.

Our convention: an echo of excess path d is `a exp(+j 2 pi f d / c)`, and the direct path is constant. The conventions
of a cube are unknown, but the geometry determines where direct path and object must lie. From that `detect_form` finds
the sign of the phase, whether delays count from the transmitter or from the direct path, whether each RX is referenced
to its own direct path or all to that of RX1, and whether the direct path was removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.capture import row_words, valid_frames
from polysight.store import CubeRow, RowData, Source
from polysight.sync.align import AlignedRow, whole_blocks
from polysight.sync.chain import BoardSetup, SyncedRow, synchronise_pieces
from polysight.sync.direct_path import DirectPath, excess_path_m, prepare, reference
from polysight.sync.high_pass_filter import HighPass
from polysight.sync.numpy_passes import FOLD
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

_SPREAD_M = 0.15  # echoes come from within this distance of the mirror point
_NOISE = 1e-3  # noise power of a sample relative to the object, for the estimate of the direct path
_PREFER_SIMPLE = 0.7  # the simplest convention is kept if it explains this part of the best one's power
_COHERENT = 0.5  # smallest constant share of the direct path's power if the cube is referenced to it
_MIN_FOUND = 0.5  # smallest share of positions with a direct path
_ALONE = 0.8  # share of power at the object above which the cube contains nothing else

_CUBE_ROWS = 7  # rows used to detect the form of a cube
_POSITIONS = 32  # read at a time: 2 MB, which stay in the processor's cache


@dataclass(frozen=True)
class CubeForm:
    """Conversion of a board's cube to our convention. Create with :func:`detect_form`.

    Attributes
    ----------
    conjugate
        The phases have the opposite sign.
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

    def synced(self, cube: NDArray[np.complex64], pulses: int) -> SyncedRow:
        """Convert a row of the cube, complex64 [rx, position, sample] in order of recording; zeros are masked.

        The receiver's filter is not compensated.
        """
        valid = np.isfinite(cube).all(axis=(0, 2)) & (cube != 0).any(axis=(0, 2))
        samples = self._turned(np.where(valid[:, None], cube, 0)) + self.constant[:, None, None]
        samples *= valid[:, None]
        zeros = np.zeros(valid.size)
        if self.path is not None:
            samples, valid, hz, amplitude = _referenced(samples, valid, self.path, self.chirp)
        else:
            hz, amplitude = zeros, np.abs(samples.mean(axis=(0, 2))).astype(np.float64)
        return SyncedRow(samples, valid, np.where(valid, pulses, 0), hz, amplitude, zeros, zeros)

    def _turned(self, cube: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return ((cube.conj() if self.conjugate else cube) * self.turn[:, None]).astype(np.complex64)


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
    cube = np.concatenate([r[:, np.isfinite(r).all(axis=(0, 2)) & (r != 0).any(axis=(0, 2))] for r in rows], axis=1)
    if cube.shape[1] == 0:
        raise DataError(
            f"the cube of board {board.name} has no data",
            "all samples are zero",
            "copy it again",
            code=ErrorCode.NO_DATA,
        )
    chirp = rig.chirp
    (a, b), sweep = chirp.linear_samples, chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    tx, rx = np.array(tx_position_m(rig)), np.array(rx_positions_m(rig, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    gate = _gate_echoes(sweep[a:b], _gate_m(rig, board, tx, rx))
    absolute = np.exp(-2j * np.pi * np.outer(direct_m, sweep) / SPEED_OF_LIGHT_M_S)
    conjugate, counted_from_tx = _sign_and_origin(cube, absolute, gate, (a, b))
    turn = absolute if counted_from_tx else np.ones_like(absolute)
    form = ["conjugated"] * conjugate + ["delays counted from the transmitter"] * counted_from_tx
    cube = (cube.conj() if conjugate else cube) * turn[:, None]

    constant, path = np.zeros(len(rx)), None
    mean, coherent = _direct_path(cube[..., a:b], gate)
    if coherent > _COHERENT:
        lag = np.exp(2j * np.pi * np.outer(direct_m - direct_m[0], sweep) / SPEED_OF_LIGHT_M_S)
        phasors = mean / np.abs(mean)
        if abs((phasors * lag[:, (a + b) // 2].conj()).sum()) > abs(phasors.sum()):
            turn = turn * lag.conj()
            form.append("all RX referenced to the direct path of one")
        else:
            form.append("each RX referenced to its own direct path")
    else:
        own = prepare(rig, board)
        _, found, _, _ = _referenced(cube.astype(np.complex64), np.ones(cube.shape[1], bool), own, chirp)
        if found.mean() > _MIN_FOUND and _share(cube[..., a:b], gate) < _ALONE:
            path = own
            form.append("not referenced to a direct path; referenced here")
        else:
            level = np.sqrt(np.mean(np.abs(cube) ** 2))
            constant = level * direct_m[0] / direct_m
            form.append("the direct path was removed; equal RX are assumed")
    how = "; ".join(form) + "; the receiver's filter is not compensated"
    return CubeForm(conjugate, turn.astype(np.complex64), constant.astype(np.complex64), path, chirp, how)


def _sign_and_origin(
    cube: NDArray[np.complexfloating],
    absolute: NDArray[np.complex128],
    gate: NDArray[np.complex128],
    linear: tuple[int, int],
) -> tuple[bool, bool]:
    """Return two flags: the cube is conjugated, and its delays count from the transmitter.

    `absolute` [rx, sample] removes the delay of the direct path, `gate` [path, sample] are echoes from the object. The
    combination with the most power at the object is chosen; in doubt the simplest one.
    """
    a, b = linear
    readings = list(product((False, True), (False, True)))
    power = []
    for conjugate, counted_from_tx in readings:
        turn = absolute if counted_from_tx else np.ones_like(absolute)
        part = ((cube.conj() if conjugate else cube) * turn[:, None])[..., a:b]
        power.append(float((np.abs((part * np.hanning(b - a)) @ gate.conj().T) ** 2).mean()))
    return readings[0 if power[0] >= _PREFER_SIMPLE * max(power) else int(np.argmax(power))]


def _direct_path(
    part: NDArray[np.complexfloating], gate: NDArray[np.complex128]
) -> tuple[NDArray[np.complexfloating], float]:
    """Return the mean direct path [rx] in samples [rx, position, sample], and its share of power.

    Generalised least squares, which suppresses the object.
    """
    samples = part.shape[-1]
    covariance = gate.T @ gate.conj() / len(gate) + _NOISE * np.eye(samples)
    weights = scipy.linalg.solve(covariance, np.ones(samples), assume_a="pos").conj()
    direct = part @ (weights / weights.sum())  # [rx, position]
    mean = direct.mean(axis=1)
    return mean, float(np.mean(np.abs(mean) ** 2 / np.mean(np.abs(direct) ** 2, axis=1)))


def _gate_m(rig: Instrument, board: Board, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> tuple[float, float]:
    """Return the smallest and largest excess path of echoes from the object plane."""
    dx, dy = (m.ravel() for m in np.meshgrid(*2 * [np.linspace(-1, 1, 9) * _SPREAD_M]))
    excess = excess_path_m(tx, rx, np.array(specular_midpoint_m(rig, board)) + np.stack([dx, dy, 0 * dx], axis=1))
    return float(excess.min()), float(excess.max())


def _gate_echoes(sweep_hz: NDArray[np.floating], gate_m: tuple[float, float]) -> NDArray[np.complex128]:
    """Return echoes of evenly spaced paths in the gate, [path, sample]."""
    paths = np.linspace(*gate_m, 33)
    return np.exp(2j * np.pi * np.outer(paths, sweep_hz) / SPEED_OF_LIGHT_M_S)


def _share(part: NDArray[np.complexfloating], gate: NDArray[np.complex128]) -> float:
    """Return the share of the power of samples [..., sample] explained by echoes in the gate."""
    _, strength, basis = np.linalg.svd(gate, full_matrices=False)
    inside = part @ basis[strength > 1e-2 * strength[0]].conj().T
    return float((np.abs(inside) ** 2).sum() / (np.abs(part) ** 2).sum())


def _referenced(
    cube: NDArray[np.complex64], valid: NDArray[np.bool_], path: DirectPath, chirp: Chirp
) -> tuple[NDArray[np.complex64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Reference positions to their direct path; return samples, mask of found positions, IF (Hz) and amplitude.

    Each position of the cube is treated as the average of one chirp.
    """
    rx, positions, samples = cube.shape
    a, b = whole_blocks(chirp.linear_samples)
    power = (np.abs(np.fft.fft(cube[..., a:b], axis=-1)) ** 2).sum(axis=0)
    centre = np.fft.fftfreq(b - a)[np.argmax(power, axis=-1)].astype(np.float64)
    mixed = cube * np.exp(-2j * np.pi * np.outer(centre, np.arange(samples)))
    folded = mixed[..., a:b].reshape(rx, positions, -1, FOLD).mean(axis=-1).swapaxes(0, 1) / 2
    one, none = valid[:, None], np.zeros((positions, 1))
    aligned = AlignedRow(
        np.ascontiguousarray(mixed.swapaxes(0, 1), np.complex64),
        np.stack([folded, folded], axis=1).astype(np.complex64),
        centre,
        one,
        none,
        none,
        none + 1,
        none + 1,
        np.zeros((2, positions, 1)),
        none + 1,
        np.zeros((positions, 1), np.int32),
    )
    near_zero = bool(abs(np.median(centre)) < 0.4)  # mixed down already, so any IF is within the band
    done = reference(aligned, path, msgspec.structs.replace(chirp, if_mode="complex2x") if near_zero else chirp)
    return done.samples, done.found, done.frequency * chirp.sample_rate_hz, np.abs(done.amplitude)


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

    def __init__(self, source: Source, rig: Instrument, filters: Mapping[str, HighPass | None]) -> None:
        self._source = source
        self.setups = {b.name: BoardSetup.of(rig, b, model=filters.get(b.name)) for b in rig.receivers}
        self._forms: dict[str, CubeForm] = {}

    def synchronise(self, board: str, recorded: RowData | CubeRow) -> tuple[SyncedRow, int]:
        """Synchronise a row of a board; return it and the number of whole frames. Raises DataError."""
        rig = self._source.instrument
        if isinstance(recorded, CubeRow):
            synced = self._form(board).synced(recorded.cube, rig.burst.chirps_a_position)
            return synced, int(synced.valid.sum())
        valid = valid_frames(recorded.missing, recorded.frames_expected, rig.frame_bytes // rig.burst.chirps)
        return synchronise_pieces(self._words(recorded), valid, self.setups[board]), int(valid.sum())

    def _words(self, recorded: RowData) -> Iterator[NDArray[np.int16]]:
        """Iterate over the words of a row, [frame, sample, 2, rx], some positions at a time."""
        rig = self._source.instrument
        frame = rig.frame_bytes // rig.burst.chirps
        for piece in recorded.pieces(_POSITIONS * rig.burst.chirps_a_position * frame):
            yield row_words(piece, (), piece.size // frame, rig.chirp.samples)[0]

    @property
    def direct_path_known(self) -> bool:
        """True if amplitudes are relative to the direct path; False for cubes without it."""
        return not any(form.constant.any() for form in self._forms.values())

    def recording_facts(self) -> dict[str, Any]:
        """Return the entry on recording of quality.json, with the form of cubes."""
        facts = self._source.recording_facts()
        if self._forms:
            facts["recording"]["cubes"] = {name: form.how for name, form in self._forms.items()}
        return facts

    def _form(self, board: str) -> CubeForm:
        """Return the form of a board's cube, detected from a few of its rows."""
        if board not in self._forms:
            rig, rows = self._source.instrument, self._source.plan.rows
            some = sorted({int(r) for r in np.linspace(0, rows - 1, _CUBE_ROWS)})
            cubes = [row.cube for r in some if isinstance(row := self._source.read_row(board, r), CubeRow)]
            self._forms[board] = detect_form(cubes, rig, rig.by_name(board))
        return self._forms[board]
