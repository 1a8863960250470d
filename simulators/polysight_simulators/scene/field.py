"""Object field: the object's echo at every stage position, computed fast and cached.

TX and RX move together in a plane, so that the echo at the stage offset u is a convolution of the reflecting amplitude
A of the scene with a kernel g of the lag w = v - u:

    field(u) = integral A(v) g(v - u) dv,     g(w) = obliquity exp(j k path(w)) / (r1 r2)

It is computed as a product of spectra:

* plates and points enter by their analytic Fourier transforms, so edges are exact at any position;
* the kernel is sampled finely enough for its phase gradient (per axis) and fades out beyond the scene;
* r(theta) of each plate is a short Chebyshev series in the local angle, with one kernel per order;
* only a few frequencies, the Chebyshev *nodes* of the IF band, are computed, without the phase of a centre path; the
  other frequencies are interpolated;
* the result is oversampled, and evaluated at any stage position with a windowed sinc.

Plates and points of similar height share a kernel, computed at that height (a :class:`_Level`). The remaining height z
of a point, from tilt, roughness and height of its plate, adds C z to the path, with C = dpath/dz of about 2 cos(theta).
C varies over the kernel, so that exp(j k C z) is not a product of a factor of the kernel and a factor of the plate. Its
interpolation between a few values C_m is a sum of such products:

    exp(j k C z) = sum over m of l_m(C) exp(j k C_m z).

l_m(C) belongs to the kernel and exp(j k C_m z) to the plate: a tilt shifts the spectrum of its rectangle, the height of
a facet changes its phase. Neglected are the change of C over z (except for its mean over the plate's height), the
changes of spreading and angle, and the rotation of the plate's normal in the obliquity.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import scipy
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.tables import to_builtins
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import optics
from polysight_simulators.scene.scene_file import Facets, Scene, draw_specimens, facets, slopes
from polysight_simulators.scene.shapes import shape_field
from polysight_simulators.scene.spectral_grid import OVERSAMPLING, TAPS, Axis, oversample, spectral_axes

# Largest errors relative to an echo, of the Chebyshev series in the local angle and of the interpolation in dpath/dz.
# Chosen: smaller ones take more kernels, that is more transforms.
_ANGLE_TOLERANCE = 1e-4
_RELIEF_TOLERANCE = 2e-4
# Range of heights that share a kernel. Chosen: a wider one takes fewer levels, each with more nodes of dpath/dz.
_LEVEL_MM = 2.0


def cheb_nodes(q: int) -> optics.Real:
    """Return the zeros [q] of the Chebyshev polynomial of order q, descending."""
    return np.cos(np.pi * (np.arange(q) + 0.5) / q)


def _fit_angle_series(
    scene: Scene, reflect: optics.Reflectivity, nodes_hz: optics.Real, theta: tuple[float, float]
) -> NDArray[np.complexfloating]:
    """Return the Chebyshev coefficients of r(theta) for each plate and node, [plate, node, order].

    `theta`: range of the local angle, rad. There are as many orders as the tolerance needs, the same for all plates.
    """
    centre = (theta[0] + theta[1]) / 2
    half = max((theta[1] - theta[0]) / 2, 1e-9)
    # More orders than r(theta) needs anywhere.
    node_count = 16
    x = cheb_nodes(node_count)
    # From values at the nodes to coefficients, [order, node].
    values_to_series = chebyshev.chebvander(x, node_count - 1).T * (2.0 / node_count)
    values_to_series[0] /= 2.0
    rows = [[reflect(p, f, centre + half * x) for f in nodes_hz] for p in scene.plates]
    values = np.array(rows, dtype=np.complex128)
    series = np.einsum("pfm,jm->pfj", values.reshape(len(scene.plates), len(nodes_hz), node_count), values_to_series)
    # Sum of the largest coefficients from each order on: a bound of the error without these orders.
    tail = np.cumsum(np.abs(series).max(axis=(0, 1), initial=0.0)[::-1])[::-1]
    orders = max(1, int(np.sum(tail > _ANGLE_TOLERANCE)))
    return series[:, :, :orders]


def _transform_intervals(
    axis: Axis, centres: optics.Real, sizes: optics.Real, shifts: optics.Real | float = 0.0
) -> optics.Complex:
    """Return the Fourier transforms of intervals (or points, size 0) along an axis, [item, kappa], on the grid.

    `shifts` [item] are linear phases over each interval, rad/m, zero at its centre.
    """
    k = axis.kappa
    width = np.where(sizes > 0, sizes, 1.0)[:, None]
    # The output of the inverse transform begins at `first_u`, and the kernel at `w[0]`.
    shift = axis.w[0] + axis.first_u - centres
    envelope = width * np.sinc((np.outer(sizes, k) - (sizes * shifts)[:, None]) / (2 * np.pi))
    return envelope.astype(np.complex128) * np.exp(1j * np.outer(shift, k))


# OpenBLAS computes products of matrices of at most this size (rows x terms x columns) in one thread: threads are slow
# while other processes run.
_PRODUCT_SIZE = 1 << 18


def _sum_outer_products(
    y: NDArray[np.complexfloating], weight: NDArray[np.complexfloating], x: NDArray[np.complexfloating]
) -> NDArray[np.complex64]:
    """Return the weighted sum of outer products over items, [kappa_y, kappa_x], of y and x [item, kappa]."""
    scaled = np.ascontiguousarray((y * weight[:, None]).T, np.complex64)
    columns = x.astype(np.complex64)
    summed = np.empty((y.shape[1], x.shape[1]), np.complex64)
    height = max(1, _PRODUCT_SIZE // max(1, x.size))
    for first in range(0, len(summed), height):
        rows = slice(first, first + height)
        np.matmul(scaled[rows], columns, out=summed[rows])
    return summed


@dataclass(frozen=True)
class _Level:
    """Plates and points of similar height, which share a kernel.

    Attributes
    ----------
    plates, points
        Indices of the level's plates, and of its points.
    lift_m, point_lift_m
        Heights of these plates and points relative to the level.
    legs
        r1, r2, incidence and obliquity over the kernel at the level's height, for each RX.
    bend
        d2path/dz2 at the image centre, 1/m.
    steepness
        Interpolation nodes C_m of dpath/dz.
    middle, half
        Middle and half width of the range of dpath/dz over the kernel.
    """

    plates: list[int]
    points: list[int]
    lift_m: optics.Real
    point_lift_m: optics.Real
    legs: list[tuple[optics.Real, optics.Real, optics.Real, optics.Real]]
    bend: float
    steepness: optics.Real
    middle: float
    half: float

    def shares(self, oblique: optics.Real) -> list[optics.Real] | None:
        """Return l_m of dpath/dz over the kernel for each m; None for a single node."""
        n = len(self.steepness)
        if n == 1:
            return None
        values_at_nodes = chebyshev.chebvander(cheb_nodes(n), n - 1) * (2.0 / n)
        values_at_nodes[:, 0] /= 2.0
        # On a level surface dpath/dz is the sum of both cosines, twice the obliquity.
        everywhere = chebyshev.chebvander((2 * oblique - self.middle) / self.half, n - 1)
        return [everywhere @ row for row in values_at_nodes]

    def lift_phase(self, lift_m: optics.Real, wave: float, m: int) -> optics.Complex | float:
        """Return exp(j k (C_m z + bend z^2 / 2)) for heights z relative to the level; `wave` is k."""
        if not lift_m.any():
            return 1.0
        return np.exp(1j * wave * (self.steepness[m] * lift_m + 0.5 * self.bend * lift_m**2))


@dataclass(frozen=True)
class _Plane:
    """Plates and points that are computed on one grid: all of a scene, only its background, or all but its background.

    Attributes
    ----------
    ant
        Antennas of the board.
    scene
        The scene with these plates, points and shapes only.
    x, y
        Grid of offsets, kernel and spectrum along each axis.
    surfaces
        Facets of each plate.
    amplitudes
        Factor of each point in the samples, without 1 / (r1 r2).
    """

    ant: optics.Antennas
    scene: Scene
    x: Axis
    y: Axis
    surfaces: tuple[Facets, ...]
    amplitudes: optics.Complex

    def levels(self, rx: Sequence[int], top_hz: float) -> list[_Level]:
        """Group plates and points by height; returns at least one level, also for an empty scene.

        `rx`: channels; `top_hz`: the highest frequency.
        """
        plates = self.scene.plates
        points = self.scene.points
        heights = np.array([p.height_mm for p in (*plates, *points)])
        groups: list[list[float]] = []
        for height in np.unique(heights if len(heights) else 0.0):
            if groups and height - groups[-1][0] <= _LEVEL_MM:
                groups[-1].append(float(height))
            else:
                groups.append([float(height)])
        all_levels = []
        for group in groups:
            inside = [i for i, height in enumerate(heights) if group[0] <= height <= group[-1]]
            # Heights are those of plates first, then those of points.
            members = [i for i in inside if i < len(plates)], [i - len(plates) for i in inside if i >= len(plates)]
            all_levels.append(self._level((group[0] + group[-1]) / 2, members, rx, top_hz))
        return all_levels

    def _level(
        self, height_mm: float, members: tuple[list[int], list[int]], rx: Sequence[int], top_hz: float
    ) -> _Level:
        """Return the level at this height.

        `members` are indices of plates and of points, `rx` of channels; `top_hz`, the highest frequency,
        decides how many interpolation nodes the tallest relief on the level needs.
        """
        z = self.ant.plane_z_m + height_mm / 1e3
        centre = self.ant.centre_m
        wx, wy = np.meshgrid(self.x.w, self.y.w)
        legs = [self.ant.legs(wx, wy, r, z) for r in rx]
        # Heights of plates and of points relative to the level.
        lifts = [
            np.array([(table[i].height_mm - height_mm) / 1e3 for i in chosen])
            for table, chosen in zip((self.scene.plates, self.scene.points), members, strict=True)
        ]
        # Largest height of anything on the level, with the ends of tilted plates and the bumps of rough ones.
        relief = float(np.abs(lifts[1]).max(initial=0.0))
        for i, lift in zip(members[0], lifts[0], strict=True):
            plate = self.scene.plates[i]
            tilted = sum(abs(t) * side / 2e3 for t, side in zip(slopes(plate), plate.size_mm, strict=True))
            relief = max(relief, abs(lift) + tilted + float(np.abs(self.surfaces[i].height_m).max()))
        low, high = _range(legs)
        half = (high - low) / 2
        reach = 2 * np.pi * top_hz / SPEED_OF_LIGHT_M_S * relief * half
        n = 1
        # Remainder of Chebyshev interpolation of exp(j reach x), -1 <= x <= 1.
        while reach**n / (2.0 ** (n - 1) * math.factorial(n)) > _RELIEF_TOLERANCE:
            n += 1
        r1, r2, _, _ = self.ant.legs(centre[0], centre[1], 0, z)
        heights_m = z - self.ant.tx_m[2], z - self.ant.rx_m[0, 2]
        bend = float(sum((r**2 - h**2) / r**3 for r, h in zip((r1, r2), heights_m, strict=True)))
        nodes = (low + high) / 2 + half * cheb_nodes(n)
        return _Level(
            plates=members[0],
            points=members[1],
            lift_m=lifts[0],
            point_lift_m=lifts[1],
            legs=legs,
            bend=bend,
            steepness=nodes,
            middle=(low + high) / 2,
            half=half,
        )

    def plate_maps(
        self, level: _Level, series: optics.Complex, f: float, m: int
    ) -> list[tuple[NDArray[np.complex64], optics.Complex]]:
        """Return pairs of a spectrum [kappa_y, kappa_x] and the series [order] of its kernel in the local angle.

        The plates' echo is the sum of spectrum times kernel over pairs; heights have the phases of C_m. There is a pair
        for each order, or for each plate if there are fewer plates than orders, so that there are few kernels.
        """
        if not level.plates:
            return []
        wave = 2 * np.pi * f / SPEED_OF_LIGHT_M_S
        ant = self.ant
        plates = [self.scene.plates[i] for i in level.plates]
        table = np.array([(*p.centre_mm, *p.size_mm) for p in plates]) / 1e3
        # Growth of a tilted plate's phase along x and y, rad/m, [plate, 2].
        turn = wave * level.steepness[m] * np.array([slopes(p) for p in plates])
        weights = series[level.plates] * optics.plate_scale(ant, self.scene, f)
        weights = weights * np.reshape(level.lift_phase(level.lift_m, wave, m), (-1, 1))
        # Spectra along y and x of each row of facets.
        strips = [
            self._transform_plate(self.surfaces[i], table[n, :2], turn[n], wave * level.steepness[m])
            for n, i in enumerate(level.plates)
        ]
        y = np.concatenate([plate_points for plate_points, _ in strips])
        x = np.concatenate([plate_points for _, plate_points in strips])
        strips_of_plate = [len(plate_points) for plate_points, _ in strips]
        orders = weights.shape[1]
        # A plate's echo is a sum over orders. Either each plate has a kernel, which is the sum over its orders, or each
        # order has a kernel for all plates, whose spectra are summed with their weights.
        if len(plates) < orders:
            shares = np.eye(len(plates), dtype=np.complex128)
            kernel_series = weights
        else:
            shares = weights.T
            kernel_series = np.eye(orders, dtype=np.complex128)
        maps = [_sum_outer_products(y, np.repeat(share, strips_of_plate), x) for share in shares]
        return list(zip(maps, kernel_series, strict=True))

    def _transform_plate(
        self, parts: Facets, centre_m: optics.Real, turn: optics.Real, per_metre: float
    ) -> tuple[optics.Complex, NDArray[np.complex64]]:
        """Return the spectra of the rows of facets of a plate along y and x, [row, kappa_y] and [row, kappa_x].

        The plate's spectrum is the sum of their outer products over the rows. `turn` [2] is the growth of its phase
        along x and y by its tilt, rad/m, and `per_metre` that with height.
        """
        x = _transform_intervals(
            self.x, self.ant.centre_m[0] + centre_m[0] + parts.x_m, np.full(parts.x_m.shape, parts.size_m[0]), turn[0]
        )
        y = _transform_intervals(
            self.y, self.ant.centre_m[1] + centre_m[1] + parts.y_m, np.full(parts.y_m.shape, parts.size_m[1]), turn[1]
        )
        phase = per_metre * parts.height_m + turn[0] * parts.x_m + turn[1] * parts.y_m[:, None]
        return y, np.einsum("rc,cx->rx", np.exp(1j * phase).astype(np.complex64), x.astype(np.complex64))

    def point_map(self, level: _Level, f: float, m: int) -> NDArray[np.complex64] | None:
        """Return the spectrum of a level's points, with the phases of C_m; None if it has none."""
        if not level.points:
            return None
        table = np.array([self.scene.points[i].position_mm for i in level.points]) / 1e3
        none = np.zeros(len(table))
        x = _transform_intervals(self.x, self.ant.centre_m[0] + table[:, 0], none)
        y = _transform_intervals(self.y, self.ant.centre_m[1] + table[:, 1], none)
        lifted = level.lift_phase(level.point_lift_m, 2 * np.pi * f / SPEED_OF_LIGHT_M_S, m)
        return _sum_outer_products(y, self.amplitudes[level.points] * lifted, x)


