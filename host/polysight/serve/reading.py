"""GET requests below /api: lists, the live view, results, comparisons; nothing here changes a scan.

Whatever touches a scan folder goes through `Site.read`: in a thread and with a time limit.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote

import anyio
import msgspec
from msgspec.structs import asdict
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from polysight import catalogue
from polysight.page import Watch
from polysight.products import REPORT, read_products
from polysight.results import ACTION_SIGMAS, WARNING_SIGMAS, CheckResult
from polysight.serve.guard import refuse
from polysight.serve.programs import WaitingRequests
from polysight.serve.site import THUMBNAIL, ListChanges, ListedScan, Site, check_products, compare_products, draw_map
from polysight_shared.errors import DataError, ErrorCode, PolysightError, ScanError

# A report may come from anywhere, so browsers run no script in it and load nothing for it.
REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
# Bytes of a file that are read and sent at a time; chosen.
CHUNK_BYTES = 1 << 18
LIST_S = 0.5
"""Time after which the scans that were read so far are sent as a list: 2,000 scans without an index take 8 s."""
# Number of attempts to read products, which may be replaced meanwhile; chosen.
MAX_TRIES = 5
T = TypeVar("T")
Endpoint = Callable[[Site, Request], Awaitable[Response]]


def reading_routes(site: Site) -> list[Route]:
    """Return the routes of GET requests below /api, except those that `front` and `commands` answer."""
    endpoints: dict[str, Endpoint] = {
        "scans": _send_scans,
        "scan": _send_scan,
        "queue": _send_queue,
        "thumbnail": _send_thumbnail,
        "program/{kind}": _send_program,
        "state": _send_state,
        "events": _stream_events,
        "picture/{name}": _send_live_picture,
        "bar/{kind}": _send_colour_bar,
        "result": _send_result,
        "map/{name}": _send_map,
        "probe": _send_probe,
        "file/{name}": _send_file,
        "check": _send_control_chart,
        "compare": _send_comparison,
        "compare/{name}": _send_comparison_map,
    }

    def make_route(path: str, answer: Endpoint) -> Route:
        async def endpoint(request: Request) -> Response:
            return await answer(site, request)

        return Route(f"/api/{path}", endpoint)

    return [make_route(path, answer) for path, answer in endpoints.items()]


def make_json_answer(content: object) -> Response:
    """Return an answer in JSON from structs, dataclasses or plain data; numbers that are not finite become null."""
    return Response(msgspec.json.encode(content), media_type="application/json")


# --- lists ---


class ScanList(ListChanges, frozen=True, kw_only=True):
    """The scans under the folder, or what has changed among them; and names in it that are not shown.

    `unread` folders are not in the list yet: it is asked for again.
    """

    unread: int
    free_bytes: int | None
    libraries: list[str]
    left_out: list[str]


class ScanDetails(ListedScan, frozen=True, kw_only=True):
    """One scan, with its folder and the programs that were started for it, the newest first."""

    folder: str
    programs: list[catalogue.Program]


async def _send_scans(site: Site, request: Request) -> Response:
    """Answer with the scans that changed since the stamp of the last answer, and the free space of the disk."""
    root = site.scans.root
    stamp = request.query_params.get("since", "")

    def list_scans() -> ScanList:
        scans = [ListedScan(**asdict(s), bytes=site.size(s.name, s.state)) for s in site.scans.list(LIST_S)]
        free_bytes = None
        if root.is_dir():
            free_bytes = shutil.disk_usage(root).free
        changes = site.listed.update(scans, stamp)
        return ScanList(
            **asdict(changes),
            unread=site.scans.unread,
            free_bytes=free_bytes,
            libraries=list(site.libraries()),
            left_out=list(site.scans.list_left_out()),
        )

    return make_json_answer(await site.read("", list_scans))


async def _send_scan(site: Site, request: Request) -> Response:
    """Answer with one scan: its line of the list, notes, folder and programs."""
    name = site.name(request)

    def read_details(folder: Path) -> ScanDetails:
        summary = site.scans.summary(name)
        facts = asdict(summary) | asdict(catalogue.read_notes(folder))
        folder_text = str(folder.absolute())
        return ScanDetails(
            **facts,
            bytes=site.size(name, summary.state),
            folder=folder_text,
            programs=catalogue.find_programs(folder),
        )

    return make_json_answer(await site.read_scan(request, read_details))


async def _send_queue(site: Site, request: Request) -> Response:
    """Answer with the names that wait for the rig; none if no scan can be started here."""
    del request
    if not site.starts:
        return make_json_answer(WaitingRequests([]))
    return make_json_answer(await site.read("", site.queue.waiting))


async def _send_thumbnail(site: Site, request: Request) -> Response:
    """Answer with a small picture of a scan; 204 if it has none."""

    def draw(folder: Path) -> bytes:
        try:
            return draw_map(folder, THUMBNAIL).png
        except DataError:
            # No image, or a damaged one: the scan's own page says so.
            return b""

    png = await site.read_scan(request, draw)
    if not png:
        return Response(status_code=204)
    # Seconds for which a browser does not ask again; chosen.
    return Response(png, media_type="image/png", headers={"Cache-Control": "private, max-age=5"})


async def _send_program(site: Site, request: Request) -> Response:
    """Answer with the state of a program that belongs to no scan; null for any other."""
    kind = request.path_params["kind"]
    if kind not in ("doctor", "train", "concentration"):
        return make_json_answer(None)
    return make_json_answer(await site.read("", lambda: catalogue.find_program(site.logs, kind)))


# --- the live view ---


async def _open_watch(site: Site, request: Request) -> Watch:
    """Return the live view of the scan that a request names."""
    name = site.name(request)
    return await site.read_scan(request, lambda folder: site.watches.open(name, folder))


async def _send_state(site: Site, request: Request) -> Response:
    """Answer with the newest state of the live view."""
    return Response((await _open_watch(site, request)).state.data, media_type="application/json")


async def _stream_events(site: Site, request: Request) -> Response:
    """Answer with the events of the live view, as long as the page is open."""
    watch = await _open_watch(site, request)
    events = site.watches.events(site.name(request), watch, site.is_ending)
    return StreamingResponse(events, media_type="text/event-stream")


async def _send_live_picture(site: Site, request: Request) -> Response:
    """Answer with a picture of the live view; 404 until the first row is processed."""
    picture = (await _open_watch(site, request)).shown.pictures.get(request.path_params["name"])
    if picture is None:
        problem = "This picture does not exist yet"
        return refuse(404, ErrorCode.FILE_MISSING, problem, "no row is processed", "it comes with the first row")
    return Response(picture.png, media_type="image/png")


async def _send_colour_bar(site: Site, request: Request) -> Response:
    """Answer with the colours of a kind of map as a picture."""
    del site
    kind = request.path_params["kind"]
    colours = {"phase": catalogue.PHASE_COLOURS, "amplitude": catalogue.AMPLITUDE_COLOURS}.get(kind, str(kind))
    if colours not in (catalogue.AMPLITUDE_COLOURS, catalogue.PHASE_COLOURS, catalogue.DIFFERENCE_COLOURS):
        return refuse(404, ErrorCode.VALUE_INVALID, "There are no such colours", "", "use the page")
    return Response(catalogue.colour_bar(colours), media_type="image/png")


# --- results ---


async def _send_result(site: Site, request: Request) -> Response:
    """Answer with the results of a scan's products."""
    return make_json_answer(await _read_products(site, request, catalogue.read_result))


