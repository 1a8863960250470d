"""What processing needs from recorded data, wherever it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from polysight.host.store.manifest import ManifestFault
from polysight.shared.config import Instrument
from polysight.shared.errors import DataError
from polysight.shared.raster import RasterPlan


@dataclass(frozen=True)
class RowData:
    """One board's recording of one row.

    Attributes
    ----------
    payload
        uint8 [frames_expected * bytes of a chirp]: the card's payload as sent, zero where bytes are missing.
    missing
        Byte ranges (start, stop) of `payload` that never arrived: sorted, not touching, half open.
    frames_expected
        Chirps in `payload`: points of the row x chirps of a position. Most frames are one chirp.
    crc32
        Digest the payload was recorded with, hexadecimal; empty where the recording keeps none.
    """

    payload: NDArray[np.uint8]
    missing: list[tuple[int, int]]
    frames_expected: int
    crc32: str = ""

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
    """One board's row of a scan that another program has synchronised: no bytes of the card are known of it.

    Attributes
    ----------
    cube
        complex64 [rx, position, sample], positions as they were met, referenced as the other program left them.
    """

    cube: NDArray[np.complex64]
    missing_bytes: int = 0
    crc32: str = ""

    @property
    def frames_expected(self) -> int:
        """One for each position."""
        return self.cube.shape[1]


class Scan(Protocol):
    """What every scan tells, however it was recorded."""

    @property
    def instrument(self) -> Instrument:
        """The rig file the scan was made with; of a mirrored scan the rig mirrored in x = y."""
        ...

    @property
    def plan(self) -> RasterPlan:
        """Where every position is."""
        ...

    @property
    def simulated(self) -> bool:
        """True if the data was simulated."""
        ...

    @property
    def scan_id(self) -> str:
        """Name of the scan."""
        ...


class Source(Scan, Protocol):
    """Recorded rows of one scan: a scan folder of ours, or the published data read as one."""

    @property
    def mirrored(self) -> bool:
        """True if it was recorded column by column: rig, plan and images are then mirrored in x = y."""
        ...

    @property
    def synchronised(self) -> bool:
        """True if another program has synchronised it already: the chirps are not in it."""
        ...

    @property
    def manifest_faults(self) -> tuple[ManifestFault, ...]:
        """Damaged and missing lines of the manifest; empty for a recording that keeps none."""
        ...

    def rows(self) -> Iterator[int]:
        """Indices of the rows that hold data, ascending."""
        ...

    def read_row(self, board_name: str, row: int) -> RowData | CubeRow:
        """One board's recording of one row. Raises DataError if it is absent or damaged."""
        ...

    def recording_facts(self) -> dict[str, Any]:
        """Entries of quality.json on how the scan was recorded: rows retaken, losses by board, notices."""
        ...


class RawSource(Source, Protocol):
    """A source with the chirps still in it. Build with :func:`raw_source`."""

    def read_row(self, board_name: str, row: int) -> RowData:
        """One board's recording of one row. Raises DataError if it is absent or damaged."""
        ...


def raw_source(source: Source, where: Path) -> RawSource:
    """The same source, when the chirps are in it.

    Raises
    ------
    DataError
        if another program has synchronised it.
    """
    if source.synchronised:
        raise DataError(
            f"{where}: the chirps are not in it",
            "these cubes were synchronised already, by the authors",
            "give the same scan's unsynced/ folder",
        )
    return cast(RawSource, source)
