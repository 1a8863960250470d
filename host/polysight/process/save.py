"""The result of processing as one typed value, and its files: `processed_scan` makes it, `save_materials` writes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from polysight.imaging import Images, PlaneEstimate
from polysight.materials import (
    PATCHES,
    Classifier,
    MaterialsResult,
    TruthPlate,
    classifier_sentence,
    expected_pixel_accuracy,
    labels_of,
    pack_labels,
    pack_patches,
    pixel_accuracy,
)
from polysight.polarimetry import with_ratio
from polysight.process.quality import Quality, error_budget, recording_verdict
from polysight.products import (
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    SCAN,
    ProcessedScan,
    rx_gains,
    write_image,
    write_json,
)
from polysight.results import MetalSource, NoResult, ScanFacts, ScanMaterials, ScanQuality, Verdict, verdict_of
from polysight.store import Scan, versions
from polysight_shared.config import Instrument
from polysight_shared.files import write_atomically
from polysight_shared.raster import RasterPlan
from polysight_shared.tables import to_builtins

Progress = Callable[[str], None]
"""Progress callback: gets the name of the next step."""


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
        lines = (*self.lines, f"report:   {self.folder / 'report.html'}", f"products: {self.folder}/")
        return "".join(f"{line}\n" for line in lines)


@dataclass(frozen=True)
class Findings:
    """Results of the analysis of a scan.

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


def imaged_scan(
    folder: Path, source: Scan, rig: Instrument, images: Images, quality: Quality, backlash: bool = True
) -> ProcessedScan:
    """Return the result of a scan of which only images were made; p is h / v in arbitrary units.

    `rig` is the rig that the images were formed with, `folder` where the data are. `backlash=False` leaves the
    estimate of the stage's backlash out.
    """
    verdict = verdict_of(recording_verdict(quality))
    return ProcessedScan.computed(
        folder,
        images=with_ratio(images),
        quality=quality.result(verdict, backlash=backlash),
        facts=_facts(source, rig, images),
        plan=source.plan,
    )


def processed_scan(
    folder: Path, source: Scan, rig: Instrument, findings: Findings, quality: Quality, unnamed: str
) -> ProcessedScan:
    """Return the result of a scan with its materials; `unnamed` is the reason why nothing was named, or ""."""
    return materials_of(
        folder,
        _facts(source, rig, findings.images),
        quality.result(findings.verdict, pixel_accuracy(findings.found)),
        findings,
        unnamed,
        source.plan,
    )


def materials_of(
    folder: Path,
    facts: ScanFacts,
    quality: ScanQuality,
    findings: Findings,
    unnamed: str,
    plan: RasterPlan | None = None,
) -> ProcessedScan:
    """Return the result with its materials, from findings; parameters as of :func:`processed_scan`."""
    found, classifier = findings.found, findings.classifier
    materials = ScanMaterials(
        scan_id=facts.scan_id or "",
        simulated=facts.simulated,
        verdict=findings.verdict,
        error_budget=error_budget(found, findings.plane),
        metal_reference=MetalSource(how=found.metal.how, certain=found.metal.certain),
        library=classifier_sentence(classifier) if classifier else unnamed or "Nothing was named.",
        model=classifier.model if classifier else None,
        pixel_accuracy=pixel_accuracy(found),
        segments=found.rows(),
    )
    return ProcessedScan.computed(
        folder,
        images=findings.calibrated,
        quality=quality,
        facts=facts,
        materials=materials,
        found=found,
        plates=findings.plates,
        plan=plan,
    )


def _facts(source: Scan, rig: Instrument, images: Images) -> ScanFacts:
    return ScanFacts(
        scan_id=source.scan_id,
        simulated=source.simulated,
        processed_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
        rx_gains=rx_gains(images),
        instrument=to_builtins(rig),
    )


def save_images(out: Path, scan: ProcessedScan) -> None:
    """Write image.npz, scan.json and quality.json."""
    write_image(out / IMAGE, scan.images)
    write_json(out / SCAN, scan.facts)
    write_json(out / QUALITY, scan.quality)


def save_materials(out: Path, scan: ProcessedScan, found: MaterialsResult, unnamed: str) -> Products:
    """Write all products: metal-referenced image.npz, quality.json, materials.json, patches, labels, figures, report.

    `found` is the analysis behind the result, `unnamed` the reason why nothing was named; "" if patches were named.
    """
    from polysight.report import write_report  # here: matplotlib takes a second to load

    save_images(out, scan)
    boxes = labels_of(found, f"patches of scan {scan.scan_id}, in pixels of image.npz")
    write_atomically(out / LABELS, pack_labels(boxes))
    write_atomically(out / PATCHES, pack_patches(found, scan.images.x_m, scan.images.y_m, scan.stamped))
    write_json(out / MATERIALS, scan.materials)
    write_report(out, scan)
    verdict = scan.verdict or Verdict("good")
    coverage = scan.quality.coverage.lines() if scan.quality.coverage else ()
    lines = (*verdict.lines(3), *_result_lines(scan, found), *coverage)
    return Products(out, (*lines, unnamed) if unnamed else lines, verdict)


def _result_lines(scan: ProcessedScan, found: MaterialsResult) -> tuple[str, ...]:
    """Return lines for the terminal: number of patches, metal reference, and names compared with the truth."""
    patches = scan.segments
    head = (
        f"{'simulated ' if scan.simulated else ''}scan {scan.scan_id}: {len(patches)} patches; metal {found.metal.how}"
    )
    count = scan.plates_named
    if count is None:
        return (head,)
    aside = f"; {count.strange} not in the library, and called unknown" if count.strange else ""
    return (head, f"{count.right} of {count.plates} plates named right{_pixels_right(found)}{aside}")


def _pixels_right(found: MaterialsResult) -> str:
    accuracy, expected = pixel_accuracy(found), expected_pixel_accuracy(found)
    if accuracy is None:
        return ""
    share = f", {100 * accuracy:.1f} % of their pixels"
    return share if expected is None else f"{share} (their own confidence expects {100 * expected:.1f} %)"
