"""Why a take does not count: the kinds, which the manifest keeps for programs, each with a sentence for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from polysight.host.store.manifest import Fact


class FaultKind(StrEnum):
    """What is wrong with a take. The manifest holds the values: none is ever given another meaning."""

    ON_REQUEST = "on_request"  # somebody asked the scan to end now
    RADAR_STOPPED = "radar_stopped"  # it says so itself
    RADAR_WAITS = "radar_waits"  # it is still armed after the last pulse
    PI_FAULT = "pi_fault"  # the Pi ended the row; `number` is of shared/faults.py
    NO_END = "no_end"  # the Pi did not say how the row ended
    COUNTS_DIFFER = "counts_differ"  # points or pulses are not those planned
    NO_DATA = "no_data"
    HELD = "held"  # so long that the cards ended their records
    PULSES_MISSED = "pulses_missed"  # frames are missing, and it is known which
    SLIPPED = "slipped"  # as many frames as pulses, but not at the pulses' times
    FRAMES_MISSING = "frames_missing"  # frames are missing, and it is not known which
    CARD_DROPPED = "card_dropped"  # the card says so: it dropped data before it numbered the packets
    LOST_BY_HOST = "lost_by_host"  # some at least: packets the kernel dropped
    LOST_ON_THE_WAY = "lost_on_the_way"  # packets that never came to this machine
    UNLOCATED = "unlocated"  # data came whose place in the row is not certain


@dataclass(frozen=True)
class TakeFault:
    """One fault of a take.

    Attributes
    ----------
    kind
        For programs.
    text
        For people.
    board
        Whose fault it is; "" when it is that of the row.
    number
        Of `PI_FAULT`, else 0.
    """

    kind: FaultKind
    text: str
    board: str = ""
    number: int = 0

    def __str__(self) -> str:
        return f"{self.board}: {self.text}" if self.board else self.text

    def fact(self) -> Fact:
        """What the manifest keeps beside the sentence (docs/spec/scan-folder.md)."""
        board: Fact = {"board": self.board} if self.board else {}
        number: Fact = {"number": self.number} if self.number else {}
        return {"kind": str(self.kind), **board, **number}


ON_REQUEST = TakeFault(FaultKind.ON_REQUEST, "asked for at the host")


def reasons(faults: list[TakeFault]) -> str:
    """All of them in one sentence."""
    return "; ".join(map(str, faults))
