"""Rows of kept samples on disk (docs/spec/samples.md): the lines of rows.jsonl, and a check of every record.

`process/samples.py` makes and restores the samples. This file needs nothing of the processing, so that `validate`
and `drop-raw` check them.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.store import manifest
from polysight.store.logs import crc32
from polysight.store.manifest import BoardRow
from polysight.store.scan_folder import ScanFolder
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError

SAMPLES = "samples"
SAMPLE_ROWS = "rows.jsonl"


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
    """Return a board's records, memory-mapped, one per row; None if the file cannot be read."""
    try:
        return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


def record_digest(record: Any) -> str:
    """Return the CRC of a record as in rows.jsonl."""
    return f"{crc32(record.tobytes()):08x}"


def damaged_samples(scan: ScanFolder) -> dict[int, list[str]]:
    """Check the kept samples of all committed rows; return the rows without whole samples, with the files to blame."""
    folder, boards = scan.path / SAMPLES, [board.name for board in scan.instrument.receivers]
    lines, _ = read_sample_rows(folder)
    records = {name: open_records(folder / f"{name}.npy") for name in boards}
    found: dict[int, list[str]] = {}
    for row, committed in scan.committed().items():
        saved = lines.get(row, {}).get("boards", {})
        if any(name not in saved or saved[name]["raw"] != raw_digest(committed.boards[name]) for name in boards):
            found[row] = [f"{SAMPLES}/{SAMPLE_ROWS}"]
            continue
        bad = [name for name in boards if not _is_whole(records[name], scan.plan.rows, row, saved[name]["crc32"])]
        if bad:
            found[row] = [f"{SAMPLES}/{name}.npy" for name in bad]
    return found


@contextmanager
def locked_samples(scan: ScanFolder) -> Iterator[None]:
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
            "the samples of this scan are not kept: its raw data is all there is to make images from",
            f"`polysight process {scan.path} --out DIR` keeps them",
            code=ErrorCode.FILE_MISSING,
        ) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
    return records is not None and records.shape == (rows,) and record_digest(records[row]) == digest


def _is_row(line: Mapping[str, Any]) -> bool:
    """True if a line of rows.jsonl has a row number and the entries of its boards."""
    boards = line.get("boards")
    return (
        isinstance(line.get("row"), int)
        and isinstance(boards, dict)
        and all(isinstance(b, dict) and {"crc32", "raw", "figures"} <= b.keys() for b in boards.values())
    )
