"""The manifest of a scan: an append-only log with one JSON line per fact (docs/spec/scan-folder.md).

`Manifest` is the one reader: `read` takes a whole file, `Manifest.feed` what was appended to a growing one. Facts are
the structs below; unknown keys and kinds are ignored, keys of later releases have defaults. It also says what the
facts add up to: the committed rows, the state of the scan, and the faults of the file.

A line is valid if it is complete and its CRC is right. A last line torn by a kill or power cut is reported by readers
and cut off before appending. Lines form a chain: each has its count and a digest of the line before, so that missing
lines are found. Lines of earlier releases have no chain and are still read.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal, TypeVar

import msgspec

from polysight.store.logs import AppendFile, LogDigest
from polysight_shared.closing import Closing
from polysight_shared.errors import DataError, DeviceError, ErrorCode, PolysightError, make_missing_path_error, quote
from polysight_shared.files import MAX_JSON_BYTES, open_regular, read_bounded
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan

try:
    import fcntl
except ModuleNotFoundError:
    fcntl = None  # type: ignore[assignment]

MANIFEST = "manifest.jsonl"
State = Literal["open", "paused", "finished", "stopped", "failed"]
"""`open`: a program records the scan, or was killed; `control/alive` distinguishes these, also for `paused`."""


# --- facts ---


class Fact(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="fact", tag=str):
    """One line of the manifest. A default means that the key is absent."""


class PiDescription(msgspec.Struct, frozen=True):
    """The Pi that ran the rows: release of its program, of the stage's firmware, and its `backend` (real or simulated).

    `stage` has those keys of its `[stage]` that place rows.
    """

    release: str = ""
    firmware: str = ""
    backend: str = ""
    stage: dict[str, float] = {}


class ScanStarted(Fact, frozen=True, kw_only=True, tag="scan_started"):
    """First fact of a scan. `instrument` is the rig file, `calibration` describes the copied files by kind.

    `format` is that of the folder (1), `versions` the releases of the software; keys in `_utc` are times, ISO 8601.
    """

    format: int = 0
    scan_id: str
    simulated: bool
    started_utc: str = ""
    instrument: dict[str, Any]
    plan: RasterPlan
    versions: dict[str, str] = {}
    pi: PiDescription | None = None
    calibration: Any = None


class RowFault(msgspec.Struct, frozen=True, omit_defaults=True):
    """A fault of a take: kind, board ("": the whole row's), and the Pi's number of a `pi_fault`."""

    kind: str
    board: str = ""
    number: int = 0


class Reception(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Counts of one board's reception of a row (docs/spec/dca1000.md); None where an earlier release or a simulation
    did not count. The fields are explained at :class:`polysight.capture.placement.PacketCounts` and at `RowCapture`.
    """

    packets: int | None = None
    duplicates: int | None = None
    late: int | None = None
    late_by_bytes: int | None = None
    outside: int | None = None
    disagreeing: int | None = None
    malformed: int | None = None
    strangers: int | None = None
    stale: int | None = None
    leftover: int | None = None
    conflicting: int | None = None
    restarted: int | None = None
    before_pulses: int | None = None
    kernel_drops: int | None = None
    head_bytes: int | None = None
    gaps: int | None = None
    gap_bytes: int | None = None
    tail_bytes: int | None = None
    card_status: int | None = None
    card_mac: str = ""
    located: bool | None = None
    received_bytes: int | None = None
    pulses_missed: int | None = None


class BoardRow(Reception, frozen=True, kw_only=True, omit_defaults=True):
    """One board's part of a committed row. `file` is relative to the scan folder; the index is in the same folder.

    `bytes` are those of the whole row, `frames_received` the frames without a missing byte; the three CRC-32 (hex) are
    of payload, index and packets, "" where there is no such file.
    """

    file: str
    bytes: int
    frames_expected: int
    frames_received: int
    missing_bytes: int
    crc32: str
    index_crc32: str = ""
    packets_crc32: str = ""
    # Number of frames whose pulse follows from their count alone: all if there are no arrival times, otherwise 0.
    frames_untimed: int | None = None


class RowCommitted(Fact, frozen=True, kw_only=True, tag="row_committed"):
    """A committed row; `kept_incomplete` has the reasons, and `faults` the faults, of one with gaps.

    `take` is the number of the attempt, `direction` +1 or -1 (of the stage, along x), `pulses` the number that the Pi
    sent, `events` the digest of the event log at the commit, `note` the Pi's remark. `replaced_utc` is set if the row
    was placed again from its packets.
    """

    row: int
    take: int
    direction: int
    boards: dict[str, BoardRow]
    pulses: int
    events: LogDigest | None = None
    committed_utc: str = ""
    replaced_utc: str = ""
    kept_incomplete: list[str] = []
    faults: list[RowFault] = []
    note: str = ""


class RowRejected(Fact, frozen=True, kw_only=True, tag="row_rejected"):
    """A take that was rejected and removed; `reasons` are its faults as text. Earlier releases wrote no `faults`."""

    row: int
    take: int
    reasons: list[str]
    faults: list[RowFault] = []
    boards: dict[str, Reception] = {}
    rejected_utc: str = ""


class RowWithdrawn(Fact, frozen=True, kw_only=True, tag="row_withdrawn"):
    """A committed row whose files have changed since: it counts as missing and is retaken."""

    row: int
    take: int = 0
    reasons: list[str] = []
    withdrawn_utc: str = ""


class DroppedFile(msgspec.Struct, frozen=True):
    """Digest of a payload that was deleted."""

    file: str
    bytes: int
    crc32: str


class RawDropped(Fact, frozen=True, kw_only=True, tag="raw_dropped"):
    """A row whose raw data is deleted, because `products` were made from it."""

    row: int
    take: int
    boards: dict[str, DroppedFile]
    products: str
    dropped_utc: str


class ScanResumed(Fact, frozen=True, kw_only=True, tag="scan_resumed"):
    """Another run began, with `rows_missing` rows to record; `rig` has its connection settings if they were given."""

    resumed_utc: str = ""
    rows_missing: int | None = None
    pi: PiDescription | None = None
    rig: dict[str, Any] | None = None


class ScanPaused(Fact, frozen=True, kw_only=True, tag="scan_paused"):
    """The scan waits, on request."""

    paused_utc: str = ""


class ScanContinued(Fact, frozen=True, kw_only=True, tag="scan_continued"):
    """The pause has ended."""

    continued_utc: str = ""


class ScanEnded(Fact, frozen=True, kw_only=True, tag="scan_ended"):
    """A run ended; `lost_mm` are the steps that the drives lost in x and y, None if they were not measured.

    `exit_status` is success, abort or fail, `reason` a sentence; `why` and `remedy` are those of an error. `asked` is
    the command that ended it, `stop` or `abort`, and `asker` who sent it; "" if no one did. `events_refetched` is
    the number of events that had to be fetched from the Pi's journal.
    """

    exit_status: str = ""
    reason: str = ""
    why: str = ""
    remedy: str = ""
    lost_mm: tuple[float, float] | None = None
    rows_committed: int | None = None
    events_refetched: int | None = None
    ended_utc: str = ""
    asked: str = ""
    asker: str = ""


class OtherFact(Fact, frozen=True, kw_only=True, tag="other"):
    """A fact that is not used: its `kind` is unknown, or its keys are not those of its kind (`problem`)."""

    kind: str
    problem: str = ""


KINDS: dict[str, type[Fact]] = {
    "scan_started": ScanStarted,
    "row_committed": RowCommitted,
    "row_rejected": RowRejected,
    "row_withdrawn": RowWithdrawn,
    "raw_dropped": RawDropped,
    "scan_resumed": ScanResumed,
    "scan_paused": ScanPaused,
    "scan_continued": ScanContinued,
    "scan_ended": ScanEnded,
}
F = TypeVar("F", bound=Fact)


# --- lines ---


class _Head(msgspec.Struct):
    """The keys of a line that make it valid."""

    fact: str
    # CRC-32 of the other keys, hexadecimal.
    crc: str
    # Number of lines before this one; None in a line that is not chained to the one before.
    count: int | None = None
    # Digest of the line before.
    previous: str | None = None


_heads = msgspec.json.Decoder(_Head)
_decoders = {name: msgspec.json.Decoder(kind) for name, kind in KINDS.items()}


def compute_crc(fact: Mapping[str, Any]) -> str:
    """Return the CRC-32 (hex) of a fact without its `crc`: JSON, keys sorted, compact separators."""
    body = json.dumps(fact, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return f"{zlib.crc32(body.encode('ascii')):08x}"


def encode_line(fact: Fact | Mapping[str, Any], **chain: int | str) -> bytes:
    """Encode a fact as a line with CRC and line end; `chain` has `count` and `previous`."""
    content = {**msgspec.to_builtins(fact), **chain}
    line = json.dumps({**content, "crc": compute_crc(content)}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return line.encode("ascii") + b"\n"


def compute_digest(line: bytes) -> str:
    """Return the digest that the next line stores: 16 hex digits of the SHA-256 of the line without its end."""
    return hashlib.sha256(line).hexdigest()[:16]


def decode_line(line: bytes) -> dict[str, Any] | None:
    """Return the content of a line without its `crc`; None if the line is malformed or its CRC is wrong."""
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not isinstance(content.get("fact"), str):
        return None
    crc = content.pop("crc", None)
    try:
        is_whole = crc == compute_crc(content)
    except ValueError:
        return None
    if not is_whole:
        return None
    return content


def _check_line(line: bytes) -> _Head | None:
    """Return the keys that make a line valid; None if it is damaged."""
    try:
        head = _heads.decode(line)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        head = None
    # A line as this program writes it is compared as it stands, without encoding it again.
    if head is not None:
        body = line.replace(f'"crc":"{head.crc}",'.encode(), b"", 1)
        if f"{zlib.crc32(body):08x}" == head.crc:
            return head
    content = decode_line(line)
    if content is None:
        return None
    # Without keys of a chain that can be read the line counts as unchained.
    return head or _Head(content["fact"], "")


def _decode_fact(kind: str, line: bytes) -> Fact:
    """Return the fact of a valid line; `OtherFact` for an unknown kind, or if its keys are not those of its kind."""
    decoder = _decoders.get(kind)
    if decoder is None:
        return OtherFact(kind=kind)
    try:
        return decoder.decode(line)
    except (msgspec.MsgspecError, ValueError) as e:
        return OtherFact(kind=kind, problem=str(e))


# --- the reader ---


def make_manifest_fault(line: int, what: str, lost: int = 0) -> Finding:
    """Return a fault of the manifest at a line (from 1); `lost` facts are missing because of it."""
    line_text = f"{MANIFEST} line {line}"
    return Finding("error", what, where=line_text, code=ErrorCode.FILE_DAMAGED, facts={"line": line, "lost": lost})


@dataclass
class Manifest:
    """The facts of a scan, and what they add up to.

    Attributes
    ----------
    facts, numbers
        The facts in order, and the line number (from 1) of each.
    started
        The first fact; None if it is not there or cannot be read.
    ended
        The end of the last run; None while it runs, or if it was killed.
    paused
        True while the scan is paused on request.
    rows
        The committed rows, each with its last take, in the order of the commits; withdrawn rows are not in it.
    rejected
        All rejected takes.
    faults
        Damaged lines and breaks in the chain.
    length
        Bytes up to the end of the last complete line.
    torn
        True if an incomplete line follows.
    count, digest
        Number of the next line, and the digest of the line before it that it must hold.
    """

    facts: list[Fact] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    started: ScanStarted | None = None
    ended: ScanEnded | None = None
    paused: bool = False
    rows: dict[int, RowCommitted] = field(default_factory=dict)
    rejected: list[RowRejected] = field(default_factory=list)
    faults: list[Finding] = field(default_factory=list)
    length: int = 0
    torn: bool = False
    count: int = 0
    digest: str = ""
    # One more than the count of the last whole line; less than `count` after damaged lines.
    _next_whole: int = 0
    # Lines so far, damaged ones too.
    _lines: int = 0

    def feed(self, raw: bytes) -> list[Fact]:
        """Add what follows the first `length` bytes of the file; return the facts that are new."""
        lines = raw.split(b"\n")
        # The last line is incomplete.
        tail = lines.pop()
        self.torn = bool(tail)
        old_facts = len(self.facts)
        for number, line in enumerate(lines, 1):
            head = _check_line(line)
            if head is None and number == len(lines) and not tail:
                # The last line, whose end is there but not all that is before it, is torn rather than damaged.
                self.torn = True
                break
            self._lines += 1
            if head is None:
                self.faults.append(make_manifest_fault(self._lines, "damaged: its CRC is wrong", 1))
                self.count += 1
            else:
                self._add_line(head, line)
            self.digest = compute_digest(line)
            self.length += len(line) + 1
        return self.facts[old_facts:]

    def _add_line(self, head: _Head, line: bytes) -> None:
        """Count a valid line, compare it with the chain, and add its fact."""
        if head.count is not None and head.previous is not None:
            self._compare(head.count, head.previous)
            self.count = head.count
        self.count += 1
        self._next_whole = self.count
        fact = _decode_fact(head.fact, line)
        # Last, because another thread may compare the number of facts to see that rows were added.
        self._add_up(fact)
        self.numbers.append(self._lines)
        self.facts.append(fact)

    def _compare(self, count: int, previous: str) -> None:
        """Compare a line's count and digest with the lines before it, and add faults."""
        missing = count - self.count
        line_before_is_damaged = self._next_whole < self.count
        if missing > 0 and line_before_is_damaged:
            # A damaged line end joins two lines: both lines are lost, and the one fault that was found counts both.
            last = self.faults.pop()
            self.faults.append(make_manifest_fault(last.facts["line"], last.what, last.facts["lost"] + missing))
        elif missing > 0:
            if missing > 1:
                problem = f"{missing} lines before it are missing"
            else:
                problem = "a line before it is missing"
            self.faults.append(
                make_manifest_fault(self._lines, f"{problem} (count {count}, {self.count} expected)", missing)
            )
        elif count < self._next_whole:
            problem = f"repeated or out of order (count {count}, {self._next_whole} expected)"
            self.faults.append(make_manifest_fault(self._lines, problem))
        elif not line_before_is_damaged and previous != self.digest:
            self.faults.append(make_manifest_fault(self._lines, "the line before it was replaced", 1))

    def _add_up(self, fact: Fact) -> None:
        """Update rows, rejected rows, start, end and pause of the scan by a fact."""
        if isinstance(fact, RowCommitted):
            self.rows.pop(fact.row, None)
            self.rows[fact.row] = fact
        elif isinstance(fact, RowWithdrawn):
            self.rows.pop(fact.row, None)
        elif isinstance(fact, RowRejected):
            self.rejected.append(fact)
        elif isinstance(fact, ScanStarted):
            self.started = self.started or fact
        elif isinstance(fact, ScanEnded):
            self.ended = fact
            self.paused = False
        elif isinstance(fact, ScanResumed):
            self.ended = None
            self.paused = False
        elif isinstance(fact, ScanPaused | ScanContinued):
            self.paused = isinstance(fact, ScanPaused)

    @property
    def state(self) -> State:
        """State of the scan according to its last run."""
        if self.ended is None:
            return "paused" if self.paused else "open"
        planned_rows = 0
        if self.started is not None:
            planned_rows = self.started.plan.rows
        if self.ended.exit_status == "success" and len(self.rows) >= planned_rows:
            return "finished"
        return "stopped" if self.ended.exit_status == "abort" else "failed"

    @property
    def problems(self) -> list[tuple[int, OtherFact]]:
        """Facts whose keys are not those of their kind, with their line numbers."""
        facts = zip(self.numbers, self.facts, strict=True)
        return [(number, fact) for number, fact in facts if isinstance(fact, OtherFact) and fact.problem]

    def of_kind(self, kind: type[F]) -> list[F]:
        """Return all facts of one kind, in order."""
        return [fact for fact in self.facts if isinstance(fact, kind)]


def parse(raw: bytes) -> Manifest:
    """Read a manifest's bytes."""
    content = Manifest()
    content.feed(raw)
    return content


def read(path: Path) -> Manifest:
    """Read a manifest. Raises DataError if the file is absent or unreadable."""
    try:
        return parse(read_bounded(path, MAX_JSON_BYTES))
    except OSError as e:
        if not path.parent.exists():
            raise make_missing_path_error(path.parent) from None
        raise DataError(
            f"{path}: cannot be read: {e.strerror}",
            f"{path.parent} is not a scan folder",
            "give the folder of a scan",
            code=ErrorCode.FILE_MISSING if isinstance(e, FileNotFoundError) else ErrorCode.FILE_UNREADABLE,
        ) from None


# --- locks, and the writer ---

# A byte beyond the end of any file, which Windows locks.
_LOCKED_BYTE = 1 << 30


def lock_file(file: IO[Any] | int, *, shared: bool = False) -> None:
    """Lock an open file until it is closed, also by a kill; `shared` with other shared locks.

    POSIX systems lock with flock(2), Windows with `msvcrt` (which was not tried on Windows).

    Raises
    ------
    BlockingIOError
        if another program has locked it.
    OSError
        if the file system has no locks.
    """
    if fcntl is not None:
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        fcntl.flock(file, kind | fcntl.LOCK_NB)
        return
    import msvcrt

    if isinstance(file, int):
        descriptor = file
    else:
        descriptor = file.fileno()
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    # A byte beyond the end, because Windows keeps others from reading what is locked. All its locks are exclusive.
    os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except PermissionError as e:
        raise BlockingIOError(e.errno, e.strerror) from None
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)


def is_being_written(path: Path) -> bool:
    """True if another program holds the manifest: it records the scan, or changes it."""
    with open_regular(path) as file:
        try:
            lock_file(file, shared=True)
        except BlockingIOError:
            return True
        except OSError:
            # A network disk without locks: no program can have one.
            return False
    return False


class ManifestWriter(Closing):
    """Appends facts durably and locks the scan against other programs. A torn last line is cut off.

    `create`: make the file, which must not exist; otherwise it must.

    Raises
    ------
    DeviceError
        if another program holds the scan, or the file cannot be written.
    """

    def __init__(self, path: Path, create: bool) -> None:
        if create == path.exists():
            if create:
                raise DeviceError(
                    f"{path}: exists already",
                    f"{path.parent} holds a scan",
                    f"choose another folder, or `polysight resume {quote(path.parent)}`",
                    code=ErrorCode.FILE_EXISTS,
                )
            problem = f"{path}: does not exist"
            cause = f"{path.parent} is not a scan folder"
            raise DeviceError(problem, cause, "give the folder of a scan", code=ErrorCode.FILE_MISSING)
        self._file = AppendFile(path, create)
        if not self._lock():
            self._file.close()
            problem = f"{path}: another program is writing this scan"
            raise DeviceError(problem, "a scan runs", "wait for it, or stop it first", code=ErrorCode.BUSY)
        try:
            content = read(path)
            self._count = content.count
            self._digest = content.digest
            self._file.cut(content.length)
        except PolysightError:
            self._file.close()
            raise

    def _lock(self) -> bool:
        """Lock the scan; return False if another program has it. Raises DeviceError, and closes the file then."""
        try:
            lock_file(self._file.fileno())
        except BlockingIOError:
            return False
        except OSError as e:
            self._file.close()
            raise DeviceError(
                f"{self._file.path}: cannot be locked: {e.strerror}",
                "a network disk whose server offers no locks, or the disk fails",
                "put the scan on a local disk, or have its server offer locks",
                code=ErrorCode.FILE_UNWRITABLE,
            ) from None
        return True

    def append(self, fact: Fact | Mapping[str, Any]) -> None:
        """Append one fact durably. After a DeviceError it does not count: the next one overwrites its remains."""
        line = encode_line(fact, count=self._count, previous=self._digest)
        self._file.append(line)
        self._count += 1
        self._digest = compute_digest(line[:-1])

    def close(self) -> None:
        """Close the file and release the lock. Safe to repeat."""
        self._file.close()
