"""GET requests below /api: lists, the live view, results, comparisons; nothing here changes a file.

Whatever touches a scan folder goes through `Site.read`: in a thread and with a time limit.
"""

from __future__ import annotations

import shutil
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from polysight.catalogue import (
    AMPLITUDE,
    DIFFERENCE,
    EXPORT,
    PHASE,
    Comparison,
    Picture,
    colour_bar,
    draw_comparison,
    draw_products,
    files_of,
    probe,
    read_notes,
    result_of,
    thumbnail,
)
from polysight.page import Watch
from polysight.products import REPORT, read_products
from polysight.serve.guard import refused
from polysight.serve.programs import program_of, programs_of
from polysight.serve.site import Site
from polysight_shared import __version__
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

_REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
"""For a report, which may come from anywhere: no script runs in it, and nothing is loaded."""
T = TypeVar("T")
Endpoint = Callable[[Site, Request], Awaitable[Response]]


def reading_routes(site: Site) -> list[Route]:
    """Routes of everything that GET answers."""
    endpoints: dict[str, Endpoint] = {
        "page": _page,
        "scans": _scans,
        "scan": _scan,
        "thumbnail": _thumbnail,
        "program/{kind}": _program,
        "state": _state,
        "events": _events,
        "picture/{name}": _live_picture,
        "bar/{kind}": _bar,
        "result": _result,
        "map/{name}": _map,
        "probe": _probe,
        "file/{name}": _file,
        "compare": _compare,
        "compare/{name}": _compare_map,
    }

    def route(path: str, answer: Endpoint) -> Route:
        async def endpoint(request: Request) -> Response:
            return await answer(site, request)

        return Route(f"/api/{path}", endpoint)

    return [route(path, answer) for path, answer in endpoints.items()]


# --- lists ---


async def _page(site: Site, request: Request) -> Response:
    access = site.access
    inside = not access.token or access.loopback or access.holds_session(request.scope)
    facts = {
        "version": __version__,
        "control": access.control,
        "starts": site.programs is not None and site.config is not None and access.control,
        "known": inside or access.holds_token(request.headers),
        "only": site.scans.only,
        "folder": str(site.scans.root) if inside else "",
    }
    return JSONResponse(facts)


async def _scans(site: Site, request: Request) -> Response:
    del request

    def listed() -> dict[str, Any]:
        root = site.scans.root
        rows = [asdict(s) | {"bytes": site.size(s.name)} for s in site.scans.list()]
        free = shutil.disk_usage(root).free if root.is_dir() else None
        left_out = site.scans.left_out()
        return {"scans": rows, "free_bytes": free, "libraries": list(site.libraries()), "left_out": left_out}

    return JSONResponse(await site.read("", listed))


async def _scan(site: Site, request: Request) -> Response:
    name = site.name(request)

    def summary(folder: Path) -> dict[str, Any]:
        notes = read_notes(folder)
        facts = asdict(site.scans.summary(name)) | {"bytes": site.size(name), "folder": str(folder.absolute())}
        programs = [program.to_dict() for program in programs_of(folder)]
        return facts | {"notes": notes.notes, "tags": list(notes.tags), "programs": programs}

    return JSONResponse(await site.read_scan(request, summary))


async def _thumbnail(site: Site, request: Request) -> Response:
    def png(folder: Path) -> bytes:
        try:
            return site.draw(folder, ("thumbnail",), thumbnail)
        except DataError:  # no image, or a damaged one: the scan's own page says so
            return b""

    found = await site.read_scan(request, png)
    if not found:
        return Response(status_code=204)
    return Response(found, media_type="image/png", headers={"Cache-Control": "private, max-age=5"})


async def _program(site: Site, request: Request) -> Response:
    kind = request.path_params["kind"]
    found = program_of(site.logs, kind) if kind in ("doctor", "train") else None
    return JSONResponse(None if found is None else found.to_dict())


# --- the live view ---


async def _watch(site: Site, request: Request) -> Watch:
    name = site.name(request)
    return await site.read_scan(request, lambda folder: site.watches.of(name, folder))


