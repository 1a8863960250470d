"""A whole scan of a scene without sockets: raw data in either layout, and truth.json beside it."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from polysight.shared.config import Grid, Instrument, load_instrument
from polysight.shared.errors import ConfigError
from polysight.shared.geometry import incidence_deg, specular_midpoint_m
from polysight.shared.raster import Row, check_burst_fits, mean_burst_travel_mm, plan_raster
from polysight.shared.tables import to_builtins
from polysight.simulators.scene.layouts import Gaps, Layout, OwnLayout, packet_payload_bytes, versions
from polysight.simulators.scene.published_layout import AuthorsLayout, Skipped
from polysight.simulators.scene.radar import SimulatedRig
from polysight.simulators.scene.receiver import stream_key
from polysight.simulators.scene.scene_file import Scene, apply_scene, load_scene

Progress = Callable[[int, int], None]


def truth(rig: Instrument, scene: Scene, seed: int) -> dict[str, Any]:
    """What a simulated scan holds: plates and points with their true places and materials, scene, seed, versions.

    `rig` has the scene applied. `centre_m` is in the rig frame; permittivity is [eps', eps''] or null (metal,
    layers).
    """
    centre = specular_midpoint_m(rig, rig.by_role("receive_h"))
    plates = [
        {
            "name": p.name,
            "centre_mm": list(p.centre_mm),
            "centre_m": [centre[0] + p.centre_mm[0] / 1e3, centre[1] + p.centre_mm[1] / 1e3, centre[2]],
            "size_mm": list(p.size_mm),
            "permittivity": None if p.permittivity is None else list(p.permittivity),
            "metal": p.metal and p.strips_deg is None,
            "strips_deg": p.strips_deg,
            "thickness_mm": p.thickness_mm,
            "layers": [msgspec.to_builtins(layer) for layer in p.layers],
        }
        for p in scene.plates
    ]
    points = [
        {
            "name": p.name,
            "position_mm": list(p.position_mm),
            "position_m": [centre[0] + p.position_mm[0] / 1e3, centre[1] + p.position_mm[1] / 1e3, centre[2]],
            "amplitude": list(p.amplitude),
        }
        for p in scene.points
    ]
    return {
        "simulated": True,
        "seed": seed,
        "versions": versions(),
        "image_centre_m": list(centre),
        "incidence_deg": {b.name: incidence_deg(rig, b) for b in rig.receivers},
        "mean_burst_travel_mm": mean_burst_travel_mm(rig.burst, rig.stage),
        "plates": plates,
        "points": points,
        "scene": {**to_builtins(scene), "disturbances": msgspec.to_builtins(scene.disturbances)},
    }


def row_offsets_mm(radar: SimulatedRig, row: Row) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """True stage offsets of every chirp of a row in the order they happen: x_mm, y_mm, [points * pulses]."""
    x = (np.array(row.x_mm)[:, None] + radar.burst_mm(row.direction)).ravel()
    return x, np.full(len(x), row.y_mm)


def lost_bytes(radar: SimulatedRig, board_name: str, row: Row) -> Gaps:
    """Byte ranges of a row whose packets the network loses: sorted, touching ones joined."""
    loss = radar.scene.disturbances.packet_loss
    size = row.points * radar.rig.burst.pulses * radar.rig.frame_bytes
    full = packet_payload_bytes(radar.rig)
    if loss == 0.0:
        return []
    rng = np.random.default_rng([stream_key(radar.seed, "loss", board_name), row.index])
    gaps: Gaps = []
    for k in np.flatnonzero(rng.random(-(-size // full)) < loss):
        start, stop = int(k) * full, min((int(k) + 1) * full, size)
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
    skipped: Skipped | None = None,
) -> Path:
    """Write a scan of a scene.

    Parameters
    ----------
    rig, scene
        Rig file and scene; the scene's overrides are applied.
    out
        Folder to write; made when absent, refused when not empty.
    layout
        "own": a scan folder at `out`. "authors": `out`/unsynced/<scan>, the transmitting board's data included.
    seed
        None takes the scene's. The same seed gives the same raw bytes.
    started_s
        Unix time written as the scan's start; None is now.
    zero_filling
        Authors' layout only: lost packets are zeros in the file instead of absent.
    cache_dir
        Where object fields are kept between runs; None keeps nothing.
    progress
        Called with rows done and rows in all.
    by_columns, skipped
        Authors' layout only: see :class:`polysight.simulators.scene.published_layout.AuthorsLayout`.

    Returns
    -------
    Folder to process: the scan folder, or unsynced/<scan>.

    Raises
    ------
    ConfigError
        when the scene does not fit the rig, or a burst does not end before the next point.
    DataError
        when the folder is not empty.
    """
    radar = SimulatedRig(rig, _wider(scene, rig) if by_columns else scene, seed, cache_dir)
    rig = apply_scene(rig, scene)
    grid = _by_columns(rig.grid) if by_columns else rig.grid
    check_burst_fits(grid, rig.burst, rig.stage)
    plan = plan_raster(grid)
    started_s = time.time() if started_s is None else started_s
    scan_id = "".join(c if c.isalnum() else "-" for c in scene.name).strip("-") or "scene"
    writer: Layout
    if layout == "own":
        stamp = datetime.fromtimestamp(started_s, UTC).isoformat(timespec="seconds")
        folder, boards = out, rig.recorded
        writer = OwnLayout(out, rig, plan, scan_id, stamp)
    else:
        writer = AuthorsLayout(out, rig, scan_id, started_s, zero_filling, by_columns, skipped)
        folder, boards = writer.folder, rig.boards
    writer.start()
    for row in plan:
        x, y = row_offsets_mm(radar, row)
        x, y = (y, x) if by_columns else (x, y)
        first = row.index * len(x)
        payloads = {b.name: radar.chirps(b.name, x, y, first) for b in boards}
        writer.write_row(row, payloads, {b.name: lost_bytes(radar, b.name, row) for b in boards})
        if progress is not None:
            progress(row.index + 1, plan.rows)
    writer.end()
    facts = {**truth(rig, scene, radar.seed), "scan_id": scan_id, "samples_clipped": radar.clipped}
    (folder / "truth.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    if layout == "authors":  # their files tell neither geometry nor filter nor leakage; a scan folder's manifest does
        (folder / "instrument.toml").write_bytes(tomli_w.dumps(to_builtins(rig)).encode())
    return folder


def _by_columns(grid: Grid) -> Grid:
    """The grid whose rows are the columns."""
    return Grid(columns=grid.rows, rows=grid.columns, step_x_mm=grid.step_y_mm, step_y_mm=grid.step_x_mm)


def _wider(scene: Scene, rig: Instrument) -> Scene:
    """The scene with a row more above and below, for bursts that travel along y."""
    grid = to_builtins(apply_scene(rig, scene).grid)
    return msgspec.structs.replace(scene, grid={**grid, "rows": grid["rows"] + 2})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `simulate`."""
    parser.add_argument("scene", type=Path, help="scene file (docs/spec/scene-file.md)")
    parser.add_argument("--config", type=Path, default=Path("instrument.toml"), help="rig file")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument(
        "--layout", choices=("own", "authors"), default="own", help="scan folder, or the published data set's"
    )
    parser.add_argument("--seed", type=int, default=None, help="instead of the scene's seed")
    parser.add_argument("--columns", action="store_true", help="authors' layout: taken column by column")
    parser.add_argument("--absent", action="store_true", help="authors' layout: lost packets are absent, not zeros")
    parser.add_argument("--json", action="store_true", help="one JSON line instead of words")


def run(args: argparse.Namespace) -> int:
    """Carry out `simulate`. Raises PolysightError."""
    if args.layout == "own" and (args.columns or args.absent):
        given = "--columns" if args.columns else "--absent"
        raise ConfigError(f"{given} with --layout own", "the published data has such scans", "add --layout authors")
    rig, scene = load_instrument(args.config), load_scene(args.scene)
    began = time.perf_counter()

    def show(done: int, rows: int) -> None:
        left = (time.perf_counter() - began) / done * (rows - done)
        sys.stderr.write(f"\rsimulated row {done} of {rows}, {left:.0f} s left ")

    quiet = args.json or not sys.stderr.isatty()
    folder = simulate(
        rig,
        scene,
        args.out,
        args.layout,
        args.seed,
        zero_filling=not args.absent,
        progress=None if quiet else show,
        by_columns=args.columns,
    )
    seconds = time.perf_counter() - began
    if args.json:
        sys.stdout.write(json.dumps({"folder": str(folder), "seconds": round(seconds, 2), "simulated": True}) + "\n")
    else:
        sys.stdout.write(f"{'' if quiet else chr(10)}simulated scan in {folder}, {seconds:.1f} s\n")
    return 0
