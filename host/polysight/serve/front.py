"""The process of the pages: access checks, static pages, running scans, and commands to them.

It reads no scan: all other requests are forwarded to the reading process (`Reader`), which has a low priority. A
command goes into the scan's control folder, in a thread of its own. If a process of its own accepts the connections
(`door.py`), it also answers commands, by the same route: nothing here can hold them up. The number of connections has
one limit (`ConnectionLimit`).
"""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import anyio
import h11
import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from polysight.acquisition import BADGES, LAPSE_S, STATES, ScanCommand, SignOfLife, send_command
from polysight.catalogue import Scans
from polysight.serve.commands import decode_body
from polysight.serve.guard import HANDLERS, Access, Guard, answer_no_page, cookie_name, refuse
from polysight.serve.stage import JogRequest, StageControl, StagePlace
from polysight_shared.errors import DataError, ErrorCode

STATIC = Path(__file__).parent / "static"
# Connections in the kernel's queue. A client that finds the queue full tries again after 1 s, and after 2 s more.
BACKLOG = 4096
# Name of a page's content and script, title, and style sheet.
PAGES = {
    "/": ("catalogue", "Scans · polysight", "catalogue"),
    "/scan": ("scan", "Scan · polysight", "scan"),
    "/watch": ("watch", "polysight", "watch"),
    "/new": ("new", "New scan · polysight", "new"),
    "/compare": ("compare", "Compare · polysight", "scan"),
    "/surface": ("surface", "Surfaces · polysight", "scan"),
    "/check": ("check", "Check plate · polysight", "scan"),
}
MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
# Longest time that a request waits for the reading process to start, or to start again; chosen.
READER_PATIENCE_S = 20.0
# Time between two attempts to connect to it; chosen.
CONNECT_INTERVAL_S = 0.1
# Bytes of an answer that are passed on at a time; chosen.
CHUNK_BYTES = 1 << 16
# Running scans are looked for at most this often, for any number of pages; chosen.
RUNNING_AGE_S = 0.5
# The header of every page shows a killed scan for this long (chosen); later, only the list of scans does.
KILLED_SHOWN_S = 3600.0
# Headers of an answer that are not passed on: they concern the connection to the reading process, or uvicorn adds its
# own.
OWN_HEADERS = (b"connection", b"keep-alive", b"transfer-encoding", b"date", b"server")
T = TypeVar("T")


class PageFacts(msgspec.Struct, frozen=True):
    """Facts that decide what a page shows.

    `control`: scans may be commanded. `starts`: programs can be started. `known`: the page's token is right, or not
    needed. `only`: name of the one scan that is served; None for a folder of scans. `badges`: words and colour of each
    state in lists. `states`: the words for a page whose server does not answer.
    """

    control: bool
    starts: bool
    known: bool
    only: str | None
    badges: dict[str, tuple[str, str]]
    states: dict[str, Any]


class RunningScan(msgspec.Struct, frozen=True):
    """A scan for the header of every page: `state` is `running`, `frozen` or `lost`, as lists have them.

    `doing` is its program's step, `asked` the command that it has not carried out yet ("": none).
    """

    name: str
    state: str
    doing: str
    asked: str


@dataclass(frozen=True)
class Front:
    """State of the process: `reader` answers what this one does not, `starts` is true if programs can be started.

    `stage` homes and jogs the stage; None: the page cannot move it.
    """

    scans: Scans
    access: Access
    starts: bool
    reader: ASGIApp
    stage: StageControl | None = None


def make_app(front: Front) -> Starlette:
    """Build the application: the guard, pages, control; the reading process for everything else."""
    routes = [*page_routes(front), *control_routes(front), command_route(front)]
    if front.stage is not None:
        routes += stage_routes(front.stage)
    routes.append(Route("/api/{path:path}", front.reader))
    return _guard_application(routes, front.access)


def make_command_app(front: Front) -> Starlette:
    """Build the application of the door, the process that accepts connections: commands to scans."""
    return _guard_application([command_route(front)], front.access)


def _guard_application(routes: list[Route], access: Access) -> Starlette:
    """Return the application of these routes behind the guard, with its answers for errors."""
    return Starlette(routes=routes, middleware=[Middleware(Guard, access=access)], exception_handlers=HANDLERS)


