"""Estimate the positions of the receivers and of the object plane from a scan of a target with points at known places.

Samples are referenced to the direct path, so the echo of a point at v, at stage offset u and frequency f, is

    A exp(2 pi j f d / c) / (|v - u - tx| |v - u - rx|),    d = |v - u - tx| + |v - u - rx| - |tx - rx|

with the excess path d. The position of the transmitter in the rig file defines the frame. Unknowns are the shift of
each receiving board (3), the distance of the plane (1), and position (2) and rotation (1) of the target. They are
fitted by least squares over positions, RX and frequencies, with whitened noise. The amplitude A of each point is a free
complex number per board, eliminated by variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973), so that
only phase differences over aperture and frequency count. Each unknown has a prior (the accuracy of a ruler): an unknown
that the scan does not determine stays near the rig file, with the prior as its standard error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.calibration import files
from polysight.imaging import Antennas, find_scene_gate_m, image_grid, reduction, row_offsets_m
from polysight.store import RawSource
from polysight.sync import BoardSetup, HighPass, synchronise_row
from polysight_shared.config import Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.raster import plan_raster
from polysight_shared.tables import decode, read_toml
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Real = NDArray[np.float64]

# Largest deviation of the plane from the rig file for which the range gate contains the target's echoes; chosen.
DEPTH_M = 0.02
# Positions used by the fit; more take longer and improve it little.
POSITIONS = 400
# Positions used by the search for the target.
_SEARCH_POSITIONS = 100
# Largest displacement of the target along x and y in that search, and its step: less than half a resolution cell.
_REACH_MM = 12.0
_STEP_MM = 1.5
# A component of the reduced samples is left out if its noise power is less than this part of the largest; chosen.
_MIN_NOISE = 1e-3
# Part of the power that the points must explain; with less, another target or other objects were scanned. Chosen.
_MIN_EXPLAINED = 0.3


class TargetPoint(msgspec.Struct, frozen=True):
    """A scatterer of the target, millimetres along x and y from its middle."""

    position_mm: tuple[float, float]
    name: str = ""


class Target(msgspec.Struct, frozen=True):
    """A target file: `[[points]]`. Other keys are ignored, so that a scene file can be used too."""

    points: tuple[TargetPoint, ...] = ()


@dataclass(frozen=True)
class Prior:
    """Prior standard deviations of the unknowns."""

    board_mm: float = 5.0
    # Offset of the target's plane.
    plane_mm: float = 5.0
    # Displacement of the target along x and along y.
    target_mm: float = 10.0
    # Rotation of the target in its plane.
    turn_deg: float = 2.0

    def scale(self, boards: int) -> Real:
        """Return the standard deviation of each unknown, float64 [3 x boards + 4], millimetres and degrees."""
        return np.array([self.board_mm] * 3 * boards + [self.plane_mm, *2 * [self.target_mm], self.turn_deg])


@dataclass
class BoardEchoes:
    """Whitened samples of one board, from :func:`load_echoes`.

    Attributes
    ----------
    antennas
        Antennas by the rig file.
    samples
        complex128 [rx, position, k]: whitened samples, k their components.
    echo
        complex128 [k, frequency]: maps a spectrum to the components.
    offsets_m
        float64 [position, 3]: stage offsets.
    frequencies_hz
        float64 [frequency], evenly spaced.
    """

    antennas: Antennas
    samples: NDArray[np.complex128]
    echo: NDArray[np.complex128]
    offsets_m: Real
    frequencies_hz: Real


@dataclass
class PlacesFit:
    """Estimated unknowns, their covariance, and the explained share of the power.

    `values` are in the order of `Prior.scale`: shift of each of `boards` (x, y, z), distance of the plane, x and y of
    the target, each relative to the rig file, in millimetres; and the target's rotation, degrees.
    """

    values: Real
    covariance: Real
    explained: float
    boards: list[str] = field(default_factory=list)

    @property
    def errors(self) -> Real:
        """Standard errors of the unknowns, millimetres and degrees, in the order of `values`."""
        return np.sqrt(np.diag(self.covariance))


def read_target(path: Path) -> list[TargetPoint]:
    """Read the points of a target file. Raises ConfigError, and DataError for fewer than three."""
    points = list(decode(read_toml(path), Target, str(path)).points)
    if len(points) < 3:
        raise DataError(
            f"{path}: {len(points)} points",
            "two points do not separate rotation from shift",
            "give three or more [[points]] with position_mm = [x, y]",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    return points


def load_echoes(
    source: RawSource, rig: Instrument, filters: dict[str, HighPass | None] | None = None
) -> dict[str, BoardEchoes]:
    """Load the whitened samples of a scan by receiving board; `filters` are measured ones. Raises DataError."""
    return {b.name: _load_board(source, rig, b.name, (filters or {}).get(b.name)) for b in rig.receivers}


def fit_places(
    echoes: dict[str, BoardEchoes], rig: Instrument, points: list[TargetPoint], prior: Prior = Prior()
) -> PlacesFit:
    """Estimate the positions of boards, plane and target, starting from the rig file's, of standard deviation `prior`.

    `echoes` are those of :func:`load_echoes`.
    """
    points_mm = np.array([p.position_mm for p in points])
    centre = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    scale = prior.scale(len(echoes))
    boards = list(echoes.values())

    def misfit(unknown: Real, sigma: float) -> Real:
        """Return residuals in standard deviations: real, then imaginary part of each sample, then the prior's terms."""
        parts = [
            _subtract_echoes(b, unknown[3 * i : 3 * i + 3], _place_points(centre, points_mm, unknown))
            for i, b in enumerate(boards)
        ]
        residuals = np.concatenate([p.ravel() for p in parts]) / sigma
        return np.concatenate([residuals.real, residuals.imag, unknown / scale])

    # In the order of `Prior.scale`: shift of each board, distance of the plane, x, y and rotation of the target.
    start = np.zeros(scale.size)
    start[-3:-1] = _find_target(boards, centre, points_mm)
    size = sum(b.samples.size for b in boards)
    sigma = float(np.sqrt(np.mean(misfit(start, 1.0)[: 2 * size] ** 2)))
    fit: Any = None
    # Each fit improves the estimate of the noise. Tolerances and steps (a tenth of each prior) are chosen.
    for tolerance in (1e-3, 1e-6, 1e-8):
        fit = scipy.optimize.least_squares(
            misfit, start, args=(sigma,), method="lm", x_scale=scale / 10, ftol=tolerance, xtol=tolerance
        )
        start = fit.x
        sigma *= float(np.sqrt(np.mean(fit.fun[: 2 * size] ** 2)))
    power = sum(float((np.abs(b.samples) ** 2).sum()) for b in boards)
    explained = 1 - 2 * size * sigma**2 / power
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    return PlacesFit(fit.x, covariance, explained, list(echoes))


