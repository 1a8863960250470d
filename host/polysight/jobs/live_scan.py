"""`polysight scan` and `resume`: a scan that is processed while it runs, with a progress bar.

Each row is added to the images as soon as it is committed, so that the products are ready soon after the last row.
With `--no-process` no module of the processing is loaded.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING
from urllib.request import Request, urlopen

from msgspec.structs import replace
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.text import Text

from polysight.acquisition import (
    ControlFolder,
    OnProgress,
    OnRow,
    ScanProgress,
    ScanResult,
    StopRequest,
    ignore_hangup,
    resume_scan,
    run_scan,
)
from polysight.settings import Settings
from polysight.store import MANIFEST, TRUTH, ScanFolder, check_same_scan, manifest, require_raw
from polysight_shared.config import Notify, load_instrument
from polysight_shared.errors import ConfigError, PolysightError, ScanError, join_advice, quote

if TYPE_CHECKING:
    from polysight.jobs.process import LiveProcessing

# Timeout of the command and of the web address of a notification, which must not delay the end of a scan; chosen.
NOTIFY_TIMEOUT_S = 20.0
# A new scan's folder may hold the log of the program that starts it, and notes, and nothing else.
_ALLOWED_ENTRIES = ("program", "operator.json")
# Run or resume a scan: gets functions for committed rows and for progress, and the request to stop.
RunScan = Callable[[OnRow | None, OnProgress, StopRequest], ScanResult]


def _format_clock(seconds: float | None) -> str:
    """Return a remaining time as `1:02:03 left` or `2:03 left`; empty if it is unknown."""
    if seconds is None:
        return ""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minute:02d}:{second:02d} left"
    return f"{minute}:{second:02d} left"


class _PlainConsole(Console):
    """Console that raises OSError for a closed pipe; the console of rich would silence stdout and exit."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError("no program reads the messages now")


