"""Follow one scan in a thread, and keep the newest snapshot of it for all pages.

Manifest, event log and products are read as they change (`ManifestTail`, `EventTail`, `ProductsTail`). A snapshot is
serialised once, so that a page costs only its transmission, and all pages see the same.
"""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgpack

from polysight.acquisition import ScanCommand, last_alive_s, send_command
from polysight.page.history import ScanHistory
from polysight.page.images import RowViewer, Shown
from polysight.page.listener import PiListener, PiState
from polysight.page.snapshot import Content, make_motion, make_snapshot
from polysight.page.status import LifeSigns
from polysight.products import MATERIALS, QUALITY, find_products
from polysight.results import Verdict
from polysight.store import (
    EVENTS,
    MANIFEST,
    Fact,
    Manifest,
    OtherFact,
    ScanContinued,
    ScanEnded,
    ScanPaused,
    ScanResumed,
    ScanStarted,
)
from polysight_shared.errors import PolysightError, ProtocolError
from polysight_shared.messages import AnyEvent, unpack_with_crc

_HEAD = 256
_TURN_S = 0.2
_LAPSE_S = 15.0  # the scan program touches its file once a second
_GRACE_S = 6.0  # from a manifest's first line to the first sign of life
_PI_LIMIT_S = 6.0  # timeout of the Pi's heartbeat
_UNATTENDED_ROWS = 3.0  # a scan without signs of life lives while rows come, and for so many rows' time


class GrowingFile:
    """Bytes that were appended to a file since the last read.

    Attributes
    ----------
    replaced
        True if the last :meth:`look` found another file; it is then read from the beginning.
    modified_s
        Time of the last change by the file system, seconds since 1970; 0 before the file exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.replaced = False
        self.modified_s = 0.0
        self._position, self._head = 0, b""
        self._seen = (0, -1, -1)

    def look(self) -> bytes:
        """Bytes after those taken so far; empty if nothing has changed or the file cannot be read."""
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
                self._head = f.read(_HEAD)
                f.seek(self._position)
                return f.read()
        except OSError:
            return b""

    def take(self, count: int) -> None:
        """Mark so many bytes as read: those of whole records."""
        self._position += count


class ManifestTail:
    """A manifest that grows; `content` has what was read so far."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)
        self.content = Manifest()

    def look(self) -> list[Fact]:
        """Facts since the last look."""
        raw = self.file.look()
        if self.file.replaced:
            self.content = Manifest()
        before = self.content.length
        facts = self.content.feed(raw)
        self.file.take(self.content.length - before)
        return facts


class EventTail:
    """Events appended to an event log, up to the first damage, which `resume` repairs."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)

    def look(self) -> list[AnyEvent]:
        """Events since the last look."""
        raw = self.file.look()
        unpacker = msgpack.Unpacker(raw=True, max_buffer_size=max(len(raw), 1))
        unpacker.feed(raw)
        events: list[AnyEvent] = []
        end = 0
        try:
            while True:
                unpacker.skip()
                events.append(unpack_with_crc(raw[end : unpacker.tell()]))
                end = unpacker.tell()
        except (msgpack.OutOfData, msgpack.UnpackException, ValueError, ProtocolError):
            self.file.take(end)
        return events


class ProductsTail:
    """The verdict of the products of a scan folder, read again when they change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: tuple[tuple[int, int], ...] | None = None
        self._verdict: Verdict | None = None

    def look(self) -> Verdict | None:
        """The verdict; None if not processed yet, by an earlier release, or if the products cannot be read."""
        found = find_products(self._folder, QUALITY)
        seen = () if found is None else tuple(_state(found.folder / name) for name in (MATERIALS, QUALITY))
        if seen != self._seen:
            self._seen, self._verdict = seen, None
            with suppress(PolysightError):  # they are being replaced, or damaged
                self._verdict = None if found is None else found.verdict
        return self._verdict


