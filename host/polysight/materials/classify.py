"""Name the pixels and patches of a scan with a reference library; the classifier of the POLySIGHT paper.

`MODELS` lists the models: the paper's KNN and the discriminant of error sources. `Classifier` uses the library's model,
or the requested one.

`PaperKnn` is the paper's classifier: the k nearest pixels of the library vote on the name of a pixel. The distance of
two pixels is lambda_H d_H + lambda_V d_V + lambda_P d_P, with their distances in |H|, |V| and complex P. There are
several measures for d_P (`library.py`). The three weights and the measure are fitted by cross-validation on the
training data, with whole scans left out.

Every patch has nearest neighbours, also one of a foreign material. Whether it is unknown is therefore decided by the
distributions of the materials (`discriminant.py`), for each model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials.discriminant import ErrorDiscriminant
from polysight.materials.kinds import Kind, Kinds, RatioEvidence, list_literature_kinds
from polysight.materials.library import (
    MEASURES,
    Distances,
    Library,
    Measure,
    Model,
    NamedScan,
    Real,
    Samples,
    compute_channel_distances,
    count_votes,
    find_usable_pixels,
    invert_ratios,
    name_by_majority,
    split_by_angle,
)
from polysight.materials.names import (
    UNKNOWN,
    NamedPatch,
    PatchName,
    compute_name_shares,
    derive_evidence_from_pixels,
    make_patch_without_pixels,
    name_patch,
)
from polysight_shared.errors import DataError, ErrorCode

WEIGHT_GRID = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Values of lambda_H and lambda_V to try, relative to lambda_P = 1, with each channel scaled by its spread; chosen."""
UNKNOWN_MARGIN = 2.0
"""A pixel is unknown beyond this multiple of the 99th percentile of distances between pixels of the same material in
different scans.

Chosen: a smaller margin calls more pixels of new placements unknown, a larger one accepts more foreign materials."""
FIT_PIXELS = 3
"""Number of pixels of each patch that are used to fit weights; chosen. Pixels of a patch are similar, and the cost
grows with the square of their number."""


