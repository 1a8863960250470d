"""Commands that process data which is already there: process, image, train."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import track

from host.calibration.in_force import of_scan
from host.demo import run_simulator
from host.imaging import ChannelImages
from host.imaging.focus import focus_sweep
from host.many import MARK
from host.materials import Library, TrainingScan, TruthPlate, make_library, patches_from_labels, read_truth
from host.options import LIBRARY, Options
from host.pipeline import Pipeline
from host.products import LABELS, Products, write_images, write_quality
from host.report import write_json
from host.report.focus import focus_figure
from host.report.scan_facts import SCAN, write_scan_facts
from host.store.authors import AuthorsCube, open_scan
from host.store.raw import require_raw
from host.store.scanfolder import MANIFEST, ScanFolder, versions
from host.store.source import ScanSource
from shared.config import load_instrument
from shared.errors import ConfigError, DataError, ScanError

TRUTH = "truth.json"
PRODUCTS = ("image.npz", SCAN, "quality.json", "materials.json", "patches.npz", LABELS, "report.html", "figures")
EDGE_MM = 9.0
"""Rim of a known plate that is not used for training: about the resolution in x."""


def _open(data: Path, config: Path | None) -> ScanSource | AuthorsCube:
    """A recorded scan of any layout; the rig file is read only where the data brings none."""
    own = (data / MANIFEST).exists()
    source = open_scan(data, None if own or config is None else load_instrument(config))
    if isinstance(source, ScanFolder):
        require_raw(source)
    return source


def _rows(source: ScanSource | AuthorsCube, data: Path, depth_m: float = 0.0, bands: int = 1) -> Pipeline:
    """A pipeline with all rows of a source, with a progress bar."""
    pipeline = Pipeline(source, depth_m=depth_m, bands=bands)
    rows = list(source.rows())
    if not rows:
        raise DataError(
            f"{data}: no row is recorded whole",
            "the scan was stopped in its first row, or files are missing",
            f"`polysight resume {data}` takes the missing rows of a scan folder",
        )
    console = Console(stderr=True)
    for row in track(rows, "rows", console=console, disable=not console.is_terminal):
        pipeline.add_row(row)
    return pipeline


def imaged(data: Path, config: Path | None, bands: int = 1) -> tuple[Pipeline, ChannelImages]:
    """A recorded scan of any layout, processed up to its images. Raises PolysightError."""
    pipeline = _rows(_open(data, config), data, bands=bands)
    return pipeline, pipeline.form_images()


def truth_of(data: Path) -> tuple[TruthPlate, ...]:
    """Plates of the truth.json beside the data; none when there is no such file."""
    path = data / TRUTH
    return read_truth(path) if path.exists() else ()


def check_library(options: Options) -> None:
    """Refuse a library that cannot be used now, not after hours. Raises DataError."""
    Library.load(options.library or LIBRARY)


def clear_products(out: Path) -> None:
    """Make a folder for products; those of an earlier run are removed, so that old and new ones never lie side by side.

    Raises
    ------
    ConfigError
        when it holds anything else, or cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        strangers = sorted(p.name for p in out.iterdir() if p.name not in PRODUCTS and not p.name.startswith("."))
        if strangers:
            raise ConfigError(
                f"{out} is not empty: it holds {strangers[0]}",
                "products go into a folder of their own",
                "give another --out",
            )
        for name in (MARK, *PRODUCTS[:-1]):
            (out / name).unlink(missing_ok=True)
        shutil.rmtree(out / PRODUCTS[-1], ignore_errors=True)
    except OSError as e:
        raise ConfigError(
            f"{out}: no folder for products: {e.strerror}",
            "a file is in the way, or you may not write there",
            "give another --out",
        ) from None


def finish(pipeline: Pipeline, out: Path, options: Options, plates: tuple[TruthPlate, ...]) -> Products:
    """All products; when no material can be found, the error says where the images are. Raises DataError."""
    try:
        return pipeline.finish(out, options, plates)
    except DataError as e:
        images = out / "image.npz"
        if not images.exists():
            raise
        raise DataError(e.what, e.why, f"{e.remedy}; the images are written: {images}") from None


def process(data: Path, out: Path, config: Path | None, options: Options) -> int:
    """Images, materials and report; returns the exit status. Raises PolysightError."""
    source, plates = _open(data, config), truth_of(data)
    check_library(options)
    clear_products(out)
    sys.stdout.write(finish(_rows(source, data, bands=options.bands), out, options, plates).summary())
    return 0


def image(data: Path, out: Path, config: Path | None) -> int:
    """image.npz and quality.json only; returns the exit status. Raises PolysightError."""
    source = _open(data, config)
    clear_products(out)
    pipeline = _rows(source, data)
    images = pipeline.form_images()
    write_images(out, images)
    write_scan_facts(out, pipeline.source, pipeline.rig, images)
    write_quality(out, pipeline.quality.to_dict(**pipeline.quality_notes))
    sys.stdout.write(f"image: {out / 'image.npz'}\n")
    return 0


