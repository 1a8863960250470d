"""Commands that process recorded data: process, image, focus, sync-report."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.calibration import calibration_of_scan
from polysight.imaging import (
    AS_IN_RIG_FILE,
    PLANE_REACH_M,
    Focus,
    Images,
    PlaneEstimate,
    View,
    focus_sweep,
)
from polysight.jobs.output import counted, current_step, print_lines, say
from polysight.materials import (
    TruthPlate,
    find_truth,
    read_labels,
)
from polysight.pipeline import Pipeline
from polysight.polarimetry import PlaneReference, plane_reference
from polysight.process import (
    Options,
    ProcessRequest,
    Products,
    map_rows,
    quality_content,
    save_images,
)
from polysight.products import (
    IMAGE,
    QUALITY,
    RAW_DROPPED,
    REPORT,
    check_products_folder,
    making_products,
    raw_dropped,
    write_json,
)
from polysight.store import ScanFolder, Source, dropped_rows, open_source, raw_source, require_raw
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, advice

Axes = tuple[NDArray[np.float64], NDArray[np.float64]]


def all_rows(
    source: Source,
    data: Path,
    depth_m: float = PLANE_REACH_M,
    bands: int = 1,
    options: Options | None = None,
    view: View = AS_IN_RIG_FILE,
    threads: int | None = None,
) -> Pipeline:
    """Run a pipeline over all rows of a source, `threads` at a time (None: one a core), with a progress bar.

    What `options` cannot use is refused first. Rows whose samples the scan folder keeps are not synchronised again;
    others are, and then kept.
    """
    pipeline = Pipeline(source, depth_m=depth_m, bands=bands, samples="keep", view=view)
    if options is not None:
        metal = check_options(options, pipeline.rig, axes_of(pipeline))
        pipeline.metal_plane(options, metal is not None)
    rows = pipeline.samples.processable(source, data)
    for _ in counted(map_rows(pipeline.add_row, rows, threads), len(rows), "rows"):
        pass
    return pipeline


def axes_of(pipeline: Pipeline) -> Axes:
    """Pixel centres of the images, x and y, ascending."""
    grid = pipeline.images.grid
    return (grid.y_m, grid.x_m) if pipeline.source.mirrored else (grid.x_m, grid.y_m)


def imaged(data: Path, config: Path | None, bands: int = 1) -> tuple[Pipeline, Images]:
    """Process a recorded scan of any layout up to its images. Raises PolysightError."""
    pipeline = all_rows(open_source(data, config, dropped=True), data, bands=bands)
    return pipeline, pipeline.form_images()


def truth_of(data: Path) -> tuple[TruthPlate, ...]:
    """Read the plates of truth.json beside the data; none, with a note on stderr, if it is not a truth file."""
    plates, note = find_truth(data)
    if note:
        sys.stderr.write(f"note: {note}\n")
    return plates


def check_options(options: Options, rig: Instrument, axes_m: Axes) -> int | None:
    """Check library, model and drawn boxes before the work begins; note on stderr if nothing will be named.

    `rig` is that of the images, as calibrated, `axes_m` are their x and y. Returns the number of the drawn box that is
    the metal reference, or None.

    Raises
    ------
    DataError
        when the library cannot be read or fitted, or a box holds no pixel.
    """
    metal = options.drawn(*axes_m).metal
    if options.classifier(rig) is None and options.model != "none":
        sys.stderr.write(f"note: {options.unnamed(rig).replace('was', 'will be', 1)}\n")
    return metal


def publish_images(pipeline: Pipeline, out: Path) -> None:
    """Write images and recording quality first, unless `out` contains a report.

    Raises PolysightError.
    """
    if (out / REPORT).exists():
        return
    images = pipeline.form_images(from_sums=True)  # within 1e-6 of those that `make_products` puts in their place
    with making_products(out, pipeline.source.scan_id) as new:
        save_images(new, pipeline.source, pipeline.rig, images, pipeline.quality, backlash=False)
    with suppress(OSError):  # that nobody reads it is no reason not to make the rest
        sys.stderr.write(f"image: {out / IMAGE}\n")


def make_products(pipeline: Pipeline, out: Path, options: Options, plates: tuple[TruthPlate, ...]) -> Products:
    """Write all products, replacing those in `out`; show the current step on stderr.

    When the metal that was given is none, the images alone do, unless `out` holds a report; the error says where they
    are. Raises PolysightError.
    """
    with making_products(out, pipeline.source.scan_id) as new, current_step("image") as progress:
        _check_dropped(pipeline, out)  # `out` is locked; `drop-raw` may have run since the rows were added
        try:
            return replace(pipeline.finish(new, options, plates, progress), folder=out)
        except DataError as e:
            if not (new / IMAGE).exists():
                raise
            why = _why_no_pixel(pipeline) or e.why
            if (out / REPORT).exists():
                where = f"{out} holds the earlier products; `polysight image` with another --out writes the images"
                raise DataError(e.what, why, advice(e.remedy, where), code=e.code) from None
            failed = DataError(e.what, why, advice(e.remedy, f"the images are written: {out / IMAGE}"), code=e.code)
    raise failed


def _why_no_pixel(pipeline: Pipeline) -> str:
    """Name the boards without any valid position, which leave no pixel valid; "" if there are none."""
    boards = " and ".join(pipeline.quality.boards_masked)
    return f"no position of {boards} has a direct path: TX or RX is off, or its data are constant" if boards else ""


def plane_of(pipeline: Pipeline, images: Images) -> PlaneReference:
    """Make a reference from images of a metal plate. Raises DataError if they show none."""
    name = pipeline.source.scan_id
    found = plane_reference(images.level(images.valid), name=name)
    return replace(found, made_with=pipeline.calibration.imaged_with(pipeline.rig))


def load_reference(folder: Path, config: Path | None = None, bands: int = 1) -> PlaneReference:
    """Make a reference from a scan of a metal plate that covers the plane, and one for each of `bands` sub-bands.

    `config` is the rig file of scans in the authors' layout.

    Raises
    ------
    PolysightError
        when the scan cannot be read, or shows no metal plate.
    """
    pipeline, images = imaged(folder, config, bands)
    parts = tuple(plane_of(pipeline, band) for band in pipeline.sub_bands.finish(pipeline.source.mirrored))
    return replace(plane_of(pipeline, images), bands=parts)


def load_options(request: ProcessRequest) -> Options:
    """Load the options of a request: read its label file, process its reference scan. Raises PolysightError."""
    reference = None
    if request.reference is not None:
        config = None if request.config is None else Path(request.config)
        reference = load_reference(Path(request.reference), config, request.bands)
    return Options(
        metal_box_mm=request.metal_box_mm,
        library=None if request.library is None else Path(request.library),
        model=request.model,
        reference=reference,
        bands=request.bands,
        incidence=request.incidence,
        labels=None if request.labels is None else read_labels(Path(request.labels)),
    )


def process(request: ProcessRequest, threads: int | None = None) -> int:
    """Make images, materials and report of one scan on `threads` (None: all cores); return the exit status.

    Raises PolysightError.
    """
    options, data, out = load_options(request), Path(request.data), Path(request.out)
    source = open_source(data, None if request.config is None else Path(request.config), dropped=True)
    plates = truth_of(data)
    check_products_folder(out, source.scan_id)
    pipeline = all_rows(source, data, bands=options.bands, options=options, threads=threads)
    _check_dropped(pipeline, out)
    publish_images(pipeline, out)
    products = make_products(pipeline, out, options, plates)
    sys.stdout.write(products.summary())
    return products.exit_status


def _check_dropped(pipeline: Pipeline, out: Path) -> None:
    """Keep the mark of products whose raw data was dropped. Raises DataError if the new ones have fewer rows."""
    if not isinstance(pipeline.source, ScanFolder) or not (mark := raw_dropped(out)):
        return
    pipeline.source.reload()
    if not dropped_rows(pipeline.source):
        return
    pipeline.quality.note(**{RAW_DROPPED: mark})
    absent = pipeline.quality.coverage().rows_absent
    if absent:
        raise DataError(
            f"{out} holds products of more rows: {len(absent)} rows have no data any more",
            "their raw data was dropped, and their samples are damaged or missing",
            "give another --out",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )


def image(data: Path, out: Path, config: Path | None, view: View = AS_IN_RIG_FILE) -> int:
    """Make image.npz and quality.json only; return the exit status. Raises PolysightError."""
    source = open_source(data, config, dropped=True)
    check_products_folder(out, source.scan_id)
    if isinstance(source, ScanFolder) and raw_dropped(out):
        require_raw(source)  # products in `out` may be all that is left of it
    pipeline = all_rows(source, data, depth_m=PLANE_REACH_M if view == AS_IN_RIG_FILE else 0.0, view=view)
    images = pipeline.form_images()
    with making_products(out, source.scan_id) as new:
        save_images(new, source, pipeline.rig, images, pipeline.quality)
    lines = (*pipeline.quality.coverage().lines(), f"image: {out / IMAGE}")
    print_lines(lines)
    sys.stdout.flush()
    pipeline.quality.note_imaging(pipeline.images, images)
    write_json(out / QUALITY, quality_content(pipeline.quality))
    if not images.valid.any():
        raise DataError(
            "the image has no valid pixel",
            _why_no_pixel(pipeline) or "nothing was recorded, or all of it was masked",
            f"`polysight sync-report {data} --out DIR` shows the direct path of each row",
            code=ErrorCode.NO_DATA,
        )
    return 0


def focus(data: Path, out: Path, config: Path | None, depth_mm: float) -> int:
    """Find the object plane's distance and tilt by sharpness; focus.json and focus.png. Raises PolysightError."""
    from polysight.report import focus_figure

    source = open_source(data, config, dropped=True)
    out.mkdir(parents=True, exist_ok=True)
    pipeline = all_rows(source, data, max(depth_mm / 1e3, PLANE_REACH_M))
    builder = pipeline.images
    say("images, and the plane of the plates")
    images = pipeline.form_images()
    pipeline.place_plane(images, move=False)
    plates = pipeline.plane
    say("the plane at which the image is sharpest")
    found = focus_sweep(builder, depth_m=depth_mm / 1e3)
    depth_m = plates.offset_m if plates.known else found.depth_mm / 1e3
    grid, board = builder.grid, builder.boards[source.instrument.receivers[0].name]
    pictures = (board.image()[0], board.image(replace(grid, z_m=grid.z_m + depth_m))[0])
    if source.mirrored:  # the builder's image is that of the mirrored rig
        found, plates, pictures = found.transposed(), plates.transposed(), (pictures[0].T, pictures[1].T)
    sweep = found.to_dict() | {"plates": plates.to_dict()}
    write_json(out / "focus.json", {"scan_id": source.scan_id, "simulated": source.simulated, **sweep})
    (out / "focus.png").write_bytes(focus_figure(sweep, *pictures, *axes_of(pipeline), source.simulated))
    head = f"{'simulated ' if source.simulated else ''}scan {source.scan_id}"
    at = pipeline.rig.geometry.object_distance_mm
    print_lines(_focus_lines(head, at, found, plates))
    sys.stdout.write(f"figure: {out / 'focus.png'}\n")
    return 0


