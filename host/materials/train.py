"""Reference libraries made from scans, their classifiers fitted, and models judged on data they have not seen.

`make_library` collects the patches of known material from processed scans; `fit_library` judges the models on them, for
each incidence angle and for all together. What names is always the discriminant, the one model that gives probabilities
and knows what is none of the materials; the others are judged beside it. Nothing is chosen, so no figure flatters.

To judge a model (`score`), whole groups are left out (scans, or physical samples): pixels of one patch share their
speckle, their placement and their metal reference, so that a split by pixel measures how well a patch knows itself.
That figure is given too, because the paper seems to use it; it is optimistic and called so. A material can be judged
only where another scan taught it. One that a single scan holds is not judged: it stays among the materials that the
others may be confused with, counts neither as right nor as wrong, and is named.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.classify import DISCRIMINANT, MODELS, PAPER, SLOW
from polysight.host.materials.knn import fit_weights
from polysight.host.materials.library import Entry, Library
from polysight.host.materials.result import MaterialsResult
from polysight.host.materials.samples import Real, Samples, majority
from polysight.shared.errors import DataError

FOLDS = 8
OPTIMISTIC = "by pixel (optimistic)"
PIXELS = 16
"""Pixels of a patch that models are judged on."""


@dataclass(frozen=True)
class Score:
    """How a model did.

    Attributes
    ----------
    model, channels, split
        Its name, what it saw, and how training and test were kept apart.
    pixels
        Share of pixels named right, each by nothing but itself: mean over materials.
    in_scan
        The same when the pixels of a scan are named together.
    by_patch
        Share of pixels whose patch was named right, the patches of a scan named together: mean over materials.
    patches
        Share of patches named right.
    unknown
        Share of the patches, all of them of known materials, that were called unknown.
    confusion
        float64 [material, material] of pixels on their own, rows the truth, each adding to 1, in the order of `names`;
        0 in the rows of materials that were not judged.
    patch_confusion
        The same of pixels by their patch.
    names
        Materials, sorted.
    not_judged
        Those of them that no training pixels were left for; the shares above are of the others.
    calibration
        Expected calibration error of the patches that were named (:func:`calibration_error`).
    """

    model: str
    channels: str
    split: str
    pixels: float
    in_scan: float
    by_patch: float
    patches: float
    unknown: float
    confusion: Real
    patch_confusion: Real
    names: tuple[str, ...]
    not_judged: tuple[str, ...] = ()
    calibration: float = float("nan")


def calibration_error(confidence: npt.NDArray, right: npt.NDArray, bins: int = 10) -> float:
    """Expected calibration error: |mean confidence - share right| in bins of confidence, weighted by their size.

    Guo et al., On Calibration of Modern Neural Networks, ICML 2017. Not a number without any.
    """
    if not len(confidence):
        return float("nan")
    at = np.clip((np.asarray(confidence) * bins).astype(int), 0, bins - 1)
    count = np.bincount(at, minlength=bins)
    off = np.bincount(at, confidence, bins) - np.bincount(at, right, bins)
    return float(np.abs(off).sum() / count.sum())


def splits(samples: Samples, by_pixel: bool = False, folds: int = FOLDS) -> Iterator[tuple[npt.NDArray, npt.NDArray]]:
    """Training and test pixels of each fold: whole groups apart, or single pixels.

    Every group is a fold of its own where `folds` could put all that hold a material into one.

    Raises
    ------
    DataError
        when there are fewer than two groups to keep apart, or no material is in two.
    """
    from sklearn.model_selection import GroupKFold, StratifiedKFold

    groups = np.unique(samples.independent)
    if by_pixel:
        smallest = int(np.unique(samples.names, return_counts=True)[1].min())
        kept = StratifiedKFold(max(2, min(folds, smallest)), shuffle=True, random_state=0)
        yield from kept.split(samples.x, samples.names)
        return
    if groups.size < 2:
        raise DataError(
            f"{groups.size} scan to judge a classifier on",
            "whole scans are left out, and none would remain to learn from",
            "process more scans",
        )
    held = samples.groups_of_material[samples.shared]
    if not held.size:
        raise DataError(
            f"no material is in two of the {groups.size} scans",
            "a scan that is left out shows only what was never learnt",
            "process a second scan with the same materials",
        )
    if held.min() <= -(-groups.size // folds):
        folds = groups.size
    yield from GroupKFold(min(folds, groups.size)).split(samples.x, samples.names, samples.independent)


def score(samples: Samples, model: str, channels: str = "H+V+P", by_pixel: bool = False, folds: int = FOLDS) -> Score:
    """Judge a model by cross-validation.

    Parameters
    ----------
    samples
        Pixels.
    model, channels
        A key of `MODELS`, one of `CHANNELS`.
    by_pixel
        Split by pixel instead of by group: optimistic, see the module's text.
    folds
        At most so many folds.

    Raises
    ------
    DataError
        when there are fewer than two groups, or no material is in two of them.
    """
    alone, in_scan, of_patch = (np.empty_like(samples.names) for _ in range(3))
    unknown, learnt = np.zeros((2, samples.names.size), bool)
    sure = np.zeros(samples.names.size)
    for train, test in splits(samples, by_pixel, folds):
        learnt[test] = np.isin(samples.names[test], samples.names[train])
        fitted = MODELS[model](channels)
        fitted.fit(samples.take(train))
        alone[test], far = fitted.by_pixel(samples.x[test])
        whole = [test]
        if fitted.knows_scans:
            whole = [test[samples.groups[test] == group] for group in np.unique(samples.groups[test])]
        for at in whole:
            if fitted.knows_scans:
                found = fitted.by_scan(samples.x[at], samples.patches[at])
            else:
                found = majority(alone[at], far, samples.patches[at])
            row = np.searchsorted(found.patches, samples.patches[at])
            in_scan[at], of_patch[at], unknown[at] = found.pixel_names, found.names[row], (found.distance > 1)[row]
            sure[at] = found.confidence[row]
    names = np.unique(samples.names)
    tables = [_confusion(samples.names[learnt], found[learnt], names) for found in (alone, in_scan, of_patch)]
    judged = np.isin(names, samples.names[learnt])
    first = np.unique(samples.patches, return_index=True)[1]
    first = first[learnt[first]]
    named = first[~unknown[first]]
    return Score(
        model,
        channels,
        OPTIMISTIC if by_pixel else f"whole scans left out, {np.unique(samples.independent).size} scans",
        *(float(np.mean(np.diag(t)[judged])) for t in tables),
        patches=float(np.mean((of_patch == samples.names)[first])),
        unknown=float(np.mean(unknown[first])),
        confusion=tables[0],
        patch_confusion=tables[2],
        names=tuple(str(n) for n in names),
        not_judged=tuple(str(n) for n in names[~judged]),
        calibration=calibration_error(sure[named], (of_patch == samples.names)[named]),
    )


def _confusion(true: npt.NDArray, found: npt.NDArray, names: npt.NDArray) -> Real:
    table = np.zeros((names.size, names.size))
    np.add.at(table, (np.searchsorted(names, true), np.searchsorted(names, found)), 1)
    return table / np.maximum(table.sum(axis=1, keepdims=True), 1)


def best_model(samples: Samples) -> tuple[str, tuple[Score, ...]]:
    """Name of the model that does best with whole groups left out, and the scores of all but the slowest.

    Best is the mean of the pixels' and of the patches' share.
    """
    scores = tuple(score(samples, model) for model in MODELS if model != SLOW)
    return max(scores, key=lambda s: s.pixels + s.patches).model, scores


def score_unseen_materials(samples: Samples, model: str, channels: str = "H+V+P") -> dict[str, float]:
    """Share of each material's patches that are called unknown when no patch of that material was ever learnt.

    The other materials are learnt from other scans than the one that is judged, as always.
    """
    out = {}
    for name in np.unique(samples.names):
        missed = []
        for train, test in splits(samples):
            others = train[samples.names[train] != name]
            fitted = MODELS[model](channels)
            fitted.fit(samples.take(others))
            for group in np.unique(samples.groups[test]):
                at = test[samples.groups[test] == group]
                found = fitted.by_scan(samples.x[at], samples.patches[at])
                mine = np.unique(samples.patches[at][samples.names[at] == name])
                missed += list(found.distance[np.searchsorted(found.patches, mine)] > 1)
        out[str(name)] = float(np.mean(missed))
    return out


def fit_library(library: Library) -> Library:
    """The library with its model chosen, ready to classify; each incidence angle for itself, and all of them together.

    Raises
    ------
    DataError
        with fewer than two scans of an angle: a split by pixel would be flattering.
    """
    samples = {f"{angle:g}": Samples.of(library.at(angle), PIXELS) for angle in library.angles_deg}
    fits = {angle: fit_samples(of) for angle, of in samples.items()}
    if len(samples) > 1:
        fits["+".join(samples)] = fit_samples(reduce(Samples.joined, samples.values()))
    return Library(library.entries, {"angles": fits}, library.note)


def fit_samples(samples: Samples) -> dict[str, Any]:
    """Model and scores on labelled pixels, as plain values for a library's file.

    The scores are of materials that two scans or more hold; `not_judged` names the others.
    """
    scores = {model: score(samples, model) for model in MODELS if model != SLOW}
    weighted, told = fit_weights(samples), scores[DISCRIMINANT]
    judged = {s.model: {"pixels": s.pixels, "patches": s.patches} for s in scores.values()}
    for name in (DISCRIMINANT, PAPER):
        judged[name]["pixels_split_by_pixel"] = score(samples, name, by_pixel=True).pixels
    return {
        "model": DISCRIMINANT,
        "weights": weighted.weights.to_dict(),
        "thresholds": weighted.thresholds,
        "by_channel": weighted.by_channel,
        "split": told.split,
        "pixel_accuracy": told.pixels,
        "patch_accuracy": told.patches,
        "known_called_unknown": told.unknown,
        "pixel_accuracy_in_scan": told.in_scan,
        "calibration_error": told.calibration,
        "judged": judged,
        "materials": len(told.names),
        "not_judged": list(told.not_judged),
    }


@dataclass(frozen=True)
class TrainingScan:
    """One processed scan for the library.

    Attributes
    ----------
    scan
        Its name: pixels of one scan never test what they trained.
    result
        Output of :func:`polysight.host.materials.analyse`, made with the truth's plates.
    simulated
        Whether it was simulated.
    seed
        Of the simulated placement, where it has one.
    versions
        Versions of what made it.
    names
        Names of patches by label, when drawn by hand instead of matched to a truth.
    specimens
        Which physical piece each patch shows, by label, where that is known.
    """

    scan: str
    result: MaterialsResult
    simulated: bool
    seed: int | None = None
    versions: Mapping[str, str] | None = None
    names: Mapping[int, str] | None = None
    specimens: Mapping[int, str] | None = None


def entries_of(scan: TrainingScan, pixels_per_patch: int = 16) -> list[Entry]:
    """Library entries of one scan: each patch whose material is known, with up to so many pixels of its interior.

    Pixels are taken at even intervals over the interior, so that the same scan always gives the same entries.
    """
    out = []
    r = scan.result
    for patch in r.patches:
        name = (scan.names or {}).get(patch.patch.label) or (patch.truth.name if patch.truth else None)
        rows, cols = np.nonzero(patch.patch.interior & np.isfinite(r.p) & (r.p != 0))
        if name is None or rows.size == 0:
            continue
        pick = np.unique(np.linspace(0, rows.size - 1, min(pixels_per_patch, rows.size)).round().astype(int))
        at = (rows[pick], cols[pick])
        eps = patch.truth.permittivity if patch.truth else None
        theta = r.theta_rad[at] if r.theta_rad.ndim else r.theta_rad
        out.append(
            Entry(
                name=name,
                scan=scan.scan,
                h=np.abs(r.h[at]).astype(np.float32),
                v=np.abs(r.v[at]).astype(np.float32),
                p=r.p[at].astype(np.complex64),
                incidence_deg=float(np.degrees(np.mean(theta))),
                simulated=scan.simulated,
                seed=scan.seed,
                thickness_mm=patch.truth.thickness_mm if patch.truth else None,
                permittivity=None if eps is None else (eps.real, -eps.imag),
                versions=dict(scan.versions or {}),
                specimen=(scan.specimens or {}).get(patch.patch.label),
            )
        )
    return out


def make_library(scans: Iterable[TrainingScan], note: str = "", pixels_per_patch: int = 16) -> Library:
    """A library of several scans, with the classifier's weights fitted on it (whole scans left out).

    Raises
    ------
    DataError
        when no scan holds a patch of known material, or fewer than two scans do.
    """
    entries = [e for scan in scans for e in entries_of(scan, pixels_per_patch)]
    if not entries:
        raise DataError(
            "no patch of known material in these scans",
            "they have no truth.json or labels, or no patch matches them by position",
            "say what lies where: polysight label SCAN",
        )
    return fit_library(Library(tuple(entries), {}, note))
