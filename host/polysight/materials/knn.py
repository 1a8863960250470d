"""The paper's weighted k-nearest-neighbour classifier on |H|, |V| and complex P (section 6.3).

The distance of two pixels is lambda_H |d|H|| + lambda_V |d|V|| + lambda_P d_P, summed over the incidence angles. The
paper uses |dP| for d_P. There are two other measures, because errors of a ratio are not additive:

* `inverse`: |d(1/P)|. 1/P = V/H stays below 1 for every dielectric, while P and its noise grow without bound near the
  Brewster angle.
* `log`: |d ln P| = sqrt((d ln|P|)^2 + (d arg P)^2). A gain error is the same distance for every material; materials of
  nearly the same permittivity differ by 4 to 10 % in P.

The three weights and the measure are fitted by cross-validation on the training data, with whole scans left out.

A nearest neighbour exists for every patch; unknown patches are recognised by the materials' distributions
(`discriminant.py`), as for every model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from polysight.materials.discriminant import ErrorDiscriminant
from polysight.materials.samples import Model, NamedScan, Real, Samples, SceneErrors, by_angle, majority
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Measure = Literal["paper", "inverse", "log"]
MEASURES: tuple[Measure, ...] = get_args(Measure)
GRID = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Values of lambda_H and lambda_V to try, relative to lambda_P = 1, with each channel scaled by its spread."""
MARGIN = 2.0
"""Largest distance of a known pixel, relative to the distances between the library's own patches."""
FIT_PIXELS = 3
"""Pixels of each patch to fit weights: pixels of a patch are similar, and the cost grows with the square."""
_CHUNK = 512
_FAR = 1e9
Distances = tuple[Real, Real, Real]


@dataclass(frozen=True)
class Weights:
    """lambda_H, lambda_V, lambda_P, the measure of P, and the number of neighbours."""

    h: float = 1.0
    v: float = 1.0
    p: float = 1.0
    measure: Measure = "log"
    neighbours: int = 15

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for the library file."""
        return {"h": self.h, "v": self.v, "p": self.p, "measure": self.measure, "neighbours": self.neighbours}

    @staticmethod
    def from_dict(raw: dict[str, Any]) -> Weights:
        """Inverse of :meth:`to_dict`. Raises DataError."""
        try:
            w = Weights(float(raw["h"]), float(raw["v"]), float(raw["p"]), raw["measure"], int(raw["neighbours"]))
        except (KeyError, TypeError, ValueError) as e:
            raise DataError(
                f"the library's weights cannot be read: {e}", "made by another version", code=ErrorCode.VALUE_INVALID
            ) from None
        if w.measure not in MEASURES or min(w.h, w.v, w.p) < 0 or w.neighbours < 1:
            raise DataError(
                f"the library's weights are invalid: {raw}", "made by another version", code=ErrorCode.VALUE_INVALID
            )
        return w


def ratio_distance(a: npt.NDArray[np.complex128], b: npt.NDArray[np.complex128], measure: Measure) -> Real:
    """Return the distance of ratios P, broadcast; the measures are in the module's docstring."""
    if measure == "paper":
        return np.abs(a - b)
    if measure == "inverse":
        return np.abs(1 / a - 1 / b)
    quotient = a / b
    return np.hypot(np.log(np.abs(quotient)), np.angle(quotient))


def channel_distances(a: Real, b: Real, measure: Measure) -> Distances:
    """Return the distances of features a [n, 4 * angles] to b [m, 4 * angles], summed over angles, [n, m] each."""
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
    """Return the weighted sum of the three distances."""
    return w.h * channels[0] + w.v * channels[1] + w.p * channels[2]


class Voters:
    """scikit-learn's KNN of labelled pixels, asked with distances; without its checks, which take most of the time."""

    def __init__(self, names: npt.NDArray, neighbours: int) -> None:
        from sklearn import config_context  # slow imports, which most commands do not need
        from sklearn.neighbors import KNeighborsClassifier

        self.neighbours = min(neighbours, names.size)
        self._unchecked = partial(config_context, assume_finite=True, skip_parameter_validation=True)
        knn = KNeighborsClassifier(n_neighbors=self.neighbours, metric="precomputed")
        with self._unchecked():
            self._knn = knn.fit(np.zeros((names.size, names.size)), names)  # only the shape is used

    def predict(self, distance: Real) -> npt.NDArray:
        """Return the name of each query from its distances to the labelled pixels, [queries, pixels]."""
        with self._unchecked():
            return self._knn.predict(distance)


