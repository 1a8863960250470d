"""Processing of recorded data, and of a scan while it runs; commands process, image, focus, sync-report.

`data` is the folder of a recorded scan, `out` the folder of its products. A scan folder keeps the samples of each row,
synchronised and cut to the range of the object, so that later processing need not read the raw data.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.calibration import Calibration, load_rig_calibration, load_scan_calibration
from polysight.data import find_packaged
from polysight.imaging import PLANE_REACH_M, Focus, Images, PlaneEstimate, Rise, focus_sweep, image_grid
from polysight.jobs.measure_surfaces import add_surfaces, has_steep_patch
from polysight.jobs.output import count_steps, current_step, name_scan, print_lines, say
from polysight.materials import WEAK_V_DB, Plates, find_truth, read_labels, read_truth
from polysight.pipeline import Pipeline
from polysight.polarimetry import PlaneReference, plane_reference
from polysight.process import (
    Inputs,
    Products,
    analyse_given_images,
    collect_imaged_scan,
    convert_boxes_to_patches,
    explain_unnamed,
    is_given_images,
    load_classifier,
    make_reference,
    map_rows,
    read_given_images,
    save_images,
    save_materials,
)
from polysight.products import (
    IMAGE,
    REPORT,
    check_products_folder,
    check_results_folder,
    raw_dropped,
    replace_products,
    write_json,
)
from polysight.results import format_one_line, rules
from polysight.settings import DEFAULT, Settings, path_text
from polysight.store import MANIFEST, ScanFolder, Source, dropped_rows, manifest, open_source, raw_source, require_raw
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError, join_advice, quote

_log = logging.getLogger(__name__)

PRODUCTS = "products"
"""Folder of the products of a scan, in the scan's folder."""
Axes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Pixel centres of images, x and y in metres."""


def add_rows(pipeline: Pipeline, data: Path, threads: int | None = None) -> None:
    """Add all rows of the pipeline's source, `threads` at a time (None: one a core), with a progress bar.

    Rows whose samples the scan folder keeps are not synchronised again; others are, and then kept.
    """
    rows = pipeline.samples.processable(pipeline.source, data)
    for _ in count_steps(map_rows(pipeline.add_row, rows, threads), len(rows), "rows"):
        pass


def process_rows(source: Source, data: Path, settings: Settings = DEFAULT) -> Pipeline:
    """Return a pipeline to which all rows of a source were added; a scan folder keeps their samples."""
    pipeline = Pipeline(source, settings, samples="keep")
    add_rows(pipeline, data)
    return pipeline


def pixel_axes(pipeline: Pipeline) -> Axes:
    """Return the pixel centres of the images, x and y in metres, ascending."""
    grid = pipeline.builder.grid
    # A scan recorded column by column is processed with x and y exchanged.
    if pipeline.source.mirrored:
        return grid.y_m, grid.x_m
    return grid.x_m, grid.y_m


def form_scan_images(data: Path, settings: Settings = DEFAULT) -> tuple[Pipeline, Images]:
    """Process a recorded scan of any layout up to its images. Raises PolysightError."""
    pipeline = process_rows(open_source(data, settings.path("config"), dropped=True), data, settings)
    return pipeline, pipeline.form_images()


def find_plates(data: Path) -> Plates:
    """Read the plates of truth.json in the data's folder; none, with a note on stderr, if it is not a truth file."""
    plates, note = find_truth(data)
    if note:
        sys.stderr.write(f"note: {note}\n")
    return plates


def check_inputs(settings: Settings, inputs: Inputs, calibration: Calibration, rig: Instrument, axes_m: Axes) -> None:
    """Check library, model, drawn boxes and metal plate before the work begins; note if nothing will be named.

    `rig` is that of the images, as calibrated, `axes_m` are their x and y.

    Raises
    ------
    DataError
        when the library cannot be read or fitted, a box holds no pixel, or the plate was imaged with other settings.
    """
    boxes = convert_boxes_to_patches(settings, inputs, *axes_m)
    if load_classifier(settings, rig) is None and settings.model != "none":
        sys.stderr.write(f"note: {explain_unnamed(settings, rig, will_be=True)}\n")
    metal_in_scene = boxes.metal is not None or settings.metal_box_mm is not None
    metal_plate = calibration.metal_plane(rig, inputs.reference, metal_in_scene, settings.bands)
    if metal_plate is not None:
        metal_plate.check_axes(*axes_m)


