"""HTTP connections with timeouts and a limit on their number.

uvicorn has no timeout for the head of a request: eighty half-open connections would lock everybody out. Here the head
must arrive within `HEAD_S`, and the client must read its answer within `STALLED_S`. Above `MAX_CONNECTIONS` each new
connection closes an old one, in this order: unread answers, slow bodies, idle connections. Connections of open sessions
are closed last. Among equals the oldest is closed first.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

TRUSTED = "polysight.trusted"  # in the scope of a request with the token or a session

HEAD_S = 8.0
STALLED_S = 60.0
FRESH_S = 1.0  # a new connection is not closed within this time, unless there are `MAX_IN_BURSTS`
MAX_CONNECTIONS, MAX_IN_BURSTS = 256, 2048
HEAD_BYTES = 16384
_UNREAD, _SLOW_BODY, _IDLE, _FRESH, _ANSWERING = range(5)  # uses of a connection, the first to be closed first
KEEP_ALIVE_S = 5


class TimeoutProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 with timeouts."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._head: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._since = self.loop.time()
        self._trusted = False

    @property
    def idle(self) -> bool:
        """True if no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def _priority(self) -> tuple[bool, int, float]:
        """Sort key: of too many connections the one with the lowest priority is closed."""
        if self._stalled is not None:
            use = _UNREAD
        elif self.idle:
            use = _FRESH if self.loop.time() - self._since < FRESH_S else _IDLE
        else:
            use = _SLOW_BODY if self.cycle.more_body else _ANSWERING
        return self._trusted, use, self._since

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timeout of the head; of too many connections, close one."""
        super().connection_made(transport)
        self._wait_for_head()
        if len(self.connections) > MAX_CONNECTIONS:
            self._make_room()

    def _make_room(self) -> None:
        """Close the connection with the lowest priority, unless all without a session are fresh or being answered."""
        left = [c for c in self.connections if isinstance(c, TimeoutProtocol) and not c.transport.is_closing()]
        if len(left) <= MAX_CONNECTIONS:
            return
        lowest = min(left, key=lambda c: c._priority)
        if lowest._priority[1] < _FRESH or len(left) > MAX_IN_BURSTS:
            lowest.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Receive bytes."""
        super().data_received(data)
        if not self.idle:
            self._cancel("_head")
        elif self._head is None and self.timeout_keep_alive_task is None:
            self._wait_for_head()  # of a further request on this connection

    def on_response_complete(self) -> None:
        """Wait for a further request."""
        self._trusted |= bool(self.scope.get(TRUSTED))
        super().on_response_complete()

    def pause_writing(self) -> None:
        """Start the timeout of an answer that is not taken."""
        super().pause_writing()
        self._cancel("_stalled")
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
