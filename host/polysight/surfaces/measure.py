"""From the samples of H and V to specular points with both voltages, and their grouping into segments.

The *path* of an echo is its length from TX over the surface to RX, and `at_m` [n, 3] the stage offset at which it is
measured, the middle of a window of positions. The *bend* of an echo is the curvature of its path over the stage
offset; *curvature* alone is that of the surface where a `Shape` holds it.

H gives place, normal and curvature. V sees the same point with the same normal from another stage position, some 15 mm
away: its path is predicted, and the phase is taken against this prediction, for separate ranges of H and V are useless
(0.3 mm is half a radian).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.surfaces.optics import Optics
from polysight.surfaces.paths import STRIDE_M, find_echoes, measure_echoes
from polysight.surfaces.points import (
    find_bend,
    find_curvature,
    find_motion,
    find_normals,
    find_offset_that_sees,
    locate,
    predict_echo,
)
from polysight.surfaces.window import WINDOW_M, Echoes, Samples

Array = NDArray[np.float64]
# Points, paths and normals of neighbouring windows that belong to one surface differ by no more than these, beyond the
# distance of the windows and the noise of the paths. Chosen; 2 mm are half a wavelength.
MAX_GAP_M = 0.02
MAX_PATH_MISS_M = 0.002
MAX_TURN_RAD = 0.35
# Windows of one surface whose path curvature is averaged; chosen.
NEIGHBOURHOOD_M = 0.024
# Points so close on a surface have the same curvature; they are counted in cells; chosen.
SAME_CURVATURE_M = 0.012
CELL_M = 0.004
# A group of fewer points is not a surface: a chance of noise and edges.
MIN_POINTS = 8
# Least number of windows to fit a curvature to: each gives two slopes and three curvatures for the five unknowns.
MIN_NEIGHBOURS = 6
# Windows of one surface from which the ripple of slopes is estimated. Near the border of a zone that reflects, its edge
# ripples by waves of about 100 mm, which a fit within 24 mm takes for curvature.
RIPPLE_REACH_M = 0.054
# Least number of these windows: nine unknowns are fitted.
MIN_AROUND = 16
# Distance at which a window's own curvature counts as a slope (see SlopeFit): a third of a window, about the rms
# distance of its positions from its middle.
LEVER_OF_WINDOW_M = 0.011
# A smaller radius (chosen, three wavelengths) is an edge or a wire: what it diffracts is not a reflection.
MIN_RADIUS_M = 0.012
# Range of z in which objects are searched, and the largest slope of an echo's path over the stage offset; chosen. Fits
# that start within the search's 0.47 may end somewhat beyond it.
NEAREST_M = 0.2
FARTHEST_M = 1.4
MAX_SLOPE = 0.6
# Offsets of the stage closer than this are of one window.
SAME_WINDOW_M = 1e-4
# Least amplitude of an echo with a usable slope, in standard deviations of its noise.
MIN_AMPLITUDE_STDS = 5


@dataclass(frozen=True)
class SeenEchoes:
    """Echoes of H and V of the same points [n], and the number of the segment of each (-1: none)."""

    h: Echoes
    v: Echoes
    segment: NDArray[np.int_]

    def __getitem__(self, keep: NDArray) -> SeenEchoes:
        return SeenEchoes(self.h[keep], self.v[keep], self.segment[keep])

    def __len__(self) -> int:
        return len(self.h)


@dataclass(frozen=True)
class Shape:
    """Points [n, 3] (metres, rig frame), normals [n, 3] towards the antennas, cosines of incidence [n], curvature.

    The curvature [n, 2, 2], 1 / m, is in the basis of `points.tangents`, positive for convex bodies.
    """

    points: Array
    normals: Array
    cos: Array
    curvature: Array

    def __getitem__(self, keep: NDArray) -> Shape:
        return Shape(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


def find_shape(echoes: Echoes, optics: Optics) -> Shape:
    """Return places, normals and curvatures of H's echoes."""
    tx_m = optics.tx.at_m
    rx_m = optics.h.at_m
    points = locate(echoes.path_m, echoes.slope, echoes.at_m, tx_m, rx_m)
    normals, cos = find_normals(points, echoes.at_m, tx_m, rx_m)
    curvature = find_curvature(points, normals, echoes.at_m, tx_m, rx_m, echoes.bend)
    return Shape(points, normals, cos, curvature)