def _focus_lines(head: str, distance_mm: float, found: Focus, plates: PlaneEstimate) -> list[str]:
    """Text of `focus`: the plane by the plates, if there are any, and by sharpness."""
    lines = []
    if plates.known:
        mm, std = 1e3 * plates.offset_m, 1e3 * plates.offset_std_m
        tilt, tilt_std = np.degrees(plates.tilt_rad), np.degrees(plates.tilt_std_rad)
        how = "the phase of their echoes" if plates.by_phase else "the range of their echoes"
        lines += [
            f"{head}: {plates.plates} flat plates lie {mm:+.2f} +- {std:.2f} mm from the rig file's plane, by {how}:"
            f" object_distance_mm = {distance_mm + mm:.2f}",
            f"tilt: {tilt[0]:+.2f} +- {tilt_std[0]:.2f} degrees along x, {tilt[1]:+.2f} +- {tilt_std[1]:.2f} along y",
        ]
    if plates.known and not found.certain:
        return [*lines, "sharpness does not tell (a narrow scan, or no points and edges in it); the plates do"]
    lines += [
        f"{head}: the plane is sharpest {found.depth_mm:+.2f} mm from the rig file's:"
        f" object_distance_mm = {distance_mm + found.depth_mm:.2f}",
        f"tilt: {found.tilt_deg[0]:+.2f} degrees along x, {found.tilt_deg[1]:+.2f} along y;"
        f" sharpness {found.gain:.3f} times the rig file's plane",
    ]
    if not plates.known and not found.certain:
        lines.append(
            "do not rely on it: there is no flat plate, and the sharpness hardly changes over the sweep (a narrow scan,"
            " or no points and edges in it), or the plane lies at the end of the sweep (give a larger --depth)"
        )
    return lines


def sync_report(data: Path, out: Path, config: Path | None) -> int:
    """Write figures, JSON and text of the residual errors of synchronisation; return the exit status."""
    from polysight.capture import row_words
    from polysight.report import SyncReport, write_sync_report
    from polysight.sync import BoardSetup, synchronise_row

    source = raw_source(open_source(data, config), data)
    calibration = calibration_of_scan(source)
    rig = calibration.rig(source.instrument)
    chirp, reports = rig.chirp, {}
    for board in rig.receivers:
        setup = BoardSetup.of(rig, board, model=calibration.high_pass(board.name))
        report = reports[board.name] = SyncReport(chirp.sample_rate_hz, chirp.linear_samples, len(setup.path.beam))
        say(f"rows of {board.name}")
        for row in source.rows():
            recorded = source.read_row(board.name, row)
            words, valid = row_words(recorded.payload, recorded.missing, recorded.frames_expected, chirp.samples)
            report.add(synchronise_row(words, valid, setup))
    sys.stdout.write(write_sync_report(out, reports, source.scan_id, source.simulated))
    return 0
