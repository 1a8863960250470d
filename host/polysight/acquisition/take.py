"""One take of a row: its data, its faults, and how it is committed or rejected.

`Take.faults` compares the data of every board with the pulses that were sent and lists the faults (`TakeFault`).
`commit_row` makes the files durable and adds the row to the manifest; `reject_row` deletes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from polysight.acquisition.missed_pulses import PlacedFrames
from polysight.acquisition.slipped_row import ReceivedCapture, describe, rewrite_row
from polysight.capture import PACKETS, RowCapture, silent_radar, valid_frames, write_error
from polysight.radar import BoardState, RadarState
from polysight.store import (
    PART,
    BoardRow,
    LogDigest,
    ManifestWriter,
    Reception,
    RowCommitted,
    RowFault,
    RowRejected,
    ScanFolder,
    sync_folder,
    utc_now,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ScanError, advice
from polysight_shared.faults import explain
from polysight_shared.messages import RowFinished
from polysight_shared.raster import Row


class FaultKind(StrEnum):
    """Kinds of faults of a take. The manifest stores the values: never change the meaning of one."""

    ON_REQUEST = "on_request"  # the scan was aborted on request
    RADAR_STOPPED = "radar_stopped"  # reported by the radar
    RADAR_WAITS = "radar_waits"  # still armed after the last pulse
    PI_FAULT = "pi_fault"  # the Pi ended the row; `number` is of shared/polysight_shared/faults.py
    NO_END = "no_end"  # the Pi did not report how the row ended
    COUNTS_DIFFER = "counts_differ"  # points or pulses are not as planned
    NO_DATA = "no_data"
    HELD = "held"  # the row was held so long that the cards ended their records
    PULSES_MISSED = "pulses_missed"  # frames are missing at known pulses
    SLIPPED = "slipped"  # as many frames as pulses, but not at the pulses' times
    FRAMES_MISSING = "frames_missing"  # frames are missing at unknown pulses
    CARD_DROPPED = "card_dropped"  # the card reports that it dropped data before numbering packets
    LOST_BY_HOST = "lost_by_host"  # packets dropped by the kernel, possibly others too
    LOST_ON_THE_WAY = "lost_on_the_way"  # packets that never reached this machine
    CONFLICTING = "conflicting"  # packets with equal counters and different bytes
    UNLOCATED = "unlocated"  # data with an uncertain place in the row


@dataclass(frozen=True)
class TakeFault:
    """One fault of a take: a kind for programs, a text for people."""

    kind: FaultKind
    text: str
    board: str = ""  # "" if the fault is the whole row's
    number: int = 0  # of a `PI_FAULT`

    def __str__(self) -> str:
        return f"{self.board}: {self.text}" if self.board else self.text

    def fact(self) -> RowFault:
        """Return the fault as the manifest stores it."""
        return RowFault(str(self.kind), self.board, self.number)


ON_REQUEST = TakeFault(FaultKind.ON_REQUEST, "stop requested at the host")


def reasons(faults: list[TakeFault]) -> str:
    """Join the faults to one sentence."""
    return "; ".join(map(str, faults))


@dataclass
class Take:
    """Data and events of one take of a row; dictionaries are by board."""

    row: Row
    number: int
    finished: RowFinished | None = None  # None if the Pi did not report how the row ended
    captures: dict[str, RowCapture] = field(default_factory=dict)
    aborted: TakeFault | None = None  # why the host aborted the row, or did not begin it
    events: list[ReceivedCapture] = field(default_factory=list)
    radars: dict[str, BoardState] = field(default_factory=dict)  # latest states
    not_done: list[str] = field(default_factory=list)  # radars that did not confirm the end of all frames
    placed: dict[str, PlacedFrames] = field(default_factory=dict)  # boards with missed pulses

    def faults(self, pulses_per_point: int) -> list[TakeFault]:
        """List the faults of this take; empty if it is complete."""
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
        if self.aborted and not self.events:
            return found  # no pulses, no data
        each = (self._fault_of(name, capture, pulses_per_point) for name, capture in self.captures.items())
        return found + [fault for fault in each if fault is not None]

    def _fault_of_row(self, pulses: int) -> TakeFault | None:
        """Return the fault that the Pi reported; None if the row was run as planned."""
        f = self.finished
        if f is None:
            return self.aborted or TakeFault(FaultKind.NO_END, "the Pi did not report how the row ended")
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
        """Return the fault of one board's data; None if it is complete."""
        placed, radar = self.placed.get(name), self.radars.get(name, BoardState(RadarState.UNKNOWN))
        held = "; the row was held, and a card ends its record after 2 s without data" if self.note else ""
        if capture.packets == 0:
            detail = f": its radar was {radar.detail}, and may not have obeyed" if radar.detail else ""
            return TakeFault(FaultKind.NO_DATA, f"no data{detail}", name)
        if placed is not None and not placed.reason:
            missed = FaultKind.PULSES_MISSED if placed.slots.size < placed.pulses else FaultKind.SLIPPED
            kind = FaultKind.HELD if held else missed
            return TakeFault(kind, describe(placed, pulses_per_point) + held, name)
        if not capture.located:
            unplaced = f"; missed pulses cannot be located: {placed.reason}" if placed is not None else ""
            waits = "; the radar still waits for pulses" if radar.state is RadarState.ARMED else ""
            kind = FaultKind.RADAR_WAITS if waits else FaultKind.HELD if held else _unlocated(capture)
            return TakeFault(kind, capture.reason + unplaced + waits + held, name)
        if capture.conflicting and capture.missing:
            text = f"{capture.conflicting} packets have other bytes than packets with equal counters"
            return TakeFault(FaultKind.CONFLICTING, f"{text}; {capture.missing_bytes} bytes are masked", name)
        if capture.missing:
            text = (
                f"{capture.missing_bytes} bytes are missing in {len(capture.missing)} places"
                f" ({capture.kernel_drops} packets dropped by this machine)"
            )
            here = capture.kernel_drops > 0
            return TakeFault(FaultKind.LOST_BY_HOST if here else FaultKind.LOST_ON_THE_WAY, text, name)
        return None

    @property
    def all_pulses_sent(self) -> bool:
        """True if the Pi sent every pulse of the row, so that only data can be missing."""
        return self.finished is not None and self.finished.status == "done"

    @property
    def note(self) -> str:
        """The Pi's remark on a completed row: that it was held during the sweep."""
        return self.finished.reason if self.finished is not None and self.all_pulses_sent else ""

    @property
    def stopped_radars(self) -> dict[str, BoardState]:
        """Radars that have stopped by themselves."""
        return {name: s for name, s in self.radars.items() if s.state is RadarState.FAULT}

    @property
    def silent_boards(self) -> list[str]:
        """Boards without any data although bursts were sent."""
        return [n for n, c in self.captures.items() if c.packets == 0 and (self.events or self.all_pulses_sent)]


