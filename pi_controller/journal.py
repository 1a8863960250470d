"""The journal: every event of a scan on disk before it is published, so that a lost message can be replayed.

One file a scan, append-only: 8 bytes of magic, then records of `<length, sequence, crc32(sequence + payload)>` (three
little-endian u32) and the packed event. Sequence numbers count up from 1; they jump only where a lost journal was begun
anew behind what the host has. A torn or damaged tail, as a power cut leaves it, is cut off at the last good record when
the file is opened. Specification: docs/spec/wire.md. Used by the executor's thread alone.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import struct
import time
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from polysight.shared import messages as m
from polysight.shared.errors import ConfigError, DataError, DeviceError, ProtocolError
from polysight.shared.faults import PiFault
from polysight.shared.raster import RasterPlan

MAGIC = b"PSJRNL1\n"
MAX_RECORD_BYTES = 1 << 20
CAPTURE_BYTES = 320  # a position's record takes less
SPARE_BYTES = 4 << 20  # faults, rows taken again
SEARCHED_BYTES = 1 << 20  # behind damage, for a good record
DAMAGED = ".damaged"  # suffix of the copy that is kept of a damaged journal
_HEAD = struct.Struct("<III")


class JournalFullError(DeviceError):
    """The journal cannot be written. Nothing of the failed write is in it."""

    number = PiFault.JOURNAL_FULL

    def __init__(self, path: Path, e: OSError) -> None:
        why = "the disk is full" if e.errno in (errno.ENOSPC, errno.EDQUOT) else "the disk is read-only or broken"
        super().__init__(f"journal {path} cannot be written: {e.strerror}", why, "free space on the Pi")


def _crc(seq: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(seq.to_bytes(4, "little")))


def records(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Good records of an open journal from its beginning: (offset, sequence, payload). Ends at the first bad one.

    Raises DataError when the file is no journal at all.
    """
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        if MAGIC.startswith(magic.rstrip(b"\0")):
            return  # made, and the power was cut before its first bytes were on the disk
        name = getattr(file, "name", "journal")
        raise DataError(f"{name}: not a journal", "another program wrote it", "move it out of the journal folder")
    offset, last = len(MAGIC), 0
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        length, seq, crc = _HEAD.unpack(head)
        if length > MAX_RECORD_BYTES or seq <= last:
            return
        payload = file.read(length)
        if len(payload) < length or _crc(seq, payload) != crc:
            return
        yield offset, seq, payload
        offset, last = offset + _HEAD.size + length, seq


def _holds_records(tail: bytes) -> bool:
    """Whether a good record lies behind the damage: a power cut leaves a torn one, or zeros, and nothing behind it."""
    for offset in range(1, min(len(tail) - _HEAD.size, SEARCHED_BYTES)):
        length, seq, crc = _HEAD.unpack_from(tail, offset)
        payload = tail[offset + _HEAD.size : offset + _HEAD.size + length] if 0 < length <= MAX_RECORD_BYTES else b""
        if payload and len(payload) == length and _crc(seq, payload) == crc:
            return True
    return False