def _load_board(source: RawSource, rig: Instrument, name: str, model: HighPass | None) -> BoardEchoes:
    """Synchronise a board's scan, reduce it to the range gate, equalise its RX and whiten its noise.

    Raises DataError if no row has a direct path.
    """
    board = rig.by_name(name)
    plan = plan_raster(rig.grid)
    setup = BoardSetup.from_rig(rig, board, model=model)
    receivers = tuple(Antennas.from_rig(rig, b) for b in rig.receivers)
    gate = find_scene_gate_m(receivers, plan, image_grid(rig), DEPTH_M)
    maps = reduction(rig.chirp, gate)
    reduced = []
    direct = []
    offsets = []
    # One row in `stride` rows is used, and one position in `stride` positions of it.
    stride = max(1, int(np.ceil(np.sqrt(plan.positions / POSITIONS))))
    for row, words, valid in files.read_board_rows(source, name):
        if row % stride:
            continue
        synced = synchronise_row(words, valid, setup)
        keep = np.flatnonzero(synced.valid)[::stride]
        values = synced.samples[:, keep] @ maps.maps(synced.sweep_hz).T
        # The last map gives the direct path.
        reduced.append(values[..., :-1])
        direct.append(values[..., -1])
        offsets.append(row_offsets_m(rig, plan.row(row))[keep])
    samples = np.concatenate(reduced, axis=1)
    gains = np.concatenate(direct, axis=1).mean(axis=1)
    if not samples.size or np.any(gains == 0):
        raise DataError(
            f"{source.scan_id}: no direct path of {name}",
            "see `polysight sync-report`",
            "scan again",
            code=ErrorCode.NO_DATA,
        )
    # Noise is white in the raw samples, so its covariance in the reduced samples is that of the reduction.
    power, directions = np.linalg.eigh(maps.matrix @ maps.matrix.conj().T)
    has_noise = power > _MIN_NOISE * power[-1]
    whitening = directions[:, has_noise].conj().T / np.sqrt(power[has_noise])[:, None]
    samples = (samples / gains[:, None, None]) @ whitening.T
    all_offsets = np.concatenate(offsets)
    places = np.column_stack([all_offsets, np.zeros(len(all_offsets))])
    return BoardEchoes(Antennas.from_rig(rig, board), samples, whitening @ maps.model, places, maps.frequencies_hz)