def _range(legs: list[tuple[optics.Real, optics.Real, optics.Real, optics.Real]]) -> tuple[float, float]:
    """Return the smallest and largest dpath/dz over the kernel: twice the obliquity, the fourth of `legs`."""
    return 2 * min(float(leg[3].min()) for leg in legs), 2 * max(float(leg[3].max()) for leg in legs)


def compute(
    rig: Instrument, scene: Scene, board: Board, samples_hz: optics.Real, rx: Sequence[int]
) -> tuple[NDArray[np.complex64], tuple[float, float], tuple[float, float], optics.Real, float]:
    """Return the fields of :class:`ObjectField` in order, for a scene after `draw_specimens` and these channels."""
    top_hz = float(samples_hz[-1])
    planes = _group_planes(rig, scene, board, top_hz)
    levels = [(plane, level) for plane in planes for level in plane.levels(rx, top_hz)]
    nodes_hz, centre = _choose_nodes(scene, levels, samples_hz)
    # Range of the local angle, the third of `legs`, over all levels and channels.
    legs = [leg for _, level in levels for leg in level.legs]
    low = min(leg[2].min() for leg in legs)
    high = max(leg[2].max() for leg in legs)
    reflect = optics.board_reflectivity(board, scene)
    series = [_fit_angle_series(plane.scene, reflect, nodes_hz, (low, high)) for plane in planes]
    ax = planes[0].x
    ay = planes[0].y
    field_by_channel = np.zeros((len(rx), len(nodes_hz), ay.outputs, ax.outputs), dtype=np.complex64)
    for plane, plate_series in zip(planes, series, strict=True):
        levels_of_plane = [level for level_plane, level in levels if level_plane is plane]
        kernels = [
            _Kernels.prepare(plane, level, (low, high), plate_series.shape[2], centre) for level in levels_of_plane
        ]
        for q, f in enumerate(nodes_hz):
            total = np.zeros((len(rx), plane.y.points, plane.x.points), dtype=np.complex64)
            for level_kernels in kernels:
                level_kernels.add_spectra(total, plane, plate_series[:, q], f)
            for r, spectrum in enumerate(total):
                field_by_channel[r, q] += oversample(oversample(spectrum, plane.y, 0), plane.x, 1)
    values = np.ascontiguousarray(field_by_channel.transpose(2, 3, 0, 1))
    steps = ax.step / OVERSAMPLING, ay.step / OVERSAMPLING
    if scene.shapes:
        ant = planes[0].ant
        offsets = (ax.first_u + steps[0] * np.arange(ax.outputs), ay.first_u + steps[1] * np.arange(ay.outputs))
        shape_echo = shape_field(
            rig=rig, scene=scene, board=board, axes_m=offsets, nodes_hz=nodes_hz, centre_m=ant.centre_m, path_m=centre
        )
        # Shapes have the gain of plates: an infinite mirror gives object_gain d / path.
        values += np.complex64(scene.object_gain * ant.direct_m[0]) * shape_echo[:, :, list(rx)]
    return values, (ax.first_u, ay.first_u), steps, nodes_hz, centre


