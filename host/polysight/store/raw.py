"""Delete raw data of processed rows, or place rows again from their stored packets (`.pkt` files), on request.

To place a row is to put the payload of each packet at its bytes of the row; missing packets leave gaps.

A `raw_dropped` line, which keeps the digests, is written before its files are deleted. After a crash in between, files
listed as dropped may still exist; dropping again deletes them. Files that are not listed always exist. A row that is
placed again with a different result is written to new files and committed with a new line; the old files are deleted
afterwards. A crash at any moment leaves either the old or the new row.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from polysight import capture
from polysight.store.logs import crc32
from polysight.store.manifest import BoardRow, DroppedFile, ManifestWriter, RawDropped, Reception, RowCommitted
from polysight.store.scan_folder import SAMPLES, ScanFolder, dropped_files, utc_now
from polysight.store.validation import find_board_faults, to_text
from polysight_shared.errors import DataError, DeviceError, ErrorCode, ScanError, quote
from polysight_shared.files import sync_folder

Digests = dict[str, dict[int, str]]
"""CRC-32 (hex) of the payload from which a product was made, by board and row."""


@dataclass(frozen=True)
class DroppableFiles:
    """Raw files that may be deleted."""

    # Files by row and board, and their bytes together.
    files: dict[int, dict[str, Path]]
    bytes: int
    # Files that must be kept, each with the reason: "file: reason".
    kept_files: list[str] = field(default_factory=list)


def require_raw(scan: ScanFolder) -> None:
    """Check that no raw data of the scan was dropped. Raises DataError."""
    dropped = list(dropped_files(scan).values())
    if dropped:
        raise DataError(
            f"{scan.path}: the raw data of {len({fact.row for fact in dropped})} rows was dropped",
            f"it was dropped on {dropped[-1].dropped_utc[:10]}, after it was processed into {dropped[-1].products}",
            "use those products; to synchronise again, restore the raw folder from a copy, or scan again",
            code=ErrorCode.NO_DATA,
        )


def find_droppable(scan: ScanFolder, processed: Digests) -> DroppableFiles:
    """Find the files that may be deleted: unchanged since their commit, and processed with the same digest.

    Parameters
    ----------
    scan
        A finished scan.
    processed
        Digests of the data from which the saved products were made.

    Raises
    ------
    ScanError
        if rows are missing, for which the scan can still be resumed and processed again.
    """
    rows = scan.committed_rows()
    missing = scan.plan.rows - len(rows)
    if missing:
        raise ScanError(
            f"{scan.path}: {missing} of {scan.plan.rows} rows are not committed",
            "the image of the whole scan needs the raw data of every row",
            f"`polysight resume {quote(scan.path)}` first",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    files: dict[int, dict[str, Path]] = {}
    kept_files: list[str] = []
    for row in rows.values():
        for name, board in row.boards.items():
            digest = processed.get(name, {}).get(row.row)
            if digest == board.crc32:
                path = scan.path / board.file
                if not path.exists():
                    continue
                if path.stat().st_size == board.bytes and f"{crc32(path.read_bytes()):08x}" == board.crc32:
                    files.setdefault(row.row, {})[name] = path
                else:
                    kept_files.append(f"{board.file}: differs from the committed data")
            elif board.file not in dropped_files(scan):
                cause = "not processed" if digest is None else "differs from the data of the products"
                kept_files.append(f"{board.file}: {cause}")
    paths = [path for boards in files.values() for path in boards.values()]
    return DroppableFiles(files, sum(path.stat().st_size for path in paths), kept_files)


def drop(scan: ScanFolder, processed: Digests, products: Path) -> None:
    """Lock the scan, then record and delete, row by row, the files that :func:`find_droppable` finds.

    `products` is the folder of what was made from the files.

    Raises
    ------
    DeviceError
        if the scan is in use, or the disk fails; the next call deletes the rest.
    """
    # A power cut must lose neither the products nor the samples, which are written without waiting for the disk.
    _make_durable(products)
    _make_durable(scan.path / SAMPLES)
    products_path = products.resolve()
    if products_path.is_relative_to(scan.path.resolve()):
        products_path = products_path.relative_to(scan.path.resolve())
    with scan.writer() as writer:
        scan.reload()
        droppable_files = find_droppable(scan, processed)
        recorded = dropped_files(scan)
        rows = scan.committed_rows()
        for index, files in droppable_files.files.items():
            if any(str(path.relative_to(scan.path)) not in recorded for path in files.values()):
                writer.append(_describe_dropped_row(rows[index], list(files), str(products_path)))
            for path in files.values():
                try:
                    path.unlink(missing_ok=True)
                except OSError as e:
                    raise DeviceError(
                        f"{path}: cannot be removed: {e.strerror}",
                        "this user may not write there, or the disk fails",
                        f"correct rights or disk, then `polysight drop-raw {quote(scan.path)}` deletes the rest",
                        code=ErrorCode.FILE_UNWRITABLE,
                    ) from None
        for folder in {path.parent for files in droppable_files.files.values() for path in files.values()}:
            sync_folder(folder)
    scan.reload()


def _make_durable(folder: Path) -> None:
    """Make the files of a folder and their names durable, if there is one. Raises DeviceError."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if not path.is_file():
            continue
        try:
            with path.open("rb") as file:
                os.fsync(file.fileno())
        except OSError as e:
            raise capture.make_write_error(path, "made durable", e) from None
    sync_folder(folder)


