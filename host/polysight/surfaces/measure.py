"""From the samples of H and V to specular points with both voltages, and their grouping into segments.

A *segment* is a connected surface: a group of points whose neighbours' paths continue each other. The *path* of an echo
is its length from TX over the surface to RX, and `at_m` [n, 3] the stage offset at which it is measured, the middle of
a *window* of stage positions. The *slope* and the *bend* of a path are its first and second derivatives by the stage
offset; *curvature* is that of the surface. The *ripple* of slopes is their error by edges and by other echoes.

H gives place, normal and curvature of a point. V sees the same point with the same normal from another stage offset,
some 15 mm away. V's path is predicted from the point, and its phase is measured against this prediction. Separate
ranges of H and V would not do: an error of 0.3 mm is half a radian of phase.
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
    find_specular_points,
    predict_echo,
)
from polysight.surfaces.window import WINDOW_M, Echoes, Samples

Array = NDArray[np.float64]
# Points, paths and normals of neighbouring windows that belong to one surface differ by no more than these, in addition
# to what the distance of the windows and the noise of the paths explain. Chosen; 2 mm are half a wavelength.
MAX_GAP_M = 0.02
MAX_PATH_MISS_M = 0.002
MAX_TURN_RAD = 0.35
# Bends are fitted to the windows of a surface within this distance; chosen.
NEIGHBOURHOOD_M = 0.024
# Points within SAME_CURVATURE_M on a surface are taken to have the same curvature. They are summed in cells of CELL_M.
# Both are chosen.
SAME_CURVATURE_M = 0.012
CELL_M = 0.004
# A group of fewer points does not count as a surface: noise and edges can make it.
MIN_POINTS = 8
# Least number of windows to which a bend is fitted: each gives two slopes and three bends for the five unknowns.
MIN_NEIGHBOURS = 6
# The ripple of slopes is estimated from the windows of a surface within this distance. The edge of the zone that a
# surface reflects to makes ripples about 100 mm long, which a fit within 24 mm takes for bends.
RIPPLE_REACH_M = 0.054
# Least number of these windows: nine unknowns are fitted.
MIN_AROUND = 16
# The bends of a window count as slopes at this distance (see SlopeFit): a third of a window, about the root mean square
# distance of its positions from its middle.
LEVER_OF_WINDOW_M = 0.011
# A smaller radius (chosen, three wavelengths) is that of an edge or a wire, which diffracts and does not reflect.
MIN_RADIUS_M = 0.012
# Range of z in which objects are searched, and the largest slope of an echo's path; chosen. Fits start from slopes of
# up to 0.47 (`paths.MAX_SLOPE`), and may end somewhat above it.
NEAREST_M = 0.2
FARTHEST_M = 1.4
MAX_SLOPE = 0.6
# Stage offsets closer than this are those of one window.
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

    The curvature [n, 2, 2], 1 / m, is in the basis of `points.compute_tangents`, positive for convex bodies.
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
    points = find_specular_points(echoes.path_m, echoes.slope, echoes.at_m, tx_m, rx_m)
    normals, cos = find_normals(points, echoes.at_m, tx_m, rx_m)
    curvature = find_curvature(points, normals, echoes.at_m, tx_m, rx_m, echoes.bend)
    return Shape(points, normals, cos, curvature)


def see_points(h: Samples, v: Samples, optics: Optics, gate_m: tuple[float, float]) -> SeenEchoes:
    """Find the specular points of a scan in H, and measure the same points in V.

    `h` and `v` are the boards' samples, `gate_m` the smallest and the largest path that is searched, metres. The points
    returned belong to a segment, are not on edges or wires, and lie inside V's scan, too.
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
    # The echoes of one window of H are measured together in V: number the windows.
    window = np.unique(np.round(echoes.at_m / SAME_WINDOW_M), axis=0, return_inverse=True)[1].reshape(-1)
    seen_by_v, is_measured = measure_echoes(v, at_m, path, slope, bend, window=window, is_measured=keep)
    return SeenEchoes(echoes[is_measured], seen_by_v, segment[is_measured])


def _is_sound(echoes: Echoes, shape: Shape) -> NDArray[np.bool_]:
    """Return True for echoes that a surface can give: within range, not too steep, well above the noise."""
    z_m = shape.points[:, 2]
    is_in_range = np.isfinite(shape.points).all(axis=1) & (z_m > NEAREST_M) & (z_m < FARTHEST_M)
    is_in_view = np.abs(echoes.slope).max(axis=1) < MAX_SLOPE
    is_above_noise = np.abs(echoes.amplitude) > MIN_AMPLITUDE_STDS * echoes.amplitude_std
    return is_in_range & is_in_view & is_above_noise


