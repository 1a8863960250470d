"""Time and memory of the processing at 1/4 to 4 times the published grid; two threads compared with one."""

import argparse
import statistics
from pathlib import Path
from typing import Any

from benchmarks.chain import Chain
from benchmarks.data import RepeatedRows, published_scene, recorded_rows, temporary
from benchmarks.measure import Seconds, add_arguments as add_common, keep_on_one_core, machine, write
from polysight.pipeline import Pipeline
from polysight.process import map_rows
from polysight_shared.config import Instrument

# Columns, rows and steps (mm) in x and y: always the published aperture of 0.7 x 0.4 m, as far as the stage reaches.
SIZES = {
    0.25: (175, 100, 4.0, 4.0),
    0.5: (175, 200, 4.0, 2.0),
    1.0: (350, 200, 2.0, 2.0),
    2.0: (700, 200, 1.0, 2.0),
    4.0: (700, 400, 1.0, 1.0),
}
# Rows of the published grid that one thread and two process in turn, and how often; chosen.
ROWS_OF_THREADS = 60
ROUNDS_OF_THREADS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add_common(parser)
    parser.add_argument("--largest", type=float, default=4.0, help="times the published grid (default 4)")


def time_threads(rig: Instrument, files: dict[str, list[Path]], rows: int, rounds: int) -> dict[int, Seconds]:
    """Measure CPU and wall seconds of adding rows to the images on one thread and on two, in turn; by threads."""
    took = {1: Seconds(), 2: Seconds()}
    pipeline = Pipeline(RepeatedRows(rig, files))
    # The first row makes maps and buffers.
    pipeline.add_row(0)
    for _ in range(rounds):
        for threads, seconds in took.items():
            with seconds.time_block():
                for _ in map_rows(pipeline.add_row, range(min(rows, rig.grid.rows)), threads):
                    pass
    return took


def run(args: argparse.Namespace) -> int:
    """Measure threads, then sizes; print both. Return 0."""
    rig, scene = published_scene()
    with temporary(args.folder) as folder:
        # Two recorded rows of each board, which are used alternately for all rows.
        files: dict[str, list[Path]] = {}
        for name, rows in recorded_rows(rig, scene, 2).items():
            files[name] = [folder / f"{name}{i}.bin" for i in range(len(rows))]
            for row, path in zip(rows, files[name], strict=True):
                row.tofile(path)
        largest = args.largest
        threads = time_threads(rig, files, ROWS_OF_THREADS, ROUNDS_OF_THREADS if not args.quick else 1)
        if args.quick:
            largest = 0.25
        with keep_on_one_core():
            lines = time_sizes(folder, files, largest)
    wall = threads[1].median_wall / threads[2].median_wall
    cpu = threads[2].median / threads[1].median
    load = machine()["load_average"][0]
    print(f"two threads beside one: {wall:.2f} times as fast by the clock, {cpu:.2f} times the CPU (load {load})")
    seconds = {str(count): {"cpu_s": t.cpu, "wall_s": t.wall} for count, t in threads.items()}
    # [] because these figures have no limits to judge.
    write(args.json, "scaling", [], sizes=lines, threads=seconds)
    return 0


def time_sizes(folder: Path, files: dict[str, list[Path]], largest: float) -> list[dict[str, Any]]:
    """Process each size up to `largest` once; print and return its figures. `files`: rows by board."""
    lines = []
    names = {board: [str(path) for path in paths] for board, paths in files.items()}
    print("\ncost against work: both boards, aperture of 0.7 x 0.4 m, one core, simulated rows repeated")
    print("   grid  columns  rows  steps, mm  positions   CPU s  us a position  last row to image  anonymous memory")
    for size, (columns, count, step_x, step_y) in SIZES.items():
        if size > largest:
            break
        grid = {"columns": columns, "rows": count, "step_x_mm": step_x, "step_y_mm": step_y}
        # "batch": all rows, then the images; not images after every row.
        chain = Chain(folder, "batch", {"files": names, "grid": grid})
        figures = chain.run()
        memory = chain.end()
        positions = columns * count * len(files)
        last = statistics.median(figures["last_row_cpu_s"])
        lines.append({"size": size, **grid, "memory_bytes": memory, **figures})
        print(
            f"{size:7.2f} {columns:8d} {count:5d} {step_x:6.0f} x {step_y:.0f} {positions:10d}"
            f" {figures['cpu_s']:7.1f} {figures['cpu_s'] / positions * 1e6:14.0f} {last:16.2f} s"
            f" {memory / 1e9:14.2f} GB",
            flush=True,
        )
    return lines