async def _read_products(site: Site, request: Request, work: Callable[[Path], T]) -> T:
    """Read products of one generation (of one run of processing): that which the request names, or the present one.

    Raises ScanError if the page shows another one, which it then loads, or if they are replaced again and again.
    """
    shown_generation = request.query_params.get("generation", "")

    def read(folder: Path) -> T:
        for _ in range(MAX_TRIES):
            generation_before = catalogue.read_generation(read_products(folder).folder)
            if shown_generation and generation_before != shown_generation:
                break
            try:
                result = work(folder)
            except (PolysightError, OSError):
                # The files may have been of two generations: an error counts only if there was one.
                if catalogue.read_generation(read_products(folder).folder) == generation_before:
                    raise
                continue
            if catalogue.read_generation(read_products(folder).folder) == generation_before:
                return result
        raise ScanError(
            "the scan was processed again in the meantime", "another program replaced its products", "load the page "
            "again",
            code=ErrorCode.MISMATCH,
        )  # fmt: skip

    return await site.read_scan(request, read)


async def _send_map(site: Site, request: Request) -> Response:
    """Answer with a map of a scan as PNG, between the limits of its colours if the page gives them."""
    name = request.path_params["name"]
    limits = None
    if "low" in request.query_params and "high" in request.query_params:
        low = _parse_number(request, "low")
        high = _parse_number(request, "high")
        if low < high:
            limits = (low, high)
    return _make_picture_answer(await _read_products(site, request, lambda folder: draw_map(folder, name, limits)))


async def _send_probe(site: Site, request: Request) -> Response:
    """Answer with the results at one place of a scan."""
    x_mm = _parse_number(request, "x")
    y_mm = _parse_number(request, "y")
    name = request.query_params.get("library", "")
    # The libraries are read in the thread, too: their drive may be gone.
    return make_json_answer(
        await _read_products(
            site, request, lambda folder: catalogue.probe(folder, x_mm, y_mm, site.libraries().get(name))
        )
    )


