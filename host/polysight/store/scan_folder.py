"""The scan folder: raw rows, and the manifest with the committed rows (docs/spec/scan-folder.md).

`ScanFolder` reads a scan; its `writer` opens it for appending. A scan is resumed with the rig file it was begun with.
Only the connection may change: `connection_of` and `with_connection` take addresses and limits from another rig file;
`check_same_scan` refuses one that differs in anything else.
"""

from __future__ import annotations

import os
import platform
import secrets
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture import read_index
from polysight.store import manifest
from polysight.store.logs import crc32, sync_folder
from polysight.store.manifest import (
    MANIFEST,
    BoardRow,
    F,
    Manifest,
    ManifestWriter,
    OtherFact,
    PiDescription,
    RawDropped,
    RowCommitted,
    RowWithdrawn,
    ScanEnded,
    ScanResumed,
    ScanStarted,
    manifest_fault,
)
from polysight.store.source import RowData
from polysight.store.untrusted import check_links, inside
from polysight_shared import __version__
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan
from polysight_shared.tables import decode, to_builtins

SECTIONS = ("pi", "limits")
ADDRESSES = ("card_address", "host_address", "command_port", "data_port")
"""Keys of each board that may change; `radar.servers` has the addresses of their control servers."""
SERIAL = ("port", "baud")
"""Keys of the stage that are not compared: the Pi has its own. Nor is calibration, of which a scan keeps copies."""
FORMAT = 1
EVENTS = "events.msgpack"
TRUTH = "truth.json"  # of a simulated scene: its plates
PART = ".part"  # suffix of a row during reception


def connection_of(rig: Instrument) -> dict[str, Any]:
    """Return the connection settings of a rig file, as `scan_resumed` stores them."""
    table = to_builtins(rig)
    return {
        **{section: table[section] for section in SECTIONS},
        "boards": {b["name"]: {key: b[key] for key in ADDRESSES} for b in table["boards"]},
        "servers": table["radar"]["servers"],
    }


def with_connection(begun: Instrument, connection: Mapping[str, Any]) -> Instrument:
    """Return the rig with other connection settings. Raises ConfigError."""
    return decode(_with(to_builtins(begun), connection), Instrument, "scan_resumed")


def check_same_scan(begun: Instrument, given: Instrument, name: str) -> None:
    """Check that a rig file differs from the one a scan was begun with only in the connection settings.

    Raises
    ------
    ConfigError
        with every other key that differs; `name` is the rig file's in the message.
    """
    table, other = to_builtins(begun), _with(to_builtins(given), connection_of(begun))
    other["stage"] = {**other["stage"], **{key: table["stage"][key] for key in SERIAL}}
    other["calibration"] = table["calibration"]
    found = list(_differences(table, other, ""))
    if found:
        raise ConfigError(
            f"{name} is not the rig file of this scan: {'; '.join(found)}",
            "a scan is resumed with its own settings: only [pi], [limits] and the addresses of the boards may change",
            "restore these values, or start a new scan",
            code=ErrorCode.VALUES_CONFLICT,
        )


def _with(table: dict[str, Any], connection: Mapping[str, Any]) -> dict[str, Any]:
    boards = [{**b, **connection["boards"].get(b["name"], {})} for b in table["boards"]]
    radar = {**table["radar"], "servers": connection["servers"]}
    return {**table, **{section: connection[section] for section in SECTIONS}, "boards": boards, "radar": radar}


def _differences(begun: Any, given: Any, key: str) -> Iterator[str]:
    """Yield `key is A in the scan and B there` for every value that differs."""
    if isinstance(begun, dict) and isinstance(given, dict):
        for name in dict.fromkeys([*begun, *given]):
            yield from _differences(begun.get(name), given.get(name), f"{key}.{name}".lstrip("."))
    elif isinstance(begun, list) and isinstance(given, list) and len(begun) == len(given):
        for k, pair in enumerate(zip(begun, given, strict=True)):
            yield from _differences(*pair, f"{key}[{k}]")
    elif begun != given:
        here, there = ("not given" if value is None else repr(value) for value in (begun, given))
        yield f"{key} is {here} in the scan and {there} there"


def new_scan_id(now: datetime | None = None) -> str:
    """Return a scan id: the start time and four random hex digits."""
    now = now or datetime.now(UTC)
    return f"{now:%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"


def versions() -> dict[str, str]:
    """Return the releases of all software that affects the data."""
    found = {"python": platform.python_version(), "numpy": np.__version__, "polysight": __version__}
    return found | {package: _release(package) for package in ("scipy", "scikit-learn")}