async def _state(site: Site, request: Request) -> Response:
    return Response((await _watch(site, request)).state.data, media_type="application/json")


async def _events(site: Site, request: Request) -> Response:
    if site.watches.full:
        return refused(503, ErrorCode.BUSY, "Too many pages are open", "each holds a connection", "close some of them")
    watch = await _watch(site, request)
    stream = site.watches.events(site.name(request), watch, site.ending)
    return StreamingResponse(stream, media_type="text/event-stream")


async def _live_picture(site: Site, request: Request) -> Response:
    found = (await _watch(site, request)).shown.pictures.get(request.path_params["name"])
    if found is None:
        what = "This picture is not there yet"
        return refused(404, ErrorCode.FILE_MISSING, what, "no row is processed", "it comes with the first row")
    return Response(found.png, media_type="image/png")


async def _bar(site: Site, request: Request) -> Response:
    del site
    kind = request.path_params["kind"]
    colours = {"phase": PHASE, "amplitude": AMPLITUDE}.get(kind, kind)
    if colours not in (AMPLITUDE, PHASE, DIFFERENCE):
        return refused(404, ErrorCode.VALUE_INVALID, "There are no such colours", "", "use the page")
    return Response(colour_bar(colours), media_type="image/png")


# --- results ---


async def _result(site: Site, request: Request) -> Response:
    return JSONResponse(await site.read_scan(request, result_of))


async def _map(site: Site, request: Request) -> Response:
    name = request.path_params["name"]
    given = [_number(request, key) for key in ("low", "high") if key in request.query_params]
    limits = (given[0], given[1]) if len(given) == 2 and given[0] < given[1] else None

    def drawn(folder: Path) -> Picture:
        return site.draw(folder, ("map", name, limits), lambda pixels: draw_products(pixels, name, limits))

    return _picture(await site.read_scan(request, drawn))


async def _probe(site: Site, request: Request) -> Response:
    x, y = (_number(request, key) for key in ("x", "y"))
    library = request.query_params.get("library", "")
    return JSONResponse(await site.read_scan(request, lambda f: probe(f, x, y, site.libraries().get(library))))


async def _file(site: Site, request: Request) -> Response:
    """One of the files that the result lists; nothing in it may act as a page of this server."""
    name, of = request.path_params["name"], request.query_params.get("of", "products")

    def find(folder: Path) -> tuple[Path, Path]:
        if not any(f["name"] == name and f["of"] == of for f in files_of(folder)):
            raise DataError(
                f"no file is called {name[:80]!r}", "it was not made, or the name is wrong", "see the scan's page",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        return folder, (folder / EXPORT if of == EXPORT else read_products(folder).folder) / name

    folder, path = await site.read_scan(request, find)
    if name == REPORT:
        return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})
    return FileResponse(path, media_type="application/octet-stream", filename=f"{folder.name}-{name}")


def _picture(drawn: Picture) -> Response:
    """A map, with the values at the ends of its colours as headers."""
    unit = "deg" if drawn.unit == "°" else drawn.unit
    ends = {"X-Low": f"{drawn.low:g}", "X-High": f"{drawn.high:g}", "X-Unit": unit}
    return Response(drawn.png, media_type="image/png", headers=ends)


def _number(request: Request, key: str) -> float:
    text = request.query_params.get(key, "")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e6:
        raise DataError(
            f"{key} = {text[:40]!r} is no number below a million", "the address is wrong", "use the page",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return value


# --- comparisons ---


async def _compared(site: Site, request: Request, use: Callable[[Comparison], T]) -> T:
    """`use` of the comparison of the two scans that a request names, in a thread."""
    names = [site.name(request, key) for key in ("a", "b")]
    both = " and ".join(name.partition("/")[0] for name in names)  # if one hangs, the other alone is still read
    return await site.read(both, lambda: use(site.compare(*map(site.scans.folder, names))))


async def _compare(site: Site, request: Request) -> Response:
    return JSONResponse(await _compared(site, request, Comparison.to_dict))


async def _compare_map(site: Site, request: Request) -> Response:
    name = request.path_params["name"]
    return _picture(await _compared(site, request, lambda found: draw_comparison(found, name)))
