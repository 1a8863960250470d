"""The `Source` protocol: recorded rows of one scan in any layout, as processing reads them.

A *frame* is what a radar records for one trigger pulse: one chirp, or several. A *position* is a place of the stage.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan

Pieces = Callable[[int], Iterator[NDArray[np.uint8]]]
"""Given a size in bytes (0: everything), iterates over a payload in pieces of this size; each is valid until the next.

Raises DataError if the payload cannot be read or is damaged, at the latest after the last piece.
"""

HEADER_LOCK = threading.Lock()
"""Held while numpy reads the head of a file: it parses it as Python, and the parser of CPython 3.11 fails now and then
("AST constructor recursion depth mismatch") when two threads are in it."""


# Bytes of a page of memory and of the page cache.
_PAGE = 4096


def allocate_pages(size: int) -> NDArray[np.uint8]:
    """Return uninitialised memory, uint8 [size], that starts at a page, to read a file into from its start.

    Large arrays of NumPy start 16 bytes after a page's start. There Zen 3 copies a file's pages at a sixth of the
    speed (64 KB: 34 us instead of 5.5): loads wait for the stores before them, which have nearly the same place in
    another page.
    """
    memory = np.empty(size + _PAGE, np.uint8)
    first = -memory.ctypes.data % _PAGE
    return memory[first : first + size]


def split_pieces(payload: NDArray[np.uint8]) -> Pieces:
    """Return a function that yields a payload in memory, uint8 [byte], in pieces of `size` bytes; 0: in one piece."""

    def pieces(size: int) -> Iterator[NDArray[np.uint8]]:
        step = size or max(1, payload.size)
        for start in range(0, payload.size, step):
            yield payload[start : start + step]

    return pieces


@dataclass(frozen=True)
class RowData:
    """One board's recording of one row. It is read when needed: in pieces that fit the processor's cache, or whole."""

    # Payload as sent by the card, [frames_expected * bytes of a chirp]; zero where missing.
    pieces: Pieces
    # Byte ranges (start, stop) that never arrived: sorted, not touching, half open.
    missing: list[tuple[int, int]]
    # Chirps in `payload`, also where a frame has several: positions of the row x chirps of a position.
    frames_expected: int
    # Digest of the recorded payload, hexadecimal; "" if the recording has none.
    crc32: str = ""

    @cached_property
    def payload(self) -> NDArray[np.uint8]:
        """The whole payload, uint8 [byte]; empty if nothing was recorded."""
        # Read to the end: damage is raised only after the last piece.
        pieces = list(self.pieces(0))
        if not pieces:
            return np.empty(0, np.uint8)
        return pieces[0]

    @property
    def missing_bytes(self) -> int:
        """Number of bytes that never arrived."""
        return sum(stop - start for start, stop in self.missing)

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Bool [bytes], True where a byte is missing; None if the row is complete."""
        if not self.missing:
            return None
        mask = np.zeros(self.payload.size, dtype=np.bool_)
        for start, stop in self.missing:
            mask[start:stop] = True
        return mask


@dataclass(frozen=True)
class CubeRow:
    """One board's row of a scan that another program has synchronised; the card's data is not available."""

    # [rx, position, sample], in the order of recording; phases relative to that program's reference.
    cube: NDArray[np.complex64]
    missing_bytes: int = 0
    crc32: str = ""

    @property
    def frames_expected(self) -> int:
        """Number of frames: one for each position."""
        return self.cube.shape[1]


class Scan(Protocol):
    """Description of a scan in any layout."""

    @property
    def instrument(self) -> Instrument:
        """The rig file of the scan; mirrored in x = y for a mirrored scan."""
        ...

    @property
    def plan(self) -> RasterPlan:
        """The plan of positions."""
        ...

    @property
    def simulated(self) -> bool:
        """True for simulated data."""
        ...

    @property
    def scan_id(self) -> str:
        """Name of the scan."""
        ...


class Source(Scan, Protocol):
    """Recorded rows of one scan: a scan folder of ours, or the published data read as one."""

    @property
    def mirrored(self) -> bool:
        """True if recorded column by column: rig, plan and images are then mirrored in x = y."""
        ...

    @property
    def synchronised(self) -> bool:
        """True if another program has synchronised the scan and the chirps are not available."""
        ...

    @property
    def manifest_faults(self) -> tuple[Finding, ...]:
        """Damaged and missing lines of the manifest; empty for a recording without one."""
        ...

    def rows(self) -> Iterator[int]:
        """Return the indices of the rows with data, ascending."""
        ...

    def read_row(self, board_name: str, row: int) -> RowData | CubeRow:
        """Read one board's recording of one row. Raises DataError if it is missing or damaged."""
        ...

    def recording_facts(self) -> dict[str, Any]:
        """Return the entries of quality.json about the recording: rows retaken, losses by board, notices."""
        ...


class RawSource(Source, Protocol):
    """A source that contains the chirps. Construct with :func:`raw_source`."""

    def read_row(self, board_name: str, row: int) -> RowData:
        """Read one board's recording of one row. Raises DataError if it is missing or damaged."""
        ...


def raw_source(source: Source, where: Path) -> RawSource:
    """Return the source if it contains the chirps. Raises DataError if another program has synchronised it."""
    if source.synchronised:
        raise DataError(
            f"{where}: does not contain the chirps",
            "these cubes were synchronised already, by the authors",
            "give the same scan's unsynced/ folder",
            code=ErrorCode.NO_DATA,
        )
    return cast(RawSource, source)
