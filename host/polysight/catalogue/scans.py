"""The scans under a folder: a list with one line for each, and the folder of a scan by its name.

Thousands of scans are listed without delay, because a scan is read again only after its files have changed: each line
of the list is kept together with the times and sizes of the files that it was made from, also over a restart (`Index`).
"""

from __future__ import annotations

import math
import os
import re
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from pathlib import Path, PurePosixPath

import msgspec
from msgspec.structs import replace

from polysight.acquisition import LAPSE_S, SignOfLife, read_life, read_start_ticks
from polysight.catalogue.notes import NOTES_FILE, Notes, is_plain, read_notes, remove_unprintable
from polysight.products import IMAGE, LABELS, MATERIALS, QUALITY, SCAN, ProcessedScan, find_labels
from polysight.results import NoResult
from polysight.store import MANIFEST, Manifest, manifest
from polysight_shared.errors import DataError, ErrorCode, PolysightError
from polysight_shared.files import write_atomically
from polysight_shared.findings import Finding

READ_S = 3.0
"""Time limit for reading one folder; chosen. A folder that takes longer is listed as `silent` until it is read."""
PART_S = 0.1
"""A list that no client waits for is read in parts of this length, with pauses of the same length; chosen."""
PROGRAM_FOLDER = "program"
"""Folder of a scan in which programs that a page started keep their process number and log."""
# Deepest level of folders in which scans are searched for; chosen.
MAX_DEPTH = 4
# Largest number of scans that are listed below one folder of the root; chosen.
MAX_SCANS = 5000
# Length of the end of a program's log that is read, with its last messages; chosen.
LOG_BYTES = 16384
# Longest record of a started program that is read: its command line is short; chosen.
MAX_RECORD_BYTES = 100_000
# Longest text of an exit status that is read, with its sign and the end of its line; chosen.
MAX_STATUS_BYTES = 8
# Characters of a program's message, and of its cause and remedy, that the list shows; chosen.
MESSAGE_CHARACTERS = 300
REMEDY_CHARACTERS = 500
# Largest number of names of materials, and of boxes, in a line of the list; chosen.
MAX_NAMES = 12
CONTROL_SEQUENCE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
# Time that a program may take from the last line of a manifest to its first sign of life; chosen.
GRACE_S = 20.0
# Files of a scan that its summary is made from. Products are in the folder `products` of a scan, or have a folder
# without a scan.
_PRODUCTS = (IMAGE, MATERIALS, QUALITY)
SUMMARISED = (MANIFEST, NOTES_FILE, *(f"{place}{name}" for place in ("", "products/") for name in (LABELS, *_PRODUCTS)))
Stamp = tuple[tuple[int, int], ...]
"""Time of the last change (ns) and size of each of the `SUMMARISED`; (0, -1) for a file that is not there."""


# --- one line of the list ---


class Summary(msgspec.Struct, frozen=True):
    """One line of the list.

    Attributes
    ----------
    name
        Path of the scan's folder below the folder that is listed, with `/`.
    state
        One of :data:`polysight.acquisition.BADGES`: `lost` (its program was killed), `frozen` (it gives no sign of
        life), `begun` (a folder in which a program was started and no scan is yet), `products` (without rows),
        `silent` (its folder does not answer: a disconnected network drive), ...
    rows, committed
        Number of rows of the plan, and of rows whose recording was completed.
    reason
        Why the scan's program ended or failed; "" if it is not known.
    verdict
        Level of the products' verdict; "" if the scan was not processed or not judged, "damaged" if the products cannot
        be read.
    processed
        True if there are materials.
    images_only
        True if there are images without materials: by `polysight image`, or before processing has ended.
    seconds
        Start of the scan in seconds since 1970; 0 if it is not known.
    generation
        Text that changes whenever the products do, see :func:`read_generation`.
    labelled
        Names of boxes drawn by hand.
    notes, tags
        Notes and tags of the operator. If their file is damaged, `notes` says so.
    """

    name: str
    state: str
    scan_id: str = ""
    rig: str = ""
    simulated: bool | None = None
    started_utc: str = ""
    rows: int = 0
    committed: int = 0
    reason: str = ""
    verdict: str = ""
    processed: bool = False
    images_only: bool = False
    materials: tuple[str, ...] = ()
    notes: str = ""
    tags: tuple[str, ...] = ()
    seconds: float = 0.0
    generation: str = ""
    labelled: tuple[str, ...] = ()