def publish_images(pipeline: Pipeline, out: Path, check: Callable[[], None] | None = None) -> None:
    """Write images and recording quality before the materials are known, unless `out` contains a report.

    The stage's backlash is estimated later, for the final products. `check` is called while `out` is locked, and raises
    an error if the images must not be written. Raises PolysightError.
    """
    if (out / REPORT).exists():
        return
    # The images of a running scan come from the sums over its rows, which exist already. The images by which
    # `make_products` replaces them differ by less than 1e-6 of the peak, unless missing positions are filled
    # (`sparse`).
    images = pipeline.form_images(from_sums=True)
    with replace_products(out, pipeline.source.scan_id) as new:
        if check is not None:
            check()
        scan = collect_imaged_scan(out, pipeline.source, pipeline.rig, images, pipeline.quality, backlash=False)
        save_images(new, scan)
    # If the terminal was closed, processing still continues.
    with suppress(OSError):
        sys.stderr.write(f"image: {out / IMAGE}\n")


def make_products(
    pipeline: Pipeline, out: Path, plates: Plates, check: Callable[[], None] | None = None, wait: bool = False
) -> Products:
    """Write all products, replacing those in `out`; show the current step on stderr.

    `check` as for :func:`publish_images`; with `wait` it waits while another program writes products in `out`.

    If no materials can be found (the given metal is not metal, a board has no signal), the images alone are written,
    unless `out` holds a report; the error says where they are. Raises PolysightError.
    """
    with replace_products(out, pipeline.source.scan_id, wait) as new, current_step("image") as progress:
        if check is not None:
            check()
        # The rows were added before `out` was locked: `drop-raw` may have run in between.
        _check_dropped(pipeline, out)
        try:
            products = pipeline.finish(new, plates, progress)
            if pipeline.quality.boards_masked:
                raise _no_pixel_error(pipeline)
            if has_steep_patch(new):
                progress("surfaces")
                add_surfaces(pipeline, new)
            return replace(products, folder=out)
        except DataError as e:
            if not (new / IMAGE).exists():
                raise
            if (out / REPORT).exists():
                images_note = (
                    f"{out} contains the earlier products; `polysight image` with another --out writes the images"
                )
                raise DataError(e.what, e.why, join_advice(e.remedy, images_note), code=e.code) from None
            # Raised below, after the `with`: an error inside it would discard the new images.
            failed = DataError(
                e.what, e.why, join_advice(e.remedy, f"the images are written: {out / IMAGE}"), code=e.code
            )
    raise failed


def _no_pixel_error(pipeline: Pipeline, data: Path | None = None) -> DataError:
    """Return the error of images without a valid pixel.

    It names the boards without any valid position: P needs both.
    """
    cause = "nothing was recorded, or all of it was masked"
    boards = " and ".join(pipeline.quality.boards_masked)
    if boards:
        cause = f"no position of {boards} has a direct path: TX or RX is off, or its data are constant"
    return DataError(
        "the image has no valid pixel",
        cause,
        f"`polysight sync-report {quote(data or 'SCAN')} --out DIR` shows the direct path of each row",
        code=ErrorCode.NO_DATA,
    )


def make_plane_reference(pipeline: Pipeline, images: Images) -> PlaneReference:
    """Make a reference from images of a metal plate. Raises DataError if they show no plate, or another material."""
    reference = plane_reference(images.level(images.valid), name=pipeline.source.scan_id)
    ratio = reference.v[reference.valid] / reference.h[reference.valid]
    level_db = 20 * float(np.log10(np.median(np.abs(ratio))))
    if pipeline.synchroniser.direct_path_known and level_db < WEAK_V_DB:
        raise DataError(
            f"the reference scan {pipeline.source.scan_id} shows no metal",
            f"V is {-level_db:.0f} dB weaker than H, relative to the direct path: plastics, glass and water reflect "
            "in this way; metal reflects both equally",
            "scan a bare metal plate that covers the plane",
            code=ErrorCode.NO_DATA,
        )
    made_with = pipeline.calibration.describe_imaging(pipeline.rig)
    return replace(reference, made_with=made_with, rise=_measure_rise(images))


