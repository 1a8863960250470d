"""HTTP connections with timeouts and a limit on their number.

uvicorn has no timeout for a request's head: eighty half-open connections would lock everybody out. Here the head must
come within `HEAD_S`, an answer must be taken within `STALLED_S`, and above `MOST` connections the one that has been
idle for longest is closed.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 8.0
STALLED_S = 60.0
MOST = 192
HEAD_BYTES = 16384
KEEP_ALIVE_S = 5


class TimeoutProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 with timeouts."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._head: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._since = self.loop.time()

    @property
    def idle(self) -> bool:
        """True if no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timeout of the head; of too many connections, close the one idle for longest."""
        super().connection_made(transport)
        self._wait_for_head()
        if len(self.connections) > MOST:
            waiting = [c for c in self.connections if isinstance(c, TimeoutProtocol) and c.idle]
            min(waiting, key=lambda c: c._since).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Receive bytes."""
        super().data_received(data)
        if not self.idle:
            self._cancel("_head")
        elif self._head is None and self.timeout_keep_alive_task is None:
            self._wait_for_head()  # of a further request on this connection

    def on_response_complete(self) -> None:
        """Wait for a further request."""
        self._since = self.loop.time()
        super().on_response_complete()

    def pause_writing(self) -> None:
        """Start the timeout of an answer that is not taken."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALLED_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop it."""
        super().resume_writing()
        self._cancel("_stalled")

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop all timeouts."""
        self._cancel("_head")
        super().connection_lost(exc)
        self._cancel("_stalled")

    def _wait_for_head(self) -> None:
        self._head = self.loop.call_later(HEAD_S, self._too_slow)

    def _too_slow(self) -> None:
        self._head = None
        if self.idle:
            self.transport.abort()

    def _cancel(self, name: str) -> None:
        handle: asyncio.TimerHandle | None = getattr(self, name)
        if handle is not None:
            handle.cancel()
            setattr(self, name, None)