def _group_planes(rig: Instrument, scene: Scene, board: Board, top_hz: float) -> list[_Plane]:
    """Return the scene's parts: a wide background has a grid of its own, so that kernels of small plates are small.

    All parts have the same step and the same range of offsets, so that their fields add up.
    """
    ant = optics.antennas(rig, board)
    surfaces = tuple(facets(p, i, scene.seed) for i, p in enumerate(scene.plates))
    amplitudes = optics.conjugate(np.array([complex(*p.amplitude) for p in scene.points])) * optics.point_scale(ant)
    amplitudes = amplitudes * optics.direct_factor(board, scene)
    is_background = [p.background for p in scene.plates]
    if any(is_background) and not all(is_background):
        parts = [False, True]
    else:
        parts = [any(is_background)]
    planes = []
    for background in parts:
        members = [i for i, plate_is_background in enumerate(is_background) if plate_is_background == background]
        is_first = background == parts[0]
        part = msgspec.structs.replace(
            scene,
            plates=tuple(scene.plates[i] for i in members),
            points=scene.points if is_first else (),
            shapes=scene.shapes if is_first else (),
        )
        x, y = spectral_axes(rig, part, ant, top_hz)
        point_amplitudes = amplitudes if is_first else amplitudes[:0]
        planes.append(_Plane(ant, part, x, y, tuple(surfaces[i] for i in members), point_amplitudes))
    step_x = min(plane.x.step for plane in planes)
    step_y = min(plane.y.step for plane in planes)
    return [replace(p, x=replace(p.x, step=step_x), y=replace(p.y, step=step_y)) for p in planes]