def _measure_rise(images: Images) -> Rise:
    """Return the rise of a plate that covers the image, along the plane of incidence and across it; 0 if unknown."""
    light = images.illumination
    if light is None:
        return 0.0, 0.0
    rise = light.estimate_rise(images.h, images.v, images.valid)
    return rise[1 - light.across], rise[light.across]


def load_reference(folder: Path, config: Path | None = None, bands: int = 1) -> PlaneReference:
    """Make a reference from a scan of a metal plate that covers the plane, and one for each of `bands` sub-bands.

    `config` is the rig file of scans in the authors' layout. From a recorded scan, the reference holds the plate's
    dispersion, too: the change of its reflectivity over the sweep.

    Raises
    ------
    PolysightError
        when the scan cannot be read, or shows no metal plate.
    """
    if is_given_images(folder):
        return make_reference(read_given_images(folder, rig_of_images(config)))
    pipeline, images = form_scan_images(folder, Settings(config=path_text(config), bands=bands))
    mirrored = pipeline.source.mirrored
    parts = tuple(make_plane_reference(pipeline, band) for band in pipeline.sub_bands.finish(mirrored))
    dispersion = pipeline.builder.form_dispersion()
    reference = make_plane_reference(pipeline, images).add_dispersion(
        dispersion.transpose() if mirrored else dispersion
    )
    return replace(reference, bands=parts)


def load_inputs(settings: Settings) -> Inputs:
    """Read the label file of the settings, and process their scan of a metal plate. Raises PolysightError."""
    inputs = Inputs()
    if (labels := settings.path("labels")) is not None:
        inputs = replace(inputs, labels=read_labels(labels))
    if (plate := settings.path("reference")) is not None:
        reference = load_reference(plate, settings.path("config"), settings.bands)
        inputs = replace(inputs, reference=reference)
    return inputs


