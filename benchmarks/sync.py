"""Synchronisation of recorded rows, against the published method on the same file and core."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.data import RepeatedRows, published_scene, recorded_rows, temporary
from benchmarks.measure import Line, Seconds, add_arguments, count_repeats, keep_on_one_core, show, write
from benchmarks.published import Synchroniser
from polysight.imaging import ImageBuilder
from polysight.pipeline import Pipeline
from polysight.sync import chain
from polysight_shared.config import Instrument

__all__ = ["add_arguments", "run"]
REPEATS = 5
# The published method is timed on so many of a row's 350 positions, evenly spaced.
POSITIONS = 70
STAGES = ("decode and align", "direct path")
# Required and desired ratio of the published method's time to ours.
LIMITS = {"decode and align": (80.0, 120.0), "direct path": (60.0, 80.0)}


@contextmanager
def direct_path_timed(into: Seconds) -> Iterator[None]:
    """Time every call of the chain's direct-path stage in the block, which is replaced meanwhile."""
    original = chain.reference

    def run_timed(*args: Any, **kwargs: Any) -> Any:
        with into.time_block():
            return original(*args, **kwargs)

    chain.reference = run_timed
    try:
        yield
    finally:
        chain.reference = original


class _NoImage:
    """Takes synchronised rows and does nothing with them."""

    live = False

    def add_row(self, *_: object) -> None:
        pass


class Ours:
    """The instrument's pipeline on a row of both boards, but for the image."""

    def __init__(self, rig: Instrument, files: dict[str, Path]) -> None:
        self._pipeline = Pipeline(RepeatedRows(rig, {name: [path] for name, path in files.items()}))
        self._pipeline.builder = cast(ImageBuilder, _NoImage())

    def row(self) -> tuple[float, float]:
        """Process a row of all boards; return CPU seconds of all steps but the direct path, and of the direct path.

        The first are reading, decoding and aligning, and what else a row needs, such as the residuals.
        """
        row_seconds = Seconds()
        inner = Seconds()
        with row_seconds.time_block(), direct_path_timed(inner):
            self._pipeline.add_row(0)
        return row_seconds.cpu[0] - sum(inner.cpu), sum(inner.cpu)


class Theirs:
    """The published method on some positions of the same files, its time scaled to the row."""

    def __init__(self, rig: Instrument, files: dict[str, Path], positions: int = POSITIONS) -> None:
        self._boards = [(Synchroniser(rig, rig.by_name(name)), path) for name, path in files.items()]
        self._rig = rig
        self._chosen = np.linspace(0, rig.grid.columns - 1, min(positions, rig.grid.columns)).astype(int)

    def row(self) -> tuple[float, float]:
        """Process the chosen positions of each board one after another; return CPU seconds as :class:`Ours`, scaled."""
        # A frame of the published rig is one chirp.
        pulses = self._rig.burst.pulses
        burst_bytes = pulses * self._rig.frame_bytes
        first = Seconds()
        second = Seconds()
        for method, path in self._boards:
            aligned = []
            with first.time_block():
                recording = np.memmap(path, dtype=np.uint8, mode="r")
                for i in self._chosen:
                    burst = method.decode(recording[i * burst_bytes : (i + 1) * burst_bytes], pulses)
                    aligned.append(method.align(burst))
            with second.time_block():
                for mean in aligned:
                    method.reference(mean)
        scale = self._rig.grid.columns / len(self._chosen)
        return sum(first.cpu) * scale, sum(second.cpu) * scale


def measure(rig: Instrument, files: dict[str, Path], repeats: int) -> dict[str, np.ndarray]:
    """Measure seconds a position of one board, [round, stage] by method, in turn; the first round is not counted."""
    jobs = {"ours": Ours(rig, files), "published": Theirs(rig, files)}
    rounds: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for turn in range(repeats + 1):
        for name, job in jobs.items():
            times = job.row()
            if turn:
                rounds[name].append(times)
    return {name: np.array(times) / (rig.grid.columns * len(files)) for name, times in rounds.items()}


def run(args: argparse.Namespace) -> int:
    """Measure both methods on one core and print the table; return 0."""
    rig, scene = published_scene(args.quick)
    with temporary(args.folder) as folder, keep_on_one_core():
        files = {}
        for name, rows in recorded_rows(rig, scene, 1).items():
            files[name] = folder / f"{name}.bin"
            rows[0].tofile(files[name])
        times = measure(rig, files, count_repeats(args.quick, REPEATS))
    medians = {method: np.median(t, axis=0) for method, t in times.items()}
    lines = []
    for k, stage in enumerate(STAGES):
        ours = float(medians["ours"][k])
        theirs = float(medians["published"][k])
        lines.append(Line(stage, f"{1e6 * ours:.0f} us", f"{1e6 * theirs:.0f} us", theirs / ours, *LIMITS[stage]))
    show("synchronisation, a position of one board, one core, published method beside it", lines, args.quick)
    write(args.json, "sync", lines, seconds_a_position={m: t.tolist() for m, t in times.items()})
    return 0