def _choose_nodes(
    scene: Scene, levels: list[tuple[_Plane, _Level]], samples_hz: optics.Real
) -> tuple[optics.Real, float]:
    """Return the nodes in the samples' band (the samples if they are fewer), and the path whose phase is removed."""
    ranges = []
    for plane, level in levels:
        inside_scene = (plane.y.fade == 1)[:, None] & (plane.x.fade == 1)
        for r1, r2, _, _ in level.legs:
            path = (r1 + r2)[inside_scene]
            ranges.append((path.min(), path.max()))
    shortest_m = float(min(low for low, _ in ranges))
    longest_m = float(max(high for _, high in ranges))
    margin_m = 0.0
    # Echoes inside plates extend the response: two round trips are counted.
    for plate in scene.plates:
        depth = sum((layer.thickness_mm or 0.0) / 1e3 * abs(np.sqrt(layer.epsilon)) for layer in plate.stack)
        margin_m = max(margin_m, 4 * depth)
    # Shapes extend beyond their fronts' heights; some 0.15 m on either side hold their specular points.
    depth_m = max((abs(plate.height_mm) / 1e3 + 0.15 for plate in scene.shapes), default=0.0)
    # Both ends are extended equally, by `margin_m` and by twice `depth_m`: the range is symmetric about `centre`.
    spread = longest_m - shortest_m + 2 * margin_m + 4 * depth_m
    centre = (longest_m + shortest_m) / 2
    # Time-bandwidth product plus a few: interpolation error of the Chebyshev series below 1e-6.
    nodes = int(np.ceil((samples_hz[-1] - samples_hz[0]) * spread / SPEED_OF_LIGHT_M_S)) + 8
    if len(samples_hz) <= nodes:
        return samples_hz, centre
    return samples_hz[0] + (samples_hz[-1] - samples_hz[0]) * (cheb_nodes(nodes) + 1) / 2, centre