def _place_points(centre: Real, points_mm: Real, unknown: Real) -> Real:
    """Return the positions of the target's points, metres [point, 3], rig frame.

    `centre` [3] is where the target's middle lies by the rig file; the last four of the unknowns move and turn it.
    """
    depth, x, y, turn = unknown[-4:]
    c = np.cos(np.radians(turn))
    s = np.sin(np.radians(turn))
    placed_xy = points_mm @ np.array([[c, s], [-s, c]]) + [x, y]
    return centre + np.column_stack([placed_xy, np.full(len(points_mm), depth)]) / 1e3


def _model_echoes(board: BoardEchoes, shift_mm: Real, places_m: Real) -> NDArray[np.complex128]:
    """Return the echo of each point with amplitude one, complex [rx * position * k, point]; k are the components.

    `shift_mm` [3] is that of the board, `places_m` [point, 3] are the points.
    """
    tx = board.antennas.tx_m
    rx = board.antennas.rx_m + np.asarray(shift_mm) / 1e3
    # [position, point, 3]
    difference = places_m[None] - board.offsets_m[:, None]
    out_m = np.linalg.norm(difference - tx, axis=-1)
    back = np.linalg.norm(difference[None] - rx[:, None, None], axis=-1)
    # [rx, position, point]
    path = out_m + back - np.linalg.norm(rx - tx, axis=-1)[:, None, None]
    f = board.frequencies_hz / SPEED_OF_LIGHT_M_S
    step = _rotate_phase(path * (f[-1] - f[0]) / (f.size - 1))
    tones = np.empty((*path.shape, f.size), np.complex128)
    tones[..., 0] = _rotate_phase(path * f[0]) / (out_m * back)
    # Frequencies are evenly spaced: each phasor follows from the one before.
    for k in range(1, f.size):
        np.multiply(tones[..., k - 1], step, out=tones[..., k])
    echoes = tones.reshape(-1, f.size) @ board.echo.T
    return echoes.reshape(*path.shape, -1).transpose(0, 1, 3, 2).reshape(-1, len(places_m))


def _rotate_phase(cycles: Real) -> NDArray[np.complex128]:
    """Return exp(2j pi cycles), of any shape, accurate for many cycles."""
    return np.exp(2j * np.pi * (cycles - np.round(cycles)))


def _subtract_echoes(board: BoardEchoes, shift_mm: Real, places_m: Real) -> NDArray[np.complex128]:
    """Return the samples minus the best-fitting sum of the points' echoes, complex [rx * position * k]."""
    design = _model_echoes(board, shift_mm, places_m)
    samples = board.samples.reshape(-1)
    amplitude = np.linalg.lstsq(design.conj().T @ design, design.conj().T @ samples, rcond=1e-9)[0]
    return samples - design @ amplitude