def see_points(h: Samples, v: Samples, optics: Optics, gate_m: tuple[float, float]) -> SeenEchoes:
    """Find the specular points of a scan in H, and measure the same points in V.

    `h` and `v` are the boards' samples, `gate_m` the smallest and the largest path that is searched, metres. The points
    returned are those of echoes in a group, wider than edges and wires, which V's scan covers too.
    """
    echoes = find_echoes(h, gate_m)
    echoes = echoes[_is_sound(echoes, find_shape(echoes, optics))]
    segment = group_echoes(echoes, optics)
    echoes = smooth_bends(echoes, segment)
    echoes = share_curvatures(echoes, segment, optics)
    shape = find_shape(echoes, optics)
    keep = (segment >= 0) & _is_wide(shape)
    tx_m = optics.tx.at_m
    rx_m = optics.v.at_m
    at_m = find_offset_that_sees(shape.points, shape.normals, echoes.at_m, tx_m, rx_m)
    path, slope, bend = predict_echo(shape.points, shape.normals, shape.curvature, at_m, tx_m, rx_m)
    # V distinguishes the echoes of one window of H by their paths: number the windows.
    window = np.unique(np.round(echoes.at_m / SAME_WINDOW_M), axis=0, return_inverse=True)[1].reshape(-1)
    # V's echoes are those of the points `is_inside` V's scan only.
    seen_by_v, is_inside = measure_echoes(v, at_m, path, slope, bend, window=window, is_measured=keep)
    return SeenEchoes(echoes[is_inside], seen_by_v, segment[is_inside])


def _is_sound(echoes: Echoes, shape: Shape) -> NDArray[np.bool_]:
    """True for echoes that a surface can give: within range, not too steep, well above the noise."""
    z_m = shape.points[:, 2]
    is_in_range = np.isfinite(shape.points).all(axis=1) & (z_m > NEAREST_M) & (z_m < FARTHEST_M)
    is_in_view = np.abs(echoes.slope).max(axis=1) < MAX_SLOPE
    is_above_noise = np.abs(echoes.amplitude) > MIN_AMPLITUDE_STDS * echoes.amplitude_std
    return is_in_range & is_in_view & is_above_noise


def _is_wide(shape: Shape) -> NDArray[np.bool_]:
    """True for points whose radii of curvature are larger than those of edges and wires."""
    curvatures = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    return np.isfinite(curvatures).all(axis=1) & (np.abs(curvatures).max(axis=1) < 1 / MIN_RADIUS_M)


