"""The journal: every event of a scan is on disk before it is published, so that lost messages can be replayed.

One append-only file per scan: 8 bytes of magic, then records of `<length, sequence, crc32(sequence + payload)>` (three
little-endian u32) and the packed event. Sequence numbers count from 1, without gaps unless a journal was lost and
continues after the host's last event. A torn or damaged tail, as after a power cut, is cut off at the last good record
when the file is opened. Specification: docs/spec/wire.md.

A disk can hang for a minute without an error. So the program uses the journal through `JournalThread`: no other thread
waits for storage; functions that depend on it are called afterwards.
"""

from __future__ import annotations

import errno
import fcntl
import os
import queue
import shutil
import struct
import threading
import time
import traceback
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from polysight_shared import messages as m
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, PolysightError, ProtocolError
from polysight_shared.faults import PiFault, explain
from polysight_shared.raster import RasterPlan

# First bytes of a journal, by which it is recognised.
MAGIC = b"PSJRNL1\n"
# A longer record is damaged: the longest text of an event has 4000 characters.
MAX_RECORD_BYTES = 1 << 20
# Record of a position, bytes: 300 with a scan name of 64 characters; 356 with the longest name, of 120 characters, for
# which `SPARE_BYTES` make up.
CAPTURE_BYTES = 320
# Space on the disk for the records of faults and retakes; chosen, 13,000 positions.
SPARE_BYTES = 4 << 20
# Bytes after a damaged record that are searched for a good one; chosen, as long as the longest record.
SEARCHED_BYTES = 1 << 20
# Suffix of the copy of a damaged journal.
DAMAGED_SUFFIX = ".damaged"
# Longest queue of jobs and largest batch of events; chosen. A row stops long before they are full, because the journal
# then counts as late (executor.LATE_S).
JOBS_WAITING = 256
EVENTS_WAITING = 1000
# Length of the payload, sequence number, checksum.
_HEAD = struct.Struct("<III")


class JournalFullError(DeviceError):
    """The journal at `path` cannot be written; it contains nothing of the failed write."""

    number = PiFault.JOURNAL_FULL

    def __init__(self, path: Path, e: OSError) -> None:
        cause = "the disk is read-only or broken"
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            cause = "the disk is full"
        summary = f"journal {path} cannot be written: {e.strerror}"
        super().__init__(summary, cause, "free space on the Pi", code=ErrorCode.DISK_FULL)


def _compute_crc(seq: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(seq.to_bytes(4, "little")))


