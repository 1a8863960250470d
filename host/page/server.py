"""The web server of the live view: one page, its data, and the wishes of who holds the token.

State is changed by POST only, with the token in a header: no link, form or image of another page can send that. Pages
of other sites cannot read anything here either: no cross-origin header is ever sent, and bound to loopback the server
answers to loopback's names only. `preview` runs it at low priority until Ctrl-C.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import logging
import os
import secrets
import socket
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from polysight.host.acquisition import Wish
from polysight.host.page.images import AMPLITUDE, PHASE, colour_bar
from polysight.host.page.watch import Watch
from polysight.shared.errors import DeviceError, PolysightError

STATIC = Path(__file__).parent / "static"
TOKEN_HEADER = "X-Polysight-Token"
_FILES = {"/": "index.html", "/preview.css": "preview.css", "/preview.js": "preview.js", "/plots.js": "plots.js",
          "/icon.svg": "icon.svg"}  # fmt: skip
_LOOK_S = 0.1
_ALIVE_S = 2.0  # a page that hears nothing for some of these tries to connect anew
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
NICE = 10  # of the server: everything else goes first
_END_S = 1  # to let go of the pages
_CONNECTIONS = 64


def make_app(watch: Watch, token: str, loopback: bool) -> Starlette:
    """The application. `state.ending()`, when its server sets it, says whether pages are to be let go.

    Parameters
    ----------
    watch
        What it shows.
    token
        Who may ask for something; empty: nobody.
    loopback
        Whether only loopback's own names are answered to.
    """

    async def page(request: Request) -> Response:
        return FileResponse(STATIC / _FILES[request.url.path], headers=_HEADERS)

    async def state(request: Request) -> Response:
        del request
        return Response(watch.state.data, media_type="application/json", headers=_HEADERS)

    async def picture(request: Request) -> Response:
        found = watch.shown.pictures.get(request.path_params["name"])
        if found is None:
            return Response("not there yet", 404, headers=_HEADERS)
        return Response(found.png, media_type="image/png", headers=_HEADERS)

    async def bar(request: Request) -> Response:
        kind = AMPLITUDE if request.path_params["kind"] == "amplitude" else PHASE
        return Response(colour_bar(kind), media_type="image/png", headers=_HEADERS)

    async def events(request: Request) -> Response:
        stream = _stream(watch, request.app.state.ending)
        return StreamingResponse(stream, media_type="text/event-stream", headers=_HEADERS)

    async def wish(request: Request) -> Response:
        given = request.headers.get(TOKEN_HEADER, "")
        if not token:
            return _refused(403, "This view is read-only", "start it with --control to have buttons")
        if not hmac.compare_digest(given.encode(), token.encode()):
            return _refused(403, "The token is wrong or missing", "open the address that `polysight preview` printed")
        try:
            await run_in_threadpool(watch.ask, Wish(request.path_params["wish"]))
        except ValueError:
            return _refused(404, "There is no such wish", f"one of {', '.join(Wish)}")
        except PolysightError as e:
            return JSONResponse({"what": e.what, "why": e.why, "do": e.remedy}, 409, headers=_HEADERS)
        return JSONResponse({"what": "asked"}, headers=_HEADERS)

    routes = [Route(path, page) for path in _FILES]
    routes += [
        Route("/api/state", state),
        Route("/api/events", events),
        Route("/api/picture/{name}", picture),
        Route("/api/bar/{kind}", bar),
        Route("/api/control/{wish}", wish, methods=["POST"]),
    ]
    names = ["localhost", "127.0.0.1"] if loopback else ["*"]
    app = Starlette(routes=routes, middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=names)])
    app.state.ending = lambda: False
    return app


def _refused(status: int, what: str, do: str) -> Response:
    return JSONResponse({"what": what, "why": "", "do": do}, status, headers=_HEADERS)


async def _stream(watch: Watch, ending: Callable[[], bool]) -> AsyncIterator[bytes]:
    """Server-sent events of one page: the newest state and motion, never an older one.

    Nothing is queued: who reads slowly is sent less often, and waits in `yield` for the socket to take more.
    """
    told = {"state": -1, "motion": -1}
    silent_s = 0.0
    while not ending():
        for kind, newest in (("state", watch.state), ("motion", watch.motion)):
            if newest.version != told[kind]:
                told[kind], silent_s = newest.version, 0.0
                yield b"event: %s\nid: %d\ndata: %s\n\n" % (kind.encode(), newest.version, newest.data)
        if silent_s >= _ALIVE_S:
            silent_s = 0.0
            yield b"event: alive\ndata: 0\n\n"
        await asyncio.sleep(_LOOK_S)
        silent_s += _LOOK_S


def preview(folder: Path, host: str, port: int, control: bool) -> int:
    """Serve the live view of a scan folder until Ctrl-C; returns the exit status.

    Raises
    ------
    DeviceError
        when the address cannot be bound.
    """
    listener = _bind(host, port)
    _step_back()
    token = secrets.token_urlsafe(18) if control else ""
    loopback = is_loopback(host)
    watch = Watch(folder, control)
    watch.start()
    try:
        sys.stderr.write(_welcome(folder, listener, token, loopback))
        sys.stderr.flush()
        server(make_app(watch, token, loopback)).run(sockets=[listener])
    finally:
        watch.close()
        listener.close()
    return 0


def server(app: Starlette) -> uvicorn.Server:
    """A quiet server of few connections, which ends within a second of being told to."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="none",
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_END_S,
    )
    made = uvicorn.Server(config)
    app.state.ending = lambda: made.should_exit
    return made


def is_loopback(host: str) -> bool:
    """Whether an address to bind reaches this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_CONNECTIONS)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{host}:{port} cannot be served: {e.strerror}",
            "another program holds this port, the address is not this machine's, or the port is below 1024",
            "give another --port; `ss -ltnp` shows who holds it",
        ) from None
    return listener


def _step_back() -> None:
    """Everything else goes first: the processor to capture and scan, and memory too, should it run out."""
    with contextlib.suppress(OSError):
        os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _welcome(folder: Path, listener: socket.socket, token: str, loopback: bool) -> str:
    host, port = str(listener.getsockname()[0]), listener.getsockname()[1]
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname(), "::1": "localhost"}.get(host, host)
    address = f"http://[{shown}]:{port}/" if ":" in shown else f"http://{shown}:{port}/"
    lines = [f"live view of {folder}: {address}{f'#token={token}' if token else ''}"]
    if token:
        lines.append("whoever has this address with its token can pause and stop the scan")
    else:
        lines.append("read-only; --control adds buttons to pause and stop the scan")
    if not loopback:
        lines.append("anyone who reaches this machine can look on; nothing is encrypted")
    return "\n".join(lines) + "\nCtrl-C ends the view; the scan goes on\n"