def page_routes(front: Front) -> list[Route]:
    """Return the routes of the static pages, and of what a page may show."""
    # They are small, and stay in memory.
    files = {
        path.name: Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix])
        for path in STATIC.iterdir()
        if path.suffix in MEDIA_TYPES
    }
    files["favicon.ico"] = files["icon.svg"]
    pages = {path: Response(frame_page(*parts), media_type="text/html") for path, parts in PAGES.items()}

    async def show_page(request: Request) -> Response:
        """Send a page, or the one to look at instead: the one scan's, or the list if no scan is named."""
        path = request.url.path
        only = front.scans.only
        if path == "/" and only is not None:
            # A browser keeps the fragment, and the token in it.
            return RedirectResponse("/watch")
        if path in ("/scan", "/surface", "/watch") and only is None and not request.query_params.get("scan"):
            return RedirectResponse("/")
        return pages[path]

    async def send_file(request: Request) -> Response:
        answer = files.get(request.path_params["name"])
        if answer is not None:
            return answer
        return await answer_no_page(request, DataError("no such file", "the address is wrong", "go to the first page"))

    async def describe_page(request: Request) -> Response:
        access = front.access
        may_read = not access.token or access.loopback or access.has_session(request.scope)
        states = {key: msgspec.to_builtins(STATES[key]) for key in ("offline", "server_frozen")}
        facts = PageFacts(
            control=access.control,
            starts=front.starts,
            known=may_read or access.has_token(request.headers),
            only=front.scans.only,
            badges=dict(BADGES),
            states=states,
        )
        return Response(msgspec.json.encode(facts), media_type="application/json")

    routes = [Route(path, show_page) for path in PAGES]
    return [*routes, Route("/{name}", send_file), Route("/api/page", describe_page)]


def frame_page(name: str, title: str, style: str) -> str:
    """Return a page's content in the frame of all pages."""
    frame = (STATIC / "frame.html").read_text(encoding="utf-8")
    content = (STATIC / f"{name}.html").read_text(encoding="utf-8")
    return frame.format(name=name, title=title, style=style, content=content)


def control_routes(front: Front) -> list[Route]:
    """Return the routes of the running scans, and of the session that a holder of the token opens."""
    running = RunningScans(front.scans)

    async def open_session(request: Request) -> Response:
        """Send the session's cookie; the guard has checked the token."""
        answer = JSONResponse({"what": "opened"})
        access = front.access
        cookie = cookie_name(request.scope)
        # A proxy may have ended the encryption.
        is_secure = access.secure or request.headers.get("origin", "").startswith("https:")
        answer.set_cookie(cookie, access.session, httponly=True, samesite="strict", secure=is_secure)
        return answer

    async def list_running(request: Request) -> Response:
        del request
        return Response(msgspec.json.encode(await run_in_own_thread(running.list)), media_type="application/json")

    return [Route("/api/running", list_running), Route("/api/session", open_session, methods=["POST"])]


def command_route(front: Front) -> Route:
    """Return the route of pause, stop, abort and the other commands to a running scan."""

    async def control(request: Request) -> Response:
        name = request.query_params.get("scan") or front.scans.only or ""
        command = request.path_params["command"]
        if command not in list(ScanCommand):
            commands = ", ".join(ScanCommand)
            problem = f"a scan cannot be asked to {command[:40]!r}"
            return refuse(400, ErrorCode.VALUE_INVALID, problem, "the name is wrong", f"one of {commands}")
        asker = "the page"
        if request.client is not None and not front.access.loopback:
            asker = f"the page at {request.client.host}"
        await run_in_own_thread(lambda: send_command(front.scans.folder(name), ScanCommand(command), asker))
        return JSONResponse(None)

    return Route("/api/control/{command}", control, methods=["POST"])


def stage_routes(stage: StageControl) -> list[Route]:
    """Return the routes of home and jog; all are POST, since even looking asks the Pi."""
    actions: dict[str, Callable[[bytes], StagePlace]] = {
        "look": lambda _: stage.read_position(),
        "home": lambda _: stage.home(),
        "stop": lambda _: stage.stop(),
        "jog": lambda body: stage.jog(decode_body(body, JogRequest)),
    }

    def make_route(name: str, action: Callable[[bytes], StagePlace]) -> Route:
        async def endpoint(request: Request) -> Response:
            body = await request.body()
            stage_place = await run_in_own_thread(lambda: action(body))
            return Response(msgspec.json.encode(stage_place), media_type="application/json")

        return Route(f"/api/stage/{name}", endpoint, methods=["POST"])

    return [make_route(name, action) for name, action in actions.items()]


async def run_in_own_thread(work: Callable[[], T]) -> T:
    """Run something that may have to wait for a drive, in a new thread."""
    # A limit for this call alone: threads of anyio's common limit may all hang in other requests.
    one_thread = anyio.CapacityLimiter(1)
    return await anyio.to_thread.run_sync(work, abandon_on_cancel=True, limiter=one_thread)