def process(data: Path, out: Path, settings: Settings = DEFAULT, threads: int | None = None) -> int:
    """Make images, materials and report of one scan on `threads` (None: all cores); return the exit status.

    `data` is a scan, or a pair of images (see :func:`process_images`). Raises PolysightError.
    """
    inputs = load_inputs(settings)
    if is_given_images(data):
        return process_images(data, out, settings, inputs)
    if settings.incidence_deg is not None:
        raise ConfigError(
            f"--incidence {settings.incidence_deg:g} with a recorded scan", "its angle follows from its rig file",
            "correct geometry.object_distance_mm, or leave the option out", code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    source = open_source(data, settings.path("config"), dropped=True)
    plates = find_plates(data)
    check_products_folder(out, source.scan_id)
    _check_not_recorded(data, out)
    pipeline = Pipeline(source, settings, inputs, samples="keep")
    check_inputs(settings, inputs, pipeline.calibration, pipeline.rig, pixel_axes(pipeline))
    add_rows(pipeline, data, threads)
    _check_dropped(pipeline, out)
    check = partial(_check_same_rows, pipeline, data, out)
    publish_images(pipeline, out, check)
    products = make_products(pipeline, out, plates, check)
    sys.stdout.write(products.summary())
    return products.exit_status


def _check_not_recorded(data: Path, out: Path) -> None:
    """Raise ScanError if `out` is the folder into which a running scan will write its products."""
    if out.resolve() != (data / PRODUCTS).resolve() or not (data / MANIFEST).is_file():
        return
    if manifest.is_being_written(data / MANIFEST):
        raise ScanError(
            f"{data} is being scanned", f"the scan makes {out} when its rows have ended, and would find it in use",
            f"wait for its end (polysight preview {quote(data)} shows it); polysight process {quote(data)} --out DIR"
            " processes its present rows", code=ErrorCode.BUSY,
        )  # fmt: skip


def _check_same_rows(pipeline: Pipeline, data: Path, out: Path) -> None:
    """Raise ScanError if `out` is the scan's own folder of products, and the scan now has more rows than were read.

    The scan may have been resumed since its rows were read; it may even have ended.
    """
    _check_not_recorded(data, out)
    source = pipeline.source
    if out.resolve() != (data / PRODUCTS).resolve() or not isinstance(source, ScanFolder):
        return
    read_rows = len(source.committed_rows())
    source.reload()
    rows = len(source.committed_rows())
    if rows > read_rows:
        raise ScanError(
            f"{data} was resumed: {rows} rows are recorded, and {read_rows} were read",
            f"{out} would lack the others",
            f"polysight process {quote(data)} --out {quote(out)}", code=ErrorCode.BUSY,
        )  # fmt: skip


def rig_of_images(config: Path | None) -> Instrument:
    """Return the rig file for given images: `config`, or the packaged one. Raises ConfigError."""
    return load_instrument(config or find_packaged(Path("instrument.toml")))


def process_images(data: Path, out: Path, settings: Settings, inputs: Inputs) -> int:
    """Find the materials of given images, and write all products; return the exit status.

    `data` is an `.npz` file, or a folder `labels/<scan>` of the published data. Raises PolysightError.
    """
    if settings.bands > 1 or settings.sparse:
        option = "--sparse" if settings.sparse else "--bands"
        raise ConfigError(
            f"{option} with given images", f"{option} needs the rows of a recorded scan",
            "leave it out", code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    rig = rig_of_images(settings.path("config"))
    pair = read_given_images(data, rig)
    check_products_folder(out, pair.scan_id)
    plates: Plates = ()
    if data.is_dir():
        plates = find_plates(data)
    scan, findings, unnamed = analyse_given_images(pair, settings, inputs, rig, plates)
    with replace_products(out, pair.scan_id) as new, current_step("figures and report"):
        products = replace(save_materials(new, scan, findings.analysis, unnamed), folder=out)
    sys.stdout.write(products.summary())
    return products.exit_status


class LiveProcessing:
    """Processes a scan while it runs: its rows as they are committed, the images and products after the last one.

    Raises PolysightError if a file that the settings name cannot be used.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self._folder = folder
        self._settings = settings
        self._inputs = load_inputs(settings)
        self._source: ScanFolder | None = None
        self._pipeline: Pipeline | None = None

    def check_new(self, rig: Instrument, truth: Path | None) -> None:
        """Check before the rig moves that a new scan can be processed after its end. Raises PolysightError."""
        self._check(rig, load_rig_calibration(rig))
        if truth is not None:
            read_truth(truth)

    def check_resumed(self, source: ScanFolder) -> None:
        """Check the same for a scan that is resumed. Raises PolysightError."""
        self._check(source.instrument, load_scan_calibration(source))
        check_products_folder(self._folder / PRODUCTS, source.scan_id)

    def _check(self, rig: Instrument, calibration: Calibration) -> None:
        """Check the settings' files against the rig as calibrated. Raises PolysightError."""
        placed = calibration.rig(rig)
        grid = image_grid(placed)
        check_inputs(self._settings, self._inputs, calibration, placed, (grid.x_m, grid.y_m))

    def add_row(self, row: int) -> None:
        """Process one committed row; the pipeline is made with the first one."""
        if self._source is None or self._pipeline is None:
            self._source = ScanFolder.load(self._folder)
            self._pipeline = Pipeline(self._source, self._settings, self._inputs, live=True, samples="keep")
        self._source.reload()
        dead_rx_before = {name: board.dead_rx for name, board in self._pipeline.quality.boards.items()}
        was_in_order = {name: not board.rx_order for name, board in self._pipeline.quality.boards.items()}
        self._pipeline.add_row(row)
        for name, board in self._pipeline.quality.boards.items():
            # Report a dead RX immediately, with the row that shows it, and not only after the scan.
            new = {rx: [row] for rx in board.rows[row].figures.dead_rx if rx not in dead_rx_before[name]}
            for finding in rules.judge_dead_rx(name, new, rows=1):
                _log.warning("row %d: %s", row, format_one_line(finding))
            if not was_in_order[name]:
                continue
            for finding in rules.judge_rx_order(name, board.rx_order):
                _log.warning("row %d: %s", row, format_one_line(finding))
        if self._source.complete:
            try:
                publish_images(self._pipeline, self._folder / PRODUCTS)
            except ConfigError as e:
                # Another program is still writing products there. `finish` waits for it, and writes these images, too.
                if e.code != ErrorCode.BUSY:
                    raise

    def finish(self) -> int:
        """Write the products, and print their summary; return the exit status (0 if there was no row)."""
        if self._pipeline is None:
            return 0
        products = make_products(self._pipeline, self._folder / PRODUCTS, find_plates(self._folder), wait=True)
        sys.stdout.write(products.summary())
        return products.exit_status


def _check_dropped(pipeline: Pipeline, out: Path) -> None:
    """Copy the note on dropped raw data from the products in `out`. Raises DataError if new ones have fewer rows."""
    if not isinstance(pipeline.source, ScanFolder) or not (mark := raw_dropped(out)):
        return
    pipeline.source.reload()
    if not dropped_rows(pipeline.source):
        return
    pipeline.quality.add_entries(raw_dropped=mark)
    absent = pipeline.quality.coverage().rows_absent
    if absent:
        raise DataError(
            f"{len(absent)} rows of the scan no longer have data, and {out} contains products made with them",
            "their raw data was dropped, and their samples are damaged or missing",
            "give another --out",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )


def image(data: Path, out: Path, settings: Settings = DEFAULT) -> int:
    """Make image.npz, scan.json and quality.json only; return the exit status. Raises PolysightError."""
    source = open_source(data, settings.path("config"), dropped=True)
    check_products_folder(out, source.scan_id)
    if isinstance(source, ScanFolder) and raw_dropped(out):
        # Products in `out` may be all that is left of the scan.
        require_raw(source)
    pipeline = process_rows(source, data, settings)
    images = pipeline.form_images()
    pipeline.quality.note_imaging(pipeline.builder, images)
    with replace_products(out, source.scan_id) as new:
        save_images(new, collect_imaged_scan(out, source, pipeline.rig, images, pipeline.quality))
    print_lines((*pipeline.quality.coverage().lines(), f"image: {out / IMAGE}"))
    if not images.valid.any():
        raise _no_pixel_error(pipeline, data)
    return 0


def focus(data: Path, out: Path, config: Path | None, depth_mm: float) -> int:
    """Find the object plane's distance and tilt, by flat plates and by sharpness; write focus.json and focus.png.

    `depth_mm` is the largest distance from the rig file's plane that is searched. Raises PolysightError.
    """
    from polysight.report import draw_focus_figure

    check_results_folder(out)
    source = open_source(data, config, dropped=True)
    out.mkdir(parents=True, exist_ok=True)
    # The range gate has to keep the echoes of every plane searched: of the sweep, and of plates up to `PLANE_REACH_M`.
    pipeline = process_rows(source, data, Settings(depth_range_mm=max(depth_mm, 1e3 * PLANE_REACH_M)))
    say("images, and the plane of the plates")
    images = pipeline.form_images()
    pipeline.place_plane(images, move=False)
    plates_plane = pipeline.plane
    say("the plane at which the image is sharpest")
    sharpest = focus_sweep(pipeline.builder, depth_m=depth_mm / 1e3)
    if plates_plane.known:
        depth_m = plates_plane.offset_m
    else:
        depth_m = sharpest.depth_mm / 1e3
    grid = pipeline.builder.grid
    # Image H in the plane of the rig file, and in the plane that was found.
    board_h, _ = source.instrument.receivers
    board = pipeline.builder.boards[board_h.name]
    image_in_given_plane, _footprint, _notice = board.image()
    image_in_found_plane, _footprint, _notice = board.image(replace(grid, z_m=grid.z_m + depth_m))
    pictures = (image_in_given_plane, image_in_found_plane)
    # A scan recorded column by column is processed as that of a mirrored rig.
    if source.mirrored:
        sharpest = sharpest.transpose()
        plates_plane = plates_plane.transpose()
        pictures = (image_in_given_plane.T, image_in_found_plane.T)
    sweep = sharpest.to_dict() | {"plates": plates_plane.to_dict()}
    write_json(out / "focus.json", {"scan_id": source.scan_id, "simulated": source.simulated, **sweep})
    (out / "focus.png").write_bytes(draw_focus_figure(sweep, *pictures, *pixel_axes(pipeline), source.simulated))
    head = name_scan(source.scan_id, source.simulated)
    print_lines(_format_focus(head, pipeline.rig.geometry.object_distance_mm, sharpest, plates_plane))
    sys.stdout.write(f"figure: {out / 'focus.png'}\n")
    return 0


def _format_focus(head: str, distance_mm: float, sharpest: Focus, plates: PlaneEstimate) -> list[str]:
    """Format the result of `focus`: the plane by the plates, if there are any, and by sharpness."""
    lines = []
    if plates.known:
        offset_mm = 1e3 * plates.offset_m
        offset_std_mm = 1e3 * plates.offset_std_m
        tilt_deg = np.degrees(plates.tilt_rad)
        tilt_std_deg = np.degrees(plates.tilt_std_rad)
        method = "the phase of their echoes" if plates.by_phase else "the range of their echoes"
        lines += [
            f"{head}: {plates.plates} flat plates lie {offset_mm:+z.2f} +- {offset_std_mm:.2f} mm from the rig file's"
            f" plane, by {method}: object_distance_mm = {distance_mm + offset_mm:.2f}",
            f"tilt: {tilt_deg[0]:+z.2f} +- {tilt_std_deg[0]:.2f} degrees along x,"
            f" {tilt_deg[1]:+z.2f} +- {tilt_std_deg[1]:.2f} along y",
        ]
    if plates.known and not sharpest.certain:
        return [*lines, "sharpness gives no plane (a narrow scan, or no points and edges in it); use the plates' plane"]
    lines += [
        f"{head}: the plane is sharpest {sharpest.depth_mm:+z.2f} mm from the rig file's:"
        f" object_distance_mm = {distance_mm + sharpest.depth_mm:.2f}",
        f"tilt: {sharpest.tilt_deg[0]:+z.2f} degrees along x, {sharpest.tilt_deg[1]:+z.2f} along y;"
        f" sharpness {sharpest.gain:.3f} times the rig file's plane",
    ]
    if not plates.known and not sharpest.certain:
        lines.append(
            "do not rely on it: there is no flat plate, and the sharpness hardly changes over the sweep (a narrow scan,"
            " or no points and edges in it), or the plane lies at the end of the sweep (give a larger --depth)"
        )
    return lines


def sync_report(data: Path, out: Path, config: Path | None) -> int:
    """Write figures, JSON and text of the residual errors of synchronisation; return 0. Raises PolysightError."""
    from polysight.calibration import read_board_rows
    from polysight.report import SyncReport, write_sync_report
    from polysight.sync import BoardSetup, synchronise_row

    check_results_folder(out)
    source = raw_source(open_source(data, config), data)
    calibration = load_scan_calibration(source)
    rig = calibration.rig(source.instrument)
    chirp = rig.chirp
    reports = {}
    for board in rig.receivers:
        setup = BoardSetup.from_rig(rig, board, model=calibration.high_pass(board.name))
        # The search beam for the direct path has one weight for each RX.
        rx = len(setup.path.beam)
        report = reports[board.name] = SyncReport(chirp.sample_rate_hz, chirp.linear_samples, rx)
        say(f"rows of {board.name}")
        for _, words, valid in read_board_rows(source, board.name):
            report.add(synchronise_row(words, valid, setup))
    sys.stdout.write(write_sync_report(out, reports, source.scan_id, source.simulated))
    return 0