def read_generation(products: Path) -> str:
    """Return a text that changes when the products in a folder are replaced; they are replaced all together.

    To read several files that belong together, compare the text before and after.
    """
    stamps = []
    for path in (products, products / IMAGE, products / MATERIALS, products / QUALITY, products / SCAN):
        try:
            status = path.stat()
        except OSError:
            stamps.append("-")
            continue
        # The time of the folder also changes with files that are not products. Its inode number changes only when the
        # folder is replaced.
        stamp = status.st_mtime_ns
        if path == products:
            stamp = status.st_ino
        stamps.append(f"{stamp:x}")
    return ".".join(stamps)


def _read_stamp(folder: Path) -> Stamp:
    """Return the times and sizes of the files that a summary is made from."""
    # The path is text, because making `Path` objects takes as long as querying the files.
    folder_text = str(folder)
    stamps = []
    for name in SUMMARISED:
        try:
            status = os.stat(f"{folder_text}/{name}")  # noqa: PTH116 - see above
            stamps.append((status.st_mtime_ns, status.st_size))
        except OSError:
            stamps.append((0, -1))
    return tuple(stamps)


def summarise(folder: Path, name: str) -> Summary:
    """Summarise a scan from its files.

    A scan that has not ended gets the state `lost` here; :func:`add_signs_of_life` corrects it if the scan's program is
    alive.
    """
    try:
        notes = read_notes(folder)
    except DataError as e:
        # The list shows the problem in place of the notes.
        notes = Notes(e.what)
    summary = Summary(name, "begun", notes=notes.notes, tags=notes.tags, seconds=_read_modified_s(folder))
    with suppress(PolysightError):
        label_file = find_labels(folder)
        if label_file is not None:
            _, labels = label_file
            summary = replace(summary, labelled=tuple(labels.boxes)[:MAX_NAMES])
    summary = _add_products(folder, summary)
    content = _read_manifest(folder)
    if content is None:
        if summary.processed or summary.images_only:
            return replace(summary, state="products")
        return summary
    started = content.started
    if started is None:
        return replace(summary, state="damaged")
    state = content.state
    if state == "open":
        state = "lost"
    reason = ""
    if content.ended is not None:
        reason = content.ended.reason[:MESSAGE_CHARACTERS]
    return replace(
        summary,
        state=state,
        scan_id=started.scan_id,
        rig=str(started.instrument.get("name", "")),
        simulated=started.simulated,
        started_utc=started.started_utc,
        rows=started.plan.rows,
        committed=len(content.rows),
        reason=reason,
        seconds=_parse_utc(started.started_utc) or summary.seconds,
    )


