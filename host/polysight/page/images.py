"""Images and range profiles of committed rows for the live view, made by the instrument's own pipeline.

`RowViewer` processes rows in a thread that may be slow, and replaces its results as a whole (`Shown`).
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.catalogue import Picture, draw
from polysight.imaging import Antennas, image_grid, scene_gate_m
from polysight.page.history import notice_of_error
from polysight.pipeline import Pipeline
from polysight.store import Manifest, ScanFolder
from polysight.sync import SyncedRow
from polysight_shared.config import Chirp, Instrument
from polysight_shared.errors import PolysightError
from polysight_shared.findings import Finding
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

FFT_POINTS = 2048
PROFILE_POINTS = 240
PROFILE_FLOOR_DB = -70.0
# Shown on either side of direct path and scene.
BEFORE_M = 0.25
BEYOND_M = 0.35
# Shortest time between two pictures, while many rows are caught up with.
PICTURE_INTERVAL_S = 0.5
POLL_S = 0.1


class RowSync(NamedTuple):
    """Synchronisation of one board in one row: phase std after all stages and of the direct path (nan: unknown)."""

    object_rad: float
    direct_rad: float
    masked: int


class Profile(msgspec.Struct, frozen=True):
    """Range profile of a row: excess path, dB below the direct path by board, and the scene's excess paths."""

    row: int
    excess_m: list[float]
    boards: dict[str, list[float]]
    scene_m: tuple[float, float]


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
        Of the last row.
    sync
        By board and row, rows ascending.
    problem
        The last error of a row.
    """

    revision: int = 0
    rows: tuple[int, ...] = ()
    pictures: dict[str, Picture] = field(default_factory=dict)
    profile: Profile | None = None
    sync: dict[str, dict[int, RowSync]] = field(default_factory=dict)
    problem: Finding | None = None


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
    first, end = chirp.linear_samples
    samples = row.samples[:, row.valid, first:end]
    if not samples.size:
        return np.full(excess_m.size, PROFILE_FLOOR_DB)
    spectrum = np.fft.fft(samples * np.hanning(end - first), FFT_POINTS, axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=(0, 1))
    bins = excess_m * FFT_POINTS * chirp.hz_per_sample / SPEED_OF_LIGHT_M_S
    level = np.interp(bins % FFT_POINTS, np.arange(FFT_POINTS + 1), np.append(power, power[0]))
    relative = np.maximum(level / max(power[0], 1e-30), 1e-30)
    return np.maximum(10 * np.log10(relative), PROFILE_FLOOR_DB)


class RowViewer:
    """Forms images of committed rows of one scan in a thread; `content` has the facts, and grows as the scan runs."""

    def __init__(self, path: Path, content: Manifest) -> None:
        self.shown = Shown()
        self._source = ScanFolder(path, content)
        # Rows to show and the take of each, those in the images, and those that failed.
        self._to_show: dict[int, int] = {}
        self._done: dict[int, int] = {}
        self._failed: dict[int, int] = {}
        self._sync: dict[str, dict[int, RowSync]] = {}
        self._problem: Finding | None = None
        self._drawn_at = 0.0
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="rows", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def show_rows(self, takes: dict[int, int]) -> None:
        """Set the rows and takes to show, in this order."""
        with self._lock:
            self._to_show = dict(takes)

    def close(self) -> None:
        """Stop after the current row."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _waiting(self) -> list[tuple[int, int]]:
        """Rows and takes that are not processed."""
        with self._lock:
            takes = self._to_show.items()
            return [(row, take) for row, take in takes if take not in (self._done.get(row), self._failed.get(row))]

    def _run(self) -> None:
        pipeline: Pipeline | None = None
        while not self._ended.is_set():
            waiting = self._waiting()
            if not waiting:
                self._ended.wait(POLL_S)
                continue
            row, take = waiting[0]
            try:
                pipeline = pipeline or Pipeline(self._source, live=True, samples="read")
                self._add(pipeline, row, take, draws=len(waiting) == 1)
            except PolysightError as e:
                self._fail(row, take, notice_of_error(e))
            except Exception as e:  # noqa: BLE001  the page shows it; the scan is not concerned
                what = f"Row {row} cannot be shown: {type(e).__name__}: {e}"
                self._fail(row, take, Finding("warning", what, "A defect of the live view", "Report it"))

    def _add(self, pipeline: Pipeline, row: int, take: int, draws: bool) -> None:
        """Process a row; publish if it `draws`, or the last pictures are old."""
        pipeline.add_row(row)
        self._done[row] = take
        for name, board in pipeline.quality.boards.items():
            record = board.rows[row]
            phases = {stage: float(residuals[1]) for stage, residuals in record["stages"].items()}
            object_rad = phases.get("referenced", math.nan)
            direct_rad = phases.get("averaged", math.nan)
            sync = RowSync(object_rad, direct_rad, int(record["positions_masked"]))
            self._sync.setdefault(name, {})[row] = sync
        if draws or time.monotonic() - self._drawn_at > PICTURE_INTERVAL_S:
            self._publish(draw(pipeline.images.current()), self._profile(pipeline, row))
            self._drawn_at = time.monotonic()

    def _profile(self, pipeline: Pipeline, row: int) -> Profile:
        """The profile of a row, synchronised anew: kept samples hold the scene, but not the direct path."""
        rig = pipeline.source.instrument
        nearest, farthest = scene_m(rig)
        excess = np.linspace(-BEFORE_M, farthest + BEYOND_M, PROFILE_POINTS)
        boards = {
            name: range_profile_db(synced, rig.chirp, excess).round(1).tolist()
            for name, synced in pipeline.synchronise_row(row).items()
        }
        return Profile(row, excess.round(4).tolist(), boards, (round(nearest, 3), round(farthest, 3)))

    def _fail(self, row: int, take: int, problem: Finding) -> None:
        self._failed[row] = take
        self._problem = problem
        self._publish(self.shown.pictures, self.shown.profile)

    def _publish(self, pictures: dict[str, Picture], profile: Profile | None) -> None:
        sync = {name: dict(sorted(rows.items())) for name, rows in self._sync.items()}
        rows = tuple(sorted(self._done))
        self.shown = Shown(self.shown.revision + 1, rows, pictures, profile, sync, self._problem)
