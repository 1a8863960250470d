"""Write the products of a scan: image.npz, quality.json, materials.json, labels.json, report.html, figures/."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from polysight.imaging import Images, PlaneEstimate
from polysight.materials import (
    PATCHES,
    UNKNOWN,
    Classifier,
    MaterialsResult,
    TruthPlate,
    expected_pixel_accuracy,
    labels_of,
    pack_labels,
    pack_patches,
    pixel_accuracy,
)
from polysight.polarimetry import with_ratio
from polysight.process.judge import error_budget, recording_verdict
from polysight.process.quality import Quality
from polysight.products import (
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    rx_gains,
    write_atomically,
    write_image,
    write_json,
    write_scan_facts,
)
from polysight.results import NoResult, Verdict, verdict_of
from polysight.store import Scan, versions
from polysight_shared.config import Instrument
from polysight_shared.geometry import incidence_deg
from polysight_shared.tables import to_builtins

if TYPE_CHECKING:  # imported where it is used: matplotlib takes a second to load
    from polysight.report import ReportContext

Progress = Callable[[str], None]
"""Progress callback: gets the name of the next step."""
NOT_ON_HARDWARE = "Nothing of this instrument has run on hardware yet."


def no_progress(_: str) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Products:
    """Folder of the products, their summary lines and the verdict."""

    folder: Path
    lines: tuple[str, ...]
    verdict: Verdict

    @property
    def exit_status(self) -> int:
        """Exit status of the command: 0, or that of `NoResult` if the verdict allows no result."""
        return 0 if self.verdict.usable else NoResult.exit_status

    def summary(self) -> str:
        """Return the text for the terminal."""
        return "".join(
            f"{line}\n"
            for line in (*self.lines, f"report:   {self.folder / 'report.html'}", f"products: {self.folder}/")
        )


@dataclass(frozen=True)
class Findings:
    """Results of processing a scan.

    Attributes
    ----------
    images
        Both channels, valid where they were analysed.
    found
        Patches and their materials; without names and permittivities if the verdict is "no result".
    verdict
        How far the results can be trusted.
    plane
        Plane of the plates.
    classifier
        The classifier that named the patches; None without naming.
    plates
        True plates, if known.
    """

    images: Images
    found: MaterialsResult
    verdict: Verdict
    plane: PlaneEstimate
    classifier: Classifier | None = None
    plates: tuple[TruthPlate, ...] = ()

    @property
    def calibrated(self) -> Images:
        """Images relative to metal, without leakage, with the ratio p and its standard deviation."""
        valid = self.images.valid
        return replace(self.found.calibrated, valid=valid, p_sigma=self.found.p_sigma(valid))


def save_images(
    out: Path, scan: Scan, rig: Instrument, images: Images, quality: Quality, backlash: bool = True
) -> None:
    """Write image.npz without metal reference (p is h / v in arbitrary units), scan.json and quality.json.

    `rig` is the rig that the images were formed with; `backlash=False` leaves the backlash out of quality.json.
    """
    write_image(out / IMAGE, with_ratio(images))
    write_scan_facts(out, scan, rig, images)
    write_json(out / QUALITY, quality_content(quality, backlash))


def quality_content(quality: Quality, backlash: bool = True) -> dict[str, Any]:
    """Return the content of quality.json for images without materials."""
    return quality.to_dict(backlash, verdict=verdict_of(recording_verdict(quality)).to_dict())


def save_materials(
    out: Path, scan: Scan, rig: Instrument, findings: Findings, unnamed: str, quality: Quality
) -> Products:
    """Write all products: metal-referenced image.npz, quality.json, materials.json, patches, labels, figures, report.

    `unnamed` is the reason why nothing was named; "" if patches were named.
    """
    from polysight.report import write_report

    found, images = findings.found, findings.images
    accuracy = pixel_accuracy(found)
    numbers = quality.to_dict(verdict=findings.verdict.to_dict(), pixel_accuracy=accuracy)
    write_image(out / IMAGE, findings.calibrated)
    write_json(out / QUALITY, numbers)
    boxes = labels_of(found, f"patches of scan {scan.scan_id}, in pixels of image.npz")
    write_atomically(out / LABELS, pack_labels(boxes))
    write_atomically(out / PATCHES, pack_patches(found, images.x_m, images.y_m, scan.simulated))
    content = materials_content(scan, findings, unnamed)
    write_json(out / MATERIALS, content)
    write_report(
        out, _report_context(scan, rig, findings, numbers, content["library"], unnamed, quality.coverage().damage)
    )
    lines = (
        *findings.verdict.lines(3),
        *_result_lines(scan, found, content["segments"]),
        *quality.coverage().lines(),
    )
    return Products(out, (*lines, unnamed) if unnamed else lines, findings.verdict)


def materials_content(scan: Scan, findings: Findings, unnamed: str = "") -> dict[str, Any]:
    """Return the content of materials.json; `unnamed` is the reason why there is no classifier."""
    from polysight.report import classifier_sentence

    found, classifier = findings.found, findings.classifier
    return {
        "scan_id": scan.scan_id,
        "simulated": scan.simulated,
        "verdict": findings.verdict.to_dict(),
        "error_budget": error_budget(found, findings.plane),
        "metal_reference": {"how": found.metal.how, "certain": found.metal.certain},
        "library": classifier_sentence(classifier) if classifier else unnamed or "Nothing was named.",
        "model": classifier.model if classifier else None,
        "pixel_accuracy": pixel_accuracy(found),
        "segments": found.rows(),
    }


def _report_context(
    scan: Scan, rig: Instrument, findings: Findings, quality: dict[str, Any], named_by: str, unnamed: str, damage: str
) -> ReportContext:
    from polysight.report import context_of

    images = findings.images
    return context_of(
        findings.found,
        images.x_m,
        images.y_m,
        title=f"Scan {scan.scan_id}",
        simulated=scan.simulated,
        valid=images.valid,
        plates=findings.plates,
        library_note=named_by,
        quality=quality,
        config=_config_summary(rig),
        provenance={
            "scan": scan.scan_id,
            "processed": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
            **versions(),
        },
        notes=[note for note in (damage, NOT_ON_HARDWARE, unnamed) if note],
        plan=scan.plan,
        rx_gains=rx_gains(images),
        rig_file=tomli_w.dumps(to_builtins(rig)),
    )


def _config_summary(rig: Instrument) -> dict[str, Any]:
    h, _ = rig.receivers
    c, leak = rig.chirp, rig.polarimetry
    return {
        "rig": rig.name,
        "incidence": f"{incidence_deg(rig, h):.1f} degrees",
        "chirp": f"{c.first_sample_hz / 1e9:.3f} GHz + {c.swept_hz / 1e9:.3f} GHz in {c.samples} samples",
        "grid": f"{rig.grid.columns} x {rig.grid.rows} positions, {rig.grid.step_x_mm:g} x {rig.grid.step_y_mm:g} mm",
        "burst": f"{rig.burst}, stage at {rig.stage.speed_mm_s:g} mm/s",
        "leakage": "not measured"
        if leak.leakage_std is None
        else f"H {complex(*leak.leakage_h):.3g}, V {complex(*leak.leakage_v):.3g}, +- {leak.leakage_std:g} (rig file)",
    }


def _result_lines(scan: Scan, found: MaterialsResult, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return lines for the terminal: number of patches, metal reference, and names compared with the truth."""
    head = f"{'simulated ' if scan.simulated else ''}scan {scan.scan_id}: {len(rows)} patches; metal {found.metal.how}"
    known = [r for r in rows if r["truth"] is not None and r["name"] is not None and not r["metal_reference"]]
    if not known:
        return (head,)
    foreign = [r for r in known if r["name"] == UNKNOWN and not r["truth"]["in_library"]]  # neither right nor wrong
    known = [r for r in known if r not in foreign]
    right = sum(r["name"] == r["truth"]["name"] for r in known)
    accuracy, expected = pixel_accuracy(found), expected_pixel_accuracy(found)
    share = "" if accuracy is None else f", {100 * accuracy:.1f} % of their pixels"
    if share and expected is not None:
        share += f" (their own confidence expects {100 * expected:.1f} %)"
    aside = f"{len(foreign)} not in the library, and called unknown" if foreign else ""
    named = f"{right} of {len(known)} plates named right{share}" if known else ""
    return head, "; ".join(part for part in (named, aside) if part)
