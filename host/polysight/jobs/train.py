"""`polysight train`: a reference library from scans whose materials are known.

The materials come from labels (`labels.json` of `polysight label`) or, without labels, from the truth of a simulated
scan. Rows are processed as by `polysight process`; if the raw rows are deleted, the saved images are used.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np

from polysight.imaging import Images
from polysight.jobs.demo import check_scenes, run_simulator
from polysight.jobs.output import print_lines, steps
from polysight.jobs.process import process_rows
from polysight.materials import (
    KnownScene,
    Labels,
    Library,
    MaterialsResult,
    Optics,
    TrainingScan,
    analyse,
    check_labels,
    describe_accuracy,
    make_library,
    make_patches_from_plates,
    read_truth,
    remove_specimen,
    specimen_seed,
)
from polysight.polarimetry import incidence_choice
from polysight.process import Inputs, is_given_images
from polysight.products import (
    IMAGE,
    LABELS,
    SCAN,
    ProcessedScan,
    find_labels,
    find_products,
    find_scan_folder,
    read_products,
)
from polysight.settings import Settings
from polysight.store import TRUTH, open_source, versions
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError, make_missing_path_error, quote

EDGE_MM = 9.0
"""Width of the rim of a known plate that is not used for training: about the resolution in x."""


def load_training_scan(data: Path, config: Path) -> TrainingScan:
    """Return a scan for the library, its patches named by labels or truth.

    `data` is a scan folder of any layout, or a folder of products; `config` is the rig file for scans without one.

    Raises
    ------
    DataError
        if neither labels nor truth exist, no metal is marked, or the labels cannot be used.
    NoResult
        if the verdict of a labelled scan is "no result".
    """
    scan = find_scan_folder(data) or data
    check_labelled(data)
    saved_labels = find_labels(data)
    if saved_labels is None:
        return _process_simulated(scan, config)
    path, labels = saved_labels
    try:
        saved = _read_products_without_rows(data, scan)
        if saved is not None:
            return _load_images(saved, labels)
        return _process_rows(scan, config, labels)
    except DataError as e:
        problem = e.what
        if str(path) not in problem:
            problem = f"{path}: {problem}"
        raise DataError(problem, e.why, e.remedy) from None


def check_labelled(data: Path) -> None:
    """Check labels or truth of a scan before any row is read.

    Raises
    ------
    DataError
        as :func:`load_training_scan`, for the faults that can be found without the rows.
    """
    scan = find_scan_folder(data) or data
    if not data.is_dir():
        raise DataError(f"{data}: no such folder", "the path is wrong", "give scan folders, or folders of products")
    saved_labels = find_labels(data)
    if is_given_images(data):
        out = Path("out") / data.resolve().name
        raise DataError(
            f"{data}: images of another program, not a scan",
            "a library is made from recorded scans and from products",
            f"polysight process {quote(data)} --out {quote(out)}; polysight label {quote(out)}; then train on it."
            " The whole published data: polysight train --authors DIR",
            code=ErrorCode.FILE_FOREIGN,
        )
    if saved_labels is None:
        if (scan / TRUTH).exists():
            return
        raise DataError(
            f"{data}: contains neither {LABELS} nor {TRUTH}",
            "the materials of this scan are not known",
            f"polysight label {quote(data)}; then train again",
        )
    if (saved := find_products(data)) is not None:
        path, labels = saved_labels
        try:
            check_labels(labels, saved.x_m, saved.y_m)
        except DataError as e:
            raise DataError(f"{path}: {e.what}", e.why, e.remedy) from None


def _read_products_without_rows(data: Path, scan: Path) -> ProcessedScan | None:
    """Return the products if the raw rows are deleted, else None. Raises DataError."""
    if find_scan_folder(data) is None:
        return read_products(data)
    if (scan / "products" / IMAGE).exists():
        saved = ProcessedScan(scan / "products")
        if saved.quality.raw_dropped:
            return saved
    return None


def _process_rows(data: Path, config: Path, labels: Labels) -> TrainingScan:
    """Process a labelled scan from its rows, as `polysight process --labels`, without naming its patches.

    Raises DataError without metal, NoResult if the verdict allows no result.
    """
    source = open_source(data, config)
    pipeline = process_rows(source, data, Settings(model="none"))
    images = pipeline.form_images()
    checked_labels = check_labels(labels, images.x_m, images.y_m, images.valid)
    if checked_labels.metal is None and pipeline.calibration.reference() is None:
        raise _no_metal_error(data)
    pipeline.inputs = Inputs(labels=checked_labels)
    findings = pipeline.examine(images)
    if not findings.verdict.usable:
        raise findings.verdict.error("no library was written")
    return _add_labels(source.scan_id, findings.analysis, source.simulated, checked_labels)


def _load_images(saved: ProcessedScan, labels: Labels) -> TrainingScan:
    """Use the saved images of a labelled scan. Raises as :func:`_process_rows`."""
    if saved.verdict is not None and not saved.verdict.usable:
        raise saved.verdict.error("no library was written")
    checked_labels = check_labels(labels, saved.x_m, saved.y_m, saved.valid)
    segmentation, names = checked_labels.patches(saved.x_m, saved.y_m)
    metal = next((label for label, name in names.items() if name == checked_labels.metal), None)
    if metal is None:
        raise _no_metal_error(saved.folder)
    pair = Images(saved.h, saved.v, saved.x_m, saved.y_m, saved.valid)
    materials = analyse(pair, _read_optics(saved), KnownScene(segmentation, metal))
    # If it is not known whether the scan is simulated, it counts as simulated.
    return _add_labels(saved.scan_id, materials, saved.simulated is not False, checked_labels)


def _read_optics(saved: ProcessedScan) -> Optics:
    """Return incidence angle and leakage of saved images; leakage that processing removed is zero here.

    Raises DataError if the products name no rig, and are not of given images, whose angle is in their quality.
    """
    rig = saved.rig
    incidence = saved.quality.incidence
    if rig is not None:
        # With "one", all pixels have the same incidence angle.
        optics = Optics.from_rig(rig, incidence_choice(rig, saved.x_m, saved.y_m, "one"))
    elif saved.quality.given_images and incidence and incidence.one_deg is not None:
        optics = Optics(float(np.radians(incidence.one_deg)))
    else:
        raise DataError(
            f"{saved.folder / SCAN}: names no rig", "an earlier release processed the scan", "process the scan again"
        )
    budget = None
    if saved.materials is not None:
        budget = saved.materials.error_budget
    if not budget or budget.incidence is None or budget.leakage is None:
        return optics
    angle_deg = budget.incidence.deg
    angle_std_deg = budget.incidence.std_deg
    leakage_std = budget.leakage.std
    if angle_deg is None or angle_std_deg is None or leakage_std is None:
        return optics
    return replace(
        optics,
        theta_rad=float(np.radians(angle_deg)),
        prior=replace(
            optics.prior,
            theta_std_rad=float(np.radians(angle_std_deg)),
            leakage=(0j, 0j),
            leakage_std=max(std or 0.0 for std in leakage_std),
            leakage_measured=True,
        ),
    )


def _add_labels(scan: str, materials: MaterialsResult, simulated: bool, labels: Labels) -> TrainingScan:
    """Return the training scan with names and specimens of the boxes."""
    boxes = dict(enumerate(labels.boxes, 1))
    for patch in materials.patches:
        if patch.patch.label in boxes and not materials.usable_pixels(patch.patch).any():
            sys.stderr.write(
                f"note: {scan}: the box of {boxes[patch.patch.label]} contains no pixel that can be used\n"
            )
    names = {label: remove_specimen(box) for label, box in boxes.items()}
    specimens = {label: piece for label, box in boxes.items() if (piece := labels.specimen(box)) is not None}
    return TrainingScan(scan, materials, simulated, versions=versions(), names=names, specimens=specimens)


def _process_simulated(data: Path, config: Path) -> TrainingScan:
    """Process a simulated scan with known plates. Raises DataError if none of these is metal."""
    source = open_source(data, config)
    plates = read_truth(data / TRUTH)
    metal = next((t for t in plates if t.metal), None)
    if metal is None:
        raise DataError(f"{data}: no metal plate in {TRUTH}", "features are relative to metal", "add one to the scene")
    pipeline = process_rows(source, data)
    images = pipeline.form_images()
    segmentation, names = make_patches_from_plates(plates, images.x_m, images.y_m, EDGE_MM)
    materials = pipeline.find_materials(images, KnownScene(segmentation, metal.box_mm, plates=plates))
    seed = specimen_seed(data / TRUTH)
    specimens = {}
    if seed is not None:
        specimens = {label: f"{source.scan_id}/{seed}/{label}" for label in names}
    return TrainingScan(
        source.scan_id, materials, source.simulated, versions=versions(), names=names, specimens=specimens
    )


def _no_metal_error(folder: Path) -> DataError:
    """Return the error of a labelled scan without a metal reference."""
    return DataError(
        f"{folder}: no box is metal",
        "features of materials are relative to metal",
        f"polysight label {quote(folder)} --metal NAME, or measure the rig with `polysight calibrate metal`",
    )


def train_from_scans(data: Sequence[Path], config: Path, note: str = "") -> Library:
    """Return a library of labelled scans; `config` is the rig file of data without one.

    Raises
    ------
    PolysightError
        as :func:`load_training_scan`; with fewer than two scans.
    """
    for folder in data:
        check_labelled(folder)
    return make_library(number_equal_names([load_training_scan(folder, config) for folder in data]), note)


def train(scenes: Path | None, data: Iterable[Path], config: Path, out: Path, times: int = 1) -> int:
    """Make a library from labelled scans, simulated scans with truth, or scenes; return the exit status.

    Each scene is simulated `times` times, with other specimens and noise each time.

    Raises
    ------
    PolysightError
        if a file is wrong (checked before anything is simulated), or a scan cannot be used.
    """
    data = list(data)
    files = []
    if scenes is not None:
        files = sorted(scenes.glob("*.toml"))
    if not data and scenes is None:
        raise ConfigError(
            "no scans to train on",
            "neither DATA nor --simulate was given",
            "polysight train SCAN... --out FILE; polysight label SCAN names the materials",
        )
    if scenes is not None and not files:
        if not scenes.is_dir():
            raise make_missing_path_error(scenes)
        raise DataError(
            f"{scenes}: no scene files", "none of its files ends in .toml", "give a folder of scene files (*.toml)"
        )
    if not out.parent.is_dir():
        raise ConfigError(
            f"{out}: no such folder {out.parent}", "the library would be lost", f"mkdir -p {quote(out.parent)}"
        )
    for folder in data:
        check_labelled(folder)
    if files:
        check_scenes(files, config)
    # `steps` prints each text before the work on it, and its duration.
    scans = [load_training_scan(folder, config) for folder in steps(data, [str(folder) for folder in data])]
    if files:
        with tempfile.TemporaryDirectory(prefix="polysight-train-") as temporary:
            scenes_drawn = list(product(files, range(times)))
            texts = [f"simulating and imaging {file.name}, specimens {repetition}" for file, repetition in scenes_drawn]
            for file, repetition in steps(scenes_drawn, texts):
                folder = Path(temporary) / f"{file.stem}-{repetition}"
                command = ["simulate", str(file), "--config", str(config), "--out", str(folder)]
                if run_simulator([*command, "--specimens", str(repetition)]):
                    raise ScanError(f"{file}: simulation failed", "the lines above say why", "correct the scene file")
                scans.append(load_training_scan(folder, config))
                shutil.rmtree(folder)
    note = ""
    if all(s.simulated for s in scans):
        note = "simulated scans of " + ", ".join(dict.fromkeys(s.scan for s in scans))
    library = make_library(number_equal_names(scans), note)
    library.save(out)
    print_lines([*_summarise_library(out, library), *describe_accuracy(library)])
    return 0


def number_equal_names(scans: Sequence[TrainingScan]) -> list[TrainingScan]:
    """Append numbers to scans of equal names.

    Raises
    ------
    DataError
        if a scan is given twice: cross-validation would test it on itself.
    """
    numbered: list[TrainingScan] = []
    for scan in scans:
        namesakes = [s for s in scans[: len(numbered)] if s.scan == scan.scan]
        if any(np.array_equal(s.result.h, scan.result.h, equal_nan=True) for s in namesakes):
            raise DataError(
                f"scan {scan.scan} is given twice",
                "cross-validation would test it on itself",
                "leave one out (a scan folder and its products are one scan)",
            )
        if namesakes:
            scan = replace(scan, scan=f"{scan.scan} ({len(namesakes) + 1})")
        numbered.append(scan)
    return numbered


def _format_count(number: int, singular: str, plural: str) -> str:
    """Return a number with its noun in singular or plural."""
    noun = singular if number == 1 else plural
    return f"{number} {noun}"


def _summarise_library(out: Path, library: Library) -> list[str]:
    """Describe the contents of a library by material; note names that differ only in case."""
    lines = [f"{out}: {len(library.entries)} patches of {len(library.names)} materials from {len(library.scans)} scans"]
    for name in library.names:
        entries = [e for e in library.entries if e.name == name]
        scans = len({e.scan for e in entries})
        specimens = len({e.specimen for e in entries if e.specimen is not None})
        line = f"  {name}: {_format_count(len(entries), 'patch', 'patches')} in {_format_count(scans, 'scan', 'scans')}"
        if specimens > 1:
            line += f", {specimens} specimens"
        lines.append(line)
    if all(e.specimen is None for e in library.entries):
        lines.append(
            "note: no box names its specimen, so differences between specimens and placements cannot be"
            " separated and probabilities are more cautious than necessary; polysight label SCAN --specimen NAME=WHICH"
        )
    for first, second in combinations(library.names, 2):
        if first.casefold() == second.casefold():
            lines.append(
                f"note: {first} and {second} are two materials here; if they are one: polysight label --rename"
            )
    return lines
