"""POST requests below /api, for whoever holds the token: plan, doctor, scans, control, labels, notes, processing.

Each is a command of `polysight` as well; what takes long runs as that command, in a process of its own.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tomli_w
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from polysight.acquisition import ScanCommand
from polysight.catalogue import NOTES, PROGRAM, Notes, Summary, write_notes
from polysight.jobs.label import remove_labels, save_labels
from polysight.materials import Labels
from polysight.plan import Changes, forecast, forecast_values
from polysight.products import find_labels, label_folder, read_products
from polysight.serve.guard import cookie_name
from polysight.serve.programs import Programs, program_of
from polysight.serve.site import LIBRARIES, Site
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError, ScanError
from polysight_shared.tables import decode, to_builtins

RIG = "instrument.toml"
FORMATS = ("csv", "mat", "hdf5", "netcdf", "cphd")
"""Formats of exports, which are written into `<scan>/export`: files; a Zarr store is a folder, for no download."""
_LARGEST = 2000  # positions of a row, rows
Text = Annotated[str, msgspec.Meta(max_length=200)]
Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Box = tuple[Number, Number, Number, Number]
Few = Annotated[int, msgspec.Meta(ge=1, le=_LARGEST)]
Size = Annotated[float, msgspec.Meta(gt=0, le=1e5)]


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The JSON body of a request; this one is empty. Lengths and ranges are limited."""


