"""POST requests of the reading process: plan, doctor, scans, labels, notes, processing.

Browsers reach the process of the pages (`front`), which checks the token of each request and forwards it to the reading
process, except for requests for static pages and running scans. Each action of this file is a command of `polysight` as
well; one that takes long runs as that command, in a process of its own. `Site.rig` is a lock: it is held from the check
that the rig is free until a program uses it.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import tomli_w
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from polysight.catalogue import (
    NOTES_FILE,
    PROGRAM_FOLDER,
    Notes,
    Summary,
    find_program,
    find_programs,
    is_plain,
    write_notes,
)
from polysight.jobs.label import remove_labels, save_labels
from polysight.materials import LAYER_FORMS, Labels, parse_layer
from polysight.planning import PlanChanges, forecast, forecast_values
from polysight.products import LABELS, find_labels, label_folder, read_products
from polysight.serve.reading import make_json_answer
from polysight.serve.site import LIBRARIES, Site
from polysight.store import ScanFolder
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError
from polysight_shared.tables import decode, to_builtins

RIG_FILE = "instrument.toml"
REQUEST_FILE = "request.json"
# Bytes of the file of a request that are read; a request itself cannot be longer (`guard.BODY_BYTES`).
MAX_REQUEST_BYTES = 1 << 16
Format = Literal["csv", "mat", "netcdf"]
"""Formats of exports, which are written into `<scan>/export`."""
# Largest number of positions of a row, and of rows; chosen.
MAX_POSITIONS = 2000
# Largest number of sub-bands that the page may ask for; chosen.
MAX_BANDS = 16
Text = Annotated[str, msgspec.Meta(max_length=200)]
LongText = Annotated[str, msgspec.Meta(max_length=1000)]
Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Box = tuple[Number, Number, Number, Number]
Count = Annotated[int, msgspec.Meta(ge=1, le=MAX_POSITIONS)]
Size = Annotated[float, msgspec.Meta(gt=0, le=1e5)]


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The JSON body of a request; this one is empty. Lengths and ranges are limited."""