@dataclass(frozen=True)
class Weights:
    """Weights `h`, `v`, `p` of the channels (the paper's lambda_H, lambda_V, lambda_P), measure of P's distance,
    neighbours.

    A weight multiplies the distance in its channel. Only the ratios of the weights affect names, but thresholds of
    distances are valid only for the weights with which they were fitted. The number of neighbours is chosen.
    """

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
        """Rebuild the weights from the result of :meth:`to_dict`. Raises DataError if they are not valid."""
        try:
            weights = Weights(float(raw["h"]), float(raw["v"]), float(raw["p"]), raw["measure"], int(raw["neighbours"]))
        except (KeyError, TypeError, ValueError) as e:
            raise DataError(
                f"the library's weights cannot be read: {e}", "another release made it", "train it again",
                code=ErrorCode.VALUE_INVALID,
            ) from None  # fmt: skip
        if weights.measure not in MEASURES or min(weights.h, weights.v, weights.p) < 0 or weights.neighbours < 1:
            raise DataError(
                f"the library's weights are invalid: {raw}", "another release made it", "train it again",
                code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        return weights


def combine(channels: Distances, weights: Weights) -> Real:
    """Return the weighted sum of the distances in H, V and P, float64 in their shape."""
    return weights.h * channels[0] + weights.v * channels[1] + weights.p * channels[2]


class PaperKnn(Model):
    """The paper's classifier.

    Weights are fitted unless they are given; with the `channels` "H" or "V" there is nothing to fit, with "P" only the
    measure. `thresholds` maps a material to the largest distance of its known pixels; without an entry there is no
    limit.
    """

    def __init__(
        self, channels: str = "H+V+P", weights: Weights | None = None, thresholds: Mapping[str, float] | None = None
    ) -> None:
        self.channels = channels
        self.given = weights
        self.thresholds = dict(thresholds or {})
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
        # Slow imports, which most commands do not need.
        from polysight.materials.paper_knn import PaperKNeighborsClassifier

        weights = self.weights
        count = min(weights.neighbours, samples.names.size)
        self._knn = PaperKNeighborsClassifier(
            count, weight_h=weights.h, weight_v=weights.v, weight_p=weights.p, measure=weights.measure
        )
        self._materials, self._material_of_pixel = np.unique(samples.names, return_inverse=True)
        # The classes are numbers instead of names, because scikit-learn checks numbers faster.
        self._knn.fit(invert_ratios(samples.x), self._material_of_pixel)
        self._samples = samples
        self._distributions = None
        return self

    @property
    def distributions(self) -> ErrorDiscriminant:
        """The materials' distributions. They are fitted at the first use, because pixels are named without them."""
        if self._distributions is None:
            self._distributions = ErrorDiscriminant().fit(self._samples)
        return self._distributions

    def by_scan(self, x: Real, patches: npt.NDArray) -> NamedScan:
        """Name the pixels and patches of one scan, patches by the majority of their pixels.

        `x` are features [n, columns], `patches` the number of each pixel's patch [n]. The distance of a patch is that
        of its votes or that to the distribution of its material, whichever is larger. If it is above 1, the caller
        calls the patch unknown.
        """
        voted = name_by_majority(*self.classify_pixels(x), patches)
        distances = self.distributions.by_scan(x, patches).distances
        if distances is None:
            return voted
        material = np.searchsorted(self.distributions.names, voted.names)
        distance_to_material = distances[np.arange(len(voted.patches)), material]
        return replace(voted, distance=np.maximum(voted.distance, distance_to_material))

    def classify_pixels(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Return the name of each pixel [n], and its mean distance to its neighbours / the material's threshold [n]."""
        distance, nearest = self._knn.kneighbors(invert_ratios(x))
        votes = count_votes(self._material_of_pixel[nearest], self._materials.size)
        names = self._materials[votes.argmax(axis=1)]
        thresholds = np.array([self.thresholds.get(str(name), np.inf) for name in names])
        return names, distance.mean(axis=1) / thresholds


@dataclass(frozen=True)
class Fit:
    """Result of the fit.

    Attributes
    ----------
    weights
        Best weights.
    pixel_accuracy
        Accuracy of these weights on scans left out: mean over the materials that are in two or more scans.
    by_channel
        Pixel accuracy with H, V, or P alone, on the same scans left out.
    thresholds
        Material to the distance beyond which a pixel is unknown.
    """

    weights: Weights
    pixel_accuracy: float
    by_channel: dict[str, float]
    thresholds: dict[str, float]


def fit_weights(samples: Samples, channels: str = "H+V+P") -> Fit:
    """Fit the paper's three weights and the measure of P.

    The accuracy of every combination of the grid is measured on scans left out. Among the combinations within half a
    percent (chosen) of the best, the one with the most even weights is taken, because extreme weights discard
    information. With `channels` "P" only the measure is fitted.

    Raises DataError if no material is in two scans: a split by pixel would be too optimistic.
    """
    if not samples.shared.any():
        raise DataError(
            f"no material is in two of the {np.unique(samples.groups).size} scans; fitting weights needs one",
            "weights are judged on scans left out; pixels of one patch are too similar",
            "process more scans with other placements",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    few = _draw_few_pixels(samples)
    neighbours = Weights.neighbours
    same_scan = few.groups[:, None] == few.groups[None, :]
    # As many pixels vote as every pixel has in other scans.
    fewest_others = int((~same_scan).sum(axis=1).min())
    judge = _LeftOut.prepare(few, same_scan, min(neighbours, fewest_others))
    grid = [(0.0, 0.0)] if channels == "P" else [(0.0, 0.0), *product(WEIGHT_GRID, WEIGHT_GRID)]
    tried: list[tuple[float, float, Weights]] = []
    p_alone: dict[str, float] = {}
    for measure in MEASURES:
        distances = compute_channel_distances(few.x, few.x, measure)
        # Each channel is scaled by its usual distance, so that the grid's weights compare channels.
        scale = [1 / max(float(np.median(c)), 1e-12) for c in distances]
        for wh, wv in grid:
            w = Weights(wh * scale[0], wv * scale[1], scale[2], measure)
            accuracy = judge.accuracy(combine(distances, w))
            # The evenness is greatest, 0, if both weights are 1; a weight of 0 counts as 0.1.
            evenness = -abs(np.log(max(wh, 0.1))) - abs(np.log(max(wv, 0.1)))
            tried.append((accuracy, evenness, w))
            if wh == wv == 0:
                p_alone[measure] = accuracy
    top = max(accuracy for accuracy, _, _ in tried)
    nearly_best = [(evenness, accuracy, w) for accuracy, evenness, w in tried if accuracy >= top - 0.005]
    _, accuracy, weights = max(nearly_best, key=lambda candidate: candidate[0])
    distances = compute_channel_distances(few.x, few.x, weights.measure)
    accuracy_by_channel = {c: judge.accuracy(distances[i]) for i, c in enumerate("hv")}
    accuracy_by_channel["p"] = p_alone[weights.measure]
    return Fit(
        weights, accuracy, accuracy_by_channel, _compute_thresholds(combine(distances, weights), neighbours, few)
    )


def _draw_few_pixels(samples: Samples) -> Samples:
    """Return at most `FIT_PIXELS` random pixels of every patch."""
    rng = np.random.default_rng(0)
    picked = [rng.permutation(np.flatnonzero(samples.patches == i))[:FIT_PIXELS] for i in np.unique(samples.patches)]
    return samples.take(np.sort(np.concatenate(picked)))


@dataclass(frozen=True)
class _LeftOut:
    """Judges a distance of pixels: each of n pixels is named by the votes of its `voters` nearest pixels of other
    scans.

    `classes` [n] is the number of each pixel's material, `shared` are the numbers of materials in two or more scans,
    and `same_scan` [n, n] is true for two pixels of one scan.
    """

    classes: npt.NDArray[np.intp]
    shared: npt.NDArray[np.intp]
    same_scan: npt.NDArray[np.bool_]
    voters: int

    @classmethod
    def prepare(cls, few: Samples, same_scan: npt.NDArray[np.bool_], voters: int) -> _LeftOut:
        """Number the materials of these pixels."""
        classes = np.unique(few.names, return_inverse=True)[1]
        return cls(classes, np.unique(classes[few.shared]), same_scan, voters)

    def accuracy(self, distance: Real) -> float:
        """Return the pixel accuracy for distances [n, n], mean over the materials of two or more scans."""
        distance_to_other_scans = np.where(self.same_scan, np.inf, distance)
        count = np.bincount(self.classes)
        # Find the nearest pixels, in any order. Values are partitioned several times faster than their indices.
        last = self.voters - 1
        is_near = distance_to_other_scans <= np.partition(distance_to_other_scans, last, axis=1)[:, last, None]
        members = (self.classes[:, None] == np.arange(count.size)).astype(np.float32)
        votes = is_near.astype(np.float32) @ members
        # Too many pixels are near if several have the same distance as the last one that votes. Then the partition of
        # indices decides which of them vote.
        tied = is_near.sum(axis=1) > self.voters
        if tied.any():
            nearest = np.argpartition(distance_to_other_scans[tied], last, axis=1)[:, : self.voters]
            votes[tied] = count_votes(self.classes[nearest], count.size)
        voted = votes.argmax(axis=1)
        accuracy_of_class = np.bincount(self.classes, voted == self.classes) / count
        return float(np.mean(accuracy_of_class[self.shared]))


def _compute_thresholds(distance: Real, neighbours: int, few: Samples) -> dict[str, float]:
    """Return material to its threshold: `UNKNOWN_MARGIN` times the 99th percentile of its distances between scans.

    The distance of a pixel is its mean distance to the nearest pixels of the same material in other scans. A threshold
    is at least half of the median over the materials, because the distances of metal, the reference, are zero. It is at
    most three times the median: one unusual specimen must not make a material accept everything. Both factors are
    chosen. A material of a single scan has no threshold.
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
            out[str(name)] = UNKNOWN_MARGIN * float(np.percentile(np.concatenate(near), 99))
    usual = float(np.median(list(out.values()))) if out else 0.0
    return {name: float(np.clip(value, 0.5 * usual, 3 * usual)) for name, value in out.items()}


PAPER_MODEL = "weighted KNN (paper)"
DISCRIMINANT_MODEL = "discriminant of error sources"
"""Names of the models in library files."""
MODEL_OF_OPTION = {"knn": PAPER_MODEL, "discriminant": DISCRIMINANT_MODEL}
"""Names of models in commands."""
EARLIER_MODELS = (
    "own-spread",
    "discriminant of error sources, own spread",
    "linear discriminant",
    "linear discriminant of logarithms",
    "quadratic discriminant",
)
"""Names of models in earlier releases and their libraries: the discriminant replaces them."""


MODELS: dict[str, Callable[[str], Model]] = {
    PAPER_MODEL: PaperKnn,
    DISCRIMINANT_MODEL: ErrorDiscriminant,
}
"""Name to the model's class, which is called with the channels to use, one of `CHANNELS`."""


class Classifier:
    """Names the pixels and patches of scans by a library.

    Parameters
    ----------
    library
        Reference patches with the fitted model.
    weights
        Weights of the paper's KNN. They select that model, and replace the library's own weights, but not its
        thresholds: weights must have the scale of the library's.
    model
        A key of `MODELS` or `MODEL_OF_OPTION`; default: the library's model.
    angles_deg
        Incidence angle of the scan, or of several scans of the same patches in their order; required if the library
        has more than one.

    Attributes
    ----------
    library, fit
        The library, and its fit at the angles in use.
    angles_deg
        The library's angles that are used.
    model
        Key of `MODELS`.
    distributions
        The materials' distributions.
    names, permittivities
        The library's materials, and those of their permittivities that are known, as half spaces; metals have none.
    kinds
        The materials that a patch may be of, of library and literature, at each angle.

    Raises DataError if the library is empty, has no patch at an angle, or its fit cannot be read.
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
                "the material library is empty",
                "nothing was trained",
                "polysight train SCAN... --out FILE",
                code=ErrorCode.NO_DATA,
            )
        if angles_deg is None and len(library.angles_deg) > 1:
            raise DataError(
                f"the library has several incidence angles: {', '.join(f'{a:g}' for a in library.angles_deg)} degrees",
                "reflections under different angles cannot be compared",
                "give the incidence angle of the scan",
                code=ErrorCode.KEY_MISSING,
            )
        # The parts of the library, one for each angle.
        parts = [library.at_angle(a) for a in angles_deg or library.angles_deg]
        if len({p.angles_deg[0] for p in parts}) < len(parts):
            raise DataError(
                f"scans under {' and '.join(f'{a:.1f}' for a in angles_deg or ())} degrees",
                "the library has only one set of features for that angle, whose errors would count twice",
                "give scans of the same patches under different angles, or one at a time",
                code=ErrorCode.VALUES_CONFLICT,
            )
        fit = parts[0].fit if len(parts) == 1 else library.fit_for([p.angles_deg[0] for p in parts])
        self.library = library
        self.fit = fit
        self.angles_deg = tuple(p.angles_deg[0] for p in parts)
        self.model = PAPER_MODEL
        if not weights:
            self.model = _check_model_name(model or fit.get("model", PAPER_MODEL))
        if self.model == PAPER_MODEL:
            if weights is None:
                weights = Weights.from_dict(fit["weights"]) if "weights" in fit else Weights()
            self._model = PaperKnn(weights=weights, thresholds=fit.get("thresholds"))
        else:
            self._model = MODELS[self.model]("H+V+P")
        samples = Samples.from_library(parts[0])
        for part in parts[1:]:
            samples = samples.join(Samples.from_library(part))
        self._model.fit(samples)
        self.distributions = self._model.distributions
        self.names = library.names
        self.permittivities: dict[str, complex] = self.distributions.permittivities
        kinds = (*self._make_library_kinds(), *list_literature_kinds(library.names))
        self.kinds = tuple(Kinds(kinds, float(np.radians(angle)), with_sheets=True) for angle in self.angles_deg)

    def _make_library_kinds(self) -> tuple[Kind, ...]:
        """Return the library's materials as half spaces, with the spread of their specimens and the mean's error."""
        spread = dict(zip(self.distributions.names.tolist(), np.sqrt(self.distributions.spread), strict=True))
        out = []
        for name in self.library.names:
            eps = self.permittivities.get(name)
            if eps is None:
                out.append(Kind(name, None))
                continue
            # Each patch of the material counts as a separate specimen.
            count = sum(e.name == name for e in self.library.entries)
            real, loss = (float(s) * float(np.sqrt(1 + 1 / count)) for s in spread[name])
            out.append(Kind(name, eps, (real, loss)))
        return tuple(out)

    def scan(
        self, patches: Sequence[Real], evidence: Sequence[Sequence[RatioEvidence] | None] | None = None
    ) -> list[NamedPatch]:
        """Name the patches of one scan, or of several scans of the same patches under different angles.

        `patches` are the features of each patch's pixels, [n, 4 * angles] (:func:`make_features`); pixels that are not
        finite are unknown. `evidence` is that of each scan on each patch; None where only the pixels are known. The
        paper's KNN uses the pixels alone.
        """
        if self.model == PAPER_MODEL:
            return [self._name_by_votes(x) for x in patches]
        named = []
        for x, patch_evidence in zip(patches, evidence or [None] * len(patches), strict=True):
            _, _, ratios = split_by_angle(x)
            if patch_evidence is None:
                patch_evidence = [
                    derive_evidence_from_pixels(t, kinds) for t, kinds in zip(ratios.T, self.kinds, strict=True)
                ]
            named.append(name_patch(self.kinds, patch_evidence, ratios))
        return named

    def _name_by_votes(self, x: Real) -> NamedPatch:
        """Name a patch by the votes of its pixels' nearest neighbours."""
        is_usable = find_usable_pixels(x)
        if not is_usable.any():
            return make_patch_without_pixels(is_usable.size)
        voted = self._model.by_scan(x[is_usable], np.zeros(int(is_usable.sum()), np.intp))
        pixel_names = np.full(is_usable.size, UNKNOWN, f"<U{max(len(UNKNOWN), *map(len, self.names))}")
        pixel_names[is_usable] = np.where(voted.pixel_distance <= 1, voted.pixel_names, UNKNOWN)
        pixel_distance = np.full(is_usable.size, np.inf)
        pixel_distance[is_usable] = voted.pixel_distance
        nearest_name = str(voted.names[0])
        distance = float(voted.distance[0])
        patch_name = PatchName(
            name=nearest_name if distance <= 1 else UNKNOWN,
            confidence=float(voted.confidence[0]),
            votes=compute_name_shares(pixel_names),
            distance=distance,
            pixels=int(is_usable.sum()),
            nearest=nearest_name,
        )
        return NamedPatch(pixel_names, pixel_distance, patch_name)


def _check_model_name(given_name: str) -> str:
    """Return the key of `MODELS` for a name of a command, a library file or an earlier release.

    Raises DataError if there is none.
    """
    name = DISCRIMINANT_MODEL if given_name in EARLIER_MODELS else MODEL_OF_OPTION.get(given_name, given_name)
    if name not in MODELS:
        raise DataError(
            f"no classifier is called {given_name!r}", "the library was made by another version, or the name is wrong",
            f"one of {', '.join(MODEL_OF_OPTION)}", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return name


def describe_classifier(classifier: Classifier) -> str:
    """Describe a classifier, its library, and its score on scans left out of training."""
    library = classifier.library
    fit = classifier.fit
    kind = "simulated " if library.simulated else ""
    angles = " and ".join(f"{a:g}" for a in classifier.angles_deg)
    out = f"{classifier.model} on |H|, |V| and complex P"
    judged = fit.get("judged", {}).get(classifier.model)
    if judged and fit.get("model") != classifier.model:
        out += ", chosen by the user; not the default model"
    out += f"; library of {len(library.names)} materials from {len(library.scans)} {kind}scans, {angles} degrees."
    if judged:
        out += (
            f" On scans left out of the library it names {100 * judged['pixels']:.1f} % of the pixels and "
            f"{100 * judged['patches']:.1f} % of the patches right"
        )
        if fit.get("model") == classifier.model and fit.get("calibration_error") is not None:
            out += f", its probabilities off by {fit['calibration_error']:.3f} (expected calibration error)"
        if "pixels_split_by_pixel" in judged:
            out += f" (split by pixel, which is optimistic: {100 * judged['pixels_split_by_pixel']:.1f} %)"
        channel = fit.get("by_channel", {})
        if {"h", "v", "p"} <= set(channel):
            single_channels = ", ".join(f"{k.upper()} {100 * channel[k]:.0f} %" for k in "hvp")
            out += f"; the KNN by one channel alone: {single_channels}"
        out += "."
        if missing := fit.get("not_judged"):
            out += (
                f" Of its {fit['materials']} materials {len(missing)} could not be judged, because only one scan has"
                f" them: {', '.join(missing)}."
            )
    return f"{out} {library.note}".strip()
