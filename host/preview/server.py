"""The web server of the live view: one page, its data, and the wishes of who holds the token.

State is changed by POST only, with the token in a header: no link, form or image of another page can send that. Pages
of other sites cannot read anything here either: no cross-origin header is ever sent, and bound to loopback the server
answers to loopback's names only.
"""

from __future__ import annotations

import asyncio
import hmac
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from polysight.host.acquisition.control import Wish
from polysight.host.preview.pictures import AMPLITUDE, PHASE, colour_bar
from polysight.host.preview.watch import Watch
from polysight.shared.errors import PolysightError

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
