"""The journal: every event of a scan on disk before it is published, so that a lost message can be asked for again.

One file a scan, append-only: 8 bytes of magic, then records of `<length, sequence, crc32(sequence + payload)>` (three
little-endian u32) and the packed event. Sequence numbers count up from 1; they jump only where a lost journal was begun
anew behind what the host has. A torn or damaged tail, as a power cut leaves it, is cut off at the last good record when
the file is opened. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import struct
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from polysight.shared.errors import ConfigError, DataError, DeviceError

MAGIC = b"PSJRNL1\n"
MAX_RECORD_BYTES = 1 << 20
CAPTURE_BYTES = 320  # a position's record takes less
SPARE_BYTES = 4 << 20  # faults, rows taken again
SEARCHED_BYTES = 1 << 20  # behind damage, for a good record
TAKE_OVER_KEY = "take-over-key"  # file beside the journals: owner of every run, for the person at the Pi
DAMAGED = ".damaged"  # suffix of the copy that is kept of a damaged journal
_HEAD = struct.Struct("<III")


class JournalFullError(DeviceError):
    """The journal cannot be written. Nothing of the failed write is in it."""

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
    if not magic.strip(b"\0"):
        return  # made, and the power was cut before its first bytes were on the disk
    if magic != MAGIC[: len(magic)]:
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


class Journal:
    """The journal of one scan, open for appending: made when absent, cut at its last good record otherwise.

    `damage` says what was cut off, when that was more than the torn record of a power cut: a copy is kept then.

    Raises DataError when the file exists and is no journal, JournalFullError when it cannot be made or written.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, ""
        self._offsets, self._seqs = array("Q"), array("I")
        self._passed = 0  # numbers up to this one are the host's
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

    def _recover(self) -> None:
        self._end = len(MAGIC)
        with self.path.open("rb") as file:
            for offset, seq, payload in records(file):
                self._offsets.append(offset)
                self._seqs.append(seq)
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
        if not self._seqs:
            os.pwrite(self._fd, MAGIC, 0)
        os.ftruncate(self._fd, self._end)
        os.fsync(self._fd)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    @property
    def last_seq(self) -> int:
        """Sequence number of the newest record; 0 when there is none."""
        return max(self._passed, self._seqs[-1] if self._seqs else 0)

    def number_behind(self, seq: int) -> int:
        """Number the next record behind `seq`. Returns how many numbers this passes over, which others have used."""
        lost = max(0, seq - self.last_seq)
        self._passed = max(self._passed, seq)
        return lost

    def write(self, payloads: Sequence[bytes], sync: bool = False) -> None:
        """Append records, all or none; with `sync`, wait until everything is on the disk.

        Raises JournalFullError when the disk is full or broken. The file is then as before.
        """
        offsets, seqs, data = array("Q"), array("I"), bytearray()
        for seq, payload in enumerate(payloads, self.last_seq + 1):
            offsets.append(self._end + len(data))
            seqs.append(seq)
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
        self._offsets += offsets
        self._seqs += seqs
        self._synced = sync or (self._synced and not data)

    def read(self, from_seq: int, limit: int) -> list[bytes]:
        """Payloads from `from_seq` on, at most `limit` of them. Raises DataError for a damaged one."""
        first, found = bisect_left(self._seqs, from_seq), []
        part = slice(first, first + limit)
        for seq, offset in zip(self._seqs[part], self._offsets[part], strict=True):
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


class JournalFolder:
    """The folder of journals, held by one process at a time.

    Raises ConfigError when the folder cannot be made or written, DeviceError when another process holds it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(path / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as e:
            raise ConfigError(
                f"journal folder {path}: {e.strerror}",
                "it does not exist and cannot be made, or this user may not write there",
                "make it, or choose another with --journal or pi.journal_dir",
            ) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise DeviceError(
                f"journal folder {path} is in use", "another polysight-pi runs", "stop it, or give another --journal"
            ) from None

    def path_of(self, scan_id: str) -> Path:
        """The journal file of a scan."""
        return self.path / f"{scan_id}.journal"

    def open(self, scan_id: str) -> Journal:
        """The journal of a scan, made when absent."""
        return Journal(self.path_of(scan_id))

    def read(self, scan_id: str, from_seq: int, limit: int) -> tuple[list[bytes], int]:
        """Payloads from `from_seq` on and the newest sequence number of a scan that is not open; ([], 0) if absent."""
        found, last = [], 0
        with suppress(FileNotFoundError), self.path_of(scan_id).open("rb") as file:
            for _, last, payload in records(file):
                if last >= from_seq and len(found) < limit:
                    found.append(payload)
        return found, last

    def check_room(self, scan_id: str, positions: int) -> None:
        """Refuse a scan for whose journal, or the rest of it, the disk has no room. Raises JournalFullError."""
        path = self.path_of(scan_id)
        try:
            there = path.stat().st_size if path.exists() else 0
            free = shutil.disk_usage(self.path).free
        except OSError as e:
            raise JournalFullError(self.path, e) from None
        needed = max(0, positions * CAPTURE_BYTES - there) + SPARE_BYTES
        if free < needed:
            room = f"{free / 1e6:.1f} MB free, {needed / 1e6:.1f} MB needed for {positions} positions"
            raise JournalFullError(self.path, OSError(errno.ENOSPC, room))

    def write_secret(self, name: str, secret: str) -> None:
        """Write a file that this program's user alone can read. Raises ConfigError."""
        path = self.path / name
        try:
            path.unlink(missing_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as file:
                file.write(secret)
        except OSError as e:
            raise ConfigError(f"{path}: {e.strerror}", "the disk is full or read-only", "free space there") from None

    def close(self) -> None:
        """Let another process have the folder."""
        os.close(self._lock)
