"""The Pi's journalled events as received: msgpack maps one after another in `events.msgpack`, in order, without gaps.

Any msgpack reader can stream the file. Each map has a CRC-32, as each line of the manifest has. What a kill or power
cut has left behind the last whole event is cut off before appending; the Pi's journal has it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack

from polysight.host.store.append_only import AppendFile
from polysight.shared.errors import DataError, DeviceError, ProtocolError
from polysight.shared.messages import AnyEvent, pack_kept, unpack_kept

DAMAGED = ".damaged"  # suffix of the copy that is kept of a damaged file


@dataclass
class EventLog:
    """What an event file holds.

    Attributes
    ----------
    events
        The whole events from the beginning up to the first that is not.
    length
        Their bytes.
    torn
        Whether the beginning of an event, or zeros, or both follow: what a kill or power cut leaves.
    damage
        What else follows; empty when nothing does.
    """

    events: list[AnyEvent]
    length: int
    torn: bool = False
    damage: str = ""


def read_events(path: Path) -> EventLog:
    """Read an event file up to its first damage; an absent one is empty. Raises DataError if it cannot be read."""
    raw = _bytes_of(path)
    log = EventLog([], 0)
    try:
        for end in _ends(raw):
            log.events.append(unpack_kept(raw[log.length : end]))
            log.length = end
    except ProtocolError as e:
        log.damage = f"event {len(log.events) + 1} is damaged: {e.what}"
    except (ValueError, msgpack.UnpackException):
        log.damage = f"event {len(log.events) + 1} is damaged: not msgpack at byte {log.length}"
    tail = raw[log.length :]
    if log.damage and _is_beginning(tail.rstrip(b"\0")):
        log.damage = ""  # the file grew, and the power was cut before all its bytes were on the disk
    log.torn = bool(tail) and not log.damage
    return log


def _is_beginning(raw: bytes) -> bool:
    """True if this could be the beginning of an event, and no more."""
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
            f"{path}: cannot be read: {e.strerror}", "no permission, or the disk fails", f"check {path.parent}"
        ) from None


def _ends(raw: bytes) -> Iterator[int]:
    """Where each whole msgpack object ends."""
    unpacker = msgpack.Unpacker(raw=True, max_buffer_size=max(len(raw), 1))
    unpacker.feed(raw)
    while True:
        try:
            unpacker.skip()
        except msgpack.OutOfData:
            return
        yield unpacker.tell()


class EventWriter:
    """Appends events to a file; they are on the disk after :meth:`sync`.

    What follows the last whole event is cut off; a copy of the file as it was is kept beside it.

    Attributes
    ----------
    last_seq
        Sequence number of the newest event.

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
                copy.append(_bytes_of(path))
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
        """Take one event; :meth:`sync` writes it."""
        self._batch.append(pack_kept(event))
        self.last_seq = event.seq

    def sync(self) -> None:
        """Make everything durable. After a DeviceError nothing is lost: the next call tries again."""
        data = b"".join(self._batch)
        if data:
            self._file.append(data)
            self._crc = zlib.crc32(data, self._crc)
            self._batch.clear()

    def digest(self) -> dict[str, int | str]:
        """Length and CRC-32 of what is on the disk, for the manifest."""
        return {"bytes": self._file.length, "crc32": f"{self._crc:08x}"}

    def close(self) -> None:
        """Close the file; what :meth:`sync` has not written is left to the Pi's journal. Twice is once."""
        self._file.close()
