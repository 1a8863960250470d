"""Convert cubes that another program has synchronised to our convention.

Our convention is that an echo of excess path d is `a exp(+j 2 pi f d / c)`, and the direct path is constant. The
conventions of a cube are unknown, but the geometry determines where direct path and object must lie. From that
`detect_form` finds the sign of the phase, whether delays count from the transmitter or from the direct path, whether
each RX is referenced to its own direct path or all to that of RX1, and whether the direct path was removed.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.sync.decimate import flatten, fold, sample_frequencies_hz, whole_blocks
from polysight.sync.direct_path import DirectPath, excess_path_m, prepare
from polysight.sync.loops import phasor
from polysight.sync.offsets import (
    JUDGED_ECHOES,
    JUDGED_POSITIONS,
    AlignedRow,
    SyncedRow,
    find_dead_rx,
    reference,
)
from polysight.sync.rx_order import find_rx_order
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Approximate number of positions that the form is detected from; chosen, as are the following numbers.
_FORM_POSITIONS = 300
# Echoes come from within this distance of the mirror point; chosen.
_SPREAD_M = 0.15
# Noise power of a sample relative to the object, for the estimate of the direct path; chosen.
_NOISE_POWER = 1e-3
# The simplest convention is kept if it explains this part of the best one's power.
_SIMPLE_SHARE = 0.7
# Smallest constant share of the direct path's power if the cube is referenced to it.
_LEAST_CONSTANT_SHARE = 0.5
# Smallest share of positions with a direct path; chosen.
_MIN_FOUND = 0.5
# Share of power at the object above which the cube contains nothing else: its direct path was removed.
_ALONE_SHARE = 0.8


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
        Description of the conversion for quality.json, one sentence.
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
        hz = np.zeros(valid.size)
        amplitude = hz
        turned_samples = samples
        has_data = valid
        order: tuple[int, ...] = ()
        if self.path is not None:
            samples, valid, hz, amplitude, order = _reference_cube(turned_samples, has_data, self.path, self.chirp)
        # Neighbouring positions hold nearly the same signals.
        judged = JUDGED_POSITIONS
        if self.constant.any():
            judged = JUDGED_ECHOES
        dead = find_dead_rx(samples[:, :-1], samples[:, 1:], judged)
        if self.path is not None and dead.any():
            path = self.path.without_rx(dead)
            samples, valid, hz, amplitude, _ = _reference_cube(turned_samples, has_data, path, self.chirp)
        samples += self.constant[:, None, None]
        samples[:, ~valid] = 0
        samples[dead] = 0
        if self.path is None:
            amplitude = np.abs(samples.mean(axis=(0, 2))).astype(np.float64)
        return SyncedRow(
            samples=samples,
            sweep_hz=sample_frequencies_hz(self.chirp),
            valid=valid,
            chirps=np.where(valid, pulses, 0),
            direct_hz=hz,
            direct_amplitude=amplitude,
            rx_order=order,
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
    if coherent > _LEAST_CONSTANT_SHARE:
        lag = np.exp(2j * np.pi * np.outer(direct_m - direct_m[0], sweep) / SPEED_OF_LIGHT_M_S)
        # If all RX are referenced to the first, each keeps its delay relative to it: their phases agree only without
        # the delays (at the middle frequency). Otherwise they agree with them.
        if abs((mean * lag[:, (a + b) // 2].conj()).sum()) > abs(mean.sum()):
            turn = turn * lag.conj()
            form.append("all RX referenced to the direct path of one")
        else:
            form.append("each RX referenced to its own direct path")
    else:
        direct_path = prepare(rig, board)
        _, is_found, _, _, order = _reference_cube(
            cube.astype(np.complex64), np.ones(cube.shape[1], bool), direct_path, chirp
        )
        has_direct_path = is_found.mean() > _MIN_FOUND or bool(order)
        if has_direct_path and _share(cube[..., a:b], gate) < _ALONE_SHARE:
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
        cube_part = cube.conj() if conjugate else cube
        if counted_from_tx:
            cube_part = cube_part * undo_delay[:, None]
        cube_part = cube_part[..., a:b]
        power.append(float((np.abs((cube_part * np.hanning(b - a)) @ gate.conj().T) ** 2).mean()))
    if power[0] >= _SIMPLE_SHARE * max(power):
        return readings[0]
    return readings[int(np.argmax(power))]


def _average_direct_path(
    part: NDArray[np.complexfloating], gate: NDArray[np.complex128]
) -> tuple[NDArray[np.complexfloating], float]:
    """Return the mean direct path [rx] in samples [rx, position, sample], and the share of its power that is constant.

    Each position's direct path is estimated by generalised least squares, which suppress the object.
    """
    samples = part.shape[-1]
    covariance = gate.T @ gate.conj() / len(gate) + _NOISE_POWER * np.eye(samples)
    weights = scipy.linalg.solve(covariance, np.ones(samples), assume_a="pos").conj()
    # Complex [rx, position].
    direct = part @ (weights / weights.sum())
    mean = direct.mean(axis=1)
    return mean, float(np.sum(np.abs(mean) ** 2) / np.sum(np.mean(np.abs(direct) ** 2, axis=1)))


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
    gate_amplitudes = samples @ basis[strength > 1e-2 * strength[0]].conj().T
    return float((np.abs(gate_amplitudes) ** 2).sum() / (np.abs(samples) ** 2).sum())


def _reference_cube(
    cube: NDArray[np.complex64], valid: NDArray[np.bool_], path: DirectPath, chirp: Chirp
) -> tuple[NDArray[np.complex64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64], tuple[int, ...]]:
    """Reference positions to their direct path; return samples, mask of found positions, IF (Hz) and amplitude.

    Each position of the cube is treated as the average of one chirp. The last value is that of `find_rx_order`.
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
        chirp = msgspec.structs.replace(chirp, if_mode="complex2x")
    estimate = reference(aligned, path, chirp)
    order: tuple[int, ...] = ()
    if 2 * np.count_nonzero(estimate.found) < np.count_nonzero(valid):
        # RX in another order may be why there is no direct path.
        order = find_rx_order(aligned, estimate, path, lambda row, other: reference(row, other, chirp))
    # `reference` found how the IF drifts along a chirp: a phase that grows with the square of time, removed here too.
    time = np.arange(samples) - middle
    steering = path.steering * np.exp(-0.5j * estimate.drift * time**2)
    residual_cycles = (estimate.frequency - centre + 0.5) % 1.0 - 0.5
    turn = phasor(-residual_cycles, -np.angle(estimate.amplitude), samples, middle) * estimate.found[:, None]
    referenced = (mixed * steering[:, None] * turn).astype(np.complex64)
    return referenced, estimate.found, estimate.frequency * chirp.sample_rate_hz, np.abs(estimate.amplitude), order
