"""Points, normals and curvatures of a surface from the paths of its echoes, and the paths from these.

Symbols:

* u: stage offset. T and R: the antennas at u = 0. p: specular point. t and r: unit vectors from the antennas to p.
* L: path over p; g and Q: its first and second derivatives by u, the *slope* and the *bend*, along x and y.
* n: normal; theta: angle of incidence; E [3, 2]: tangents; K [2, 2]: curvature of the surface along the tangents,
  positive for convex bodies.
* H [3, 3]: second derivative of the path by p. xy marks the rows or columns x and y, ' a transpose.

The place and the normal follow from the path and its slope. A specular point's path is stationary over the surface, so
that its slope is that of a fixed p:

    |p - T - u| + |p - R - u| = L,   (t + r)_xy = -g
    n = -(t + r) / |t + r|,   cos(theta) = |t + r| / 2

The curvature follows from the bend:

    H = sum over k = t and k = r of  (I - k k') / distance,   X = -E' H_xy   (columns x and y)
    P = E' H E + 2 cos(theta) K     (second derivative of the path by the place on the surface)
    Q = H_xy - X' P^-1 X            (rows and columns x and y of H)
    K = (X (H_xy - Q)^-1 X' - E' H E) / (2 cos(theta))

P^-1 is the *motion*: how far p moves over the surface with the stage. It is 0 on an edge, and Q is linear in it. All
arrays are [n, ...], for n points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Newton's method doubles the number of correct digits at each step: a few steps reach full precision from half a metre
# away. The further ones are for starts from which the first steps are cut to LONGEST_STEP_M.
NEWTON_STEPS = 12
LONGEST_STEP_M = 0.15
# The iteration ends after a step below this: the next one would be about its square.
SHORTEST_STEP_M = 1e-9
# Newton's method starts this far in front of the antennas, and never comes closer than NEAREST_M (both chosen). Each
# point has a mirror image behind the antennas, with nearly the same path and slope.
START_RANGE_M = 0.5
NEAREST_M = 0.05
# Added to the diagonal of a matrix to keep it invertible. Its entries are about 1, so that this is far below the
# precision of a step.
REGULARISATION = 1e-12


def compute_unit_legs(points_m: Array, at_m: Array, tx_m: Array, rx_m: Array) -> tuple[Array, Array, Array, Array]:
    """Return unit vectors from TX and RX to points [n, 3] and the distances [n], with the stage at `at_m` [n, 3]."""
    out = points_m - at_m - tx_m
    back = points_m - at_m - rx_m
    out_m = np.linalg.norm(out, axis=-1)
    back_m = np.linalg.norm(back, axis=-1)
    return out / out_m[:, None], back / back_m[:, None], out_m, back_m


def compute_leg_bend(t: Array, r: Array, out_m: Array, back_m: Array) -> Array:
    """Return H [n, 3, 3], the second derivative of the path by the point, 1 / m."""
    eye = np.eye(3)
    out = (eye - t[:, :, None] * t[:, None, :]) / out_m[:, None, None]
    back = (eye - r[:, :, None] * r[:, None, :]) / back_m[:, None, None]
    return out + back


def find_specular_points(path_m: Array, slope: Array, at_m: Array, tx_m: Array, rx_m: Array) -> Array:
    """Return the specular points [n, 3] of echoes with a path [n] and its slope [n, 2], by Newton's method."""
    points = at_m + (tx_m + rx_m) / 2
    points = points + np.stack(
        [np.zeros_like(path_m), np.zeros_like(path_m), np.full_like(path_m, START_RANGE_M)], axis=-1
    )
    for _ in range(NEWTON_STEPS):
        t, r, out_m, back_m = compute_unit_legs(points, at_m, tx_m, rx_m)
        bisector = t + r
        # Both equations of the point: L, then g_x and g_y. [n, 3], and their derivatives by the point, [n, 3, 3].
        miss = np.concatenate([(out_m + back_m - path_m)[:, None], bisector[:, :2] + slope], axis=1)
        bend = compute_leg_bend(t, r, out_m, back_m)
        matrix = np.concatenate([bisector[:, None], bend[:, :2]], axis=1)
        step = np.linalg.solve(matrix + REGULARISATION * np.eye(3), miss[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        points = points - step * np.minimum(1, LONGEST_STEP_M / np.maximum(length, 1e-30))
        # A point that a step moved behind the antennas is put back in front of them.
        points[:, 2] = np.maximum(points[:, 2], NEAREST_M)
        if (length < SHORTEST_STEP_M).all():
            break
    return points


def find_normals(points_m: Array, at_m: Array, tx_m: Array, rx_m: Array) -> tuple[Array, Array]:
    """Return normals towards the antennas [n, 3], and cosines of incidence [n]."""
    t, r, *_ = compute_unit_legs(points_m, at_m, tx_m, rx_m)
    bisector = t + r
    length = np.linalg.norm(bisector, axis=1)
    return -bisector / length[:, None], length / 2


def compute_tangents(normals: Array) -> Array:
    """Return E: two orthonormal tangents, the columns of [n, 3, 2].

    The first is perpendicular to y, and close to x on a surface that faces the antennas.
    """
    first = np.cross(normals, np.array([0.0, 1.0, 0.0]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=-1).astype(np.float64)


def _compute_second_derivatives(
    points: Array, normals: Array, at_m: Array, tx_m: Array, rx_m: Array
) -> tuple[Array, Array, Array, Array]:
    """Return H_xy (rows and columns x and y), X, E' H E and 2 cos(theta) of the module's formulas."""
    t, r, out_m, back_m = compute_unit_legs(points, at_m, tx_m, rx_m)
    bend = compute_leg_bend(t, r, out_m, back_m)
    basis = compute_tangents(normals)
    cross = -np.swapaxes(basis, 1, 2) @ bend[:, :, :2]
    along_surface = np.swapaxes(basis, 1, 2) @ bend @ basis
    return bend[:, :2, :2], cross, along_surface, np.linalg.norm(t + r, axis=1)


def find_curvature(points: Array, normals: Array, at_m: Array, tx_m: Array, rx_m: Array, bend: Array) -> Array:
    """Return the curvature K [n, 2, 2] in the basis of `compute_tangents`, 1 / m, of echoes with the bend Q."""
    plane, cross, along_surface, twice_cosine = _compute_second_derivatives(points, normals, at_m, tx_m, rx_m)
    difference = plane - bend
    # The small part keeps the matrix invertible where the path bends as that of a point (Q = H_xy).
    surface_part = cross @ np.linalg.solve(difference + 1e-9 * np.eye(2), np.swapaxes(cross, 1, 2))
    return (surface_part - along_surface) / twice_cosine[:, None, None]


def find_motion(points: Array, normals: Array, at_m: Array, tx_m: Array, rx_m: Array, bend: Array) -> Array:
    """Return the motion P^-1 [n, 2, 2], metres, of echoes with the bend Q."""
    plane, cross, _, _ = _compute_second_derivatives(points, normals, at_m, tx_m, rx_m)
    inverse = np.linalg.inv(cross)
    return np.swapaxes(inverse, 1, 2) @ (plane - bend) @ inverse


def find_bend(points: Array, normals: Array, at_m: Array, tx_m: Array, rx_m: Array, motion: Array) -> Array:
    """Return the bend Q [n, 2, 2], 1 / m, of echoes with the motion P^-1."""
    plane, cross, _, _ = _compute_second_derivatives(points, normals, at_m, tx_m, rx_m)
    return plane - np.swapaxes(cross, 1, 2) @ motion @ cross


def predict_echo(
    points: Array, normals: Array, curvature: Array, at_m: Array, tx_m: Array, rx_m: Array
) -> tuple[Array, Array, Array]:
    """Return path L [n], slope g [n, 2] and bend Q [n, 2, 2] of the echo of a surface at stage offsets [n, 3]."""
    t, r, out_m, back_m = compute_unit_legs(points, at_m, tx_m, rx_m)
    plane, cross, along_surface, twice_cosine = _compute_second_derivatives(points, normals, at_m, tx_m, rx_m)
    second = along_surface + twice_cosine[:, None, None] * curvature
    bend = plane - np.swapaxes(cross, 1, 2) @ np.linalg.solve(second, cross)
    return out_m + back_m, -(t + r)[:, :2], bend


def compute_spreading(points: Array, normals: Array, curvature: Array, at_m: Array, tx_m: Array, rx_m: Array) -> Array:
    """Return cos(theta) / (r1 r2 sqrt |det P|), [n], 1 / m: the echo amplitude of a surface that reflects everything.

    r1 and r2 are the distances of the point from TX and RX. For a plane the result is 1 / path.
    """
    _, _, out_m, back_m = compute_unit_legs(points, at_m, tx_m, rx_m)
    _, _, along_surface, twice_cosine = _compute_second_derivatives(points, normals, at_m, tx_m, rx_m)
    second = along_surface + twice_cosine[:, None, None] * curvature
    root = np.sqrt(np.abs(np.linalg.det(second)))
    # 1e-9 keeps a focus, where det P is 0, finite.
    return twice_cosine / (2 * out_m * back_m * np.maximum(root, 1e-9))


def find_offset_that_sees(points: Array, normals: Array, at_m: Array, tx_m: Array, rx_m: Array) -> Array:
    """Return the stage offsets [n, 3] at which TX and RX see a point as a mirror with the given normal.

    The search starts at `at_m` [n, 3].
    """
    basis = np.swapaxes(compute_tangents(normals), 1, 2)
    at_m = at_m.copy()
    for _ in range(NEWTON_STEPS):
        t, r, out_m, back_m = compute_unit_legs(points, at_m, tx_m, rx_m)
        bend = compute_leg_bend(t, r, out_m, back_m)
        matrix = (basis @ bend)[:, :, :2]
        step = np.linalg.solve(matrix, basis @ (t + r)[..., None])[..., 0]
        at_m[:, :2] += np.clip(step, -LONGEST_STEP_M, LONGEST_STEP_M)
    return at_m