class RunningScans:
    """The scans that run under a folder, found by their control folders."""

    def __init__(self, scans: Scans) -> None:
        self._scans = scans
        self._listed_at = float("-inf")
        self._running: list[RunningScan] = []
        self._lock = threading.Lock()

    def list(self) -> Sequence[RunningScan]:
        """Return the running scans, and those whose program was killed within the last hour.

        The previous list is returned while it is fresh, and while another thread still reads the folder.
        """
        if time.monotonic() - self._listed_at < RUNNING_AGE_S or not self._lock.acquire(blocking=False):
            return self._running
        try:
            described = [self._describe(name, life) for name, life in self._scans.iterate_signs_of_life()]
            self._running = [scan for scan in described if scan is not None]
            self._listed_at = time.monotonic()
        finally:
            self._lock.release()
        return self._running

    def _describe(self, name: str, life: SignOfLife) -> RunningScan | None:
        """Return a scan for the header from its last sign of life; None if that is older than `KILLED_SHOWN_S`."""
        silent_s = time.time() - life.written_s
        if silent_s > KILLED_SHOWN_S:
            return None
        state = "running"
        if life.killed:
            state = "lost"
        elif silent_s > LAPSE_S:
            state = "frozen"
        return RunningScan(name, state, life.doing, life.asked)


# --- the reading process ---


class Reader:
    """Forwards requests to the reading process over a socket in the file system, each over a connection of its own."""

    def __init__(self, path: Path) -> None:
        self._path = path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward one request, and its answer until the browser has closed the connection."""
        # The guard has read the body already, and passes it on as one message.
        body = b""
        if scope["method"] == "POST":
            body = (await receive()).get("body", b"")
        async with anyio.create_task_group() as tasks:

            async def cancel_when_gone() -> None:
                while (await receive())["type"] != "http.disconnect":
                    pass
                tasks.cancel_scope.cancel()

            tasks.start_soon(cancel_when_gone)
            await self._relay(scope, receive, send, body)
            tasks.cancel_scope.cancel()

    async def _relay(self, scope: Scope, receive: Receive, send: Send, body: bytes) -> None:
        """Send a request to the reading process, and pass on its answer; 503 if it does not answer."""
        is_answered = False

        async def send_on(message: Message) -> None:
            nonlocal is_answered
            is_answered = True
            await send(message)

        try:
            reader, writer = await self._connect()
            try:
                connection = h11.Connection(h11.CLIENT)
                writer.write(_encode_request(connection, scope, body))
                await _relay_answer(connection, reader, send_on)
            finally:
                writer.close()
        except (OSError, h11.RemoteProtocolError):
            # The reading process ended during the request, and is started again. An incomplete answer is not repaired.
            if not is_answered:
                problem = "The reading part of the server does not answer"
                do = "load the page again; pause, stop and abort still work"
                answer = refuse(503, ErrorCode.NO_ANSWER, problem, "it is starting, or was ended", do)
                await answer(scope, receive, send)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect to the reading process, which may be starting. Raises OSError after `READER_PATIENCE_S`."""
        deadline = time.monotonic() + READER_PATIENCE_S
        while True:
            try:
                return await asyncio.open_unix_connection(str(self._path))
            except OSError:
                if time.monotonic() > deadline:
                    raise
            await asyncio.sleep(CONNECT_INTERVAL_S)


def _encode_request(connection: h11.Connection, scope: Scope, body: bytes) -> bytes:
    """Return a request as bytes for the reading process, without the headers of the browser."""
    target = scope["raw_path"]
    if scope["query_string"]:
        target += b"?" + scope["query_string"]
    headers = [("Host", "reader"), ("Connection", "close"), ("Content-Length", str(len(body)))]
    parts = (
        connection.send(h11.Request(method=scope["method"], target=target, headers=headers)),
        connection.send(h11.Data(data=body)),
        connection.send(h11.EndOfMessage()),
    )
    return b"".join(part or b"" for part in parts)


async def _relay_answer(connection: h11.Connection, reader: asyncio.StreamReader, send: Send) -> None:
    """Pass on the answer of the reading process. Raises OSError or h11.RemoteProtocolError if it breaks off."""
    while True:
        event = connection.next_event()
        if event is h11.NEED_DATA:
            connection.receive_data(await reader.read(CHUNK_BYTES))
        elif isinstance(event, h11.Response):
            headers = [(name, value) for name, value in event.headers if name not in OWN_HEADERS]
            await send({"type": "http.response.start", "status": event.status_code, "headers": headers})
        elif isinstance(event, h11.Data):
            await send({"type": "http.response.body", "body": bytes(event.data), "more_body": True})
        elif isinstance(event, h11.EndOfMessage):
            await send({"type": "http.response.body", "body": b"", "more_body": False})
            return


