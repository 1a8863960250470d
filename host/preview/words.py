"""What went wrong, in words: what happened, the likely cause, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from polysight.host.acquisition.take import FaultKind
from polysight.host.store.manifest import Fact
from polysight.shared.errors import PolysightError
from polysight.shared.faults import PiFault, explain
from polysight.shared.messages import Fault

Level = Literal["bad", "warn", "note"]

K = FaultKind
CAUSES: dict[FaultKind, tuple[str, str]] = {
    K.ON_REQUEST: ("Somebody stopped the scan in this row", "Nothing; `polysight resume` takes the row again"),
    K.RADAR_STOPPED: (
        "The radar hit a fault of its own",
        "It is armed anew; if that fails too, power-cycle the board",
    ),
    K.RADAR_WAITS: ("SYNC_IN pulses did not reach the board", "Check its SYNC_IN wire and the fan-out buffer"),
    K.NO_END: ("The Pi or the network was busy", "Nothing, while it is rare; else the Pi's load and network"),
    K.COUNTS_DIFFER: ("The stage and the Pi do not agree on what was passed", "Check the stage's trigger wire"),
    K.NO_DATA: (
        "The radar is not armed, or its card has lost network or power",
        "`polysight card` names the silent hop",
    ),
    K.HELD: ("Somebody held the stage for more than 2 s", "Nothing"),
    K.PULSES_MISSED: (
        "The board missed SYNC_IN pulses",
        "Check its SYNC_IN wire; after the scan `polysight doctor` sends some to try",
    ),
    K.SLIPPED: (
        "The board saw edges on SYNC_IN that the Pi did not send",
        "Check its SYNC_IN wire and ground, and what runs beside it",
    ),
    K.FRAMES_MISSING: (
        "The board missed SYNC_IN pulses, or the end of its data was lost",
        "Check its SYNC_IN wire; after the scan `polysight doctor` sends some to try",
    ),
    K.CARD_DROPPED: ("The card could not send as fast as the radar measured", "Check its cable and the switch"),
    K.LOST_BY_HOST: ("This machine was too busy to take the packets", "Close other programs on the host"),
    K.LOST_ON_THE_WAY: (
        "Packets were lost between card and host",
        "Nothing, while it is rare; else check cable and switch",
    ),
    K.UNLOCATED: (
        "Packets were lost at the row's beginning, or the radar saw triggers that were not sent",
        "Nothing, while it is rare; else check cable, switch and SYNC_IN wire",
    ),
}
"""Likely cause of a fault and what to do. Those of the Pi are in shared/faults.py."""


@dataclass(frozen=True)
class Notice:
    """Something a person should know: in few words, and `detail` for who wants to know more.

    `row` is -1 when it is of no row, `utc` empty when the time is not known.
    """

    level: Level
    what: str
    why: str = ""
    do: str = ""
    detail: str = ""
    row: int = -1
    utc: str = ""


def sentence(text: str) -> str:
    """A text that begins with a capital letter, as the pages show it; a command does not."""
    return text if text.startswith("polysight") else text[:1].upper() + text[1:]


def of_error(error: PolysightError, level: Level = "warn") -> Notice:
    """An error that was raised."""
    return Notice(level, sentence(error.what), sentence(error.why), sentence(error.remedy))


def of_fault(event: Fault) -> Notice:
    """A fault that the Pi told. Those it takes the row again for by itself are warnings."""
    table = explain(event.number)
    passing = PiFault.EDGE_LOST <= event.number <= PiFault.PERIOD_TOO_SHORT or event.number in (
        PiFault.HOST_LOST, PiFault.POINTS_MISMATCH, PiFault.ABORTED,
    )  # fmt: skip
    return Notice(
        "warn" if passing else "bad",
        f"Fault {event.number} at the Pi: {table.what}",
        sentence(event.why or table.why),
        sentence(event.remedy or table.remedy),
        event.what if event.what != table.what else "",
    )


def _cause(faults: Sequence[Fact]) -> tuple[str, str]:
    """Likely cause and remedy of a row's faults, from the first one that is known; newer kinds are not."""
    for fault in faults:
        if fault["kind"] == K.PI_FAULT and fault.get("number"):
            table = explain(int(fault["number"]))
            return sentence(table.why), sentence(table.remedy)
        if fault["kind"] in CAUSES:
            return CAUSES[fault["kind"]]
    return "", ""


def of_rejection(row: int, take: int, reasons: Sequence[str], faults: Sequence[Fact], utc: str) -> Notice:
    """A take that did not count."""
    why, do = _cause(faults)
    do = do or "Nothing: the row is taken again by itself"
    return Notice("warn", f"Row {row}, take {take}, did not count", why, do, "; ".join(reasons), row, utc)


def of_kept(row: int, reasons: Sequence[str], faults: Sequence[Fact], utc: str) -> Notice:
    """A row that is kept though something of it is missing."""
    why, do = _cause(faults)
    return Notice("warn", f"Row {row} is kept with gaps, which are masked", why, do, "; ".join(reasons), row, utc)
