"""`polysight calibrate` and `polysight leakage`: calibration of the rig from recorded scans.

Each `calibrate` command looks at scans, writes one dated file (`metal` also its images), and prints the keys
of the rig file that use it; neither the scans nor the rig file are written. `leakage` writes no file, and prints what
belongs into the rig file's [polarimetry].
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polysight.calibration import (
    CalibrationFile,
    FilterFile,
    StartFile,
    make_header,
    make_source_entry,
    open_raw,
    write_calibration,
)
from polysight.imaging import Image, Mask
from polysight.jobs.output import load_rig_file, print_json, print_lines, say, steps
from polysight.jobs.process import form_scan_images, load_reference, make_plane_reference
from polysight.polarimetry import Leakage, estimate_leakage_from_images, specular_incidence_rad
from polysight.settings import Settings, path_text
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode
from polysight_shared.files import require_writable_folder
from polysight_shared.tables import to_builtins

# Least number of pixels that show metal in all scans of `leakage`; chosen. Each quarter of the plane, from which the
# error is estimated, has 25 of them.
LEAST_PIXELS = 100
# Smallest standard error of a leakage. Errors of the plate and the strips themselves do not show in an estimate.
LEAST_LEAKAGE_STD = 1e-3
# Largest leakage of a rig: real mounts leak up to 0.1, while a plate that was scanned instead of strips gives 1.
MAX_LEAKAGE = 0.5


def print_result(
    path: Path, file: CalibrationFile, lines: Sequence[str], what_to_set: Sequence[str], as_json: bool
) -> int:
    """Print a calibration as lines, with `what_to_set` in the rig file, or the file's content as JSON; return 0."""
    if as_json:
        print_json({"file": str(path), "simulated": file.simulated, **to_builtins(file)})
        return 0
    head_line = "SIMULATED data: not usable for a real rig" if file.simulated else "measured"
    scans = ", ".join(f"{s.scan_id} ({s.rows} rows)" for s in file.sources)
    sys.stdout.write(f"{head_line}: {scans}\n" + "".join(f"  {line}\n" for line in lines))
    sys.stdout.write(f"written: {path}\nnothing else was changed; to use it, in the rig file:\n")
    sys.stdout.write("".join(f"  {line}\n" for line in what_to_set))
    return 0


def take_antenna_places(scanned_rig: Instrument, other_rig: Instrument) -> Instrument:
    """Return a scan's rig with antennas, mounts and object plane of another rig file. Raises ConfigError."""
    mounts = {b.name: b.mount for b in other_rig.boards}
    if set(mounts) != {b.name for b in scanned_rig.boards}:
        raise ConfigError(
            f"the rig file has the boards {sorted(mounts)}",
            "it belongs to another rig",
            "give the rig file of the scan",
        )
    boards = tuple(msgspec.structs.replace(b, mount=mounts[b.name]) for b in scanned_rig.boards)
    return msgspec.structs.replace(scanned_rig, boards=boards, antennas=other_rig.antennas, geometry=other_rig.geometry)


def rig_file_keys(kind: str, path: Path) -> list[str]:
    """Return the lines of the rig file that name a calibration file."""
    return ["[calibration]", f'{kind} = "{path.resolve()}"']