# --- connections ---


class ConnectionLimit:
    """The most connections at a time. When there are more, one without a request is closed: the longest silent one.

    Each step takes the same time for any number of them. Nothing is measured in seconds: a process that is busy must
    not take its own delay for a client's. A connection of which bytes wait to be read is not closed.
    """

    # Connections with unread bytes that are passed over for one that is closed; chosen.
    MAX_PASSED = 8

    def __init__(self, max_connections: int) -> None:
        self._most = max_connections
        self._open = 0
        # Those that have never sent a whole request are closed first.
        self._silent: OrderedDict[CountedConnection, None] = OrderedDict()
        self._idle: OrderedDict[CountedConnection, None] = OrderedDict()

    def add(self, connection: CountedConnection) -> None:
        """Note that a connection was opened; close another one if there are too many."""
        self._open += 1
        self._silent[connection] = None
        if self._open > self._most:
            self._close_one()

    def note_read(self, connection: CountedConnection) -> None:
        """Note that bytes of a connection were read."""
        if connection.is_working:
            self._forget(connection)
        elif connection in self._idle:
            self._idle.move_to_end(connection)
        else:
            self._silent[connection] = None
            self._silent.move_to_end(connection)

    def note_answered(self, connection: CountedConnection) -> None:
        """Note that a request was answered and no other one is being processed."""
        if not connection.is_working:
            self._idle[connection] = None

    def remove(self, connection: CountedConnection) -> None:
        """Note that a connection was closed."""
        self._open -= 1
        self._forget(connection)

    def _forget(self, connection: CountedConnection) -> None:
        """Take a connection out of those that may be closed."""
        self._silent.pop(connection, None)
        self._idle.pop(connection, None)

    def _close_one(self) -> None:
        """Close the first connection without unread bytes: one that never sent a request, else an idle one."""
        for group in (self._silent, self._idle):
            for _ in range(min(self.MAX_PASSED, len(group))):
                connection, _ = group.popitem(last=False)
                if not connection.has_unread_bytes():
                    connection.transport.close()
                    return
                group[connection] = None


class CountedConnection(H11Protocol):
    """A connection of uvicorn that reports to its limit what was read."""

    def __init__(self, *arguments: Any, limit: ConnectionLimit, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._limit = limit

    @property
    def is_working(self) -> bool:
        """True from a whole request to the end of its answer."""
        is_whole = self.conn.their_state not in (h11.IDLE, h11.SEND_BODY)
        return is_whole and self.cycle is not None and not self.cycle.response_complete

    def has_unread_bytes(self) -> bool:
        """True if bytes of the client lie in the kernel."""
        descriptor = self.transport.get_extra_info("socket").fileno()
        if descriptor < 0:
            return False
        # These modules exist on POSIX systems only; this file is imported on others, too.
        import fcntl
        import termios

        (count,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))
        return count > 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Add the new connection to those that the limit counts."""
        super().connection_made(transport)
        self._limit.add(self)

    def data_received(self, data: bytes) -> None:
        """Tell the limit that bytes of this connection were read."""
        super().data_received(data)
        if not self.transport.is_closing():
            self._limit.note_read(self)

    def on_response_complete(self) -> None:
        """Tell the limit that this connection waits for its next request."""
        super().on_response_complete()
        if not self.transport.is_closing():
            self._limit.note_answered(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the closed connection from those that the limit counts."""
        super().connection_lost(exc)
        self._limit.remove(self)


class EndingServer(uvicorn.Server):
    """A server whose connections end with it, even if clients still read or send, and wait in a queue of `BACKLOG`."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to accept connections from `sockets`."""
        await super().startup(sockets)
        # asyncio takes one number for the connections that it accepts in a round and for the kernel's queue.
        for listener in sockets or ():
            listener.listen(BACKLOG)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close connections as uvicorn does, and abort those that are open after its time for that."""
        await super().shutdown(sockets)
        for open_connection in list(self.server_state.connections):
            open_connection.transport.abort()
        # The loop closes an aborted socket in its next round.
        await asyncio.sleep(0)


def make_counting_protocol(max_connections: int) -> Any:
    """Make uvicorn's protocol class for connections that share a limit."""
    return partial(CountedConnection, limit=ConnectionLimit(max_connections))
