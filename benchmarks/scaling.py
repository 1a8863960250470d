"""Cost against work: time and memory of the whole processing at 1/4, 1/2, 1, 2 and 4 times the published grid."""

from __future__ import annotations

import argparse
import statistics

from benchmarks.data import published_scene, recorded_rows, temporary
from benchmarks.measure import add_arguments as add_common
from benchmarks.measure import one_core, write
from benchmarks.whole import Chain

# Columns, rows and steps (mm) in x and y: always the published aperture of 0.7 x 0.4 m, as far as the stage reaches.
SIZES = {
    0.25: (175, 100, 4.0, 4.0),
    0.5: (175, 200, 4.0, 2.0),
    1.0: (350, 200, 2.0, 2.0),
    2.0: (700, 200, 1.0, 2.0),
    4.0: (700, 400, 1.0, 1.0),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    parser.add_argument("--largest", type=float, default=4.0, help="times the published grid (default 4)")


def run(args: argparse.Namespace) -> int:
    rig, scene = published_scene()
    lines = []
    with temporary(args.folder) as folder, one_core():
        files = {}
        for name, rows in recorded_rows(rig, scene, 2).items():
            files[name] = [str(folder / f"{name}{i}.bin") for i in range(len(rows))]
            for row, path in zip(rows, files[name], strict=True):
                row.tofile(path)
        print("\ncost against work: both boards, aperture of 0.7 x 0.4 m, one core, simulated rows repeated")
        print(
            "   grid  columns  rows  steps, mm  positions   CPU s  us a position  last row to image  anonymous memory"
        )
        largest = args.largest
        if args.quick:
            largest = 0.25
        for size, (columns, count, step_x, step_y) in SIZES.items():
            if size > largest:
                break
            grid = {"columns": columns, "rows": count, "step_x_mm": step_x, "step_y_mm": step_y}
            chain = Chain(folder, "batch", {"files": files, "grid": grid})
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
    write(args.json, "scaling", [], sizes=lines)
    return 0