def direct_path(scan: Path, target: Path, config: Path | None, prior_mm: float, out: Path, as_json: bool) -> int:
    """Calibrate positions of boards and plane with a scan of known points; return 0. Raises PolysightError.

    `target` is the file of the points, `prior_mm` the standard deviation of the rig file's positions before the scan.
    """
    from polysight.calibration import Prior, fit_places, load_echoes, load_scan_calibration, places_file, read_target

    require_writable_folder(out.absolute())
    points = read_target(target)
    rig_file = load_rig_file(config)
    source = open_raw(scan, rig_file)
    rig = source.instrument
    if rig_file is not None:
        rig = take_antenna_places(rig, rig_file)
    calibration = load_scan_calibration(source)
    filters = {place.name: calibration.high_pass(place.name) for place in rig.receivers}
    say("places of boards and plane")
    fit = fit_places(load_echoes(source, rig, filters), rig, points, Prior(board_mm=prior_mm, plane_mm=prior_mm))
    file = places_file(rig, fit, len(points), [make_source_entry(source, scan)])
    path = write_calibration(file, out)
    lines = []
    for name, place in file.boards.items():
        shift = ", ".join(f"{v:+z.2f} +- {e:.2f}" for v, e in zip(place.shift_mm, place.standard_error_mm, strict=True))
        lines += [
            f"{name}: shifted by ({shift}) mm in x, y, z",
            f"{name}: direct path to RX1 {place.direct_path_was_mm:.2f} -> {place.direct_path_mm:.2f}"
            f" +- {place.direct_path_standard_error_mm:.2f} mm",
        ]
        # If the error is more than half of the prior's (chosen), most of the result comes from the prior.
        lines += [
            f"{name}: the scan does not show its shift along {axis}; a scan with a wider aperture does"
            for axis, e in zip("xyz", place.standard_error_mm, strict=True)
            if e > prior_mm / 2
        ]
    lines += [
        f"object plane: {file.object_distance_was_mm:.2f} -> {file.object_distance_mm:.2f}"
        f" +- {file.object_distance_standard_error_mm:.2f} mm",
        f"the target lay at ({file.target_mm[0]:+z.2f}, {file.target_mm[1]:+z.2f}) mm, turned by"
        f" {file.target_turn_deg:+z.2f} degrees; its points explain {100 * file.explained:.1f} % of the echoes",
    ]
    return print_result(path, file, lines, rig_file_keys("direct_path", path), as_json)


def hpf(scans: Sequence[Path], config: Path | None, out: Path, as_json: bool) -> int:
    """Calibrate the receivers' high-pass filters with scans at several start frequencies; return 0.

    Raises PolysightError.
    """
    from polysight.calibration import fit_filter

    require_writable_folder(out.absolute())
    rig = load_rig_file(config)
    sources = [open_raw(folder, rig) for folder in scans]
    corners_khz = {(s.instrument.chirp.hpf1_khz, s.instrument.chirp.hpf2_khz) for s in sources}
    if len(corners_khz) > 1:
        raise DataError(
            f"the scans have different filters: {sorted(corners_khz)} kHz",
            "they belong to several sweeps",
            "give the scans of one sweep",
        )
    names = [board_filter.name for board_filter in sources[0].instrument.receivers]
    boards = {name: fit_filter(sources, name) for name in steps(names, [f"filters of {name}" for name in names])}
    source_scans = [make_source_entry(source, folder) for source, folder in zip(sources, scans, strict=True)]
    file = FilterFile(**make_header("hpf", source_scans), boards=boards)
    path = write_calibration(file, out)
    lines = []
    for name, board_filter in boards.items():
        corners = zip(
            board_filter.programmed_khz, board_filter.corners_khz, board_filter.standard_error_khz, strict=True
        )
        text = ", ".join(
            f"{programmed:.0f} -> {corner:.1f} +- {error:.1f} kHz" for programmed, corner, error in corners
        )
        lines.append(
            f"{name}: corners {text}; IF {board_filter.if_from_khz:.0f}..{board_filter.if_to_khz:.0f} kHz,"
            f" {board_filter.chirps} chirps, the fit leaves {board_filter.residual_db:.2f} dB"
        )
    return print_result(path, file, lines, rig_file_keys("hpf", path), as_json)


def metal(scan: Path, config: Path | None, bands: int, out: Path, as_json: bool) -> int:
    """Calibrate gains per pixel and sub-band with a scan of a metal plate; return 0. Raises PolysightError."""
    from polysight.calibration import MetalFile, read_calibration, write_metal
    from polysight.imaging import sub_bands

    require_writable_folder(out.absolute())
    source = open_raw(scan, load_rig_file(config))
    parts = ()
    if bands > 1:
        parts = sub_bands(source.instrument.chirp, bands)
    path = write_metal(load_reference(scan, config, bands), [make_source_entry(source, scan)], out, parts)
    file = read_calibration(path, MetalFile, "metal")
    lines = [
        f"metal on {100 * file.share_of_plane:.0f} % of the image; elsewhere pixels are masked",
        f"gains vary over it by {file.h_variation_db:.2f} dB (H), {file.v_variation_db:.2f} dB (V),"
        f" {file.ratio_variation_db:.2f} dB and {file.ratio_variation_deg:.1f} degrees (H / V)",
        f"scatter of its own pixels: {file.spread:.4f}",
        f"images: {file.images}, in the folder of the file",
    ]
    if file.bands:
        edges = ", ".join(f"{b.first_hz / 1e9:.2f}..{b.last_hz / 1e9:.2f}" for b in file.bands)
        lines.append(f"{len(file.bands)} sub-bands kept: {edges} GHz; for process --bands {len(file.bands)} alone")
    else:
        lines.append("sub-bands are not kept: calibrate with --bands K for process --bands K")
    return print_result(path, file, lines, rig_file_keys("metal", path), as_json)


