"""What can be asked for, by who holds the token: plan, doctor, scans and their wishes, labels, notes, processing.

Each is a command of `polysight` as well; what takes long runs as one, in a process of its own.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import tomli_w
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from polysight.host.acquisition import Wish
from polysight.host.catalogue import NOTES, PROGRAM, Notes, Summary, write_notes
from polysight.host.jobs.label import save_labels
from polysight.host.materials import Labels
from polysight.host.plan import Changes, forecast, numbers
from polysight.host.products import find_labels, label_folder, read_products
from polysight.host.serve.guard import cookie_name, refused
from polysight.host.serve.programs import Programs, program_of
from polysight.host.serve.site import LIBRARIES, Site
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError, DeviceError, ScanError
from polysight.shared.tables import to_builtins

RIG = "instrument.toml"
FORMATS = ("csv", "mat", "png", "hdf5", "netcdf", "cphd")
"""What a page may have written for other programs, into `<scan>/export`."""
_LARGEST = 2000  # positions of a row, rows
Text = Annotated[str, msgspec.Meta(max_length=200)]
Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Box = tuple[Number, Number, Number, Number]
Few = Annotated[int, msgspec.Meta(ge=1, le=_LARGEST)]
Size = Annotated[float, msgspec.Meta(gt=0, le=1e5)]
T = TypeVar("T", bound="Request_")


class UnknownWishError(Exception):
    """What a running scan is asked for is nothing that it can be asked for."""


class Request_(msgspec.Struct, frozen=True, forbid_unknown_fields=True):  # noqa: N801
    """The body of a POST: what it may hold, and how large it may be."""


class PlanRequest(Request_, frozen=True):
    """Numbers that a scan is to have otherwise than the rig file."""

    columns: Few | None = None
    rows: Few | None = None
    step_x_mm: Size | None = None
    step_y_mm: Size | None = None
    speed_mm_s: Size | None = None
    pulses: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None

    @property
    def given(self) -> bool:
        """Whether any is."""
        return any(getattr(self, name) is not None for name in self.__struct_fields__)

    def of(self, config: Path) -> Instrument:
        """The rig file with them. Raises ConfigError."""
        names = PlanRequest.__struct_fields__
        rig = Changes(**{name: getattr(self, name) for name in names}).apply(load_instrument(config))
        if max(rig.grid.columns, rig.grid.rows) > _LARGEST:
            raise ConfigError(
                f"{rig.grid.columns} x {rig.grid.rows} positions", f"{_LARGEST} in a row are the most here",
                "larger steps, or a smaller area",
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


class ResumeRequest(Request_, frozen=True):
    """An old scan that goes on."""

    keep_incomplete: bool = False
    library: Text = ""


class ProcessRequest(Request_, frozen=True):
    """A scan that is processed again."""

    library: Text = ""
    labels: bool = False
    metal: Box | None = None


class LabelRequest(Request_, frozen=True):
    """Boxes in millimetres from the image's centre."""

    boxes: Annotated[dict[Text, Box], msgspec.Meta(max_length=200)]
    metal: Text | None = None
    specimens: Annotated[dict[Text, Text], msgspec.Meta(max_length=200)] = {}


class NotesRequest(Request_, frozen=True):
    """The operator's words."""

    notes: Annotated[str, msgspec.Meta(max_length=20_000)] = ""
    tags: Annotated[tuple[Annotated[str, msgspec.Meta(max_length=1000)], ...], msgspec.Meta(max_length=100)] = ()


