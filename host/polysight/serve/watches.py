"""Open live views: one `Watch` per scan, kept while a page shows it, and their event streams."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import contextmanager
from pathlib import Path

from polysight.page import Watch
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError

STREAMS = 48
_MOST, _LINGER_S = 4, 30.0
_LOOK_S = 0.1
_ALIVE_S = 2.0  # a page that receives nothing for some of these reconnects


class Watches:
    """Opens a watch when a page asks for a scan, and closes it some time after the last page has disconnected.

    `control`: scans may be controlled; `kept`: watches that stay open, by name.
    """

    def __init__(self, control: bool, kept: dict[str, Watch] | None = None) -> None:
        self._control, self._kept = control, dict(kept or {})
        self._open: dict[str, tuple[Watch, float]] = {}
        self._streams: dict[str, int] = {}
        self._lock = threading.Lock()

    def of(self, name: str, folder: Path) -> Watch:
        """The watch of a scan. Raises DeviceError when too many are open."""
        watch = self._find(name)
        if watch is None:
            watch = Watch(folder, self._control)  # reads the folder: without the lock, for it may hang
            with self._lock:
                if name not in self._open:
                    watch.start()
                    self._open[name] = (watch, time.monotonic())
                watch = self._open[name][0]
        return watch

    def _find(self, name: str) -> Watch | None:
        """The open watch of a scan; None if there is none and room for one. Raises DeviceError."""
        with self._lock:
            if name in self._kept:
                return self._kept[name]
            self._sweep(name)
            if name in self._open:
                watch, _ = self._open[name]
                self._open[name] = (watch, time.monotonic())
                return watch
            if len(self._open) >= _MOST:
                raise DeviceError(
                    f"{_MOST} live views are open", "each takes a part of a processor", "close one", code=ErrorCode.BUSY
                )
        return None

    def _sweep(self, wanted: str) -> None:
        """Close watches without pages: after a while, or at once when there are too many."""
        now, full = time.monotonic(), len(self._open) >= _MOST
        for name, (watch, used) in list(self._open.items()):
            idle = not self._streams.get(name) and name != wanted
            if idle and (full or now - used > _LINGER_S):
                threading.Thread(target=watch.close, name="close", daemon=True).start()  # its folder may hang
                del self._open[name]

    @contextmanager
    def _stream(self, name: str):
        self._streams[name] = self._streams.get(name, 0) + 1
        try:
            yield
        finally:
            self._streams[name] -= 1
            with self._lock:
                if name in self._open:
                    self._open[name] = (self._open[name][0], time.monotonic())

    @property
    def full(self) -> bool:
        """True if no further event stream is allowed."""
        return sum(self._streams.values()) >= STREAMS

    async def events(self, name: str, watch: Watch, ending: Callable[[], bool]) -> AsyncIterator[bytes]:
        """Server-sent events of one page: always the newest state and motion.

        Nothing is queued: a slow page gets fewer events, since `yield` waits for its socket.
        """
        sent = {"state": -1, "motion": -1}
        silent_s = 0.0
        with self._stream(name):
            while not ending():
                for kind, newest in (("state", watch.state), ("motion", watch.motion)):
                    if newest.version != sent[kind]:
                        sent[kind], silent_s = newest.version, 0.0
                        yield b"event: %s\nid: %d\ndata: %s\n\n" % (kind.encode(), newest.version, newest.data)
                if silent_s >= _ALIVE_S:
                    silent_s = 0.0
                    yield b"event: alive\ndata: 0\n\n"
                await asyncio.sleep(_LOOK_S)
                silent_s += _LOOK_S

    def close(self) -> None:
        """Close all."""
        with self._lock:
            for watch, _ in self._open.values():
                watch.close()
            for watch in self._kept.values():
                watch.close()
            self._open, self._kept = {}, {}
