"""Delete raw data of processed rows on request; the manifest keeps the digests.

A row's `raw_dropped` line is written before its files are deleted. After a crash in between, files listed as dropped
may still exist; dropping again deletes them. Files that are not listed always exist.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from polysight.store.append_only import crc32, sync_folder
from polysight.store.manifest import DroppedFile, RawDropped, RowCommitted, RowWithdrawn
from polysight.store.scan_folder import ScanFolder, utc_now
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError, ScanError

Digests = dict[str, dict[int, str]]
"""CRC-32 (hex) of the payload from which a product was made, by board and row."""


@dataclass(frozen=True)
class Droppable:
    """Raw files that may be deleted."""

    files: dict[int, dict[str, Path]]  # by row and board
    bytes: int
    kept: list[str] = field(default_factory=list)  # files that must be kept, with the reason


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


def require_raw(scan: ScanFolder) -> None:
    """Check that no raw data of the scan was dropped. Raises DataError."""
    facts = list(dropped_files(scan).values())
    if facts:
        raise DataError(
            f"{scan.path}: the raw data of {len({fact.row for fact in facts})} rows was dropped",
            f"it was dropped on {facts[-1].dropped_utc[:10]}, after it was processed into {facts[-1].products}",
            "use those products; to synchronise again, restore the raw folder from a copy, or scan again",
            code=ErrorCode.NO_DATA,
        )


def droppable(scan: ScanFolder, processed: Digests) -> Droppable:
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
    rows = scan.committed()
    missing = scan.plan.rows - len(rows)
    if missing:
        raise ScanError(
            f"{scan.path}: {missing} of {scan.plan.rows} rows are not committed",
            "the image of the whole scan needs the raw data of every row",
            f"`polysight resume {scan.path}` first",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    files: dict[int, dict[str, Path]] = {}
    kept: list[str] = []
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
                    kept.append(f"{board.file}: differs from the committed data")
            elif board.file not in dropped_files(scan):
                why = "not processed" if digest is None else "differs from the data of the products"
                kept.append(f"{board.file}: {why}")
    there = [path for boards in files.values() for path in boards.values()]
    return Droppable(files, sum(path.stat().st_size for path in there), kept)


def drop(scan: ScanFolder, processed: Digests, products: Path) -> None:
    """Lock the scan, then record and delete, row by row, the files that :func:`droppable` finds.

    Raises
    ------
    DeviceError
        if the scan is in use, or the disk fails; the next call deletes the rest.
    """
    sync_folder(products)  # a power cut must not lose the products
    inside = products.resolve().is_relative_to(scan.path.resolve())
    where = str(products.resolve().relative_to(scan.path.resolve()) if inside else products.resolve())
    with scan.writer() as writer:
        scan.reload()
        found, recorded, rows = droppable(scan, processed), dropped_files(scan), scan.committed()
        for index, files in found.files.items():
            if any(str(path.relative_to(scan.path)) not in recorded for path in files.values()):
                writer.append(_fact(rows[index], list(files), where))
            for path in files.values():
                try:
                    path.unlink(missing_ok=True)
                except OSError as e:
                    raise DeviceError(
                        f"{path}: cannot be removed: {e.strerror}",
                        "you may not write there, or the disk fails",
                        f"mend that, then `polysight drop-raw {scan.path}` deletes the rest",
                        code=ErrorCode.FILE_UNWRITABLE,
                    ) from None
        for folder in {path.parent for files in found.files.values() for path in files.values()}:
            sync_folder(folder)
    scan.reload()


def _fact(row: RowCommitted, boards: list[str], products: str) -> RawDropped:
    files = {n: DroppedFile(b.file, b.bytes, b.crc32) for n, b in row.boards.items() if n in boards}
    return RawDropped(row=row.row, take=row.take, boards=files, products=products, dropped_utc=utc_now())
