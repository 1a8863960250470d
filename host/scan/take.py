"""What one take of a row brought, and why it is not complete."""

from __future__ import annotations

from dataclasses import dataclass, field

from polysight.host.capture.receiver import RowCapture
from polysight.host.radar.interface import BoardState, RadarState
from polysight.host.scan.missed_pulses import PlacedFrames
from polysight.host.scan.slipped_row import ToldCapture, describe
from polysight.host.scan.take_faults import FaultKind, TakeFault
from polysight.shared.faults import explain
from polysight.shared.messages import RowFinished
from polysight.shared.raster import Row


@dataclass
class Take:
    """What one take of a row brought.

    Attributes
    ----------
    finished
        None when the Pi never said how it ended.
    captures
        What each board's receiver got.
    aborted
        Why the host had the row aborted, or did not begin it; None when it did not.
    told
        The row's capture events.
    radars
        What was known of the radars at the end.
    not_done
        Radars that did not say, after the last pulse, that all their frames have ended.
    placed
        Of boards that missed pulses: where their frames belong.
    """

    row: Row
    number: int
    finished: RowFinished | None = None
    captures: dict[str, RowCapture] = field(default_factory=dict)
    aborted: TakeFault | None = None
    told: list[ToldCapture] = field(default_factory=list)
    radars: dict[str, BoardState] = field(default_factory=dict)
    not_done: list[str] = field(default_factory=list)
    placed: dict[str, PlacedFrames] = field(default_factory=dict)

    def faults(self, pulses_per_point: int) -> list[TakeFault]:
        """Why this take is not complete; empty when it is."""
        found = [
            TakeFault(FaultKind.RADAR_STOPPED, f"the radar has stopped: {s.detail}", name)
            for name, s in self.stopped_radars.items()
        ]
        if fault := self._fault_of_row(self.row.points * pulses_per_point):
            found.append(fault)
        found += [
            TakeFault(FaultKind.RADAR_WAITS, "the radar still waits for pulses, it missed some", name)
            for name in self.not_done
        ]
        if self.aborted and not self.told:
            return found  # no data could come
        each = (self._fault_of(name, capture, pulses_per_point) for name, capture in self.captures.items())
        return found + [fault for fault in each if fault is not None]

    def _fault_of_row(self, pulses: int) -> TakeFault | None:
        """What the Pi says against it; None when the row was run as planned."""
        f = self.finished
        if f is None:
            return self.aborted or TakeFault(FaultKind.NO_END, "the Pi did not say how the row ended")
        if f.status != "done":
            text = f"the row ended as {f.status}: {f.reason or explain(f.fault).what}"
            if self.aborted is not None and f.status == "aborted":
                return TakeFault(self.aborted.kind, text)
            return TakeFault(FaultKind.PI_FAULT, text, number=f.fault)
        if (f.points, f.pulses) != (self.row.points, pulses):
            text = f"{f.points} points and {f.pulses} pulses, {self.row.points} and {pulses} planned"
            return TakeFault(FaultKind.COUNTS_DIFFER, text)
        return None

    def _fault_of(self, name: str, capture: RowCapture, pulses_per_point: int) -> TakeFault | None:
        """What one board lacks; None when it is complete."""
        placed, radar = self.placed.get(name), self.radars.get(name, BoardState(RadarState.UNKNOWN))
        held = "; the row was held, and a card ends its record after 2 s without data" if self.note else ""
        if capture.packets == 0:
            detail = f": its radar was {radar.detail}, and may not have obeyed" if radar.detail else ""
            return TakeFault(FaultKind.NO_DATA, f"no data{detail}", name)
        if placed is not None and not placed.reason:
            lacks = FaultKind.PULSES_MISSED if placed.slots.size < placed.pulses else FaultKind.SLIPPED
            kind = FaultKind.HELD if held else lacks
            return TakeFault(kind, describe(placed, pulses_per_point) + held, name)
        if not capture.located:
            untold = f"; where cannot be told: {placed.reason}" if placed is not None else ""
            waits = "; the radar still waits for pulses" if radar.state is RadarState.ARMED else ""
            kind = FaultKind.RADAR_WAITS if waits else FaultKind.HELD if held else _unlocated(capture)
            return TakeFault(kind, capture.reason + untold + waits + held, name)
        if capture.missing:
            text = (
                f"{capture.missing_bytes} bytes in {len(capture.missing)} places did not come"
                f" ({capture.kernel_drops} packets dropped by this machine)"
            )
            here = capture.kernel_drops > 0
            return TakeFault(FaultKind.LOST_BY_HOST if here else FaultKind.LOST_ON_THE_WAY, text, name)
        return None

    @property
    def bursts_are_whole(self) -> bool:
        """Whether the Pi sent every pulse, so that what is missing is only data."""
        return self.finished is not None and self.finished.status == "done"

    @property
    def note(self) -> str:
        """What the Pi says of a row that is done: that it was held on the way."""
        return self.finished.reason if self.finished is not None and self.bursts_are_whole else ""

    @property
    def stopped_radars(self) -> dict[str, BoardState]:
        """Radars that have stopped by themselves."""
        return {name: s for name, s in self.radars.items() if s.state is RadarState.FAULT}

    @property
    def silent_boards(self) -> list[str]:
        """Boards from which nothing came though bursts were sent."""
        return [n for n, c in self.captures.items() if c.packets == 0 and (self.told or self.bursts_are_whole)]


def _unlocated(capture: RowCapture) -> FaultKind:
    """What a board's data lacks that cannot be located."""
    if capture.lost_before_packets:
        return FaultKind.CARD_DROPPED
    return FaultKind.FRAMES_MISSING if capture.slipped else FaultKind.UNLOCATED
