"""Process the rows of a scan into images, several rows at a time, or restore them from kept samples.

`map_rows` and `map_boards` process rows, or the boards of a row, on several threads: the compiled synchronisation
releases the interpreter.

*Kept samples* are the rows of a scan after synchronisation, reduced to the range gate (the excess paths of the scene)
and stored on disk: images are formed from them without raw data. `KeptSamples` belongs to one pipeline. It restores a
row from disk if the row was made from the same raw bytes with the same settings; otherwise the pipeline synchronises
the row and saves it. Rows with missing, truncated or damaged records are synchronised again.
File format: docs/spec/samples.md.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.imaging import (
    AS_IN_RIG_FILE,
    PLANE_REACH_M,
    ImageBuilder,
    ImagedWith,
    ReducedRow,
    SubBandImages,
    View,
    fill_missing,
    fill_sub_bands,
    find_needed_gate_m,
    reduction,
)
from polysight.process.quality import Quality, RowFigures, RowQuality
from polysight.settings import DEFAULT, Settings
from polysight.store import (
    SAMPLE_ROWS,
    SAMPLES,
    ScanFolder,
    Source,
    check_inside,
    dropped_rows,
    lock_file,
    manifest,
    open_records,
    raw_digest,
    read_sample_rows,
    record_digest,
    require_raw,
)
from polysight.sync import HighPass
from polysight_shared.config import Instrument
from polysight_shared.errors import DataError, ErrorCode, quote
from polysight_shared.files import read_json

HEAD_FILE = "samples.json"
"""File that describes the kept samples; `rows.jsonl` lists the rows, and each board has a file of records."""
FORMAT = 1
"""Format of these files."""
METHOD_VERSION = 1
"""Version of the method that makes samples from raw data."""
SampleUse = Literal["none", "read", "keep"]
"""Use of kept samples, see `KeptSamples`."""
Filters = Mapping[str, HighPass | None]
"""The receivers' high-pass filters by board name; None: as the chirp profile programs them."""
Gate = tuple[float, float]
"""Smallest and largest excess path of a range gate, metres."""
Result = TypeVar("Result")

MAX_ROWS = 8
"""Rows that are processed at the same time: each takes some 60 MB on the published grid, and more threads would be
limited by the memory's bandwidth."""
_log = logging.getLogger(__name__)


def list_settings_of_samples(rig: Instrument, filters: Filters) -> dict[str, Any]:
    """Return the settings that samples depend on besides raw data and gate: the calibrated rig and its filters.

    They are plain values as JSON holds them, to be compared with a file.
    """
    imaged = msgspec.to_builtins(ImagedWith.from_rig(rig, filters))
    # The window over the aperture acts on images, not on samples.
    imaged.pop("apodisation")
    parts = {name: msgspec.to_builtins(getattr(rig, name)) for name in ("chirp", "burst", "grid")}
    return json.loads(json.dumps({"making": METHOD_VERSION, **imaged, **parts, "speed_mm_s": rig.stage.speed_mm_s}))


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_rows(add: Callable[[int], object], rows: Sequence[int], threads: int | None = None) -> Iterator[int]:
    """Call `add` for every row, on `threads` threads (None: one per core); yield each finished row, in order.

    There are at most `MAX_ROWS` threads. The first error is raised, and rows that were not started are cancelled.
    """
    count = min(threads or count_cores(), MAX_ROWS, len(rows))
    if count <= 1:
        for row in rows:
            add(row)
            yield row
        return
    with ThreadPoolExecutor(count) as pool:
        try:
            futures = [pool.submit(add, row) for row in rows]
            for row, future in zip(rows, futures, strict=True):
                future.result()
                yield row
        finally:
            pool.shutdown(cancel_futures=True)


def map_boards(names: Iterable[str], function: Callable[[str], Result], parallel: bool) -> dict[str, Result]:
    """Return `function(name)` for each board, by name; on one thread per core if `parallel`."""
    names = list(names)
    count = 1
    if parallel:
        count = min(count_cores(), len(names))
    if count <= 1:
        return {name: function(name) for name in names}
    with ThreadPoolExecutor(count) as pool:
        return dict(zip(names, pool.map(function, names), strict=True))


