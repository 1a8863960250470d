"""Weighted k-nearest-neighbour classification on |H|, |V| and complex P (section 6.3 of the paper).

The distance of two pixels is lambda_H |d|H|| + lambda_V |d|V|| + lambda_P d_P. The paper uses |dP| for d_P. Two other
measures of the same quantity are offered, because errors of a ratio are not additive:

* `inverse`: |d(1/P)|. 1/P = V/H stays below 1 for every dielectric, while P grows without bound near the Brewster angle
  and there its noise swamps the distance.
* `log`: |d ln P| = sqrt((d ln|P|)^2 + (d arg P)^2). A gain error of a few percent is the same distance for every
  material; materials of nearly the same permittivity differ by 4 to 10 % in P.

Which measure and which weights are used is decided by cross-validation on the library, whole scans left out.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from host.materials.library import Library
from shared.errors import DataError

Measure = Literal["paper", "inverse", "log"]
MEASURES: tuple[Measure, ...] = get_args(Measure)
UNKNOWN = "unknown"
Real = npt.NDArray[np.float64]
Features = tuple[Real, Real, npt.NDArray[np.complex128]]
_CHUNK = 512


@dataclass(frozen=True)
class Weights:
    """lambda_H, lambda_V, lambda_P, how P is compared, and the number of neighbours."""

    h: float = 1.0
    v: float = 1.0
    p: float = 1.0
    measure: Measure = "log"
    neighbours: int = 15

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the library file."""
        return {"h": self.h, "v": self.v, "p": self.p, "measure": self.measure, "neighbours": self.neighbours}

    @staticmethod
    def from_dict(raw: dict[str, Any]) -> Weights:
        """Inverse of :meth:`to_dict`. Raises DataError."""
        try:
            w = Weights(float(raw["h"]), float(raw["v"]), float(raw["p"]), raw["measure"], int(raw["neighbours"]))
        except (KeyError, TypeError, ValueError) as e:
            raise DataError(f"the library's weights cannot be read: {e}", "made by another version") from None
        if w.measure not in MEASURES or min(w.h, w.v, w.p) < 0 or w.neighbours < 1:
            raise DataError(f"the library's weights make no sense: {raw}", "made by another version")
        return w


@dataclass(frozen=True)
class Verdict:
    """What one patch was called.

    Attributes
    ----------
    name
        Material with most votes, or "unknown".
    confidence
        Its share of the votes.
    votes
        Share of each material that got any, largest first.
    distance
        Median distance of the pixels to their neighbours, in units of the material's own threshold: above 1 is unknown.
    pixels
        Pixels that voted.
    """

    name: str
    confidence: float
    votes: dict[str, float]
    distance: float
    pixels: int


def ratio_distance(a: npt.NDArray[np.complex128], b: npt.NDArray[np.complex128], measure: Measure) -> Real:
    """Distance of ratios P, broadcast; see the module's text for the measures."""
    if measure == "paper":
        return np.abs(a - b)
    if measure == "inverse":
        return np.abs(1 / a - 1 / b)
    quotient = a / b
    return np.hypot(np.log(np.abs(quotient)), np.angle(quotient))


def channel_distances(a: Features, b: Features, measure: Measure) -> tuple[Real, Real, Real]:
    """The three distances of every pixel of `a` to every pixel of `b`, float64 [na, nb] each."""
    return (
        np.abs(a[0][:, None] - b[0][None, :]),
        np.abs(a[1][:, None] - b[1][None, :]),
        ratio_distance(a[2][:, None], b[2][None, :], measure),
    )


def usable(features: Features) -> npt.NDArray[np.bool_]:
    """Pixels whose features are all finite and whose ratio is not zero, bool [n]."""
    h, v, p = features
    return np.isfinite(h) & np.isfinite(v) & np.isfinite(p) & (p != 0)