def _find_target(boards: list[BoardEchoes], centre: Real, points_mm: Real) -> tuple[float, float]:
    """Return the displacement of the target (x, y) on a coarse grid, millimetres, with the most power at its points."""
    best = -1.0
    best_place = (0.0, 0.0)
    small_boards = [_take_some_positions(b) for b in boards]
    steps = np.arange(-_REACH_MM, _REACH_MM + _STEP_MM / 2, _STEP_MM)
    for x in steps:
        for y in steps:
            places = _place_points(centre, points_mm, np.array([0.0, x, y, 0.0]))
            total = 0.0
            for board in small_boards:
                design = _model_echoes(board, np.zeros(3), places)
                correlation = design.conj().T @ board.samples.reshape(-1)
                total += float((np.abs(correlation) ** 2 / (np.abs(design) ** 2).sum(axis=0)).sum())
            if total > best:
                best = total
                best_place = (float(x), float(y))
    return best_place


def _take_some_positions(b: BoardEchoes) -> BoardEchoes:
    """Return the samples of one RX at some positions."""
    picked = slice(None, None, -(-len(b.offsets_m) // _SEARCH_POSITIONS))
    antennas = Antennas(b.antennas.tx_m, b.antennas.rx_m[:1])
    return BoardEchoes(antennas, b.samples[:1, picked], b.echo, b.offsets_m[picked], b.frequencies_hz)


def places_file(rig: Instrument, fit: PlacesFit, points: int, sources: list[files.SourceScan]) -> files.PlacesFile:
    """Return a fit as a calibration file. Raises DataError if the points explain too little of the data."""
    if fit.explained < _MIN_EXPLAINED:
        raise DataError(
            f"the points explain {100 * fit.explained:.0f} % of the echoes",
            "another target was scanned, it lay more than a centimetre off the middle, or other objects reflect too",
            "check the target file; cover other reflecting objects",
            code=ErrorCode.MISMATCH,
        )
    errors = fit.errors
    boards = {}
    for i, name in enumerate(fit.boards):
        board_values = slice(3 * i, 3 * i + 3)
        antennas = Antennas.from_rig(rig, rig.by_name(name))
        vector_before = antennas.rx_m[0] - antennas.tx_m
        vector_after = vector_before + fit.values[board_values] / 1e3
        unit_vector = vector_after / np.linalg.norm(vector_after)
        boards[name] = files.BoardPlace(
            shift_mm=_make_vector(fit.values[board_values]),
            standard_error_mm=_make_vector(errors[board_values]),
            direct_path_mm=float(np.linalg.norm(vector_after) * 1e3),
            direct_path_was_mm=float(np.linalg.norm(vector_before) * 1e3),
            direct_path_standard_error_mm=float(
                np.sqrt(unit_vector @ fit.covariance[board_values, board_values] @ unit_vector)
            ),
        )
    depth, x, y, turn = (float(v) for v in fit.values[-4:])
    return files.PlacesFile(
        **files.make_header("direct_path", sources),
        rig_crc32=files.places_crc32(rig),
        boards=boards,
        object_distance_mm=rig.geometry.object_distance_mm + depth,
        object_distance_was_mm=rig.geometry.object_distance_mm,
        object_distance_standard_error_mm=float(errors[-4]),
        target_mm=(x, y),
        target_standard_error_mm=(float(errors[-3]), float(errors[-2])),
        target_turn_deg=turn,
        target_turn_standard_error_deg=float(errors[-1]),
        explained=fit.explained,
        points=points,
    )


def _make_vector(values: Real) -> files.Vector:
    """Return a vector [3] as plain numbers."""
    x, y, z = (float(v) for v in values)
    return x, y, z
