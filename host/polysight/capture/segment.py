"""File of one row of one board, and its index of arrivals and gaps.

`<row>.idx` is one JSON line (counts, gaps) followed by int64 little-endian pairs (arrival time on the monotonic clock
in ns, bytes of the row received by then), one pair per batch of packets.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError
from polysight_shared.files import open_to_write, read_bounded

PAIR = np.dtype("<i8")
MAX_INDEX_BYTES = 256 << 20  # sixteen million batches of packets


def _scan_of(path: Path) -> Path:
    """The scan folder of `SCAN/raw/BOARD/ROW.*`; of a file elsewhere, its own folder."""
    return path.parents[2] if path.parent.parent.name == "raw" else path.parent


def write_error(path: Path, done: str, e: OSError) -> DeviceError:
    """Return the error for a file of a scan that cannot be `done`: written, opened, renamed..."""
    full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return DeviceError(
        f"{path}: cannot be {done}: {e.strerror}",
        "the disk is full, read-only or fails",
        f"free space, then `polysight resume {_scan_of(path)}` continues after the last committed row",
        code=ErrorCode.DISK_FULL if full else ErrorCode.FILE_UNWRITABLE,
    )


def damaged(path: Path) -> tuple[str, str]:
    """Return cause and remedy for a row's file that cannot be read."""
    return "the file is damaged or truncated", f"`polysight validate {_scan_of(path)}` names every damaged file"


class Segment:
    """A file of `size` bytes with reserved disk space, which :meth:`finish` writes at once; its folder is made.

    A mapped file could block the receiver while the kernel writes it back, and the receive buffer holds only a quarter
    of a second. A row that is not finished is taken again anyway.

    Raises
    ------
    DeviceError
        if the disk is full or cannot be written.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with ExitStack() as stack:
                self._file = stack.enter_context(open_to_write(path, "w+b", 0))
                stack.callback(path.unlink, missing_ok=True)
                if size:
                    # Reserve the space now: a full disk must be an error here, not after the row.
                    os.posix_fallocate(self._file.fileno(), 0, size)
                stack.pop_all()
        except OSError as e:
            raise write_error(path, f"reserved ({size} bytes)", e) from None

    def finish(self, data: NDArray[np.uint8]) -> int:
        """Write the bytes durably, close the file, and return their CRC-32. Raises DeviceError if the disk fails."""
        left = np.ascontiguousarray(data).data
        crc = zlib.crc32(left)
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError as e:
            raise write_error(self.path, "made durable", e) from None
        finally:
            self.close()
        return crc

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        self._file.close()

    def discard(self) -> None:
        """Close and remove the file."""
        self.close()
        self.path.unlink(missing_ok=True)


def write_index(path: Path, facts: dict[str, Any], arrivals: NDArray[np.int64]) -> int:
    """Write a row's index durably and return its CRC-32. `arrivals` is int64 [n, 2]. Raises DeviceError."""
    head = json.dumps({**facts, "arrivals": len(arrivals)}, sort_keys=True, separators=(",", ":"))
    raw = head.encode("ascii") + b"\n" + arrivals.astype(PAIR).tobytes()
    return write_durably(path, raw)


def write_durably(path: Path, raw: bytes) -> int:
    """Write a file durably and return its CRC-32. Raises DeviceError."""
    try:
        with open_to_write(path) as f:
            f.write(raw)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise write_error(path, "written", e) from None
    return zlib.crc32(raw)


def read_index(path: Path) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Read the facts and arrivals (int64 [n, 2]) of a row's index. Raises DataError if missing or damaged."""
    try:
        head, _, tail = read_bounded(path, MAX_INDEX_BYTES).partition(b"\n")
        facts = json.loads(head)
        pairs = np.frombuffer(tail, dtype=PAIR).reshape(-1, 2).astype(np.int64)
    except (OSError, ValueError, RecursionError) as e:
        what = f"{path}: not a readable row index: {e}"
        raise DataError(what, *damaged(path), code=ErrorCode.FILE_DAMAGED) from None
    if not isinstance(facts, dict) or facts.get("arrivals") != len(pairs):
        raise DataError(f"{path}: the row index is incomplete", *damaged(path), code=ErrorCode.FILE_DAMAGED)
    return facts, pairs
