"""Naming the pixels and patches of a scan by a reference library, and the models that can do it.

`MODELS` makes each classifier: the paper's KNN, the discriminant of error sources, and others from scikit-learn to
compare with. `Classifier` uses the one that was fitted with the library, or that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.discriminant import ErrorDiscriminant
from polysight.host.materials.knn import PaperKnn, Weights
from polysight.host.materials.library import Library
from polysight.host.materials.samples import WIDTH, Model, Real, Samples, by_angle, feature_matrix, usable
from polysight.shared.errors import DataError

PAPER = "weighted KNN (paper)"
DISCRIMINANT = "discriminant of error sources"
OWN_SPREAD = "discriminant of error sources, own spread"
SLOW = "metric learning (NCA) + KNN"
"""Takes seconds to fit, too long for every start of a program: judged, but not chosen."""
SHORT = {"knn": PAPER, "discriminant": DISCRIMINANT, "own-spread": OWN_SPREAD}
"""What the commands call some of them."""
UNKNOWN = "unknown"


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


@dataclass(frozen=True)
class Verdict:
    """What one patch was called.

    Attributes
    ----------
    name
        Material, or "unknown".
    confidence
        How sure: the probability of that name, or for the KNN the share of its pixels.
    votes
        Share of the pixels called so on their own, of each name that got any, largest first.
    distance
        Distance to the material, in units of its threshold: above 1 is unknown.
    pixels
        Usable pixels.
    """

    name: str
    confidence: float
    votes: dict[str, float]
    distance: float
    pixels: int


@dataclass(frozen=True)
class NamedPatch:
    """Names of a patch's pixels [n], their distances over the threshold [n], and the patch's verdict."""

    names: npt.NDArray[np.str_]
    distance: Real
    verdict: Verdict

    def unknown(self) -> NamedPatch:
        """The same patch, called unknown; its pixels keep their own names."""
        return replace(self, verdict=replace(self.verdict, name=UNKNOWN))


class Classifier:
    """Names pixels and patches by the library.

    Parameters
    ----------
    library
        Reference patches; what was fitted on them says which model names.
    weights
        Of the paper's KNN, which they select; instead of the library's own.
    model
        A key of `MODELS` or `SHORT`, instead of the model chosen for the library.
    angles_deg
        Incidence angle of the scan, or of several scans of the same patches in their order; needed where the library
        holds more than one.

    Raises
    ------
    DataError
        when the library is empty, holds no patch at an angle, or its fit cannot be read.
    """

    def __init__(
        self,
        library: Library,
        weights: Weights | None = None,
        model: str | None = None,
        angles_deg: Sequence[float] | None = None,
    ) -> None:
        if not library.entries:
            raise DataError("the material library is empty", "nothing was trained", "polysight train")
        if angles_deg is None and len(library.angles_deg) > 1:
            raise DataError(
                f"the library holds incidence angles {', '.join(f'{a:g}' for a in library.angles_deg)} degrees",
                "reflections under different angles are not compared",
                "say which angle the scan has",
            )
        parts = [library.at(a) for a in angles_deg or library.angles_deg]
        fit = parts[0].fit if len(parts) == 1 else library.fit_of([p.angles_deg[0] for p in parts])
        self.library, self.fit, self.angles_deg = library, fit, tuple(p.angles_deg[0] for p in parts)
        self.model = PAPER if weights else _model_name(model or fit.get("model", PAPER))
        if self.model == PAPER:
            if weights is None:
                weights = Weights.from_dict(fit["weights"]) if "weights" in fit else Weights()
            self._model = PaperKnn(weights=weights, thresholds=fit.get("thresholds"))
        else:
            self._model = MODELS[self.model]("H+V+P")
        samples = Samples.of(parts[0])
        for part in parts[1:]:
            samples = samples.joined(Samples.of(part))
        self._model.fit(samples)
        self._width = max(len(UNKNOWN), *(len(n) for n in library.names))

    @property
    def permittivities(self) -> dict[str, complex]:
        """Name to the mean true permittivity of its library entries, where all are known."""
        out: dict[str, complex] = {}
        for name in self.library.names:
            known = [e.permittivity for e in self.library.entries if e.name == name]
            values = [complex(p[0], -p[1]) for p in known if p is not None]
            if values and len(values) == len(known):
                out[name] = complex(np.mean(values))
        return out

    def scan(self, patches: Sequence[Real], errors: Real | None = None) -> list[NamedPatch]:
        """Name the patches of one scan, or of several scans of the same patches, together.

        Parameters
        ----------
        patches
            Features of each patch's pixels, [n, 4 * angles] (:func:`polysight.host.materials.samples.feature_matrix`);
            pixels that are not finite are unknown.
        errors
            float64 [patch, 3, 3]: covariance of each patch's ln|H|, ln|V| and arg P by the error budget; None, and for
            several angles: none.
        """
        if errors is not None and len(self.angles_deg) > 1:
            errors = None
        good = [usable(x) for x in patches]
        number = np.concatenate([np.full(int(g.sum()), i) for i, g in enumerate(good)] or [np.zeros(0, int)])
        if number.size == 0:
            return [self._named(g, None, None, UNKNOWN, 0.0, np.inf) for g in good]
        found = self._model.by_scan(np.concatenate([x[g] for x, g in zip(patches, good, strict=True)]), number, errors)
        out = []
        for i, g in enumerate(good):
            row = int(np.searchsorted(found.patches, i))
            if not g.any():
                out.append(self._named(g, None, None, UNKNOWN, 0.0, np.inf))
                continue
            at, far = number == i, float(found.distance[row])
            name = str(found.names[row]) if far <= 1 else UNKNOWN
            confidence = float(found.confidence[row])
            out.append(self._named(g, found.pixel_names[at], found.pixel_distance[at], name, confidence, far))
        return out

    def pixels(
        self, h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.str_], npt.NDArray[np.float64]]:
        """Name pixels, each by nothing but itself; for libraries of one angle.

        Parameters
        ----------
        h, v
            |H|, |V| relative to metal, [n] (complex values are taken by modulus).
        p
            complex [n], metal-referenced ratio.

        Returns
        -------
        names
            str [n]; "unknown" beyond the threshold, or where the pixel is not finite.
        distance
            float64 [n], distance over the threshold; infinite where not finite.
        """
        x = features_of(h, v, p)
        good = usable(x)
        if not good.any():
            found = self._named(good, None, None, UNKNOWN, 0.0, np.inf)
        else:
            found = self._named(good, *self._model.by_pixel(x[good]), UNKNOWN, 0.0, np.inf)
        return found.names, found.distance

    def patch(self, h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Verdict:
        """Name one patch on its own; features as :meth:`pixels`."""
        return self.scan([features_of(h, v, p)])[0].verdict

    def _named(
        self, good: npt.NDArray[np.bool_], names: Any, distance: Any, name: str, confidence: float, far: float
    ) -> NamedPatch:
        every = np.full(good.size, UNKNOWN, f"<U{self._width}")
        relative = np.full(good.size, np.inf)
        if names is not None:
            every[good], relative[good] = np.where(distance <= 1, names, UNKNOWN), distance
        kinds, count = np.unique(every, return_counts=True)
        order = sorted(zip(kinds, count, strict=True), key=lambda i: (-i[1], i[0]))
        votes = {str(k): c / every.size for k, c in order}
        return NamedPatch(every, relative, Verdict(name, confidence, votes, far, int(good.sum())))


def features_of(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Features [n, 4] of pixels, not finite where one of them cannot be used."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return feature_matrix(np.ravel(h), np.ravel(v), np.ravel(p))


def _model_name(given: str) -> str:
    name = SHORT.get(given, given)
    if name not in MODELS:
        raise DataError(
            f"no classifier is called {given!r}", "the library was made by another version, or the name is wrong",
            f"one of {', '.join(SHORT)}",
        )  # fmt: skip
    return name
