"""The scan folder: raw rows, the manifest with the committed rows (docs/spec/scan-folder.md), and kept samples.

A fact is one line of the manifest. A take is one recording of a row; a fact commits it once its files are durable.

`ScanFolder` reads a scan; its `writer` opens it for appending. A scan is resumed with the rig file it was begun with.
Only the connection may change: `extract_connection` and `with_connection` take addresses and limits from another rig
file; `check_same_scan` refuses one that differs in anything else. A folder may come from anywhere: `check_inside` and
`check_links` refuse names and links that lead out of it, `open_npz` refuses oversized arrays.

Kept samples (docs/spec/samples.md) are the synchronised rows, cut to the ranges of the image: small, and enough to make
images when the raw rows are dropped. `process/rows.py` makes and restores them. What their files say of themselves is
read here, without the processing, so that `validate` and `drop-raw` check them.
"""

from __future__ import annotations

import errno
import os
import platform
import secrets
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.capture import read_index, recognise_format
from polysight.store import manifest
from polysight.store.logs import crc32
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
    lock_file,
    make_manifest_fault,
)
from polysight.store.source import HEADER_LOCK, RowData, allocate_pages
from polysight_shared import __version__
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, quote
from polysight_shared.files import open_regular, sync_folder
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan
from polysight_shared.tables import decode, to_builtins

# Sections of the rig file that may change when a scan is resumed.
CHANGEABLE_SECTIONS = ("pi", "limits")
CHANGEABLE_BOARD_KEYS = ("card_address", "host_address", "command_port", "data_port")
"""Keys of each board that may change; `radar.servers` has the addresses of their control servers."""
UNCOMPARED_STAGE_KEYS = ("port", "baud")
"""Keys of the stage that are not compared: the Pi has its own. Nor is calibration, of which a scan keeps copies."""
# Format of the folder, in `scan_started`.
FORMAT = 1
# File with the Pi's events.
EVENTS = "events.msgpack"
# File with the plates of a simulated scene.
TRUTH = "truth.json"
# Folder of the kept samples, and the file in it that lists the rows.
SAMPLES = "samples"
SAMPLE_ROWS = "rows.jsonl"
# Suffix of a row during reception.
PART_SUFFIX = ".part"

# The one entry of a scan folder that may be a link out of it, see `check_links`.
_MAY_BE_LINK = "products"
MAX_BYTES = 2 << 30
"""Largest size of the arrays in one archive (chosen): thousands of times the images of the published scan."""


def extract_connection(rig: Instrument) -> dict[str, Any]:
    """Return the connection settings of a rig file, as `scan_resumed` stores them."""
    table = to_builtins(rig)
    return {
        **{section: table[section] for section in CHANGEABLE_SECTIONS},
        "boards": {b["name"]: {key: b[key] for key in CHANGEABLE_BOARD_KEYS} for b in table["boards"]},
        "servers": table["radar"]["servers"],
    }


def with_connection(begun: Instrument, connection: Mapping[str, Any]) -> Instrument:
    """Return the rig with other connection settings. Raises ConfigError."""
    return decode(_replace_connection(to_builtins(begun), connection), Instrument, "scan_resumed")


def check_same_scan(begun: Instrument, rig_file: Instrument, name: str) -> None:
    """Check that a rig file differs from the one a scan was begun with only in the connection settings.

    Raises
    ------
    ConfigError
        with every other key that differs; `name` is the rig file's in the message.
    """
    table = to_builtins(begun)
    given_table = _replace_connection(to_builtins(rig_file), extract_connection(begun))
    given_table["stage"] = {**given_table["stage"], **{key: table["stage"][key] for key in UNCOMPARED_STAGE_KEYS}}
    given_table["calibration"] = table["calibration"]
    differences = list(_list_differences(table, given_table, ""))
    if differences:
        raise ConfigError(
            f"{name} is not the rig file of this scan: {'; '.join(differences)}",
            "a scan is resumed with its own settings: only [pi], [limits] and the addresses of the boards may change",
            "restore these values, or start a new scan",
            code=ErrorCode.VALUES_CONFLICT,
        )


