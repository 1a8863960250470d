"""Weights of the classifier, fitted by cross-validation with whole scans left out, and its threshold for "unknown"."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from host.materials.classify import (
    MEASURES,
    Features,
    Weights,
    channel_distances,
    neighbours_vote,
    usable,
)
from host.materials.library import Library
from shared.errors import DataError

GRID = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0)
"""lambda_H and lambda_V tried, relative to lambda_P = 1 and with each channel scaled by its own spread."""
MARGIN = 2.0
"""How much farther than the library's own patches from one another a pixel may lie before it is unknown."""


@dataclass(frozen=True)
class Fit:
    """Result of the fit.

    Attributes
    ----------
    weights
        Best weights.
    pixel_accuracy, patch_accuracy
        Of those weights on scans that were left out, mean over materials.
    by_channel
        Pixel accuracy with H, V, or P alone, same splits.
    thresholds
        Per material: distance beyond which a pixel is unknown.
    """

    weights: Weights
    pixel_accuracy: float
    patch_accuracy: float
    by_channel: dict[str, float]
    thresholds: dict[str, float]


def fit_library(library: Library, neighbours: int = 15, pixels_per_patch: int = 16, seed: int = 0) -> Library:
    """The library with weights and thresholds fitted on it, ready to classify. Raises as :func:`fit_weights`."""
    fit = fit_weights(library, neighbours, pixels_per_patch, seed)
    return Library(
        library.entries,
        {
            "weights": fit.weights.to_dict(),
            "thresholds": fit.thresholds,
            "pixel_accuracy": fit.pixel_accuracy,
            "patch_accuracy": fit.patch_accuracy,
            "by_channel": fit.by_channel,
            "split": f"leave one scan out, {len(library.scans)} scans",
        },
        library.note,
    )


def fit_weights(library: Library, neighbours: int = 15, pixels_per_patch: int = 16, seed: int = 0) -> Fit:
    """Fit the paper's three weights and the measure of P.

    Every combination of the grid is judged on pixels of scans it has not seen; among the combinations within half a
    percent of the best the one with the most even weights is taken, because a weight of zero that wins by chance
    throws information away.

    Parameters
    ----------
    library
        Patches of at least two scans.
    neighbours
        k of the KNN.
    pixels_per_patch
        Pixels drawn of each patch: neighbours in a patch are alike, and the cost grows with the square.
    seed
        Of that draw.

    Raises
    ------
    DataError
        with fewer than two scans: a split by pixel would be flattering.
    """
    if len(library.scans) < 2:
        raise DataError(
            f"the library holds {len(library.scans)} scan(s); fitting weights needs at least 2",
            "whole scans are left out to judge weights; pixels of one patch are too much alike",
            "process more scans with other placements",
        )
    features, names, scans, patches = _sample(library, pixels_per_patch, np.random.default_rng(seed))
    tried: list[tuple[float, float, Weights]] = []
    by_channel: dict[str, float] = {}
    for measure in MEASURES:
        channels = channel_distances(features, features, measure)
        scale = [1 / max(float(np.median(c)), 1e-12) for c in channels]
        for wh, wv in product(GRID, GRID):
            w = Weights(wh * scale[0], wv * scale[1], scale[2], measure, neighbours)
            accuracy = _left_out(channels, w, names, scans)[0]
            tried.append((accuracy, -abs(np.log(max(wh, 0.1))) - abs(np.log(max(wv, 0.1))), w))
            if wh == wv == 0:
                by_channel["p_" + measure] = accuracy
    top = max(accuracy for accuracy, _, _ in tried)
    weights = max((t for t in tried if t[0] >= top - 0.005), key=lambda t: t[1])[2]
    channels = channel_distances(features, features, weights.measure)
    for name, w in (("h", Weights(1, 0, 0)), ("v", Weights(0, 1, 0))):
        by_channel[name] = _left_out(channels, Weights(w.h, w.v, 0.0, weights.measure, neighbours), names, scans)[0]
    by_channel["p"] = by_channel["p_" + weights.measure]
    accuracy, predicted = _left_out(channels, weights, names, scans)
    patch = _by_patch(predicted, names, patches)
    return Fit(weights, accuracy, patch, by_channel, _thresholds(channels, weights, names, scans))


def _sample(library: Library, per_patch: int, rng: np.random.Generator):
    """Features of a few pixels of every patch, with their names, scans and patch numbers."""
    h, v, p = library.pixels()
    good = usable((h, v, p))
    number = np.concatenate([np.full(e.h.size, i) for i, e in enumerate(library.entries)])
    chosen = []
    for i in range(len(library.entries)):
        at = np.flatnonzero((number == i) & good)
        chosen.append(rng.permutation(at)[:per_patch])
    at = np.sort(np.concatenate(chosen))
    features: Features = (h[at], v[at], p[at])
    return features, library.of_pixels("name")[at], library.of_pixels("scan")[at], number[at]


def _combine(channels: tuple[npt.NDArray, npt.NDArray, npt.NDArray], w: Weights) -> npt.NDArray[np.float64]:
    return w.h * channels[0] + w.v * channels[1] + w.p * channels[2]


def _left_out(
    channels: tuple[npt.NDArray, npt.NDArray, npt.NDArray], w: Weights, names: npt.NDArray, scans: npt.NDArray
) -> tuple[float, npt.NDArray]:
    """Pixel accuracy (mean over materials) and predicted names, each scan judged by the others."""
    distance = _combine(channels, w)
    predicted = np.empty_like(names)
    for scan in np.unique(scans):
        test, train = scans == scan, scans != scan
        predicted[test], _ = neighbours_vote(distance[np.ix_(test, train)], names[train], w.neighbours)
    right = [float((predicted[names == n] == n).mean()) for n in np.unique(names)]
    return float(np.mean(right)), predicted


def _by_patch(predicted: npt.NDArray, names: npt.NDArray, patches: npt.NDArray) -> float:
    """Share of patches whose majority is right."""
    right = []
    for i in np.unique(patches):
        at = patches == i
        found, counts = np.unique(predicted[at], return_counts=True)
        right.append(found[np.argmax(counts)] == names[at][0])
    return float(np.mean(right))


def _thresholds(
    channels: tuple[npt.NDArray, npt.NDArray, npt.NDArray], w: Weights, names: npt.NDArray, scans: npt.NDArray
) -> dict[str, float]:
    """Per material: how far its pixels lie from its own pixels in other scans, 99th percentile, times a margin.

    At least half of the materials' median: metal is the reference, so it lies on itself in every scan of the library
    and would accept nothing else. A material seen in one scan only has no spread between scans and gets none: it
    accepts whatever is nearest to it.
    """
    distance = _combine(channels, w)
    out = {}
    for name in np.unique(names):
        near = []
        for scan in np.unique(scans[names == name]):
            test, train = (names == name) & (scans == scan), (names == name) & (scans != scan)
            if train.any():
                d = distance[np.ix_(test, train)]
                k = min(w.neighbours, d.shape[1])
                near.append(np.partition(d, k - 1, axis=1)[:, :k].mean(axis=1))
        if near:
            out[str(name)] = MARGIN * float(np.percentile(np.concatenate(near), 99))
    floor = 0.5 * float(np.median(list(out.values()))) if out else 0.0
    return {name: max(value, floor) for name, value in out.items()}
