"""Content of a report as plain arrays and dicts, independent of how they were computed.

`context_of` fills it from the result of a scan, `ReportContext.of_products` from saved products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials import Classifier, MaterialsResult, TruthPlate, expected_pixel_accuracy, pixel_accuracy
from polysight.products import SavedProducts, withhold
from polysight.results import Verdict, read_verdict
from polysight_shared.raster import RasterPlan

Image = npt.NDArray[np.complexfloating]
Labels = npt.NDArray[np.int32]


@dataclass(frozen=True)
class ReportContext:
    """Everything a report shows; fields that are None or empty are left out of the report.

    Attributes
    ----------
    title
        Heading, the scan's or scene's name.
    simulated
        If true, the page, every figure and every table are stamped SIMULATED.
    x_m, y_m
        Pixel centres, rig frame, metres, [nx] and [ny]. Figures show millimetres from the image centre.
    h, v, p
        complex [ny, nx]: the two channels and their metal-referenced ratio.
    valid
        bool [ny, nx]; invalid pixels are drawn grey.
    metal_referenced
        True if h, v, p are relative to metal (0 dB = metal), else they have arbitrary units.
    materials
        Rows as `polysight.materials.MaterialsResult.rows` makes them, in the order of their labels.
    segments
        int32 [ny, nx], 0 = nothing, else the row's label.
    pixel_names
        Row label to (names str [n] of the interior's pixels in image order, interior bool [ny, nx]); may be empty.
    truth
        True plates: dicts with name, box_mm (x0, y0, x1, y1 from the image centre), permittivity (complex or None for
        metal). None if unknown.
    metal_how
        One sentence: which patch is the metal reference and how it was chosen.
    pixel_accuracy
        Share of interior pixels named right; None without truth.
    expected_accuracy
        Share that the best classifier is expected to reach on the same pixels, by their own probabilities.
    library_note
        Origin of the classifier's library, and its score on scans left out.
    quality
        Content of quality.json. Known keys: `boards` {name: {frames_expected, frames_received, ...,
        synchronisation: {stage: {quantity: std}}}} and `seconds_per_stage` {stage: s}. Other keys are listed
        unchanged.
    config
        Short summary, key to text or number, in the order to show.
    provenance
        Scan id, times, versions; key to text.
    notes
        Sentences shown at the top.
    plan
        Raster of the scan; with `masked_columns` of `quality` it gives the map of masked positions.
    rx_gains
        Board to gain_db and phase_deg of each RX against the first, which were divided out.
    rig_file
        The rig file as text.
    verdict
        Level of trust and its reasons; default: that of `quality`, if it has one. With the level `none` the context
        drops all names, permittivities and truth, so that nothing can show them.
    error_budget
        `error_budget` of materials.json: leakage, plane, angle and metal.
    """

    title: str
    simulated: bool
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]
    h: Image
    v: Image
    p: Image
    valid: npt.NDArray[np.bool_] | None = None
    metal_referenced: bool = True
    materials: list[dict[str, Any]] = field(default_factory=list)
    segments: Labels | None = None
    pixel_names: dict[int, tuple[npt.NDArray[np.str_], npt.NDArray[np.bool_]]] = field(default_factory=dict)
    truth: list[dict[str, Any]] | None = None
    metal_how: str = ""
    pixel_accuracy: float | None = None
    expected_accuracy: float | None = None
    library_note: str = ""
    quality: dict[str, Any] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    plan: RasterPlan | None = None
    rx_gains: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    rig_file: str = ""
    verdict: Verdict | None = None
    error_budget: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        verdict = self.verdict or read_verdict(self.quality)
        object.__setattr__(self, "verdict", verdict)
        if verdict is None or verdict.usable:
            return
        bare = withhold({"verdict": verdict.to_dict(), "segments": self.materials})["segments"]
        nothing: dict[str, Any] = {
            "materials": [{**row, "metal_reference": False} for row in bare],
            "quality": _without_results(self.quality),
            **{"pixel_names": {}, "truth": None, "pixel_accuracy": None, "expected_accuracy": None},
            **{"library_note": "", "metal_how": ""},
        }
        for name, value in nothing.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of_products(cls, products: SavedProducts, segments: Labels | None = None) -> ReportContext:
        """Return a context with the images and patches of saved products; unknown origin counts as simulated."""
        return cls(
            title=products.scan_id,
            simulated=products.simulated is not False,
            x_m=products.x_m,
            y_m=products.y_m,
            h=products.h,
            v=products.v,
            p=products.p,
            valid=products.valid,
            metal_referenced=products.metal_referenced,
            materials=products.segments,
            segments=segments,
            verdict=products.verdict,
        )

    @property
    def judged(self) -> bool:
        """False if the verdict is `none`: names and permittivities are withheld."""
        return self.verdict is None or self.verdict.usable

    def with_products(self, folder: Path) -> ReportContext:
        """Return a copy with patches, verdict and error budget of the folder's materials.json, if there is one."""
        saved = SavedProducts(folder)
        if not saved.materials:
            return self
        budget = saved.materials.get("error_budget") or self.error_budget
        return replace(self, materials=saved.segments, verdict=saved.verdict or self.verdict, error_budget=budget)


def _without_results(quality: dict[str, Any]) -> dict[str, Any]:
    """Return the content of quality.json without names and permittivities."""
    out = {k: v for k, v in quality.items() if k != "pixel_accuracy"}
    if isinstance(out.get("incidence"), dict):
        out["incidence"] = {k: v for k, v in out["incidence"].items() if "permittivity" not in k}
    return out


def context_of(
    result: MaterialsResult,
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    plates: Sequence[TruthPlate] = (),
    **fields: Any,
) -> ReportContext:
    """Return the context of a :class:`polysight.materials.MaterialsResult`.

    `plates` are the true ones, if known; `fields` are the remaining attributes of :class:`ReportContext`.
    """
    return ReportContext(
        x_m=x_m,
        y_m=y_m,
        h=result.calibrated.h,
        v=result.calibrated.v,
        p=np.asarray(result.calibrated.p),
        materials=result.rows(),
        segments=result.segmentation.labels,
        pixel_names={r.patch.label: (r.names, r.patch.interior) for r in result.patches if r.names is not None},
        truth=[{"name": t.name, "box_mm": t.box_mm, "permittivity": t.permittivity} for t in plates] or None,
        metal_how=result.metal.how,
        pixel_accuracy=pixel_accuracy(result),
        expected_accuracy=expected_pixel_accuracy(result),
        **fields,
    )


def classifier_sentence(classifier: Classifier) -> str:
    """Describe a classifier, its library, and its score on scans left out of training."""
    library, fit = classifier.library, classifier.fit
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
            alone = ", ".join(f"{k.upper()} {100 * channel[k]:.0f} %" for k in "hvp")
            out += f"; the KNN by one channel alone: {alone}"
        out += "."
        if missing := fit.get("not_judged"):
            out += (
                f" Of its {fit['materials']} materials {len(missing)} could not be judged, because only one scan has"
                f" them: {', '.join(missing)}."
            )
    return f"{out} {library.note}".strip()