class PlanRequest(Body, frozen=True):
    """Numbers of the plan that differ from the rig file."""

    columns: Count | None = None
    rows: Count | None = None
    step_x_mm: Size | None = None
    step_y_mm: Size | None = None
    speed_mm_s: Size | None = None
    pulses: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None

    def changes(self) -> PlanChanges:
        """Return the numbers as changes of a plan."""
        return PlanChanges(**msgspec.structs.asdict(self))

    def apply(self, config: Path) -> Instrument:
        """Return the rig file with these numbers. Raises ConfigError."""
        rig = self.changes().apply(load_instrument(config))
        if max(rig.grid.columns, rig.grid.rows) > MAX_POSITIONS:
            raise ConfigError(
                f"{rig.grid.columns} x {rig.grid.rows} positions",
                f"at most {MAX_POSITIONS} in each direction can be planned here",
                "choose larger steps, or a smaller area", code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        return rig


class StartRequest(Body, frozen=True):
    """A new scan: its name, its plan, and how it is processed; `keep_incomplete`: keep rows with gaps, masked."""

    name: Text = ""
    plan: PlanRequest = PlanRequest()
    metal: Box | None = None
    library: Text = ""
    keep_incomplete: bool = False
    notes: Annotated[str, msgspec.Meta(max_length=10_000)] = ""
    tags: Annotated[tuple[Text, ...], msgspec.Meta(max_length=20)] = ()


class ScanName(Body, frozen=True):
    """The name of a scan, typed by who archives or deletes it, or takes it out of the queue."""

    name: Text = ""


class ResumeRequest(Body, frozen=True):
    """An interrupted scan to resume; `keep_incomplete` as of :class:`StartRequest`."""

    keep_incomplete: bool = False
    library: Text = ""


class ProcessRequest(Body, frozen=True):
    """A scan to process again."""

    library: Text = ""
    labels: bool = False
    metal: Box | None = None
    bands: Annotated[int, msgspec.Meta(ge=1, le=MAX_BANDS)] | None = None
    sparse: bool = False


class LayersRequest(Body, frozen=True):
    """Layers to fit to a patch, in the order the wave meets them, as `parse_layer` takes them."""

    patch: Annotated[int, msgspec.Meta(ge=1)]
    layers: Annotated[tuple[Text, ...], msgspec.Meta(min_length=1, max_length=20)]


class LibraryRequest(Body, frozen=True):
    """A library of solutions."""

    library: Text


class LabelRequest(Body, frozen=True):
    """Boxes in millimetres from the image's centre."""

    boxes: Annotated[dict[Text, Box], msgspec.Meta(max_length=200)]
    metal: Text | None = None
    specimens: Annotated[dict[Text, Text], msgspec.Meta(max_length=200)] = {}


class NotesRequest(Body, frozen=True):
    """The operator's notes and tags; they are refused if the present ones are not `base`."""

    notes: Annotated[str, msgspec.Meta(max_length=20_000)] = ""
    tags: Annotated[tuple[LongText, ...], msgspec.Meta(max_length=100)] = ()
    base: Notes | None = None


class TrainRequest(Body, frozen=True):
    """A library to make from labelled scans."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[\w][\w .-]{0,60}$")]
    scans: Annotated[tuple[LongText, ...], msgspec.Meta(min_length=1, max_length=500)]


class ExportRequest(Body, frozen=True):
    """Formats to write."""

    formats: Annotated[tuple[Format, ...], msgspec.Meta(min_length=1)]


AnyBody = TypeVar("AnyBody", bound=Body)
Words = list[str | Path]
"""Words of a `polysight` command line, after the program's name."""


class RequestedScan(NamedTuple):
    """The scan that a request names, and its folder."""

    name: str
    folder: Path


def command_routes(site: Site) -> list[Route]:
    """Return the routes of all POST requests, and the GET route of the request that started a scan."""

    async def show_request(request: Request) -> Response:
        name = site.name(request)
        return make_json_answer(await site.read_scan(request, lambda folder: read_request(folder, name)))

    def make_route(path: str, kind: type[Body], work: Callable[[Site, Any], object]) -> Route:
        async def endpoint(request: Request) -> Response:
            body = decode_body(await request.body(), kind)
            return make_json_answer(await site.run_command(lambda: work(site, body)))

        return Route(f"/api/{path}", endpoint, methods=["POST"])

    def make_scan_route(path: str, kind: type[Body], work: Callable[[Site, RequestedScan, Any], object]) -> Route:
        async def endpoint(request: Request) -> Response:
            body = decode_body(await request.body(), kind)
            name = site.name(request)
            # Commands use a scan's folder like reads: in a thread, with a time limit.
            return make_json_answer(
                await site.read_scan(request, lambda folder: work(site, RequestedScan(name, folder), body))
            )

        return Route(f"/api/{path}", endpoint, methods=["POST"])

    return [
        Route("/api/request", show_request),
        make_route("plan", PlanRequest, _plan),
        make_route("doctor", Body, _start_doctor),
        make_route("start", StartRequest, start_scan),
        make_route("queue", StartRequest, _enqueue_scan),
        make_route("unqueue", ScanName, lambda site, body: site.queue.remove(body.name)),
        make_route("release", Body, lambda site, _: site.queue.release()),
        make_route("train", TrainRequest, _train),
        make_route("concentration", LibraryRequest, _fit_concentration),
        make_scan_route("again", Body, _start_again),
        make_scan_route("archive", ScanName, _archive_scan),
        make_scan_route("delete", ScanName, _delete),
        make_scan_route("resume", ResumeRequest, _resume),
        make_scan_route("process", ProcessRequest, _process),
        make_scan_route("layers", LayersRequest, _fit_layers),
        make_scan_route("labels", LabelRequest, _save_labels),
        make_scan_route("notes", NotesRequest, _save_notes),
        make_scan_route("export", ExportRequest, _export),
    ]


def decode_body(body: bytes, kind: type[AnyBody]) -> AnyBody:
    """Parse and check the body of a request. Raises ConfigError."""
    try:
        table = msgspec.json.decode(body or b"{}")
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        raise ConfigError(
            "the request is not JSON", "its body is damaged", "send a JSON object, as the page does",
            code=ErrorCode.MESSAGE_INVALID,
        ) from None  # fmt: skip
    return decode(table, kind, "the request", "send what the page sends")


def _plan(site: Site, body: PlanRequest) -> dict[str, Any]:
    """Return the forecast of a scan with the numbers of a plan, and the grid of the rig file."""
    plan = forecast_values(forecast(body.apply(site.config)))
    rig = load_instrument(site.config)
    return plan | {"rig": rig.name, "config": str(site.config), "begun_with": to_builtins(rig)["grid"]}


def _start_doctor(site: Site, body: Body) -> None:
    """Start the checks of the rig, unless it is in use."""
    del body
    with site.rig:
        _check_free(site)
        site.logs.mkdir(exist_ok=True)
        site.programs.start(site.logs, "doctor", ["doctor", "--config", site.config, "--out", site.scans.root])


def start_scan(site: Site, body: StartRequest) -> None:
    """Start a scan as a request says. Raises PolysightError."""
    rig = check_request(site, body)
    folder = site.scans.folder(body.name, new=True)
    words: Words = ["scan", "--out", folder, *_list_processing_options(site, body.library, body.metal)]
    if body.keep_incomplete:
        words.append("--keep-incomplete")
    with site.rig:
        _check_free(site)
        path = _write_files(folder, rig, body)
        if body.plan == PlanRequest():
            # Nothing differs from the rig file: it is used itself, at its place, where its relative paths begin.
            path = site.config.absolute()
        words += ["--config", path]
        if body.notes or body.tags:
            write_notes(folder, Notes(body.notes, body.tags))
        site.programs.start(folder, "scan", words)


def start_waiting(site: Site, request: bytes) -> None:
    """Start a request of the queue. Raises PolysightError."""
    start_scan(site, decode_body(request, StartRequest))


def check_request(site: Site, body: StartRequest) -> Instrument:
    """Return the rig file with a request's plan. Raises PolysightError if no scan can be started with it."""
    if not body.name:
        raise ConfigError("the scan has no name", "`name` is empty", "give it one", code=ErrorCode.KEY_MISSING)
    rig = body.plan.apply(site.config)
    # Raises if there is no such library.
    _list_processing_options(site, body.library, body.metal)
    folder = site.scans.folder(body.name, new=True)
    if folder.exists() and any(p.name not in (PROGRAM_FOLDER, NOTES_FILE) for p in folder.iterdir()):
        raise ConfigError(
            f"{body.name} exists already", "scans are never overwritten", "give another name",
            code=ErrorCode.NAME_TAKEN,
        )  # fmt: skip
    return rig


def _start_again(site: Site, scan: RequestedScan, body: Body) -> None:
    """Repeat the start of a scan that could not start; its saved request is checked as if it came from the page."""
    del body
    start_scan(site, read_request(scan.folder, scan.name))


def read_request(folder: Path, name: str) -> StartRequest:
    """Return the request that started a scan, or one made from its plan. Raises PolysightError if it has neither."""
    path = folder / PROGRAM_FOLDER / REQUEST_FILE
    if is_plain(path) and not path.parent.is_symlink():
        request = decode_body(path.read_bytes()[:MAX_REQUEST_BYTES], StartRequest)
        return msgspec.structs.replace(request, name=name)
    rig = ScanFolder.load(folder).instrument
    plan = PlanRequest(
        columns=rig.grid.columns,
        rows=rig.grid.rows,
        step_x_mm=rig.grid.step_x_mm,
        step_y_mm=rig.grid.step_y_mm,
        speed_mm_s=rig.stage.speed_mm_s,
        pulses=rig.burst.pulses,
    )
    return StartRequest(name=name, plan=plan)


def _enqueue_scan(site: Site, body: StartRequest) -> None:
    """Check a request, and add it to the queue."""
    check_request(site, body)
    site.queue.add(body.name, msgspec.json.encode(body))


def _archive_scan(site: Site, scan: RequestedScan, body: ScanName) -> None:
    """Move a scan out of the list; its files are kept in the hidden archive."""
    _put_away(site, scan, body.name)


def _delete(site: Site, scan: RequestedScan, body: ScanName) -> None:
    """Move a scan out of the list, and delete its files in the background."""
    # The scan leaves the list immediately; its files may take longer.
    archive_folder = _put_away(site, scan, body.name)
    threading.Thread(target=shutil.rmtree, args=(archive_folder, True), name="delete").start()


def _put_away(site: Site, scan: RequestedScan, typed: str) -> Path:
    """Move a scan into the hidden archive; returns its new place. Raises PolysightError."""
    name, folder = scan
    if typed != name:
        raise ConfigError(
            "the typed name is not that of the scan", f"the scan has the name {name}", "type the name as it is shown",
            code=ErrorCode.MISMATCH,
        )  # fmt: skip
    with site.rig:
        working = [p.kind for p in find_programs(folder) if p.running]
        summary = site.scans.summary(name)
        if working or summary.state in ("running", "paused", "frozen"):
            raise ScanError(f"{name} is in use", "its files are being written", "wait, or stop it", code=ErrorCode.BUSY)
        archive_folder = site.logs / "archive" / f"{time.time_ns()}" / folder.name
        archive_folder.parent.mkdir(parents=True)
        folder.rename(archive_folder)
    return archive_folder


def _check_free(site: Site) -> None:
    """Raise ScanError while a scan of the list, or the doctor, uses the rig."""
    running = [s.name for s in site.scans.list() if s.state in ("running", "paused", "frozen") or _is_starting(site, s)]
    doctor = find_program(site.logs, "doctor")
    if running:
        activity = f"{running[0]} is being scanned"
    elif doctor is not None and doctor.running:
        activity = "the doctor checks the rig"
    else:
        return
    raise ScanError(
        activity, "a rig does one thing at a time", "wait until it has ended, or stop it", code=ErrorCode.BUSY
    )


def _is_starting(site: Site, summary: Summary) -> bool:
    """True if the program of a scan runs, but has not yet given a sign of life.

    Such a scan is listed as `begun` (a folder without rows), or when it is resumed still as `lost`.
    """
    if summary.state in ("begun", "lost"):
        program = find_program(site.scans.root / summary.name, "scan")
    else:
        program = None
    return program is not None and program.running


def _write_files(folder: Path, rig: Instrument, request: StartRequest) -> Path:
    """Write a scan's rig file, and its request for another start; returns the rig file's path. Raises ConfigError."""
    program_folder = folder / PROGRAM_FOLDER
    if program_folder.is_symlink():
        raise ConfigError(f"{program_folder} is a link", "the folder was made by another program", "give another name")
    program_folder.mkdir(parents=True, exist_ok=True)
    for name, content in (
        (RIG_FILE, tomli_w.dumps(to_builtins(rig)).encode()),
        (REQUEST_FILE, msgspec.json.encode(request)),
    ):
        # Through a link there, another file would be written.
        (program_folder / name).unlink(missing_ok=True)
        (program_folder / name).write_bytes(content)
    return program_folder / RIG_FILE


def _resume(site: Site, scan: RequestedScan, body: ResumeRequest) -> None:
    """Start `polysight resume` for a scan, unless the rig is in use."""
    words: Words = ["resume", scan.folder.absolute(), *_list_processing_options(site, body.library, None)]
    if body.keep_incomplete:
        words.append("--keep-incomplete")
    with site.rig:
        _check_free(site)
        site.programs.start(scan.folder, "scan", words)


def _process(site: Site, scan: RequestedScan, body: ProcessRequest) -> None:
    """Start `polysight process` for a scan; its products go into the scan's folder.

    Raises ConfigError if the scan's boxes are asked for, and there are none.
    """
    folder = scan.folder.absolute()
    words: Words = ["process", folder, "--out", folder / "products"]
    words += _list_processing_options(site, body.library, body.metal)
    if body.labels:
        labels = find_labels(folder)
        if labels is None:
            raise ConfigError(
                "no boxes are drawn on this scan", "they were not saved", "draw and save them first",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        words += ["--labels", labels[0]]
    if body.bands is not None:
        words += ["--bands", str(body.bands)]
    if body.sparse:
        words.append("--sparse")
    site.programs.start(folder, "process", words)


def _fit_layers(site: Site, scan: RequestedScan, body: LayersRequest) -> None:
    """Start `polysight permittivity` for a stack of layers, after a check of their texts."""
    for text in body.layers:
        try:
            parse_layer(text)
        except ValueError:
            raise ConfigError(
                f"{text!r} is not a layer", "a value is missing, or is not a number", f"write {LAYER_FORMS}",
                code=ErrorCode.VALUE_INVALID,
            ) from None  # fmt: skip
    stack = [f"--layer={text}" for text in body.layers]
    words: Words = ["permittivity", scan.folder.absolute(), "--patch", str(body.patch), *stack]
    site.programs.start(scan.folder, "permittivity", words)


class SavedLabels(msgspec.Struct, frozen=True):
    """The file of boxes drawn by hand, "" if there are none any more, and notices about them."""

    file: str
    notes: list[str] = []


def _save_labels(site: Site, scan: RequestedScan, body: LabelRequest) -> SavedLabels:
    """Save the boxes drawn on the page in the folder of the products; without boxes the file is removed."""
    del site
    labels = Labels(body.boxes, "mm", body.metal or None, body.specimens, by_hand=True)
    if not labels.boxes:
        remove_labels(scan.folder)
        return SavedLabels("")
    products = read_products(scan.folder)
    labels_folder = label_folder(products.folder)
    _, notes = save_labels(labels_folder, products, labels)
    return SavedLabels(str(labels_folder / LABELS), notes)


def _save_notes(site: Site, scan: RequestedScan, body: NotesRequest) -> Notes:
    """Save notes and tags of a scan; refused if another person has changed them meanwhile."""
    del site
    return write_notes(scan.folder, Notes(body.notes, body.tags), body.base)


def _train(site: Site, body: TrainRequest) -> None:
    """Start `polysight train` with labelled scans; the library goes into the folder of libraries."""
    folders = [site.scans.folder(name).absolute() for name in body.scans]
    out = site.scans.root.absolute() / LIBRARIES
    out.mkdir(exist_ok=True)
    site.logs.mkdir(exist_ok=True)
    site.programs.start(site.logs, "train", ["train", *folders, "--out", out / f"{body.name}.npz"])


def _fit_concentration(site: Site, body: LibraryRequest) -> None:
    """Start `polysight concentration` on a library that was trained here."""
    site.programs.start(site.logs, "concentration", ["concentration", _find_library(site, body.library)])


def _export(site: Site, scan: RequestedScan, body: ExportRequest) -> None:
    """Start an export into the folder of the scan. Raises DataError if `export` is a link that leads out of it."""
    folder = scan.folder.absolute()
    out = folder / "export"
    if not out.resolve().is_relative_to(folder.resolve()):
        raise DataError(
            f"{out}: is outside the scan", "it is a link", "remove the link, or use `polysight export --out`",
            code=ErrorCode.PATH_OUTSIDE,
        )  # fmt: skip
    options = [f"--{name}" for name in body.formats]
    site.programs.start(folder, "export", ["export", folder, *options, "--out", out])


def _list_processing_options(site: Site, library: str, metal: Box | None) -> Words:
    """Return the options of the library and the metal reference. Raises ConfigError."""
    words: Words = []
    if library:
        words += ["--library", _find_library(site, library)]
    if metal is not None:
        x0, y0, x1, y1 = metal
        words.append(f"--metal-box={x0:g},{y0:g},{x1:g},{y1:g}")
    return words


def _find_library(site: Site, name: str) -> Path:
    """Return the file of a library. Raises ConfigError."""
    libraries = site.libraries()
    if name not in libraries:
        raise ConfigError(
            f"no library is called {name[:60]!r}", "it was not trained here", "train it first",
            code=ErrorCode.FILE_MISSING,
        )  # fmt: skip
    return libraries[name].absolute()
