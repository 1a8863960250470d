"""Advice on a trained library: how often its names are correct, whether it is overconfident, and which scans it needs.

Scores are those of scans left out of training (`train.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from polysight.materials.discriminant import ErrorDiscriminant
from polysight.materials.labels import is_metal
from polysight.materials.library import Library, Samples


def describe_accuracy(library: Library) -> list[str]:
    """Return for each angle how often names are correct on scans left out of training, or why this is not known."""
    lines: list[str] = []
    for angle, fit in library.fit["angles"].items():
        materials_in_one_scan = ", ".join(fit["not_judged"])
        if not fit["judged"]:
            lines.append(
                f"{angle} degrees: accuracy not known: for that a material other than metal has to be in two scans."
                " Scan each material once more, placed again, and train on all scans"
            )
            continue
        lines += _judge_confidence(angle, fit)
        lines.append(
            f"{angle} degrees: on scans left out {100 * fit['pixel_accuracy']:.1f} % of the pixels and"
            f" {100 * fit['patch_accuracy']:.1f} % of the patches are named right ({fit['model']},"
            f" {fit['materials'] - len(fit['not_judged'])} materials)"
            + (f"; not known for materials of one scan: {materials_in_one_scan}" if materials_in_one_scan else "")
        )
    return lines


# Degrees of freedom that are asked for, which are the specimens beyond the first of each material: a standard deviation
# from n degrees of freedom is known to 1 / sqrt(2 n) of itself, 25 % with 8.
FREEDOM_NEEDED = 8
# With fewer scans than this they are the likely cause of overconfidence. Chosen.
FEW_SCANS = 4
LEAST_MISFIT = 0.05
"""Difference between the mean confidence and the share of correct names that is reported, unless it may be chance.
Chosen."""
ALIKE_STD = 2.0
"""Distance of two materials, in standard deviations of a patch, below which one may be named as the other. Chosen."""
# Largest number of pairs of materials that are listed; chosen.
SHOWN_PAIRS = 3


def _judge_confidence(angle: str, fit: Mapping[str, Any]) -> list[str]:
    """Return lines on confidence: whether it is too large or too small, why, and how many specimens are needed.

    Then follow the pairs of materials that lie closest together.
    `fit` is that of one angle (`train.fit_samples`), `angle` its key in the library's fit.
    """
    if fit.get("named") is None:
        # Libraries of earlier releases have no confidence.
        return []
    missing = max(FREEDOM_NEEDED - fit["specimen_freedom"], 0)
    # The spread between specimens is known from materials of which more than one specimen was scanned.
    freedom = fit["specimen_freedom"]
    if freedom == 0:
        spread_text = "how far specimens of a material differ is not known: no second one of any is named"
    elif freedom == 1:
        spread_text = "how far specimens of a material differ is known from one beyond the first"
    else:
        spread_text = f"how far specimens of a material differ is known from {freedom} beyond the first ones"
    need = f"{spread_text}; to know it to 25 %, scan {missing} more"
    need += " (polysight label SCAN --specimen NAME=WHICH names them)"
    lines = []
    # Standard deviation of the share p of correct names among n, sqrt(p (1 - p) / n). A few names may all be correct by
    # chance: p (1 - p) counts as 0.05 at least, its value for 95 %.
    judged_names = max(fit["named"], 1)
    share_std = np.sqrt(max(fit["right"] * (1 - fit["right"]), 0.05) / judged_names)
    mean_confidence = fit["said"]
    misfit = mean_confidence - fit["right"]
    if abs(misfit) > max(2 * share_std, LEAST_MISFIT):
        kind = "overconfident" if misfit > 0 else "underconfident"
        if misfit < 0 and not fit["specimen_freedom"]:
            cause = "no second specimen of a material is named: how specimens differ counts as an error of placement"
        elif misfit < 0:
            cause = "its specimens differ less than published ones, whose spread counts as that of 4 specimens"
        elif fit["scans"] < FEW_SCANS:
            cause = f"the errors of metal reference and placement are known from {fit['scans']} scans only"
        elif missing:
            cause = "specimens left out differ more from those learnt than these from each other"
        else:
            cause = "errors of its scans differ: a scan may be disturbed, or a label may be wrong"
        lines.append(
            f"{angle} degrees: {kind}: names have a mean confidence of {100 * mean_confidence:.0f} %, and "
            f"{100 * fit['right']:.0f} % are right: {cause}"
        )
    if missing:
        lines.append(f"{angle} degrees: {need}")
    for first, second, distance in fit["alike"][:SHOWN_PAIRS]:
        lines.append(
            f"{angle} degrees: {first} and {second} lie {distance:.1f} standard deviations apart: more specimens do not"
            " separate them; a second angle may, or one name for both"
        )
    return lines


def find_alike_pairs(samples: Samples) -> list[tuple[str, str, float]]:
    """Return pairs of materials that a patch hardly distinguishes, and their distance in standard deviations."""
    model = ErrorDiscriminant().fit(samples)
    distances = model.distances()
    pairs = []
    for i, j in zip(*np.triu_indices(len(model.names), 1), strict=True):
        if distances[i, j] < ALIKE_STD:
            pairs.append((str(model.names[i]), str(model.names[j]), round(float(distances[i, j]), 2)))
    return sorted(pairs, key=lambda pair: pair[2])


def count_specimen_freedom(samples: Samples) -> int:
    """Return the number of specimens beyond the first of each material, metals left out."""
    counts = {name: np.unique(samples.plates[samples.names == name]).size for name in np.unique(samples.names)}
    return sum(count - 1 for name, count in counts.items() if not is_metal(str(name)))