@dataclass(frozen=True)
class _Kernels:
    """Properties of the kernels of a level that are equal at all frequencies.

    Attributes
    ----------
    level
        Plates and points of similar height.
    paths_m
        float64 [rx, y, x]: paths over the kernel, less the one whose phase is removed.
    spreading
        float32 [rx, m][y, x]: 1 / (r1 r2) of spherical waves, faded at the borders, times each share l_m of dpath/dz.
    angle
        float32 [rx, order, y, x]: obliquity times the Chebyshev polynomials of the local angle.
    """

    level: _Level
    paths_m: list[optics.Real]
    spreading: list[list[NDArray[np.float32]]]
    angle: NDArray[np.float32]

    @classmethod
    def prepare(
        cls, plane: _Plane, level: _Level, theta: tuple[float, float], orders: int, centre_m: float
    ) -> _Kernels:
        """Return the kernels' properties of a level.

        `theta`: range of angles of the whole scene (rad), over which there are `orders` Chebyshev polynomials.
        `centre_m`: path whose phase is removed.
        """
        fade = np.outer(plane.y.fade, plane.x.fade)
        low, high = theta
        paths_m = []
        spreading = []
        angle = []
        for r1, r2, incidence, oblique in level.legs:
            faded = fade / (r1 * r2)
            shares = level.shares(oblique)
            paths_m.append(r1 + r2 - centre_m)
            spreading.append([(faded * share).astype(np.float32) for share in shares or [1.0]])
            # The polynomials take the range of angles as -1 to 1.
            scaled_angle = (incidence - (low + high) / 2) / max((high - low) / 2, 1e-9)
            polynomials = chebyshev.chebvander(scaled_angle, orders - 1)
            angle.append(np.moveaxis(oblique[..., None] * polynomials, -1, 0).astype(np.float32))
        return cls(level, paths_m, spreading, np.stack(angle))

    def add_spectra(self, total: NDArray[np.complex64], plane: _Plane, series: optics.Complex, f: float) -> None:
        """Add the level's spectra at one frequency to `total` [rx, kappa_y, kappa_x]; series [plate, order]."""
        waves = [_compute_phasors(f / SPEED_OF_LIGHT_M_S * path_m) for path_m in self.paths_m]
        for m in range(len(self.level.steepness)):
            maps = plane.plate_maps(self.level, series, f, m)
            point_map = plane.point_map(self.level, f, m)
            for r, wave in enumerate(waves):
                base = wave * self.spreading[r][m]
                for plate_map, orders in maps:
                    total[r] += plate_map * _transform_back(base * _add_orders(orders, self.angle[r]))
                if point_map is not None:
                    total[r] += point_map * _transform_back(base)


