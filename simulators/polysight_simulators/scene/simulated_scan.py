"""Simulate a whole scan without sockets: raw data in either layout, with truth.json."""

import json
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.geometry import Vector, incidence_deg, specular_midpoint_m
from polysight_shared.raster import Grid, RasterPlan, Row, check_burst_fits, mean_burst_travel_mm, plan_raster
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import layouts
from polysight_simulators.scene.radar import SimulatedRig
from polysight_simulators.scene.scene_file import Pair, Plate, Scene, apply_scene, draw_specimens, stream_key

Progress = Callable[[int, int], None]
# Largest row of a board. Chosen: six times this is in memory, and a row of the published scan has 22.9 MB.
MAX_ROW_BYTES = 100_000_000


def truth(rig: Instrument, scene: Scene, seed: int) -> dict[str, Any]:
    """Return the content of truth.json: true plates and points, disturbances, scene, seed, versions.

    `rig` has the scene applied. In the entry of a plate, `centre_m` is in the rig frame, at the plate's true height.
    `permittivity` is the drawn [eps', eps''], or null (metal, layers); `nominal_permittivity` is that of the scene
    file. Tilt and height are relative to the plane of the rig file and include those of the true plane.
    """
    centre = specular_midpoint_m(rig, rig.by_role("receive_h"))
    actual = draw_specimens(scene)
    plates = [_describe_plate(p, n, centre) for p, n in zip(actual.plates, scene.plates, strict=True)]
    points = [
        {
            "name": p.name,
            "position_mm": list(p.position_mm),
            "position_m": _convert_to_rig_frame(p.position_mm, p.height_mm, centre),
            "height_mm": p.height_mm,
            "amplitude": list(p.amplitude),
        }
        for p in actual.points
    ]
    return {
        "simulated": True,
        "seed": seed,
        "versions": layouts.versions(),
        "image_centre_m": list(centre),
        "incidence_deg": {b.name: incidence_deg(rig, b) for b in rig.receivers},
        "mean_burst_travel_mm": mean_burst_travel_mm(rig.burst, rig.stage),
        "plates": plates,
        "points": points,
        "shapes": [
            {**msgspec.to_builtins(shape), "front_m": _convert_to_rig_frame(shape.centre_mm, shape.height_mm, centre)}
            for shape in actual.shapes
        ],
        "direct_path": scene.disturbances.direct_gain > 0,
        "scene": {**to_builtins(scene), "disturbances": msgspec.to_builtins(scene.disturbances)},
    }


def _describe_plate(plate: Plate, nominal: Plate, centre_m: Vector) -> dict[str, Any]:
    """Return the entry of a drawn plate, with the nominal values of the scene file."""
    return {
        "name": plate.name,
        "centre_mm": list(plate.centre_mm),
        "centre_m": _convert_to_rig_frame(plate.centre_mm, plate.height_mm, centre_m),
        "size_mm": list(plate.size_mm),
        "permittivity": None if plate.permittivity is None else list(plate.permittivity),
        "nominal_permittivity": None if nominal.permittivity is None else list(nominal.permittivity),
        "metal": plate.metal and plate.strips_deg is None,
        "background": plate.background,
        "strips_deg": plate.strips_deg,
        "thickness_mm": plate.thickness_mm,
        "layers": [msgspec.to_builtins(layer) for layer in plate.layers],
        "nominal_layers": [msgspec.to_builtins(layer) for layer in nominal.layers],
        "tilt_deg": list(plate.tilt_deg),
        "height_mm": plate.height_mm,
        "rough_mm": plate.rough_mm,
        "rough_length_mm": plate.rough_length_mm,
    }


def _convert_to_rig_frame(at_mm: Pair, height_mm: float, centre_m: Vector) -> list[float]:
    """Return a position on the plane with a height, in the rig frame, metres."""
    return [centre_m[0] + at_mm[0] / 1e3, centre_m[1] + at_mm[1] / 1e3, centre_m[2] + height_mm / 1e3]


