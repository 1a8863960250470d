"""Records everything on the given wires, in a thread: an unread socket would block the senders."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from polysight_shared.errors import DeviceError
from polysight_shared.wires import WireClient, WireEdge

LIMIT_S = 60.0


class WiresLog:
    def __init__(self, hub: Path, *lines: int) -> None:
        self._client = WireClient(hub, listen=lines)
        self.edges: list[WireEdge] = []
        self._closed = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while not self._closed:
            try:
                message = self._client.receive(0.1)
            except DeviceError:
                return
            if isinstance(message, WireEdge):
                self.edges.append(message)

    def rises(self, line: int) -> list[int]:
        return [e.t_ns for e in self.edges if e.line == line and e.value]

    def level(self, line: int) -> int:
        """The last one seen; 0 before the first."""
        return next((e.value for e in reversed(self.edges) if e.line == line), 0)

    def drive(self, *edges: WireEdge) -> None:
        self._client.send(*edges)

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < deadline, f"not seen on the wires; the last edges: {self.edges[-5:]}"
            time.sleep(0.005)

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._client.close()
