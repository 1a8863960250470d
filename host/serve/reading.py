"""What can be looked at: answers that change nothing."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from polysight.host.catalogue import (
    AMPLITUDE,
    DIFFERENCE,
    EXPORT,
    PHASE,
    Comparison,
    Picture,
    colour_bar,
    compare,
    draw_comparison,
    draw_products,
    files_of,
    probe,
    read_notes,
    result_of,
    thumbnail,
)
from polysight.host.products import read_products
from polysight.host.serve.guard import refused
from polysight.host.serve.programs import program_of, programs_of
from polysight.host.serve.site import Site
from polysight.shared import __version__
from polysight.shared.errors import DataError

_DOWNLOADS = "application/octet-stream"
_REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
"""Of a report, which may come from anywhere: no script runs in it, and nothing is loaded."""


def reading_routes(site: Site) -> list[Route]:
    """Everything that GET answers, below /api."""
    return [*_lists(site), *_live(site), *_results(site), *_comparisons(site)]


def _lists(site: Site) -> list[Route]:
    async def page(request: Request) -> Response:
        access = site.access
        inside = not access.token or access.loopback or access.holds_session(request.headers, request.url.port or 80)
        told = {
            "version": __version__,
            "control": access.control,
            "starts": site.programs is not None and site.config is not None and access.control,
            "known": inside or access.holds_token(request.headers),
            "only": site.scans.only,
            "folder": str(site.scans.root) if inside else "",
        }
        return JSONResponse(told)

    async def scans(request: Request) -> Response:
        del request
        found = await site.compute(site.scans.list)
        rows = [asdict(s) | {"bytes": site.size(s.name)} for s in found]
        left_out = await site.compute(site.scans.left_out)
        free = shutil.disk_usage(site.scans.root).free if site.scans.root.is_dir() else None
        return JSONResponse(
            {"scans": rows, "free_bytes": free, "libraries": list(site.libraries()), "left_out": left_out}
        )

    async def scan(request: Request) -> Response:
        name = site.name(request)
        folder = site.scans.folder(name)
        summary = await site.compute(site.scans.summary, name)
        told = asdict(summary) | {"bytes": site.size(name), "folder": str(folder.absolute())}
        notes = read_notes(folder)
        return JSONResponse(
            told
            | {"notes": notes.notes, "tags": list(notes.tags), "programs": [p.to_dict() for p in programs_of(folder)]}
        )

    async def small(request: Request) -> Response:
        folder = site.scans.folder(site.name(request))
        try:
            png = await site.compute(site.drawn, folder, ("thumbnail",), thumbnail)
        except DataError:  # no image, or a damaged one, of which the scan's own page tells
            return Response(status_code=204)
        return Response(png, media_type="image/png", headers={"Cache-Control": "private, max-age=5"})

    async def program(request: Request) -> Response:
        kind = request.path_params["kind"]
        found = program_of(site.logs, kind) if kind in ("doctor", "train") else None
        return JSONResponse(None if found is None else found.to_dict())

    return [
        Route("/api/page", page),
        Route("/api/scans", scans),
        Route("/api/scan", scan),
        Route("/api/thumbnail", small),
        Route("/api/program/{kind}", program),
    ]


def _live(site: Site) -> list[Route]:
    async def state(request: Request) -> Response:
        watch = await _watch(site, request)
        return Response(watch.state.data, media_type="application/json")

    async def events(request: Request) -> Response:
        if site.watches.full:
            return refused(503, "Too many pages look on", "close some of them")
        watch = await _watch(site, request)
        stream = site.watches.events(site.name(request), watch, site.ending)
        return StreamingResponse(stream, media_type="text/event-stream")

    async def picture(request: Request) -> Response:
        watch = await _watch(site, request)
        found = watch.shown.pictures.get(request.path_params["name"])
        if found is None:
            return refused(404, "This picture is not there yet", "it comes with the first row")
        return Response(found.png, media_type="image/png")

    async def bar(request: Request) -> Response:
        kind = {"phase": PHASE, "amplitude": AMPLITUDE}.get(asked := request.path_params["kind"], asked)
        if kind not in (AMPLITUDE, PHASE, DIFFERENCE):
            return refused(404, "There are no such colours", "see the page")
        return Response(await site.compute(colour_bar, kind), media_type="image/png")

    return [
        Route("/api/state", state),
        Route("/api/events", events),
        Route("/api/picture/{name}", picture),
        Route("/api/bar/{kind}", bar),
    ]


async def _watch(site: Site, request: Request) -> Any:
    name = site.name(request)
    return await site.act(site.watches.of, name, site.scans.folder(name))


def _results(site: Site) -> list[Route]:
    async def result(request: Request) -> Response:
        return JSONResponse(await site.compute(result_of, site.scans.folder(site.name(request))))

    async def map_of(request: Request) -> Response:
        folder, name = site.scans.folder(site.name(request)), request.path_params["name"]
        given = [_number(request, key) for key in ("low", "high") if key in request.query_params]
        limits = (given[0], given[1]) if len(given) == 2 and given[0] < given[1] else None
        drawn = await site.compute(site.drawn, folder, ("map", name, limits), lambda p: draw_products(p, name, limits))
        return _picture(drawn)

    async def place(request: Request) -> Response:
        folder = site.scans.folder(site.name(request))
        x, y = (_number(request, key) for key in ("x", "y"))
        library = site.libraries().get(request.query_params.get("library", ""))
        return JSONResponse(await site.compute(probe, folder, x, y, library))

    async def file(request: Request) -> Response:
        folder, of = site.scans.folder(site.name(request)), request.query_params.get("of", "products")
        return _file(folder, of, request.path_params["name"])

    return [
        Route("/api/result", result),
        Route("/api/map/{name}", map_of),
        Route("/api/probe", place),
        Route("/api/file/{name}", file),
    ]


def _file(folder: Path, of: str, name: str) -> Response:
    """One of the files that the result lists; nothing in it may act as a page of this server."""
    if not any(f["name"] == name and f["of"] == of for f in files_of(folder)):
        raise DataError(
            f"no file is called {name[:80]!r}", "it was not made, or the name is wrong", "see the scan's page"
        )
    path = (folder / EXPORT if of == EXPORT else read_products(folder).folder) / name
    if name == "report.html":
        return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})
    return FileResponse(path, media_type=_DOWNLOADS, filename=f"{folder.name}-{name}")


def _comparisons(site: Site) -> list[Route]:
    def pair(request: Request) -> tuple[Path, Path]:
        return site.scans.folder(site.name(request, "a")), site.scans.folder(site.name(request, "b"))

    def both(request: Request) -> Comparison:
        return compare(*pair(request))

    async def comparison(request: Request) -> Response:
        found = await site.compute(both, request)
        return JSONResponse(found.to_dict())

    async def map_of(request: Request) -> Response:
        name = request.path_params["name"]
        return _picture(await site.compute(lambda: draw_comparison(both(request), name)))

    return [Route("/api/compare", comparison), Route("/api/compare/{name}", map_of)]


def _picture(drawn: Picture) -> Response:
    """A map, and what the ends of its colours mean."""
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
        raise DataError(f"{key} = {text[:40]!r} is no number below a million", "the address is wrong", "use the page")
    return value
