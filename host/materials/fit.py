"""What a library is used with: the model that does best on it with whole scans left out, and how well it does."""

from __future__ import annotations

from functools import reduce
from typing import Any

from polysight.host.materials.judge import best_model, score
from polysight.host.materials.knn import fit_weights
from polysight.host.materials.library import Library
from polysight.host.materials.models import PAPER
from polysight.host.materials.samples import Samples

PIXELS = 16
"""Pixels of a patch that models are judged on."""


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
    model, scores = best_model(samples)
    weighted = fit_weights(samples)
    chosen = next(s for s in scores if s.model == model)
    judged = {s.model: {"pixels": s.pixels, "patches": s.patches} for s in scores}
    for name in {model, PAPER}:
        judged[name]["pixels_split_by_pixel"] = score(samples, name, by_pixel=True).pixels
    return {
        "model": model,
        "weights": weighted.weights.to_dict(),
        "thresholds": weighted.thresholds,
        "by_channel": weighted.by_channel,
        "split": chosen.split,
        "pixel_accuracy": chosen.pixels,
        "patch_accuracy": chosen.patches,
        "known_called_unknown": chosen.unknown,
        "pixel_accuracy_in_scan": chosen.in_scan,
        "judged": judged,
        "materials": len(chosen.names),
        "not_judged": list(chosen.not_judged),
    }
