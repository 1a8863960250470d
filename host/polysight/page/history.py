"""Rows, takes, counts of each board, times and faults of a scan, collected from its manifest and events.

A fact is a record of the manifest. No files and no clocks are read here, so that the same facts and events always give
the same history. A fault becomes a finding: a sentence with its likely cause and remedy (`CAUSES`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import msgspec

from polysight import store
from polysight.acquisition import FaultKind, typical_row_s
from polysight.planning import scan_time
from polysight_shared.config import Instrument
from polysight_shared.errors import PolysightError
from polysight_shared.faults import PiFault, explain
from polysight_shared.findings import Finding, Level
from polysight_shared.messages import AnyEvent, Capture, Fault, State
from polysight_shared.raster import RasterPlan, plan_raster
from polysight_shared.tables import decode as decode_config

CAUSES: dict[FaultKind, tuple[str, str]] = {
    FaultKind.ON_REQUEST: ("Somebody stopped the scan in this row", "Nothing; `polysight resume` retakes the row"),
    FaultKind.RADAR_STOPPED: (
        "The radar had an internal fault",
        "It is armed again; if that fails, power-cycle the board",
    ),
    FaultKind.RADAR_WAITS: ("SYNC_IN pulses did not reach the board", "Check its SYNC_IN wire and the fan-out buffer"),
    FaultKind.NO_END: (
        "The Pi or the network was busy",
        "Nothing if this is rare; otherwise check the Pi's load and network",
    ),
    FaultKind.COUNTS_DIFFER: (
        "The stage and the Pi counted different numbers of points",
        "Check the stage's trigger wire",
    ),
    FaultKind.NO_DATA: (
        "The radar is not armed, or its card has lost network or power",
        "`polysight card` shows which connection does not answer",
    ),
    FaultKind.HELD: ("Somebody held the stage for more than 2 s", "Nothing"),
    FaultKind.PULSES_MISSED: (
        "The board missed SYNC_IN pulses",
        "Check its SYNC_IN wire; after the scan run `polysight doctor`",
    ),
    FaultKind.SLIPPED: (
        "The board saw edges on SYNC_IN that the Pi did not send",
        "Check its SYNC_IN wire and ground, and cables next to it",
    ),
    FaultKind.FRAMES_MISSING: (
        "The board missed SYNC_IN pulses, or the end of its data was lost",
        "Check its SYNC_IN wire; after the scan run `polysight doctor`",
    ),
    FaultKind.CARD_DROPPED: ("The card could not send as fast as the radar measured", "Check its cable and the switch"),
    FaultKind.LOST_BY_HOST: ("This machine was too busy to receive the packets", "Close other programs on the host"),
    FaultKind.LOST_ON_THE_WAY: (
        "Packets were lost between card and host",
        "Nothing if this is rare; otherwise check cable and switch",
    ),
    FaultKind.CONFLICTING: (
        "Packets with the same counters brought different bytes",
        "Nothing: the row is retaken. If it happens again, reset the card: `polysight card reset BOARD`",
    ),
    FaultKind.UNLOCATED: (
        "Packets were lost at the row's beginning, or the radar saw triggers that were not sent",
        "Nothing if this is rare; otherwise check cable, switch and SYNC_IN wire",
    ),
}
"""Likely cause and remedy by kind of fault. Those of the Pi are in shared/polysight_shared/faults.py."""
# The last outcome of a row: committed whole, committed with gaps ("kept"), or rejected and to be recorded again.
RowMark = Literal["committed", "kept", "rejected"]
# Attributes of a committed row with counts of a board's reception, which the page adds up over the rows.
RECEPTION = ("packets", "duplicates", "late", "kernel_drops", "malformed", "pulses_missed")


def capitalise(text: str) -> str:
    """Return the text with a capital letter first; a command is not changed."""
    if text.startswith("polysight"):
        return text
    return text[:1].upper() + text[1:]


def make_error_notice(error: PolysightError, level: Level = "warning") -> Finding:
    """Return the notice of an error that was raised."""
    return Finding(level, capitalise(error.what), capitalise(error.why), capitalise(error.remedy), code=error.code)


def make_fault_notice(event: Fault) -> Finding:
    """Return the notice of a fault of the Pi: a note if a person requested it, a warning if the rig can continue."""
    explanation = explain(event.number)
    passing_faults = (PiFault.HOST_LOST, PiFault.POINTS_MISMATCH)
    level: Level = "error"
    if event.number == PiFault.ABORTED:
        level = "note"
    elif PiFault.EDGE_LOST <= event.number <= PiFault.PERIOD_TOO_SHORT or event.number in passing_faults:
        # A fault of a burst ends its row, which is recorded again.
        level = "warning"
    details = {} if event.problem == explanation.problem else {"detail": event.problem}
    problem = f"Fault {event.number} at the Pi: {explanation.problem}"
    return Finding(
        level,
        problem,
        capitalise(event.cause or explanation.cause),
        capitalise(event.remedy or explanation.remedy),
        facts=details,
    )


def _find_cause(faults: Sequence[store.RowFault]) -> tuple[str, str]:
    """Return the likely cause and remedy of a row's first fault of a known kind; both are "" if there is none."""
    for fault in faults:
        if fault.kind == FaultKind.PI_FAULT and fault.number:
            explanation = explain(fault.number)
            return capitalise(explanation.cause), capitalise(explanation.remedy)
        if fault.kind in CAUSES:
            return CAUSES[FaultKind(fault.kind)]
    return "", ""


