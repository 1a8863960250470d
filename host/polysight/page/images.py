"""Images and range profiles of committed rows for the live view, made by the instrument's own pipeline.

`RowViewer` processes rows in a thread that may be slow, and replaces its results as a whole (`Shown`).
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.catalogue import Picture, draw
from polysight.imaging import Antennas, image_grid, scene_gate_m
from polysight.page.history import Notice, notice_of_error
from polysight.pipeline import Pipeline
from polysight.store import Manifest, ScanFolder
from polysight.sync import SyncedRow
from polysight_shared.config import Chirp, Instrument
from polysight_shared.errors import PolysightError
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

_FFT = 2048  # points of a range profile
_PICTURES_S = 0.5  # at most so often, while many rows are caught up with
_LOOK_S = 0.1
_PROFILE_FLOOR_DB = -70.0
_BEFORE_M, _BEYOND_M = 0.25, 0.35  # shown on either side of direct path and scene


@dataclass(frozen=True)
class Shown:
    """Results of the rows so far; replaced as a whole, never changed.

    Attributes
    ----------
    rows
        Rows that are in the images, ascending.
    pictures
        See :func:`polysight.catalogue.draw`.
    profile
        Range profile of the last row: `row`, `excess_m` [n], `boards` {name: dB below the direct path [n]}, and the
        range of the scene, `scene_m`.
    sync
        {board: {row: (phase std after all stages, rad; the same of the direct path; masked positions)}}; nan: unknown.
    problem
        The last error of a row.
    """

    revision: int = 0
    rows: tuple[int, ...] = ()
    pictures: dict[str, Picture] = field(default_factory=dict)
    profile: dict[str, Any] = field(default_factory=dict)
    sync: dict[str, dict[int, tuple[float, float, int]]] = field(default_factory=dict)
    problem: Notice | None = None


def scene_m(rig: Instrument) -> tuple[float, float]:
    """Excess paths that the scene can have: nearest and farthest, metres."""
    antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
    return scene_gate_m(antennas, plan_raster(rig.grid), image_grid(rig))


def range_profile_db(row: SyncedRow, chirp: Chirp, excess_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean power over RX and positions against excess path, relative to the direct path at 0.

    An echo of excess path d is `exp(+j 2 pi f d / c)` (sync/chain.py), so a Fourier transform along the linear
    samples, Hann-windowed, has it at bin `d N df / c`. Returns dB, float64 [n] as `excess_m`; all at the floor when no
    position is valid.
    """
    a, b = chirp.linear_samples
    samples = row.samples[:, row.valid, a:b]
    if not samples.size:
        return np.full(excess_m.size, _PROFILE_FLOOR_DB)
    spectrum = np.fft.fft(samples * np.hanning(b - a), _FFT, axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=(0, 1))
    bins = excess_m * _FFT * chirp.hz_per_sample / SPEED_OF_LIGHT_M_S
    level = np.interp(bins % _FFT, np.arange(_FFT + 1), np.append(power, power[0]))
    return np.maximum(10 * np.log10(np.maximum(level / max(power[0], 1e-30), 1e-30)), _PROFILE_FLOOR_DB)


class RowViewer:
    """Forms images of committed rows of one scan in a thread; `content` has the facts, and grows as the scan runs."""

    def __init__(self, path: Path, content: Manifest) -> None:
        self._source = ScanFolder(path, content)
        self._wanted: dict[int, int] = {}
        self._done: dict[int, int] = {}
        self._failed: dict[int, int] = {}
        self._sync: dict[str, dict[int, tuple[float, float, int]]] = {}
        self._problem: Notice | None = None
        self._scene_m: tuple[float, float] | None = None
        self._left = 0
        self._shown_at = 0.0
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self.shown = Shown()
        self._thread = threading.Thread(target=self._run, name="rows", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def want(self, takes: dict[int, int]) -> None:
        """Set the rows and takes to show, in this order."""
        with self._lock:
            self._wanted = dict(takes)

    def close(self) -> None:
        """Stop after the current row."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _next(self) -> tuple[int, int] | None:
        """The next row and take that is not processed; None if there is none."""
        with self._lock:
            todo = [
                (row, take)
                for row, take in self._wanted.items()
                if take not in (self._done.get(row), self._failed.get(row))
            ]
        self._left = len(todo)
        return todo[0] if todo else None

    def _run(self) -> None:
        pipeline: Pipeline | None = None
        while not self._ended.is_set():
            todo = self._next()
            if todo is None:
                self._ended.wait(_LOOK_S)
                continue
            row, take = todo
            try:
                pipeline = pipeline or Pipeline(self._source, live=True, samples="read")
                self._add(pipeline, row, take)
            except PolysightError as e:
                self._fail(row, take, notice_of_error(e))
            except Exception as e:  # noqa: BLE001  the page shows it; the scan is not concerned
                what = f"Row {row} cannot be shown: {type(e).__name__}: {e}"
                self._fail(row, take, Notice("warn", what, "A defect of the live view", "Report it; the scan goes on"))

    def _add(self, pipeline: Pipeline, row: int, take: int) -> None:
        """Process a row; publish unless more rows wait and the last pictures are recent."""
        pipeline.add_row(row)
        self._done[row] = take
        self._keep_sync(pipeline, row)
        if self._left > 1 and time.monotonic() - self._shown_at < _PICTURES_S:
            return
        synced = pipeline.synchronise_row(row)  # kept samples hold the scene; the profile shows the direct path too
        rig = pipeline.source.instrument
        self._scene_m = self._scene_m or scene_m(rig)
        excess = np.linspace(-_BEFORE_M, self._scene_m[1] + _BEYOND_M, 240)
        boards = {name: range_profile_db(one, rig.chirp, excess) for name, one in synced.items()}
        profile = {"row": row, "excess_m": excess, "boards": boards, "scene_m": self._scene_m}
        self._show(draw(pipeline.images.current()), profile)
        self._shown_at = time.monotonic()

    def _fail(self, row: int, take: int, notice: Notice) -> None:
        self._failed[row], self._problem = take, notice
        self._show(self.shown.pictures, self.shown.profile)

    def _keep_sync(self, pipeline: Pipeline, row: int) -> None:
        for name, board in pipeline.quality.boards.items():
            record = board.rows[row]
            stages = record["stages"]
            object_rad = float(stages["referenced"][1]) if "referenced" in stages else float("nan")
            direct_rad = float(stages["averaged"][1]) if "averaged" in stages else float("nan")
            self._sync.setdefault(name, {})[row] = (object_rad, direct_rad, int(record["positions_masked"]))

    def _show(self, pictures: dict[str, Picture], profile: dict[str, Any]) -> None:
        """Publish new results."""
        sync = {name: dict(sorted(rows.items())) for name, rows in self._sync.items()}
        revision, rows = self.shown.revision + 1, tuple(sorted(self._done))
        self.shown = Shown(revision, rows, pictures, profile, sync, self._problem)
