"""A scan as a Bluesky run: `RadarScan`, an ophyd-async flyer, and the plan `radar_scan`.

Needs `pip install "bluesky>=1.14" "ophyd-async>=0.19"`, and is used as

    from bluesky import RunEngine

    RunEngine()(radar_scan(RadarScan("instrument.toml"), "scans/one", md={"operator": "a person"}))

The scan runs as with `polysight scan`: rows are transactions, and committed rows stay, however the plan ends. Bluesky
gets metadata, an event for each committed row, and progress; the data stay in the scan folder, whose path is in the
start document. A RunEngine that is paused while rows are taken ends the run, since rows cannot be replayed: the scan
stops after the row, and `polysight resume` continues it.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
from bluesky.protocols import EventCollectable, Flyable, Preparable, Stageable, Stoppable
from ophyd_async.core import (
    AsyncStatus,
    StandardReadable,
    WatchableAsyncStatus,
    WatcherUpdate,
    soft_signal_r_and_setter,
)

from polysight.acquisition import ControlFolder, ScanProgress, ScanResult, StopRequest, run_scan
from polysight.store import MANIFEST, ScanFolder
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, ErrorCode, ScanError

ROWS = "rows"
_KEYS = ("row", "take", "pulses", "missing_bytes")
"""Keys of an event: index of the row, number of the committed take (from 1), SYNC_IN pulses sent, missing bytes."""
# Time between two looks at the progress of the scan.
_LOOK_S = 0.2


class RadarScan(StandardReadable, Flyable, Preparable, Stageable, Stoppable, EventCollectable):
    """The rig as a flyer: `prepare` names the scan folder, `kickoff` begins, `complete` waits for the last row.

    Signals: `folder`, `scan_id`, `rows_committed`, `rows_planned`, `state` (what `polysight scan` is doing).

    Names of signals and data keys begin with the given one. `keep_incomplete`: keep rows with gaps after all retakes.
    """

    def __init__(self, config: Path | str, name: str = "radar_scan", keep_incomplete: bool = False) -> None:
        self.config = Path(config)
        self._keep_incomplete = keep_incomplete
        with self.add_children_as_readables():
            self.folder, self._set_folder = soft_signal_r_and_setter(str)
            self.scan_id, self._set_scan_id = soft_signal_r_and_setter(str)
            self.rows_committed, self._set_committed = soft_signal_r_and_setter(int)
            self.rows_planned, self._set_planned = soft_signal_r_and_setter(int)
        self.state, self._set_state = soft_signal_r_and_setter(str)
        self._place: Path | None = None
        self._stop = StopRequest()
        self._scanning: asyncio.Task[ScanResult] | None = None
        # Set when rows are taken; when each row was committed; rows that `collect` has given; rows committed, planned.
        self._begun = threading.Event()
        self._times: dict[int, float] = {}
        self._collected = 0
        self._progress = (0, 0)
        super().__init__(name=name)

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Reset the state of the previous scan."""
        await self._end()
        self._place = None
        self._stop = StopRequest()
        self._collected = 0
        self._begun.clear()
        self._times.clear()

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop a running scan after the current row, and wait for its end."""
        await self._end()

    async def _end(self) -> None:
        """Stop a running scan after the current row, and wait for its end; an error of it is dropped."""
        if self._scanning is not None:
            self._stop.request()
            await asyncio.gather(self._scanning, return_exceptions=True)
            self._scanning = None

    @AsyncStatus.wrap
    async def prepare(self, value: Path | str) -> None:
        """Set the folder of the next scan, and check it and the rig file.

        Raises
        ------
        ConfigError
            if the folder is not empty, or the rig file is wrong.
        """
        folder = Path(value)
        rig = load_instrument(self.config)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(
                f"{folder} is not an empty folder", "each scan needs its own folder", "give another one",
                code=ErrorCode.FILE_EXISTS,
            )  # fmt: skip
        self._place = folder
        self._set_folder(str(folder.resolve()))
        self._set_planned(rig.grid.rows)
        self._set_committed(0)
        self._set_scan_id("")
        self._progress = (0, rig.grid.rows)

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Start; done when the first row begins. Raises PolysightError if it does not begin."""
        if self._place is None or self._scanning is not None:
            raise ScanError(
                f"{self.name}: not prepared, or a scan runs",
                "a scan needs a folder of its own",
                "prepare it first",
                code=ErrorCode.BUSY,
            )
        self._scanning = asyncio.create_task(asyncio.to_thread(self._scan, self._place, asyncio.get_running_loop()))
        while not self._begun.is_set() and not self._scanning.done():
            await asyncio.sleep(_LOOK_S / 4)
        if self._scanning.done():
            self._check_result(await self._scanning)

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Wait for the last row. Raises ScanError when the scan ends before it; committed rows stay."""
        scanning = self._scanning
        if scanning is None:
            raise ScanError(f"{self.name}: no scan runs", "none was begun, or it has ended", "kick it off first")
        began = time.monotonic()
        while not scanning.done():
            committed, planned = self._progress
            yield WatcherUpdate(committed, 0, planned, self.name, "rows", time_elapsed=time.monotonic() - began)
            await asyncio.wait([scanning], timeout=_LOOK_S)
        self._check_result(await scanning)

    async def stop(self, success: bool = True) -> None:
        """Stop the scan after the current row; immediately if the run has failed."""
        # A second request aborts the row.
        self._stop.request()
        if not success:
            self._stop.request()

    def describe_collect(self) -> dict[str, dict[str, Any]]:
        """Return the data keys of an event, by stream."""
        about = {"source": f"polysight://{self.name}", "dtype": "integer", "shape": [], "object_name": self.name}
        return {ROWS: {f"{self.name}-{key}": dict(about) for key in _KEYS}}

    def collect(self) -> Iterator[Any]:
        """Yield an event for each committed row since the last call, in the order of the plan."""
        if self._place is None or not (self._place / MANIFEST).exists():
            return
        rows = list(ScanFolder.load(self._place).committed_rows().values())
        for row in rows[self._collected :]:
            missing = sum(board.missing_bytes for board in row.boards.values())
            values = {"row": row.row, "take": row.take, "pulses": row.pulses, "missing_bytes": missing}
            data = {f"{self.name}-{key}": value for key, value in values.items()}
            time_s = self._times.get(row.row, time.time())
            self._collected += 1
            yield {"data": data, "timestamps": dict.fromkeys(data, time_s), "time": time_s}

    def _scan(self, folder: Path, loop: asyncio.AbstractEventLoop) -> ScanResult:
        """Run the scan; called in its own thread."""
        with ControlFolder(folder, self._stop) as control:

            def show(progress: ScanProgress) -> None:
                if progress.phase != "connect":
                    control.open()
                if progress.phase == "row":
                    self._begun.set()
                if progress.phase == "committed":
                    self._times[progress.row] = time.time()
                self._progress = (progress.committed, progress.rows)
                loop.call_soon_threadsafe(self._show, progress.phase, progress.committed, folder)

            rig = load_instrument(self.config)
            return run_scan(rig, folder, progress=show, keep_incomplete=self._keep_incomplete, stop=self._stop)

    def _show(self, phase: str, committed: int, folder: Path) -> None:
        """Set the signals; called in the loop of the run engine."""
        self._set_state(phase)
        self._set_committed(committed)
        if phase == "committed" and committed == 1:
            self._set_scan_id(ScanFolder.load(folder).scan_id)

    def _check_result(self, result: ScanResult) -> None:
        """Raise ScanError if the scan ended before its last row."""
        if result.exit_status != "success":
            raise ScanError(
                f"{self._place}: {result.reason}",
                "the scan ended before its last row; committed rows stay",
                f"polysight resume {self._place}",
            )


def radar_scan(scan: RadarScan, folder: Path | str, md: dict[str, Any] | None = None) -> Iterator[Any]:
    """Plan: one scan into `folder` as one run, an event of the stream `rows` for each row, the device's signals last.

    Parameters
    ----------
    scan
        The rig.
    folder
        To be made; its path is `scan_folder` of the start document, the rig file's path `rig_file`.
    md
        More metadata for the start document.
    """
    metadata = {"plan_name": "radar_scan", "scan_folder": str(Path(folder).resolve()), "rig_file": str(scan.config)}

    @bpp.stage_decorator([scan])
    @bpp.run_decorator(md={**metadata, **(md or {})})
    def run() -> Iterator[Any]:
        yield from bps.prepare(scan, folder, wait=True)
        # Rows cannot be replayed.
        yield from bps.clear_checkpoint()
        yield from bps.kickoff(scan, wait=True)
        yield from bps.complete(scan, wait=True)
        yield from bps.collect(scan)
        yield from bps.trigger_and_read([scan])

    return (yield from run())
