"""`polysight surface` and `polysight calibrate sphere`: shape and permittivity of curved and tilted objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polysight.calibration import SphereFile, make_header, make_source_entry, open_raw, write_calibration
from polysight.jobs import measure_surfaces
from polysight.jobs.output import load_rig_file, print_json, print_lines, say
from polysight.jobs.process import process_rows
from polysight.materials import WEAK_V_DB
from polysight.pipeline import Pipeline
from polysight.products import check_results_folder
from polysight.settings import Settings
from polysight.store import open_source
from polysight.surfaces import (
    Echoes,
    Gains,
    Optics,
    Reference,
    SeenEchoes,
    Surface,
    find_shape,
    find_voltages,
    join_turned,
    learn_gains,
    make_optics,
    mirror_point,
    plain_segment,
    summary_lines,
)
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode
from polysight_shared.files import require_writable_folder

# Largest distance of the front of an object from the object plane, to either side; chosen.
DEPTH_M = 0.12
# Least number of points of a metal sphere for its radius and gains; chosen. Fewer points do not cover the directions of
# arrival.
LEAST_METAL_POINTS = 60
# Largest relative deviation of the measured radius from the given one: a larger one means another object. The radius of
# a metal sphere of 125 mm is found within 0.5 %, also with antennas misplaced by 1 mm (simulated).
RADIUS_TOLERANCE = 0.15


def process_to_points(data: Path, rig: Path | Instrument | None) -> tuple[Pipeline, Optics, SeenEchoes]:
    """Process the rows of a scan, and find the specular points in it. Raises PolysightError.

    `rig`: rig, or rig file, of published data; a scan folder has its own.
    """
    # If the raw data was deleted, the samples that the scan folder keeps are used.
    source = open_source(data, rig, dropped=True)
    pipeline = process_rows(source, data, Settings(depth_range_mm=1e3 * DEPTH_M))
    optics = measure_surfaces.make_rig_optics(pipeline.rig)
    say("specular points")
    points = measure_surfaces.find_points_in_rows(pipeline, optics)
    if not len(points):
        raise DataError(
            f"{data}: no surface shows a specular point",
            "nothing smooth faces the rig, or the objects lie outside the range gate",
            f"put objects within {1e3 * DEPTH_M:.0f} mm of the object plane; `polysight plan` shows visible normals",
            code=ErrorCode.NO_DATA,
        )
    return pipeline, optics, points


def surface(
    scans: Sequence[Path],
    out: Path,
    config: Path | None,
    reference: Path | None,
    turned_deg: Sequence[float] = (),
    axis_mm: tuple[float, float] | None = None,
    as_json: bool = False,
) -> int:
    """Write surface.npz, surface.ply and surface.png of scans; return the exit status. Raises PolysightError.

    Several scans are of one object on a turntable, which had turned by `turned_deg` about a vertical axis at `axis_mm`:
    x from the middle of the grid, z from the object plane (None: 0, 0).
    """
    check_results_folder(out)
    check_turns(len(scans), turned_deg)
    surfaces = [make_surface(scan, config, reference) for scan in scans]
    joined = surfaces[0]
    if len(surfaces) > 1:
        rig = open_source(scans[0], config, dropped=True).instrument
        joined = join_turned(surfaces, turned_deg, find_axis(rig, axis_mm or (0.0, 0.0)))
    measure_surfaces.save_surface(out, joined)
    if as_json:
        row = {
            "scan_id": joined.scan_id,
            "simulated": joined.simulated,
            "segments": [plain_segment(segment) for segment in joined.segments],
        }
        print_json(row)
    else:
        lines = summary_lines(joined)
        rig = open_source(scans[0], config, dropped=True).instrument
        if rig.polarimetry.leakage_std is None:
            lines.append("the rig's leakage was never measured, and widens all errors: measure it (polysight leakage)")
        print_lines([*lines, f"surface: {out / 'surface.npz'}, surface.ply, surface.png"])
    return 0


def check_turns(scans: int, turned_deg: Sequence[float]) -> None:
    """Raise ConfigError unless several scans have an angle each, and one scan has none."""
    expected = scans if scans > 1 else 0
    if len(turned_deg) != expected:
        raise ConfigError(
            f"{len(turned_deg)} angles with --turned for {scans} scans",
            "scans are joined by the angles of a turntable",
            "give one angle for each scan: `polysight surface A B C --turned 0,30,60 --out DIR`",
            code=ErrorCode.VALUES_CONFLICT,
        )


def find_axis(rig: Instrument, axis_mm: tuple[float, float]) -> tuple[float, float]:
    """Return x and z of a turntable's axis in the rig frame, metres.

    `axis_mm` is x from the middle of the grid and z from the object plane.
    """
    optics = make_optics(rig)
    middle_m = mirror_point(optics, rig.geometry.object_distance_mm / 1e3)
    return float(middle_m[0]) + axis_mm[0] / 1e3, float(middle_m[2]) + axis_mm[1] / 1e3


def make_surface(data: Path, rig: Path | Instrument | None = None, reference: Path | None = None) -> Surface:
    """Return the surfaces of a recorded scan; `reference` is a scan of a flat metal plate. Raises PolysightError."""
    pipeline, optics, points = process_to_points(data, rig)
    gains: Reference | None = None
    if reference is not None:
        _, _, metal = process_to_points(reference, rig)
        # The largest surface has the number 0.
        gains = measure_surfaces.make_reference(measure_surfaces.thin_out(metal[metal.segment == 0]))
    surface = measure_surfaces.analyse_points(pipeline, optics, points, gains)
    if not len(surface.segment):
        raise DataError(
            f"{data}: none of {len(points)} points lies on a surface",
            "only edges were seen: the object is too small, turned away, or reflects to positions that the stage "
            "does not reach",
            "turn the object towards the rig; `polysight plan` shows visible normals",
            code=ErrorCode.NO_DATA,
        )
    return surface


def check_is_metal(scan: Path, gains: Gains) -> None:
    """Raise DataError if V of a reference is weaker than any metal's, relative to the direct path."""
    if gains.v_over_h_db < WEAK_V_DB:
        raise DataError(
            f"{scan}: V is {-gains.v_over_h_db:.0f} dB weaker than H, relative to the direct path",
            "the reference is not of metal, which reflects both equally, or the cable of V is loose",
            "scan a bare metal sphere or plate alone",
            code=ErrorCode.MISMATCH,
        )


