"""The scan folder: raw rows and the manifest that says which of them count (docs/spec/scan-folder.md).

`ScanFolder` is a scan on disk, read; its `writer` opens it for appending. A scan is resumed with the rig file it was
begun with. Only the connection may differ: `connection_of` and `reconnected` take addresses and limits from another rig
file, and `check_same_scan` refuses one that differs in anything else.
"""

from __future__ import annotations

import platform
import secrets
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polysight.host.capture import read_index
from polysight.host.store import manifest
from polysight.host.store.append_only import crc32, sync_folder
from polysight.host.store.manifest import Fact, Manifest, ManifestFault, ManifestWriter
from polysight.host.store.source import RowData
from polysight.host.store.untrusted import check_links, inside
from polysight.shared import __version__
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError, DataError, DeviceError
from polysight.shared.raster import RasterPlan
from polysight.shared.tables import decode, to_builtins
from polysight.shared.tables import decode as decode_config

SECTIONS = ("pi", "limits")
ADDRESSES = ("card_address", "host_address", "command_port", "data_port")
"""Of each board; `radar.servers` holds the addresses of their control servers."""


SERIAL = ("port", "baud")
"""Of the stage: the Pi has its own. Calibration is not compared either: a scan keeps copies of its files."""
FORMAT = 1
MANIFEST = "manifest.jsonl"
EVENTS = "events.msgpack"
PART = ".part"  # suffix of a row that is being received


def connection_of(rig: Instrument) -> dict[str, Any]:
    """That part of a rig file, as `scan_resumed` records it."""
    table = to_builtins(rig)
    return {
        **{section: table[section] for section in SECTIONS},
        "boards": {b["name"]: {key: b[key] for key in ADDRESSES} for b in table["boards"]},
        "servers": table["radar"]["servers"],
    }


def reconnected(begun: Instrument, connection: Mapping[str, Any]) -> Instrument:
    """The rig a scan was begun with, reached another way. Raises ConfigError."""
    return decode(_with(to_builtins(begun), connection), Instrument, "scan_resumed")


def check_same_scan(begun: Instrument, given: Instrument, name: str) -> None:
    """Refuse a rig file that differs in more than that from the one a scan was begun with; `name` is for the message.

    Raises
    ------
    ConfigError
        naming every key in which it does.
    """
    table, other = to_builtins(begun), _with(to_builtins(given), connection_of(begun))
    other["stage"] = {**other["stage"], **{key: table["stage"][key] for key in SERIAL}}
    other["calibration"] = table["calibration"]
    found = list(_differences(table, other, ""))
    if found:
        raise ConfigError(
            f"{name} is not the rig file of this scan: {'; '.join(found)}",
            "a scan goes on as it was begun: only [pi], [limits] and the addresses of the boards may change",
            "put these back; what has to change needs a new scan",
        )


def _with(table: dict[str, Any], connection: Mapping[str, Any]) -> dict[str, Any]:
    boards = [{**b, **connection["boards"].get(b["name"], {})} for b in table["boards"]]
    radar = {**table["radar"], "servers": connection["servers"]}
    return {**table, **{section: connection[section] for section in SECTIONS}, "boards": boards, "radar": radar}


def _differences(begun: Any, given: Any, key: str) -> Iterator[str]:
    """`key is A in the scan, B in the file`, for every number or text."""
    if isinstance(begun, dict) and isinstance(given, dict):
        for name in dict.fromkeys([*begun, *given]):
            yield from _differences(begun.get(name), given.get(name), f"{key}.{name}".lstrip("."))
    elif isinstance(begun, list) and isinstance(given, list) and len(begun) == len(given):
        for k, pair in enumerate(zip(begun, given, strict=True)):
            yield from _differences(*pair, f"{key}[{k}]")
    elif begun != given:
        yield f"{key} is {_told(begun)} in the scan and {_told(given)} there"


def _told(value: Any) -> str:
    return "not given" if value is None else repr(value)


class BoardRow(msgspec.Struct, frozen=True):
    """One board's share of a committed row. `file` is relative to the scan folder; the index is beside it."""

    file: str
    bytes: int
    frames_expected: int
    frames_received: int
    missing_bytes: int
    crc32: str
    index_crc32: str = ""
    packets_crc32: str = ""


class CommittedRow(msgspec.Struct, frozen=True):
    """A row that counts."""

    row: int
    take: int
    direction: int
    boards: dict[str, BoardRow]
    pulses: int