class TrainRequest(Request_, frozen=True):
    """Labelled scans that a library is made of."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[\w][\w .-]{0,60}$")]
    scans: Annotated[
        tuple[Annotated[str, msgspec.Meta(max_length=1000)], ...], msgspec.Meta(min_length=1, max_length=500)
    ]


class ExportRequest(Request_, frozen=True):
    """Formats to write."""

    formats: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=len(FORMATS))]


Answer = Callable[[Site, Request, Any], Awaitable[Any]]


def control_routes(site: Site) -> list[Route]:
    """Everything that POST asks for, below /api; the guard has seen the token."""

    def asks(path: str, kind: type[Request_], answer: Answer) -> Route:
        async def endpoint(request: Request) -> Response:
            body = await request.body()
            try:
                wanted = msgspec.json.decode(body or b"{}", type=kind)
            except (msgspec.MsgspecError, UnicodeDecodeError) as e:
                return refused(400, f"This cannot be asked so: {e}", "use the page, or see docs/how-to/serve.md")
            return JSONResponse(await answer(site, request, wanted))

        return Route(path, endpoint, methods=["POST"])

    return [
        Route("/api/session", _session(site), methods=["POST"]),
        asks("/api/control/{wish}", Request_, _wish),
        asks("/api/plan", PlanRequest, _plan),
        asks("/api/doctor", Request_, _doctor),
        asks("/api/start", StartRequest, _start),
        asks("/api/resume", ResumeRequest, _resume),
        asks("/api/process", ProcessRequest, _process),
        asks("/api/labels", LabelRequest, _labels),
        asks("/api/notes", NotesRequest, _notes),
        asks("/api/train", TrainRequest, _train),
        asks("/api/export", ExportRequest, _export),
    ]


def _session(site: Site) -> Callable[[Request], Awaitable[Response]]:
    async def session(request: Request) -> Response:
        answer = JSONResponse({"what": "opened"})
        name = cookie_name(int((request.scope.get("server") or ("", 0))[1] or 0))
        answer.set_cookie(name, site.access.session, httponly=True, samesite="strict", secure=site.access.secure)
        return answer

    return session


async def _wish(site: Site, request: Request, wanted: Request_) -> dict[str, Any]:
    del wanted
    name = site.name(request)
    try:
        wish = Wish(request.path_params["wish"])
    except ValueError:
        raise UnknownWishError(f"one of {', '.join(Wish)}") from None
    watch = await site.act(site.watches.of, name, site.scans.folder(name))
    await site.act(watch.ask, wish)
    return {"what": "asked"}


async def _plan(site: Site, request: Request, wanted: PlanRequest) -> dict[str, Any]:
    del request
    config = _config(site)
    told = await site.compute(lambda: numbers(forecast(wanted.of(config))))
    rig = load_instrument(config)
    return told | {"rig": rig.name, "config": str(config), "begun_with": to_builtins(rig)["grid"]}


async def _doctor(site: Site, request: Request, wanted: Request_) -> dict[str, Any]:
    del request, wanted
    _check_free(site)
    site.logs.mkdir(exist_ok=True)
    words = ["doctor", "--config", _config(site), "--out", site.scans.root]
    await site.act(_programs(site).start, site.logs, "doctor", words)
    return {"what": "started"}


async def _start(site: Site, request: Request, wanted: StartRequest) -> dict[str, Any]:
    del request
    config, programs = _config(site), _programs(site)
    folder = site.scans.folder(wanted.name, new=True)
    if folder.exists() and any(p.name not in (PROGRAM, NOTES) for p in folder.iterdir()):
        raise ConfigError(f"{wanted.name} is there already", "scans are never overwritten", "give another name")
    rig = wanted.of(config)
    await site.act(_check_free, site)
    more = _material_words(site, wanted.library, wanted.metal)  # refused before anything is written
    if wanted.given:
        config = _write_rig(folder, rig)
    words: list[str | Path] = ["scan", "--out", folder, "--config", config.absolute(), *more]
    if wanted.keep_incomplete:
        words.append("--keep-incomplete")
    if wanted.notes or wanted.tags:
        folder.mkdir(parents=True, exist_ok=True)
        write_notes(folder, Notes(wanted.notes, wanted.tags))
    await site.act(programs.start, folder, "scan", words)
    return {"what": "started", "scan": wanted.name}


def _check_free(site: Site) -> None:
    """Refuse what needs the rig while a program that is known here has it. Raises ScanError."""
    running = [s.name for s in site.scans.list() if s.state in ("running", "paused") or _starting(site, s)]
    if running:
        raise ScanError(f"{running[0]} is being scanned", "a rig does one thing at a time", "wait for it, or stop it")
    doctor = program_of(site.logs, "doctor")
    if doctor is not None and doctor.running:
        raise ScanError("the doctor looks at the rig", "a rig does one thing at a time", "wait until it has ended")


def _starting(site: Site, s: Summary) -> bool:
    """Whether the program of a scan lives though it has not come to its first sign of life, or is processing."""
    program = program_of(site.scans.root / s.name, "scan") if s.state in ("begun", "lost") else None
    return program is not None and program.running


def _write_rig(folder: Path, rig: Instrument) -> Path:
    """The rig file of a scan that differs from the usual one, where its program finds it."""
    path = folder / PROGRAM / RIG
    if path.parent.is_symlink():
        raise ConfigError(f"{path.parent} is a link", "the folder was made by another program", "give another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # a link there would have another file written
    path.write_text(tomli_w.dumps(to_builtins(rig)), encoding="utf-8")
    return path


async def _resume(site: Site, request: Request, wanted: ResumeRequest) -> dict[str, Any]:
    name = site.name(request)
    folder = site.scans.folder(name)
    await site.act(_check_free, site)
    words: list[str | Path] = ["resume", folder.absolute(), *_material_words(site, wanted.library, None)]
    if wanted.keep_incomplete:
        words.append("--keep-incomplete")
    await site.act(_programs(site).start, folder, "scan", words)
    return {"what": "started"}


async def _process(site: Site, request: Request, wanted: ProcessRequest) -> dict[str, Any]:
    folder = site.scans.folder(site.name(request))
    words: list[str | Path] = ["process", folder.absolute(), "--out", folder.absolute() / "products"]
    words += _material_words(site, wanted.library, wanted.metal)
    if wanted.labels:
        found = find_labels(folder)
        if found is None:
            raise ConfigError("no boxes are drawn on this scan", "they were not saved", "draw and save them first")
        words += ["--labels", found[0].absolute()]
    await site.act(_programs(site).start, folder, "process", words)
    return {"what": "started"}


async def _labels(site: Site, request: Request, wanted: LabelRequest) -> dict[str, Any]:
    folder = site.scans.folder(site.name(request))
    products = read_products(folder)
    labels = Labels(wanted.boxes, "mm", wanted.metal or None, wanted.specimens, by_hand=True)
    place = label_folder(products.folder)
    checked, notes = await site.compute(save_labels, place, products, labels)
    return {"what": "saved", "file": str(place / "labels.json"), "metal": checked.metal, "notes": notes}


async def _notes(site: Site, request: Request, wanted: NotesRequest) -> dict[str, Any]:
    written = write_notes(site.scans.folder(site.name(request)), Notes(wanted.notes, wanted.tags))
    return {"what": "saved", "notes": written.notes, "tags": list(written.tags)}


async def _train(site: Site, request: Request, wanted: TrainRequest) -> dict[str, Any]:
    del request
    folders = [site.scans.folder(name).absolute() for name in wanted.scans]
    out = site.scans.root.absolute() / LIBRARIES
    out.mkdir(exist_ok=True)
    site.logs.mkdir(exist_ok=True)
    words = ["train", *folders, "--out", out / f"{wanted.name}.npz"]
    await site.act(_programs(site).start, site.logs, "train", words)
    return {"what": "started"}


async def _export(site: Site, request: Request, wanted: ExportRequest) -> dict[str, Any]:
    folder = site.scans.folder(site.name(request)).absolute()
    unknown = [name for name in wanted.formats if name not in FORMATS]
    if unknown:
        raise ConfigError(f"no format is called {unknown[0][:20]!r}", "the name is wrong", f"of {', '.join(FORMATS)}")
    words = ["export", folder, *(f"--{name}" for name in wanted.formats), "--out", folder / "export"]
    await site.act(_programs(site).start, folder, "export", words)
    return {"what": "started"}


def _material_words(site: Site, library: str, metal: Box | None) -> list[str | Path]:
    """Options of the library and the metal reference."""
    words: list[str | Path] = []
    if library:
        known = site.libraries()
        if library not in known:
            raise ConfigError(f"no library is called {library[:60]!r}", "it was not trained here", "train it first")
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
