"""Raw rows dropped by choice once they are processed: the digest stays in the manifest, the payload goes.

A row's line is written before its files are removed, and says which: whatever ends the program in between, what the
manifest calls dropped may still be there, and what it does not is there. Running it again removes the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from polysight.host.store.append_only import crc32, sync_folder
from polysight.host.store.manifest import Fact
from polysight.host.store.scan_folder import CommittedRow, ScanFolder, utc_now
from polysight.shared.errors import DataError, DeviceError, ScanError

Digests = dict[str, dict[int, str]]
"""CRC-32 (hex) of the payload a product was made from, by board and row."""


@dataclass(frozen=True)
class Droppable:
    """What may be dropped: files by row, and why the other rows may not."""

    files: dict[int, dict[str, Path]]
    bytes: int
    kept: list[str] = field(default_factory=list)


def dropped_files(scan: ScanFolder) -> dict[str, Fact]:
    """Payload files, relative to the scan folder, that were dropped by choice, each with the fact that says so."""
    files: dict[str, tuple[int, Fact]] = {}
    for fact in scan.content.facts:
        if fact["fact"] in ("row_committed", "row_withdrawn"):  # taken again: its files are new
            files = {file: row_fact for file, row_fact in files.items() if row_fact[0] != fact["row"]}
        elif fact["fact"] == "raw_dropped":
            files |= {board["file"]: (fact["row"], fact) for board in fact["boards"].values()}
    return {file: fact for file, (_, fact) in files.items()}


def require_raw(scan: ScanFolder) -> None:
    """Refuse what needs the raw rows of a scan whose rows were dropped. Raises DataError."""
    facts = list(dropped_files(scan).values())
    if facts:
        raise DataError(
            f"{scan.path}: the raw data of {len({f['row'] for f in facts})} rows is not there any more",
            f"it was dropped on {facts[-1]['dropped_utc'][:10]}, after it was processed into {facts[-1]['products']}",
            "use those products; a new scan is needed to process again, or the raw folder of a copy",
        )


def droppable(scan: ScanFolder, processed: Digests) -> Droppable:
    """The files of every row that was processed as it was committed, and that are still there and the same.

    Parameters
    ----------
    scan
        A finished scan.
    processed
        What the saved products were made from.

    Raises
    ------
    ScanError
        if rows are missing: they could still be taken, and the image made again from all of them.
    """
    rows = scan.committed()
    missing = scan.plan.rows - len(rows)
    if missing:
        raise ScanError(
            f"{scan.path}: {missing} of {scan.plan.rows} rows are not committed",
            "the image of the whole scan needs the raw data of every row",
            f"`polysight resume {scan.path}` first",
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
                    kept.append(f"{board.file}: not the bytes that were committed")
            elif board.file not in dropped_files(scan):
                why = "not processed" if digest is None else "not the bytes the products were made from"
                kept.append(f"{board.file}: {why}")
    there = [path for boards in files.values() for path in boards.values()]
    return Droppable(files, sum(path.stat().st_size for path in there), kept)


def drop(scan: ScanFolder, processed: Digests, products: Path) -> None:
    """Write down and remove, row by row, what :func:`droppable` finds once nobody else writes the scan.

    Raises
    ------
    DeviceError
        if the scan is in use, or the disk fails; what was not removed yet is removed by the next call.
    """
    sync_folder(products)  # what was made from them must not be lost to a power cut
    inside = products.resolve().is_relative_to(scan.path.resolve())
    where = str(products.resolve().relative_to(scan.path.resolve()) if inside else products.resolve())
    with scan.writer() as writer:
        scan.reload()
        what, told, rows = droppable(scan, processed), dropped_files(scan), scan.committed()
        for index, files in what.files.items():
            if any(str(path.relative_to(scan.path)) not in told for path in files.values()):
                writer.append(_fact(rows[index], list(files), where))
            for path in files.values():
                try:
                    path.unlink(missing_ok=True)
                except OSError as e:
                    raise DeviceError(
                        f"{path}: cannot be removed: {e.strerror}",
                        "you may not write there, or the disk fails",
                        f"then `polysight drop-raw {scan.path}` goes on",
                    ) from None
        for folder in {path.parent for files in what.files.values() for path in files.values()}:
            sync_folder(folder)
    scan.reload()


def _fact(row: CommittedRow, boards: list[str], products: str) -> Fact:
    said = {n: {"file": b.file, "bytes": b.bytes, "crc32": b.crc32} for n, b in row.boards.items() if n in boards}
    return {
        "fact": "raw_dropped",
        "row": row.row,
        "take": row.take,
        "boards": said,
        "products": products,
        "dropped_utc": utc_now(),
    }
