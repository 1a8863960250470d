"""The POLySIGHT paper's nearest-neighbour classifier as an estimator of scikit-learn.

This module imports scikit-learn, which takes a second. Import it inside the functions that use it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt
from sklearn.neighbors import KNeighborsClassifier
from sklearn.utils import check_array, gen_batches
from sklearn.utils.validation import check_is_fitted, validate_data

from polysight.materials.library import (
    COLUMNS_PER_ANGLE,
    Measure,
    Real,
    compute_channel_distances,
    find_neighbours,
    invert_ratios,
)

# Pixels whose distances are computed together: 512 x 20,000 numbers are 80 MB.
_CHUNK = 512


def paper_distance(
    a: Real, b: Real, *, h: float = 1.0, v: float = 1.0, p: float = 1.0, measure: Measure = "log"
) -> Real:
    """Return the paper's distance of pixels a [n, columns] to b [m, columns], [n, m]; of two single pixels a number.

    Columns are |H|, |V|, real and imaginary part of P for each incidence angle, and the distance is

        lambda_H d_H + lambda_V d_V + lambda_P d_P

    with the weights `h`, `v` and `p`. If the number of columns is not a multiple of four they are other features, such
    as |H| alone: then the distance is the sum of the absolute differences of the columns.
    """
    first = np.atleast_2d(np.asarray(a, np.float64))
    second = np.atleast_2d(np.asarray(b, np.float64))
    if first.shape[1] % COLUMNS_PER_ANGLE:
        distance = np.abs(first[:, None, :] - second[None, :, :]).sum(axis=2)
    else:
        # `compute_channel_distances` takes features with 1 / P instead of P. If P has no weight, its distance is not
        # computed, and 0 is returned for it.
        measure_of_p = measure if p else None
        d_h, d_v, d_p = compute_channel_distances(invert_ratios(first), invert_ratios(second), measure_of_p)
        distance = h * d_h + v * d_v + p * d_p
    if np.ndim(a) > 1 or np.ndim(b) > 1:
        return distance
    return distance[0, 0]


class PaperKNeighborsClassifier(KNeighborsClassifier):
    """k nearest neighbours by the paper's distance (section 6.3): :func:`paper_distance`.

    Parameters
    ----------
    n_neighbors
        Number of nearest pixels that vote, each with one vote; if there are fewer pixels, all of them vote.
    weight_h, weight_v, weight_p
        lambda_H, lambda_V and lambda_P.
    measure
        Distance of two ratios: "paper", "inverse" or "log", see `polysight.materials.library`.
    """

    def __init__(
        self,
        n_neighbors: int = 15,
        *,
        weight_h: float = 1.0,
        weight_v: float = 1.0,
        weight_p: float = 1.0,
        measure: Measure = "log",
    ) -> None:
        super().__init__(n_neighbors=n_neighbors, algorithm="brute")
        self.weight_h = weight_h
        self.weight_v = weight_v
        self.weight_p = weight_p
        self.measure: Measure = measure

    @property
    def metric(self) -> Callable[[Any, Any], Any]:
        """The paper's distance with these weights, as scikit-learn's `metric`."""
        return partial(paper_distance, h=self.weight_h, v=self.weight_v, p=self.weight_p, measure=self.measure)

    @metric.setter
    def metric(self, value: object) -> None:
        """Ignore the metric that the base class sets: the weights define it."""

    def __sklearn_tags__(self) -> Any:
        """Return scikit-learn's description of the estimator: it takes no sparse arrays."""
        tags = super().__sklearn_tags__()
        tags.input_tags.sparse = False
        return tags

    def fit(self, X: npt.ArrayLike, y: npt.ArrayLike) -> Self:
        """Store the pixels X [n, columns] and their materials y [n]."""
        # The base class would take sparse arrays; these are refused.
        check_array(X, accept_sparse=False)
        return super().fit(X, y)

    def kneighbors(
        self, X: npt.ArrayLike | None = None, n_neighbors: int | None = None, return_distance: bool = True
    ) -> Any:
        """Return the distances and indices of the nearest pixels, nearest first, [n, neighbours] each.

        The result is that of scikit-learn's method. Distances are computed for whole arrays, because a metric that is
        called for each pair of pixels takes minutes.
        """
        check_is_fitted(self)
        pixels = self._fit_X if X is None else cast(Any, validate_data)(self, X, reset=False)
        available = self.n_samples_fit_
        if X is None:
            # A pixel of the training data is not a neighbour of itself.
            available -= 1
        neighbours: Any = n_neighbors or self.n_neighbors
        count = min(int(neighbours), available)
        nearest_indices = np.empty((len(pixels), count), np.intp)
        distances = np.empty((len(pixels), count))
        for rows in gen_batches(len(pixels), _CHUNK):
            distance = self.metric(pixels[rows], self._fit_X)
            if X is None:
                # Exclude each pixel as its own neighbour.
                row_indices = np.arange(rows.start, rows.stop)
                distance[row_indices - rows.start, row_indices] = np.inf
            nearest_indices[rows] = find_neighbours(distance, count)
            distances[rows] = np.take_along_axis(distance, nearest_indices[rows], axis=1)
        return (distances, nearest_indices) if return_distance else nearest_indices
