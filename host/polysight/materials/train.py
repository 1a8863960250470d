"""Train reference libraries from scans, and judge models by cross-validation.

`make_library` collects the patches of known material from processed scans; `fit_library` judges the models on them, for
each incidence angle and for all together. The default model is always the discriminant, the only one with probabilities
and a test for unknown materials; other models are judged for comparison. No model is selected by its score, so that the
scores are unbiased.

To judge a model (`score`), whole groups are left out (scans, or physical samples): pixels of one patch share speckle,
placement and metal reference, so that a split by pixel compares a patch with itself. That score is given too, because
the paper seems to use it; it is labelled optimistic. A material of a single scan cannot be judged: it stays among the
candidates, counts neither as right nor as wrong, and is listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials.classify import DISCRIMINANT, MODELS, PAPER, fit_weights
from polysight.materials.library import Entry, Library, Real, Samples, majority
from polysight.materials.result import MaterialsResult
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

FOLDS = 8
OPTIMISTIC = "by pixel (optimistic)"
PIXELS = 16
"""Pixels of each patch, in a library and to judge models."""


@dataclass(frozen=True)
class Score:
    """Scores of a model.

    Attributes
    ----------
    model, channels, split
        Name, channels, and split of training and test data.
    pixels
        Share of pixels named right, classified independently: mean over materials.
    in_scan
        The same with the pixels of a scan named together.
    by_patch
        Share of pixels whose patch was named right, with the patches of a scan named together: mean over materials.
    patches
        Share of patches named right.
    unknown
        Share of the patches (all of known materials) that were called unknown.
    confusion
        float64 [material, material] of independent pixels: rows are the truth in the order of `names` and add to 1; 0
        in the rows of materials that were not judged.
    patch_confusion
        The same with each pixel named as its patch.
    names
        Materials, sorted.
    not_judged
        Materials without training pixels in other groups; the shares above are of the others.
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
    """Return the expected calibration error: |mean confidence - share right| in bins, weighted by their size.

    Guo et al., On Calibration of Modern Neural Networks, ICML 2017. NaN without data.
    """
    if not len(confidence):
        return float("nan")
    at = np.clip((np.asarray(confidence) * bins).astype(int), 0, bins - 1)
    count = np.bincount(at, minlength=bins)
    off = np.bincount(at, confidence, bins) - np.bincount(at, right, bins)
    return float(np.abs(off).sum() / count.sum())


def splits(samples: Samples, by_pixel: bool = False, folds: int = FOLDS) -> Iterator[tuple[npt.NDArray, npt.NDArray]]:
    """Yield training and test pixels of each fold: whole groups, or single pixels.

    Every group is a fold of its own if `folds` could put all groups of a material into one fold.

    Raises DataError with fewer than two groups, or without a material in two groups.
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
            "whole scans are left out, and none would remain for training",
            "process more scans",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    held = samples.groups_of_material[samples.shared]
    if not held.size:
        raise DataError(
            f"no material is in two of the {groups.size} scans",
            "a scan left out has no material of the training scans",
            "process a second scan with the same materials",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    if held.min() <= -(-groups.size // folds):
        folds = groups.size
    yield from GroupKFold(min(folds, groups.size)).split(samples.x, samples.names, samples.independent)


def score(samples: Samples, model: str, channels: str = "H+V+P", by_pixel: bool = False, folds: int = FOLDS) -> Score:
    """Judge a model by cross-validation.

    `model` is a key of `MODELS`, `channels` one of `CHANNELS`. With `by_pixel` the split is by pixel instead of by
    group: optimistic, see the module's docstring. `folds` is the largest number of folds.

    Raises DataError with fewer than two groups, or without a material in two groups.
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