def row_offsets_mm(radar: SimulatedRig, row: Row) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the true stage offsets x_mm, y_mm of every chirp of a row in order of time, [points * chirps a point]."""
    x = (np.array(row.x_mm)[:, None] + radar.burst_mm(row.direction)).ravel()
    return x, np.full(len(x), row.y_mm)


def find_lost_bytes(radar: SimulatedRig, board_name: str, row: Row) -> layouts.Gaps:
    """Return the byte ranges of a row in lost packets, sorted and merged."""
    loss = radar.scene.disturbances.packet_loss
    size = row.points * radar.rig.burst.pulses * radar.rig.frame_bytes
    full_packet_bytes = layouts.packet_payload_bytes(radar.rig)
    if loss == 0.0:
        return []
    rng = np.random.default_rng([stream_key(radar.seed, "loss", board_name), row.index])
    gaps: layouts.Gaps = []
    for k in np.flatnonzero(rng.random(-(-size // full_packet_bytes)) < loss):
        start = int(k) * full_packet_bytes
        stop = min((int(k) + 1) * full_packet_bytes, size)
        if gaps and gaps[-1][1] == start:
            gaps[-1] = (gaps[-1][0], stop)
        else:
            gaps.append((start, stop))
    return gaps


def simulate(
    rig: Instrument,
    scene: Scene,
    out: Path,
    layout: str = "own",
    seed: int | None = None,
    started_s: float | None = None,
    zero_filling: bool = True,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
    by_columns: bool = False,
    skipped: layouts.Skipped | None = None,
) -> Path:
    """Write a scan of a scene.

    Parameters
    ----------
    rig, scene
        Rig file and scene; the scene's overrides are applied.
    out, layout
        Output folder, created if missing. "own": a scan folder at `out`. "authors": `out`/unsynced/<scan>, with the
        transmitting board's data.
    seed
        None: the scene's. The same seed gives the same raw bytes.
    started_s
        Unix time of the scan's start; None: now.
    cache_dir, progress
        Folder that caches object fields (None: no cache); callback with rows done and total rows.
    zero_filling, by_columns, skipped
        Authors' layout only: see :class:`polysight_simulators.scene.layouts.AuthorsLayout`.

    Returns
    -------
    Folder to process: the scan folder, or unsynced/<scan>.

    Raises
    ------
    ConfigError
        if the scene does not fit the rig, or a burst does not end before the next point.
    DataError
        if the folder is not empty.
    """
    radar = SimulatedRig(rig, _widen_scene(scene, rig) if by_columns else scene, seed, cache_dir)
    rig = apply_scene(rig, scene)
    plan = _plan(rig, by_columns)
    if started_s is None:
        started_s = time.time()
    scan_id = layouts.make_scan_id(scene.name)
    if layout == "own":
        stamp = datetime.fromtimestamp(started_s, UTC).isoformat(timespec="seconds")
        boards = rig.recorded
        writer: layouts.OwnLayout | layouts.AuthorsLayout = layouts.OwnLayout(out, rig, plan, scan_id, stamp)
    else:
        boards = rig.boards
        writer = layouts.AuthorsLayout(
            path=out,
            rig=rig,
            scan_id=scan_id,
            started_s=started_s,
            zero_filling=zero_filling,
            by_columns=by_columns,
            skipped=skipped,
        )
    layouts.require_empty(writer.folder)
    # Done before the first file is written: a scene that cannot be simulated then leaves no folder.
    radar.prepare()
    writer.start()
    for row in plan:
        x, y = row_offsets_mm(radar, row)
        if by_columns:
            x, y = y, x
        first_chirp = row.index * len(x)
        payloads = {b.name: radar.chirps(b.name, x, y, first_chirp) for b in boards}
        writer.write_row(row, payloads, {b.name: find_lost_bytes(radar, b.name, row) for b in boards})
        if progress is not None:
            progress(row.index + 1, plan.rows)
    facts = {**truth(rig, scene, radar.seed), "scan_id": scan_id, "samples_clipped": radar.clipped}
    (writer.folder / "truth.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    # This is done last: if the program ends before, the scan is unfinished.
    writer.end()
    if layout == "authors":
        # The authors' files contain neither geometry nor filter nor leakage.
        (writer.folder / "instrument.toml").write_bytes(tomli_w.dumps(to_builtins(rig)).encode())
    return writer.folder


def _plan(rig: Instrument, by_columns: bool) -> RasterPlan:
    """Return the plan of the rig's grid. Raises ConfigError if a burst does not end before the next point."""
    if by_columns:
        grid = _transpose_grid(rig.grid)
    else:
        grid = rig.grid
    check_burst_fits(grid, rig.burst, rig.stage)
    _check_row_size(rig, grid)
    return plan_raster(grid)


def _check_row_size(rig: Instrument, grid: Grid) -> None:
    """Raise ConfigError if a row does not fit in the memory."""
    row_bytes = grid.columns * rig.burst.pulses * rig.frame_bytes
    if row_bytes > MAX_ROW_BYTES:
        raise ConfigError(
            f"a row of {grid.columns} positions, each of {rig.burst}, has {row_bytes / 1e6:.0f} MB a board",
            f"rows are simulated whole in memory, up to {MAX_ROW_BYTES / 1e6:.0f} MB a board",
            "lower grid.columns, burst.pulses or burst.chirps",
            code=ErrorCode.VALUES_CONFLICT,
        )


def _transpose_grid(grid: Grid) -> Grid:
    """Return the grid with rows and columns swapped."""
    return Grid(columns=grid.rows, rows=grid.columns, step_x_mm=grid.step_y_mm, step_y_mm=grid.step_x_mm)


def _widen_scene(scene: Scene, rig: Instrument) -> Scene:
    """Return the scene with one more row above and below, for bursts that travel along y."""
    grid = to_builtins(apply_scene(rig, scene).grid)
    return msgspec.structs.replace(scene, grid={**grid, "rows": grid["rows"] + 2})