def _add_orders(
    series: optics.Complex, polynomials: NDArray[np.float32]
) -> NDArray[np.complex64] | NDArray[np.float32]:
    """Return the sum of series [order] times polynomials [order, y, x]; einsum starts no BLAS threads."""
    (used_orders,) = np.nonzero(series)
    if len(used_orders) == 1 and series[used_orders[0]] == 1:
        return polynomials[used_orders[0]]
    summed = np.empty(polynomials.shape[1:], np.complex64)
    summed.real = np.einsum("j,jyx->yx", series.real.astype(np.float32), polynomials)
    summed.imag = np.einsum("j,jyx->yx", series.imag.astype(np.float32), polynomials)
    return summed


def _compute_phasors(cycles: optics.Real) -> NDArray[np.complex64]:
    """Return exp(2 pi j cycles); whole cycles are removed first, so that single precision has errors of 4e-7 rad."""
    phase = (2 * np.pi * (cycles - np.rint(cycles))).astype(np.float32)
    phasors = np.empty(phase.shape, np.complex64)
    np.cos(phase, out=phasors.real)
    np.sin(phase, out=phasors.imag)
    return phasors


def _transform_back(kernel: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Return the inverse DFT of a kernel, which is overwritten, without its 1 / n."""
    return np.asarray(scipy.fft.ifft2(kernel, norm="forward", overwrite_x=True))


# Version of the content of cached fields: it changes with the physics above, so that older files are not read.
_CACHE_VERSION = 3

# Shape of the Kaiser window of the interpolation; chosen for `TAPS` and `OVERSAMPLING`.
_KAISER_BETA = 8.0


@dataclass(frozen=True)
class ObjectField:
    """Object field of a board on a regular grid of stage offsets.

    Attributes
    ----------
    values
        complex64 [ny, nx, rx, node], without the phase of `centre_path_m`.
    start_m, step_m
        First offset and pitch in (x, y), metres.
    nodes_hz
        Frequencies of the nodes.
    centre_path_m
        Path whose phase was removed.
    """

    values: NDArray[np.complex64]
    start_m: tuple[float, float]
    step_m: tuple[float, float]
    nodes_hz: optics.Real
    centre_path_m: float

    def interpolate(self, x_m: optics.Real, y_m: optics.Real) -> NDArray[np.complex64]:
        """Return the field at stage offsets, complex64 [n, rx, node], without the phase of the centre path.

        Raises
        ------
        DataError
            if an offset lies outside the field's aperture.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        ix, wx = self._compute_taps(x_m, 0)
        out = np.empty((len(x_m), *self.values.shape[2:]), dtype=np.complex64)
        for y in np.unique(y_m):
            iy, wy = self._compute_taps(np.array([y]), 1)
            on = np.flatnonzero(y_m == y)
            low = ix[on].min()
            high = ix[on].max() + 1
            line = np.einsum("t,tx...->x...", wy[0], self.values[iy[0], low:high])
            out[on] = np.einsum("nt,nt...->n...", wx[on], line[ix[on] - low])
        return out

    def covers(self, x_m: optics.Real, y_m: optics.Real) -> NDArray[np.bool_]:
        """Return True for offsets inside the field's aperture, bool [n]."""
        is_covered = np.ones(len(x_m), dtype=np.bool_)
        for axis, u in enumerate((x_m, y_m)):
            low, high = self._reach(axis)
            is_covered &= (u >= low) & (u <= high)
        return is_covered

    def _reach(self, axis: int) -> tuple[float, float]:
        """Return the first and last offset with all taps inside the grid, metres; 0 = x, 1 = y."""
        first = self.start_m[axis]
        step = self.step_m[axis]
        half = TAPS // 2
        n = self.values.shape[1 - axis]
        return first + (half - 1) * step, first + (n - half - 1) * step

    def _compute_taps(self, u: optics.Real, axis: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return grid indices [n, taps] and weights of the Kaiser-windowed sinc at offsets u.

        Raises DataError for an offset outside the simulated aperture.
        """
        low, high = self._reach(axis)
        if u.min() < low or u.max() > high:
            raise DataError(
                f"stage offset {1e3 * u[np.argmax(np.abs(u))]:.2f} mm in {'xy'[axis]} is outside the simulated aperture"
                f" {1e3 * low:.2f}..{1e3 * high:.2f} mm",
                "the scan has another grid than the simulated rig",
                "start the simulated rig with the same instrument.toml and scene as the scan",
                code=ErrorCode.MISMATCH,
            )
        position = (u - self.start_m[axis]) / self.step_m[axis]
        index = np.floor(position).astype(np.intp)[:, None] + np.arange(1 - TAPS // 2, 1 + TAPS // 2)
        distance = position[:, None] - index
        inner = np.sqrt(np.maximum(0.0, 1 - (2 * distance / TAPS) ** 2))
        window = scipy.special.i0(_KAISER_BETA * inner) / scipy.special.i0(_KAISER_BETA)
        return index, (np.sinc(distance) * window).astype(np.float32)


def node_matrix(field: ObjectField, frequencies_hz: optics.Real) -> tuple[optics.Real, optics.Real]:
    """Return the interpolation from nodes to frequencies, and its derivative per Hz: two float64 [node, k].

    It uses the discrete orthogonality of the Chebyshev polynomials on their nodes.
    """
    q = len(field.nodes_hz)
    low = frequencies_hz[0]
    high = frequencies_hz[-1]
    scale = 2.0 / (high - low)
    x = (frequencies_hz - low) * scale - 1.0
    values_at_nodes = chebyshev.chebvander(cheb_nodes(q), q - 1) * (2.0 / q)
    values_at_nodes[:, 0] /= 2.0
    derivative = chebyshev.chebder(np.eye(q), axis=0)
    values = chebyshev.chebvander(x, q - 1)
    slopes = chebyshev.chebvander(x, max(q - 2, 0)) @ derivative
    return values_at_nodes @ values.T, values_at_nodes @ slopes.T * scale


def build_field(
    rig: Instrument,
    scene: Scene,
    board: Board,
    samples_hz: optics.Real,
    cache_dir: Path | None = None,
    rx: Sequence[int] | None = None,
) -> ObjectField:
    """Compute the object field of a board over the aperture of the rig's grid, or read it from the cache.

    Parameters
    ----------
    rig, scene, board
        Rig with the scene applied, the scene, and one of the rig's receiving boards.
    samples_hz
        Transmit frequency of the ADC samples, ascending. If there are fewer than the nodes needed for interpolation,
        the field is computed at the samples.
    cache_dir
        Folder that caches fields between runs, keyed by everything they depend on; None: no cache.
    rx
        Channels to compute; None for all.

    Raises
    ------
    DataError
        if a cached file cannot be read.
    """
    scene = draw_specimens(scene)
    if rx is None:
        rx = range(len(rig.antennas.rx_mm))
    if cache_dir is None:
        return ObjectField(*compute(rig, scene, board, samples_hz, rx))
    d = scene.disturbances
    key = to_builtins(
        [rig, scene.plates, scene.points, scene.shapes, scene.object_gain, d.leakage_h, d.leakage_v, d.backlash_mm]
    )
    drawn_seed = scene.seed if any(p.rough_mm for p in scene.plates) else None
    text = json.dumps([_CACHE_VERSION, key, board.name, list(samples_hz), list(rx), drawn_seed], sort_keys=True)
    path = cache_dir / f"field-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as f:
                start = f["start_m"]
                step = f["step_m"]
                return ObjectField(
                    f["values"], (start[0], start[1]), (step[0], step[1]), f["nodes_hz"], float(f["centre_path_m"])
                )
        except (OSError, ValueError, KeyError) as e:
            raise DataError(
                f"{path}: not a field: {e}", "an interrupted write", "delete the file", code=ErrorCode.FILE_DAMAGED
            ) from None
    field = ObjectField(*compute(rig, scene, board, samples_hz, rx))
    cache_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{board.name}.tmp.npz")
    np.savez(partial, allow_pickle=False, **vars(field))
    partial.replace(path)
    return field