def _read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of a scan; None if there is none, or it is damaged."""
    if not is_plain(folder / MANIFEST):
        return None
    try:
        return manifest.read(folder / MANIFEST)
    except DataError:
        return None


def _add_products(folder: Path, summary: Summary) -> Summary:
    """Add verdict and materials of the products."""
    places = [place for place in (folder / "products", folder) if (place / IMAGE).exists()]
    if not places:
        return summary
    generation = read_generation(places[0])
    processed = (places[0] / MATERIALS).exists()
    summary = replace(summary, processed=processed, images_only=not processed, generation=generation)
    try:
        products = ProcessedScan(places[0])
        if products.materials is not None:
            level = "" if products.verdict is None else products.verdict.level
            names = dict.fromkeys(patch.name for patch in products.segments if patch.name)
            summary = replace(summary, verdict=level, materials=tuple(names)[:MAX_NAMES])
        if places[0] == folder:
            summary = replace(summary, scan_id=products.scan_id, simulated=products.simulated)
    except PolysightError:
        # The page of the scan shows the problem.
        return replace(summary, verdict="damaged")
    return summary


# --- programs ---

KINDS = ("scan", "process", "permittivity", "export", "doctor", "train", "concentration")
"""Programs that a page starts; each has its record, log and exit status in `<folder>/program/`."""


class Program(msgspec.Struct, frozen=True):
    """A program that was started: its exit status is None while it runs, and if it was killed."""

    kind: str
    running: bool
    status: int | None
    words: tuple[str, ...]
    started_utc: str
    log: str


class ProgramRecord(msgspec.Struct, frozen=True):
    """Content of `program/<kind>.json`: process number, its start time (`ticks`), command, and time in UTC.

    Process numbers are used again: a process with this number is the program only if its :func:`read_start_ticks` are
    the same.
    """

    pid: int
    ticks: int
    words: list[str]
    started_utc: str


def find_programs(folder: Path) -> list[Program]:
    """Return all programs started for a folder, the newest first."""
    programs = [find_program(folder, kind) for kind in KINDS]
    return sorted((p for p in programs if p is not None), key=lambda p: p.started_utc, reverse=True)


def find_program(folder: Path, kind: str) -> Program | None:
    """Return the program of a kind that was started last for a folder; None if there is none."""
    base = folder / PROGRAM_FOLDER / kind
    path = base.with_suffix(".json")
    if (folder / PROGRAM_FOLDER).is_symlink() or not is_plain(path):
        return None
    try:
        with path.open("rb") as f:
            record = msgspec.json.decode(f.read(MAX_RECORD_BYTES), type=ProgramRecord)
    except (OSError, ValueError):
        return None
    words = record.words
    if words[1:3] == ["-m", "polysight"]:
        words = ["polysight", *words[3:]]
    running = read_start_ticks(record.pid) == record.ticks
    status = None if running else _read_status(base.with_suffix(".status"))
    return Program(kind, running, status, tuple(words), record.started_utc, read_log_tail(base.with_suffix(".log")))


def _read_status(path: Path) -> int | None:
    """Return the exit status that a program has left; None if there is none."""
    try:
        if not is_plain(path):
            return None
        with path.open("rb") as f:
            return int(f.read(MAX_STATUS_BYTES))
    except (OSError, ValueError):
        return None


def explain_failure(program: Program | None) -> Finding | None:
    """Return why a program failed, from the last error in its log; None if it runs, or has ended well."""
    if program is None or program.running or program.status in (0, NoResult.exit_status):
        return None
    if program.status is None:
        return Finding("error", f"polysight {program.kind} was killed", "Memory ran out, or somebody killed it")
    lines = program.log.splitlines()
    heads = [k for k, line in enumerate(lines) if re.match(r"polysight \w+: ", line)]
    if not heads:
        lines = lines or ["its program ended without a message"]
        return Finding("error", lines[-1][:MESSAGE_CHARACTERS])
    start = heads[-1]
    # Errors are printed in three parts: the problem, and indented lines `why:` and `do:`.
    parts = {"why": "", "do": ""}
    for line in lines[start + 1 :]:
        name, _, text = line.strip().partition(": ")
        if name in parts:
            parts[name] = text[:REMEDY_CHARACTERS]
    problem = lines[start].partition(": ")[2]
    return Finding("error", problem[:MESSAGE_CHARACTERS], parts["why"], parts["do"])


def read_log_tail(path: Path) -> str:
    """Return the end of a program's log since its last start, without control sequences; "" if there is none."""
    if not is_plain(path):
        return ""
    try:
        with path.open("rb") as f:
            f.seek(max(0, f.seek(0, os.SEEK_END) - LOG_BYTES))
            text = f.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    # Each start writes a line that begins with dashes.
    *_, text = re.split(r"(?m)^--- .*$", text.replace("\r\n", "\n"))
    return remove_unprintable(CONTROL_SEQUENCE.sub("", text), keep="\n\t").strip()


