"""A full scan of two boards from raw files to images: time, memory, and the wait after its last row.

Beside it the published method (`published.py`). Limits are those in the column "asked" of docs/benchmarks.md; the aim
of the ratio is chosen.
"""

import argparse
import shutil
import statistics
from pathlib import Path

import numpy as np

from benchmarks import sync
from benchmarks.chain import Chain
from benchmarks.data import published_scene, recorded_rows, temporary, write_scan
from benchmarks.measure import (
    Line,
    Seconds,
    add_arguments as add_common,
    count_repeats,
    keep_on_one_core,
    line_at_most,
    show,
    write,
)
from benchmarks.published import form_image
from polysight.imaging import image_grid
from polysight_shared.config import Instrument

REPEATS = 3
# Positions of each board on which the published method is timed, 70 of both.
POSITIONS = 35
# Space that stays free on the disk (chosen).
SPARE_BYTES = 3 << 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    parser.add_argument("--rows", type=int, default=200, help="of the scan (default 200, the published scan)")
    parser.add_argument("--repeats", type=int, default=REPEATS, help=f"rounds (default {REPEATS})")


def rows_that_fit(rig: Instrument, rows: int, folder: Path) -> int:
    """Return how many of `rows` rows the disk of `folder` has room for; at least 2 (chosen), even without room."""
    # Each pulse of a burst is recorded as one frame.
    row_bytes = rig.grid.columns * rig.burst.pulses * rig.frame_bytes * len(rig.receivers)
    return max(2, min(rows, (shutil.disk_usage(folder).free - SPARE_BYTES) // row_bytes))


class Published:
    """The published method on a part of a scan, its time scaled to the whole: positions and boards cost the same.

    `files`: raw data of one row by board.
    """

    def __init__(self, rig: Instrument, files: dict[str, Path]) -> None:
        self._rig = rig
        self._grid = image_grid(rig)
        self._row = sync.Theirs(rig, files, POSITIONS)
        # [rx, row, column, sample]
        shape = len(rig.antennas.rx_mm), rig.grid.rows, rig.grid.columns, rig.chirp.samples
        # The time does not depend on the samples.
        self._cube = np.broadcast_to(np.ones(shape[1:], np.complex64), shape)

    def run(self) -> float:
        """Return the CPU seconds of the whole scan."""
        # Its two steps, of both boards, scaled to all positions of a row.
        positions_s = sum(self._row.row()) * self._rig.grid.rows
        image = Seconds()
        with image.time_block():
            form_image(self._cube, self._rig, self._rig.receivers[0], self._grid)
        return positions_s + image.cpu[0] * len(self._rig.receivers)


def run(args: argparse.Namespace) -> int:
    """Measure our processing and the published method in turn on one core, and print the table; return 0."""
    rig, scene = published_scene(args.quick)
    most_rows = args.rows
    if args.quick:
        most_rows = 4
    with temporary(args.folder) as folder, keep_on_one_core():
        count = rows_that_fit(rig, most_rows, folder)
        # A few simulated rows by board, which the scan's files repeat.
        rows = recorded_rows(rig, scene)
        scan = folder / "scan"
        write_scan(scan, rig, rows, count)
        # Row 0 of each board is enough for the published method.
        files = {name: scan / "raw" / name / "0000.bin" for name in rows}
        del rows
        published = Published(rig, files)
        # Our processing, each in a process of its own: of a whole scan, and as during a running one.
        batch = Chain(folder, "batch", {"scan": str(scan)})
        live = Chain(folder, "live", {"scan": str(scan)})
        ours = []
        theirs = []
        for _ in range(count_repeats(args.quick, args.repeats)):
            ours.append(batch.run())
            theirs.append(published.run())
        beside_scan = live.run()
        memory = max(batch.end(), live.end())
    scale = rig.grid.rows / count
    whole_bytes = rig.grid.columns * rig.burst.pulses * rig.frame_bytes * len(rig.receivers) * rig.grid.rows
    part_bytes = whole_bytes / scale
    if scale > 1:
        part = f"{count} of {rig.grid.rows} rows ({part_bytes / 1e9:.1f} GB)"
    else:
        part = f"all {part_bytes / 1e9:.1f} GB"
    # What is done once, such as the images, does not grow with the rows.
    seconds = statistics.median((r["cpu_s"] - r["once_cpu_s"]) * scale + r["once_cpu_s"] for r in ours)
    quantity = f"raw to image, two boards, {whole_bytes / 1e9:.1f} GB"
    lines = [
        _make_time_line(quantity, seconds, statistics.median(theirs), part),
        _make_last_row_line(beside_scan),
        line_at_most(
            "anonymous memory of a full scan, GB",
            memory / 1e9,
            "GB",
            0.4,
            note=f"highest RssAnon of the processing process, at once and row by row; {part}",
        ),
    ]
    show("a whole scan, one core, simulated rows repeated", lines, args.quick)
    write(args.json, "whole", lines, ours=ours, live=beside_scan, published_s=theirs)
    return 0


def _make_time_line(quantity: str, seconds: float, published_s: float, part: str) -> Line:
    """Return the line about CPU seconds: ours, and the published method's."""
    return Line(
        quantity,
        f"{seconds:.1f} s",
        f"{published_s:.0f} s",
        published_s / seconds,
        at_least=80,
        aim=120,
        note=f"ours from {part}; published method from {2 * POSITIONS} positions and one board's image, scaled",
    )


def _make_last_row_line(live: dict[str, list[float]]) -> Line:
    """Return the line about the wait after the last row, from figures of `Chain.run`."""
    last = statistics.median(live["last_row_wall_s"])
    last_cpu = statistics.median(live["last_row_cpu_s"])
    return line_at_most(
        "last committed row to final image, s",
        last,
        "s",
        0.1,
        note=f"median of {len(live['last_row_wall_s'])}, wall seconds ({last_cpu:.2f} s of CPU): reading,"
        " synchronising and imaging the last row of both boards, then both images",
    )
