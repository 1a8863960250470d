"""Point response of an aperture, and its field of view.

`compute_point_response` images a point in the middle of the scene with the aperture's taper and mask. It gives the
width of the image, the limit of the geometry, and the width by the POLySIGHT paper's formula. `describe_imaging` gives
the entry `imaging` of quality.json. `compute_field_limits` gives the field without ghosts, and the margin of aperture
around flat plates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.imaging.direct import DirectImager, backproject
from polysight.imaging.geometry import Antennas, Aperture, ImageGrid
from polysight.imaging.images import ImageBuilder, Images
from polysight.imaging.samples import BoardSamples
from polysight.results import BoardImaging, Pair
from polysight_shared.config import Instrument
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Positions are combined into blocks, for speed: at most this many along a cut through the image, and across it. Along:
# 24 blocks repeat the peak only about 24 resolution cells away. Compared with 96 blocks, the published rig's widths
# differ by 0.1 % and its highest sidelobe by 0.3 dB; at the end of the cut, at -43 dB, the level is up to 1.6 dB too
# high. Across: the change of the path along the cut is nearly the same at all these positions (the difference is of
# second order). With 8 blocks the widths of the published rig are within 3e-4 of those with 24.
_BLOCKS_ALONG = 24
_BLOCKS_ACROSS = 8
# Number of resolution cells that are evaluated to either side of the peak, and of points per cell (chosen).
_CELLS_EACH_SIDE = 6.0
_POINTS_PER_CELL = 20
# Step of the numerical derivative of the phase slope, for the mirror zone; chosen.
_STEP_M = 1e-4
# Search for the nearest ghosts: largest distance, precision, and number of places of the object; chosen.
_MAX_DISTANCE_M = 20.0
_PRECISION_M = 1e-6
_PLACES = 5
# Amplitude at half of the power.
_HALF_POWER = np.sqrt(0.5)


@dataclass(frozen=True)
class PointResponse:
    """Response to a point in the middle of the image, for (x, y).

    All figures of an axis are infinite if `limit_mm` would be wider than the image: nothing is resolved along it. The
    figures hold for a small part of the plane only, and would be meaningless.

    Attributes
    ----------
    width_mm
        Width of the image of a point between its half-power points, with the actual taper and missing positions; all
        frequencies have the same weight.
    limit_mm
        Limit of the geometry, 0.886 / spread of `(sin theta_tx + sin theta_rx) / lambda` along the aperture: the
        half-power width of an evenly filled band. For a plane at the distance h it is about 0.886 lambda h / (2 L
        cos^3(theta)) in x and 0.886 lambda h / (2 L cos(theta)) in y, with L the aperture's length along the axis and
        theta the incidence angle.
    paper_mm
        The paper's formula `r lambda / L` (section 6.1) with r the plane's distance.
    sidelobe_db
        Strongest sidelobe, relative to the peak.
    """

    width_mm: tuple[float, float]
    limit_mm: tuple[float, float]
    paper_mm: tuple[float, float]
    sidelobe_db: tuple[float, float]


def compute_point_response(aperture: Aperture, weights: NDArray[np.floating]) -> PointResponse:
    """Return the point response of an aperture with weights [row, column], 0 where a position is missing.

    Positions are combined into blocks at their mean positions (errors: see `_BLOCKS_ALONG`). The images of the RX are
    added up.
    """
    grid = aperture.grid
    point = np.array([grid.x_m.mean(), grid.y_m.mean(), float(np.mean(grid.z_m))])
    wavelength_m = SPEED_OF_LIGHT_M_S / aperture.frequencies_hz.mean()
    lengths_m = np.ptp(aperture.offsets_m[..., :2], axis=(0, 1))
    distance = point[2] - aperture.offsets_m[..., 2].mean()
    width_mm = [math.inf, math.inf]
    limit_mm = [math.inf, math.inf]
    paper_mm = [math.inf, math.inf]
    sidelobe_db = [math.inf, math.inf]
    for axis, pixels_m in enumerate((grid.x_m, grid.y_m)):
        cell_m = compute_limit_m(aperture, point, axis)
        if cell_m > len(pixels_m) * grid.pixel_m:
            continue
        cut, step_m = _compute_cut(aperture, weights, point, axis, cell_m)
        width_mm[axis] = 1e3 * _measure_width(cut) * step_m
        limit_mm[axis] = 1e3 * cell_m
        paper_mm[axis] = float(1e3 * distance * wavelength_m / lengths_m[axis])
        sidelobe_db[axis] = _measure_sidelobe_db(cut)
    return PointResponse(
        (width_mm[0], width_mm[1]),
        (limit_mm[0], limit_mm[1]),
        (paper_mm[0], paper_mm[1]),
        (sidelobe_db[0], sidelobe_db[1]),
    )


def _combine_positions(
    aperture: Aperture, weights: NDArray[np.floating], max_blocks: tuple[int, int]
) -> tuple[Aperture, NDArray[np.float64]]:
    """Return the aperture with neighbours combined into at most this many (rows, columns), and their weights."""
    row_starts, column_starts = (
        np.unique(np.linspace(0, count, blocks + 1).astype(int)[:-1])
        for count, blocks in zip(weights.shape, max_blocks, strict=True)
    )

    def sum_blocks(values: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.add.reduceat(np.add.reduceat(values.astype(float), row_starts, axis=0), column_starts, axis=1)

    count = sum_blocks(np.ones(weights.shape))
    offsets = np.stack([sum_blocks(aperture.offsets_m[..., i]) / count for i in range(3)], axis=-1)
    return replace(aperture, offsets_m=offsets), sum_blocks(weights)


def compute_limit_m(aperture: Aperture, point: NDArray[np.float64], axis: int) -> float:
    """Return the half-power width at `point` [3] along an axis, m, from the spread of wavenumbers in the aperture.

    It is computed for the middle row or column and the first RX; infinite if that line has one position.
    """
    middle = tuple(n // 2 for n in aperture.offsets_m.shape[:2])
    if axis == 0:
        line = aperture.offsets_m[middle[0]]
    else:
        line = aperture.offsets_m[:, middle[1]]
    slope = np.zeros(len(line))
    for antenna in (aperture.antennas.tx_m, aperture.antennas.rx_m[0]):
        difference = point - line - antenna
        slope += difference[:, axis] / np.linalg.norm(difference, axis=1)
    # Cycles per metre.
    wavenumber_range = np.ptp(slope) * aperture.frequencies_hz.mean() / SPEED_OF_LIGHT_M_S
    # With a uniform aperture, the image of a point has the half-power width 0.886 / range.
    if wavenumber_range > 0:
        return float(0.886 / wavenumber_range)
    return float("inf")


def _compute_cut(
    aperture: Aperture, weights: NDArray[np.floating], point: NDArray[np.float64], axis: int, cell_m: float
) -> tuple[NDArray[np.float64], float]:
    """Return the amplitude of a point's image [n] along an axis through the point [3], and the step in metres.

    The amplitude is 1 at the point, which is in the middle. `cell_m` is the resolution cell.
    """
    # Largest numbers of blocks (rows, columns).
    max_blocks = (_BLOCKS_ACROSS, _BLOCKS_ALONG) if axis == 0 else (_BLOCKS_ALONG, _BLOCKS_ACROSS)
    blocks, block_weights = _combine_positions(aperture, weights, max_blocks)
    point_grid = ImageGrid(point[:1], point[1:2], float(point[2]), aperture.grid.pixel_m)
    # The echo of the point alone, [rx, frequency, row, column].
    point_samples = DirectImager(replace(blocks, grid=point_grid)).samples(np.ones((1, 1))) * block_weights
    count = int(_CELLS_EACH_SIDE * _POINTS_PER_CELL)
    step = cell_m / _POINTS_PER_CELL
    voxels = np.tile(point, (2 * count + 1, 1))
    voxels[:, axis] += np.arange(-count, count + 1) * step
    shift = blocks.offsets_m.reshape(-1, 3)
    a = aperture.antennas
    total = np.zeros(len(voxels), complex)
    for rx, samples in enumerate(point_samples):
        samples_by_position = samples.reshape(len(samples), -1).T
        tx_m = a.tx_m + shift
        rx_m = a.rx_m[rx] + shift
        direct_m = np.full(len(shift), a.direct_m[rx])
        total += backproject(samples_by_position, aperture.frequencies_hz, tx_m, rx_m, voxels, direct_m)
    cut = np.abs(total)
    return cut / (cut[count] or 1.0), step


def _measure_width(cut: NDArray[np.float64]) -> float:
    """Return the half-power width of a cut in points; infinite if a side does not fall to half of the power."""
    middle = cut.size // 2
    sides = []
    for side in (cut[middle:], cut[middle::-1]):
        indices_below = np.flatnonzero(side < _HALF_POWER)
        if not indices_below.size:
            return float("inf")
        i = indices_below[0]
        sides.append(i - 1 + (side[i - 1] - _HALF_POWER) / (side[i - 1] - side[i]))
    return float(sum(sides))


def _measure_sidelobe_db(cut: NDArray[np.float64]) -> float:
    """Return the strongest value after the first minimum on either side of the peak, dB.

    A side without a minimum counts with its last value.
    """
    middle = cut.size // 2
    levels = []
    for side in (cut[middle:], cut[middle::-1]):
        rising = np.flatnonzero(np.diff(side) > 0)
        levels.append(side[rising[0] :].max() if rising.size else side[-1])
    return float(20 * np.log10(max(max(levels), 1e-9)))


def describe_imaging(builder: ImageBuilder, images: Images) -> dict[str, BoardImaging | list[str]]:
    """Return the entry `imaging` of quality.json: the figures by board, and `notices` if there are any."""
    facts: dict[str, BoardImaging | list[str]] = {name: describe_board(board) for name, board in builder.boards.items()}
    if images.notices:
        facts["notices"] = list(images.notices)
    return facts


def describe_board(board: BoardSamples) -> BoardImaging:
    """Return the figures of one board.

    `masked` is the share of the tapered aperture without data. `loss_db` is the loss that it causes in the sum of a
    point's echoes, `-20 log10(1 - masked)`. The amplitudes of images do not change, because images are divided by the
    weight of valid positions.
    """
    weights = board.weights
    masked = 1 - float(weights.sum() / board.taper.sum())
    facts = BoardImaging(
        positions=int(board.valid.size),
        masked_positions=int(board.valid.size - board.usable.sum()),
        rows_without_data=int((~board.usable.any(axis=1)).sum()),
        masked=round(masked, 6),
        frequencies=board.aperture.frequencies_hz.size,
    )
    if masked >= 1:
        return facts
    response = compute_point_response(board.aperture, weights)
    return msgspec.structs.replace(
        facts,
        # Adding zero turns -0.0 into 0.0.
        loss_db=round(-20 * float(np.log10(1 - masked)), 4) + 0.0,
        point_width_mm=_round_pair(response.width_mm),
        point_limit_mm=_round_pair(response.limit_mm),
        point_paper_mm=_round_pair(response.paper_mm),
        point_sidelobe_db=_round_pair(response.sidelobe_db),
    )


def _round_pair(pair: tuple[float, float]) -> Pair:
    """Return (x, y) with three decimals, None for values that are not finite."""
    x, y = (round(value, 3) if np.isfinite(value) else None for value in pair)
    return x, y


# Limits of the field of view: the alias-free field for a step size, and the mirror zone around flat plates. The phase
# slope of an echo is the change of its phase per metre of stage offset, k (sin a_tx + sin a_rx), with a the angles from
# the normal of the plane. TX and RX move together, so that it depends only on the object's place relative to the stage.
# Samples d apart cannot distinguish slopes that differ by 2 pi / d: an object has a ghost at each place whose slope
# differs by a multiple of that. The limit is the distance to the nearest ghost, seen from the middle half of the
# aperture, because the taper suppresses the rest.


@dataclass(frozen=True)
class FieldLimits:
    """Limits for (x, y) of the rig file's grid of positions.

    Attributes
    ----------
    alias_free_mm
        Distance from an object to its nearest ghost at the highest frequency; infinite if none is within 20 m.
    mirror_zone_mm
        Radius of the first Fresnel zone: the margin of aperture that a flat plate needs on every side.
    """

    alias_free_mm: tuple[float, float]
    mirror_zone_mm: tuple[float, float]


class PhaseSlope:
    """Phase slope of an echo against stage offset along an axis (0: x, 1: y) for the H receiver, rad/m."""

    def __init__(self, rig: Instrument, axis: int) -> None:
        self._antennas = Antennas.from_rig(rig, rig.receivers[0])
        self._middle = np.array(specular_midpoint_m(rig, rig.receivers[0]))
        self._axis = axis

    def slope(self, place_m: float, frequency_hz: float) -> float:
        """Return the slope for an object at this signed distance from the specular midpoint along the axis."""
        point = self._middle.copy()
        point[self._axis] += place_m
        total = 0.0
        for antenna in (self._antennas.tx_m, self._antennas.rx_m[0]):
            offset = point - antenna
            total += float(offset[self._axis] / np.linalg.norm(offset))
        return 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * total


def compute_field_limits(rig: Instrument) -> FieldLimits:
    """Compute the limits for a rig's grid."""
    chirp = rig.chirp
    grid = rig.grid
    low, high = (chirp.first_sample_hz + n * chirp.hz_per_sample for n in chirp.linear_samples)
    ghost_free = []
    zone = []
    for axis, (count, step_mm) in enumerate(((grid.columns, grid.step_x_mm), (grid.rows, grid.step_y_mm))):
        slope = PhaseSlope(rig, axis)
        change = (slope.slope(_STEP_M, (low + high) / 2) - slope.slope(-_STEP_M, (low + high) / 2)) / (2 * _STEP_M)
        # At the edge of the zone, at the distance r, the phase change r^2 / 2 is pi.
        zone.append(1e3 * float(np.sqrt(2 * np.pi / change)))
        size_m = (count - 1) * step_mm / 1e3
        places = np.linspace(-size_m / 4, size_m / 4, _PLACES)
        ghost_free.append(1e3 * min(_find_nearest_ghost_m(slope, high, 2e3 * np.pi / step_mm, p) for p in places))
    return FieldLimits((ghost_free[0], ghost_free[1]), (zone[0], zone[1]))


def _find_nearest_ghost_m(
    slope: PhaseSlope, frequency_hz: float, difference_rad_per_m: float, centre_m: float
) -> float:
    """Return the distance between two places around `centre_m` whose slopes differ by `difference_rad_per_m`.

    Infinite if it is beyond `_MAX_DISTANCE_M`.
    """

    def reaches_ghost(distance_m: float) -> bool:
        upper = slope.slope(centre_m + distance_m / 2, frequency_hz)
        lower = slope.slope(centre_m - distance_m / 2, frequency_hz)
        return upper - lower >= difference_rad_per_m

    if not reaches_ghost(_MAX_DISTANCE_M):
        return float("inf")
    free_m = 0.0
    ghost_m = _MAX_DISTANCE_M
    # Bisection: importing scipy.optimize takes longer than the whole forecast of `polysight plan`.
    while ghost_m - free_m > _PRECISION_M:
        middle = (free_m + ghost_m) / 2
        if reaches_ghost(middle):
            ghost_m = middle
        else:
            free_m = middle
    return ghost_m