@cache
def _release(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


class ScanFolder:
    """A scan on disk. Construct with :meth:`create` or :meth:`load`; :meth:`writer` opens it for appending."""

    mirrored = False
    synchronised = False

    def __init__(self, path: Path, content: Manifest) -> None:
        self.path = path
        self.content = content
        self._rows: tuple[Manifest, int, dict[int, RowCommitted]] | None = None
        for number, fact in content.problems:
            if fact.kind == "scan_started":
                raise self._unreadable(number, fact)
        if content.started is None:
            raise DataError(
                f"{path / MANIFEST}: no scan_started",
                "the scan ended before its first line was written, or that line is damaged",
                f"restore it from a copy: without it rig and plan are unknown; if {path} is otherwise empty, nothing"
                " was recorded, and `polysight scan` may use the folder again",
                code=ErrorCode.FILE_DAMAGED,
            )
        self.started: ScanStarted = content.started
        source = f"{path / MANIFEST} (scan_started) instrument"
        self._begun: Instrument = decode(self.started.instrument, Instrument, source)
        self.plan: RasterPlan = self.started.plan
        self.scan_id = self.started.scan_id
        self.simulated = self.started.simulated
        self.instrument = self._latest()

    def _unreadable(self, number: int, fact: OtherFact) -> ConfigError:
        return ConfigError(
            f"{self.path / MANIFEST} line {number} ({fact.kind}): {fact.problem}",
            "written by another program or release",
            "restore it from a copy",
            code=ErrorCode.VALUE_INVALID,
        )

    def _latest(self) -> Instrument:
        """Return the scan's rig with the connection settings of the last resume. Raises ConfigError."""
        connections = [fact.rig for fact in self.facts(ScanResumed) if fact.rig]
        return with_connection(self._begun, connections[-1]) if connections else self._begun

    @staticmethod
    def create(
        path: Path,
        instrument: Instrument,
        plan: RasterPlan,
        *,
        simulated: bool = False,
        scan_id: str = "",
        pi: PiDescription | None = None,
        calibration: Mapping[str, Any] | None = None,
    ) -> ScanFolder:
        """Create a scan folder with its first fact, durably.

        Raises
        ------
        DeviceError
            if the folder contains a scan already or cannot be written.
        """
        fact = ScanStarted(
            format=FORMAT,
            scan_id=scan_id or new_scan_id(),
            simulated=simulated,
            started_utc=utc_now(),
            instrument=to_builtins(instrument),
            plan=plan,
            versions=versions(),
            pi=pi,
            calibration=calibration,
        )
        _make_folder(path)
        if (path / MANIFEST).exists() and not manifest.read(path / MANIFEST).length:
            (path / MANIFEST).unlink()  # left by a start that ended before its first line
        with ManifestWriter(path / MANIFEST, create=True) as writer:
            writer.append(fact)
        return ScanFolder.load(path)

    @staticmethod
    def load(path: Path) -> ScanFolder:
        """Read a scan folder. Raises DataError or ConfigError if it is not one, or links lead out of it."""
        if (path / MANIFEST).exists():
            check_links(path)
        return ScanFolder(path, manifest.read(path / MANIFEST))

    def reload(self) -> None:
        """Read the manifest again."""
        self.content = manifest.read(self.path / MANIFEST)
        self.instrument = self._latest()

    def writer(self) -> ManifestWriter:
        """Open the scan for appending and cut off a torn last line. Raises DeviceError if the scan is in use."""
        writer = ManifestWriter(self.path / MANIFEST, create=False)
        try:
            for board in self.instrument.recorded:
                _make_folder(self.path / "raw" / board.name)
        except DeviceError:
            writer.close()
            raise
        return writer

    def facts(self, kind: type[F]) -> list[F]:
        """Return all facts of one kind, in order."""
        return self.content.of_kind(kind)

    def committed(self) -> dict[int, RowCommitted]:
        """Return committed rows by index: the last committed take of each row, unless it was withdrawn.

        Raises DataError if the manifest names a file outside `raw`, ConfigError for a row of another form.
        """
        return dict(self._committed())

    def _committed(self) -> dict[int, RowCommitted]:
        """Return the committed rows from a cache, which is valid until facts are added."""
        if self._rows is None or self._rows[0] is not self.content or self._rows[1] != len(self.content.facts):
            for number, fact in self.content.problems:
                if fact.kind in ("row_committed", "row_withdrawn"):
                    raise self._unreadable(number, fact)
            for fact in self.facts(RowCommitted):
                for board in fact.boards.values():
                    inside(self.path, board.file, "raw")
            self._rows = (self.content, len(self.content.facts), dict(sorted(self.content.rows.copy().items())))
        return self._rows[2]

    @property
    def manifest_faults(self) -> tuple[Finding, ...]:
        """Damaged and missing lines of the manifest, and a `scan_ended` that counts more rows than are committed."""
        content = self.content
        faults = tuple(content.faults)
        ends = [k for k, fact in enumerate(content.facts) if isinstance(fact, ScanEnded)]
        if not ends:
            return faults
        last = ends[-1]
        counted = self.facts(ScanEnded)[-1].rows_committed
        if counted is None or counted <= len(self._committed()):
            return faults
        # Rows that were later withdrawn, or taken again, were committed then.
        rows = {fact.row for fact in content.facts[:last] if isinstance(fact, RowCommitted)} | {*self._committed()}
        lost = counted - len(rows)
        if lost <= sum(fault.facts["lost"] for fault in faults):
            return faults
        what = f"scan_ended counts {counted} rows, the lines before it commit {len(rows)}"
        return (*faults, manifest_fault(content.numbers[last], what, lost))

    @property
    def rows_absent(self) -> list[int]:
        """Rows of the plan that are not committed."""
        return [row for row in range(self.plan.rows) if row not in self._committed()]

    def recording_facts(self) -> dict[str, Any]:
        """Return `rows_retaken` (rejected takes of all runs) and `rows_incomplete` for quality.json."""
        return {
            "rows_retaken": len(self.content.rejected),
            "rows_incomplete": [row for row, fact in self._committed().items() if fact.kept_incomplete],
        }

    def rows(self) -> Iterator[int]:
        """Indices of the committed rows, ascending."""
        return iter(self.committed())

    @property
    def complete(self) -> bool:
        """True if every row of the plan is committed."""
        return len(self.committed()) == self.plan.rows

    def row_path(self, board: str, row: int) -> Path:
        """Return the path of a row's payload."""
        return self.path / "raw" / board / f"{row:04d}.bin"

    def read_row(self, board_name: str, row: int) -> RowData:
        """Return one board's recording of a committed row; its payload is read, and its CRC checked, when it is used.

        Raises
        ------
        DataError
            if the row is not committed or its index is damaged; when the payload is used: if it is missing or damaged.
        """
        found = self._committed().get(row)
        board = None if found is None else found.boards.get(board_name)
        if board is None:
            raise DataError(
                f"{self.path}: row {row} of {board_name} is not committed",
                "the scan was interrupted before it, or the board was not recorded",
                f"`polysight resume {self.path}` takes the rows that are missing",
                code=ErrorCode.NO_DATA,
            )
        path = self.path / board.file
        chirps = board.frames_expected * self.instrument.burst.chirps
        missing = self._missing(path.with_suffix(".idx"), board)
        return RowData(partial(self._read_pieces, path, board), missing, chirps, board.crc32)

    def _read_pieces(self, path: Path, board: BoardRow, size: int) -> Iterator[NDArray[np.uint8]]:
        """Read a payload in pieces of `size` bytes (0: everything), all in the same memory, and check its CRC."""
        digest, memory = 0, np.empty(min(size, board.bytes) or board.bytes or 1, np.uint8)
        try:
            with path.open("rb") as file:
                found = os.fstat(file.fileno()).st_size
                for start in range(0, board.bytes if found == board.bytes else 0, memory.size):
                    piece = memory[: board.bytes - start]
                    file.readinto(piece.data)
                    digest = crc32(piece, digest)
                    yield piece
        except OSError as e:
            what = f"{path}: cannot be read: {e.strerror}"
            raise DataError(what, "the file was removed", self._remedy(), code=ErrorCode.FILE_MISSING) from None
        if found != board.bytes or f"{digest:08x}" != board.crc32:
            raise DataError(
                f"{path}: differs from the committed data ({found} bytes, {board.bytes} expected)",
                "the file was changed, truncated or damaged after the scan",
                self._remedy(),
                code=ErrorCode.FILE_DAMAGED,
            )

    def _missing(self, path: Path, board: BoardRow) -> list[tuple[int, int]]:
        if board.missing_bytes == 0:
            return []
        facts, _ = read_index(path)
        missing = [(int(a), int(b)) for a, b in facts.get("missing", [])]
        damaged = board.index_crc32 and f"{crc32(path.read_bytes()):08x}" != board.index_crc32
        if damaged or sum(b - a for a, b in missing) != board.missing_bytes:
            what = f"{path}: differs from the committed index"
            raise DataError(what, "the file was changed", self._remedy(), code=ErrorCode.FILE_DAMAGED)
        return missing

    def _remedy(self) -> str:
        return (
            f"restore it from a copy, or `polysight resume {self.path}` takes its row again;"
            f" `polysight validate {self.path}` names every damaged file"
        )


def dropped_files(scan: ScanFolder) -> dict[str, RawDropped]:
    """Return the payload files (relative to the scan folder) that were dropped, each with its fact."""
    files: dict[str, RawDropped] = {}
    for fact in scan.content.facts:
        if isinstance(fact, RowCommitted | RowWithdrawn):  # taken again, with new files
            files = {file: dropped for file, dropped in files.items() if dropped.row != fact.row}
        elif isinstance(fact, RawDropped):
            files |= {board.file: fact for board in fact.boards.values()}
    return files


def dropped_rows(scan: ScanFolder) -> set[int]:
    """Return the rows of which a dropped file is gone."""
    return {fact.row for file, fact in dropped_files(scan).items() if not (scan.path / file).exists()}


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it, durably. Raises DeviceError."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as e:
        what, why = f"{folder}: cannot be made: {e.strerror}", "the disk is full or read-only"
        raise DeviceError(what, why, "free space, or choose another folder", code=ErrorCode.FILE_UNWRITABLE) from None
    sync_folder(folder.parent)


def utc_now() -> str:
    """Return the present time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
