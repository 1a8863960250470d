"""What a scan tells while it runs, and how it ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.messages import ExitStatus


@dataclass(frozen=True)
class ScanProgress:
    """Where a scan is.

    `phase`: check, connect, home, row, state, held, wait, committed, retake, warning, stop or end. `message` is for
    people, `state` the row's (docs/spec/row.md).
    """

    phase: str
    message: str
    rows: int
    committed: int
    row: int = -1
    take: int = 0
    points: int = 0
    row_points: int = 0
    remaining_s: float | None = None
    state: str = ""


@dataclass
class ScanResult:
    """How a scan ended; `processing_error` is the first error `on_row` raised, after all data is safe."""

    folder: ScanFolder
    exit_status: ExitStatus
    reason: str
    retakes: int = 0
    incomplete_rows: list[int] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    processing_error: BaseException | None = None


OnProgress = Callable[[ScanProgress], None]
