"""What a processed scan leaves behind: image.npz, quality.json, materials.json, labels.json, report.html, figures/."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from polysight.host.imaging import ChannelImages, PlaneEstimate
from polysight.host.materials import (
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
from polysight.host.polarimetry import ratio
from polysight.host.process.judge import error_budget, recording_verdict
from polysight.host.process.quality import Quality
from polysight.host.products import (
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
from polysight.host.store import Scan, versions
from polysight.host.verdict import NoResult, Verdict, verdict_of
from polysight.shared.config import Instrument
from polysight.shared.geometry import incidence_deg
from polysight.shared.raster import RasterPlan
from polysight.shared.tables import to_builtins

if TYPE_CHECKING:  # it draws, and is loaded where something is written: matplotlib takes a second
    from polysight.host.report import ReportContext

Tell = Callable[[str], None]
"""Called with what is done next, in a word or two."""
NOT_ON_HARDWARE = "Nothing of this instrument has run on hardware yet."


def untold(_: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Products:
    """Where the products are, and what they say in short."""

    folder: Path
    lines: tuple[str, ...]
    verdict: Verdict

    @property
    def exit_status(self) -> int:
        """0; without a result that of `NoResult`."""
        return 0 if self.verdict.usable else NoResult.exit_status

    def summary(self) -> str:
        """Text for the terminal."""
        return "".join(
            f"{line}\n"
            for line in (*self.lines, f"report:   {self.folder / 'report.html'}", f"products: {self.folder}/")
        )


@dataclass(frozen=True)
class Findings:
    """What is saved of a processed scan.

    Attributes
    ----------
    images
        Both channels, valid where they were analysed.
    found
        Patches, and what they are; nothing is said of them without a result.
    verdict
        How far all of it may be trusted.
    plane
        Where the plates lie.
    classifier
        What named them, if anything did.
    plates
        The truth, where known.
    """

    images: ChannelImages
    found: MaterialsResult
    verdict: Verdict
    plane: PlaneEstimate
    classifier: Classifier | None = None
    plates: tuple[TruthPlate, ...] = ()


def save_images(
    out: Path, scan: Scan, rig: Instrument, images: ChannelImages, quality: Quality, backlash: bool = True
) -> None:
    """image.npz before any metal reference is known (p is h / v in arbitrary units), scan.json, quality.json.

    `rig` is the one the images were made with; without `backlash` quality.json says nothing of it yet.
    """
    p = ratio(images.h, images.v)
    write_image(out / IMAGE, images.h, images.v, p, images.x_m, images.y_m, images.valid)
    write_scan_facts(out, scan, rig, images)
    write_json(out / QUALITY, quality_content(quality, backlash))


def quality_content(quality: Quality, backlash: bool = True) -> dict[str, Any]:
    """Content of quality.json of images in which no material was looked for."""
    return quality.to_dict(backlash, verdict=verdict_of(recording_verdict(quality)).to_dict())


def save_materials(
    out: Path, scan: Scan, rig: Instrument, findings: Findings, unnamed: str, quality: Quality
) -> Products:
    """The metal-referenced image.npz, quality.json, materials.json, patches, labels, figures and report.

    `unnamed` says why nothing was named; empty where it was.
    """
    from polysight.host.report import write_report

    found, images, c = findings.found, findings.images, findings.found.calibrated
    accuracy = pixel_accuracy(found)
    numbers = quality.to_dict(verdict=findings.verdict.to_dict(), pixel_accuracy=accuracy)
    sigma = found.p_sigma(images.valid)
    write_image(out / IMAGE, c.h, c.v, c.p, images.x_m, images.y_m, images.valid, sigma)
    write_json(out / QUALITY, numbers)
    boxes = labels_of(found, f"patches of scan {scan.scan_id}, in pixels of image.npz")
    write_atomically(out / LABELS, pack_labels(boxes))
    write_atomically(out / PATCHES, pack_patches(found, images.x_m, images.y_m, scan.simulated))
    content = materials_content(scan, findings, unnamed)
    write_json(out / MATERIALS, content)
    write_report(out, _report_context(scan, rig, findings, numbers, (content["library"], unnamed)))
    lines = (
        *findings.verdict.lines(3),
        *_lines(scan, found, content["segments"]),
        *coverage_lines(numbers["coverage"]),
    )
    return Products(out, (*lines, unnamed) if unnamed else lines, findings.verdict)


def coverage_lines(coverage: dict[str, Any]) -> tuple[str, ...]:
    """For the terminal: what was recorded of the plan, and what is wrong with the manifest."""
    from polysight.host.report import manifest_sentence, recorded_sentence

    damaged = manifest_sentence(coverage)
    return (recorded_sentence(coverage), damaged) if damaged else (recorded_sentence(coverage),)


def materials_content(scan: Scan, findings: Findings, unnamed: str = "") -> dict[str, Any]:
    """Content of materials.json; `unnamed` says why there is no classifier."""
    from polysight.host.report import classifier_sentence

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
    scan: Scan, rig: Instrument, findings: Findings, quality: dict[str, Any], naming: tuple[str, str]
) -> ReportContext:
    from polysight.host.report import context_of, manifest_sentence

    images, (named_by, unnamed) = findings.images, naming
    context = context_of(
        findings.found,
        images.x_m,
        images.y_m,
        title=f"Scan {scan.scan_id}",
        simulated=scan.simulated,
        valid=images.valid,
        plates=findings.plates,
        named_by=named_by,
        quality=quality,
        config=_config_summary(rig),
        provenance={
            "scan": scan.scan_id,
            "processed": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
            **versions(),
        },
        notes=[note for note in (manifest_sentence(quality["coverage"]), NOT_ON_HARDWARE, unnamed) if note],
    )
    return _with_scan(context, scan.plan, rig, images)


def _with_scan(ctx: ReportContext, plan: RasterPlan, rig: Instrument, images: ChannelImages) -> ReportContext:
    """A report's context with what it says of the scan itself: where its positions were, gains, the whole rig file."""
    return replace(ctx, plan=plan, rx_gains=rx_gains(images), rig_file=tomli_w.dumps(to_builtins(rig)))


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


def _lines(scan: Scan, found: MaterialsResult, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    head = f"{'simulated ' if scan.simulated else ''}scan {scan.scan_id}: {len(rows)} patches; metal {found.metal.how}"
    known = [r for r in rows if r["truth"] is not None and r["name"] is not None and not r["metal_reference"]]
    if not known:
        return (head,)
    strange = [r for r in known if r["name"] == UNKNOWN and not r["truth"]["in_library"]]  # neither right nor wrong
    known = [r for r in known if r not in strange]
    right = sum(r["name"] == r["truth"]["name"] for r in known)
    accuracy, expected = pixel_accuracy(found), expected_pixel_accuracy(found)
    share = "" if accuracy is None else f", {100 * accuracy:.1f} % of their pixels"
    if share and expected is not None:
        share += f" (their own confidence expects {100 * expected:.1f} %)"
    aside = f"{len(strange)} not in the library, and called unknown" if strange else ""
    named = f"{right} of {len(known)} plates named right{share}" if known else ""
    return head, "; ".join(part for part in (named, aside) if part)