class PaperKnn(Model):
    """The paper's classifier.

    Parameters
    ----------
    channels
        One of `CHANNELS`; a single channel has no weight to fit.
    weights
        Fixed weights; None: they are fitted.
    thresholds
        Largest distance of known pixels by material; without an entry there is no limit.
    """

    def __init__(
        self, channels: str = "H+V+P", weights: Weights | None = None, thresholds: Mapping[str, float] | None = None
    ) -> None:
        self.channels, self.given, self.thresholds = channels, weights, dict(thresholds or {})
        self._distributions: ErrorDiscriminant | None = None

    def fit(self, samples: Samples) -> PaperKnn:
        """Store the pixels, and fit the weights unless they are given or no two scans share a material."""
        if self.given is not None:
            self.weights = self.given
        elif self.channels in ("H", "V"):
            self.weights = Weights(h=float(self.channels == "H"), v=float(self.channels == "V"), p=0.0)
        elif not samples.shared.any():
            self.weights = Weights()
        else:
            self.weights = fit_weights(samples, channels=self.channels).weights
        self.x, self.voters = samples.x, Voters(samples.names, self.weights.neighbours)
        self._samples, self._distributions = samples, None
        return self

    @property
    def distributions(self) -> ErrorDiscriminant:  # type: ignore[override]
        """The materials' distributions, fitted when they are asked for: pixels are named without them."""
        if self._distributions is None:
            self._distributions = ErrorDiscriminant().fit(self._samples)
        return self._distributions

    def by_scan(
        self, x: Real, patches: npt.NDArray, errors: SceneErrors | None = None, others: float | None = None
    ) -> NamedScan:
        """Name patches by the majority of their pixels; unknown if they are far from that material's distribution."""
        found, known = majority(*self.by_pixel(x), patches), self.distributions.by_scan(x, patches, errors, others)
        row, kind = np.arange(len(found.patches)), np.searchsorted(self.distributions.names, found.names)
        far = np.zeros(len(row)) if known.distances is None else known.distances[row, kind]
        return replace(found, distance=np.maximum(found.distance, far))

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name each pixel; return name, and mean distance of its neighbours over the material's threshold."""
        names, relative = [], []
        for start in range(0, len(x), _CHUNK):
            distance = combine(self._distances(x[start : start + _CHUNK]), self.weights)
            k = self.voters.neighbours
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
        Accuracy of these weights on scans left out, mean over the materials of two or more scans.
    by_channel
        Pixel accuracy with H, V, or P alone, same splits.
    thresholds
        Material to the distance beyond which a pixel is unknown.
    """

    weights: Weights
    pixel_accuracy: float
    by_channel: dict[str, float]
    thresholds: dict[str, float]


def fit_weights(samples: Samples, channels: str = "H+V+P") -> Fit:
    """Fit the paper's three weights and the measure of P.

    Every combination of the grid is judged on scans left out; among the combinations within half a percent of the best
    the one with the most even weights is taken, because extreme weights discard information.

    Parameters
    ----------
    samples
        Pixels of at least two scans.
    channels
        "P": only the measure is fitted.

    Raises
    ------
    DataError
        if no material is in two scans: a split by pixel would be too optimistic.
    """
    if not samples.shared.any():
        raise DataError(
            f"no material is in two of the {np.unique(samples.groups).size} scans; fitting weights needs one",
            "weights are judged on scans left out; pixels of one patch are too similar",
            "process more scans with other placements",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    few, neighbours = _few(samples), Weights.neighbours
    same_scan = few.groups[:, None] == few.groups[None, :]
    knn = Voters(few.names, min(neighbours, int((~same_scan).sum(axis=1).min())))
    grid = [(0.0, 0.0)] if channels == "P" else [(0.0, 0.0), *product(GRID, GRID)]
    tried: list[tuple[float, float, Weights]] = []
    alone: dict[str, float] = {}
    for measure in MEASURES:
        distances = channel_distances(few.x, few.x, measure)
        scale = [1 / max(float(np.median(c)), 1e-12) for c in distances]
        for wh, wv in grid:
            w = Weights(wh * scale[0], wv * scale[1], scale[2], measure)
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


def _few(samples: Samples) -> Samples:
    """Return at most `FIT_PIXELS` random pixels of every patch."""
    rng = np.random.default_rng(0)
    at = [rng.permutation(np.flatnonzero(samples.patches == i))[:FIT_PIXELS] for i in np.unique(samples.patches)]
    return samples.take(np.sort(np.concatenate(at)))


def _left_out(distance: Real, knn: Voters, few: Samples, same_scan: npt.NDArray[np.bool_]) -> float:
    """Return the pixel accuracy, mean over the materials of two or more scans, without votes of the same scan."""
    found = knn.predict(np.where(same_scan, _FAR, distance))
    return float(np.mean([(found[few.names == n] == n).mean() for n in np.unique(few.names[few.shared])]))


def _thresholds(distance: Real, neighbours: int, few: Samples) -> dict[str, float]:
    """Return thresholds: 99th percentile of the distances of a material's pixels between scans, times a margin.

    At least half of the materials' median: metal is the reference, so its own distances are zero. At most three times
    the median: one unusual specimen must not make a material accept everything. A material of a single scan has no
    threshold.
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