def add_signs_of_life(folder: Path, summary: Summary) -> Summary:
    """Return the summary with its present state.

    `running` or `paused` if the scan's program is alive, `lost` or `frozen` if not; `failed` if a program that was
    started here ended before it made a scan.
    """
    if summary.state == "begun":
        # A program that is killed changes no file: its failure cannot be a part of the summary that is kept.
        failure = explain_failure(find_program(folder, "scan"))
        if failure is None:
            return summary
        return replace(summary, state="failed", reason=failure.what)
    if summary.state not in ("lost", "paused"):
        return summary
    life = read_life(folder)
    if life is not None:
        written_s = life.written_s
        patience_s = LAPSE_S
    else:
        written_s = _read_modified_s(folder / MANIFEST)
        patience_s = GRACE_S
    if life is not None and life.killed:
        return replace(summary, state="lost")
    if time.time() - written_s >= patience_s:
        # In a folder that was copied from another machine, the signs of life are from there.
        if life is not None and life.is_here:
            return replace(summary, state="frozen")
        return replace(summary, state="lost")
    if summary.state == "paused":
        return summary
    return replace(summary, state="running")


def _read_modified_s(path: Path) -> float:
    """Return the time of the last change of a file or folder, since 1970; 0 if it cannot be read."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _parse_utc(utc: str) -> float:
    """Return a time in seconds since 1970; 0 if the text is not a time."""
    try:
        return datetime.fromisoformat(utc).timestamp()
    except ValueError:
        return 0.0


# --- the list ---

StampedSummary = tuple[Stamp, Summary]
# Version of the index. A release that makes other summaries from the same files has a higher one.
INDEX_VERSION = 1
# Step of a drive's clock (FAT: 2 s). A file that is written twice within a step keeps its time: a summary from files
# that were changed less than a step before the index is written is not put into it, and made again after a restart.
CLOCK_STEP_S = 2.0
# Shortest time between two writes of the index; chosen. A running scan changes the list with every row, and each write
# is flushed to disk.
INDEX_INTERVAL_S = 60.0


class Index(msgspec.Struct, frozen=True):
    """Summaries by name, each with the stamp of its files; a later process uses those whose stamps are unchanged."""

    version: int
    summaries: dict[str, StampedSummary]


def read_index(path: Path) -> dict[str, StampedSummary]:
    """Read the summaries of an earlier process; empty if there is no index, or it is damaged or of another version."""
    if not is_plain(path):
        return {}
    try:
        index = msgspec.json.decode(path.read_bytes(), type=Index)
    except (OSError, ValueError):
        return {}
    if index.version != INDEX_VERSION:
        return {}
    return index.summaries


def write_index(path: Path, summaries: dict[str, StampedSummary]) -> None:
    """Replace the index atomically, so that a kill leaves the old one. In a read-only folder nothing is written."""
    if path.parent.is_symlink():
        return
    newest_ns = int((time.time() - CLOCK_STEP_S) * 1e9)
    settled = {
        name: (stamp, summary)
        for name, (stamp, summary) in summaries.items()
        if all(modified_ns < newest_ns for modified_ns, _ in stamp)
    }
    with suppress(OSError):
        write_atomically(path, msgspec.json.encode(Index(INDEX_VERSION, settled)))


class Scans:
    """The scans in a folder, or a single one.

    Parameters
    ----------
    root
        Folder to look under.
    only
        Name of the only scan that is shown, which may not exist yet. None: all scans.
    index
        File that keeps the list over a restart, see :class:`Index`. None: it is not kept.
    """

    def __init__(self, root: Path, only: str | None = None, index: Path | None = None) -> None:
        self.root = root
        self.only = only
        self._index = index
        self._summaries: dict[str, StampedSummary] = {}
        if index is not None:
            self._summaries = read_index(index)
        # The summaries that the index file had when it was last read or written.
        self._indexed = dict(self._summaries)
        self._indexed_at = float("-inf")
        # Scans below each entry of the root, and entries that are being read.
        self._listed: dict[str, list[Summary]] = {}
        self._reading: set[str] = set()
        self._lock = threading.Lock()
        self.unread = 0
        """Number of entries of the root that the last list lacks, because its time limit had passed."""

    def list(self, within_s: float = math.inf) -> Sequence[Summary]:
        """Return every scan, the newest first; what has changed since the last call is read again.

        A folder that takes longer than `READ_S` is listed as `silent`. The thread that reads it cannot be ended: the
        folder is read again after the thread has returned. After `within_s` the list has the entries that were read so
        far, and the next call continues with the others.
        """
        with self._lock:
            if self.only is not None:
                entries = [self.only]
            else:
                entries = [name for name, _ in _list_folders(self.root)]
            # Scans that are not listed yet come first, by descending names, because many names begin with a date. Only
            # the threads that read may query a folder's time, because its drive may be missing.
            waiting = [entry for entry in reversed(entries) if entry not in self._reading]
            waiting.sort(key=self._listed.__contains__)
            self._read_all(deque(waiting), time.monotonic() + within_s)
            unread = {entry for entry in entries if entry not in self._listed and entry not in self._reading}
            self.unread = len(unread)
            scans: list[Summary] = []
            for entry in entries:
                listed = self._listed.get(entry, [])
                if entry in self._reading:
                    listed = [replace(s, state="silent") for s in listed] or [Summary(entry, "silent")]
                scans += listed
            names = {s.name for s in scans}
            self._summaries = {
                name: stored_summary
                for name, stored_summary in list(self._summaries.items())
                if name in names or name.partition("/")[0] in unread
            }
            if not unread:
                self._keep_index()
        return sorted(scans, key=lambda s: (-s.seconds, s.name))

    def read_in_parts(self) -> None:
        """Read the whole list once, in parts between which other threads get what was read so far."""
        self.list(PART_S)
        while self.unread:
            time.sleep(PART_S)
            self.list(PART_S)

    def _keep_index(self) -> None:
        """Write the index if the list has changed since it was written, not too often."""
        age_s = time.monotonic() - self._indexed_at
        if self._index is None or age_s < INDEX_INTERVAL_S or self._summaries == self._indexed:
            return
        write_index(self._index, self._summaries)
        self._indexed = dict(self._summaries)
        self._indexed_at = time.monotonic()

    def _read_all(self, waiting: deque[str], until_s: float) -> None:
        """Read entries of the root in a thread; when it makes no progress for `READ_S`, another thread continues.

        After `until_s` (monotonic clock) no further entry is read.
        """
        while waiting:
            worker = threading.Thread(target=self._read_entries, args=(waiting, until_s), name="list", daemon=True)
            worker.start()
            count_before = -1
            while worker.is_alive() and count_before != len(waiting):
                count_before = len(waiting)
                worker.join(READ_S)

    def _read_entries(self, waiting: deque[str], until_s: float) -> None:
        """Summarise waiting entries of the root, one after another; after `until_s` drop those that still wait."""
        # Two threads may read: the other one may take the last entry.
        with suppress(IndexError):
            while True:
                entry = waiting.popleft()
                self._reading.add(entry)
                try:
                    self._listed[entry] = [self._summarise(name) for name in self._find_names_below(entry)]
                finally:
                    self._reading.discard(entry)
                if time.monotonic() >= until_s:
                    waiting.clear()

    def _find_names_below(self, entry: str) -> Iterator[str]:
        """Return the names of the scans at or below an entry of the root folder."""
        if self.only is not None or is_scan(self.root / entry):
            return iter([entry])
        return _find_scan_names(self.root / entry, prefix=f"{entry}/", depth=2)

    def iterate_signs_of_life(self) -> Iterator[tuple[str, SignOfLife]]:
        """Yield name and last sign of life of each scan that runs, or was killed; no scan is read."""
        places = _find_scans(self.root, prefix="", depth=1)
        if self.only is not None:
            places = iter([(self.only, self.root / self.only)])
        for name, path in places:
            life = read_life(path)
            if life is not None:
                yield name, life

    def list_left_out(self) -> Sequence[str]:
        """Return the names (ASCII) of scans that are not listed: links, and names that cannot be shown."""
        if self.only is not None:
            return []
        with suppress(OSError), os.scandir(self.root) as entries:
            odd_entries = [
                e for e in entries if not e.name.startswith(".") and (e.is_symlink() or not _is_name(e.name))
            ]
            return sorted(ascii(e.name)[1:-1] for e in odd_entries if is_scan(Path(e.path)))
        return []

    def summary(self, name: str) -> Summary:
        """Return the summary of one scan. Raises DataError as :meth:`folder`."""
        self.folder(name)
        return self._summarise(name)

    def folder(self, name: str, new: bool = False) -> Path:
        """Return the folder of a scan.

        Parameters
        ----------
        name
            Name of the scan in the list.
        new
            True for a scan that is to be made: its folder need not exist.

        Raises
        ------
        DataError
            when the name leads out of the folder, also by a link, or there is no such scan.
        """
        parts = name.split("/")
        valid = len(name) <= 1000 and len(parts) <= MAX_DEPTH and all(map(_is_name, parts))
        if self.only is not None:
            valid = valid and name == self.only
        path = self.root / PurePosixPath(name) if valid else self.root
        try:
            # The resolved path differs if a part of it is a link.
            valid = valid and path.resolve() == self.root.resolve() / name
            outer = [parent for parent in path.parents if self.root in parent.parents and is_scan(parent)]
            exists = new or name == self.only or is_scan(path)
        except (OSError, ValueError):
            outer = []
            exists = False
        if not valid:
            raise DataError(
                f"no scan here has the name {name[:80]!r}", "the name is not valid, or leads out of this folder",
                "choose a name from the list",
                code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip
        if outer:
            raise DataError(
                f"{path}: not a scan", f"the folder lies inside the scan {outer[0].name}", "give the name of that scan",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        if not exists:
            problem = f"{path}: not a scan"
            cause = "nothing was recorded there"
            if not path.exists():
                problem = f"{path}: does not exist"
                cause = "its name is mistyped, or it was moved, renamed or deleted"
            raise DataError(problem, cause, "choose a scan from the list", code=ErrorCode.FILE_MISSING)
        return path

    def _summarise(self, name: str) -> Summary:
        """Return the present summary of a scan, made again if its files have changed."""
        folder = self.root / name
        stamp = _read_stamp(folder)
        stored_summary = self._summaries.get(name)
        if stored_summary is None or stored_summary[0] != stamp:
            stored_summary = (stamp, summarise(folder, name))
            self._summaries[name] = stored_summary
        _, summary = stored_summary
        return add_signs_of_life(folder, summary)


def folder_bytes(folder: Path) -> int:
    """Return the bytes of all files in a folder; links are not followed."""
    total = 0
    for subfolder, _, files in os.walk(folder):
        for name in files:
            # A file may be deleted meanwhile.
            with suppress(OSError):
                total += (Path(subfolder) / name).lstat().st_size
    return total


def _find_scan_names(root: Path, prefix: str, depth: int) -> Iterator[str]:
    """Return the names of the scans below a folder."""
    names = (name for name, _ in _find_scans(root, prefix, depth))
    yield from islice(names, MAX_SCANS)


def _find_scans(root: Path, prefix: str, depth: int) -> Iterator[tuple[str, Path]]:
    """Return names and paths of the scans below a folder, without links, hidden folders and the insides of scans.

    `depth` is the level of its entries below the listed root, from 1.
    """
    for entry, path in _list_folders(root):
        name = f"{prefix}{entry}"
        if is_scan(path):
            yield name, path
        elif depth < MAX_DEPTH:
            yield from _find_scans(path, f"{name}/", depth + 1)


def _list_folders(root: Path) -> list[tuple[str, Path]]:
    """Return names and paths of the folders in a folder, sorted, without links and names that cannot be shown."""
    with suppress(OSError), os.scandir(root) as entries:
        folders = [e for e in entries if _is_name(e.name) and e.is_dir(follow_symlinks=False)]
        return sorted((e.name, Path(e.path)) for e in folders)
    return []


def _is_name(part: str) -> bool:
    """True if a folder of this name is listed: not empty, hidden or unprintable, and at most 200 characters."""
    if not part or part.startswith("."):
        return False
    return part.isprintable() and "\\" not in part and len(part) <= 200


def is_scan(path: Path) -> bool:
    """True if a folder holds a scan, products, or programs that a page started; False if it cannot be looked into."""
    # The path is text: thousands of folders are queried, and making `Path` objects takes as long as querying the files.
    path_text = str(path)
    return any(os.path.exists(f"{path_text}/{name}") for name in (MANIFEST, IMAGE, PROGRAM_FOLDER))  # noqa: PTH110
