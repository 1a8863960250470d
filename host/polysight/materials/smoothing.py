"""Levels without speckle, and outlines with few corners.

As `denoise_tv_chambolle` and `approximate_polygon` of scikit-image, which load scipy.stats and scipy.signal: a second.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]
_ITERATIONS = 100
_LEAST_CHANGE = 2e-4
"""Change of the cost, relative to its first value, at which the iteration ends."""
_STEP = 0.25
"""Largest step for which the iteration in two dimensions converges (Chambolle 2004)."""


def reduce_variation(level: Real, weight: float) -> Real:
    """Return an image with less total variation, by Chambolle's dual projection (2004); a larger weight smooths more.

    It minimises half the squared distance from `level` plus `weight` times the sum of the gradient's magnitude.
    """
    field = np.zeros((2, *level.shape))
    gradient = np.zeros_like(field)
    change = np.zeros_like(level)
    first_cost = last_cost = np.inf
    smooth = level
    for _ in range(_ITERATIONS):
        smooth = level + change
        np.subtract(smooth[1:], smooth[:-1], out=gradient[0, :-1])
        np.subtract(smooth[:, 1:], smooth[:, :-1], out=gradient[1, :, :-1])
        steepness = np.hypot(gradient[0], gradient[1])
        cost = float(np.vdot(change, change)) + weight * float(steepness.sum())
        if first_cost == np.inf:
            first_cost = cost
        elif abs(last_cost - cost) < _LEAST_CHANGE * first_cost:
            break
        last_cost = cost
        field -= _STEP * gradient
        field /= 1 + (_STEP / weight) * steepness
        # the field's negative divergence
        np.negative(field[0] + field[1], out=change)
        change[1:] += field[0, :-1]
        change[:, 1:] += field[1, :, :-1]
    return smooth


def drop_corners(outline: Real, tolerance: float) -> Real:
    """Return the corners of an outline [n, 2] that keep it within a tolerance (Douglas and Peucker 1973)."""
    last = len(outline) - 1
    kept = {0, last}
    parts = [(0, last)]
    while parts:
        start, end = parts.pop()
        between = outline[start + 1 : end] - outline[start]
        side = outline[end] - outline[start]
        length = float(side @ side)
        along = np.zeros(len(between))
        if length > 0:
            along = np.clip(between @ side / length, 0.0, 1.0)
        distances = np.hypot(*(between - along[:, None] * side).T)
        if distances.size and distances.max() > tolerance:
            corner = start + 1 + int(distances.argmax())
            kept.add(corner)
            parts += [(start, corner), (corner, end)]
    return outline[sorted(kept)]