class JournalFile:
    """The journal of one scan, open for appending: made when absent, cut at its last good record otherwise.

    `damage` says what was cut off, when that was more than the torn record of a power cut: a copy is kept then.

    Raises DataError when the file exists and is no journal, JournalFullError when it cannot be made or written.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, ""
        self.last_seq = 0  # of the newest record, or of the host's newest event
        self._places: list[tuple[int, int]] = []  # sequence number and offset of each record
        self._synced = True
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as e:
            raise JournalFullError(path, e) from None
        try:
            self._recover()
        except (OSError, DataError) as e:
            os.close(self._fd)
            raise (JournalFullError(path, e) if isinstance(e, OSError) else e) from None

    def _recover(self) -> None:
        self._end = len(MAGIC)
        with self.path.open("rb") as file:
            for offset, self.last_seq, payload in records(file):
                self._places.append((self.last_seq, offset))
                self._end = offset + _HEAD.size + len(payload)
            file.seek(self._end)
            tail = file.read()
        if _holds_records(tail):
            names = (self.path.with_name(f"{self.path.name}{DAMAGED}{n or ''}") for n in (0, *range(2, 1000)))
            copy = next(name for name in names if not name.exists())
            shutil.copyfile(self.path, copy)
            self.damage = (
                f"{self.path}: damaged behind event {self.last_seq}, {len(tail)} bytes that followed are cut off;"
                f" the file as it was is {copy}; the disk or card fails: replace it"
            )
        if not self._places:
            os.pwrite(self._fd, MAGIC, 0)
        os.ftruncate(self._fd, self._end)
        os.fsync(self._fd)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def number_behind(self, seq: int) -> int:
        """Number the next record behind `seq`. Returns how many numbers this skips, which others have used."""
        lost = max(0, seq - self.last_seq)
        self.last_seq += lost
        return lost

    def write(self, payloads: Sequence[bytes], sync: bool = False) -> None:
        """Append records, all or none; with `sync`, wait until everything is on the disk.

        Raises JournalFullError when the disk is full or broken. The file is then as before.
        """
        places, data = [], bytearray()
        for seq, payload in enumerate(payloads, self.last_seq + 1):
            places.append((seq, self._end + len(data)))
            data += _HEAD.pack(len(payload), seq, _crc(seq, payload)) + payload
        done = 0
        try:
            while done < len(data):
                done += os.pwrite(self._fd, memoryview(data)[done:], self._end + done)
            if sync and (data or not self._synced):
                os.fsync(self._fd)
        except OSError as e:
            with suppress(OSError):  # what is left is overwritten, or cut off when the file is next opened
                os.ftruncate(self._fd, self._end)
            raise JournalFullError(self.path, e) from None
        self._end += len(data)
        self._places += places
        self.last_seq += len(places)
        self._synced = sync or (self._synced and not data)

    def read(self, from_seq: int, limit: int) -> list[bytes]:
        """Payloads from `from_seq` on, at most `limit` of them. Raises DataError for a damaged one."""
        first, found = bisect_left(self._places, (from_seq, 0)), []
        for seq, offset in self._places[first : first + limit]:
            length, _, crc = _HEAD.unpack(os.pread(self._fd, _HEAD.size, offset))
            payload = os.pread(self._fd, length, offset + _HEAD.size)
            if _crc(seq, payload) != crc:
                raise DataError(f"{self.path}: record {seq} is damaged", "the disk or card fails", "replace it")
            found.append(payload)
        return found

    def close(self) -> None:
        """Wait until everything is on the disk, and close. Raises JournalFullError."""
        try:
            self.write((), sync=True)
        finally:
            os.close(self._fd)


class Journal:
    """Events in order: numbered, written to the file of the current scan, then published. One process a folder.

    `publish` takes packed events once they are in the file, `warn` sentences.

    Raises ConfigError when the folder cannot be made or written, DeviceError when another process holds it.
    """

    def __init__(
        self,
        folder: Path,
        publish: Callable[[list[bytes]], None] = lambda _: None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.folder, self._publish, self._warn = folder, publish, warn
        self._file: JournalFile | None = None
        self._batch: list[tuple[m.AnyEvent, bytes]] = []
        self._pending = 0  # events of the batch that belong into the file
        self.broken = False
        self.scan_id = ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as e:
            raise ConfigError(
                f"journal folder {folder}: {e.strerror}",
                "it does not exist and cannot be made, or this user may not write there",
                "make it, or choose another with --journal or pi.journal_dir",
            ) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            busy = f"journal folder {folder} is in use", "another polysight-pi runs"
            raise DeviceError(*busy, "stop it, or give another --journal") from None

    @property
    def last_seq(self) -> int:
        """Sequence number of the newest event of the current scan."""
        return self._file.last_seq + self._pending if self._file else 0

    def path_of(self, scan_id: str) -> Path:
        """The journal file of a scan."""
        return self.folder / f"{scan_id}.journal"

    def open(self, scan_id: str, plan: RasterPlan, host_seq: int) -> tuple[bool, int]:
        """Make `scan_id` the current scan. The next event is numbered behind `host_seq`, the newest the host has.

        Returns whether the scan was begun before, and how many of the host's events the journal has lost.

        Raises
        ------
        JournalFullError
            when the journal cannot be had, or there is no room for this plan's.
        DataError
            when it is no journal, or the scan was begun with another plan. In both cases nothing has changed.
        """
        self.broken = False
        self.commit()
        self.check_room(scan_id, plan.positions)
        file = self._file
        if file is None or self.scan_id != scan_id:
            file = JournalFile(self.path_of(scan_id))
            if file.damage:
                self._warn(file.damage)
        try:
            begun = _plan_of(file)
            if begun is not None and begun != plan:
                raise DataError(
                    f"scan {scan_id} was begun with another plan: {begun}",
                    "the scan's name was used before, with another grid",
                    "resume that scan with its own plan, or give the new one another name",
                )
        except (DataError, ProtocolError):
            if file is not self._file:
                file.close()
            raise
        if file is not self._file:
            if self._file is not None:
                self._file.close()
            self._file, self.scan_id = file, scan_id
        return begun is not None or host_seq > 0, file.number_behind(host_seq)

    def check_room(self, scan_id: str, positions: int) -> None:
        """Refuse a scan for whose journal, or the rest of it, the disk has no room. Raises JournalFullError."""
        path = self.path_of(scan_id)
        try:
            there = path.stat().st_size if path.exists() else 0
            free = shutil.disk_usage(self.folder).free
        except OSError as e:
            raise JournalFullError(self.folder, e) from None
        needed = max(0, positions * CAPTURE_BYTES - there) + SPARE_BYTES
        if free < needed:
            room = f"{free / 1e6:.1f} MB free, {needed / 1e6:.1f} MB needed for {positions} positions"
            raise JournalFullError(self.folder, OSError(errno.ENOSPC, room))

    def add(self, kind: type[m.AnyEvent], **fields: Any) -> None:
        """Number an event and add it to the batch; words are cut to what a reader takes.

        An event that does not go into the file carries the last number.
        """
        self._pending += issubclass(kind, m.JOURNALLED) and self._file is not None and not self.broken
        fields = {k: v[: m.MAX_TEXT] if isinstance(v, str) else v for k, v in fields.items()}
        event = kind(scan_id=self.scan_id, seq=self.last_seq, t_mono_ns=time.monotonic_ns(), **fields)
        self._batch.append((event, m.pack(event)))

    def commit(self) -> None:
        """Write the batch to the file, then publish it.

        Raises JournalFullError when it cannot be written. From then on events are published with the last good number
        and not kept, until the scan is opened again; of this batch, only what ends a row or names a fault is published.
        """
        batch, self._batch, self._pending = self._batch, [], 0
        if self._file is not None:
            after = self._file.last_seq
            kept = [(e, raw) for e, raw in batch if isinstance(e, m.JOURNALLED) and e.seq > after]
            try:
                if kept:
                    self._file.write([raw for _, raw in kept], any(not isinstance(e, m.Capture) for e, _ in kept))
            except JournalFullError:
                self.broken = True
                told = [e for e, _ in batch if isinstance(e, m.RowFinished | m.Fault | m.StageStatus)]
                self._publish([m.pack(msgspec.structs.replace(e, seq=after)) for e in told])
                raise
        if batch:
            self._publish([raw for _, raw in batch])

    def read(self, scan_id: str, from_seq: int, limit: int) -> tuple[list[bytes], int]:
        """Packed events of any scan from `from_seq` on, and its newest sequence number; ([], 0) if there is none."""
        if self._file is not None and scan_id == self.scan_id:
            return self._file.read(from_seq, limit), self.last_seq
        found, last = [], 0
        with suppress(FileNotFoundError), self.path_of(scan_id).open("rb") as file:
            for _, last, payload in records(file):
                if last >= from_seq and len(found) < limit:
                    found.append(payload)
        return found, last

    def close(self) -> None:
        """Close the current file, and let another process have the folder. Raises JournalFullError."""
        file, self._file = self._file, None
        try:
            if file is not None:
                file.close()
        finally:
            os.close(self._lock)


def _plan_of(file: JournalFile) -> RasterPlan | None:
    """The plan of the first event; None when there is no event yet."""
    first = file.read(1, 1)
    event = m.unpack_event(first[0]) if first else None
    return event.plan if isinstance(event, m.RunStarted) else None
