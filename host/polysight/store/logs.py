"""Append-only files with durable writes, which the manifest and the event log use, and the event log.

`events.msgpack` has the journalled events of the Pi as consecutive msgpack maps, without gaps. Any msgpack reader can
stream the file. Each map has a CRC-32, as each line of the manifest has. A torn last event, after a kill or power cut,
is cut off before appending; the journal of the Pi contains it.

`crc32` is that of zlib-ng, which is faster, if it is installed, and zlib's otherwise; both have the same result.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import msgpack
import msgspec

from polysight.capture import make_write_error
from polysight_shared.errors import DataError, DeviceError, ErrorCode, ProtocolError
from polysight_shared.files import open_to_write, sync_folder
from polysight_shared.messages import AnyEvent, pack_with_crc, unpack_with_crc

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["AppendFile", "EventLog", "EventWriter", "LogDigest", "crc32", "parse_events", "read_events"]


class AppendFile:
    """A file open for durable, unbuffered appending; with `create`, made if missing.

    `length` is the number of valid bytes; bytes after them, from a failed :meth:`append`, are overwritten or cut off.

    Raises
    ------
    DeviceError
        if the file cannot be opened.
    """

    def __init__(self, path: Path, create: bool) -> None:
        self.path = path
        fresh = create and not path.exists()
        try:
            with ExitStack() as stack:
                self._file = stack.enter_context(open_to_write(path, "xb" if fresh else "r+b", 0))
                if fresh:
                    sync_folder(path.parent)
                self.length = os.fstat(self._file.fileno()).st_size
                stack.pop_all()
        except OSError as e:
            raise make_write_error(path, "created" if fresh else "opened", e) from None

    def fileno(self) -> int:
        """Return the descriptor of the open file, to lock it."""
        return self._file.fileno()

    def cut(self, length: int) -> None:
        """Truncate the file to `length` bytes. Raises DeviceError."""
        try:
            os.ftruncate(self._file.fileno(), length)
            os.fsync(self._file.fileno())
        except OSError as e:
            raise make_write_error(self.path, "cut at its last complete record", e) from None
        self.length = length

    def append(self, data: bytes) -> None:
        """Append `data` durably. After a DeviceError `length` is unchanged; the file too, if it can be truncated."""
        remaining = memoryview(data)
        end = self.length
        try:
            while remaining:
                written_bytes = os.pwrite(self._file.fileno(), remaining, end)
                remaining = remaining[written_bytes:]
                end = end + written_bytes
            os.fsync(self._file.fileno())
        except OSError as e:
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), self.length)
            raise make_write_error(self.path, "written", e) from None
        self.length = end

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        self._file.close()


# Suffix of the file with the data that was cut off.
DAMAGED_SUFFIX = ".damaged"


@dataclass
class EventLog:
    """Content of an event file."""

    # The events before the first one that is torn or damaged.
    events: list[AnyEvent]
    # Length of the good records, bytes.
    length: int
    # True if the beginning of an event or zeros follow, as after a kill or power cut.
    torn: bool = False
    # Description of damage after the good records; "" if there is none.
    damage: str = ""


def read_events(path: Path) -> EventLog:
    """Read an event file up to its first damage; a missing file is empty. Raises DataError if it is unreadable."""
    return parse_events(_read_bytes(path))


def parse_events(raw: bytes) -> EventLog:
    """Read the bytes of an event file, or of what was appended to one, up to the first damage."""
    log = EventLog([], 0)
    try:
        for end in _find_ends(raw):
            log.events.append(unpack_with_crc(raw[log.length : end]))
            log.length = end
    except ProtocolError as e:
        log.damage = f"event {len(log.events) + 1} is damaged: {e.what}"
    except (ValueError, msgpack.UnpackException):
        log.damage = f"event {len(log.events) + 1} is damaged: not msgpack at byte {log.length}"
    tail = raw[log.length :]
    if log.damage and _is_beginning(tail.rstrip(b"\0")):
        # The file had grown, but not all its bytes were on the disk at a power cut.
        log.damage = ""
    log.torn = bool(tail) and not log.damage
    return log


def _is_beginning(raw: bytes) -> bool:
    """True if this may be the incomplete beginning of an event."""
    try:
        return next(_find_ends(raw), None) is None
    except (ValueError, msgpack.UnpackException):
        return False


def _read_bytes(path: Path) -> bytes:
    """Return the content of a file; empty if it does not exist. Raises DataError if it cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as e:
        raise DataError(
            f"{path}: cannot be read: {e.strerror}",
            "no permission, or the disk fails",
            f"check {path.parent}",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None


def _find_ends(raw: bytes) -> Iterator[int]:
    """Yield the end of each complete msgpack object, in bytes from the start. Raises as msgpack does for other data."""
    unpacker = msgpack.Unpacker(raw=True, max_buffer_size=max(len(raw), 1))
    unpacker.feed(raw)
    while True:
        try:
            unpacker.skip()
        except msgpack.OutOfData:
            return
        yield unpacker.tell()


class LogDigest(msgspec.Struct, frozen=True):
    """Length and CRC-32 (8 hexadecimal digits) of the event log when a row was committed: written to the manifest."""

    bytes: int
    crc32: str


class EventWriter:
    """Appends events to a file; they are durable after :meth:`sync`. `last_seq` is the newest sequence number.

    Torn or damaged data after the last complete event is moved to `events.msgpack.damaged`.

    Raises
    ------
    DataError, DeviceError
        if the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        log = read_events(path)
        if log.damage or log.torn:
            copy = AppendFile(path.with_name(path.name + DAMAGED_SUFFIX), create=True)
            try:
                copy.append(_read_bytes(path)[log.length :])
            finally:
                copy.close()
        self._file = AppendFile(path, create=True)
        try:
            self._file.cut(log.length)
        except DeviceError:
            self._file.close()
            raise
        self._batch: list[bytes] = []
        self._crc = crc32(_read_bytes(path))
        self.last_seq = max((e.seq for e in log.events), default=0)

    def append(self, event: AnyEvent) -> None:
        """Add one event; :meth:`sync` writes it."""
        self._batch.append(pack_with_crc(event))
        self.last_seq = event.seq

    def sync(self) -> None:
        """Make all events durable. After a DeviceError the next call retries."""
        data = b"".join(self._batch)
        if data:
            self._file.append(data)
            self._crc = crc32(data, self._crc)
            self._batch.clear()

    def digest(self) -> LogDigest:
        """Return the length and CRC-32 of the file on disk, for the manifest."""
        return LogDigest(self._file.length, f"{self._crc:08x}")

    def close(self) -> None:
        """Close the file without writing pending events, which the Pi's journal contains. Safe to repeat."""
        self._file.close()