async def _send_file(site: Site, request: Request) -> Response:
    """Send one of the files that the result lists, in a form that cannot act as a page of this server."""
    name = request.path_params["name"]
    kind = request.query_params.get("of", "products")

    def find_file(folder: Path) -> tuple[str, Path]:
        if not any(file.name == name and file.of == kind for file in catalogue.list_files(folder)):
            raise DataError(
                f"no file is called {name[:80]!r}", "it was not made, or the name is wrong", "see the scan's page",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        if kind == catalogue.EXPORT_FOLDER:
            return folder.name, folder / catalogue.EXPORT_FOLDER / name
        return folder.name, read_products(folder).folder / name

    scan, path = await site.read_scan(request, find_file)
    if name == REPORT:
        return Download(path, "text/html", {"Content-Security-Policy": REPORT_POLICY})
    disposition = f"attachment; filename*=utf-8''{quote(f'{scan}-{name}')}"
    return Download(path, "application/octet-stream", {"Content-Disposition": disposition})


class Download(StreamingResponse):
    """A file as an answer, closed also when the answer is aborted: starlette's FileResponse leaves it open then."""

    def __init__(self, path: Path, media_type: str, headers: dict[str, str]) -> None:
        super().__init__(self._read_chunks(), media_type=media_type, headers=headers)
        self._path = path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file."""
        with self._path.open("rb") as self._file:
            self.headers["Content-Length"] = str(os.fstat(self._file.fileno()).st_size)
            await super().__call__(scope, receive, send)

    async def _read_chunks(self) -> AsyncIterator[bytes]:
        while chunk := await anyio.to_thread.run_sync(self._file.read, CHUNK_BYTES):
            yield chunk


def _make_picture_answer(picture: catalogue.Picture) -> Response:
    """Return a map as an answer; its headers have the values at the ends of its colours."""
    unit = "deg" if picture.unit == "°" else picture.unit
    headers = {"X-Low": f"{picture.low:g}", "X-High": f"{picture.high:g}", "X-Unit": unit}
    return Response(picture.png, media_type="image/png", headers=headers)


def _parse_number(request: Request, key: str) -> float:
    """Return a number of the query. Raises DataError if it is missing, NaN or a million and more."""
    text = request.query_params.get(key, "")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e6:
        raise DataError(
            f"{key} = {text[:40]!r} is not a number below a million", "the address is wrong", "use the page",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return value


# --- check plates ---


class CheckedScan(msgspec.Struct, frozen=True, kw_only=True):
    """Check plate of one scan of the list; `seconds` when it began, since 1970."""

    name: str
    seconds: float
    simulated: bool | None
    check: CheckResult


class ControlChart(msgspec.Struct, frozen=True, kw_only=True):
    """Check plates of all scans, the oldest first; names of scans whose products cannot be read; limits."""

    scans: list[CheckedScan]
    unreadable: list[str]
    warning_sigmas: float = WARNING_SIGMAS
    action_sigmas: float = ACTION_SIGMAS


async def _send_control_chart(site: Site, request: Request) -> Response:
    """Answer with the check plates of all processed scans."""
    del request

    def read_checks() -> ControlChart:
        scans = []
        unreadable = []
        for summary in site.scans.list():
            if not summary.processed:
                continue
            try:
                check = check_products(site.scans.folder(summary.name))
            except (PolysightError, OSError):
                unreadable.append(summary.name)
                continue
            if check is not None:
                scan = CheckedScan(name=summary.name, seconds=summary.seconds, simulated=summary.simulated, check=check)
                scans.append(scan)
        scans.sort(key=lambda scan: (scan.seconds, scan.name))
        return ControlChart(scans=scans, unreadable=unreadable)

    return make_json_answer(await site.read("", read_checks))


# --- comparisons ---


async def _use_comparison(site: Site, request: Request, use: Callable[[catalogue.Comparison], T]) -> T:
    """Compare the two scans of a request in a thread, and return the result of `use` on the comparison."""
    first = site.name(request, "a")
    second = site.name(request, "b")
    # A name of its own, made of their folders below the root: if reading one of them hangs, the other one's requests
    # still work.
    both_scans = f"{first.partition('/')[0]} and {second.partition('/')[0]}"
    folder = site.scans.folder
    return await site.read(both_scans, lambda: use(compare_products(folder(first), folder(second))))


async def _send_comparison(site: Site, request: Request) -> Response:
    """Answer with the differences of two scans as numbers."""
    return make_json_answer(await _use_comparison(site, request, lambda comparison: comparison.figures))


async def _send_comparison_map(site: Site, request: Request) -> Response:
    """Answer with a map of the differences of two scans."""
    name = request.path_params["name"]
    return _make_picture_answer(
        await _use_comparison(site, request, lambda comparison: catalogue.draw_comparison(comparison, name))
    )
