"""Name the pixels and patches of a scan by a reference library; the available models.

`MODELS` lists the models: the paper's KNN and the discriminant of error sources. `Classifier` uses the library's model,
or the requested one. `add_explanation` gives the reason of a name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from polysight.materials.discriminant import ErrorDiscriminant
from polysight.materials.knn import PaperKnn, Weights
from polysight.materials.library import Library
from polysight.materials.permittivity import format_permittivity
from polysight.materials.samples import (
    Model,
    NamedScan,
    Real,
    Samples,
    SceneErrors,
    feature_matrix,
    usable,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

PAPER = "weighted KNN (paper)"
DISCRIMINANT = "discriminant of error sources"
SHORT = {"knn": PAPER, "discriminant": DISCRIMINANT}
"""Names of models in commands."""
EARLIER = (
    "own-spread",
    "discriminant of error sources, own spread",
    "linear discriminant",
    "linear discriminant of logarithms",
    "quadratic discriminant",
)
"""Names of models in earlier releases and their libraries: the discriminant replaces them."""
UNKNOWN = "unknown"
INCLUSIONS = 0.05
"""Share of a patch's pixels that may be of another material; a pixel's prior is its patch's name otherwise."""
LIKELY = 0.005
"""Materials of less probability are not listed."""


MODELS: dict[str, Callable[[str], Model]] = {
    PAPER: PaperKnn,
    DISCRIMINANT: ErrorDiscriminant,
}


@dataclass(frozen=True)
class PatchName:
    """Name of one patch, with its confidence and reason.

    Attributes
    ----------
    name
        Material, or "unknown".
    confidence
        Probability of that name; for the KNN the share of its pixels.
    votes
        Share of the pixels with each name, largest first.
    distance
        Distance to the material, in units of its threshold: above 1 is unknown.
    pixels
        Usable pixels.
    probabilities
        Of each likely material and of "unknown", largest first; empty for models without probabilities.
    why
        Reason of the name in one sentence (:func:`add_explanation`); empty if permittivities are not known.
    nearest
        The likeliest material, also of an unknown patch; None without usable pixels.
    """

    name: str
    confidence: float
    votes: dict[str, float]
    distance: float
    pixels: int
    probabilities: dict[str, float] = field(default_factory=dict)
    why: str = ""
    nearest: str | None = None


@dataclass(frozen=True)
class NamedPatch:
    """Names of a patch's pixels [n], their distances over the threshold [n], and the patch's verdict.

    `confidence` [n]: probability of each pixel's likeliest material, 0 for unusable pixels; None: the model gives none.
    """

    names: npt.NDArray[np.str_]
    distance: Real
    verdict: PatchName
    confidence: Real | None = None


