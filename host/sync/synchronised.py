"""Cubes that were synchronised by another program: what they are referenced to, and how to bring them to our form.

Ours is: an echo of excess path d over the direct path is `a exp(+j 2 pi f d / c)`, the direct path a constant. Of a
cube from elsewhere only its shape is known. The geometry says where direct path and object must lie, so the data itself
tells the rest: the sign of its phase, whether delays count from the transmitter or from the direct path, whether each
RX is referenced to its own direct path or all to that of RX1, and whether the direct path is still in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.host.sync.align import AlignedRow, whole_blocks
from polysight.host.sync.chain import SyncedRow
from polysight.host.sync.direct_path import DirectPath, excess_path_m, prepare, reference
from polysight.host.sync.numpy_passes import FOLD
from polysight.shared.config import Board, Chirp, Instrument
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DataError
from polysight.shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight.shared.units import SPEED_OF_LIGHT_M_S

_SPREAD_M = 0.15  # echoes come from this far to either side of the mirror point
_NOISE = 1e-3  # noise power of one sample beside the object's, for the direct path's estimate
_AS_LEFT = 0.7  # the simplest reading stands unless another puts this much more of the power where the object is
_COHERENT = 0.5  # part of a direct path's power that is the same at all positions, if it is the reference
_FOUND = 0.5  # of the positions
_ALONE = 0.8  # part of the power that lies where the object is, if nothing else is in the cube


@dataclass(frozen=True)
class CubeForm:
    """How a board's cube is brought to our form. Build with :func:`recognise`.

    Attributes
    ----------
    conjugate
        Its phases have the opposite sign.
    turn
        complex64 [rx, sample]: multiplies it, after that.
    constant
        complex64 [rx]: a direct path to put back in, where it was removed; the RX are then taken to be alike.
    path
        Find the direct path of every position and reference to it; None where the cube is referenced already.
    chirp
        The scan's.
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
        """One row of the cube, complex64 [rx, position, sample], positions as they were met; zeros are masked.

        The receiver's filter is left as it is.
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


def recognise(rows: Sequence[NDArray[np.complex64]], rig: Instrument, board: Board) -> CubeForm:
    """Find the form of a board's cube.

    Parameters
    ----------
    rows
        Some rows of it, complex64 [rx, position, sample] each.
    rig, board
        The scan's rig file, and the board.

    Raises
    ------
    DataError
        when the rows hold no data.
    """
    cube = np.concatenate([r[:, np.isfinite(r).all(axis=(0, 2)) & (r != 0).any(axis=(0, 2))] for r in rows], axis=1)
    if cube.shape[1] == 0:
        raise DataError(
            f"the cube of board {board.name} holds no data", "it is all zero", "fetch it again", code=ErrorCode.NO_DATA
        )
    chirp = rig.chirp
    (a, b), sweep = chirp.linear_samples, chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    tx, rx = np.array(tx_position_m(rig)), np.array(rx_positions_m(rig, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    gate = _gate_echoes(sweep[a:b], _gate_m(rig, board, tx, rx))
    absolute = np.exp(-2j * np.pi * np.outer(direct_m, sweep) / SPEED_OF_LIGHT_M_S)
    conjugate, counted_from_tx = _reading(cube, absolute, gate, (a, b))
    turn = absolute if counted_from_tx else np.ones_like(absolute)
    said = ["conjugated"] * conjugate + ["delays counted from the transmitter"] * counted_from_tx
    cube = (cube.conj() if conjugate else cube) * turn[:, None]

    constant, path = np.zeros(len(rx)), None
    mean, coherent = _direct_path(cube[..., a:b], gate)
    if coherent > _COHERENT:
        lag = np.exp(2j * np.pi * np.outer(direct_m - direct_m[0], sweep) / SPEED_OF_LIGHT_M_S)
        phasors = mean / np.abs(mean)
        if abs((phasors * lag[:, (a + b) // 2].conj()).sum()) > abs(phasors.sum()):
            turn = turn * lag.conj()
            said.append("all RX referenced to the direct path of one")
        else:
            said.append("each RX referenced to its own direct path")
    else:
        own = prepare(rig, board)
        _, found, _, _ = _referenced(cube.astype(np.complex64), np.ones(cube.shape[1], bool), own, chirp)
        if found.mean() > _FOUND and _share(cube[..., a:b], gate) < _ALONE:
            path = own
            said.append("not referenced to a direct path; referenced here")
        else:
            level = np.sqrt(np.mean(np.abs(cube) ** 2))
            constant = level * direct_m[0] / direct_m
            said.append("the direct path was taken out; the RX are taken to be alike")
    how = "; ".join(said) + "; the receiver's filter is left as it is"
    return CubeForm(conjugate, turn.astype(np.complex64), constant.astype(np.complex64), path, chirp, how)


def _reading(
    cube: NDArray[np.complexfloating],
    absolute: NDArray[np.complex128],
    gate: NDArray[np.complex128],
    linear: tuple[int, int],
) -> tuple[bool, bool]:
    """Whether a cube is conjugated, and whether its delays count from the transmitter.

    `absolute` [rx, sample] takes the direct path's delay out, `gate` [path, sample] are echoes from the object. The
    reading is taken that puts the most power where the object must be; the simplest one in doubt.
    """
    a, b = linear
    readings = list(product((False, True), (False, True)))
    power = []
    for conjugate, counted_from_tx in readings:
        turn = absolute if counted_from_tx else np.ones_like(absolute)
        part = ((cube.conj() if conjugate else cube) * turn[:, None])[..., a:b]
        power.append(float((np.abs((part * np.hanning(b - a)) @ gate.conj().T) ** 2).mean()))
    return readings[0 if power[0] >= _AS_LEFT * max(power) else int(np.argmax(power))]


def _direct_path(
    part: NDArray[np.complexfloating], gate: NDArray[np.complex128]
) -> tuple[NDArray[np.complexfloating], float]:
    """The direct path's mean over positions, [rx], in samples [rx, position, sample]; and its share of power.

    By the estimate that does not hear the object (generalised least squares).
    """
    samples = part.shape[-1]
    covariance = gate.T @ gate.conj() / len(gate) + _NOISE * np.eye(samples)
    weights = scipy.linalg.solve(covariance, np.ones(samples), assume_a="pos").conj()
    heard = part @ (weights / weights.sum())  # [rx, position]
    mean = heard.mean(axis=1)
    return mean, float(np.mean(np.abs(mean) ** 2 / np.mean(np.abs(heard) ** 2, axis=1)))


def _gate_m(rig: Instrument, board: Board, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> tuple[float, float]:
    """Excess paths of echoes from the object plane."""
    dx, dy = (m.ravel() for m in np.meshgrid(*2 * [np.linspace(-1, 1, 9) * _SPREAD_M]))
    excess = excess_path_m(tx, rx, np.array(specular_midpoint_m(rig, board)) + np.stack([dx, dy, 0 * dx], axis=1))
    return float(excess.min()), float(excess.max())


def _gate_echoes(sweep_hz: NDArray[np.floating], gate_m: tuple[float, float]) -> NDArray[np.complex128]:
    """Echoes of paths over the gate, [path, sample]."""
    paths = np.linspace(*gate_m, 33)
    return np.exp(2j * np.pi * np.outer(paths, sweep_hz) / SPEED_OF_LIGHT_M_S)


def _share(part: NDArray[np.complexfloating], gate: NDArray[np.complex128]) -> float:
    """Part of the power of samples [..., sample] that echoes from the gate can explain."""
    _, strength, basis = np.linalg.svd(gate, full_matrices=False)
    inside = part @ basis[strength > 1e-2 * strength[0]].conj().T
    return float((np.abs(inside) ** 2).sum() / (np.abs(part) ** 2).sum())


def _referenced(
    cube: NDArray[np.complex64], valid: NDArray[np.bool_], path: DirectPath, chirp: Chirp
) -> tuple[NDArray[np.complex64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Samples referenced to their direct path, where it was found, its IF (Hz) and its amplitude.

    The cube's positions are taken for averages of one chirp.
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
    near_zero = bool(abs(np.median(centre)) < 0.4)  # mixed down already: no IF is outside the receiver's band then
    done = reference(aligned, path, msgspec.structs.replace(chirp, if_mode="complex2x") if near_zero else chirp)
    return done.samples, done.found, done.frequency * chirp.sample_rate_hz, np.abs(done.amplitude)
