"""Image error from the stage's travel within a burst, by speed, simulated: `python -m benchmarks.burst_motion`.

Four points, nothing disturbed but the trigger's phase, steps of 2.5 mm: at 100 mm/s a burst of 16 pulses fills nearly
all of one. Each speed is scanned with the stage in motion and, for comparison, standing still at each burst's mean
position; the images differ by the motion alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.data import ROOT
from polysight.imaging import ImageBuilder
from polysight.imaging.geometry import row_offsets_m
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.raster import mean_burst_travel_mm, plan_raster
from polysight_simulators.scene import Point, Scene, SimulatedRig, apply_scene, row_offsets_mm

Images = dict[str, NDArray[np.complex64]]
TREATMENTS = {
    "ignored": "taken at the trigger points",
    "mean": "taken at the mean positions",
    "undone": "mean positions, travel undone",
}
SPEEDS = (20.0, 40.0, 60.0, 80.0, 100.0)
AMPLITUDES = (0.1, 0.6)
PLACES = ((-60.0, -20.0), (-20.0, 10.0), (30.0, -10.0), (70.0, 20.0))
GRID = {"columns": 100, "rows": 24, "step_x_mm": 2.5, "step_y_mm": 4.0}
IMAGE = {"columns": 90, "rows": 40, "pixel_mm": 2.0}


def images(
    speed_mm_s: float, amplitude: float, motion: bool, grid: dict[str, float] = GRID
) -> tuple[Instrument, Images]:
    """The rig, and board H's image by each treatment. Points have this amplitude beside the direct path."""
    still = {"burst_motion": motion, "if_offset_hz": 870e3, "random_phase": True}
    points = tuple(Point(place, (amplitude, 0.0)) for place in PLACES)
    scene = Scene("points", grid=grid, image=IMAGE, stage={"speed_mm_s": speed_mm_s}, points=points)
    scene = scene.with_disturbances(ideal=True)
    scene = msgspec.structs.replace(scene, disturbances=msgspec.structs.replace(scene.disturbances, **still))
    rig = apply_scene(load_instrument(ROOT / "instrument.toml"), scene)
    radar, board = SimulatedRig(rig, scene), rig.receivers[0]
    setup = BoardSetup.of(rig, board, compensate_filter=False)
    kept = {name: ImageBuilder(rig).boards[board.name] for name in TREATMENTS}
    travel_m = mean_burst_travel_mm(rig.burst, rig.stage) / 1e3
    for row in plan_raster(rig.grid):
        x, y = row_offsets_mm(radar, row)
        words = radar.chirps(board.name, x, y, row.index * len(x)).reshape(len(x), rig.chirp.samples, 2, -1)
        synced = synchronise_row(words, np.ones(len(x), bool), setup)
        at_triggers = row_offsets_m(rig, row) - [row.direction * travel_m, 0.0]
        kept["undone"].add_row(row.index, synced)
        kept["mean"].add_row(row.index, replace(synced, turn=None))
        kept["ignored"].add_row(row.index, replace(synced, turn=None), at_triggers)
    return rig, {name: samples.image()[0] for name, samples in kept.items()}


def errors(speed_mm_s: float, amplitude: float, grid: dict[str, float] = GRID) -> tuple[dict[str, float], Images]:
    """Relative rms error by treatment beside the stage at rest, and the differences themselves over the peak."""
    _, still = images(speed_mm_s, amplitude, False, grid)
    _, moving = images(speed_mm_s, amplitude, True, grid)
    true = still["mean"]
    apart = {name: (image - true) / np.abs(true).max() for name, image in moving.items()}
    size = np.linalg.norm(true) / np.abs(true).max()
    return {name: float(np.linalg.norm(d) / size) for name, d in apart.items()}, apart


def figure(found: dict[tuple[float, float], tuple[dict[str, float], Images]], path: Path) -> None:
    """Errors against speed for each amplitude, and where they are at the highest speed."""
    fig = Figure(figsize=(11.0, 7.0), dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    fig.suptitle("SIMULATED: image error by the stage's travel within a burst, four points", color="firebrick")
    grid = fig.add_gridspec(2, 6)
    speeds, amplitudes = (sorted({key[i] for key in found}) for i in (0, 1))
    for i, amplitude in enumerate(amplitudes):
        ax = fig.add_subplot(grid[0, 3 * i : 3 * i + 3])
        for name, label in TREATMENTS.items():
            ax.semilogy(speeds, [100 * found[s, amplitude][0][name] for s in speeds], "o-", label=label)
        ax.set(xlabel="stage speed (mm/s)", ylabel="image error (%)")
        ax.set_title(f"points of {amplitude:g} of the direct path each", fontsize=9, loc="left")
        ax.grid(alpha=0.3)
    fig.axes[0].legend(fontsize=8, frameon=False)
    apart = found[speeds[-1], amplitudes[-1]][1]
    reach = [n * IMAGE["pixel_mm"] / 2 for n in (IMAGE["columns"], IMAGE["rows"])]
    for i, (name, label) in enumerate(TREATMENTS.items()):
        ax = fig.add_subplot(grid[1, 2 * i : 2 * i + 2])
        level = 20 * np.log10(np.maximum(np.abs(apart[name]), 1e-6))
        extent = (-reach[0], reach[0], -reach[1], reach[1])
        shown = ax.imshow(level, origin="lower", extent=extent, vmin=-80, vmax=-40, cmap="cividis")
        ax.set_title(f"{label}, {speeds[-1]:g} mm/s", fontsize=9, loc="left")
        ax.set(xlabel="x (mm)", ylabel="y (mm)" if i == 0 else "")
        if i == len(TREATMENTS) - 1:
            fig.colorbar(shown, ax=fig.axes[len(amplitudes) :], label="dB of the peak", shrink=0.8)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, metadata={"Software": None})


def main() -> int:
    """Simulate, print a Markdown table, draw the figure."""
    parser = argparse.ArgumentParser(description="image error by the stage's travel within a burst")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "images" / "burst-motion.png")
    args = parser.parse_args()
    found = {}
    print("| points beside the direct path | mm/s | " + " | ".join(TREATMENTS.values()) + " |")
    print("| --- " * (2 + len(TREATMENTS)) + "|")
    for amplitude in AMPLITUDES:
        for speed in SPEEDS:
            found[speed, amplitude] = errors(speed, amplitude)
            cells = (f"{100 * found[speed, amplitude][0][name]:.3f} %" for name in TREATMENTS)
            print(f"| {amplitude:g} | {speed:g} | " + " | ".join(cells) + " |", flush=True)
    figure(found, args.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
