"""A report's context from what the materials stage found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials import Classifier, MaterialsResult, TruthPlate, pixel_accuracy
from polysight.host.report.context import ReportContext


def context_of(
    result: MaterialsResult,
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    *,
    title: str,
    simulated: bool,
    valid: npt.NDArray[np.bool_] | None = None,
    plates: Sequence[TruthPlate] = (),
    named_by: str = "",
    quality: dict[str, Any] | None = None,
    config: dict[str, Any] | None = None,
    provenance: dict[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> ReportContext:
    """Everything a report shows of a :class:`polysight.host.materials.MaterialsResult`; the rest is passed on as it is."""
    return ReportContext(
        title=title,
        simulated=simulated,
        x_m=x_m,
        y_m=y_m,
        h=result.calibrated.h,
        v=result.calibrated.v,
        p=result.calibrated.p,
        valid=valid,
        materials=result.rows(),
        segments=result.segmentation.labels,
        pixel_names={r.patch.label: (r.names, r.patch.interior) for r in result.patches if r.names is not None},
        truth=[{"name": t.name, "box_mm": t.box_mm, "permittivity": t.permittivity} for t in plates] or None,
        metal_how=result.metal.how,
        pixel_accuracy=pixel_accuracy(result),
        library_note=named_by,
        quality=quality or {},
        config=config or {},
        provenance=provenance or {},
        notes=list(notes),
    )


def classifier_sentence(classifier: Classifier) -> str:
    """What names, how it was chosen, and how well it names scans it has not seen."""
    library, fit = classifier.library, classifier.fit
    kind = "simulated " if library.simulated else ""
    angles = " and ".join(f"{a:g}" for a in classifier.angles_deg)
    out = f"{classifier.model} on |H|, |V| and complex P"
    judged = fit.get("judged", {}).get(classifier.model)
    if judged:
        chosen = fit.get("model") == classifier.model
        out += f", {'chosen' if chosen else 'asked for; not the one chosen'} by leaving whole scans out"
        if chosen and len(fit["judged"]) > 1:
            out += f" (the best of {len(fit['judged'])} models on the same split, so its figures flatter slightly)"
    out += f"; library of {len(library.names)} materials from {len(library.scans)} {kind}scans, {angles} degrees."
    if judged:
        out += (
            f" On scans left out of the library it names {100 * judged['pixels']:.1f} % of the pixels and "
            f"{100 * judged['patches']:.1f} % of the patches right"
        )
        if "pixels_split_by_pixel" in judged:
            out += f" (split by pixel, which is optimistic: {100 * judged['pixels_split_by_pixel']:.1f} %)"
        channel = fit.get("by_channel", {})
        if {"h", "v", "p"} <= set(channel):
            alone = ", ".join(f"{k.upper()} {100 * channel[k]:.0f} %" for k in "hvp")
            out += f"; the KNN by one channel alone: {alone}"
        out += "."
        if missing := fit.get("not_judged"):
            out += (
                f" Of its {fit['materials']} materials {len(missing)} could not be judged, because one scan alone holds"
                f" them: {', '.join(missing)}."
            )
    return f"{out} {library.note}".strip()
