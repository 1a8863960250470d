"""The classifiers by name, all on the same features and with the same three methods.

The paper's weighted KNN is one of them, the discriminant of `polysight.host.materials.discriminant` another, in two forms; the
others are scikit-learn's. Which one a library is used with is
decided on that library with whole scans left out (`polysight.host.materials.judge`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.decision import Model
from polysight.host.materials.discriminant import ErrorDiscriminant
from polysight.host.materials.knn import PaperKnn
from polysight.host.materials.samples import WIDTH, Real, Samples, by_angle

PAPER = "weighted KNN (paper)"
DISCRIMINANT = "discriminant of error sources"
OWN_SPREAD = "discriminant of error sources, own spread"
SLOW = "metric learning (NCA) + KNN"
"""Takes seconds to fit, too long for every start of a program: judged, but not chosen."""


class Learnt(Model):
    """An estimator of scikit-learn on the columns of its channels; unknown is what lies far in the discriminant."""

    def __init__(self, estimator: Any, channels: str) -> None:
        self.estimator, self.channels = estimator, channels
        self.far = ErrorDiscriminant(channels)

    def fit(self, samples: Samples) -> Learnt:
        """Learn from labelled pixels."""
        self.estimator.fit(self._columns(samples.x), samples.names)
        self.far.fit(samples)
        return self

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name of each pixel, and its distance to that material over the threshold."""
        names = self.estimator.predict(self._columns(x))
        return names, self.far.distance(x, names)

    def _columns(self, x: Real) -> Real:
        chosen = {"H": (0,), "V": (1,), "P": (2, 3), "H+V+P": (0, 1, 2, 3)}[self.channels]
        return x[:, [WIDTH * a + c for a in range(x.shape[1] // WIDTH) for c in chosen]]


def log_features(x: Real) -> Real:
    """ln|H|, ln|V| and the direction of V / H for each angle; features of fewer channels are left as they are."""
    if x.shape[1] % WIDTH:
        return x
    h, v, q = by_angle(x)
    length = np.maximum(np.abs(q), 1e-9)
    logs = (np.log(np.maximum(h, 1e-9)), np.log(np.maximum(v, 1e-9)), q.real / length, q.imag / length)
    return np.concatenate(logs, axis=1)


def _sklearn(channels: str, *names: str) -> Learnt:
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
    from sklearn.neighbors import KNeighborsClassifier, NeighborhoodComponentsAnalysis
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    parts: dict[str, Callable[[], Any]] = {
        "log": lambda: FunctionTransformer(log_features),
        "scale": StandardScaler,
        "lda": LinearDiscriminantAnalysis,
        "qda": lambda: QuadraticDiscriminantAnalysis(reg_param=0.02),
        "nca": lambda: NeighborhoodComponentsAnalysis(random_state=0, max_iter=60),
        "knn": lambda: KNeighborsClassifier(15),
    }
    return Learnt(make_pipeline(*(parts[n]() for n in names)), channels)


MODELS: dict[str, Callable[[str], Model]] = {
    PAPER: PaperKnn,
    DISCRIMINANT: ErrorDiscriminant,
    OWN_SPREAD: lambda channels: ErrorDiscriminant(channels, own=0.5),
    SLOW: lambda channels: _sklearn(channels, "scale", "nca", "knn"),
    "linear discriminant": lambda channels: _sklearn(channels, "scale", "lda"),
    "linear discriminant of logarithms": lambda channels: _sklearn(channels, "log", "scale", "lda"),
    "quadratic discriminant": lambda channels: _sklearn(channels, "scale", "qda"),
}
SHORT = {"knn": PAPER, "discriminant": DISCRIMINANT, "own-spread": OWN_SPREAD}
"""What the commands call some of them."""