def neighbours_vote(distance: Real, names: npt.NDArray, k: int) -> tuple[npt.NDArray, Real]:
    """Distance-weighted vote of the k nearest, and their mean distance, from a distance matrix [queries, library]."""
    k = min(k, names.size)
    from sklearn.neighbors import KNeighborsClassifier  # here: it loads for a second, which most commands need not wait

    knn = KNeighborsClassifier(n_neighbors=k, weights="distance", metric="precomputed")
    knn.fit(np.zeros((names.size, names.size)), names)
    near = np.partition(distance, k - 1, axis=1)[:, :k].mean(axis=1)
    return np.asarray(knn.predict(distance)), near


class Classifier:
    """Names pixels and patches by the library.

    Parameters
    ----------
    library
        Reference patches; its `fit` gives the weights when they are not passed.
    weights
        Overrides the library's own.

    Raises
    ------
    DataError
        when the library is empty or its weights cannot be read.
    """

    def __init__(self, library: Library, weights: Weights | None = None) -> None:
        if not library.entries:
            raise DataError("the material library is empty", "nothing was trained", "polysight train")
        if weights is None:
            weights = Weights.from_dict(library.fit["weights"]) if "weights" in library.fit else Weights()
        self.library, self.weights = library, weights
        features = library.pixels()
        keep = usable(features)
        self._features: Features = (features[0][keep], features[1][keep], features[2][keep])
        self._names = library.of_pixels("name")[keep]
        thresholds = library.fit.get("thresholds", {})
        self.thresholds = {n: float(thresholds.get(n, np.inf)) for n in library.names}

    def distances(self, query: Features) -> Real:
        """Weighted distances of query pixels to the library's pixels, float64 [n, library pixels]."""
        h, v, p = channel_distances(query, self._features, self.weights.measure)
        return self.weights.h * h + self.weights.v * v + self.weights.p * p

    def pixels(
        self, h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.str_], npt.NDArray[np.float64]]:
        """Name pixels.

        Parameters
        ----------
        h, v
            |H|, |V| relative to metal, [n] (complex values are taken by modulus).
        p
            complex [n], metal-referenced ratio.

        Returns
        -------
        names
            str [n]; "unknown" where the nearest neighbours are farther than the material's threshold, or where the
            pixel is not finite.
        distance
            float64 [n], mean distance of the neighbours over the threshold of the material they vote for; infinite
            where not finite.
        """
        query: Features = (
            np.abs(np.asarray(h)).astype(np.float64).ravel(),
            np.abs(np.asarray(v)).astype(np.float64).ravel(),
            np.asarray(p, np.complex128).ravel(),
        )
        good = np.flatnonzero(usable(query))
        width = max(len(UNKNOWN), *(len(n) for n in self.library.names))
        names = np.full(query[0].size, UNKNOWN, f"<U{width}")
        relative = np.full(query[0].size, np.inf)
        for start in range(0, good.size, _CHUNK):
            at = good[start : start + _CHUNK]
            d = self.distances((query[0][at], query[1][at], query[2][at]))
            found, near = neighbours_vote(d, self._names, self.weights.neighbours)
            scaled = near / np.array([self.thresholds[str(n)] for n in found])
            names[at] = np.where(scaled <= 1, found, UNKNOWN)
            relative[at] = scaled
        return names, relative

    def patch(self, h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Verdict:
        """Name one patch by the majority of its pixels; features as :meth:`pixels`."""
        return vote(*self.pixels(h, v, p))


def vote(names: npt.NDArray[np.str_], distance: Real) -> Verdict:
    """Majority of pixel names; "unknown" counts as a name. An empty patch is unknown with confidence 0."""
    if names.size == 0:
        return Verdict(UNKNOWN, 0.0, {}, float("inf"), 0)
    shares = {str(n): c / names.size for n, c in sorted(Counter(names.tolist()).items(), key=lambda i: (-i[1], i[0]))}
    best = next(iter(shares))
    return Verdict(best, shares[best], shares, float(np.median(distance)), int(names.size))