def _describe_dropped_row(row: RowCommitted, boards: list[str], products: str) -> RawDropped:
    """Return the line of the manifest for a row whose files of these boards are deleted."""
    files = {
        name: DroppedFile(board.file, board.bytes, board.crc32) for name, board in row.boards.items() if name in boards
    }
    return RawDropped(row=row.row, take=row.take, boards=files, products=products, dropped_utc=utc_now())


@dataclass(frozen=True)
class ReplacedRow:
    """Report on one board's row that was placed again."""

    row: int
    board: str
    # Missing bytes when the row was committed, and now.
    missing_before: int
    missing_after: int
    # Reason why the row was left unchanged.
    why_unchanged: str = ""
    changed: bool = False
    # True if the row was left unchanged because its files differ from the commit or are unreadable.
    damaged: bool = False


@dataclass(frozen=True)
class PlacedAgain:
    """A row placed again from its packets."""

    # Other data that the placement used than the packets.
    evidence: capture.Evidence
    placed: capture.PlacedRecord
    # uint8: the payload as placed now.
    payload: np.ndarray
    # Missing byte ranges [start, stop) when the row was committed.
    missing_before: list[tuple[int, int]]
    # True if the committed row has its frames at the times of their pulses. Placement by byte count would undo that.
    by_pulses: bool


def place_again(path: Path) -> PlacedAgain:
    """Place a row again; `path` is its file; `.idx` and `.pkt` are next to it. Raises DataError."""
    try:
        row = np.fromfile(path, dtype=np.uint8)
    except OSError as e:
        cause = "the path is wrong, or the raw data was dropped"
        problem = f"{path}: cannot be read: {e.strerror}"
        remedy = "give SCAN/raw/BOARD/ROW.bin"
        raise DataError(problem, cause, remedy, code=ErrorCode.FILE_UNREADABLE) from None
    index, _ = capture.read_index(path.with_suffix(".idx"))
    evidence, log = capture.read_packets(path.with_suffix(capture.PACKETS_SUFFIX), row)
    placed, payload = capture.place_record(
        log, evidence.frame_bytes, evidence.past, evidence.not_before_ns, evidence.dropped_by_card
    )
    missing = [(int(start), int(stop)) for start, stop in index.get("missing", [])]
    return PlacedAgain(evidence, placed, payload, missing, by_pulses="frames" in index)


def replace_rows(scan: ScanFolder) -> list[ReplacedRow]:
    """Place every committed row again, and commit those with a different result.

    Raises
    ------
    DeviceError
        if the scan is in use, or the disk fails; the remaining rows are unchanged.
    """
    reports = []
    with scan.writer() as writer:
        scan.reload()
        for row in scan.committed_rows().values():
            boards = {name: _place_row_again(scan, row, board) for name, board in row.boards.items()}
            reports += [report for report, _ in boards.values()]
            changed_rows = {
                name: placed_again
                for name, (report, placed_again) in boards.items()
                if report.changed and placed_again is not None
            }
            if changed_rows:
                _commit_changed_boards(scan, writer, row, changed_rows)
    scan.reload()
    return reports