class ScanBar:
    """Shows :class:`ScanProgress`: bars on a terminal, elsewhere a line at every tenth of the scan.

    Only `update` raises OSError if the output cannot be written.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or _PlainConsole(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}"),
        )
        self._bars = Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._rows = self._bars.add_task("rows", total=None, left="")
        self._points = self._bars.add_task("points", total=None, left="", visible=False)
        self._printed_tenth = -1

    def __enter__(self) -> ScanBar:
        with suppress(OSError):
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, e: BaseException | None, trace: TracebackType | None) -> None:
        with suppress(OSError):
            self._bars.stop()

    def update(self, progress: ScanProgress) -> None:
        """Show the progress `progress` of the scan."""
        self._bars.update(
            self._rows, total=progress.rows, completed=progress.committed, left=_format_clock(progress.remaining_s)
        )
        if progress.row_points:
            # A take is one recording of a row; a row that fails is retaken.
            row_text = f"row {progress.row}"
            if progress.take > 1:
                row_text += f" take {progress.take}"
            self._bars.update(
                self._points, description=row_text, total=progress.row_points, completed=progress.points, visible=True
            )
        if progress.phase in ("warning", "retake", "home", "check", "connect", "stop", "held", "wait"):
            self._print(f"{progress.phase}: {progress.message}")
        # Print now why the rows ended early: the error message itself follows only after the processing.
        if progress.phase == "end" and progress.committed < progress.rows:
            self._print(f"{progress.phase}: {progress.message}")
        if not self._console.is_terminal and progress.phase == "committed":
            tenth = 10 * progress.committed // max(1, progress.rows)
            if tenth != self._printed_tenth:
                self._printed_tenth = tenth
                self._print(f"{progress.committed} of {progress.rows} rows, {_format_clock(progress.remaining_s)}")

    def _print(self, text: str) -> None:
        """Print a line unchanged: rich would read brackets, as in `[stage]`, as markup, and would colour numbers."""
        self._console.print(Text(text))


def _run_and_notify(folder: Path, processing: LiveProcessing | None, run_rows: RunScan, notifier: Notify) -> int:
    """Run and process a scan, and report its end as [notify] of the rig file says; return the exit status."""
    stop = StopRequest()
    try:
        status = _run_and_process(folder, processing, run_rows, stop)
    except PolysightError as e:
        state = "stopped" if stop.pending else "failed"
        notify(notifier, folder, state, str(e).splitlines()[0])
        raise
    except BaseException as e:
        notify(notifier, folder, "failed", type(e).__name__)
        raise
    message = "every row is safe"
    if status != 0:
        message += ", without a result"
    notify(notifier, folder, "finished", message)
    return status


@ignore_hangup()
def _run_and_process(folder: Path, processing: LiveProcessing | None, run_rows: RunScan, stop: StopRequest) -> int:
    """Run the rows, obey commands to the scan meanwhile, and finish the products; return the exit status.

    A closed terminal (SIGHUP) does not end it. Raises PolysightError if rows or processing failed, or were stopped.
    """
    with ScanBar() as bar, ControlFolder(folder, stop) as control:

        def show_progress(progress: ScanProgress) -> None:
            if progress.phase != "connect":
                # From here on the scan folder exists and is locked by this program.
                control.open()
            bar.update(progress)

        on_row = None
        if processing is not None:
            on_row = processing.add_row
        result = run_rows(on_row, show_progress, stop)
        control.end_rows()
        if result.exit_status == "success":
            _print(f"{folder}: every row is committed\n")
        if result.processing_error is not None:
            raise _add_advice(folder, result, result.processing_error)
        if result.exit_status != "success":
            reason = result.reason
            if stop.asker:
                reason = f"{reason} (asked by {stop.asker})"
            raise ScanError(f"{folder}: {reason}", "", f"polysight resume {quote(folder)}")
        if processing is None:
            return 0
        return processing.finish()


def _print(text: str) -> None:
    """Print to stdout; a closed stdout does not stop processing."""
    with suppress(OSError):
        sys.stdout.write(text)
        sys.stdout.flush()


def _add_advice(folder: Path, result: ScanResult, e: BaseException) -> PolysightError:
    """Return the error to raise if processing failed while the scan continued."""
    remedy = f"the rows are safe: `polysight process {quote(folder)} --out DIR` processes them again"
    if result.exit_status != "success":
        remedy = f"{result.reason}: `polysight resume {quote(folder)}` continues, and processes all rows again"
    if isinstance(e, PolysightError):
        e.remedy = join_advice(e.remedy, remedy)
        return e
    traceback.print_exception(e)
    return ScanError(
        f"processing failed, the scan did not: {type(e).__name__}: {e}",
        "a fault of this program, or there was not enough memory or disk space; the lines above show where",
        remedy,
    )


def _start_processing(folder: Path, settings: Settings) -> LiveProcessing:
    """Return the processing of a running scan."""
    # Imported here, so that a scan that is only recorded loads nothing of the processing.
    from polysight.jobs.process import LiveProcessing

    return LiveProcessing(folder, settings)


def _check_new(folder: Path) -> None:
    """Raise ConfigError before the rig moves if the folder holds more than `_ALLOWED_ENTRIES` and an empty manifest."""
    if not folder.exists():
        return
    if (folder / MANIFEST).exists() and manifest.read(folder / MANIFEST).length:
        raise ConfigError(
            f"{folder} already contains a scan",
            "scans are never overwritten",
            f"`polysight resume {quote(folder)}` continues it; or give another --out",
        )
    if not folder.is_dir() or any(p.name not in (MANIFEST, *_ALLOWED_ENTRIES) for p in folder.iterdir()):
        raise ConfigError(f"{folder} is not an empty folder", "each scan needs its own folder", "give another --out")


def scan(
    config: Path, folder: Path, settings: Settings, truth: Path | None, keep_incomplete: bool, process: bool
) -> int:
    """Run a new scan into `folder`, and process it; returns the exit status. Raises PolysightError.

    `truth` is the truth.json of a simulated rig, copied into the folder. With `keep_incomplete` a row that is
    incomplete after all retakes is committed, masked. Without `process` the rows are only recorded.
    """
    rig = load_instrument(config)
    notifier = rig.notify
    # The web address of [notify] may hold a secret, and people pass manifests on: keep it out of the scan's rig file.
    rig = replace(rig, notify=Notify())
    _check_new(folder)
    if truth is not None and not truth.is_file():
        raise ConfigError(f"{truth}: no such file", "--truth names it", "give truth.json, or leave --truth out")
    processing = None
    if process:
        processing = _start_processing(folder, settings)
        processing.check_new(rig, truth)

    def run_rows(on_row: OnRow | None, on_progress: OnProgress, stop: StopRequest) -> ScanResult:
        """Record the scan; `truth` is copied into its folder once that is there."""

        def copy_truth_and_show(progress: ScanProgress) -> None:
            if truth is not None and progress.phase == "row" and not (folder / TRUTH).exists():
                # A failed copy must not end the scan; it is reported after the last row.
                with suppress(OSError):
                    shutil.copyfile(truth, folder / TRUTH)
            on_progress(progress)

        result = run_scan(
            rig, folder, on_row=on_row, progress=copy_truth_and_show, keep_incomplete=keep_incomplete, stop=stop
        )
        if truth is not None and not (folder / TRUTH).exists():
            sys.stderr.write(f"note: {truth} was not copied into {folder}; the report will not compare with it\n")
        return result

    return _run_and_notify(folder, processing, run_rows, notifier)


def resume(folder: Path, settings: Settings, keep_incomplete: bool, process: bool, config: Path | None = None) -> int:
    """Resume a scan at its first uncommitted row; return the exit status. Raises PolysightError.

    `config` is a rig file with the addresses to use from now on; None: those of the scan's own rig file, which names no
    receiver of notifications, so that none are sent. `keep_incomplete` and `process` as for :func:`scan`.
    """
    source = ScanFolder.load(folder)
    require_raw(source)
    rig_now = None
    notifier = Notify()
    if config is not None:
        rig_now = load_instrument(config)
        check_same_scan(source.instrument, rig_now, str(config))
        notifier = rig_now.notify
    processing = None
    if process:
        processing = _start_processing(folder, settings)
        processing.check_resumed(source)

    def run_rows(on_row: OnRow | None, on_progress: OnProgress, stop: StopRequest) -> ScanResult:
        return resume_scan(
            folder, on_row=on_row, progress=on_progress, keep_incomplete=keep_incomplete, stop=stop, rig_now=rig_now
        )

    return _run_and_notify(folder, processing, run_rows, notifier)


def notify(settings: Notify, folder: Path, state: str, text: str) -> None:
    """Report the end of a scan as `[notify]` of the rig file says; a failure is only noted on stderr.

    Runs the command with the text as its last argument, and sends `{"scan", "state", "text"}` to the address.
    `state` is `finished`, `stopped` or `failed`.
    """
    message = f"{folder.name}: {text}"
    if settings.command:
        _send_or_note(lambda: _run_command([*shlex.split(settings.command), message]), "notify.command")
    if settings.url:
        content = json.dumps({"scan": folder.name, "state": state, "text": message}).encode()
        _send_or_note(lambda: _post(settings.url, content), "notify.url")


def _run_command(words: list[str]) -> None:
    """Run a command without input; its output is discarded. Raises OSError or SubprocessError if it fails."""
    subprocess.run(words, check=True, timeout=NOTIFY_TIMEOUT_S, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def _post(url: str, content: bytes) -> None:
    """Send JSON to a web address. Raises OSError or ValueError if it is not accepted."""
    with urlopen(Request(url, content, {"Content-Type": "application/json"}), timeout=NOTIFY_TIMEOUT_S):
        pass


def _send_or_note(send: Callable[[], None], name: str) -> None:
    """Call `send`; write a note with `name` to stderr if it fails."""
    try:
        send()
    except (OSError, ValueError, subprocess.SubprocessError) as e:
        with suppress(OSError):
            sys.stderr.write(f"note: {name} of the rig file did not work: {type(e).__name__}\n")
