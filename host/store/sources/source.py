"""What processing needs from recorded data, wherever it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from polysight.shared.config import Instrument
from polysight.shared.raster import RasterPlan


@dataclass(frozen=True)
class RowData:
    """One board's recording of one row.

    Attributes
    ----------
    payload
        uint8 [frames_expected * frame bytes]: the card's payload as sent, zero where bytes are missing.
    missing
        Byte ranges (start, stop) of `payload` that never arrived: sorted, not touching, half open.
    frames_expected
        Frames in `payload`: points of the row x pulses of a burst.
    crc32
        Digest the payload was recorded with, hexadecimal; empty where the recording keeps none.
    """

    payload: NDArray[np.uint8]
    missing: list[tuple[int, int]]
    frames_expected: int
    crc32: str = ""

    @classmethod
    def none(cls, positions: int) -> RowData:
        """What stands for a row that was synchronised elsewhere: a frame for each position, and no bytes."""
        return cls(np.zeros(0, np.uint8), [], positions)

    @property
    def missing_bytes(self) -> int:
        """Number of bytes that never arrived."""
        return sum(stop - start for start, stop in self.missing)

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Bool [bytes], True where a byte is missing; None when the row is complete."""
        if not self.missing:
            return None
        mask = np.zeros(self.payload.size, dtype=np.bool_)
        for start, stop in self.missing:
            mask[start:stop] = True
        return mask


class Scan(Protocol):
    """What every scan tells, however it was recorded."""

    @property
    def instrument(self) -> Instrument:
        """The rig file the scan was made with."""
        ...

    @property
    def plan(self) -> RasterPlan:
        """Where every position is."""
        ...

    @property
    def simulated(self) -> bool:
        """Whether the data was simulated."""
        ...

    @property
    def scan_id(self) -> str:
        """Name of the scan."""
        ...

    def rows(self) -> Iterator[int]:
        """Indices of the rows that hold data, ascending."""
        ...


class ScanSource(Scan, Protocol):
    """A recorded scan: a scan folder, or another layout read as one."""

    def read_row(self, board_name: str, row: int) -> RowData:
        """One board's recording of one row. Raises DataError when it is absent or damaged."""
        ...


class SyncedSource(Scan, Protocol):
    """A scan that another program has synchronised."""

    def read_synced(self, board_name: str, row: int) -> NDArray[np.complex64]:
        """One board's row, complex64 [rx, column, sample], column 0 the smallest x. Raises DataError."""
        ...

    def recording(self) -> dict[str, Any]:
        """What quality.json says of how it was recorded."""
        ...
