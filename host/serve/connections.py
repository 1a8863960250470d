"""Connections with limits: who is slow is let go, and who is slow in numbers makes room for who is not.

uvicorn waits for ever for a request's head, and counts who sends none among those that it serves: eighty half-open
connections would lock everybody out. Here a head has some seconds, an answer that nobody takes a minute, and of too
many connections the one that has waited longest without a request goes first.
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


class PatientProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 with deadlines."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._head: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._since = self.loop.time()

    @property
    def idle(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a head; when there are too many, let the oldest idle one go, or this one."""
        super().connection_made(transport)
        self._wait_for_head()
        if len(self.connections) > MOST:
            waiting = [c for c in self.connections if isinstance(c, PatientProtocol) and c.idle]
            min(waiting, key=lambda c: c._since).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes in."""
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
        """Nobody takes what is sent."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALLED_S, self.transport.abort)

    def resume_writing(self) -> None:
        """It is taken again."""
        super().resume_writing()
        self._cancel("_stalled")

    def connection_lost(self, exc: Exception | None) -> None:
        """The end."""
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