def start_frequency(scan: Path, config: Path | None, out: Path, as_json: bool) -> int:
    """Choose start offsets that centre the direct paths in the IF band; return 0. Raises PolysightError."""
    from polysight.calibration import fit_start

    require_writable_folder(out.absolute())
    source = open_raw(scan, load_rig_file(config))
    names = [start.name for start in source.instrument.receivers]
    boards = {name: fit_start(source, name) for name in steps(names, [f"direct path of {name}" for name in names])}
    file = StartFile(**make_header("start_frequency", [make_source_entry(source, scan)]), boards=boards)
    path = write_calibration(file, out)
    lines = []
    what_to_set = []
    rate_khz = source.instrument.chirp.sample_rate_hz / 1e3
    for name, start in boards.items():
        line = f"{name}: direct path at {start.direct_if_hz / 1e3:.1f}"
        line += f" +- {start.direct_if_standard_error_hz / 1e3:.1f} kHz"
        line += f" ({start.expected_if_hz / 1e3:.0f} kHz by the rig file)"
        if start.alias:
            line += f", an alias of {start.direct_if_hz / 1e3 + start.alias * rate_khz:.0f} kHz"
        lines += [
            line,
            f"{name}: start_offset_hz {start.start_offset_was_hz:.0f} -> {start.start_offset_hz:.0f} puts it at"
            f" {start.middle_hz / 1e3:.0f} kHz; where mmWave Studio programs the board:"
            f" {start.start_offset_hz - start.start_offset_was_hz:+z.0f} Hz to its start frequency",
        ]
        what_to_set += [f'[[boards]]  name = "{name}"', f"start_offset_hz = {start.start_offset_hz:.0f}"]
    return print_result(path, file, lines, what_to_set, as_json)


def leakage_of_scans(
    plate: Path, strips: Sequence[tuple[float, Path]], config: Path | None = None
) -> tuple[Leakage, dict[str, Any]]:
    """Estimate leakage and gain imbalance from scans of a metal plate and of metal strips in its place.

    Parameters
    ----------
    plate
        Scan of a whole metal plate that covers the plane.
    strips
        (degrees from the vertical towards +x, scan) of strips that cover the plane, in two orientations or more. A
        single orientation gives only the axial ratio: then both boards get the same leakage.
    config
        Rig file for scans in the authors' layout.

    Returns
    -------
    leakage, facts
        The facts are a dictionary: `scans` (their names), `simulated`, `pixels`, `leakage_std`, `incidence_deg`.

    Raises
    ------
    DataError
        when the scans are of different rigs, do not show metal at the same pixels, or are too alike in orientation,
        or when the leakage is above `MAX_LEAKAGE`.
    """
    settings = Settings(config=path_text(config))
    pipeline, images = form_scan_images(plate, settings)
    plate_reference = make_plane_reference(pipeline, images)
    theta = specular_incidence_rad(pipeline.rig)
    mask = plate_reference.valid & images.valid
    strips_by_angle = []
    names = [pipeline.source.scan_id]
    simulated = pipeline.source.simulated
    for degrees, folder in strips:
        strips_pipeline, strip_images = form_scan_images(folder, settings)
        plate_reference.check_rig(strips_pipeline.calibration.describe_imaging(strips_pipeline.rig), str(plate))
        plate_reference.check_axes(strip_images.x_m, strip_images.y_m)
        mask = mask & strip_images.valid
        strips_by_angle.append((float(np.radians(degrees)), strip_images.h, strip_images.v))
        names.append(strips_pipeline.source.scan_id)
        simulated = simulated or strips_pipeline.source.simulated
    if int(mask.sum()) < LEAST_PIXELS:
        raise DataError(
            f"the scans show metal at {int(mask.sum())} common pixels only",
            "plate and strips must cover the same part of the plane",
            "scan them in the same place, larger than the grid on every side",
        )
    leakage = estimate_leakage_from_images((plate_reference.h, plate_reference.v), strips_by_angle, mask, theta)
    largest = max(abs(leakage.h), abs(leakage.v))
    if largest > MAX_LEAKAGE:
        raise DataError(
            f"a leakage of {largest:.2f}: that of a rig is below {MAX_LEAKAGE}",
            "the strips' scan shows a whole plate, or strips at another angle",
            "correct the angle, DEG of --strips DEG=SCAN, or scan the strips again",
            code=ErrorCode.VALUE_INVALID,
        )
    std = _estimate_leakage_std((plate_reference.h, plate_reference.v), strips_by_angle, mask, theta)
    facts = {"scans": names, "simulated": simulated, "pixels": int(mask.sum()), "leakage_std": std}
    return leakage, {**facts, "incidence_deg": float(np.degrees(theta))}