def new_scan_id(now: datetime | None = None) -> str:
    """A scan's name: when it started, and four hex digits against a second one in that second."""
    now = now or datetime.now(UTC)
    return f"{now:%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"


def versions() -> dict[str, str]:
    """Releases of everything that shapes the data."""
    found = {"python": platform.python_version(), "numpy": np.__version__, "polysight": __version__}
    return found | {package: _release(package) for package in ("scipy", "scikit-learn")}


@cache
def _release(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


class ScanFolder:
    """A scan on disk, read. Build with :meth:`create` or :meth:`load`; :meth:`writer` opens it for appending."""

    mirrored = False
    synchronised = False

    def __init__(self, path: Path, content: Manifest) -> None:
        self.path = path
        self.content = content
        self._rows: tuple[Manifest, int, dict[int, CommittedRow]] | None = None
        started = next((f for f in content.facts if f["fact"] == "scan_started"), None)
        if started is None:
            raise DataError(
                f"{path / MANIFEST}: no scan_started",
                "the scan ended before its first line was written, or that line is damaged",
                f"restore it from a copy: without it rig and plan are unknown; when {path} is otherwise empty, nothing"
                " was recorded, and `polysight scan` begins there anew",
            )
        source = f"{path / MANIFEST} (scan_started)"
        try:
            self._begun: Instrument = decode_config(started["instrument"], Instrument, f"{source} instrument")
            self.plan: RasterPlan = decode_config(started["plan"], RasterPlan, f"{source} plan")
            self.scan_id = str(started["scan_id"])
            self.simulated = bool(started["simulated"])
        except KeyError as e:
            raise DataError(f"{source}: no {e}", "written by another program or release") from None
        self.instrument = self._latest()

    def _latest(self) -> Instrument:
        """The rig as it was begun with, reached as the last run that said so reached it. Raises ConfigError."""
        told = [f["rig"] for f in self.facts("scan_resumed") if f.get("rig")]
        return reconnected(self._begun, told[-1]) if told else self._begun

    @staticmethod
    def create(
        path: Path,
        instrument: Instrument,
        plan: RasterPlan,
        *,
        simulated: bool = False,
        scan_id: str = "",
        extra: dict[str, Any] | None = None,
    ) -> ScanFolder:
        """Make a scan folder with its first fact, durably. `extra` adds keys to that fact (calibration, operator...).

        Raises
        ------
        DeviceError
            if the folder holds a scan already or cannot be written.
        """
        fact: Fact = {
            **(extra or {}),
            "fact": "scan_started",
            "format": FORMAT,
            "scan_id": scan_id or new_scan_id(),
            "simulated": simulated,
            "started_utc": utc_now(),
            "instrument": to_builtins(instrument),
            "plan": msgspec.to_builtins(plan),
            "versions": versions(),
        }
        _make(path)
        if (path / MANIFEST).exists() and not manifest.read(path / MANIFEST).length:
            (path / MANIFEST).unlink()  # an earlier start ended before its first line was written
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
        """Open the scan for appending; a torn last line is cut off. Raises DeviceError if the scan is in use."""
        writer = ManifestWriter(self.path / MANIFEST, create=False)
        try:
            for board in self.instrument.recorded:
                _make(self.path / "raw" / board.name)
        except DeviceError:
            writer.close()
            raise
        return writer

    def facts(self, kind: str) -> list[Fact]:
        """All facts of one kind, in order."""
        return [f for f in self.content.facts if f["fact"] == kind]

    def committed(self) -> dict[int, CommittedRow]:
        """Committed rows by index; the last valid take wins, unless it was withdrawn.

        Raises DataError where the manifest names a file outside `raw`.
        """
        return dict(self._committed())

    def _committed(self) -> dict[int, CommittedRow]:
        """The same, made once for the facts at hand: reading a scan asks for every row."""
        if self._rows is None or self._rows[0] is not self.content or self._rows[1] != len(self.content.facts):
            self._rows = (self.content, len(self.content.facts), self._count_rows(self.content.facts))
        return self._rows[2]

    def _count_rows(self, facts: Iterable[Fact]) -> dict[int, CommittedRow]:
        rows: dict[int, CommittedRow] = {}
        for fact in facts:
            if fact["fact"] == "row_withdrawn":
                rows.pop(fact["row"], None)
            if fact["fact"] != "row_committed":
                continue
            row = decode_config(
                {k: fact.get(k) for k in CommittedRow.__struct_fields__}, CommittedRow, f"{self.path / MANIFEST}"
            )
            for board in row.boards.values():
                inside(self.path, board.file, "raw")
            rows[row.row] = row
        return dict(sorted(rows.items()))

    @property
    def manifest_faults(self) -> tuple[ManifestFault, ...]:
        """Lines of the manifest that are damaged or missing, and an end that counts more rows than there are."""
        content = self.content
        end = next((k for k in reversed(range(len(content.facts))) if content.facts[k]["fact"] == "scan_ended"), None)
        told = None if end is None else content.facts[end].get("rows_committed")
        if end is None or not isinstance(told, int) or told <= len(self._committed()):
            return tuple(content.faults)
        known = {*self._count_rows(content.facts[:end]), *self._committed()}  # later withdrawn, or taken again
        lost = told - len(known)
        if lost <= sum(fault.lost for fault in content.faults):
            return tuple(content.faults)
        what = f"scan_ended counts {told} rows, the lines before it commit {len(known)}"
        return (*content.faults, ManifestFault(content.numbers[end], what, lost))

    @property
    def rows_absent(self) -> list[int]:
        """Rows of the plan that are not committed."""
        return [row for row in range(self.plan.rows) if row not in self._committed()]

    def recording_facts(self) -> dict[str, Any]:
        """For quality.json: `rows_retaken`, takes of all runs that did not count; `rows_incomplete`, rows kept so."""
        last = {f["row"]: f for f in self.facts("row_committed") if f["row"] in self._committed()}
        return {
            "rows_retaken": len(self.facts("row_rejected")),
            "rows_incomplete": sorted(row for row, fact in last.items() if fact.get("kept_incomplete")),
        }

    def rows(self) -> Iterator[int]:
        """Indices of the committed rows, ascending."""
        return iter(self.committed())

    @property
    def complete(self) -> bool:
        """True if every row of the plan is committed."""
        return len(self.committed()) == self.plan.rows

    def row_path(self, board: str, row: int) -> Path:
        """Where a committed row's payload is."""
        return self.path / "raw" / board / f"{row:04d}.bin"

    def read_row(self, board_name: str, row: int) -> RowData:
        """One board's payload of a committed row, checked against its CRC.

        Raises
        ------
        DataError
            if the row is not committed, or its files are absent or damaged.
        """
        found = self._committed().get(row)
        board = None if found is None else found.boards.get(board_name)
        if board is None:
            raise DataError(
                f"{self.path}: row {row} of {board_name} is not committed",
                "the scan was interrupted before it, or the board was not recorded",
                f"`polysight resume {self.path}` takes the rows that are missing",
            )
        path = self.path / board.file
        try:
            size = path.stat().st_size
            payload = np.fromfile(path, dtype=np.uint8, count=-1 if size == board.bytes else 0)
        except OSError as e:
            raise DataError(f"{path}: cannot be read: {e.strerror}", "the file was removed", self._remedy()) from None
        if payload.size != board.bytes or f"{crc32(payload.data):08x}" != board.crc32:
            raise DataError(
                f"{path}: not the bytes that were committed ({size} bytes, {board.bytes} expected)",
                "the file was changed, truncated or damaged after the scan",
                self._remedy(),
            )
        chirps = board.frames_expected * self.instrument.burst.chirps
        return RowData(payload, self._missing(path.with_suffix(".idx"), board), chirps, board.crc32)

    def _missing(self, path: Path, board: BoardRow) -> list[tuple[int, int]]:
        if board.missing_bytes == 0:
            return []
        facts, _ = read_index(path)
        missing = [(int(a), int(b)) for a, b in facts.get("missing", [])]
        damaged = board.index_crc32 and f"{crc32(path.read_bytes()):08x}" != board.index_crc32
        if damaged or sum(b - a for a, b in missing) != board.missing_bytes:
            raise DataError(f"{path}: not the index that was committed", "the file was changed", self._remedy())
        return missing

    def _remedy(self) -> str:
        return (
            f"restore it from a copy, or `polysight resume {self.path}` takes its row again;"
            f" `polysight validate {self.path}` names every damaged file"
        )


def _make(folder: Path) -> None:
    """Make a folder and those above it, durably. Raises DeviceError."""
    if folder.is_dir():
        return
    _make(folder.parent)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as e:
        raise DeviceError(
            f"{folder}: cannot be made: {e.strerror}",
            "the disk is full or read-only",
            "free space, or choose another folder",
        ) from None
    sync_folder(folder.parent)


def utc_now() -> str:
    """The time for people, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
