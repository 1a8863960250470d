"""Reading the files of a scan while another program writes them: what is new since the last look, and nothing twice.

Both files only grow, and their records say themselves whether they are whole, so nothing is locked. A file that has
become shorter, or another one, belongs to a new scan in the same place.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgpack

from polysight.host.store import manifest
from polysight.host.store.manifest import Fact
from polysight.shared.errors import ProtocolError
from polysight.shared.messages import AnyEvent, unpack_kept

_HEAD = 256


class GrowingFile:
    """The bytes behind those that were taken.

    Attributes
    ----------
    replaced
        Whether the last :meth:`look` found another file than the one before; it is then read from the beginning.
    modified_s
        When it was written last, seconds since 1970 by the file system; 0 before it was seen.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.replaced = False
        self.modified_s = 0.0
        self._position, self._head = 0, b""
        self._seen = (0, -1, -1)

    def look(self) -> bytes:
        """What follows the bytes taken so far; empty when nothing has changed, or the file cannot be read."""
        self.replaced = False
        try:
            with self.path.open("rb") as f:
                status = os.fstat(f.fileno())
                seen = (status.st_ino, status.st_size, status.st_mtime_ns)
                if seen == self._seen:
                    return b""
                self._seen, self.modified_s = seen, status.st_mtime
                # Another file may have the same number: a record's CRC at its beginning tells them apart.
                if status.st_size < self._position or f.read(len(self._head)) != self._head:
                    self.replaced, self._position = True, 0
                f.seek(0)
                self._head = f.read(min(self._position, _HEAD))
                f.seek(self._position)
                return f.read()
        except OSError:
            return b""

    def take(self, count: int) -> None:
        """So many of the bytes were whole records; the next look begins behind them."""
        self._position += count


class ManifestTail:
    """New facts of a manifest."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)

    def look(self) -> list[Fact]:
        """Facts that have come since the last look."""
        new = manifest.parse(self.file.look())
        self.file.take(new.length)
        return new.facts


class EventTail:
    """New events of an event log; it ends at the first damage, until `resume` has repaired the file."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)

    def look(self) -> list[AnyEvent]:
        """Events that have come since the last look."""
        raw = self.file.look()
        unpacker = msgpack.Unpacker(raw=True, max_buffer_size=max(len(raw), 1))
        unpacker.feed(raw)
        events: list[AnyEvent] = []
        end = 0
        try:
            while True:
                unpacker.skip()
                events.append(unpack_kept(raw[end : unpacker.tell()]))
                end = unpacker.tell()
        except (msgpack.OutOfData, msgpack.UnpackException, ValueError, ProtocolError):
            self.file.take(end)
        return events