def _is_wide(shape: Shape) -> NDArray[np.bool_]:
    """Return True for points whose radii of curvature are larger than those of edges and wires."""
    curvatures = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    return np.isfinite(curvatures).all(axis=1) & (np.abs(curvatures).max(axis=1) < 1 / MIN_RADIUS_M)


def group_echoes(echoes: Echoes, optics: Optics) -> NDArray[np.int_]:
    """Return the number of each echo's segment [n], 0 for the largest one; -1 for groups of few echoes.

    Echoes of neighbouring windows belong to one segment if the path of one follows from that of the other by its slope,
    and their points and normals are close.
    """
    count = len(echoes)
    if not count:
        return np.zeros(0, int)
    shape = find_shape(echoes, optics)
    # Neighbours are up to 2.3 strides apart: two along one axis and one along the other. So a single missing window
    # does not split a surface.
    pairs = scipy.spatial.KDTree(echoes.at_m[:, :2]).query_pairs(2.3 * STRIDE_M, output_type="ndarray")
    first, second = pairs.T
    # The path rises by the mean slope times the distance d of the windows.
    d = (echoes.at_m[second] - echoes.at_m[first])[:, :2]
    rise = np.einsum("np,np->n", echoes.slope[first] + echoes.slope[second], d) / 2
    miss = np.abs(echoes.path_m[second] - echoes.path_m[first] - rise)
    gap = np.linalg.norm(shape.points[second] - shape.points[first], axis=1)
    turn = np.linalg.norm(shape.normals[second] - shape.normals[first], axis=1)
    # To the limits are added: four standard deviations for paths, and twice the distance of the windows for points.
    tolerance = MAX_PATH_MISS_M + 4 * np.hypot(echoes.path_std_m[first], echoes.path_std_m[second])
    joined = (miss < tolerance) & (gap < MAX_GAP_M + 2 * np.linalg.norm(d, axis=1)) & (turn < MAX_TURN_RAD)
    ones = np.ones(int(joined.sum()))
    graph = scipy.sparse.coo_matrix((ones, (first[joined], second[joined])), shape=(count, count))
    _, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(labels)
    labels_by_size = np.argsort(-sizes, kind="stable")
    number_of_label = np.empty_like(labels_by_size)
    number_of_label[labels_by_size] = np.arange(labels_by_size.size)
    number_of_label[sizes < MIN_POINTS] = -1
    return number_of_label[labels]