def _list_rows(echoes: Echoes) -> list[list[float]]:
    """Return a row of numbers for each point, as `SphereFile` stores it; three of them are the symmetric `bend`."""
    bend = echoes.bend
    columns = [*echoes.at_m.T, echoes.path_m, *echoes.slope.T, bend[:, 0, 0], bend[:, 0, 1], bend[:, 1, 1]]
    columns += [echoes.amplitude.real, echoes.amplitude.imag, echoes.amplitude_std, echoes.band_rise]
    return np.stack(columns, axis=1).tolist()


def sphere(scan: Path, radius_mm: float, config: Path | None, out: Path, as_json: bool) -> int:
    """`polysight calibrate sphere`: keep points of a metal sphere as reference of surfaces. Raises PolysightError."""
    from polysight.jobs.calibrate import print_result, rig_file_keys

    require_writable_folder(out.absolute())
    raw = open_raw(scan, load_rig_file(config))
    _, optics, points = process_to_points(scan, config)
    metal = points[points.segment == 0]
    if len(metal) < LEAST_METAL_POINTS:
        raise DataError(
            f"{scan}: {len(metal)} points of the sphere, {LEAST_METAL_POINTS} are needed",
            "the sphere hangs outside the grid, or another object hides it",
            "hang the sphere so that its front is at the middle of the object plane",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    shape = find_shape(metal.h, optics)
    # The principal curvatures are the eigenvalues of the symmetric part.
    curvatures = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    radius_m = 1 / float(np.median(curvatures))
    # The centre lies one radius behind each point, along its normal.
    centre = np.median(shape.points - radius_mm / 1e3 * shape.normals, axis=0)
    off_sphere_m = np.linalg.norm(shape.points - centre, axis=1) - radius_mm / 1e3
    scatter_m = float(np.median(np.abs(off_sphere_m - np.median(off_sphere_m))))
    if abs(1e3 * radius_m / radius_mm - 1) > RADIUS_TOLERANCE:
        raise DataError(
            f"{scan}: the surface has a radius of {1e3 * radius_m:.0f} mm, not {radius_mm:g}",
            "it is another object, or the boards are at other places than the rig file says",
            "give the sphere's true radius, or calibrate the places of the boards first",
            code=ErrorCode.MISMATCH,
        )
    chosen_metal = measure_surfaces.thin_out(metal)
    gains = learn_gains(find_voltages(chosen_metal, optics), optics.wave_number)
    check_is_metal(scan, gains)
    file = SphereFile(
        **make_header("sphere", [make_source_entry(raw, scan)]),
        radius_mm=radius_mm,
        radius_found_mm=1e3 * radius_m,
        centre_mm=(1e3 * float(centre[0]), 1e3 * float(centre[1]), 1e3 * float(centre[2])),
        misfit_mm=1e3 * scatter_m,
        gain_std=gains.std,
        points={"h": _list_rows(chosen_metal.h), "v": _list_rows(chosen_metal.v)},
    )
    path = write_calibration(file, out)
    low, high = (np.degrees(np.arcsin(edge)) for edge in gains.covered)
    lines = [
        f"sphere of {1e3 * radius_m:.1f} mm (given: {radius_mm:g}), its points scatter by {1e3 * scatter_m:.2f} mm",
        f"directions of arrival {low[0]:.0f}..{high[0]:.0f} degrees in x, {low[1]:.0f}..{high[1]:.0f} in y",
        f"H / V is known to {100 * gains.std:.2f} %",
    ]
    return print_result(path, file, lines, rig_file_keys("sphere", path), as_json)
