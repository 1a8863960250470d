"""The paper's weighted k-nearest-neighbour classifier on |H|, |V| and complex P (section 6.3).

The distance of two pixels is lambda_H |d|H|| + lambda_V |d|V|| + lambda_P d_P, summed over the incidence angles. The
paper uses |dP| for d_P. Two other measures of the same quantity are offered, because errors of a ratio are not
additive:

* `inverse`: |d(1/P)|. 1/P = V/H stays below 1 for every dielectric, while P grows without bound near the Brewster angle
  and there its noise swamps the distance.
* `log`: |d ln P| = sqrt((d ln|P|)^2 + (d arg P)^2). A gain error of a few percent is the same distance for every
  material; materials of nearly the same permittivity differ by 4 to 10 % in P.

The three weights and the measure are fitted by cross-validation on the training data, whole scans left out.

Neighbours cannot tell that a patch is none of the materials: the nearest is always somebody. What is unknown is decided
by the materials' distributions (`discriminant.py`), as for every model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from polysight.host.materials.discriminant import ErrorDiscriminant
from polysight.host.materials.samples import Model, NamedScan, Real, Samples, SceneErrors, by_angle, majority
from polysight.shared.errors import DataError

Measure = Literal["paper", "inverse", "log"]
MEASURES: tuple[Measure, ...] = get_args(Measure)
GRID = (0.2, 0.5, 1.0, 2.0, 5.0)
"""lambda_H and lambda_V tried, relative to lambda_P = 1 and with each channel scaled by its own spread."""
MARGIN = 2.0
"""How much farther than the library's own patches from one another a pixel may lie before it is unknown."""
_CHUNK = 512
_FAR = 1e9
Distances = tuple[Real, Real, Real]


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


def ratio_distance(a: npt.NDArray[np.complex128], b: npt.NDArray[np.complex128], measure: Measure) -> Real:
    """Distance of ratios P, broadcast; see the module's text for the measures."""
    if measure == "paper":
        return np.abs(a - b)
    if measure == "inverse":
        return np.abs(1 / a - 1 / b)
    quotient = a / b
    return np.hypot(np.log(np.abs(quotient)), np.angle(quotient))


def channel_distances(a: Real, b: Real, measure: Measure) -> Distances:
    """The three distances of features `a` [n, 4 * angles] to `b` [m, 4 * angles], summed over angles, [n, m] each."""
    (ah, av, aq), (bh, bv, bq) = by_angle(a), by_angle(b)
    angles = range(ah.shape[1])
    return (
        sum((np.abs(ah[:, None, i] - bh[None, :, i]) for i in angles), np.zeros((len(a), len(b)))),
        sum((np.abs(av[:, None, i] - bv[None, :, i]) for i in angles), np.zeros((len(a), len(b)))),
        sum(
            (ratio_distance(1 / aq[:, None, i], 1 / bq[None, :, i], measure) for i in angles),
            np.zeros((len(a), len(b))),
        ),
    )


def combine(channels: Distances, w: Weights) -> Real:
    """Weighted sum of the three distances."""
    return w.h * channels[0] + w.v * channels[1] + w.p * channels[2]


def voters(names: npt.NDArray, neighbours: int) -> Any:
    """scikit-learn's KNN over named pixels, to be asked with a matrix of distances [queries, pixels]."""
    from sklearn.neighbors import KNeighborsClassifier  # here: it loads for a second, which most commands need not wait

    knn = KNeighborsClassifier(n_neighbors=min(neighbours, names.size), metric="precomputed")
    return knn.fit(np.zeros((names.size, names.size)), names)  # of the distances among themselves it needs the shape


class PaperKnn(Model):
    """The paper's classifier.

    Parameters
    ----------
    channels
        One of `CHANNELS`; with one channel alone there is no weight to fit.
    weights
        Given instead of fitted.
    thresholds
        Distance beyond which a pixel named so is unknown, by material; none: never.
    """

    def __init__(
        self, channels: str = "H+V+P", weights: Weights | None = None, thresholds: Mapping[str, float] | None = None
    ) -> None:
        self.channels, self.given, self.thresholds = channels, weights, dict(thresholds or {})

    def fit(self, samples: Samples) -> PaperKnn:
        """Keep the pixels, and fit the weights unless they are given, or no two scans hold one material."""
        if self.given is not None:
            self.weights = self.given
        elif self.channels in ("H", "V"):
            self.weights = Weights(h=float(self.channels == "H"), v=float(self.channels == "V"), p=0.0)
        elif not samples.shared.any():
            self.weights = Weights()
        else:
            self.weights = fit_weights(samples, channels=self.channels).weights
        self.x, self.voters = samples.x, voters(samples.names, self.weights.neighbours)
        self.distributions = ErrorDiscriminant().fit(samples)
        return self

    def by_scan(
        self, x: Real, patches: npt.NDArray, errors: SceneErrors | None = None, others: float | None = None
    ) -> NamedScan:
        """Patches named by most of their pixels' neighbours, or unknown where that material's distribution is far."""
        found, told = majority(*self.by_pixel(x), patches), self.distributions.by_scan(x, patches, errors, others)
        row, kind = np.arange(len(found.patches)), np.searchsorted(self.distributions.names, found.names)
        far = np.zeros(len(row)) if told.distances is None else told.distances[row, kind]
        return replace(found, distance=np.maximum(found.distance, far))

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name of each pixel, and its neighbours' mean distance over the threshold of the material it is named."""
        names, relative = [], []
        for start in range(0, len(x), _CHUNK):
            distance = combine(self._distances(x[start : start + _CHUNK]), self.weights)
            k = self.voters.n_neighbors
            near = np.partition(distance, k - 1, axis=1)[:, :k].mean(axis=1)
            names.append(self.voters.predict(distance))
            relative.append(near / np.array([self.thresholds.get(str(n), np.inf) for n in names[-1]]))
        return np.concatenate(names), np.concatenate(relative)

    def _distances(self, x: Real) -> Distances:
        if self.weights.p:
            return channel_distances(x, self.x, self.weights.measure)
        h, v = (
            np.abs(a[:, None] - b[None]).sum(axis=2) for a, b in zip(by_angle(x)[:2], by_angle(self.x), strict=False)
        )
        return h, v, np.zeros_like(h)