class PlanRequest(Body, frozen=True):
    """Numbers of the plan that differ from the rig file."""

    columns: Few | None = None
    rows: Few | None = None
    step_x_mm: Size | None = None
    step_y_mm: Size | None = None
    speed_mm_s: Size | None = None
    pulses: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None

    def changes(self) -> dict[str, Any]:
        """The numbers that are given."""
        return {n: v for n in PlanRequest.__struct_fields__ if (v := getattr(self, n)) is not None}

    def apply(self, config: Path) -> Instrument:
        """The rig file with these numbers. Raises ConfigError."""
        rig = Changes(**self.changes()).apply(load_instrument(config))
        if max(rig.grid.columns, rig.grid.rows) > _LARGEST:
            raise ConfigError(
                f"{rig.grid.columns} x {rig.grid.rows} positions", f"{_LARGEST} in a row are the most here",
                "larger steps, or a smaller area", code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        return rig


class StartRequest(PlanRequest, frozen=True):
    """A new scan: its name, its plan, and how it is processed."""

    name: Text = ""
    metal: Box | None = None
    library: Text = ""
    keep_incomplete: bool = False
    notes: Annotated[str, msgspec.Meta(max_length=10_000)] = ""
    tags: Annotated[tuple[Text, ...], msgspec.Meta(max_length=20)] = ()


class ResumeRequest(Body, frozen=True):
    """An interrupted scan to resume."""

    keep_incomplete: bool = False
    library: Text = ""


class ProcessRequest(Body, frozen=True):
    """A scan to process again."""

    library: Text = ""
    labels: bool = False
    metal: Box | None = None


class LabelRequest(Body, frozen=True):
    """Boxes in millimetres from the image's centre."""

    boxes: Annotated[dict[Text, Box], msgspec.Meta(max_length=200)]
    metal: Text | None = None
    specimens: Annotated[dict[Text, Text], msgspec.Meta(max_length=200)] = {}


class NotesRequest(Body, frozen=True):
    """The operator's notes and tags; they are refused if the present ones are not `base`."""

    notes: Annotated[str, msgspec.Meta(max_length=20_000)] = ""
    tags: Annotated[tuple[Annotated[str, msgspec.Meta(max_length=1000)], ...], msgspec.Meta(max_length=100)] = ()
    base: Notes | None = None


class TrainRequest(Body, frozen=True):
    """A library to make from labelled scans."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[\w][\w .-]{0,60}$")]
    scans: Annotated[
        tuple[Annotated[str, msgspec.Meta(max_length=1000)], ...], msgspec.Meta(min_length=1, max_length=500)
    ]


class ExportRequest(Body, frozen=True):
    """Formats to write."""

    formats: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=len(FORMATS))]


Answer = Callable[[Site, Request, Any], Awaitable[dict[str, Any]]]
Words = list[str | Path]


def control_routes(site: Site) -> list[Route]:
    """Routes of everything that POST asks for; the guard has checked the token."""

    def route(path: str, kind: type[Body], answer: Answer) -> Route:
        async def endpoint(request: Request) -> Response:
            body = _decode_body(await request.body(), kind)
            return JSONResponse(await answer(site, request, body))

        return Route(f"/api/{path}", endpoint, methods=["POST"])

    return [
        Route("/api/session", _session(site), methods=["POST"]),
        route("control/{command}", Body, _control),
        route("plan", PlanRequest, _plan),
        route("doctor", Body, _doctor),
        route("start", StartRequest, _start),
        route("resume", ResumeRequest, _resume),
        route("process", ProcessRequest, _process),
        route("labels", LabelRequest, _labels),
        route("notes", NotesRequest, _notes),
        route("train", TrainRequest, _train),
        route("export", ExportRequest, _export),
    ]


def _decode_body(body: bytes, kind: type[Body]) -> Body:
    """Parse and check the body of a request. Raises ConfigError."""
    try:
        table = msgspec.json.decode(body or b"{}")
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        raise ConfigError(
            "the request is not JSON", "its body is damaged", "send a JSON object, as the page does",
            code=ErrorCode.MESSAGE_INVALID,
        ) from None  # fmt: skip
    return decode(table, kind, "the request", "send what the page sends")


def _session(site: Site) -> Callable[[Request], Awaitable[Response]]:
    async def session(request: Request) -> Response:
        answer = JSONResponse({"what": "opened"})
        name, access = cookie_name(request.scope), site.access
        answer.set_cookie(name, access.session, httponly=True, samesite="strict", secure=access.secure)
        return answer

    return session


async def _control(site: Site, request: Request, body: Body) -> dict[str, Any]:
    del body
    name, given = site.name(request), request.path_params["command"]
    if given not in list(ScanCommand):
        raise DataError(
            f"a scan cannot be asked to {given[:40]!r}", "the name is wrong", f"one of {', '.join(ScanCommand)}",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    watch = await site.read_scan(request, lambda folder: site.watches.of(name, folder))
    await site.act(watch.ask, ScanCommand(given))
    return {"what": "asked"}


async def _plan(site: Site, request: Request, body: PlanRequest) -> dict[str, Any]:
    del request
    config = _config(site)
    plan = await site.read("plan", lambda: forecast_values(forecast(body.apply(config))))
    rig = load_instrument(config)
    return plan | {"rig": rig.name, "config": str(config), "begun_with": to_builtins(rig)["grid"]}


async def _doctor(site: Site, request: Request, body: Body) -> dict[str, Any]:
    del request, body
    words: Words = ["doctor", "--config", _config(site), "--out", site.scans.root]

    def start() -> None:
        with site.rig:
            _check_free(site)
            site.logs.mkdir(exist_ok=True)
            _programs(site).start(site.logs, "doctor", words)

    await site.act(start)
    return {"what": "started"}


async def _start(site: Site, request: Request, body: StartRequest) -> dict[str, Any]:
    del request
    config, programs = _config(site), _programs(site)
    if not body.name:
        raise ConfigError("the scan has no name", "`name` is empty", "give it one", code=ErrorCode.KEY_MISSING)
    rig = body.apply(config)

    def start() -> None:
        folder = site.scans.folder(body.name, new=True)
        if folder.exists() and any(p.name not in (PROGRAM, NOTES) for p in folder.iterdir()):
            raise ConfigError(
                f"{body.name} is there already", "scans are never overwritten", "give another name",
                code=ErrorCode.NAME_TAKEN,
            )  # fmt: skip
        words: Words = ["scan", "--out", folder, *_material_words(site, body.library, body.metal)]
        words += ["--keep-incomplete"] if body.keep_incomplete else []
        with site.rig:
            _check_free(site)
            words += ["--config", _write_rig(folder, rig) if body.changes() else config.absolute()]
            if body.notes or body.tags:
                folder.mkdir(parents=True, exist_ok=True)
                write_notes(folder, Notes(body.notes, body.tags))
            programs.start(folder, "scan", words)

    await site.act(start)
    return {"what": "started", "scan": body.name}


def _check_free(site: Site) -> None:
    """Refuse what needs the rig while a known program has it. Raises ScanError."""
    running = [s.name for s in site.scans.list() if s.state in ("running", "paused") or _starting(site, s)]
    doctor = program_of(site.logs, "doctor")
    if not running and (doctor is None or not doctor.running):
        return
    what = f"{running[0]} is being scanned" if running else "the doctor checks the rig"
    raise ScanError(what, "a rig does one thing at a time", "wait until it has ended, or stop it", code=ErrorCode.BUSY)


def _starting(site: Site, s: Summary) -> bool:
    """True if the scan's program runs without a sign of life yet, or is processing."""
    program = program_of(site.scans.root / s.name, "scan") if s.state in ("begun", "lost") else None
    return program is not None and program.running


def _write_rig(folder: Path, rig: Instrument) -> Path:
    """Write the rig file of a scan that differs from the usual one; returns its path. Raises ConfigError."""
    path = folder / PROGRAM / RIG
    if path.parent.is_symlink():
        raise ConfigError(f"{path.parent} is a link", "the folder was made by another program", "give another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # a link there would have another file written
    path.write_text(tomli_w.dumps(to_builtins(rig)), encoding="utf-8")
    return path


async def _resume(site: Site, request: Request, body: ResumeRequest) -> dict[str, Any]:
    def start(folder: Path) -> None:
        words: Words = ["resume", folder.absolute(), *_material_words(site, body.library, None)]
        words += ["--keep-incomplete"] if body.keep_incomplete else []
        with site.rig:
            _check_free(site)
            _programs(site).start(folder, "scan", words)

    await site.read_scan(request, start)
    return {"what": "started"}


async def _process(site: Site, request: Request, body: ProcessRequest) -> dict[str, Any]:
    def start(folder: Path) -> None:
        words: Words = ["process", folder.absolute(), "--out", folder.absolute() / "products"]
        words += _material_words(site, body.library, body.metal)
        if body.labels:
            found = find_labels(folder)
            if found is None:
                raise ConfigError(
                    "no boxes are drawn on this scan", "they were not saved", "draw and save them first",
                    code=ErrorCode.FILE_MISSING,
                )  # fmt: skip
            words.extend(["--labels", found[0].absolute()])
        _programs(site).start(folder, "process", words)

    await site.read_scan(request, start)
    return {"what": "started"}


async def _labels(site: Site, request: Request, body: LabelRequest) -> dict[str, Any]:
    labels = Labels(body.boxes, "mm", body.metal or None, body.specimens, by_hand=True)

    def save(folder: Path) -> dict[str, Any]:
        if not labels.boxes:
            return {"what": "removed", "file": str(remove_labels(folder)), "metal": None, "notes": []}
        products = read_products(folder)
        place = label_folder(products.folder)
        checked, notes = save_labels(place, products, labels)
        return {"what": "saved", "file": str(place / "labels.json"), "metal": checked.metal, "notes": notes}

    return await site.read_scan(request, save)


async def _notes(site: Site, request: Request, body: NotesRequest) -> dict[str, Any]:
    written = await site.read_scan(request, write_notes, Notes(body.notes, body.tags), body.base)
    return {"what": "saved", "notes": written.notes, "tags": list(written.tags)}


async def _train(site: Site, request: Request, body: TrainRequest) -> dict[str, Any]:
    del request

    def start() -> None:
        folders = [site.scans.folder(name).absolute() for name in body.scans]
        out = site.scans.root.absolute() / LIBRARIES
        for folder in (out, site.logs):
            folder.mkdir(exist_ok=True)
        _programs(site).start(site.logs, "train", ["train", *folders, "--out", out / f"{body.name}.npz"])

    await site.act(start)
    return {"what": "started"}


async def _export(site: Site, request: Request, body: ExportRequest) -> dict[str, Any]:
    unknown = [name for name in body.formats if name not in FORMATS]
    if unknown:
        raise ConfigError(
            f"no format is called {unknown[0][:20]!r}", "the name is wrong", f"one of {', '.join(FORMATS)}",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip

    def start(folder: Path) -> None:
        out = folder.absolute() / "export"
        if not out.resolve().is_relative_to(folder.resolve()):
            raise DataError(
                f"{out}: leads out of the scan", "it is a link", "remove the link, or use `polysight export --out`",
                code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip
        words = ["export", folder.absolute(), *(f"--{name}" for name in body.formats)]
        _programs(site).start(folder, "export", [*words, "--out", out])

    await site.read_scan(request, start)
    return {"what": "started"}


def _material_words(site: Site, library: str, metal: Box | None) -> Words:
    """Options of the library and the metal reference. Raises ConfigError."""
    words: Words = []
    if library:
        known = site.libraries()
        if library not in known:
            raise ConfigError(
                f"no library is called {library[:60]!r}", "it was not trained here", "train it first",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        words += ["--library", known[library].absolute()]
    if metal is not None:
        x0, y0, x1, y1 = metal
        words.append(f"--metal={(x0 + x1) / 2:g},{(y0 + y1) / 2:g},{x1 - x0:g},{y1 - y0:g}")
    return words


def _config(site: Site) -> Path:
    if site.config is None:
        raise ConfigError("this server has no rig file", "it was started without", "polysight serve --config FILE")
    return site.config


def _programs(site: Site) -> Programs:
    if site.programs is None:
        raise DeviceError("nothing can be started here", "it shows one scan", "polysight serve starts scans")
    return site.programs
