"""`polysight drop-raw`: delete raw data of processed rows after a typed confirmation."""

from __future__ import annotations

import sys
from pathlib import Path

from polysight.jobs.cards import confirm
from polysight.products import QUALITY, RAW_DROPPED, REPORT, products_locked, read_products, write_json
from polysight.store import (
    Digests,
    ScanFolder,
    damaged_samples,
    drop,
    droppable,
    dropped_rows,
    locked_samples,
    utc_now,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError

WORD = "drop"  # confirms the removal of raw rows


def drop_raw(folder: Path, products: Path | None, yes: bool) -> int:
    """Delete the raw data of processed rows after confirmation; return the exit status.

    Products with a report and whole samples of every row must remain; no other program may be writing them.

    Raises
    ------
    DataError
        when products or samples are not complete, or were made from nothing of this scan.
    ConfigError
        when it is not confirmed, or products are being written; nothing was removed.
    DeviceError
        when the scan is being processed or recorded.
    """
    scan = ScanFolder.load(folder)
    payloads = [scan.path / board.file for row in scan.committed().values() for board in row.boards.values()]
    if dropped_rows(scan) and not any(path.exists() for path in payloads):
        sys.stdout.write(f"{folder}: every processed row is dropped already\n")
        return 0
    products = read_products(products or folder, REPORT).folder
    with products_locked(products), locked_samples(scan):
        return _drop(scan, folder, products, yes)


def _drop(scan: ScanFolder, folder: Path, products: Path, yes: bool) -> int:
    processed = processed_digests(products)
    what = droppable(scan, processed)
    for line in what.kept:
        sys.stdout.write(f"kept: {line}\n")
    if not what.files:
        if what.kept:
            raise DataError(
                f"{folder}: nothing can be dropped",
                f"{products} is made from none of its rows",
                f"`polysight process {folder} --out DIR`, then --products DIR",
            )
        sys.stdout.write(f"{folder}: every processed row is dropped already\n")
        return 0
    _check_samples(scan, set(what.files))
    text = (
        f"{folder}: the raw data of {len(what.files)} rows, {what.bytes / 1e6:.1f} MB, is removed. {products} and"
        " the kept samples stay: images and materials can be made again, but not synchronised again."
    )
    for where in sorted({path.parent for boards in what.files.values() for path in boards.values()}):
        names = sorted(path.name for boards in what.files.values() for path in boards.values() if path.parent == where)
        sys.stdout.write(f"to be removed: {where.relative_to(folder)}: {', '.join(names)}\n")
    answer = confirm(text, WORD, yes)
    if answer != WORD:
        raise ConfigError(f"nothing dropped: answered {answer!r}", f"{WORD!r} was asked for", f"type {WORD}, or --yes")
    _keep(products, scan)
    drop(scan, processed, products)
    sys.stdout.write(f"{folder}: dropped; its digests stay in the manifest\n")
    return 0


def _check_samples(scan: ScanFolder, rows: set[int]) -> None:
    """Check that images can be made without the raw data of these rows. Raises DataError."""
    damaged = {row: names for row, names in damaged_samples(scan).items() if row in rows}
    if not damaged:
        from polysight.pipeline import Pipeline

        samples = Pipeline(scan, samples="read").samples
        damaged = {row: ["samples/samples.json: other settings"] for row in rows if not samples.is_kept(row)}
    if damaged:
        names = sorted({name for files in damaged.values() for name in files})
        raise DataError(
            f"{scan.path}: samples of rows {', '.join(map(str, damaged))} are damaged or missing: {', '.join(names)}",
            "without them the raw data is all there is to make images from",
            f"`polysight process {scan.path} --out DIR` makes them again",
            code=ErrorCode.FILE_DAMAGED,
        )


def _keep(products: Path, scan: ScanFolder) -> None:
    """Mark the products as the only remaining data of the scan, so that they are never overwritten."""
    mark = {"scan_id": scan.scan_id, "scan": str(scan.path.resolve()), "dropped_utc": utc_now()}
    write_json(products / QUALITY, {**read_products(products).quality, RAW_DROPPED: mark})


def processed_digests(folder: Path) -> Digests:
    """Return the CRCs of the processed rows, by board. Raises DataError."""
    products = read_products(folder)
    _ = products.image  # raises when it cannot be read
    try:
        boards = products.quality["boards"]
        return {name: {int(r): str(crc) for r, crc in b["raw_crc32"].items()} for name, b in boards.items()}
    except (ValueError, KeyError, AttributeError, TypeError) as e:
        raise DataError(
            f"{products.folder / QUALITY}: does not say what it was made from: {e}",
            "made by an earlier release, damaged, or from another program's recordings",
            "`polysight process SCAN --out DIR` makes it again",
        ) from None