def smooth_bends(echoes: Echoes, segment: NDArray[np.int_]) -> Echoes:
    """Replace each echo's bend by a fit to its neighbours in the same segment; add the ripple to `slope_std`.

    Echoes with too few neighbours are not changed.
    Edges and other echoes change slopes in a way that the noise of a single window does not show. This ripple is
    estimated from the residuals of the fit, and its variance is added to that of the slope. Ripple is about as long as
    the neighbourhood of the fit, so that the fit follows it and leaves too little. Where there are enough windows, it
    is therefore estimated over a larger neighbourhood, by a fit in which the bend may change from place to place. A
    single fit leaves few independent residuals, so that the variance is averaged over the neighbours.
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
    """Least squares fit of slope g and bend Q at one place, to the slopes and bends of n windows around it.

    The windows are at the offsets `d` [n, 2] from the place, metres. Their slopes are g + Q d, and their bends are Q.
    If the bend `may_change`, its four derivatives by d are fitted, too. So that bends can be compared with slopes, they
    are multiplied by LEVER_OF_WINDOW_M.

    `answer` [unknown, equation, n]: the unknowns are the sum of `answer` times the five values (two slopes, three
    bends) of each window. `noise_left` and `ripple_left` [2]: the residuals of both slopes hold these shares of the
    variance of noise, and of that of ripple.
    """

    def __init__(self, d: Array, *, may_change: bool) -> None:
        x, y = d.T
        zero = np.zeros(len(d))
        ones = np.ones(len(d))
        # Unknowns: g_x, g_y, Q_xx, Q_xy, Q_yy; dQ_xx/dx, dQ_xx/dy = dQ_xy/dx, dQ_xy/dy = dQ_yy/dx, dQ_yy/dy.
        slope_x = [ones, zero, x, y, zero, x * x / 2, x * y, y * y / 2, zero]
        slope_y = [zero, ones, zero, x, y, zero, x * x / 2, x * y, y * y / 2]
        bend_xx = [zero, zero, ones, zero, zero, x, y, zero, zero]
        bend_xy = [zero, zero, zero, ones, zero, zero, x, y, zero]
        bend_yy = [zero, zero, zero, zero, ones, zero, zero, x, y]
        # [equation, window, unknown]
        rows = np.moveaxis(np.array([slope_x, slope_y, bend_xx, bend_xy, bend_yy]), 1, 2)
        if not may_change:
            rows = rows[..., :5]
        rows[2:] *= LEVER_OF_WINDOW_M
        self.matrix = rows[:2]
        # The pseudo-inverse, because windows on a single line do not determine all derivatives.
        inverse = np.linalg.pinv(np.einsum("rnp,rnq->pq", rows, rows), hermitian=True)
        self.answer = np.einsum("pq,rnq->prn", inverse, rows)
        noise, ripple = correlate_windows(d)
        self.noise_left = find_share_left(noise, self.matrix, inverse)
        self.ripple_left = find_share_left(ripple, self.matrix, inverse)

    def apply(self, echoes: Echoes, others: NDArray[np.int_]) -> tuple[Array, Array]:
        """Return the symmetric bend [2, 2], and the variance [2] of the slopes' ripple.

        `others` [n] are the indices of the windows in `echoes`. The variance is that of the residuals, without the part
        of the windows' noise, over `ripple_left`. It may be negative: where there is no ripple it scatters about zero.
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
    """Return the fit for windows at the offsets `d`, from `fits` if it is there.

    Most windows of a scan have neighbours at the same offsets.
    """
    pattern = np.round(d / SAME_WINDOW_M).astype(np.int16).tobytes() + bytes([may_change])
    if pattern not in fits:
        fits[pattern] = SlopeFit(d, may_change=may_change)
    return fits[pattern]


def correlate_windows(d: Array) -> tuple[Array, Array]:
    """Return the correlations of the errors of slopes, by noise [2, n, n] and by ripple [2, n, n].

    The windows are at the offsets `d` [n, 2]; axis 0 of the results is that of the slope, x or y. Overlapping windows
    share samples. With s the distance of two windows along an axis over the width of a window, up to 1:

        noise:   1 - 3 s + 2 s^3 along the slope's axis, times 1 - s along the other axis
        ripple:  1 - s along either axis, multiplied

    Noise: the noise of a sample counts by its distance from the window's middle along the slope's axis, and equally at
    all places along the other axis. Ripple: normals of simulated plates had correlations of 0.77, 0.49 and 0.13 at 8,
    16 and 24 mm, about 1 - s.
    """
    distance = np.minimum(1, np.abs(d[:, None] - d[None]) / WINDOW_M)
    across = np.moveaxis(1 - distance, -1, 0)
    along = np.moveaxis(1 - 3 * distance + 2 * distance**3, -1, 0)
    ripple = across[0] * across[1]
    # Axis 0 is x, y. The slope in x takes `along` of x and `across` of y; that in y the reverse.
    return along * across[::-1], np.stack([ripple, ripple])


def find_share_left(correlation: Array, matrix: Array, inverse: NDArray) -> Array:
    """Return the share of the variance of errors of both slopes that a fit leaves as residuals, [2].

        share = trace((1 - S) C (1 - S)') / n,   S = A N A'

    C [2, n, n] is the correlation of the errors. A = `matrix` [2, n, unknown] gives both slopes by the unknowns, and N
    = `inverse` [unknown, unknown] is the inverse of the normal matrix. Errors of the windows' bends are left out.
    """
    transposed = np.swapaxes(matrix, 1, 2)
    common = transposed @ correlation @ matrix
    share_taken = 2 * np.trace(inverse @ common, axis1=1, axis2=2)
    fitted = np.trace(inverse @ common.sum(axis=0) @ inverse @ transposed @ matrix, axis1=1, axis2=2)
    return 1 + (fitted - share_taken) / matrix.shape[1]


def share_curvatures(echoes: Echoes, segment: NDArray[np.int_], optics: Optics) -> Echoes:
    """Replace each echo's bend by that of the mean motion of the points near its own on the surface.

    The motion is how far the specular point moves over the surface with the stage (`find_motion`); the bend is linear
    in it. The specular point of a small body moves by millimetres only: each window alone determines its curvature
    badly, all windows together determine it well. On a plane only the next windows have points near by. In the mean,
    echoes are weighted by power.
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
