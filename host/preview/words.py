"""What went wrong, in words: what happened, the likely cause, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from shared.errors import PolysightError
from shared.faults import PiFault, explain
from shared.messages import Fault

Level = Literal["bad", "warn", "note"]

# A word of the reason, its likely cause, what to do.
_LOSSES: tuple[tuple[str, str, str], ...] = (
    (
        "asked for at the host",
        "Somebody stopped the scan in this row",
        "Nothing; `polysight resume` takes the row again",
    ),
    (
        "the radar has stopped",
        "The radar hit a fault of its own",
        "It is armed anew; if that fails too, power-cycle the board",
    ),
    (
        "the radar still waits",
        "SYNC_IN pulses did not reach the board",
        "Check its SYNC_IN wire and the fan-out buffer",
    ),
    (
        "no data",
        "The radar is not armed, or its card has lost network or power",
        "`polysight card` names the silent hop",
    ),
    (
        "(0 packets dropped by this machine)",
        "Packets were lost between card and host",
        "Nothing, while it is rare; else check cable and switch",
    ),
    (
        "dropped by this machine",
        "This machine was too busy to take the packets",
        "Close other programs on the host",
    ),
    ("held", "Somebody held the stage for more than 2 s", "Nothing"),
    (
        "pulse",
        "The board missed SYNC_IN pulses",
        "Check its SYNC_IN wire; `polysight-pi pulse` sends some to try",
    ),
)


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


def _cause(reasons: Sequence[str]) -> tuple[str, str]:
    """Likely cause and remedy of a row's faults, from the first one that is known."""
    found = ((why, do) for reason in reasons for word, why, do in _LOSSES if word in reason)
    return next(found, ("", ""))


def of_rejection(row: int, take: int, reasons: Sequence[str], utc: str) -> Notice:
    """A take that did not count."""
    why, do = _cause(reasons)
    do = do or "Nothing: the row is taken again by itself"
    return Notice("warn", f"Row {row}, take {take}, did not count", why, do, "; ".join(reasons), row, utc)


def of_kept(row: int, reasons: Sequence[str], utc: str) -> Notice:
    """A row that is kept though something of it is missing."""
    why, do = _cause(reasons)
    return Notice("warn", f"Row {row} is kept with gaps, which are masked", why, do, "; ".join(reasons), row, utc)
