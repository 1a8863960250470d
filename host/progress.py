"""Progress of a scan for people: a bar over rows with the time left, and one over the points of the running row."""

from __future__ import annotations

from contextlib import suppress
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from polysight.host.acquisition.scan import ScanProgress


def _clock(seconds: float | None) -> str:
    """`1:02:03` or `2:03` left; empty when unknown."""
    if seconds is None:
        return ""
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d} left" if hours else f"{minutes}:{whole % 60:02d} left"


class _PlainConsole(Console):
    """A console whose closed pipe is an error like any other; rich's own ends the program and silences stdout."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError("nobody reads the messages any more")


class ScanBar:
    """Shows :class:`ScanProgress`; on anything but a terminal, a line at every tenth of the scan instead of bars.

    What cannot be written is an OSError of `update`, and of nothing else.
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
        self._told = -1

    def __enter__(self) -> ScanBar:
        with suppress(OSError):
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, e: BaseException | None, trace: TracebackType | None) -> None:
        with suppress(OSError):
            self._bars.stop()

    def update(self, p: ScanProgress) -> None:
        """Show where the scan is."""
        self._bars.update(self._rows, total=p.rows, completed=p.committed, left=_clock(p.remaining_s))
        if p.row_points:
            text = f"row {p.row}" + (f" take {p.take}" if p.take > 1 else "")
            self._bars.update(self._points, description=text, total=p.row_points, completed=p.points, visible=True)
        if p.phase in ("warning", "retake", "home", "check", "connect", "stop", "held", "wait"):
            self._console.print(f"{p.phase}: {p.message}", highlight=False)
        if p.phase == "end" and p.committed < p.rows:  # processing may still take a while; the error comes behind it
            self._console.print(f"{p.phase}: {p.message}", highlight=False)
        if not self._console.is_terminal and p.phase == "committed":
            tenth = 10 * p.committed // max(1, p.rows)
            if tenth != self._told:
                self._told = tenth
                self._console.print(f"{p.committed} of {p.rows} rows, {_clock(p.remaining_s)}", highlight=False)
