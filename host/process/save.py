"""What a processed scan leaves behind: image.npz, quality.json, materials.json, labels.json, report.html, figures/."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomli_w

from polysight.host.imaging import ChannelImages
from polysight.host.materials import Classifier, MaterialsResult, TruthPlate, pixel_accuracy
from polysight.host.materials.patch_files import PATCHES, labels_of, pack_patches, write_labels
from polysight.host.polarimetry import ratio
from polysight.host.products.files import LABELS, rx_gains, write_atomically
from polysight.host.report import write_image, write_json, write_report
from polysight.host.report.context import ReportContext, classifier_sentence, context_of
from polysight.host.store.scan_folder import versions
from polysight.host.store.sources.source import Scan
from polysight.shared.config import Instrument
from polysight.shared.geometry import incidence_deg
from polysight.shared.raster import RasterPlan
from polysight.shared.tables import to_builtins

NOT_ON_HARDWARE = "Nothing of this instrument has run on hardware yet."


@dataclass(frozen=True)
class Products:
    """Where the products are, and what they say in short."""

    folder: Path
    lines: tuple[str, ...]

    def summary(self) -> str:
        """Text for the terminal."""
        return "".join(
            f"{line}\n"
            for line in (*self.lines, f"report:   {self.folder / 'report.html'}", f"products: {self.folder}/")
        )


def write_images(out: Path, images: ChannelImages) -> None:
    """image.npz before any metal reference is known: p is h / v in arbitrary units."""
    p = ratio(images.h, images.v)
    write_image(out / "image.npz", images.h, images.v, p, images.x_m, images.y_m, images.valid)


def write_quality(out: Path, quality: dict[str, Any]) -> None:
    """quality.json."""
    write_json(out / "quality.json", quality)


def materials_content(
    source: Scan, found: MaterialsResult, classifier: Classifier | None, unnamed: str = ""
) -> dict[str, Any]:
    """Content of materials.json; `unnamed` says why there is no classifier."""
    return {
        "scan_id": source.scan_id,
        "simulated": source.simulated,
        "metal_reference": {"how": found.metal.how, "certain": found.metal.certain},
        "library": classifier_sentence(classifier) if classifier else unnamed or "Nothing was named.",
        "model": classifier.model if classifier else None,
        "pixel_accuracy": pixel_accuracy(found),
        "segments": found.rows(),
    }


def write_materials(
    out: Path,
    source: Scan,
    images: ChannelImages,
    found: MaterialsResult,
    classifier: Classifier | None,
    quality: dict[str, Any],
    truth: tuple[TruthPlate, ...],
    rig: Instrument | None = None,
    unnamed: str = "",
) -> Products:
    """The metal-referenced image.npz, quality.json, materials.json, figures and report.

    `rig` if it is not the scan's own; `unnamed` says why there is no classifier.
    """
    c = found.calibrated
    write_image(out / "image.npz", c.h, c.v, c.p, images.x_m, images.y_m, images.valid)
    write_quality(out, quality)
    write_labels(out / LABELS, labels_of(found), f"patches of scan {source.scan_id}, in pixels of image.npz")
    write_atomically(out / PATCHES, pack_patches(found, images.x_m, images.y_m, source.simulated))
    materials = materials_content(source, found, classifier, unnamed)
    rows, named_by = materials["segments"], materials["library"]
    write_json(out / "materials.json", materials)
    context = context_of(
        found,
        images.x_m,
        images.y_m,
        title=f"Scan {source.scan_id}",
        simulated=source.simulated,
        valid=images.valid,
        plates=truth,
        named_by=named_by,
        quality=quality,
        config=_config_summary(rig or source.instrument),
        provenance={
            "scan": source.scan_id,
            "processed": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
            **versions(),
        },
        notes=[NOT_ON_HARDWARE, *([unnamed] if unnamed else [])],
    )
    write_report(out, _with_scan(context, source.plan, rig or source.instrument, images))
    return Products(out, _lines(source, found, rows) + ((unnamed,) if unnamed else ()))


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
        "burst": f"{rig.burst.pulses} pulses, {rig.burst.period_us:g} us apart, stage at {rig.stage.speed_mm_s:g} mm/s",
        "leakage removed": f"H {complex(*leak.leakage_h):.3g}, V {complex(*leak.leakage_v):.3g} (rig file)",
    }


def _lines(source: Scan, found: MaterialsResult, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    head = (
        f"{'simulated ' if source.simulated else ''}scan {source.scan_id}: {len(rows)} patches; metal {found.metal.how}"
    )
    known = [r for r in rows if r["truth"] is not None and r["name"] is not None]
    if not known:
        return (head,)
    right = sum(r["name"] == r["truth"]["name"] for r in known)
    accuracy = pixel_accuracy(found)
    share = "" if accuracy is None else f", {100 * accuracy:.1f} % of their pixels"
    return head, f"{right} of {len(known)} plates named right{share}"
