"""From the samples of H and V to specular points with both voltages, and their grouping into segments.

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
# Points and normals of neighbouring windows that belong to one surface differ by no more.
MAX_GAP_M = 0.02
MAX_PATH_MISS_M = 0.002
MAX_TURN_RAD = 0.35
# Windows of one surface whose path curvature is averaged.
NEIGHBOURHOOD_M = 0.024
# Points so close on a surface have the same curvature; they are counted in cells.
SAME_CURVATURE_M = 0.012
CELL_M = 0.004
MIN_POINTS = 8
MIN_NEIGHBOURS = 6
# Distance at which a window's own curvature counts as a slope: a third of a window.
LEVER_OF_WINDOW_M = 0.011
# A smaller radius is an edge or a wire: what it diffracts is no reflection.
MIN_RADIUS_M = 0.012
# Range of z in which objects are searched, and the largest slope of an echo's path over the stage offset.
NEAREST_M = 0.2
FARTHEST_M = 1.4
MAX_SLOPE = 0.6
# Offsets of the stage closer than this are of one window.
SAME_WINDOW_M = 1e-4
# An echo below so many standard deviations of its noise has no usable slope.
MIN_AMPLITUDE_STDS = 5


@dataclass(frozen=True)
class Seen:
    """Echoes of H and V of the same points [n], and the number of the segment of each (-1: none)."""

    h: Echoes
    v: Echoes
    segment: NDArray[np.int_]

    def __getitem__(self, keep: NDArray) -> Seen:
        return Seen(self.h[keep], self.v[keep], self.segment[keep])

    def __len__(self) -> int:
        return len(self.h)


@dataclass(frozen=True)
class Shape:
    """Points [n, 3] (metres, rig frame), normals towards the antennas, cosines of incidence, curvature [n, 2, 2]."""

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


def see_points(h: Samples, v: Samples, optics: Optics, gate_m: tuple[float, float]) -> Seen:
    """Find the specular points of a scan in H, and measure the same points in V."""
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
    window = np.unique(np.round(echoes.at_m / SAME_WINDOW_M), axis=0, return_inverse=True)[1].reshape(-1)
    seen_by_v, inside = measure_echoes(v, at_m, path, slope, bend, window=window, is_measured=keep)
    return Seen(echoes[inside], seen_by_v, segment[inside])


def _is_sound(echoes: Echoes, shape: Shape) -> NDArray[np.bool_]:
    """True for echoes that a surface can give: within range, not too steep, well above the noise."""
    z_m = shape.points[:, 2]
    in_range = np.isfinite(shape.points).all(axis=1) & (z_m > NEAREST_M) & (z_m < FARTHEST_M)
    in_view = np.abs(echoes.slope).max(axis=1) < MAX_SLOPE
    above_noise = np.abs(echoes.amplitude) > MIN_AMPLITUDE_STDS * echoes.amplitude_std
    return in_range & in_view & above_noise


def _is_wide(shape: Shape) -> NDArray[np.bool_]:
    """True for points whose radii of curvature are larger than those of edges and wires."""
    bends = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    return np.isfinite(bends).all(axis=1) & (np.abs(bends).max(axis=1) < 1 / MIN_RADIUS_M)


def group_echoes(echoes: Echoes, optics: Optics) -> NDArray[np.int_]:
    """Number of the connected surface of each echo, from the largest on; -1 for small groups.

    Neighbouring windows belong together if the path of one follows from that of the other by its slope.
    """
    count = len(echoes)
    if not count:
        return np.zeros(0, int)
    shape = find_shape(echoes, optics)
    pairs = scipy.spatial.KDTree(echoes.at_m[:, :2]).query_pairs(2.3 * STRIDE_M, output_type="ndarray")
    first, second = pairs.T
    d = (echoes.at_m[second] - echoes.at_m[first])[:, :2]
    rise = np.einsum("np,np->n", echoes.slope[first] + echoes.slope[second], d) / 2
    miss = np.abs(echoes.path_m[second] - echoes.path_m[first] - rise)
    gap = np.linalg.norm(shape.points[second] - shape.points[first], axis=1)
    turn = np.linalg.norm(shape.normals[second] - shape.normals[first], axis=1)
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
    """Replace the curvature of each echo's path by a fit to its neighbours in the same surface.

    The fit takes the slopes of all windows near by, g + Q d at the distance d, for the unknown g and Q. What it leaves
    of the slopes is an error of each that its own window does not show: ripple of edges and of other echoes. Its
    variance is averaged over the neighbours, for one fit leaves few independent residuals.
    """
    bend = echoes.bend.copy()
    slope_std = echoes.slope_std.copy()
    for number in np.unique(segment[segment >= 0]):
        members = np.flatnonzero(segment == number)
        at_m = echoes.at_m[members, :2]
        neighbours = scipy.spatial.KDTree(at_m).query_ball_point(at_m, NEIGHBOURHOOD_M)
        ripple = np.zeros((len(members), 2))
        is_fitted = np.array([len(near) >= MIN_NEIGHBOURS for near in neighbours])
        for place in np.flatnonzero(is_fitted):
            bend[members[place]], ripple[place] = fit_bend(echoes, int(members[place]), members[neighbours[place]])
        for place in np.flatnonzero(is_fitted):
            near = [other for other in neighbours[place] if is_fitted[other]]
            slope_std[members[place]] = np.hypot(
                slope_std[members[place]], np.sqrt(np.maximum(0, ripple[near].mean(axis=0)))
            )
    return replace(echoes, bend=bend, slope_std=slope_std)


def fit_bend(echoes: Echoes, index: int, others: NDArray[np.int_]) -> tuple[Array, Array]:
    """Symmetric curvature [2, 2] from the slopes of neighbours, and the variance [2] of their ripple.

    Ripple is what is neither a smooth change nor noise of the windows. Where there is none, its variance scatters about
    zero.
    """
    d = (echoes.at_m[others] - echoes.at_m[index])[:, :2]
    zero = np.zeros(len(d))
    ones = np.ones(len(d))
    # Unknown: g_x, g_y, Q_xx, Q_xy, Q_yy.
    along_x = np.stack([ones, zero, d[:, 0], d[:, 1], zero], axis=1)
    along_y = np.stack([zero, ones, zero, d[:, 0], d[:, 1]], axis=1)
    matrix = np.stack([along_x, along_y])
    slopes = echoes.slope[others].T
    # The windows' own curvatures count as slopes at this distance.
    weight_m2 = LEVER_OF_WINDOW_M**2 * len(d)
    bend = echoes.bend[others].mean(axis=0)
    own = np.array([0.0, 0.0, bend[0, 0], bend[0, 1], bend[1, 1]])
    weights = np.diag([0.0, 0.0, weight_m2, weight_m2, weight_m2])
    inverse = np.linalg.inv(along_x.T @ along_x + along_y.T @ along_y + weights)
    fitted = inverse @ (along_x.T @ slopes[0] + along_y.T @ slopes[1] + weights @ own)
    left = np.mean((slopes - matrix @ fitted) ** 2, axis=1)
    noise, ripple = correlate_windows(d)
    noise_left = find_share_left(noise, matrix, inverse) * np.mean(echoes.slope_std[others] ** 2, axis=0)
    variance = (left - noise_left) / find_share_left(ripple, matrix, inverse)
    return np.array([[fitted[2], fitted[3]], [fitted[3], fitted[4]]]), variance


def correlate_windows(d: Array) -> tuple[Array, Array]:
    """Correlations [2, n, n] of the errors of both slopes of windows at the offsets `d` [n, 2], by noise and by ripple.

    Windows share data as far as they overlap. Noise counts by its distance from the middle in the direction of the
    slope, hence 1 - 3 s + 2 s^3 at the share s of a window there, and 1 - s across it. Ripple is as long as a window or
    longer: normals of simulated plates had correlations of 0.77, 0.49 and 0.13 at 8, 16 and 24 mm, about 1 - s.
    """
    apart = np.minimum(1, np.abs(d[:, None] - d[None]) / WINDOW_M)
    across = np.moveaxis(1 - apart, -1, 0)
    along = np.moveaxis(1 - 3 * apart + 2 * apart**3, -1, 0)
    ripple = across[0] * across[1]
    return along * across[::-1], np.stack([ripple, ripple])


def find_share_left(correlation: Array, matrix: Array, inverse: NDArray) -> Array:
    """Share [2] of the variance of errors of both slopes that a fit leaves as residuals.

    trace((1 - S) C (1 - S)') / n, with S = `matrix` `inverse` `matrix`' the smoother and C the correlation [2, n, n].
    `matrix` [2, n, 5]: both slopes in terms of the unknown; `inverse` [5, 5]: of the normal matrix.
    """
    transposed = np.swapaxes(matrix, 1, 2)
    common = transposed @ correlation @ matrix
    taken = 2 * np.trace(inverse @ common, axis1=1, axis2=2)
    fitted = np.trace(inverse @ common.sum(axis=0) @ inverse @ transposed @ matrix, axis1=1, axis2=2)
    return 1 + (fitted - taken) / matrix.shape[1]


def share_curvatures(echoes: Echoes, segment: NDArray[np.int_], optics: Optics) -> Echoes:
    """Replace the curvature of each echo's path by that of the mean motion of the points close by on the surface.

    A small body shows nearly the same place to all windows, which moves by millimetres: each window alone tells little
    of its curvature, all together much. On a plane only the next windows see the same place. Echoes count by power.
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
        near = scipy.spatial.KDTree(cells * CELL_M).query_ball_point(cells * CELL_M, SAME_CURVATURE_M)
        means = np.array([sums[group].sum(axis=0) / weights[group].sum() for group in near])
        motion[members] = means[cell]
    return replace(echoes, bend=find_bend(*geometry, motion))