def _read_figures(entry: object) -> RowFigures | None:
    """Return the figures of a row from its line; None if they have another form."""
    try:
        return msgspec.convert(entry, RowFigures)
    except msgspec.ValidationError:
        return None


class KeptSamples:
    """Kept samples of a scan folder; nothing is kept for other sources.

    Parameters
    ----------
    source
        The scan.
    rig, filters
        Its calibrated rig, and its receivers' filters by board name; None: as the chirp profile programs them.
    quality
        Quality figures: restored rows are added to it, saved rows are read from it.
    settings
        Plane, pixels and sub-bands of the images, and range of planes.
    live
        Keep running sums, so that images can be formed after every row.
    samples
        "none" ignores kept samples, "read" restores rows, "keep" also saves missing rows.

    Attributes
    ----------
    images, sub_bands
        Image builders: restored rows are added to them, saved rows are read from them. They use the range gate of the
        samples on disk if it covers what they need. Rows of a wider gate than usual are not saved.
    filled
        `images`, with reconstructed positions after :meth:`fill_missing`.
    """

    def __init__(
        self,
        source: Source,
        rig: Instrument,
        filters: Filters,
        quality: Quality,
        settings: Settings = DEFAULT,
        *,
        live: bool = False,
        samples: SampleUse = "none",
    ) -> None:
        view = View(settings.depth_mm, settings.columns, settings.rows, settings.pixel_mm)
        # Echoes of planes that are nearer or farther by this distance are kept: images of the rig's view move to the
        # plates' plane.
        depth_m = 0.0
        if view == AS_IN_RIG_FILE:
            depth_m = PLANE_REACH_M
        if settings.depth_range_mm is not None:
            depth_m = settings.depth_range_mm / 1e3
        self._scan: ScanFolder | None = None
        self._folder = Path()
        if isinstance(source, ScanFolder) and samples != "none":
            self._scan = source
            self._folder = source.path / SAMPLES
        self._plan = source.plan
        self._made = list_settings_of_samples(rig, filters)
        self._quality = quality
        self._bands = settings.bands
        self._keep = samples == "keep"
        # Lines of rows.jsonl by row, and the bytes of the file that were read.
        self._lines: dict[int, dict[str, Any]] = {}
        self._read_bytes = 0
        # File descriptor of rows.jsonl, locked, while rows are written.
        self._rows: int | None = None
        self._arrays: dict[str, NDArray[Any]] = {}
        self._lock = threading.Lock()
        self._head = self._read_head()
        viewed = view.apply_to(rig, source.mirrored)
        gate = self._gate_m(rig, find_needed_gate_m(viewed, depth_m), find_needed_gate_m(rig, PLANE_REACH_M))
        self.builder = ImageBuilder(viewed, live=live, gate_m=gate)
        self.sub_bands = SubBandImages(viewed, self._bands, gate)
        self.filled = self.builder
        self._builders = {"samples": self.builder}
        self._builders |= {f"band_{k}": builder for k, builder in enumerate(self.sub_bands.builders)}
        # Rows without the sub-bands of those on disk are not added to them.
        self._keep &= not self._head or set(self._builders) == set(self._head["frequencies_hz"])

    def _gate_m(self, rig: Instrument, needed_gate_m: Gate, usual_gate_m: Gate) -> Gate:
        """Return the gate of the samples on disk if it covers the needed one, else the needed one.

        Without samples on disk, or if they are damaged, the usual gate is taken instead of theirs. If the needed gate
        is returned, samples on disk are not used, and no rows are kept.
        """
        gate_on_disk = tuple(self._head.get("gate_m", usual_gate_m))
        if self._head and not _has_frequencies(self._head, rig, gate_on_disk, usual_gate_m):
            self._head = {}
            gate_on_disk = usual_gate_m
        if gate_on_disk[0] <= needed_gate_m[0] and needed_gate_m[1] <= gate_on_disk[1]:
            return gate_on_disk
        self._head = {}
        self._keep = False
        return needed_gate_m

    def processable(self, source: Source, folder: Path) -> list[int]:
        """Return the rows of a source that can be processed: those with raw data or whole samples; log the others.

        `folder` is for messages. Raises DataError if there are none.
        """
        rows = list(source.rows())
        unreadable: list[int] = []
        if isinstance(source, ScanFolder):
            rows_without_raw = dropped_rows(source)
            unreadable = [row for row in rows if row in rows_without_raw and not self.is_kept(row)]
            if unreadable and len(unreadable) == len(rows):
                require_raw(source)
        if unreadable:
            _log.warning(
                "%s: rows %s are left out: their samples are damaged or missing, and their raw data was dropped;"
                " `polysight validate %s` names the files; restore them from a copy",
                self._folder, ", ".join(map(str, unreadable)), folder,
            )  # fmt: skip
        if not rows:
            remedy = "fetch the files of both receiving boards again"
            if isinstance(source, ScanFolder):
                remedy = f"`polysight resume {quote(folder)}` records the missing rows"
            raise DataError(
                f"{folder}: no recorded row is complete",
                "the scan was stopped in its first row, or files are missing",
                remedy,
                code=ErrorCode.NO_DATA,
            )
        return [row for row in rows if row not in unreadable]

    def is_kept(self, row: int) -> bool:
        """True if a row can be restored."""
        return self._read_records(row) is not None

    def fill_missing(self) -> SubBandImages:
        """Reconstruct missing positions from the rows so far: set `filled`, and return the images of sub-bands."""
        with self._quality.measure_time("reconstruct missing positions"):
            self.filled, errors = fill_missing(self.builder)
            sub_bands = fill_sub_bands(self.sub_bands)
        self._quality.note_filled(errors)
        return sub_bands

    def restore(self, row: int) -> bool:
        """Restore a row into the images; return False if it must be synchronised instead."""
        records = self._read_records(row)
        for board, (record, figures) in (records or {}).items():
            self._put(board, row, record, figures)
        return records is not None

    def _read_records(self, row: int) -> dict[str, tuple[Any, RowFigures]] | None:
        """Return a row's record and figures by board; None if one of them is missing, damaged or outdated."""
        line = self._read_row_line(row)
        if line is None:
            return None
        records = {}
        for board, entry in line["boards"].items():
            array = self._map_array(board)
            figures = _read_figures(entry["figures"])
            if array is None or figures is None or record_digest(array[row]) != entry["crc32"]:
                return None
            records[board] = (array[row], figures)
        return records or None

    def save(self, row: int) -> None:
        """Save a row that was just added to the images; log a warning if it cannot be written."""
        digests = self._read_digests(row)
        if digests is not None:
            with self._lock:
                self._save(row, digests)

    def _save(self, row: int, digests: dict[str, str]) -> None:
        """Write a row's record into each board's file, then its line; after an error no more rows are kept."""
        if not self._keep:
            return
        try:
            if self._rows is None:
                self._rows = self._open()
            if self._rows is None:
                return
            boards = {}
            for board, digest in digests.items():
                record, figures = self._record(board, row)
                with (self._folder / f"{board}.npy").open("r+b") as file:
                    # From the end of the file: its head has no fixed length.
                    file.seek(-(self._plan.rows - row) * record.nbytes, 2)
                    file.write(record.tobytes())
                boards[board] = {"crc32": record_digest(record), "raw": digest, "figures": msgspec.to_builtins(figures)}
            os.write(self._rows, manifest.encode_line({"fact": "row", "row": row, "boards": boards}))
        except (OSError, ValueError, DataError) as e:
            self._keep = False
            _log.warning("samples are not kept in %s: %s", self._folder, e)

    def _read_digests(self, row: int) -> dict[str, str] | None:
        """Return the digests of a committed row's raw data, by receiver; None if this source keeps no samples."""
        if self._scan is None:
            return None
        committed = self._scan.committed_rows().get(row)
        if committed is None or any(name not in committed.boards for name in self._quality.boards):
            return None
        return {name: raw_digest(committed.boards[name]) for name in self._quality.boards}

    def _read_row_line(self, row: int) -> dict[str, Any] | None:
        """Return the line of rows.jsonl for a row, if it was made from the committed raw data; else None."""
        digests = self._read_digests(row)
        if digests is None or not self._head:
            return None
        with self._lock:
            # Another program may have added the line since the last reading.
            if self._read_kept_digests(row) != digests:
                self._read_lines()
            if self._read_kept_digests(row) != digests:
                return None
            return self._lines[row]

    def _read_kept_digests(self, row: int) -> dict[str, str] | None:
        """Return the digests of the raw data that a saved row was made from; None if it is not saved."""
        if row not in self._lines:
            return None
        return {name: board["raw"] for name, board in self._lines[row]["boards"].items()}

    def _read_head(self) -> dict[str, Any]:
        """Return samples.json if its samples can be used, otherwise an empty dict."""
        if self._scan is None:
            return {}
        try:
            head = read_json(self._folder / HEAD_FILE)
        except (OSError, ValueError, DataError):
            return {}
        required = {"format": FORMAT, "scan_id": self._scan.scan_id, "made_with": self._made}
        if not isinstance(head, dict) or any(head.get(key) != value for key, value in required.items()):
            return {}
        # Images without sub-bands, 1, can be formed from samples with any.
        if self._bands not in (1, head.get("bands")) or not _is_valid_head(head):
            return {}
        return head

    def _read_lines(self) -> None:
        """Read new lines of rows.jsonl; skip a truncated or damaged one."""
        lines, self._read_bytes = read_sample_rows(self._folder, self._read_bytes)
        self._lines |= lines

    def _map_array(self, board: str) -> NDArray[Any] | None:
        """Return a board's records, memory-mapped; None if the file does not fit samples.json."""
        if board not in self._arrays:
            records = open_records(self._folder / f"{board}.npy")
            if records is None or records.dtype != self._make_record_type(board) or records.shape != (self._plan.rows,):
                return None
            self._arrays[board] = records
        return self._arrays[board]

    def _make_record_type(self, board: str) -> np.dtype[Any]:
        """Return the structured type of one board's record of a row: reduced samples, echo, direct path, mask."""
        columns = self._plan.columns
        rx = len(self._builders["samples"].boards[board].aperture.antennas.rx_m)
        parts: list[Any] = []
        for name, frequencies in self._head["frequencies_hz"].items():
            parts += [(name, "<c8", (rx, len(frequencies), columns)), (f"{name}_direct", "<c8", (rx, columns))]
        parts += [("echo", "<c8", (rx, columns)), ("direct_hz", "<f8", (columns,)), ("direct_snr", "<f8", (columns,))]
        return np.dtype([*parts, ("valid", "?", (columns,))])

    def _record(self, board: str, row: int) -> tuple[NDArray[Any], RowFigures]:
        """Return the record of a row, and its quality figures for rows.jsonl."""
        record = np.zeros((), self._make_record_type(board))
        # Quality is in order of recording, records in order of x.
        forward = slice(None, None, self._plan.row(row).direction)
        for name, builder in self._builders.items():
            record[name], record[f"{name}_direct"], record["valid"] = builder.boards[board].read_reduced(row)
        quality = self._quality.boards[board].rows[row]
        record["echo"] = quality.echo[:, forward]
        record["direct_hz"] = quality.direct_hz[forward]
        record["direct_snr"] = quality.direct_snr[forward]
        return record, quality.figures

    def _put(self, board: str, row: int, record: Any, figures: RowFigures) -> None:
        """Add a record to the images and its figures to the quality; the inverse of `_record`."""
        forward = slice(None, None, self._plan.row(row).direction)
        for name, builder in self._builders.items():
            builder.boards[board].put(row, ReducedRow(record[name], record[f"{name}_direct"], record["valid"]))
        direct_hz = np.array(record["direct_hz"][forward])
        direct_snr = np.array(record["direct_snr"][forward])
        echo = np.array(record["echo"][:, forward])
        direct = np.array(record["samples_direct"]).mean(axis=1)
        self._quality.boards[board].rows[row] = RowQuality(figures, direct_hz, direct_snr, echo, direct)

    def _open(self) -> int | None:
        """Open and lock rows.jsonl; start new files if those on disk do not fit. None if another program locked it."""
        scan = self._scan
        if scan is None:
            return None
        self._folder.mkdir(exist_ok=True)
        for name in (HEAD_FILE, SAMPLE_ROWS, f"{HEAD_FILE}.part", *(f"{board}.npy" for board in self._quality.boards)):
            # A link could overwrite another file.
            check_inside(scan.path, f"{SAMPLES}/{name}", SAMPLES)
        rows = os.open(self._folder / SAMPLE_ROWS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        weakref.finalize(self, os.close, rows)
        try:
            lock_file(rows)
        except BlockingIOError:
            self._keep = False
            return None
        if not self._head or any(self._map_array(board) is None for board in self._quality.boards):
            self._create(scan, rows)
        self._read_lines()
        # A killed program may have cut its last line: the next one would be joined to it.
        os.truncate(rows, self._read_bytes)
        return rows

    def _create(self, scan: ScanFolder, rows: int) -> None:
        """Create samples.json and empty records for all rows."""
        (self._folder / HEAD_FILE).unlink(missing_ok=True)
        os.truncate(rows, 0)
        self._lines = {}
        self._read_bytes = 0
        self._arrays = {}
        first_board = next(iter(self._quality.boards))
        frequencies_hz = {
            name: builder.boards[first_board].aperture.frequencies_hz.tolist()
            for name, builder in self._builders.items()
        }
        self._head = {
            "format": FORMAT,
            "scan_id": scan.scan_id,
            "simulated": scan.simulated,
            "bands": self._bands,
            "gate_m": self._builders["samples"].gate_m,
            "frequencies_hz": frequencies_hz,
            "made_with": self._made,
        }
        for board in self._quality.boards:
            # Programs that have the old file mapped keep it: it is not overwritten in place.
            (self._folder / f"{board}.npy").unlink(missing_ok=True)
            np.lib.format.open_memmap(
                self._folder / f"{board}.npy", "w+", self._make_record_type(board), (self._plan.rows,)
            )
        part = self._folder / f"{HEAD_FILE}.part"
        part.write_text(json.dumps(self._head, indent=1) + "\n", encoding="utf-8")
        part.replace(self._folder / HEAD_FILE)


def _is_valid_head(head: Mapping[str, Any]) -> bool:
    """True if samples.json has a gate of two finite numbers, and lists of frequencies."""
    gate = head.get("gate_m")
    frequencies = head.get("frequencies_hz")
    if not (isinstance(gate, list) and isinstance(frequencies, dict) and "samples" in frequencies):
        return False
    numbers = [gate, *frequencies.values()]
    has_numbers = all(isinstance(part, list) and part and all(_is_finite(v) for v in part) for part in numbers)
    return has_numbers and len(gate) == 2


def _has_frequencies(head: Mapping[str, Any], rig: Instrument, gate: Gate, usual: Gate) -> bool:
    """True if the frequencies in samples.json are those of its gate; a gate twice as wide as usual is damage."""
    if not 0 < gate[1] - gate[0] < 2 * (usual[1] - usual[0]):
        return False
    on_disk = head["frequencies_hz"]["samples"]
    expected = reduction(rig.chirp, gate).frequencies_hz
    return len(on_disk) == expected.size and np.allclose(on_disk, expected, rtol=1e-9, atol=0)


def _is_finite(value: object) -> bool:
    """True for a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)
