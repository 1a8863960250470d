"""Classifiers on the same features, judged side by side on data they have not seen.

The paper's weighted KNN (`host.materials.classify`) is one of them. The others are scikit-learn's, on
`[|H|, |V|, Re V/H, Im V/H]`: the ratio upside down, because its noise is then additive and bounded near the Brewster
angle. Which is best is decided with whole groups left out (scans, or physical samples): pixels of one patch share their
speckle, their placement and their metal reference, so that a split by pixel measures how well a patch knows itself.
That figure is given too, because the paper seems to use it; it is optimistic and called so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import confusion_matrix
from sklearn.model_selection import GroupKFold, StratifiedKFold
from sklearn.neighbors import KNeighborsClassifier, NeighborhoodComponentsAnalysis
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from host.materials.library import Library
from shared.errors import DataError

Real = npt.NDArray[np.float64]
CHANNELS = {"H": (0,), "V": (1,), "P": (2, 3), "H+V+P": (0, 1, 2, 3)}
"""Columns of one angle's features by channel (Fig. 20 of the paper)."""
WIDTH = 4


def feature_matrix(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Features [n, 4] of metal-referenced pixels: |H|, |V|, real and imaginary part of V / H = 1 / P."""
    inverse = 1 / np.asarray(p, np.complex128)
    return np.stack([np.abs(h), np.abs(v), inverse.real, inverse.imag], axis=-1)


class PaperKnn(ClassifierMixin, BaseEstimator):
    """The paper's KNN: lambda_H |d|H|| + lambda_V |d|V|| + lambda_P |dP|, each channel in units of its own spread.

    Of P the features hold 1 / P = V / H; its distance is the sum of those of its real and its imaginary part.

    Parameters
    ----------
    neighbours
        k.
    lambdas
        lambda_H, lambda_V, lambda_P, times one over each channel's mean spread within a material.
    columns
        Feature columns in use; several angles are so many groups of four.
    """

    def __init__(
        self, neighbours: int = 15, lambdas: tuple[float, float, float] = (1.0, 1.0, 1.0), columns: Sequence[int] = ()
    ) -> None:
        self.neighbours = neighbours
        self.lambdas = lambdas
        self.columns = columns

    def fit(self, x: Real, y: npt.NDArray) -> PaperKnn:
        """Learn the scales and keep the pixels."""
        columns = list(self.columns) or list(range(x.shape[1]))
        spread = np.stack([x[y == name].std(axis=0) for name in np.unique(y)]).mean(axis=0)
        weight = np.array([self.lambdas[min(c % WIDTH, 2)] for c in columns])
        self.scale_ = np.maximum(spread, 1e-9) / np.maximum(weight, 1e-9)
        self.knn_ = KNeighborsClassifier(self.neighbours, metric="manhattan").fit(x / self.scale_, y)
        self.classes_ = self.knn_.classes_
        return self

    def predict(self, x: Real) -> npt.NDArray:
        """Names of pixels."""
        return self.knn_.predict(x / self.scale_)


def log_features(x: Real) -> Real:
    """ln|H|, ln|V| and the direction of V / H for each angle; features of fewer channels are left as they are.

    Errors of gain and of phase multiply; on this scale they are the same for every material, which is what a linear
    discriminant takes for granted.
    """
    if x.shape[1] % WIDTH:
        return x
    h, v, real, imag = np.moveaxis(x.reshape(len(x), -1, WIDTH), -1, 0)
    h, v, length = (np.maximum(np.abs(part), 1e-9) for part in (h, v, real + 1j * imag))
    logs = (np.log(h), np.log(v), real / length, imag / length)
    return np.concatenate(logs, axis=1)


MODELS: dict[str, Callable[[], Any]] = {
    "weighted KNN (paper)": PaperKnn,
    "metric learning (NCA) + KNN": lambda: make_pipeline(
        StandardScaler(), NeighborhoodComponentsAnalysis(random_state=0, max_iter=60), KNeighborsClassifier(15)
    ),
    "linear discriminant": lambda: make_pipeline(StandardScaler(), LinearDiscriminantAnalysis()),
    "linear discriminant of logarithms": lambda: make_pipeline(
        FunctionTransformer(log_features), StandardScaler(), LinearDiscriminantAnalysis()
    ),
    "quadratic discriminant": lambda: make_pipeline(StandardScaler(), QuadraticDiscriminantAnalysis(reg_param=0.02)),
    "logistic regression": lambda: make_pipeline(StandardScaler(), LogisticRegression(C=100.0, max_iter=500)),
}


@dataclass(frozen=True)
class Samples:
    """Labelled pixels.

    Attributes
    ----------
    x
        float64 [n, 4 * angles].
    names, groups, patches
        Material, group that is left out as a whole, and patch number of each pixel, [n].
    """

    x: Real
    names: npt.NDArray
    groups: npt.NDArray
    patches: npt.NDArray

    @classmethod
    def of(cls, library: Library, pixels_per_patch: int | None = None, seed: int = 0) -> Samples:
        """Pixels of a library, grouped by scan; at most so many of each patch, drawn at random."""
        rng = np.random.default_rng(seed)
        x, names, groups, patches = [], [], [], []
        for i, e in enumerate(library.entries):
            features = feature_matrix(e.h, e.v, e.p)
            good = np.flatnonzero(np.isfinite(features).all(axis=1))
            at = rng.permutation(good)[:pixels_per_patch]
            x.append(features[at])
            names += [e.name] * at.size
            groups += [e.scan] * at.size
            patches += [i] * at.size
        if not names:
            raise DataError("the library holds no usable pixel", "nothing was trained", "polysight train")
        return cls(np.concatenate(x), np.array(names), np.array(groups), np.array(patches))

    def joined(self, other: Samples, seed: int = 0) -> Samples:
        """The same samples seen under a second angle: pixels of one material and group paired at random.

        Only materials that both have in a group of the same name remain.
        """
        rng = np.random.default_rng(seed)
        ours, theirs = [], []
        for name in np.unique(self.names):
            for group in np.unique(self.groups):
                a = np.flatnonzero((self.names == name) & (self.groups == group))
                b = np.flatnonzero((other.names == name) & (other.groups == group))
                n = min(a.size, b.size)
                ours.append(rng.permutation(a)[:n])
                theirs.append(rng.permutation(b)[:n])
        i, j = np.concatenate(ours), np.concatenate(theirs)
        if i.size == 0:
            raise DataError("no material was seen under both angles", "the scans' names differ")
        return Samples(np.hstack([self.x[i], other.x[j]]), self.names[i], self.groups[i], self.patches[i])


@dataclass(frozen=True)
class Score:
    """How a model did.

    Attributes
    ----------
    model, channels, split
        Its name, what it saw, and how training and test were kept apart.
    pixels, patches
        Share named right: mean over materials of the pixels' share, and of the patches by majority.
    confusion
        float64 [material, material], rows the truth, each adding to 1, in the order of `names`.
    names
        Materials, sorted.
    """

    model: str
    channels: str
    split: str
    pixels: float
    patches: float
    confusion: Real
    names: tuple[str, ...]


def score(samples: Samples, model: str, channels: str = "H+V+P", by_pixel: bool = False, folds: int = 8) -> Score:
    """Judge a model by cross-validation.

    Parameters
    ----------
    samples
        Pixels.
    model, channels
        Keys of `MODELS` and `CHANNELS`.
    by_pixel
        Split by pixel instead of by group: optimistic, see the module's text.
    folds
        At most so many folds.

    Raises
    ------
    DataError
        when there are fewer than two groups.
    """
    groups = np.unique(samples.groups)
    if groups.size < 2 and not by_pixel:
        raise DataError(
            f"{groups.size} scan to judge a classifier on",
            "whole scans are left out, and none would remain to learn from",
            "process more scans",
        )
    angles = samples.x.shape[1] // WIDTH
    columns = [WIDTH * a + c for a in range(angles) for c in CHANNELS[channels]]
    x = samples.x[:, columns]
    if by_pixel:
        smallest = int(np.unique(samples.names, return_counts=True)[1].min())
        splits = StratifiedKFold(max(2, min(folds, smallest)), shuffle=True, random_state=0).split(x, samples.names)
    else:
        splits = GroupKFold(min(folds, groups.size)).split(x, samples.names, samples.groups)
    found = np.empty_like(samples.names)
    for train, test in splits:
        estimator = MODELS[model]()
        if isinstance(estimator, PaperKnn):
            estimator.columns = columns
        found[test] = estimator.fit(x[train], samples.names[train]).predict(x[test])
    names = np.unique(samples.names)
    confusion = confusion_matrix(samples.names, found, labels=names, normalize="true")
    right = []
    for patch in np.unique(samples.patches):
        votes, count = np.unique(found[samples.patches == patch], return_counts=True)
        right.append(votes[np.argmax(count)] == samples.names[samples.patches == patch][0])
    split = "by pixel (optimistic)" if by_pixel else f"whole scans left out, {groups.size} scans"
    return Score(
        model, channels, split, float(np.mean(np.diag(confusion))), float(np.mean(right)), confusion, tuple(names)
    )


def best_model(samples: Samples, folds: int = 8) -> tuple[str, tuple[Score, ...]]:
    """Name of the model that does best with whole groups left out, and the scores of all."""
    scores = tuple(score(samples, model, folds=folds) for model in MODELS)
    return max(scores, key=lambda s: s.pixels).model, scores
