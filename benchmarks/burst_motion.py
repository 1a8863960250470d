"""Image error from the stage's travel within a burst, by speed, simulated: `python -m benchmarks.burst_motion`.

Four points, nothing disturbed but the trigger's phase, steps of 2.5 mm: at 100 mm/s a burst of 16 pulses fills nearly
all of one. Each speed is scanned with the stage in motion and, for comparison, standing still at each burst's mean
position; the images differ by the motion alone.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.data import RIG
from polysight.imaging import ImageBuilder
from polysight.imaging.geometry import row_offsets_m
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import load_instrument
from polysight_shared.raster import mean_burst_travel_mm, plan_raster
from polysight_simulators.scene import Point, Scene, SimulatedRig, apply_scene, row_offsets_mm

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
) -> dict[str, NDArray[np.complex64]]:
    """Board H's image by each treatment. Points have this amplitude beside the direct path."""
    still = {"burst_motion": motion, "if_offset_hz": 870e3, "random_phase": True}
    points = tuple(Point(place, (amplitude, 0.0)) for place in PLACES)
    scene = Scene("points", grid=grid, image=IMAGE, stage={"speed_mm_s": speed_mm_s}, points=points)
    scene = scene.with_disturbances(ideal=True)
    scene = msgspec.structs.replace(scene, disturbances=msgspec.structs.replace(scene.disturbances, **still))
    rig = apply_scene(load_instrument(RIG), scene)
    radar = SimulatedRig(rig, scene)
    board = rig.receivers[0]
    setup = BoardSetup.from_rig(rig, board, compensate_filter=False)
    boards = {name: ImageBuilder(rig).boards[board.name] for name in TREATMENTS}
    travel_m = mean_burst_travel_mm(rig.burst, rig.stage) / 1e3
    for row in plan_raster(rig.grid):
        x, y = row_offsets_mm(radar, row)
        words = radar.chirps(board.name, x, y, row.index * len(x)).reshape(len(x), rig.chirp.samples, 2, -1)
        synced = synchronise_row(words, np.ones(len(x), bool), setup)
        at_triggers = row_offsets_m(rig, row) - [row.direction * travel_m, 0.0]
        boards["undone"].add_row(row.index, synced)
        boards["mean"].add_row(row.index, replace(synced, turn=None))
        boards["ignored"].add_row(row.index, replace(synced, turn=None), at_triggers)
    return {name: samples.image()[0] for name, samples in boards.items()}


def errors(speed_mm_s: float, amplitude: float, grid: dict[str, float] = GRID) -> dict[str, float]:
    """Relative rms error by treatment beside the stage at rest."""
    still = images(speed_mm_s, amplitude, False, grid)["mean"]
    moving = images(speed_mm_s, amplitude, True, grid)
    return {name: float(np.linalg.norm(image - still) / np.linalg.norm(still)) for name, image in moving.items()}


def main() -> int:
    """Simulate, print a Markdown table."""
    print("| points beside the direct path | mm/s | " + " | ".join(TREATMENTS.values()) + " |")
    print("| --- " * (2 + len(TREATMENTS)) + "|")
    for amplitude in AMPLITUDES:
        for speed in SPEEDS:
            error = errors(speed, amplitude)
            cells = (f"{100 * error[name]:.3f} %" for name in TREATMENTS)
            print(f"| {amplitude:g} | {speed:g} | " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