def focus(data: Path, out: Path, config: Path | None, depth_mm: float) -> int:
    """Find the object plane's distance and tilt by sharpness; focus.json and focus.png. Raises PolysightError."""
    source = _open(data, config)
    out.mkdir(parents=True, exist_ok=True)
    pipeline = _rows(source, data, depth_mm / 1e3)
    builder = pipeline.images
    found = focus_sweep(builder, depth_mm / 1e3)
    sweep = found.to_dict()
    grid, board = builder.grid, builder.boards[source.instrument.receivers[0].name]
    moved = replace(grid, z_m=grid.z_m + found.depth_mm / 1e3)
    pictures = (board.image()[0], board.image(moved)[0])
    write_json(out / "focus.json", {"scan_id": source.scan_id, "simulated": source.simulated, **sweep})
    (out / "focus.png").write_bytes(focus_figure(sweep, *pictures, grid.x_m, grid.y_m, source.simulated))
    at = pipeline.rig.geometry.object_distance_mm
    sys.stdout.write(
        f"{'simulated ' if source.simulated else ''}scan {source.scan_id}: the plane is sharpest"
        f" {found.depth_mm:+.2f} mm from the rig file's: object_distance_mm = {at + found.depth_mm:.2f}\n"
        f"tilt: {found.tilt_deg[0]:+.2f} degrees along x, {found.tilt_deg[1]:+.2f} along y;"
        f" sharpness {found.gain:.3f} times the rig file's plane\n"
        f"figure: {out / 'focus.png'}\n"
    )
    if pipeline.by_columns:
        sys.stdout.write("the scan was taken by columns: x and y are swapped in these results and in the figure\n")
    if not found.certain:
        sys.stdout.write(
            "do not rely on it: the sharpness hardly changes over the sweep (a narrow scan, or no points and edges in"
            " it), or the plane lies at the end of the sweep (give a larger --depth)\n"
        )
    return 0


def sync_report(data: Path, out: Path, config: Path | None) -> int:
    """What synchronisation leaves of errors: figures, JSON, text; returns the exit status. Raises PolysightError."""
    from host.capture.decode import row_words
    from host.report.sync_report import SyncReport, write_sync_report
    from host.sync import BoardSetup, synchronise_row

    source = _open(data, config)
    if isinstance(source, AuthorsCube):
        raise DataError(
            f"{data}: the chirps are not in it",
            "these cubes were synchronised already, by the authors",
            "give the same scan's unsynced/ folder",
        )
    calibration = of_scan(source)
    rig = calibration.rig(source.instrument)
    chirp, reports = rig.chirp, {}
    for board in rig.receivers:
        setup = BoardSetup.of(rig, board, model=calibration.high_pass(board.name))
        report = reports[board.name] = SyncReport(chirp.sample_rate_hz, chirp.linear_samples, len(setup.path.beam))
        for row in source.rows():
            recorded = source.read_row(board.name, row)
            words, valid = row_words(recorded.payload, recorded.missing, recorded.frames_expected, chirp.samples)
            report.add(synchronise_row(words, valid, setup))
    sys.stdout.write(write_sync_report(out, reports, source.scan_id, source.simulated))
    return 0


def _training_scan(data: Path, config: Path) -> TrainingScan:
    source = _open(data, config)
    pipeline, plates = _rows(source, data), truth_of(data)
    if not plates:
        raise DataError(f"{data}: no {TRUTH}", "its plates are not known", "give scans made by polysight simulate")
    metal = next((t for t in plates if t.metal), None)
    if metal is None:
        raise DataError(f"{data}: no metal plate in {TRUTH}", "features are relative to metal", "add one to the scene")
    images = pipeline.form_images()
    boxes = {t.name: t.box_mm for t in plates}
    known, names = patches_from_labels(boxes, images.x_m, images.y_m, unit="mm", margin_mm=EDGE_MM)
    found = pipeline.find_materials(images, metal.box_mm, plates=plates, segmentation=known)
    return TrainingScan(source.scan_id, found, source.simulated, versions=versions(), names=names)


def train(scenes: Path | None, data: Iterable[Path], config: Path, out: Path) -> int:
    """Make a library from scans with known plates, or from scenes that are simulated first."""
    scans = [_training_scan(folder, config) for folder in data]
    if not scans and scenes is None:
        raise ConfigError(
            "no scans to learn from",
            "neither DATA nor --simulate was given",
            "polysight train --simulate examples/library --out FILE",
        )
    if scenes is not None:
        files = sorted(scenes.glob("*.toml"))
        if not files:
            raise DataError(f"{scenes}: no scene files", "the folder is wrong", "give a folder of scene files (*.toml)")
        with tempfile.TemporaryDirectory(prefix="polysight-train-") as temporary:
            for file in files:
                folder = Path(temporary) / file.stem
                if run_simulator(["simulate", str(file), "--config", str(config), "--out", str(folder)]):
                    raise ScanError(f"{file}: simulation failed, see above")
                scans.append(_training_scan(folder, config))
    note = "simulated scans of " + ", ".join(s.scan for s in scans) if all(s.simulated for s in scans) else ""
    library = make_library(scans, note)
    library.save(out)
    sys.stdout.write(
        f"{out}: {len(library.entries)} patches of {len(library.names)} materials from {len(scans)} scans\n"
    )
    sys.stdout.write(f"{json.dumps(library.fit, indent=1)}\n")
    return 0