def score_unseen_materials(samples: Samples, model: str) -> dict[str, float]:
    """Return the share of each material's patches that are called unknown if it is left out of the training data.

    The other materials are learnt from other scans than the judged one, as always.
    """
    out = {}
    for name in np.unique(samples.names):
        missed = []
        for train, test in splits(samples):
            others = train[samples.names[train] != name]
            fitted = MODELS[model]("H+V+P")
            fitted.fit(samples.take(others))
            for group in np.unique(samples.groups[test]):
                at = test[samples.groups[test] == group]
                found = fitted.by_scan(samples.x[at], samples.patches[at])
                mine = np.unique(samples.patches[at][samples.names[at] == name])
                missed += list(found.distance[np.searchsorted(found.patches, mine)] > 1)
        out[str(name)] = float(np.mean(missed))
    return out


def fit_library(library: Library) -> Library:
    """Return the library with its fit, for each incidence angle and for all together.

    Raises DataError with fewer than two scans of an angle: a split by pixel would be too optimistic.
    """
    samples = {f"{angle:g}": Samples.of(library.at(angle), PIXELS) for angle in library.angles_deg}
    fits = {angle: fit_samples(of) for angle, of in samples.items()}
    if len(samples) > 1:
        fits["+".join(samples)] = fit_samples(reduce(Samples.joined, samples.values()))
    return Library(library.entries, {"angles": fits}, library.note)


def fit_samples(samples: Samples) -> dict[str, Any]:
    """Return model and scores on labelled pixels, as plain values for a library's file.

    The scores are of materials in two or more scans; `not_judged` lists the others.
    """
    scores = {model: score(samples, model) for model in MODELS}
    weighted, own = fit_weights(samples), scores[DISCRIMINANT]
    judged = {s.model: {"pixels": s.pixels, "patches": s.patches} for s in scores.values()}
    for name in (DISCRIMINANT, PAPER):
        judged[name]["pixels_split_by_pixel"] = score(samples, name, by_pixel=True).pixels
    return {
        "model": DISCRIMINANT,
        "weights": weighted.weights.to_dict(),
        "thresholds": weighted.thresholds,
        "by_channel": weighted.by_channel,
        "split": own.split,
        "pixel_accuracy": own.pixels,
        "patch_accuracy": own.patches,
        "known_called_unknown": own.unknown,
        "pixel_accuracy_in_scan": own.in_scan,
        "calibration_error": own.calibration,
        "judged": judged,
        "materials": len(own.names),
        "not_judged": list(own.not_judged),
    }


@dataclass(frozen=True)
class TrainingScan:
    """One processed scan for training.

    Attributes
    ----------
    scan
        Its name; training and test data are split by it.
    result
        Result of :func:`polysight.materials.analyse`, made with the truth's plates.
    simulated
        True if it was simulated.
    seed
        Seed of the simulated placement, if any.
    versions
        Versions of the programs that made it.
    names
        Patch number to name, if drawn by hand instead of matched to a truth.
    specimens
        Patch number to physical piece, if known.
    """

    scan: str
    result: MaterialsResult
    simulated: bool
    seed: int | None = None
    versions: Mapping[str, str] | None = None
    names: Mapping[int, str] | None = None
    specimens: Mapping[int, str] | None = None


def entries_of(scan: TrainingScan) -> list[Entry]:
    """Return the library entries of one scan: each patch of known material, with up to `PIXELS` interior pixels.

    Pixels are taken at even intervals, so that the same scan always gives the same entries.
    """
    out = []
    r = scan.result
    for patch in r.patches:
        name = (scan.names or {}).get(patch.patch.label) or (patch.truth.name if patch.truth else None)
        rows, cols = np.nonzero(patch.patch.interior & np.isfinite(r.p) & (r.p != 0))
        if name is None or rows.size == 0:
            continue
        pick = np.unique(np.linspace(0, rows.size - 1, min(PIXELS, rows.size)).round().astype(int))
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


def make_library(scans: Iterable[TrainingScan], note: str = "") -> Library:
    """Make a library of several scans, with its fit.

    Raises DataError with no patch of known material, or fewer than two scans with one.
    """
    entries = [e for scan in scans for e in entries_of(scan)]
    if not entries:
        raise DataError(
            "no patch of known material in these scans",
            "they have no truth.json or labels, or no patch matches them by position",
            "label the patches: polysight label SCAN",
            code=ErrorCode.NO_DATA,
        )
    return fit_library(Library(tuple(entries), {}, note))
