"""What becomes of a take: committed, rejected, or given up with a reason."""

from __future__ import annotations

from polysight.host.capture.decode import valid_frames
from polysight.host.capture.network import silent_radar
from polysight.host.scan.slipped_row import write_in_place
from polysight.host.scan.take import Take
from polysight.host.scan.take_faults import TakeFault, reasons
from polysight.host.store.append_only import sync_folder
from polysight.host.store.manifest import Fact, ManifestWriter
from polysight.host.store.scan_folder import PART, ScanFolder, utc_now
from polysight.shared.errors import DeviceError, ScanError, advice
from polysight.shared.faults import explain

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
    "kernel_drops",
    "head_bytes",
    "gaps",
    "gap_bytes",
    "tail_bytes",
    "card_status",
)
"""What the manifest says of each board's reception, beside what makes the row count."""


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
