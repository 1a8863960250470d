"""`polysight surface` and `polysight calibrate sphere`: shape and permittivity of curved and tilted objects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from polysight.calibration import SphereFile, header, open_raw, source_scan, write_calibration
from polysight.jobs.output import print_json, print_lines, say
from polysight.jobs.process import processed_rows
from polysight.pipeline import Pipeline
from polysight.settings import Settings, path_text
from polysight.store import open_source
from polysight.surfaces import (
    Echoes,
    Gains,
    Optics,
    Samples,
    Seen,
    Surface,
    Uncertainty,
    analyse_surface,
    learn_gains,
    optics_of,
    plain_segment,
    see_points,
    shape_of,
    summary_lines,
    voltages_of,
    write_surface,
)
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

# Fronts of objects lie up to this before or behind the object plane.
DEPTH_M = 0.12
# Points of the metal sphere that the calibration file keeps.
KEPT_POINTS = 240
LEAST_METAL_POINTS = 60
# Standard errors of places that were measured by hand, and of those that `calibrate direct-path` measured.
PLACE_STD_M = 1e-3
CALIBRATED_PLACE_STD_M = 3e-4
# Axes of polarisation follow the boards, which are mounted to about a degree.
AXIS_STD_RAD = 0.0175

Reference = Callable[[Optics], Gains]


def samples_of(pipeline: Pipeline) -> tuple[Samples, Samples]:
    """Return the samples of H and V that a pipeline holds, x from TX to RX."""
    found = []
    for board in pipeline.images.boards.values():
        aperture = board.aperture
        cube, valid, offsets = board.calibrated(), board.valid, aperture.offsets_m
        tx_m, rx_m = aperture.antennas.tx_m, aperture.antennas.rx_m
        if pipeline.source.mirrored:
            # Recorded by columns: the builder holds the scan mirrored in x = y.
            swap = [1, 0, 2]
            cube, valid, offsets = np.swapaxes(cube, 2, 3), valid.T, np.swapaxes(offsets, 0, 1)[..., swap]
            tx_m, rx_m = tx_m[swap], rx_m[:, swap]
        found.append(Samples(cube, valid, offsets, aperture.frequencies_hz, tx_m, rx_m, board.model))
    return found[0], found[1]


def uncertainty_of(rig: Instrument, *, places_known: bool) -> Uncertainty:
    """Return the standard errors of leakage, axes and places of a rig."""
    polarimetry = rig.polarimetry
    # Unmeasured, its size is that of a complex number.
    leakage = polarimetry.leakage_prior / np.sqrt(2)
    if polarimetry.leakage_std is not None:
        leakage = polarimetry.leakage_std
    return Uncertainty(float(leakage), AXIS_STD_RAD, CALIBRATED_PLACE_STD_M if places_known else PLACE_STD_M)


def optics_of_rig(rig: Instrument) -> Optics:
    """Return the antennas of a rig with its leakage, if measured."""
    polarimetry = rig.polarimetry
    if polarimetry.leakage_std is None:
        return optics_of(rig)
    return optics_of(rig, (complex(*polarimetry.leakage_h), complex(*polarimetry.leakage_v)))


def seen_by(data: Path, config: Path | None) -> tuple[Pipeline, Optics, Seen]:
    """Process the rows of a scan, and find the specular points in it. Raises PolysightError."""
    source = open_source(data, config, dropped=True)
    pipeline = processed_rows(source, data, Settings(config=path_text(config), depth_range_mm=1e3 * DEPTH_M))
    optics = optics_of_rig(pipeline.rig)
    h, v = samples_of(pipeline)
    low, high = pipeline.images.gate_m
    direct_m = float(h.direct_m.mean())
    say("specular points")
    seen = see_points(h, v, optics, (low + direct_m, high + direct_m))
    if not len(seen):
        raise DataError(
            f"{data}: no surface shows a specular point",
            "nothing smooth faces the rig, or the objects lie outside the range gate",
            f"put objects within {1e3 * DEPTH_M:.0f} mm of the object plane; `polysight plan` shows visible normals",
            code=ErrorCode.NO_DATA,
        )
    return pipeline, optics, seen


def surface(data: Path, out: Path, config: Path | None, reference: Path | None, as_json: bool = False) -> int:
    """Write surface.npz, surface.ply and surface.png of a scan; return the exit status. Raises PolysightError."""
    from polysight.report import surface_figure

    made = make_surface(data, config, reference)
    write_surface(out, made)
    (out / "surface.png").write_bytes(surface_figure(made))
    if as_json:
        print_json(
            {
                "scan_id": made.scan_id,
                "simulated": made.simulated,
                "segments": [plain_segment(s) for s in made.segments],
            }
        )
    else:
        print_lines([*summary_lines(made), f"surface: {out / 'surface.npz'}, surface.ply, surface.png"])
    return 0


def make_surface(data: Path, config: Path | None = None, reference: Path | None = None) -> Surface:
    """Return the surfaces of a recorded scan; `reference` is a scan of a flat metal plate. Raises PolysightError."""
    pipeline, optics, seen = seen_by(data, config)
    calibration = pipeline.calibration
    gains: Reference | None = None
    if reference is not None:
        _, _, metal = seen_by(reference, config)
        gains = gains_of(metal[metal.segment == 0])
    elif calibration.sphere is not None:
        gains = gains_of(points_of(calibration.sphere))
    return analyse_surface(
        seen,
        optics,
        gains,
        uncertainty=uncertainty_of(pipeline.rig, places_known=calibration.places is not None),
        scan_id=pipeline.source.scan_id,
        simulated=pipeline.source.simulated,
    )


def gains_of(metal: Seen) -> Reference:
    """Return the gains that points of metal give, for any rig; each is computed once."""
    known: dict[int, tuple[Optics, Gains]] = {}

    def learn(optics: Optics) -> Gains:
        if id(optics) not in known:
            known[id(optics)] = (optics, learn_gains(voltages_of(metal, optics), optics.wave_number))
        return known[id(optics)][1]

    return learn


def points_of(file: SphereFile) -> Seen:
    """Return the points of a metal sphere from its calibration file."""
    h, v = (_echoes_of(np.array(file.points[channel])) for channel in ("h", "v"))
    return Seen(h, v, np.zeros(len(h), int))


def _columns_of(echoes: Echoes) -> list[list[float]]:
    bend = echoes.bend
    columns = [*echoes.at_m.T, echoes.path_m, *echoes.slope.T, bend[:, 0, 0], bend[:, 0, 1], bend[:, 1, 1]]
    columns += [echoes.amplitude.real, echoes.amplitude.imag, echoes.amplitude_std]
    return np.stack(columns, axis=1).tolist()


def _echoes_of(rows: np.ndarray) -> Echoes:
    at, path, slope, bends = rows[:, :3], rows[:, 3], rows[:, 4:6], rows[:, 6:9]
    bend = np.stack([bends[:, [0, 1]], bends[:, [1, 2]]], axis=1)
    zero = np.zeros(len(rows))
    return Echoes(at, path, slope, bend, rows[:, 9] + 1j * rows[:, 10], rows[:, 11], zero, np.zeros_like(slope), zero)


def sphere(scan: Path, radius_mm: float, config: Path | None, out: Path, as_json: bool) -> int:
    """`polysight calibrate sphere`: keep points of a metal sphere as reference of surfaces. Raises PolysightError."""
    from polysight.jobs.calibrate import print_result, rig_file_keys

    raw = open_raw(scan, None if config is None else load_instrument(config))
    _, optics, seen = seen_by(scan, config)
    metal = seen[seen.segment == 0]
    if len(metal) < LEAST_METAL_POINTS:
        raise DataError(
            f"{scan}: {len(metal)} points of the sphere, {LEAST_METAL_POINTS} are needed",
            "it hangs outside the grid, or another object is before it",
            "hang it so that its front is at the middle of the object plane",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    shape = shape_of(metal.h, optics)
    bends = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    radius_m = 1 / float(np.median(bends))
    centre = np.median(shape.points - radius_mm / 1e3 * shape.normals, axis=0)
    rest_m = np.linalg.norm(shape.points - centre, axis=1) - radius_mm / 1e3
    rest_m = float(np.median(np.abs(rest_m - np.median(rest_m))))
    if not 0.7 < 1e3 * radius_m / radius_mm < 1.4:
        raise DataError(
            f"{scan}: the surface has a radius of {1e3 * radius_m:.0f} mm, not {radius_mm:g}",
            "it is another object, or the boards stand elsewhere than the rig file says",
            "give the sphere's radius, or calibrate the places first",
            code=ErrorCode.MISMATCH,
        )
    chosen = np.linspace(0, len(metal) - 1, min(KEPT_POINTS, len(metal))).round().astype(int)
    kept = metal[chosen]
    gains = learn_gains(voltages_of(kept, optics), optics.wave_number)
    file = SphereFile(
        **header("sphere", [source_scan(raw, scan)]),
        radius_mm=radius_mm,
        radius_found_mm=1e3 * radius_m,
        centre_mm=(1e3 * float(centre[0]), 1e3 * float(centre[1]), 1e3 * float(centre[2])),
        misfit_mm=1e3 * rest_m,
        gain_std=gains.std,
        points={"h": _columns_of(kept.h), "v": _columns_of(kept.v)},
    )
    path = write_calibration(file, out)
    low, high = (np.degrees(np.arcsin(edge)) for edge in gains.covered)
    lines = [
        f"sphere of {1e3 * radius_m:.1f} mm (given: {radius_mm:g}), its points scatter by {1e3 * rest_m:.2f} mm",
        f"directions of arrival {low[0]:.0f}..{high[0]:.0f} degrees in x, {low[1]:.0f}..{high[1]:.0f} in y",
        f"H / V is known to {100 * gains.std:.2f} %",
    ]
    return print_result(path, file, lines, rig_file_keys("sphere", path), as_json)
