"""One take of a row: what it brought, what is wrong with it, and how it is committed or rejected.

`Take` compares what every board received with the pulses that were sent, and lists the faults (`TakeFault`).
`commit_row` makes its files durable and writes the manifest's line that makes the row count; `reject_row` removes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from polysight.host.acquisition.missed_pulses import PlacedFrames
from polysight.host.acquisition.slipped_row import ToldCapture, describe, write_in_place
from polysight.host.capture import PACKETS, RowCapture, silent_radar, valid_frames
from polysight.host.radar import BoardState, RadarState
from polysight.host.store import PART, Fact, ManifestWriter, ScanFolder, sync_folder, utc_now
from polysight.shared.errors import DeviceError, ScanError, advice
from polysight.shared.faults import explain
from polysight.shared.messages import RowFinished
from polysight.shared.raster import Row

_KINDS = (
    "packets",
    "duplicates",
    "late",
    "late_by_bytes",
    "outside",
    "disagreeing",
    "malformed",
    "strangers",
    "stale",
    "leftover",
    "conflicting",
    "restarted",
    "before_pulses",
    "clock_jumps",
    "kernel_drops",
    "head_bytes",
    "gaps",
    "gap_bytes",
    "tail_bytes",
    "card_status",
)
"""What the manifest says of each board's reception, beside what makes the row count."""


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
    CONFLICTING = "conflicting"  # packets with the same counters brought different bytes
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
        if capture.conflicting and capture.missing:
            text = f"{capture.conflicting} packets brought other bytes than others with the same counters"
            return TakeFault(FaultKind.CONFLICTING, f"{text}; {capture.missing_bytes} bytes are masked", name)
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


def commit_row(scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault], events: Fact) -> None:
    """Give the files their names, make that durable, then write the line that makes the row count.

    `events` is the digest of the event log, which is on the disk already. `faults` says why a row that is kept is
    incomplete; empty for a whole one. Raises DeviceError when the disk fails.
    """
    frames = take.row.points * scan.instrument.burst.pulses
    boards: dict[str, Fact] = {}
    for name, capture in take.captures.items():
        final = scan.row_path(name, take.row.index)
        placed = take.placed.get(name)
        if placed is not None and not placed.reason:
            capture = write_in_place(final.with_suffix(PART), capture, placed, scan.instrument.frame_bytes)
            take.captures[name] = capture
        try:
            final.with_suffix(PART).rename(final)
        except OSError as e:
            raise DeviceError(
                f"{final}: cannot be named: {e.strerror}",
                "the disk is full, read-only or fails",
                f"free space; `polysight resume {scan.path}` takes the row again",
            ) from None
        sync_folder(final.parent)
        boards[name] = {
            "file": str(final.relative_to(scan.path)),
            "bytes": capture.expected,
            "frames_expected": frames,
            "frames_received": int(valid_frames(capture.missing, frames, scan.instrument.frame_bytes).sum()),
            "missing_bytes": capture.missing_bytes,
            "crc32": f"{capture.crc32:08x}",
            "index_crc32": f"{capture.index_crc32:08x}",
            **({"packets_crc32": f"{capture.packets_crc32:08x}"} if capture.packets_crc32 else {}),
            **_counts(take, name),
            **({} if placed is None else {"pulses_missed": placed.pulses - placed.slots.size}),
        }
    fact: Fact = {
        "fact": "row_committed",
        "row": take.row.index,
        "take": take.number,
        "direction": take.row.direction,
        "boards": boards,
        "pulses": take.finished.pulses if take.finished else 0,
        "events": events,
        "committed_utc": utc_now(),
    }
    kept: Fact = {"kept_incomplete": [str(f) for f in faults], "faults": [f.fact() for f in faults]} if faults else {}
    note: Fact = {"note": take.note} if take.note else {}
    writer.append({**fact, **kept, **note})


def reject_row(scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault]) -> None:
    """Remove what was received, and write down why. Raises DeviceError when the disk fails."""
    for name in take.captures:
        path = scan.row_path(name, take.row.index)
        path.with_suffix(PART).unlink(missing_ok=True)
        path.with_suffix(".idx").unlink(missing_ok=True)
        path.with_suffix(PACKETS).unlink(missing_ok=True)
    writer.append(
        {
            "fact": "row_rejected",
            "row": take.row.index,
            "take": take.number,
            "reasons": [str(f) for f in faults],
            "faults": [f.fact() for f in faults],
            "boards": {name: _counts(take, name) for name in take.captures},
            "rejected_utc": utc_now(),
        }
    )


def _counts(take: Take, name: str) -> Fact:
    c = take.captures[name]
    return {**{kind: getattr(c, kind) for kind in _KINDS}, "located": c.located, "received_bytes": c.bytes}


def gave_up(take: Take, faults: list[TakeFault], scan: ScanFolder, takes: int) -> ScanError:
    """The error for a row whose retakes are used up, with the likeliest cause."""
    what = f"row {take.row.index} is not complete after {takes} takes: {reasons(faults)}"
    resume = f"then `polysight resume {scan.path}`; with --keep-incomplete it keeps such rows, masked"
    if take.stopped_radars:
        return ScanError(
            what,
            "a radar has stopped by itself, or the link to it is gone",
            f"check its USB cable, its power and its SYNC_IN (docs/how-to/radar-bring-up.md); {resume}",
        )
    if take.silent_boards:
        silent = [silent_radar(scan.instrument.by_name(name), take.captures[name]) for name in take.silent_boards]
        asked = [f"{n}'s radar was {take.radars[n].detail}" for n in take.silent_boards if n in take.radars]
        return ScanError(
            what, "; ".join([f"{e.what}: {e.why}" for e in silent] + asked), advice(silent[0].remedy, resume)
        )
    if take.finished is not None and take.finished.fault:
        e = explain(take.finished.fault)
        return ScanError(what, e.why, advice(e.remedy, resume))
    return ScanError(
        what,
        "packets are lost on the network or in this machine, or a board misses SYNC_IN pulses",
        f"see the counts of row_rejected in the manifest; check cable, receive buffer and load, {resume}",
    )