def group_echoes(echoes: Echoes, optics: Optics) -> NDArray[np.int_]:
    """Return the number of the connected surface of each echo [n], largest surface first; -1 for small groups.

    Neighbouring windows belong together if the path of one follows from that of the other by its slope.
    """
    count = len(echoes)
    if not count:
        return np.zeros(0, int)
    shape = find_shape(echoes, optics)
    # Up to 2.3 strides: windows two apart along one axis and one along the other, so that one gap does not part them.
    pairs = scipy.spatial.KDTree(echoes.at_m[:, :2]).query_pairs(2.3 * STRIDE_M, output_type="ndarray")
    first, second = pairs.T
    d = (echoes.at_m[second] - echoes.at_m[first])[:, :2]
    rise = np.einsum("np,np->n", echoes.slope[first] + echoes.slope[second], d) / 2
    miss = np.abs(echoes.path_m[second] - echoes.path_m[first] - rise)
    gap = np.linalg.norm(shape.points[second] - shape.points[first], axis=1)
    turn = np.linalg.norm(shape.normals[second] - shape.normals[first], axis=1)
    # Beyond the limits, paths may differ by four standard deviations, and points by twice the distance of the windows.
    tolerance = MAX_PATH_MISS_M + 4 * np.hypot(echoes.path_std_m[first], echoes.path_std_m[second])
    joined = (miss < tolerance) & (gap < MAX_GAP_M + 2 * np.linalg.norm(d, axis=1)) & (turn < MAX_TURN_RAD)
    ones = np.ones(int(joined.sum()))
    graph = scipy.sparse.coo_matrix((ones, (first[joined], second[joined])), shape=(count, count))
    _, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(labels)
    order = np.argsort(-sizes, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(order.size)
    number[sizes < MIN_POINTS] = -1
    return number[labels]


def smooth_bends(echoes: Echoes, segment: NDArray[np.int_]) -> Echoes:
    """Replace the curvature of each echo's path by a fit to its neighbours in the same surface; enlarge `slope_std`.

    Echoes with too few neighbours are not changed.
    What a fit leaves of the slopes is an error of each that its own window does not show: ripple of edges and of other
    echoes, whose variance is added to that of the slope. Ripple is as long as the neighbourhood to which the curvature
    is fitted, and a fit follows it there. So where there are enough windows it is judged over a larger one, by a fit in
    which the curvature may change. The variance is averaged over the neighbours, for one fit leaves few independent
    residuals.
    """
    bend = echoes.bend.copy()
    slope_std = echoes.slope_std.copy()
    fits: dict[bytes, SlopeFit] = {}
    for number in np.unique(segment[segment >= 0]):
        members = np.flatnonzero(segment == number)
        at_m = echoes.at_m[members, :2]
        tree = scipy.spatial.KDTree(at_m)
        neighbours = tree.query_ball_point(at_m, NEIGHBOURHOOD_M)
        neighbours_around = tree.query_ball_point(at_m, RIPPLE_REACH_M)
        ripple_variance = np.zeros((len(members), 2))
        is_fitted = np.array([len(near_points) >= MIN_NEIGHBOURS for near_points in neighbours])
        for point in np.flatnonzero(is_fitted):
            near_points = neighbours[point]
            fit = _find_fit(fits, at_m[near_points] - at_m[point], may_change=False)
            bend[members[point]], ripple_variance[point] = fit.apply(echoes, members[near_points])
            if len(neighbours_around[point]) >= MIN_AROUND:
                near_points = neighbours_around[point]
                fit = _find_fit(fits, at_m[near_points] - at_m[point], may_change=True)
                _, ripple_variance[point] = fit.apply(echoes, members[near_points])
        for point in np.flatnonzero(is_fitted):
            near_points = [neighbour for neighbour in neighbours[point] if is_fitted[neighbour]]
            slope_std[members[point]] = np.hypot(
                slope_std[members[point]], np.sqrt(np.maximum(0, ripple_variance[near_points].mean(axis=0)))
            )
    return replace(echoes, bend=bend, slope_std=slope_std)


class SlopeFit:
    """Least squares of slope g and curvature Q of a path from those of windows at the offsets `d` [n, 2], metres.

    Slopes are g + Q d at the distance d. If curvature `may_change`, its four derivatives are fitted too. The windows'
    own curvatures count as slopes at the distance LEVER_OF_WINDOW_M.

    `answer` [unknown, equation, n] turns slopes and curvatures of the windows into the unknown; `noise_left` and
    `ripple_left` [2] are the shares of either error's variance that residuals of both slopes show.
    """

    def __init__(self, d: Array, *, may_change: bool) -> None:
        x, y = d.T
        zero = np.zeros(len(d))
        one = np.ones(len(d))
        # Unknown: g_x, g_y, Q_xx, Q_xy, Q_yy; dQ_xx/dx, dQ_xx/dy = dQ_xy/dx, dQ_xy/dy = dQ_yy/dx, dQ_yy/dy.
        slope_x = [one, zero, x, y, zero, x * x / 2, x * y, y * y / 2, zero]
        slope_y = [zero, one, zero, x, y, zero, x * x / 2, x * y, y * y / 2]
        bend_xx = [zero, zero, one, zero, zero, x, y, zero, zero]
        bend_xy = [zero, zero, zero, one, zero, zero, x, y, zero]
        bend_yy = [zero, zero, zero, zero, one, zero, zero, x, y]
        # [equation, window, unknown]
        rows = np.moveaxis(np.array([slope_x, slope_y, bend_xx, bend_xy, bend_yy]), 1, 2)
        if not may_change:
            rows = rows[..., :5]
        rows[2:] *= LEVER_OF_WINDOW_M
        self.matrix = rows[:2]
        # The windows of a single line do not determine all derivatives.
        inverse = np.linalg.pinv(np.einsum("rnp,rnq->pq", rows, rows), hermitian=True)
        self.answer = np.einsum("pq,rnq->prn", inverse, rows)
        noise, ripple = correlate_windows(d)
        self.noise_left = find_share_left(noise, self.matrix, inverse)
        self.ripple_left = find_share_left(ripple, self.matrix, inverse)

    def apply(self, echoes: Echoes, others: NDArray[np.int_]) -> tuple[Array, Array]:
        """Return the symmetric curvature [2, 2], and the variance [2] of the slopes' ripple.

        `others` [n] are the indices of the windows in `echoes`.
        Ripple is what is neither a smooth change nor noise of the windows. Where there is none, its variance scatters
        about zero.
        """
        slopes = echoes.slope[others].T
        bends = echoes.bend[others]
        levers = LEVER_OF_WINDOW_M * np.stack([bends[:, 0, 0], bends[:, 0, 1], bends[:, 1, 1]])
        fitted = np.einsum("prn,rn->p", self.answer, np.concatenate([slopes, levers]))
        residual_variance = np.mean((slopes - self.matrix @ fitted) ** 2, axis=1)
        noise_variance = self.noise_left * np.mean(echoes.slope_std[others] ** 2, axis=0)
        variance = (residual_variance - noise_variance) / self.ripple_left
        return np.array([[fitted[2], fitted[3]], [fitted[3], fitted[4]]]), variance


def _find_fit(fits: dict[bytes, SlopeFit], d: Array, *, may_change: bool) -> SlopeFit:
    """Return the fit of a pattern of windows; most windows of a scan have the same neighbours."""
    pattern = np.round(d / SAME_WINDOW_M).astype(np.int16).tobytes() + bytes([may_change])
    if pattern not in fits:
        fits[pattern] = SlopeFit(d, may_change=may_change)
    return fits[pattern]


def correlate_windows(d: Array) -> tuple[Array, Array]:
    """Correlations [2, n, n] of the errors of both slopes of windows at the offsets `d` [n, 2], by noise and by ripple.

    Windows share data as far as they overlap; s is their distance over the width of a window. A sample's noise acts on
    the slope in proportion to its distance from the window's middle along the slope's axis, for any place across:
    hence the correlation is 1 - 3 s + 2 s^3 along that axis and 1 - s across it. Ripple is as long as a window or
    longer: normals of simulated plates had correlations of 0.77, 0.49 and 0.13 at 8, 16 and 24 mm, about 1 - s.
    """
    distance = np.minimum(1, np.abs(d[:, None] - d[None]) / WINDOW_M)
    across = np.moveaxis(1 - distance, -1, 0)
    along = np.moveaxis(1 - 3 * distance + 2 * distance**3, -1, 0)
    ripple = across[0] * across[1]
    # The slope in x has x along and y across, that in y the reverse.
    return along * across[::-1], np.stack([ripple, ripple])


def find_share_left(correlation: Array, matrix: Array, inverse: NDArray) -> Array:
    """Return the share [2] of the variance of errors of both slopes that a fit leaves as residuals.

    trace((1 - S) C (1 - S)') / n, with S = `matrix` `inverse` `matrix`' the smoother and C the correlation [2, n, n].
    `matrix` [2, n, p]: both slopes in terms of the unknown; `inverse` [p, p]: of the normal matrix.
    Errors of the windows' own curvatures are left out.
    """
    transposed = np.swapaxes(matrix, 1, 2)
    common = transposed @ correlation @ matrix
    share_taken = 2 * np.trace(inverse @ common, axis1=1, axis2=2)
    fitted = np.trace(inverse @ common.sum(axis=0) @ inverse @ transposed @ matrix, axis1=1, axis2=2)
    return 1 + (fitted - share_taken) / matrix.shape[1]


def share_curvatures(echoes: Echoes, segment: NDArray[np.int_], optics: Optics) -> Echoes:
    """Replace the curvature of each echo's path by that of the mean motion of the points close by on the surface.

    The motion is how far the point moves on the surface while the stage moves (`find_motion`); the path's curvature is
    linear in it. A small body shows nearly the same place to all windows, which moves by millimetres: each window alone
    says little about its curvature, all together much. On a plane only the next windows see the same place. Echoes
    count by power.
    """
    shape = find_shape(echoes, optics)
    geometry = (shape.points, shape.normals, echoes.at_m, optics.tx.at_m, optics.h.at_m)
    motion = find_motion(*geometry, echoes.bend)
    weight = np.abs(echoes.amplitude) ** 2
    for number in np.unique(segment[segment >= 0]):
        members = np.flatnonzero(segment == number)
        places = np.round(shape.points[members] / CELL_M).astype(int)
        cells, cell = np.unique(places, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        weights = np.bincount(cell, weight[members])
        sums = np.zeros((len(cells), 2, 2))
        np.add.at(sums, cell, weight[members, None, None] * motion[members])
        near_cells = scipy.spatial.KDTree(cells * CELL_M).query_ball_point(cells * CELL_M, SAME_CURVATURE_M)
        means = np.array([sums[group].sum(axis=0) / weights[group].sum() for group in near_cells])
        motion[members] = means[cell]
    return replace(echoes, bend=find_bend(*geometry, motion))
