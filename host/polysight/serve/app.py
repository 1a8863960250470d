"""The web application: static pages, GET and POST routes, error answers, behind the guard."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Awaitable, Callable
from pathlib import Path

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.routing import Route

from polysight.serve.control import control_routes
from polysight.serve.guard import Guard, refused
from polysight.serve.reading import reading_routes
from polysight.serve.site import Site
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError, PolysightError, os_error

_WRONG_REQUEST = (ErrorCode.VALUE_INVALID, ErrorCode.VALUES_CONFLICT, ErrorCode.TYPE_WRONG, ErrorCode.KEY_MISSING)
STATIC = Path(__file__).parent / "static"
PAGES = {
    "/": "catalogue.html",
    "/scan": "scan.html",
    "/watch": "watch.html",
    "/new": "new.html",
    "/compare": "compare.html",
}


def make_app(site: Site) -> Starlette:
    """Build the application of a site."""

    async def page(request: Request) -> Response:
        path, only = request.url.path, site.scans.only
        if path == "/" and only is not None:
            return RedirectResponse("/watch")  # a browser keeps the fragment, and the token in it
        if path in ("/scan", "/watch") and only is None and not request.query_params.get("scan"):
            return RedirectResponse("/")
        return FileResponse(STATIC / PAGES[path])

    files = {path.name for path in STATIC.iterdir() if path.suffix in (".js", ".css", ".svg")}
    routes = [Route(path, page) for path in PAGES]
    routes += [Route(f"/{name}", _static(name)) for name in sorted(files)]
    routes.append(Route("/favicon.ico", _static("icon.svg")))
    routes += reading_routes(site) + control_routes(site)
    return Starlette(
        routes=routes,
        middleware=[Middleware(Guard, access=site.access)],
        exception_handlers={
            PolysightError: _error,
            OSError: _os_error,
            ClientDisconnect: _gone,
            404: _not_found,
            Exception: _fault,
        },
    )


def _static(name: str) -> Callable[[Request], Awaitable[Response]]:
    async def file(request: Request) -> Response:
        del request
        return FileResponse(STATIC / name)

    return file


async def _error(request: Request, e: Exception) -> Response:
    if not isinstance(e, PolysightError):
        raise e
    status = 400 if isinstance(e, ConfigError) else 404 if isinstance(e, DataError) else 409
    if request.method == "POST" and e.code in _WRONG_REQUEST:
        status = 400
    silent = isinstance(e, DeviceError) and e.code is ErrorCode.NO_ANSWER
    return refused(503 if silent else status, e.code, e.what, e.why, e.remedy)


async def _os_error(request: Request, e: Exception) -> Response:
    """A file that cannot be written or read: not a defect of this program."""
    if not isinstance(e, OSError):
        raise e
    return await _error(request, os_error(e))


async def _gone(request: Request, e: Exception) -> Response:
    """The client hung up in the middle of its request: nobody reads this answer."""
    del request, e
    return Response(status_code=400)


async def _not_found(request: Request, e: Exception) -> Response:
    del request, e
    return refused(404, ErrorCode.OTHER, "There is no such page", "the address is wrong", "begin at the list of scans")


async def _fault(request: Request, e: Exception) -> Response:
    sys.stderr.write(f"{request.method} {request.url.path}\n{''.join(traceback.format_exception(e))}")
    sys.stderr.flush()
    what = f"An internal error of the server: {type(e).__name__}"
    return refused(
        500, ErrorCode.OTHER, what, "a defect of this program", "report it, with the server's terminal output"
    )