def _replace_connection(table: dict[str, Any], connection: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rig's table with other connection settings, as of :func:`extract_connection`."""
    boards = [{**b, **connection["boards"].get(b["name"], {})} for b in table["boards"]]
    radar = {**table["radar"], "servers": connection["servers"]}
    return {
        **table,
        **{section: connection[section] for section in CHANGEABLE_SECTIONS},
        "boards": boards,
        "radar": radar,
    }


def _list_differences(begun: Any, rig_value: Any, key: str) -> Iterator[str]:
    """Yield `key is A in the scan and B there` for every value that differs."""
    if isinstance(begun, dict) and isinstance(rig_value, dict):
        for name in dict.fromkeys([*begun, *rig_value]):
            yield from _list_differences(begun.get(name), rig_value.get(name), f"{key}.{name}".lstrip("."))
    elif isinstance(begun, list) and isinstance(rig_value, list) and len(begun) == len(rig_value):
        for k, pair in enumerate(zip(begun, rig_value, strict=True)):
            yield from _list_differences(*pair, f"{key}[{k}]")
    elif begun != rig_value:
        yield f"{key} is {_describe_value(begun)} in the scan and {_describe_value(rig_value)} there"


def _describe_value(value: Any) -> str:
    if value is None:
        return "not given"
    return repr(value)


def make_scan_id() -> str:
    """Return a scan id: the start time and four random hex digits."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"


def versions() -> dict[str, str]:
    """Return the releases of the software that affects the data, by name."""
    releases = {"python": platform.python_version(), "numpy": np.__version__, "polysight": __version__}
    return releases | {package: _release(package) for package in ("scipy", "scikit-learn")}


@cache
def _release(package: str) -> str:
    """Return the release of an installed package as text."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


class _CachedRows(NamedTuple):
    """Committed rows by index, with the manifest that they were read from and its number of facts just before."""

    content: Manifest
    facts: int
    rows: dict[int, RowCommitted]


class ScanFolder:
    """A scan on disk. Construct with :meth:`create` or :meth:`load`; :meth:`writer` opens it for appending.

    `content` is the manifest as last read, `started` its first fact, `instrument` the rig with the connection settings
    of the last resume.
    """

    # Attributes that every `Source` has: rows run along the stage's x, and the chirps are those that the boards
    # recorded.
    mirrored = False
    synchronised = False

    def __init__(self, path: Path, content: Manifest) -> None:
        self.path = path
        self.content = content
        # One value, because several threads read it; None before the first reading.
        self._cached_rows: _CachedRows | None = None
        for number, fact in content.problems:
            if fact.kind == "scan_started":
                raise self._unreadable_error(number, fact)
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
        self.instrument = self._read_latest_rig()

    def _unreadable_error(self, number: int, fact: OtherFact) -> ConfigError:
        """Return the error for a fact, in line `number` of the manifest, whose keys are not those of its kind."""
        return ConfigError(
            f"{self.path / MANIFEST} line {number} ({fact.kind}): {fact.problem}",
            "written by another program or release",
            "restore it from a copy",
            code=ErrorCode.VALUE_INVALID,
        )

    def _read_latest_rig(self) -> Instrument:
        """Return the scan's rig with the connection settings of the last resume. Raises ConfigError."""
        connections = [fact.rig for fact in self.facts(ScanResumed) if fact.rig]
        if connections:
            return with_connection(self._begun, connections[-1])
        return self._begun

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
            scan_id=scan_id or make_scan_id(),
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
            # A start that was interrupted before its first line left an empty manifest.
            (path / MANIFEST).unlink()
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
        self.instrument = self._read_latest_rig()

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

    def committed_rows(self) -> dict[int, RowCommitted]:
        """Return committed rows by index: the last committed take of each row, unless it was withdrawn.

        Raises DataError if the manifest names a file outside `raw`, ConfigError for a row of another form.
        """
        return dict(self._read_cached_rows())

    def _read_cached_rows(self) -> dict[int, RowCommitted]:
        """Return the committed rows from a cache, which is valid until facts are added.

        Raises DataError if a committed row cannot be read.
        """
        # Another thread may add a row meanwhile: first the row, then its fact. Therefore facts are counted before the
        # rows are copied: a row that comes after the copy changes the number of facts, and is found the next time.
        content = self.content
        facts = len(content.facts)
        cached = self._cached_rows
        if cached is None or cached.content is not content or cached.facts != facts:
            for number, fact in content.problems:
                if fact.kind in ("row_committed", "row_withdrawn"):
                    raise self._unreadable_error(number, fact)
            for fact in self.facts(RowCommitted):
                for board in fact.boards.values():
                    check_inside(self.path, board.file, "raw")
            cached = _CachedRows(content, facts, rows=dict(sorted(content.rows.copy().items())))
            self._cached_rows = cached
        return cached.rows

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
        if counted is None or counted <= len(self._read_cached_rows()):
            return faults
        # Rows that were later withdrawn, or taken again, were committed then.
        rows = {fact.row for fact in content.facts[:last] if isinstance(fact, RowCommitted)} | {
            *self._read_cached_rows()
        }
        lost_rows = counted - len(rows)
        # The faults found so far account for that many lines.
        if lost_rows <= sum(fault.facts["lost"] for fault in faults):
            return faults
        problem = f"scan_ended counts {counted} rows, the lines before it commit {len(rows)}"
        return (*faults, make_manifest_fault(content.numbers[last], problem, lost_rows))

    @property
    def rows_absent(self) -> list[int]:
        """Rows of the plan that are not committed."""
        return [row for row in range(self.plan.rows) if row not in self._read_cached_rows()]

    def recording_facts(self) -> dict[str, Any]:
        """Return `rows_retaken` (rejected takes of all runs) and `rows_incomplete` for quality.json."""
        return {
            "rows_retaken": len(self.content.rejected),
            "rows_incomplete": [row for row, fact in self._read_cached_rows().items() if fact.kept_incomplete],
        }

    def rows(self) -> Iterator[int]:
        """Return the indices of the committed rows, ascending."""
        return iter(self.committed_rows())

    @property
    def complete(self) -> bool:
        """True if every row of the plan is committed."""
        return len(self.committed_rows()) == self.plan.rows

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
        committed = self._read_cached_rows().get(row)
        board = None
        if committed is not None:
            board = committed.boards.get(board_name)
        if board is None:
            raise DataError(
                f"{self.path}: row {row} of {board_name} is not committed",
                "the scan was interrupted before it, or the board was not recorded",
                f"`polysight resume {quote(self.path)}` records the missing rows",
                code=ErrorCode.NO_DATA,
            )
        path = self.path / board.file
        chirps = board.frames_expected * self.instrument.burst.chirps
        missing = self._read_missing(path.with_suffix(".idx"), board)
        return RowData(partial(self._read_pieces, path, board), missing, chirps, board.crc32)

    def _read_pieces(self, path: Path, board: BoardRow, size: int) -> Iterator[NDArray[np.uint8]]:
        """Read a payload in pieces of `size` bytes (0: everything), all in the same memory, and check its CRC."""
        digest = 0
        # It is the step of the loop below: at least one byte, also if the file is to be empty.
        piece_bytes = min(size, board.bytes) or board.bytes or 1
        memory = allocate_pages(piece_bytes)
        try:
            with path.open("rb") as file:
                size_on_disk = os.fstat(file.fileno()).st_size
                # A file of another size is refused below, unread.
                bytes_to_read = 0
                if size_on_disk == board.bytes:
                    bytes_to_read = board.bytes
                for start in range(0, bytes_to_read, memory.size):
                    piece = memory[: board.bytes - start]
                    file.readinto(piece.data)
                    digest = crc32(piece.data, digest)
                    yield piece
        except OSError as e:
            problem = f"{path}: cannot be read: {e.strerror}"
            raise DataError(
                problem, "the file was removed", self._suggest_remedy(), code=ErrorCode.FILE_MISSING
            ) from None
        if size_on_disk != board.bytes or f"{digest:08x}" != board.crc32:
            raise DataError(
                f"{path}: differs from the committed data ({size_on_disk} bytes, {board.bytes} expected)",
                "the file was changed, truncated or damaged after the scan",
                self._suggest_remedy(),
                code=ErrorCode.FILE_DAMAGED,
            )

    def _read_missing(self, path: Path, board: BoardRow) -> list[tuple[int, int]]:
        """Return a row's missing byte ranges from its index `path`. Raises DataError if that is not as committed."""
        if board.missing_bytes == 0:
            return []
        facts, _ = read_index(path)
        missing = [(int(a), int(b)) for a, b in facts.get("missing", [])]
        damaged = board.index_crc32 and f"{crc32(path.read_bytes()):08x}" != board.index_crc32
        if damaged or sum(b - a for a, b in missing) != board.missing_bytes:
            problem = f"{path}: differs from the committed index"
            raise DataError(problem, "the file was changed", self._suggest_remedy(), code=ErrorCode.FILE_DAMAGED)
        return missing

    def _suggest_remedy(self) -> str:
        """Return the remedy for a file of a row that is not as committed."""
        return (
            f"restore it from a copy, or `polysight resume {quote(self.path)}` retakes its row;"
            f" `polysight validate {quote(self.path)}` names every damaged file"
        )


def dropped_files(scan: ScanFolder) -> dict[str, RawDropped]:
    """Return the payload files (relative to the scan folder) that `drop-raw` was to delete, each with its fact."""
    files: dict[str, RawDropped] = {}
    for fact in scan.content.facts:
        # The row was recorded again or withdrawn: its dropped files no longer count.
        if isinstance(fact, RowCommitted | RowWithdrawn):
            files = {file: dropped for file, dropped in files.items() if dropped.row != fact.row}
        elif isinstance(fact, RawDropped):
            files |= {board.file: fact for board in fact.boards.values()}
    return files


def dropped_rows(scan: ScanFolder) -> set[int]:
    """Return the rows of which a dropped file was deleted."""
    return {fact.row for file, fact in dropped_files(scan).items() if not (scan.path / file).exists()}


def raw_digest(board: BoardRow) -> str:
    """Return the digest of a board's committed row, by which its samples know the data they were made from."""
    return f"{board.crc32} {board.index_crc32} {board.missing_bytes}"


def read_sample_rows(folder: Path, start: int = 0) -> tuple[dict[int, dict[str, Any]], int]:
    """Read rows.jsonl in a folder of samples from byte `start`; return its lines by row, and the end of the last one.

    Truncated and damaged lines are skipped. Nothing is returned for a file that cannot be read.
    """
    try:
        raw = (folder / SAMPLE_ROWS).read_bytes()
    except OSError:
        return {}, start
    end = raw.rfind(b"\n") + 1
    lines = (manifest.decode_line(text) for text in raw[start:end].splitlines())
    return {line["row"]: line for line in lines if line is not None and _is_row(line)}, end


def open_records(path: Path) -> NDArray[Any] | None:
    """Return a board's kept samples, a structured record [row] each, memory-mapped; None if the file cannot be read."""
    try:
        with HEADER_LOCK:
            return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


def record_digest(record: Any) -> str:
    """Return the CRC of a record as in rows.jsonl."""
    return f"{crc32(record.tobytes()):08x}"


def find_damaged_samples(scan: ScanFolder) -> dict[int, list[str]]:
    """Check the kept samples of all committed rows; return the rows without whole samples, with the files to blame."""
    folder = scan.path / SAMPLES
    boards = [board.name for board in scan.instrument.receivers]
    lines, _ = read_sample_rows(folder)
    records = {name: open_records(folder / f"{name}.npy") for name in boards}
    damaged: dict[int, list[str]] = {}
    for row, committed in scan.committed_rows().items():
        saved = lines.get(row, {}).get("boards", {})
        if any(name not in saved or saved[name]["raw"] != raw_digest(committed.boards[name]) for name in boards):
            damaged[row] = [f"{SAMPLES}/{SAMPLE_ROWS}"]
            continue
        damaged_boards = [
            name for name in boards if not _is_whole(records[name], scan.plan.rows, row, saved[name]["crc32"])
        ]
        if damaged_boards:
            damaged[row] = [f"{SAMPLES}/{name}.npy" for name in damaged_boards]
    return damaged


@contextmanager
def lock_samples(scan: ScanFolder) -> Iterator[None]:
    """Lock the kept samples, so that no program writes them meanwhile.

    Raises
    ------
    DataError
        if there are none.
    DeviceError
        if another program is writing them.
    """
    path = scan.path / SAMPLES / SAMPLE_ROWS
    try:
        file = os.open(path, os.O_RDONLY)
    except OSError as e:
        raise DataError(
            f"{path}: {e.strerror}",
            "the samples of this scan are not kept: images can be made from its raw data only",
            f"`polysight process {quote(scan.path)} --out DIR` keeps them",
            code=ErrorCode.FILE_MISSING,
        ) from None
    try:
        lock_file(file)
        yield
    except BlockingIOError:
        raise DeviceError(
            f"{scan.path}: another program is processing this scan",
            f"it has locked {path}",
            "wait for its end",
            code=ErrorCode.BUSY,
        ) from None
    finally:
        os.close(file)


def _is_whole(records: NDArray[Any] | None, rows: int, row: int, digest: str) -> bool:
    """True if a board's `records` of `rows` rows are there and that of `row` has this digest."""
    return records is not None and records.shape == (rows,) and record_digest(records[row]) == digest


def _is_row(line: Mapping[str, Any]) -> bool:
    """True if a line of rows.jsonl has a row number and the entries of its boards."""
    boards = line.get("boards")
    return (
        isinstance(line.get("row"), int)
        and isinstance(boards, dict)
        and all(isinstance(b, dict) and {"crc32", "raw", "figures"} <= b.keys() for b in boards.values())
    )


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it, durably. Raises DeviceError."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as e:
        problem = f"{folder}: cannot be made: {e.strerror}"
        cause = "the disk is full or read-only"
        raise DeviceError(
            problem, cause, "free space, or choose another folder", code=ErrorCode.FILE_UNWRITABLE
        ) from None
    sync_folder(folder.parent)


def utc_now() -> str:
    """Return the present time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def check_inside(folder: Path, name: str, within: str = "") -> Path:
    """Return the path of a file that a manifest names, relative to the scan folder and inside its folder `within`.

    Only the name is foreign: `folder` is the user's own path, in any form.

    Raises
    ------
    DataError
        if the path, with links followed, is elsewhere.
    """
    path = folder / name
    home = folder.resolve()
    if within:
        root = (folder / within).resolve()
    else:
        root = home
    try:
        target = path.resolve()
        is_inside = ".." not in Path(name).parts and target.is_relative_to(home / within)
        is_inside = is_inside and target != root and root.is_relative_to(home)
    except (OSError, ValueError):
        # A name that no file can have.
        is_inside = False
    if not is_inside:
        raise DataError(
            f"{folder}: its manifest names {name!r}, which lies outside {folder / within}",
            "the manifest was made by another program or changed, or a link leads out of the scan",
            "nothing there is read, written or removed; `polysight validate` a copy of the scan as it was recorded",
            code=ErrorCode.PATH_OUTSIDE,
        )
    return path


def check_links(folder: Path) -> None:
    """Check that a scan folder contains no link that leads out of it, no pipe and no device.

    Only `products` may be such a link, because products are only replaced as a whole. Raises DataError.
    """
    root = folder.resolve()
    folders = [folder]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    if entry.is_symlink():
                        if path != folder / _MAY_BE_LINK and not _leads_into(path, root):
                            raise _refuse(folder, path, "is a link that leads out of it", ErrorCode.PATH_OUTSIDE)
                    elif entry.is_dir(follow_symlinks=False):
                        folders.append(path)
                    elif not entry.is_file(follow_symlinks=False):
                        raise _refuse(folder, path, "is neither a file nor a folder", ErrorCode.FILE_FOREIGN)
        except OSError:
            # Deleted in the meantime, or not readable: reported when a file is read.
            continue


def _leads_into(link: Path, root: Path) -> bool:
    """True if the target of a link lies in the folder `root`, whose own links are resolved."""
    try:
        return link.resolve().is_relative_to(root)
    except (OSError, RuntimeError):
        # The links form a circle.
        return False


def _refuse(folder: Path, path: Path, what: str, code: ErrorCode) -> DataError:
    """Return the error for an entry of a scan folder that may not be there."""
    return DataError(
        f"{folder}: {path.relative_to(folder)} {what}",
        "the folder was made by another program or changed; reading or writing the scan would affect other files",
        f"nothing was read or written; remove it (rm '{path}'), or replace it by a copy of its target",
        code=code,
    )


@contextmanager
def open_npz(path: Path) -> Iterator[Any]:
    """Open an archive of arrays, without pickled objects, after a check of its uncompressed size.

    Raises
    ------
    DataError
        if it is not a regular file, or its arrays exceed :data:`MAX_BYTES`.
    OSError, ValueError, KeyError, EOFError
        if it is not an archive of arrays, as numpy does.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    with open_regular(path) as f:
        try:
            with zipfile.ZipFile(f) as archive:
                size = sum(member.file_size for member in archive.infolist())
        except zipfile.BadZipFile as e:
            f.seek(0)
            raise ValueError(f"it is {recognise_format(f.read(512))}, not an archive of arrays ({e})") from None
        if size > MAX_BYTES:
            raise DataError(
                f"{path}: its arrays take {size} bytes, the limit is {MAX_BYTES} bytes",
                "it was not made by this program, or is damaged",
                "process the scan again, or cut the image area ([image] of the rig file)",
                code=ErrorCode.FILE_TOO_LARGE,
            )
        f.seek(0)
        try:
            with np.load(f, allow_pickle=False) as arrays:
                yield arrays
        except MemoryError as e:
            raise ValueError(f"an array in it is larger than the file says: {e}") from None