def make_rejection_notice(
    row: int, take: int, reasons: Sequence[str], faults: Sequence[store.RowFault], utc: str
) -> Finding:
    """Return the notice of a rejected take, which is one recording of a row; on request it is not a fault."""
    cause, remedy = _find_cause(faults)
    remedy = remedy or "Nothing: the row is retaken automatically"
    if is_on_request(faults):
        notice = _make_row_notice(row, f"Row {row} was ended on request", (cause, remedy), reasons, utc)
        return msgspec.structs.replace(notice, level="note")
    return _make_row_notice(row, f"Row {row}, take {take}, was rejected", (cause, remedy), reasons, utc)


def is_on_request(faults: Sequence[store.RowFault]) -> bool:
    """True if a take was rejected only because a person aborted the scan."""
    return bool(faults) and all(fault.kind == FaultKind.ON_REQUEST for fault in faults)


def _make_row_notice(row: int, problem: str, why_do: tuple[str, str], reasons: Sequence[str], utc: str) -> Finding:
    """Return the notice of a row, whose reasons the page shows on demand, with the time if it is known."""
    return Finding("warning", problem, *why_do, where=f"row {row}", facts={"detail": "; ".join(reasons), "utc": utc})


class BoardCounts(msgspec.Struct):
    """Data of one board over the committed rows.

    `retaken` is the number of takes that were rejected because of this board, `counts` has the counts of `RECEPTION`.
    `masked` is the number of positions without a direct path, which the page's synchronisation fills in; it is 0 here.
    """

    name: str
    frames_expected: int = 0
    frames_received: int = 0
    retaken: int = 0
    masked: int = 0
    counts: dict[str, int] = {}


class TriggerHealth(msgspec.Struct, frozen=True):
    """Longest SYNC_IN pulse and largest jitter, measured by the Pi."""

    width_max_ns: int
    jitter_max_ns: int


@dataclass(frozen=True)
class PiState:
    """State of the Pi by its last events; replaced as a whole, never changed.

    Attributes
    ----------
    heard_s, heard_utc_s
        Time of the last event, on the monotonic clock and in seconds since 1970; 0 before.
    state
        State that the event named; None before.
    x_mm, y_mm
        Stage offset in the rig frame; None while unknown.
    row, take, point
        The running row, its take and the last point that was passed; row -1 between rows.
    faults
        Faults since the last row that was done.
    receive_error
        Error that prevents the reception of events; None if they are received.
    """

    heard_s: float = 0.0
    heard_utc_s: int = 0
    state: State | None = None
    x_mm: float | None = None
    y_mm: float | None = None
    row: int = -1
    take: int = 0
    point: int = 0
    faults: tuple[Finding, ...] = ()
    receive_error: Finding | None = None


def parse_seconds(utc: str) -> float:
    """Return an ISO time in seconds since 1970."""
    return datetime.fromisoformat(utc).timestamp()


