"""The process that accepts connections: it answers commands to scans itself, and hands on everything else.

It looks at the first bytes of each connection. One that brings a command with the right token is answered here; every
other one is handed to the process of the pages (`front`) as an open socket. Each connection carries one request, so
that a command is always the first thing on its own.

With TLS the process cannot see the content of a connection: `front` accepts by itself then, and answers commands, too.
"""

from __future__ import annotations

import asyncio
import hmac
import multiprocessing
import signal
import socket
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import uvicorn
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from polysight.serve.front import EndingServer
from polysight.serve.guard import HEAD_BYTES, TOKEN_HEADER
from polysight_shared.program import delay_interrupts, ignore_interrupts

# First bytes of a command to a scan.
COMMAND_START = b"POST /api/control/"
TOKEN_LINE = TOKEN_HEADER.lower().encode()
# Connections that are accepted, or taken over, before other work of the process is done; chosen.
ACCEPTED_AT_ONCE = 64
# Connections that have not sent anything (chosen). With one more, the one that is silent for longest is closed.
MOST_SILENT = 1024
# Connections that the pages' process has not taken yet (chosen). With one more, the oldest is answered `BUSY_ANSWER`.
MOST_WAITING = 512
BUSY_ANSWER = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class Door:
    """Accepts connections from `listener`; `serve` answers a command, `pages` takes the other ones."""

    def __init__(
        self, listener: socket.socket, pages: socket.socket, token: str, serve: Callable[[socket.socket], None]
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._listener = listener
        self._pages = pages
        self._token = token.encode()
        self._serve = serve
        # The one that is silent for longest comes first.
        self._silent: OrderedDict[socket.socket, None] = OrderedDict()
        self._waiting: deque[socket.socket] = deque()
        self.ended = asyncio.Event()
        listener.setblocking(False)
        pages.setblocking(False)
        self._loop.add_reader(listener, self._accept)
        # It never sends anything: readable means that it has ended.
        self._loop.add_reader(pages, self.ended.set)

    def _accept(self) -> None:
        """Accept waiting connections, and look at the first bytes of each."""
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                client, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError:
                # There is no free descriptor for another connection, or the client has closed it already.
                self._drop_silent()
                return
            client.setblocking(False)
            if not self._look(client):
                self._silent[client] = None
                self._loop.add_reader(client, self._handle_silent, client)
                if len(self._silent) > MOST_SILENT:
                    self._drop_silent()

    def _handle_silent(self, client: socket.socket) -> None:
        """Handle a silent connection by what it has sent; close it if that is still nothing."""
        del self._silent[client]
        self._loop.remove_reader(client)
        if not self._look(client):
            client.close()

    def _drop_silent(self) -> None:
        """Close the connection that is silent for longest, unless its first bytes have come meanwhile."""
        if self._silent:
            self._handle_silent(next(iter(self._silent)))

    def _look(self, client: socket.socket) -> bool:
        """Give a connection to the process that answers it; False if nothing can be read from it yet."""
        try:
            head = client.recv(HEAD_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            head = b""
        if not head:
            client.close()
        elif is_command(head, self._token):
            self._serve(client)
        else:
            self._waiting.append(client)
            self._pass_connections()
        return True

    def _pass_connections(self) -> None:
        """Hand connections to the pages' process, as many as it can take."""
        try:
            while self._waiting:
                # A descriptor travels with at least one byte; which one does not matter.
                socket.send_fds(self._pages, [b"c"], [self._waiting[0].fileno()])
                self._waiting.popleft().close()
            self._loop.remove_writer(self._pages)
        except BlockingIOError:
            self._loop.add_writer(self._pages, self._pass_connections)
        except OSError:
            self.ended.set()
        if len(self._waiting) > MOST_WAITING:
            _refuse(self._waiting.popleft())


def is_command(head: bytes, token: bytes) -> bool:
    """True if these first bytes are the whole head of a command to a scan, with the right token."""
    if not head.startswith(COMMAND_START) or b"\r\n\r\n" not in head:
        return False
    lines, _, _ = head.partition(b"\r\n\r\n")
    for line in lines.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.lower() == TOKEN_LINE:
            return hmac.compare_digest(value.strip(), token)
    return False


def _refuse(client: socket.socket) -> None:
    """Answer that the server is busy; the request is read, so that the client gets the answer and no reset."""
    with suppress(OSError):
        client.recv(HEAD_BYTES)
        client.send(BUSY_ANSWER)
    client.close()


def close_after_each(app: ASGIApp) -> ASGIApp:
    """Return the application such that it serves one request per connection."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_on(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Connection"] = "close"
            await send(message)

        await app(scope, receive, send_on)

    return answer


async def _keep_door(listener: socket.socket, pages: socket.socket, token: str, config: uvicorn.Config) -> None:
    """Run the door until the pages' process has ended; `config` is that of the commands' application."""
    config.load()
    make_protocol = partial(H11Protocol, config=config, server_state=ServerState(), app_state={})
    loop = asyncio.get_running_loop()
    # The loop itself keeps no reference to a task, which could be collected before it ends.
    beginning: set[asyncio.Task[Any]] = set()

    def serve(client: socket.socket) -> None:
        task = loop.create_task(loop.connect_accepted_socket(make_protocol, client))
        beginning.add(task)
        task.add_done_callback(beginning.discard)

    await Door(listener, pages, token, serve).ended.wait()


@contextmanager
def open_door(listener: socket.socket, token: str, config: uvicorn.Config) -> Iterator[socket.socket]:
    """Run the door in a process of its own for the block; `config` answers commands. Yields the pages' end.

    To be called before there are threads: the process is forked.
    """
    door_end, pages_end = socket.socketpair()

    def run() -> None:
        # Ctrl-C and a service manager's end reach the whole group; the door ends when the pages' end is closed.
        ignore_interrupts(signal.SIGINT, signal.SIGTERM)
        pages_end.close()
        asyncio.run(_keep_door(listener, door_end, token, config))

    process = multiprocessing.get_context("fork").Process(target=run, name="door", daemon=True)
    pages_end.setblocking(False)
    try:
        with delay_interrupts():
            process.start()
        door_end.close()
        yield pages_end
    finally:
        door_end.close()
        pages_end.close()
        if process.pid is not None:
            process.join()


class PagesServer(EndingServer):
    """The server of the pages, which ends when the door has ended.

    Its connections come over the socket `door`; each gets a new object of the class `protocol`.
    """

    def __init__(self, config: uvicorn.Config, door: socket.socket, protocol: Any) -> None:
        super().__init__(config)
        self._door = door
        self._protocol = protocol
        self._beginning: set[asyncio.Task[Any]] = set()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to take connections."""
        del sockets
        await super().startup([])
        asyncio.get_running_loop().add_reader(self._door, self._take)

    def _take(self) -> None:
        """Take connections that the door has sent; end when the door has ended."""
        loop = asyncio.get_running_loop()
        make_protocol = partial(
            self._protocol, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                message, descriptors, _, _ = socket.recv_fds(self._door, 1, 1)
            except BlockingIOError:
                return
            if not message:
                loop.remove_reader(self._door)
                self.should_exit = True
                return
            client = socket.socket(fileno=descriptors[0])
            client.setblocking(False)
            task = loop.create_task(loop.connect_accepted_socket(make_protocol, client))
            self._beginning.add(task)
            task.add_done_callback(self._beginning.discard)
