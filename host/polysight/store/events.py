"""Event log of a scan: the Pi's journalled events as consecutive msgpack maps in `events.msgpack`, without gaps.

Any msgpack reader can stream the file. Each map has a CRC-32, as each line of the manifest has. A torn last event,
after a kill or power cut, is cut off before appending; the Pi's journal contains it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack

from polysight.store.append_only import AppendFile
from polysight.store.manifest import LogDigest
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError, ProtocolError
from polysight_shared.messages import AnyEvent, pack_with_crc, unpack_with_crc

DAMAGED = ".damaged"  # suffix of the file with the data that was cut off


@dataclass
class EventLog:
    """Content of an event file."""

    events: list[AnyEvent]  # up to the first that is torn or damaged
    length: int  # their bytes
    torn: bool = False  # the beginning of an event or zeros follow, as after a kill or power cut
    damage: str = ""  # description of anything else that follows


def read_events(path: Path) -> EventLog:
    """Read an event file up to its first damage; a missing file is empty. Raises DataError if it is unreadable."""
    raw = _bytes_of(path)
    log = EventLog([], 0)
    try:
        for end in _ends(raw):
            log.events.append(unpack_with_crc(raw[log.length : end]))
            log.length = end
    except ProtocolError as e:
        log.damage = f"event {len(log.events) + 1} is damaged: {e.what}"
    except (ValueError, msgpack.UnpackException):
        log.damage = f"event {len(log.events) + 1} is damaged: not msgpack at byte {log.length}"
    tail = raw[log.length :]
    if log.damage and _is_beginning(tail.rstrip(b"\0")):
        log.damage = ""  # the file had grown, but not all its bytes were on the disk at a power cut
    log.torn = bool(tail) and not log.damage
    return log


def _is_beginning(raw: bytes) -> bool:
    """True if this may be the incomplete beginning of an event."""
    try:
        return not any(True for _ in _ends(raw))
    except (ValueError, msgpack.UnpackException):
        return False


def _bytes_of(path: Path) -> bytes:
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


def _ends(raw: bytes) -> Iterator[int]:
    """Yield the end of each complete msgpack object."""
    unpacker = msgpack.Unpacker(raw=True, max_buffer_size=max(len(raw), 1))
    unpacker.feed(raw)
    while True:
        try:
            unpacker.skip()
        except msgpack.OutOfData:
            return
        yield unpacker.tell()


class EventWriter:
    """Appends events to a file; they are durable after :meth:`sync`. `last_seq` is the newest sequence number.

    Torn or damaged data behind the last complete event is moved to `events.msgpack.damaged`.

    Raises
    ------
    DataError, DeviceError
        if the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        log = read_events(path)
        if log.damage or log.torn:
            copy = AppendFile(path.with_name(path.name + DAMAGED), create=True)
            try:
                copy.append(_bytes_of(path)[log.length :])
            finally:
                copy.close()
        self._file = AppendFile(path, create=True)
        try:
            self._file.cut(log.length)
        except DeviceError:
            self._file.close()
            raise
        self._batch: list[bytes] = []
        self._crc = zlib.crc32(_bytes_of(path))
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
            self._crc = zlib.crc32(data, self._crc)
            self._batch.clear()

    def digest(self) -> LogDigest:
        """Length and CRC-32 of the file on disk, for the manifest."""
        return LogDigest(self._file.length, f"{self._crc:08x}")

    def close(self) -> None:
        """Close the file without writing pending events, which the Pi's journal contains. Safe to repeat."""
        self._file.close()