def records(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Yield (offset, sequence, payload) of the records up to the first bad one.

    Raises DataError if the file is not a journal.
    """
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        if MAGIC.startswith(magic.rstrip(b"\0")):
            # The power was cut before the first bytes were on the disk.
            return
        summary = f"{getattr(file, 'name', 'journal')}: not a journal"
        remedy = "move it out of the journal folder"
        raise DataError(summary, "another program wrote it", remedy, code=ErrorCode.FILE_FOREIGN)
    offset = len(MAGIC)
    last = 0
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        length, seq, crc = _HEAD.unpack(head)
        if length > MAX_RECORD_BYTES or seq <= last:
            return
        payload = file.read(length)
        if len(payload) < length or _compute_crc(seq, payload) != crc:
            return
        yield offset, seq, payload
        offset += _HEAD.size + length
        last = seq


def _holds_records(tail: bytes) -> bool:
    """True if a good record follows the damage; after a power cut only a torn record or zeros follow."""
    for offset in range(1, min(len(tail) - _HEAD.size, SEARCHED_BYTES)):
        length, seq, crc = _HEAD.unpack_from(tail, offset)
        start = offset + _HEAD.size
        payload = tail[start : start + length]
        if 0 < length <= MAX_RECORD_BYTES and len(payload) == length and _compute_crc(seq, payload) == crc:
            return True
    return False


class JournalFile:
    """The journal of one scan, open for appending: created if missing, cut at its last good record if damaged.

    `damage` describes what was cut off if that was more than the torn record of a power cut; a copy is kept then.
    Raises DataError if the file is not a journal, JournalFullError if it cannot be created or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        # Number of the newest record, or of the host's newest event if that is later.
        self.last_seq = 0
        # The newest take (number of the attempt) of each row, by the row's index.
        self.takes: dict[int, int] = {}
        # Sequence number and offset in the file of each record.
        self._index: list[tuple[int, int]] = []
        # True if everything that was written is on the disk.
        self._synced = True
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as e:
            raise JournalFullError(path, e) from None
        try:
            self._recover()
        except OSError as e:
            os.close(self._fd)
            raise JournalFullError(path, e) from None
        except DataError:
            os.close(self._fd)
            raise

    def _note_take(self, payload: bytes) -> None:
        """Update `takes` if the event is the start of a row."""
        # The type comes first in the packed event: this test is a hundred times faster than decoding.
        if b"RowStarted" not in payload[:32]:
            return
        with suppress(ProtocolError):
            event = m.unpack_event(payload)
            if isinstance(event, m.RowStarted):
                self.takes[event.row.index] = max(event.take, self.takes.get(event.row.index, 0))

    def _recover(self) -> None:
        """Read the records, copy a damaged file, and cut the file after the last good record."""
        # Offset of the next record.
        self._end = len(MAGIC)
        with self.path.open("rb") as file:
            for offset, self.last_seq, payload in records(file):
                self._index.append((self.last_seq, offset))
                self._note_take(payload)
                self._end = offset + _HEAD.size + len(payload)
            file.seek(self._end)
            tail = file.read()
        if _holds_records(tail):
            # The first name that is free: .damaged, .damaged2, .damaged3 and so on.
            names = (self.path.with_name(f"{self.path.name}{DAMAGED_SUFFIX}{n or ''}") for n in (0, *range(2, 1000)))
            copy = next(name for name in names if not name.exists())
            shutil.copyfile(self.path, copy)
            self.damage = (
                f"{self.path}: damaged after event {self.last_seq}, the following {len(tail)} bytes were cut off;"
                f" the original is kept as {copy}; the disk or card fails: replace it"
            )
        if not self._index:
            os.pwrite(self._fd, MAGIC, 0)
        os.ftruncate(self._fd, self._end)
        os.fsync(self._fd)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def continue_after(self, seq: int) -> int:
        """Continue numbering after `seq`, the host's newest event. Return the number of skipped (lost) events."""
        missing_events = max(0, seq - self.last_seq)
        self.last_seq += missing_events
        return missing_events

    def write(self, payloads: Sequence[bytes], sync: bool = False) -> None:
        """Append all records or none; with `sync`, wait until everything is on the disk.

        Raises JournalFullError if the disk is full or broken; the file is then unchanged.
        """
        new_index = []
        data = bytearray()
        for seq, payload in enumerate(payloads, self.last_seq + 1):
            new_index.append((seq, self._end + len(data)))
            data += _HEAD.pack(len(payload), seq, _compute_crc(seq, payload)) + payload
        written = 0
        try:
            while written < len(data):
                written += os.pwrite(self._fd, memoryview(data)[written:], self._end + written)
            if sync and (data or not self._synced):
                os.fsync(self._fd)
        except OSError as e:
            # If this fails, too: the next write overwrites the incomplete records, or the next start cuts them off.
            with suppress(OSError):
                os.ftruncate(self._fd, self._end)
            raise JournalFullError(self.path, e) from None
        self._end += len(data)
        self._index += new_index
        for payload in payloads:
            self._note_take(payload)
        self.last_seq += len(new_index)
        self._synced = sync or (self._synced and not data)

    def read(self, from_seq: int, limit: int) -> list[bytes]:
        """Return at most `limit` payloads, starting at `from_seq`. Raises DataError for a damaged record."""
        first = bisect_left(self._index, (from_seq, 0))
        payloads = []
        for seq, offset in self._index[first : first + limit]:
            length, _, crc = _HEAD.unpack(os.pread(self._fd, _HEAD.size, offset))
            payload = os.pread(self._fd, length, offset + _HEAD.size)
            if _compute_crc(seq, payload) != crc:
                summary = f"{self.path}: record {seq} is damaged"
                raise DataError(summary, "the disk or card fails", "replace it", code=ErrorCode.FILE_DAMAGED)
            payloads.append(payload)
        return payloads

    def close(self) -> None:
        """Close the file once everything is on the disk. Raises JournalFullError."""
        try:
            self.write((), sync=True)
        finally:
            os.close(self._fd)


class NewEvent(NamedTuple):
    """An event that has no number yet."""

    kind: type[m.AnyEvent]
    # Its fields without those that all events have.
    fields: dict[str, Any]
    # Time of the event, CLOCK_MONOTONIC.
    t_mono_ns: int

    @staticmethod
    def now(kind: type[m.AnyEvent], **fields: Any) -> NewEvent:
        """Return an event of this moment."""
        return NewEvent(kind, fields, time.monotonic_ns())


class Journal:
    """Numbers events, writes them to the file of the current scan, then publishes them. One process per folder.

    `publish` is called with packed events once they are in the file, `warn` with sentences for the log.
    Raises ConfigError if the folder cannot be created or written, DeviceError if another process uses it.
    """

    def __init__(
        self,
        folder: Path,
        publish: Callable[[list[bytes]], None] = lambda _: None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.folder = folder
        self._publish = publish
        self._warn = warn
        # The current scan's file; None until a scan is opened.
        self._file: JournalFile | None = None
        # True after a failed write: events are then published without being stored (see `write`).
        self.broken = False
        # The current scan.
        self.scan_id = ""
        # Current scan and number of its newest published event. Other threads read it, so it is replaced as a whole.
        self.position = ("", 0)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as e:
            raise ConfigError(
                f"journal folder {folder}: {e.strerror}",
                "it does not exist and cannot be created, or this user may not write there",
                "create it, or choose another with --journal or pi.journal_dir",
                code=ErrorCode.FILE_UNREADABLE,
            ) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            summary = f"journal folder {folder} is in use"
            remedy = "stop it, or give another --journal"
            raise DeviceError(summary, "another polysight-pi runs", remedy, code=ErrorCode.BUSY) from None

    @property
    def last_seq(self) -> int:
        """Sequence number of the newest event of the current scan."""
        return self._file.last_seq if self._file else 0

    @property
    def takes(self) -> dict[int, int]:
        """Return the newest take of each row of the current scan."""
        if self._file is None:
            return {}
        return dict(self._file.takes)

    def journal_path(self, scan_id: str) -> Path:
        """Return the path of a scan's journal file."""
        return self.folder / f"{scan_id}.journal"

    def open(self, scan_id: str, plan: RasterPlan, host_seq: int) -> tuple[bool, int]:
        """Make `scan_id` the current scan. The next event is numbered after `host_seq`, the newest of the host.

        Returns
        -------
        resumed
            True if the scan was begun before.
        missing_events
            Number of the host's events that are missing in the journal.

        Raises
        ------
        JournalFullError
            if the journal cannot be opened, or there is no space for this plan's events.
        DataError
            if the file is not a journal, or the scan was begun with another plan. Nothing is changed then.
        """
        self.broken = False
        self.check_room(scan_id, plan.positions)
        file = self._file
        if file is None or self.scan_id != scan_id:
            file = JournalFile(self.journal_path(scan_id))
            if file.damage:
                self._warn(file.damage)
        try:
            begun = _read_plan(file)
            if begun is not None and begun != plan:
                raise DataError(
                    f"scan {scan_id} was begun with another plan: {begun}",
                    "the scan's name was used before, with another grid",
                    "resume that scan with its own plan, or give the new one another name",
                    code=ErrorCode.NAME_TAKEN,
                )
        except (DataError, ProtocolError):
            if file is not self._file:
                file.close()
            raise
        if file is not self._file:
            if self._file is not None:
                self._file.close()
            self._file = file
            self.scan_id = scan_id
        missing_events = file.continue_after(host_seq)
        self.position = (scan_id, file.last_seq)
        return begun is not None or host_seq > 0, missing_events

    def check_room(self, scan_id: str, positions: int) -> None:
        """Raise JournalFullError if the disk has no space for the rest of the scan's journal."""
        path = self.journal_path(scan_id)
        try:
            written = path.stat().st_size if path.exists() else 0
            free_bytes = shutil.disk_usage(self.folder).free
        except OSError as e:
            raise JournalFullError(self.folder, e) from None
        needed_bytes = max(0, positions * CAPTURE_BYTES - written) + SPARE_BYTES
        if free_bytes < needed_bytes:
            room = f"{free_bytes / 1e6:.1f} MB free, {needed_bytes / 1e6:.1f} MB needed for {positions} positions"
            raise JournalFullError(self.folder, OSError(errno.ENOSPC, room))

    def write(self, events: Sequence[NewEvent]) -> None:
        """Number events, write them to the file, then publish them; long texts are cut to the limit of the messages.

        Raises JournalFullError if they cannot be written; of them only faults and the end of a row are then published.
        While the journal is `broken` (until the scan is opened again, or `Home` or `EndRun` tries again), events have
        the last good number and are not stored, and a row that is done ends with a fault: what is not journalled is not
        acknowledged.
        """
        file = None if self.broken else self._file
        seq = self.last_seq
        numbered: list[m.AnyEvent] = []
        for event in events:
            if file is not None:
                seq += 1
            fields: dict[str, Any] = {
                key: value[: m.MAX_TEXT] if isinstance(value, str) else value for key, value in event.fields.items()
            }
            numbered.append(event.kind(scan_id=self.scan_id, seq=seq, t_mono_ns=event.t_mono_ns, **fields))
        if self.broken:
            numbered = [_end_with_fault(event) for event in numbered]
        packed = [m.pack(event) for event in numbered]
        if file is not None:
            try:
                file.write(packed, sync=any(event.kind is not m.Capture for event in events))
            except JournalFullError:
                self.broken = True
                urgent = [_end_with_fault(event) for event in numbered if isinstance(event, m.RowFinished | m.Fault)]
                self._publish([m.pack(msgspec.structs.replace(event, seq=self.last_seq)) for event in urgent])
                raise
        self._publish(packed)
        self.position = (self.scan_id, self.last_seq)

    def publish_now(self, kind: type[m.AnyEvent], **fields: Any) -> None:
        """Publish an event that is not journalled, without waiting for those that are. From any thread."""
        scan_id, seq = self.position
        self._publish([m.pack(kind(scan_id=scan_id, seq=seq, t_mono_ns=time.monotonic_ns(), **fields))])

    def read(self, scan_id: str, from_seq: int, limit: int) -> tuple[list[bytes], int]:
        """Return at most `limit` packed events of any scan from `from_seq` on, and the scan's newest number.

        Return ([], 0) if the scan has no journal. Raises DataError for a damaged record or a file that is not a
        journal.
        """
        if self._file is not None and scan_id == self.scan_id:
            return self._file.read(from_seq, limit), self.last_seq
        payloads = []
        last = 0
        with suppress(FileNotFoundError), self.journal_path(scan_id).open("rb") as file:
            for _, last, payload in records(file):
                if last >= from_seq and len(payloads) < limit:
                    payloads.append(payload)
        return payloads, last

    def close(self) -> None:
        """Close the current file and unlock the folder. Raises JournalFullError."""
        try:
            if self._file is not None:
                self._file.close()
        finally:
            self._file = None
            os.close(self._lock)


def _end_with_fault(event: m.AnyEvent) -> m.AnyEvent:
    """Return a `RowFinished` of status `done` as one with a fault, because it is not journalled; others unchanged."""
    if not isinstance(event, m.RowFinished) or event.status != "done":
        return event
    explanation = explain(PiFault.JOURNAL_FULL)
    return msgspec.structs.replace(event, status="fault", fault=PiFault.JOURNAL_FULL, reason=explanation.problem)


def _read_plan(file: JournalFile) -> RasterPlan | None:
    """Return the plan of the first event, or None if there is no event yet."""
    for packed in file.read(1, 1):
        event = m.unpack_event(packed)
        if isinstance(event, m.RunStarted):
            return event.plan
    return None


class Job(NamedTuple):
    """Work for the journal's thread."""

    work: Callable[[Journal], Any]
    # Called with the result of `work`, or with the error that it raised.
    then: Callable[[Any], object]
    # Time of the request, on the monotonic clock.
    requested_s: float


class JournalThread:
    """A thread that alone uses the journal's files. `add` and `commit` are for the executor's thread.

    Events are collected in a batch, which `commit` has written as a whole.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        # The batch.
        self._events: list[NewEvent] = []
        # None ends the thread.
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        # Time when the current job was requested; None: no job is executed.
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._work, name="journal", daemon=True)
        self._closed = False

    @property
    def position(self) -> tuple[str, int]:
        """The current scan and the number of its newest published event."""
        return self._journal.position

    @property
    def is_broken(self) -> bool:
        """True after a failed write, until the journal is tried again (`retry`, `EndRun`, or opening the scan)."""
        return self._journal.broken

    @property
    def late_s(self) -> float:
        """Age of the oldest job that is not finished, seconds."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def add(self, kind: type[m.AnyEvent], **fields: Any) -> None:
        """Add an event to the batch; events that are not journalled are published immediately."""
        if issubclass(kind, m.JOURNALLED_EVENTS):
            self._events.append(NewEvent.now(kind, **fields))
        else:
            self._journal.publish_now(kind, **fields)

    def commit(self, then: Callable[[PolysightError | OSError | None], object]) -> bool:
        """Queue the batch for writing and publishing; `then` is called with None, or with the error.

        Return False if the queue is full: the batch then waits for a later call. A batch that is too long is dropped,
        and `then` gets the error immediately.
        """
        if self._jobs.qsize() >= JOBS_WAITING and len(self._events) < EVENTS_WAITING:
            return False
        events = self._events
        self._events = []
        if len(events) >= EVENTS_WAITING:
            then(JournalFullError(self._journal.folder, OSError(errno.EIO, "the disk hangs, too many events wait")))
        else:
            self.call(lambda journal: journal.write(events), then)
        return True

    @property
    def has_batch(self) -> bool:
        """True if events wait for :meth:`commit`."""
        return bool(self._events)

    def call(self, work: Callable[[Journal], Any], then: Callable[[Any], object]) -> None:
        """Queue a job; `then` gets its result, or the PolysightError or OSError it raised, in the journal's thread."""
        self._jobs.put(Job(work, then, time.monotonic()))

    def retry(self) -> None:
        """Try to write again from now on: a full disk may have space again."""

        def end_broken_state(journal: Journal) -> None:
            journal.broken = False

        self.call(end_broken_state, lambda _: None)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _work(self) -> None:
        """Execute jobs until None comes."""
        try:
            while (job := self._jobs.get()) is not None:
                self._busy_since_s = job.requested_s
                self.do(job)
                self._busy_since_s = None
        except BaseException:
            # The job never ends, so that the executor sees a journal that is late.
            traceback.print_exc()
            raise

    def do(self, job: Job) -> None:
        """Execute a job and pass its result to its callback."""
        try:
            result = job.work(self._journal)
        except (PolysightError, OSError) as e:
            result = e
        job.then(result)

    def do_waiting(self) -> None:
        """Execute the queued jobs in the calling thread, instead of :meth:`start`."""
        while not self._jobs.empty():
            if (job := self._jobs.get()) is not None:
                self.do(job)

    def stop(self, timeout_s: float) -> None:
        """End the thread after the queued jobs, and close the journal; give up after `timeout_s` if the disk hangs.

        Raises JournalFullError.
        """
        self._jobs.put(None)
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        if not self._thread.is_alive() and not self._closed:
            self._closed = True
            self._journal.close()