@dataclass(frozen=True)
class Fit:
    """Result of the fit.

    Attributes
    ----------
    weights
        Best weights.
    pixel_accuracy
        Of those weights on scans that were left out, mean over the materials that two scans or more hold.
    by_channel
        Pixel accuracy with H, V, or P alone, same splits.
    thresholds
        Per material: distance beyond which a pixel is unknown.
    """

    weights: Weights
    pixel_accuracy: float
    by_channel: dict[str, float]
    thresholds: dict[str, float]


def fit_weights(
    samples: Samples, neighbours: int = 15, pixels_per_patch: int = 3, seed: int = 0, channels: str = "H+V+P"
) -> Fit:
    """Fit the paper's three weights and the measure of P.

    Every combination of the grid is judged on pixels of scans it has not seen; among the combinations within half a
    percent of the best the one with the most even weights is taken, because a weight that wins by chance throws
    information away.

    Parameters
    ----------
    samples
        Pixels of at least two scans.
    neighbours
        k of the KNN.
    pixels_per_patch
        Pixels drawn of each patch: neighbours in a patch are alike, and the cost grows with the square.
    seed
        Of that draw.
    channels
        "P": the measure alone is fitted.

    Raises
    ------
    DataError
        with fewer than two scans, or no material in two: a split by pixel would be flattering.
    """
    if not samples.shared.any():
        raise DataError(
            f"no material is in two of the {np.unique(samples.groups).size} scans; fitting weights needs one",
            "whole scans are left out to judge weights; pixels of one patch are too much alike",
            "process more scans with other placements",
        )
    few = _few(samples, pixels_per_patch, np.random.default_rng(seed))
    same_scan = few.groups[:, None] == few.groups[None, :]
    knn = voters(few.names, min(neighbours, int((~same_scan).sum(axis=1).min())))
    grid = [(0.0, 0.0)] if channels == "P" else [(0.0, 0.0), *product(GRID, GRID)]
    tried: list[tuple[float, float, Weights]] = []
    alone: dict[str, float] = {}
    for measure in MEASURES:
        distances = channel_distances(few.x, few.x, measure)
        scale = [1 / max(float(np.median(c)), 1e-12) for c in distances]
        for wh, wv in grid:
            w = Weights(wh * scale[0], wv * scale[1], scale[2], measure, neighbours)
            accuracy = _left_out(combine(distances, w), knn, few, same_scan)
            tried.append((accuracy, -abs(np.log(max(wh, 0.1))) - abs(np.log(max(wv, 0.1))), w))
            if wh == wv == 0:
                alone[measure] = accuracy
    top = max(accuracy for accuracy, _, _ in tried)
    accuracy, _, weights = max((t for t in tried if t[0] >= top - 0.005), key=lambda t: t[1])
    distances = channel_distances(few.x, few.x, weights.measure)
    by_channel = {c: _left_out(distances[i], knn, few, same_scan) for i, c in enumerate("hv")}
    by_channel["p"] = alone[weights.measure]
    return Fit(weights, accuracy, by_channel, _thresholds(combine(distances, weights), neighbours, few))


def _few(samples: Samples, per_patch: int, rng: np.random.Generator) -> Samples:
    """At most so many pixels of every patch."""
    at = [rng.permutation(np.flatnonzero(samples.patches == i))[:per_patch] for i in np.unique(samples.patches)]
    return samples.take(np.sort(np.concatenate(at)))


def _left_out(distance: Real, knn: Any, few: Samples, same_scan: npt.NDArray[np.bool_]) -> float:
    """Pixel accuracy, mean over the materials of two scans or more, when no pixel of the same scan may vote."""
    found = knn.predict(np.where(same_scan, _FAR, distance))
    return float(np.mean([(found[few.names == n] == n).mean() for n in np.unique(few.names[few.shared])]))


def _thresholds(distance: Real, neighbours: int, few: Samples) -> dict[str, float]:
    """Per material: how far its pixels lie from its own pixels in other scans, 99th percentile, times a margin.

    At least half of the materials' median: metal is the reference, so it lies on itself in every scan of the library
    and would accept nothing else. At most three times the median: one strange specimen must not open a material to
    everything. A material seen in one scan only has no spread between scans and gets none: it accepts whatever is
    nearest to it.
    """
    out = {}
    for name in np.unique(few.names):
        near = []
        for scan in np.unique(few.groups[few.names == name]):
            test = (few.names == name) & (few.groups == scan)
            train = (few.names == name) & (few.groups != scan)
            if train.any():
                d = distance[np.ix_(test, train)]
                k = min(neighbours, d.shape[1])
                near.append(np.partition(d, k - 1, axis=1)[:, :k].mean(axis=1))
        if near:
            out[str(name)] = MARGIN * float(np.percentile(np.concatenate(near), 99))
    usual = float(np.median(list(out.values()))) if out else 0.0
    return {name: float(np.clip(value, 0.5 * usual, 3 * usual)) for name, value in out.items()}
