"""HTTP connections with timeouts and a limit on their number.

uvicorn has no timeout for a request's head: eighty half-open connections would lock everybody out. Here the head must
come within `HEAD_S`, an answer must be taken within `STALLED_S`, and above `MOST` connections one is closed: before
those of open sessions the others, and of them answers that are not taken before slow bodies, and these before idle
ones; the oldest connection first.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

TRUSTED = "polysight.trusted"  # in the scope of a request with the token or a session

HEAD_S = 8.0
STALLED_S = 60.0
FRESH_S = 1.0  # in which a new connection is not closed for others
MOST, MOST_IN_BURSTS = 256, 2048
HEAD_BYTES = 16384
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
    def _worth(self) -> tuple[bool, int, float]:
        """Order in which connections are closed when there are too many."""
        if self._stalled is not None:
            use = 0
        elif self.idle:
            use = 3 if self.loop.time() - self._since < FRESH_S else 2
        else:
            use = 1 if self.cycle.more_body else 4
        return self._trusted, use, self._since

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timeout of the head; of too many connections, close one."""
        super().connection_made(transport)
        self._wait_for_head()
        open_ones = [c for c in self.connections if isinstance(c, TimeoutProtocol) and not c.transport.is_closing()]
        if len(open_ones) > MOST:
            least = min(open_ones, key=lambda c: c._worth)
            if least._worth[1] < 3 or len(open_ones) > MOST_IN_BURSTS:
                least.transport.abort()

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
