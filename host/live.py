"""A scan that is processed while it runs: rows go into the images as they are committed."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from host.offline import TRUTH, check_library, clear_products, finish, truth_of
from host.options import Options
from host.pipeline import Pipeline
from host.progress import ScanBar
from host.scan.control import ControlDesk
from host.scan.result import OnProgress
from host.scan.run import OnRow, ScanProgress, ScanResult, resume_scan, run_scan
from host.scan.stop import StopRequest
from host.store import manifest
from host.store.raw import require_raw
from host.store.scanfolder import MANIFEST, ScanFolder
from shared.config import load_instrument
from shared.errors import ConfigError, ScanError


class _Live:
    """Feeds committed rows to a pipeline, which is made when the first row is there."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._source: ScanFolder | None = None
        self.pipeline: Pipeline | None = None

    def add_row(self, row: int) -> None:
        """Process one committed row."""
        if self._source is None or self.pipeline is None:
            self._source = ScanFolder.load(self._folder)
            self.pipeline = Pipeline(self._source, live=True)
        self._source.reload()
        self.pipeline.add_row(row)


Take = Callable[[OnRow | None, OnProgress, StopRequest], ScanResult]


def _run(folder: Path, options: Options, process: bool, take: Take) -> int:
    if process:
        check_library(options)
    live = _Live(folder)
    stop = StopRequest()
    with ScanBar() as bar, ControlDesk(folder, stop) as desk:

        def told(progress: ScanProgress) -> None:
            bar.update(progress)
            if progress.phase != "connect":
                desk.open()  # the scan folder is there, and locked by this program

        result = take(live.add_row if process else None, told, stop)
    if result.processing_error is not None:
        raise result.processing_error
    if result.exit_status != "success":
        raise ScanError(f"{folder}: {result.reason}", "", f"polysight resume {folder}")
    sys.stdout.write(f"{folder}: every row is committed\n")
    sys.stdout.flush()
    if live.pipeline is not None:
        live.pipeline.quality_notes = {"rows_retaken": result.retakes, "rows_incomplete": result.incomplete_rows}
        out = folder / "products"
        clear_products(out)
        sys.stdout.write(finish(live.pipeline, out, options, truth_of(folder)).summary())
    return 0


def _check_new(folder: Path) -> None:
    """Refuse a folder that holds something, before the rig is touched. Raises ConfigError."""
    if not folder.exists():
        return
    if (folder / MANIFEST).exists() and manifest.read(folder / MANIFEST).length:
        raise ConfigError(
            f"{folder} holds a scan already",
            "scans are never overwritten",
            f"`polysight resume {folder}` goes on with it; or give another --out",
        )
    if not folder.is_dir() or any(p.name != MANIFEST for p in folder.iterdir()):
        raise ConfigError(f"{folder} is not an empty folder", "a scan has a folder of its own", "give another --out")


def scan(config: Path, folder: Path, truth: Path | None, options: Options, keep_incomplete: bool, process: bool) -> int:
    """Run a new scan and process it; returns the exit status. Raises PolysightError."""
    rig = load_instrument(config)
    _check_new(folder)
    if truth is not None and not truth.is_file():
        raise ConfigError(f"{truth}: no such file", "--truth names it", "give truth.json, or leave --truth out")

    def take(on_row: OnRow | None, tell: OnProgress, stop: StopRequest) -> ScanResult:
        def told(progress: ScanProgress) -> None:
            tell(progress)
            if truth is not None and progress.phase == "row" and not (folder / TRUTH).exists():
                shutil.copyfile(truth, folder / TRUTH)

        return run_scan(rig, folder, on_row=on_row, progress=told, keep_incomplete=keep_incomplete, stop=stop)

    return _run(folder, options, process, take)


def resume(folder: Path, options: Options, keep_incomplete: bool, process: bool) -> int:
    """Take a scan up at its first row that is not committed; returns the exit status. Raises PolysightError."""
    require_raw(ScanFolder.load(folder))

    def take(on_row: OnRow | None, tell: OnProgress, stop: StopRequest) -> ScanResult:
        return resume_scan(folder, on_row=on_row, progress=tell, keep_incomplete=keep_incomplete, stop=stop)

    return _run(folder, options, process, take)