def _place_row_again(scan: ScanFolder, row: RowCommitted, board: BoardRow) -> tuple[ReplacedRow, PlacedAgain | None]:
    """Place one board's row again; None with the report if that cannot be done."""
    name = Path(board.file).parent.name
    path = scan.path / board.file
    unchanged = ReplacedRow(row.row, name, board.missing_bytes, board.missing_bytes)
    if not board.packets_crc32:
        return replace(unchanged, why_unchanged="its packets were not kept"), None
    try:
        if faults := find_board_faults(scan, board, row.pulses):
            return replace(unchanged, why_unchanged="; ".join(map(to_text, faults)), damaged=True), None
        placed = place_again(path)
    except DataError as e:
        return replace(unchanged, why_unchanged=str(e), damaged=True), None
    if placed.by_pulses:
        return replace(unchanged, why_unchanged="its frames were placed by their pulses"), None
    missing_now = sum(stop - start for start, stop in placed.placed.missing)
    same_gaps = placed.missing_before == placed.placed.missing
    same_payload = f"{crc32(placed.payload.tobytes()):08x}" == board.crc32
    has_changed = not (same_gaps and same_payload)
    return replace(unchanged, missing_after=missing_now, changed=has_changed), placed


def _commit_changed_boards(
    scan: ScanFolder, writer: ManifestWriter, row: RowCommitted, changed_boards: dict[str, PlacedAgain]
) -> None:
    """Write the new files, then the line, then delete the old files."""
    boards = dict(row.boards)
    old_files: list[Path] = []
    for name, placed in changed_boards.items():
        path = scan.path / boards[name].file
        old_files += [path.with_suffix(suffix) for suffix in (".bin", ".idx", capture.PACKETS_SUFFIX)]
        boards[name] = _write_new_files(scan, boards[name], placed)
    kept_incomplete = row.kept_incomplete
    faults = row.faults
    if all(board.missing_bytes == 0 for board in boards.values()):
        kept_incomplete = []
        faults = []
    elif not kept_incomplete:
        kept_incomplete = ["placed again: some bytes are not certain"]
    new = msgspec.structs.replace(
        row, boards=boards, kept_incomplete=kept_incomplete, faults=faults, replaced_utc=utc_now()
    )
    writer.append(new)
    for path in old_files:
        path.unlink(missing_ok=True)


def _write_new_files(scan: ScanFolder, board: BoardRow, placed_again: PlacedAgain) -> BoardRow:
    """Write a row's new files durably; return their entry for the manifest."""
    placed = placed_again.placed
    frame_bytes = scan.instrument.frame_bytes
    path = scan.path / board.file
    index, _ = capture.read_index(path.with_suffix(".idx"))
    _, log = capture.read_packets(path.with_suffix(capture.PACKETS_SUFFIX), np.fromfile(path, dtype=np.uint8))
    new_path = _find_free_name(path)
    crc = capture.write_durably(new_path, placed_again.payload.tobytes())
    index_crc = capture.write_index(new_path.with_suffix(".idx"), {**index, **placed.facts()}, placed.arrivals)
    packets_crc = capture.write_packets(
        new_path.with_suffix(capture.PACKETS_SUFFIX), log, placed_again.evidence, placed
    )
    sync_folder(new_path.parent)
    frames = placed.expected // frame_bytes
    counts = {name: n for name, n in vars(placed.counts).items() if name in Reception.__struct_fields__}
    return msgspec.structs.replace(
        board,
        file=str(new_path.relative_to(scan.path)),
        frames_received=int(capture.valid_frames(placed.missing, frames, frame_bytes).sum()),
        missing_bytes=sum(stop - start for start, stop in placed.missing),
        crc32=f"{crc:08x}",
        index_crc32=f"{index_crc:08x}",
        packets_crc32=f"{packets_crc:08x}",
        located=placed.located,
        received_bytes=placed.received,
        packets=placed.counts.placed,
        **counts,
        **vars(placed.losses),
    )


def _find_free_name(path: Path) -> Path:
    """Return `0003-1.bin` for `0003.bin`, or the next number that is free."""
    stem = path.stem.split("-")[0]
    number = 1
    while (new := path.with_name(f"{stem}-{number}.bin")).exists():
        number += 1
    return new
