"""Collect the result of processing as one value, a `ProcessedScan`, and write it to files.

`collect_processed_scan` and `save_materials` do so for a scan with materials, `collect_imaged_scan` and `save_images`
for a scan of which only images were made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from polysight import products
from polysight.imaging import Images, PlaneEstimate
from polysight.materials import (
    PATCHES_FILE,
    Classifier,
    MaterialsResult,
    TruthPlate,
    describe_classifier,
    make_labels,
    pack_labels,
    pack_patches,
    pixel_accuracy,
    predict_pixel_accuracy,
)
from polysight.polarimetry import with_ratio
from polysight.process.judge import error_budget, recording_verdict
from polysight.process.quality import Quality
from polysight.results import MetalSource, NoResult, ScanFacts, ScanMaterials, ScanQuality, Verdict, join_reasons
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
        if self.verdict.usable:
            return 0
        return NoResult.exit_status

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
        Images of both channels; a pixel is valid if it was analysed.
    analysis
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
    analysis: MaterialsResult
    verdict: Verdict
    plane: PlaneEstimate
    classifier: Classifier | None = None
    plates: tuple[TruthPlate, ...] = ()

    @property
    def calibrated(self) -> Images:
        """Images relative to metal, without leakage, with the ratio p and its standard deviation."""
        valid = self.images.valid
        return replace(self.analysis.calibrated, valid=valid, p_sigma=self.analysis.p_sigma(valid))


def collect_imaged_scan(
    folder: Path, source: Scan, rig: Instrument, images: Images, quality: Quality, backlash: bool = True
) -> products.ProcessedScan:
    """Return the result of a scan of which only images were made; p is h / v in arbitrary units.

    `rig` is the rig that the images were formed with, `folder` the folder of the data. With `backlash=False` the
    stage's backlash is not estimated.
    """
    verdict = join_reasons(recording_verdict(quality))
    return products.ProcessedScan.from_results(
        folder,
        images=with_ratio(images),
        quality=quality.result(verdict, backlash=backlash),
        facts=_collect_facts(source, rig, images),
        plan=source.plan,
    )


def collect_processed_scan(
    folder: Path, source: Scan, rig: Instrument, findings: Findings, quality: Quality, unnamed: str
) -> products.ProcessedScan:
    """Return the result of a scan with its materials; `unnamed` is the reason why nothing was named, or ""."""
    return assemble_result(
        folder,
        facts=_collect_facts(source, rig, findings.images),
        quality=quality.result(findings.verdict, pixel_accuracy(findings.analysis)),
        findings=findings,
        unnamed=unnamed,
        plan=source.plan,
    )


def assemble_result(
    folder: Path,
    facts: ScanFacts,
    quality: ScanQuality,
    findings: Findings,
    unnamed: str,
    plan: RasterPlan | None = None,
) -> products.ProcessedScan:
    """Return the result with its materials, from findings; `unnamed` is that of :func:`collect_processed_scan`.

    `plan` is the raster of the scan; None if images of another program were processed.
    """
    analysis = findings.analysis
    library = unnamed or "Nothing was named."
    model = None
    if findings.classifier is not None:
        library = describe_classifier(findings.classifier)
        model = findings.classifier.model
    materials = ScanMaterials(
        scan_id=facts.scan_id or "",
        simulated=facts.simulated,
        verdict=findings.verdict,
        error_budget=error_budget(analysis, findings.plane),
        metal_reference=MetalSource(how=analysis.metal.how, certain=analysis.metal.certain),
        library=library,
        model=model,
        pixel_accuracy=pixel_accuracy(analysis),
        segments=analysis.rows(),
    )
    return products.ProcessedScan.from_results(
        folder,
        images=findings.calibrated,
        quality=quality,
        facts=facts,
        materials=materials,
        analysis=analysis,
        plates=findings.plates,
        plan=plan,
    )


def _collect_facts(source: Scan, rig: Instrument, images: Images) -> ScanFacts:
    """Return the content of scan.json, dated now."""
    return ScanFacts(
        scan_id=source.scan_id,
        simulated=source.simulated,
        processed_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
        rx_gains=products.rx_gains(images),
        instrument=to_builtins(rig),
    )


def save_images(out: Path, scan: products.ProcessedScan) -> None:
    """Write image.npz, scan.json and quality.json."""
    products.write_image(out / products.IMAGE, scan.images, simulated=bool(scan.simulated))
    products.write_json(out / products.SCAN, scan.facts)
    products.write_json(out / products.QUALITY, scan.quality)


def save_materials(out: Path, scan: products.ProcessedScan, result: MaterialsResult, unnamed: str) -> Products:
    """Write all products: metal-referenced image.npz, scan, quality and materials as JSON, patches, labels, report.

    `result` is the analysis behind the scan, `unnamed` the reason why nothing was named; "" if patches were named.
    """
    # Imported here: matplotlib takes a second to load.
    from polysight.report import write_report

    save_images(out, scan)
    boxes = make_labels(result, f"patches of scan {scan.scan_id}, in pixels of image.npz")
    write_atomically(out / products.LABELS, pack_labels(boxes))
    # `stamped` is true if the scan is simulated, and if it is not known whether it is.
    write_atomically(out / PATCHES_FILE, pack_patches(result, scan.images.x_m, scan.images.y_m, scan.stamped))
    products.write_json(out / products.MATERIALS, scan.materials)
    write_report(out, scan)
    verdict = scan.verdict or Verdict("good")
    # The terminal shows three reasons, the report all of them.
    lines = [*verdict.lines(max_reasons=3), *_summarise_result(scan, result)]
    if scan.quality.coverage:
        lines += scan.quality.coverage.lines()
    if unnamed:
        lines.append(unnamed)
    return Products(out, tuple(lines), verdict)


def _summarise_result(scan: products.ProcessedScan, result: MaterialsResult) -> tuple[str, ...]:
    """Return lines for the terminal: number of patches, metal reference, and names compared with the truth."""
    patches = scan.segments
    head = f"scan {scan.scan_id}: {len(patches)} patches; metal {result.metal.how}"
    if scan.simulated:
        head = f"simulated {head}"
    count = scan.named_plates
    if count is None:
        return (head,)
    names = f"{count.right} of {count.plates} plates named right{_describe_accuracy(result)}"
    if count.strange:
        names += f"; {count.strange} not in the library, and called unknown"
    return (head, names)


def _describe_accuracy(result: MaterialsResult) -> str:
    """Return the end of a sentence on the correct pixels of a simulated scene; "" if the truth is unknown."""
    accuracy = pixel_accuracy(result)
    expected = predict_pixel_accuracy(result)
    if accuracy is None:
        return ""
    share = f", {100 * accuracy:.1f} % of their pixels"
    if expected is None:
        return share
    return f"{share} (their own confidence expects {100 * expected:.1f} %)"