def _state(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_size


class Versioned(NamedTuple):
    """Published JSON with its version number."""

    version: int
    data: bytes


class Watch:
    """Follows a scan folder, which may not exist yet, in a thread of its own; only :meth:`ask` writes into it.

    `lapse_s` is the timeout of the scan program's signs of life.
    """

    def __init__(self, folder: Path, control: bool = False, lapse_s: float = _LAPSE_S) -> None:
        self.folder, self.control = folder, control
        self._lapse_s = lapse_s
        self._ended = threading.Event()
        self._asked: tuple[ScanCommand, int] | None = None  # and how many facts there were
        self._looked = False
        self.state, self.motion = Versioned(0, b"{}"), Versioned(0, b"{}")
        self.shown = Shown()
        self._begin()
        self._turn()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _begin(self) -> None:
        """Reset all state: another scan may be in the folder now."""
        self._manifest, self._events = ManifestTail(self.folder / MANIFEST), EventTail(self.folder / EVENTS)
        self._result = ProductsTail(self.folder)
        self._history: ScanHistory | None = None
        self._viewer: RowViewer | None = None
        self._listener: PiListener | None = None
        self._problem = ""
        self._life_seen: float | None = None
        self._life_at = self._grown_at = float("-inf")

    def _run(self) -> None:
        while not self._ended.wait(_TURN_S):
            try:
                self._turn()
            except Exception as e:  # noqa: BLE001  a view that has failed must not show "All is well"
                self._problem = f"the live view fails: {type(e).__name__}: {e}"
                nothing = Content(
                    self.folder, None, self._signs(PiState()), PiState(), Shown(), None, False, self._problem
                )
                self.state = _publish(self.state, make_snapshot(nothing))

    def _turn(self) -> None:
        """Read everything once, and publish what has changed."""
        self._read()
        self._attend()
        self.shown = self._viewer.shown if self._viewer is not None else Shown()
        heard = self._listener.heard if self._listener is not None else PiState()
        content = Content(
            self.folder, self._history, self._signs(heard), heard, self.shown, self._pending(), self.control,
            self._problem, self._result.look(),
        )  # fmt: skip
        self.state = _publish(self.state, make_snapshot(content))
        self.motion = _publish(self.motion, make_motion(content))

    def _read(self) -> None:
        """Read what was appended to the files."""
        facts = self._manifest.look()
        if self._manifest.file.replaced:
            self._close_parts()
            self._begin()
            facts = self._manifest.look()
        if facts and self._looked:  # at the first look nothing is known to be new
            self._grown_at = time.monotonic()
        self._looked = True
        for fact in facts:
            try:
                if self._history is None and isinstance(fact, ScanStarted):
                    self._history = ScanHistory(fact)
                elif isinstance(fact, OtherFact) and fact.problem:
                    self._problem = f"{self.folder / MANIFEST}: unreadable {fact.kind}: {fact.problem}"
                elif self._history is not None:
                    self._history.add_fact(fact)
            except (PolysightError, ValueError) as e:
                self._problem = f"{self.folder / MANIFEST}: unreadable {type(fact).__name__}: {e}"
        if self._history is not None:
            self._history.add_events(self._events.look())

    def _attend(self) -> None:
        """Start and stop the row viewer and the listener as needed."""
        history = self._history
        if history is None:
            return
        if self._viewer is None:
            self._viewer = RowViewer(self.folder, self._manifest.content)
            self._viewer.start()
        self._viewer.want(history.takes)
        if history.ended is None and self._listener is None:
            self._listener = PiListener(history.instrument, history.scan_id)
        elif history.ended is not None and self._listener is not None:
            self._listener.close()
            self._listener = None

    def _signs(self, heard: PiState) -> LifeSigns:
        """Signs of life of the scan program and the Pi."""
        now, wall = time.monotonic(), time.time()
        life = last_alive_s(self.folder)
        if life is not None and life != self._life_seen:
            age = max(0.0, wall - life) if self._life_seen is None else 0.0  # from then on changes count, not clocks
            self._life_seen, self._life_at = life, now - age
        known = None if self._history is None else self._history.row_seconds
        patience = _GRACE_S if known is None else max(_GRACE_S, _UNATTENDED_ROWS * known[0])
        alive = now - self._grown_at < patience if life is None else now - self._life_at < self._lapse_s
        alive_s = 0 if alive else round(life or self._manifest.file.modified_s)
        silent = now - heard.heard_s if heard.heard_s else None
        return LifeSigns(alive, alive_s, silent, _PI_LIMIT_S, wall)

    def _pending(self) -> ScanCommand | None:
        """The pending request, until the manifest shows that it was carried out."""
        if self._asked is None or self._history is None:
            return None
        command, facts = self._asked
        since = self._manifest.content.facts[facts:]
        if any(isinstance(fact, ScanEnded | ScanResumed | ScanPaused | ScanContinued) for fact in since):
            self._asked = None
            return None
        return command

    def ask(self, command: ScanCommand) -> None:
        """Ask the scan to pause, continue, stop or abort; returns when it has taken the request. Raises ScanError."""
        before = len(self._manifest.content.facts)
        send_command(self.folder, command)
        paused = self._history is not None and self._history.paused
        self._asked = None if command is ScanCommand.CONTINUE and not paused else (command, before)

    def _close_parts(self) -> None:
        for part in (self._viewer, self._listener):
            if part is not None:
                part.close()

    def close(self) -> None:
        """Stop all threads."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self._close_parts()


def _publish(before: Versioned, content: dict[str, Any]) -> Versioned:
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return before if data == before.data else Versioned(before.version + 1, data)