class Classifier:
    """Names the pixels and patches of scans by a library.

    Parameters
    ----------
    library
        Reference patches with the fitted model.
    weights
        Weights of the paper's KNN; they select that model, and replace the library's own weights.
    model
        A key of `MODELS` or `SHORT`; default: the library's model.
    angles_deg
        Incidence angle of the scan, or of several scans of the same patches in their order; required if the library
        has more than one.

    Raises
    ------
    DataError
        if the library is empty, has no patch at an angle, or its fit cannot be read.
    """

    def __init__(
        self,
        library: Library,
        weights: Weights | None = None,
        model: str | None = None,
        angles_deg: Sequence[float] | None = None,
    ) -> None:
        if not library.entries:
            raise DataError(
                "the material library is empty", "nothing was trained", "polysight train", code=ErrorCode.NO_DATA
            )
        if angles_deg is None and len(library.angles_deg) > 1:
            raise DataError(
                f"the library has several incidence angles: {', '.join(f'{a:g}' for a in library.angles_deg)} degrees",
                "reflections under different angles cannot be compared",
                "give the incidence angle of the scan",
                code=ErrorCode.KEY_MISSING,
            )
        parts = [library.at(a) for a in angles_deg or library.angles_deg]
        if len({p.angles_deg[0] for p in parts}) < len(parts):
            raise DataError(
                f"scans under {' and '.join(f'{a:.1f}' for a in angles_deg or ())} degrees",
                "the library has only one set of features for that angle, whose errors would count twice",
                "give scans of the same patches under different angles, or one at a time",
                code=ErrorCode.VALUES_CONFLICT,
            )
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
        self.distributions = self._model.distributions
        self._width = max(len(UNKNOWN), *(len(n) for n in library.names))

    @property
    def permittivities(self) -> dict[str, complex]:
        """Material to the permittivity of the library's patches as half spaces; without metals."""
        return self.distributions.permittivities

    def scan(self, patches: Sequence[Real], errors: SceneErrors | None = None) -> list[NamedPatch]:
        """Name the patches of one scan, or of several scans of the same patches, together.

        Parameters
        ----------
        patches
            Features of each patch's pixels, [n, 4 * angles] (:func:`polysight.materials.samples.feature_matrix`);
            pixels that are not finite are unknown.
        errors
            Errors of the patches by the scan's error budget; None: no errors.
        """
        good = [usable(x) for x in patches]
        some = [i for i, g in enumerate(good) if g.any()]
        out = [self._named(g, None, PatchName(UNKNOWN, 0.0, {}, np.inf, 0)) for g in good]
        if not some:
            return out
        number = np.concatenate([np.full(int(good[i].sum()), i) for i in some])
        x = np.concatenate([patches[i][good[i]] for i in some])
        found = self._model.by_scan(x, number, None if errors is None else errors.of(np.array(some)), INCLUSIONS)
        for row, i in enumerate(some):
            at = number == i
            pixels = found.pixel_names[at], found.pixel_distance[at]
            out[i] = self._named(good[i], pixels, self._patch_name(found, row))
            if found.pixel_confidence is not None:
                confidence = np.zeros(good[i].size)
                confidence[good[i]] = found.pixel_confidence[at]
                out[i] = replace(out[i], confidence=confidence)
        return out

    def _patch_name(self, found: NamedScan, row: int) -> PatchName:
        far, confidence = float(found.distance[row]), float(found.confidence[row])
        probabilities: dict[str, float] = {}
        if found.probabilities is not None and found.materials is not None:
            every = dict(zip([*map(str, found.materials), UNKNOWN], found.probabilities[row].tolist(), strict=True))
            order = sorted(every, key=lambda name: -every[name])
            probabilities = {name: round(every[name], 4) for name in order if every[name] >= LIKELY}
            if far > 1:  # too far from all materials
                confidence = max(every[UNKNOWN], 1 - confidence)
        nearest = str(found.names[row])
        name = nearest if far <= 1 else UNKNOWN
        return PatchName(name, confidence, {}, far, 0, probabilities, nearest=nearest)

    def _named(
        self, good: npt.NDArray[np.bool_], pixels: tuple[npt.NDArray, Real] | None, name: PatchName
    ) -> NamedPatch:
        """Return a patch with names and distances of all pixels; `pixels` are those of the usable ones, if any."""
        every = np.full(good.size, UNKNOWN, f"<U{self._width}")
        relative = np.full(good.size, np.inf)
        if pixels is not None:
            names, distance = pixels
            every[good], relative[good] = np.where(distance <= 1, names, UNKNOWN), distance
        kinds, count = np.unique(every, return_counts=True)
        order = sorted(zip(kinds, count, strict=True), key=lambda i: (-i[1], i[0]))
        votes = {str(k): c / every.size for k, c in order}
        return NamedPatch(every, relative, replace(name, votes=votes, pixels=int(good.sum())))


def features_of(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Return features [n, 4] of pixels; not finite for unusable pixels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return feature_matrix(np.ravel(h), np.ravel(v), np.ravel(p))


def _model_name(given: str) -> str:
    name = DISCRIMINANT if given in EARLIER else SHORT.get(given, given)
    if name not in MODELS:
        raise DataError(
            f"no classifier is called {given!r}", "the library was made by another version, or the name is wrong",
            f"one of {', '.join(SHORT)}", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return name


def add_explanation(
    named: NamedPatch, permittivity: complex | None, covariance: npt.NDArray[np.float64] | None, classifier: Classifier
) -> NamedPatch:
    """Return the patch with the reason of its name, one sentence for a reader who knows materials.

    Parameters
    ----------
    named
        Result of the classifier.
    permittivity, covariance
        eps' - j eps'' of the patch, and [2, 2] of its real and imaginary part; None if it has none.
    classifier
        Gives the library's permittivities.
    """
    name = named.verdict
    known, found = classifier.permittivities, _estimate(permittivity, covariance)
    nearest = name.name if name.name != UNKNOWN else name.nearest
    like = "" if nearest is None else _with_permittivity(nearest, known.get(nearest))
    if name.name == UNKNOWN:
        near = f"; nearest: {like}" if like else ""
        why = f"not in the library: {found}{near}" if found else f"not in the library{near}"
    else:
        others = [f"{n} {100 * p:.0f} %" for n, p in name.probabilities.items() if n not in (name.name, UNKNOWN)][:2]
        match = f"{found} matches the library's {like}" if found else f"it looks like the library's {like}"
        alone = "; no other material is likely" if name.probabilities else ""  # the KNN has no probabilities
        why = match + (f"; it could also be {' or '.join(others)}" if others else alone)
    return replace(named, verdict=replace(name, why=why))


def _estimate(permittivity: complex | None, covariance: npt.NDArray[np.float64] | None) -> str:
    if permittivity is None:
        return ""
    text = f"permittivity {format_permittivity(permittivity)}"
    if covariance is None or not np.isfinite(covariance).all():
        return text
    real, loss = np.sqrt(np.diag(covariance))
    return f"{text} (+- {real:.2f}, {loss:.2f})"


def _with_permittivity(name: str, permittivity: complex | None) -> str:
    return name if permittivity is None else f"{name} ({format_permittivity(permittivity)})"