def _estimate_leakage_std(
    plate: tuple[Image, Image], strips: Sequence[tuple[float, Image, Image]], mask: Mask, theta_rad: float
) -> float:
    """Return the standard error of each part of the leakage, from the differences between the quarters of the plane.

    Errors by edges, by wires that are not straight and by uneven illumination differ from place to place, as speckle
    does. Therefore the mean of four quarters has half of the standard deviation of one. The result is at least
    `LEAST_LEAKAGE_STD`, which is also returned if fewer than two quarters can be used.
    """
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    middle = [float(np.median(index[mask])) for index in (rows, columns)]
    parts = []
    for up in (rows > middle[0], rows <= middle[0]):
        for right in (columns > middle[1], columns <= middle[1]):
            try:
                quarter = estimate_leakage_from_images(plate, strips, mask & up & right, theta_rad)
            except DataError:
                continue
            parts.append([quarter.h.real, quarter.h.imag, quarter.v.real, quarter.v.imag])
    if len(parts) < 2:
        return LEAST_LEAKAGE_STD
    return max(LEAST_LEAKAGE_STD, float(np.sqrt(np.mean(np.var(parts, axis=0, ddof=1)))) / 2)


def leakage(plate: Path, strips: Sequence[tuple[float, Path]], config: Path | None, as_json: bool) -> int:
    """`polysight leakage`: print the keys for the rig file's [polarimetry]; return the exit status."""
    measured, facts = leakage_of_scans(plate, strips, config)
    leakage_h = [round(measured.h.real, 5), round(measured.h.imag, 5)]
    leakage_v = [round(measured.v.real, 5), round(measured.v.imag, 5)]
    imbalance_db = 20 * float(np.log10(abs(measured.imbalance)))
    imbalance_deg = float(np.degrees(np.angle(measured.imbalance)))
    if as_json:
        content = {
            **facts,
            "leakage_h": leakage_h,
            "leakage_v": leakage_v,
            "imbalance_db": imbalance_db,
            "imbalance_deg": imbalance_deg,
            "residual_rad": measured.residual,
            "alike": len(strips) == 1,
        }
        print_json(content)
        return 0
    lines = []
    if facts["simulated"]:
        lines.append("# simulated scans")
    if len(strips) == 1:
        lines.append("# one orientation: both boards are assumed to have the same leakage (the axial ratio)")
    lines += [
        "[polarimetry]",
        f"leakage_h = {leakage_h}",
        f"leakage_v = {leakage_v}",
        f"leakage_std = {facts['leakage_std']:.4f}",
    ]
    gain = f"# H over V in the images: {imbalance_db:+z.2f} dB, {imbalance_deg:+z.1f} degrees"
    gain += f"; from {facts['pixels']} pixels"
    # With two orientations there are as many equations as unknowns, so that the standards always agree.
    if len(strips) > 2:
        gain += f", the standards agree within {measured.residual:.4f} rad"
    print_lines([*lines, gain])
    return 0