def _unlocated(capture: RowCapture) -> FaultKind:
    """Return why a board's data cannot be located in the row."""
    if capture.lost_before_packets:
        return FaultKind.CARD_DROPPED
    return FaultKind.FRAMES_MISSING if capture.slipped else FaultKind.UNLOCATED


def commit_row(
    scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault], events: LogDigest
) -> None:
    """Rename the row's files to their final names, durably, then add `row_committed` to the manifest.

    `events` is the digest of the event log, which must be on the disk. `faults` are those of a row kept incomplete;
    empty for a complete row. Raises DeviceError if the disk fails.
    """
    frames = take.row.points * scan.instrument.burst.pulses
    boards: dict[str, BoardRow] = {}
    for name, capture in take.captures.items():
        final = scan.row_path(name, take.row.index)
        placed = take.placed.get(name)
        if placed is not None and not placed.reason:
            capture = rewrite_row(final.with_suffix(PART), capture, placed, scan.instrument.frame_bytes)
            take.captures[name] = capture
        try:
            final.with_suffix(PART).rename(final)
        except OSError as e:
            raise write_error(final, "renamed", e) from None
        sync_folder(final.parent)
        boards[name] = BoardRow(
            file=str(final.relative_to(scan.path)),
            bytes=capture.expected,
            frames_expected=frames,
            frames_received=int(valid_frames(capture.missing, frames, scan.instrument.frame_bytes).sum()),
            missing_bytes=capture.missing_bytes,
            crc32=f"{capture.crc32:08x}",
            index_crc32=f"{capture.index_crc32:08x}",
            packets_crc32=f"{capture.packets_crc32:08x}" if capture.packets_crc32 else "",
            pulses_missed=None if placed is None else placed.pulses - placed.slots.size,
            **_reception(capture),
        )
    writer.append(
        RowCommitted(
            row=take.row.index,
            take=take.number,
            direction=take.row.direction,
            boards=boards,
            pulses=take.finished.pulses if take.finished else 0,
            events=events,
            committed_utc=utc_now(),
            kept_incomplete=[str(f) for f in faults],
            faults=[f.fact() for f in faults],
            note=take.note,
        )
    )


def reject_row(scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault]) -> None:
    """Delete the files of the take and add `row_rejected` with the faults to the manifest. Raises DeviceError."""
    for name in take.captures:
        path = scan.row_path(name, take.row.index)
        for suffix in (PART, ".idx", PACKETS):
            path.with_suffix(suffix).unlink(missing_ok=True)
    writer.append(
        RowRejected(
            row=take.row.index,
            take=take.number,
            reasons=[str(f) for f in faults],
            faults=[f.fact() for f in faults],
            boards={name: Reception(**_reception(capture)) for name, capture in take.captures.items()},
            rejected_utc=utc_now(),
        )
    )


def _reception(capture: RowCapture) -> dict[str, Any]:
    """Return the fields of `Reception` that every capture has."""
    counts = {kind: getattr(capture, kind) for kind in Reception.__struct_fields__ if hasattr(capture, kind)}
    return {**counts, "received_bytes": capture.bytes}


def retakes_exhausted(take: Take, faults: list[TakeFault], scan: ScanFolder, takes: int) -> ScanError:
    """Return the error for a row whose retakes are used up, with the likeliest cause."""
    why = "packets are lost on the network or in this machine, or a board misses SYNC_IN pulses"
    remedy = "see the counts of row_rejected in the manifest; check cable, receive buffer and load"
    if take.stopped_radars:
        why = "a radar has stopped by itself, or the link to it is gone"
        remedy = "check its USB cable, its power and its SYNC_IN (docs/how-to/radar-bring-up.md)"
    elif take.silent_boards:
        silent = [silent_radar(scan.instrument.by_name(name), take.captures[name]) for name in take.silent_boards]
        states = [f"{n}'s radar was {take.radars[n].detail}" for n in take.silent_boards if n in take.radars]
        why, remedy = "; ".join([f"{e.what}: {e.why}" for e in silent] + states), silent[0].remedy
    elif take.finished is not None and take.finished.fault:
        explained = explain(take.finished.fault)
        why, remedy = explained.why, explained.remedy
    return ScanError(
        f"row {take.row.index} is not complete after {takes} takes: {reasons(faults)}",
        why,
        advice(remedy, f"then `polysight resume {scan.path}`; with --keep-incomplete it keeps such rows, masked"),
        code=ErrorCode.ROW_INCOMPLETE,
    )