class ScanHistory:
    """A scan according to its manifest and events.

    Attributes
    ----------
    content
        The manifest, of which the first fact has been read.
    instrument, plan
        Rig file of the scan, and its rows and columns.
    notices
        Faults in the order of the facts and events.
    run_started_s, last_commit_s
        Start of the last run, and time of the last row, seconds since 1970. The time of pauses since that row is added
        to it.
    last_row_utc
        Time of the last row as the manifest has it; "" before.
    rows_since_trouble
        Rows committed whole since one was rejected or kept with gaps.
    trigger
        Longest pulse and largest jitter of all bursts; None before the first.
    """

    def __init__(self, content: store.Manifest, started: store.ScanStarted) -> None:
        self.content = content
        self.instrument: Instrument = decode_config(started.instrument, Instrument, "the manifest's instrument")
        self.plan: RasterPlan = plan_raster(self.instrument.grid)
        self.scan_id = started.scan_id
        self.simulated = started.simulated
        self.notices: list[Finding] = []
        self.run_started_s = parse_seconds(started.started_utc or "1970-01-01T00:00:00+00:00")
        self.last_commit_s = 0.0
        self.last_row_utc = ""
        self.rows_since_trouble = 0
        self.trigger: TriggerHealth | None = None
        # Durations of the rows.
        self._row_seconds: list[float] = []
        # Beginning of the last pause, seconds since 1970.
        self._paused_at = 0.0
        # Sequence numbers of the fault events that have a notice already.
        self._fault_seqs: set[int] = set()

    # --- the manifest ---

    @property
    def ended(self) -> store.ScanEnded | None:
        """Last fact of a run that ended; None while it runs, or if it was killed."""
        return self.content.ended

    @property
    def paused(self) -> bool:
        """True while the scan is paused on request."""
        return self.content.paused

    @property
    def takes(self) -> dict[int, int]:
        """Committed row to the take that was committed, in the order of the commits."""
        return {row: fact.take for row, fact in self.content.rows.items()}

    @property
    def marks(self) -> dict[int, RowMark]:
        """Outcome of each row so far."""
        marks: dict[int, RowMark] = {fact.row: "rejected" for fact in self.content.rejected}
        for row, fact in self.content.rows.items():
            marks[row] = "kept" if fact.kept_incomplete else "committed"
        return marks

    @property
    def boards(self) -> list[BoardCounts]:
        """Counts of each board over the committed rows, and of rejected takes."""
        totals = {board.name: BoardCounts(board.name) for board in self.instrument.recorded}
        for rejected in self.content.rejected:
            for name, total in totals.items():
                if rejected.faults:
                    total.retaken += any(fault.board == name for fault in rejected.faults)
                else:
                    # Older scans have no faults by kind, only texts.
                    total.retaken += any(reason.startswith(f"{name}:") for reason in rejected.reasons)
        for row in self.content.rows.values():
            for name, part in row.boards.items():
                total = totals.setdefault(name, BoardCounts(name))
                total.frames_expected += part.frames_expected
                total.frames_received += part.frames_received
                for kind in RECEPTION:
                    count = getattr(part, kind)
                    if count is not None:
                        total.counts[kind] = total.counts.get(kind, 0) + count
        return list(totals.values())

    @property
    def lost_shares(self) -> dict[str, dict[int, float]]:
        """Share of the bytes that are missing in each committed row, percent, by board and row."""
        shares: dict[str, dict[int, float]] = {}
        for row, fact in sorted(self.content.rows.items()):
            for name, part in fact.boards.items():
                shares.setdefault(name, {})[row] = round(100 * part.missing_bytes / max(1, part.bytes), 3)
        return shares

    def add_fact(self, fact: store.Fact) -> None:
        """Add times and notices of the next fact of `content`. Raises ValueError for a time of another form."""
        if isinstance(fact, store.RowCommitted):
            self._add_committed_row(fact)
        elif isinstance(fact, store.RowRejected):
            if not is_on_request(fact.faults):
                self.rows_since_trouble = 0
            self.notices.append(
                make_rejection_notice(fact.row, fact.take, fact.reasons, fact.faults, fact.rejected_utc)
            )
        elif isinstance(fact, store.RowWithdrawn):
            problem = f"Row {fact.row} on the disk differs from the committed row"
            why_do = ("The disk is faulty, or the file was changed", "Nothing: the row is retaken")
            self.notices.append(_make_row_notice(fact.row, problem, why_do, fact.reasons, fact.withdrawn_utc))
        elif isinstance(fact, store.ScanResumed):
            self.run_started_s = parse_seconds(fact.resumed_utc)
            if fact.rig:
                # The Pi has another address from now on.
                self.instrument = store.with_connection(self.instrument, fact.rig)
        elif isinstance(fact, store.ScanPaused):
            self._paused_at = parse_seconds(fact.paused_utc)
        elif isinstance(fact, store.ScanContinued) and self.last_commit_s:
            # The time of a pause does not count as time of the row.
            self.last_commit_s += parse_seconds(fact.continued_utc) - self._paused_at

    def _add_committed_row(self, fact: store.RowCommitted) -> None:
        """Add the time of a committed row, and a notice if it was kept with gaps."""
        self.rows_since_trouble += 1
        if fact.kept_incomplete:
            self.rows_since_trouble = 0
            problem = f"Row {fact.row} is kept with gaps, which are masked"
            notice = _make_row_notice(
                fact.row, problem, _find_cause(fact.faults), fact.kept_incomplete, fact.committed_utc
            )
            self.notices.append(notice)
        if not fact.committed_utc:
            # `polysight simulate` writes all rows together, without times.
            return
        committed_s = parse_seconds(fact.committed_utc)
        self.last_row_utc = fact.committed_utc
        if self.last_commit_s > self.run_started_s:
            self._row_seconds.append(committed_s - self.last_commit_s)
        self.last_commit_s = committed_s

    # --- the Pi's events ---

    def add_events(self, events: Iterable[AnyEvent]) -> None:
        """Add events of the event log; repeated ones change nothing."""
        for event in events:
            if isinstance(event, Capture):
                health = self.trigger or TriggerHealth(0, 0)
                width_ns = max(health.width_max_ns, event.width_max_ns)
                self.trigger = TriggerHealth(width_ns, max(health.jitter_max_ns, event.jitter_ns))
            elif isinstance(event, Fault) and event.seq not in self._fault_seqs:
                self._fault_seqs.add(event.seq)
                self.notices.append(make_fault_notice(event))

    @property
    def row_seconds(self) -> tuple[float, str] | None:
        """Duration of a row and its origin (`measured`, `first row`, `plan`); None if it is not known."""
        if self._row_seconds:
            return typical_row_s(self._row_seconds), "measured"
        if self.last_commit_s > self.run_started_s:
            return self.last_commit_s - self.run_started_s, "first row"
        if self.simulated:
            # The speed of simulated time is not known.
            return None
        return scan_time(self.instrument).total_s / self.instrument.grid.rows, "plan"
