"""Quality figures of a scan (quality.json): frames received, positions masked, synchronisation residuals, run time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from polysight.imaging import ImageBuilder, Images, imaging_facts
from polysight.materials import MaterialsResult, permittivity_change
from polysight.polarimetry import IncidenceChoice, PlaneReference
from polysight.results import (
    Backlash,
    BoardQuality,
    Coverage,
    FrequencyRange,
    Residual,
    ScanQuality,
    Verdict,
    plain,
)
from polysight.store import CubeRow, RowData, Source
from polysight.sync import SyncedRow, echo_of_row, estimate_backlash, object_filter
from polysight_shared.config import Board, Instrument
from polysight_shared.raster import plan_raster


@dataclass
class BoardRows:
    """Quality figures of one board, by row; adding a row again replaces its earlier figures."""

    rig: Instrument
    board: Board
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)
    echoes: dict[int, NDArray[np.complex64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._filter = object_filter(self.rig, self.board)

    def add(self, row: int, recorded: RowData | CubeRow, frames_valid: int, synced: SyncedRow) -> None:
        """Compute and store the figures of a synchronised row."""
        figures = {
            "frames_expected": recorded.frames_expected,
            "frames_received": frames_valid,
            "bytes_missing": recorded.missing_bytes,
            "crc32": recorded.crc32,
            "positions": int(synced.valid.size),
            "positions_masked": int(synced.valid.size - synced.valid.sum()),
            "masked_columns": masked_runs(~synced.valid[:: plan_raster(self.rig.grid).row(row).direction]),
            "direct_hz": np.where(synced.valid, synced.direct_hz, np.nan),
            "stages": {name: spread for name, spread in synced.stages.items() if np.isfinite(spread).all()},
            "direct_snr": _direct_snr(synced),
        }
        self.put(row, figures, echo_of_row(synced, self._filter))

    def put(self, row: int, figures: dict[str, Any], echo: NDArray[np.complex64]) -> None:
        """Store figures of a row that :meth:`add` computed earlier."""
        self.rows[row], self.echoes[row] = figures, echo

    @property
    def positions(self) -> int:
        """Number of positions in the recorded rows."""
        return sum(r["positions"] for r in self.rows.values())

    @property
    def positions_masked(self) -> int:
        """Number of recorded positions without usable data."""
        return sum(r["positions_masked"] for r in self.rows.values())

    @property
    def frames_share(self) -> float:
        """Share of the frames of recorded rows that were received whole, 0 to 1."""
        expected = sum(r["frames_expected"] for r in self.rows.values())
        return sum(r["frames_received"] for r in self.rows.values()) / expected if expected else 0.0

    @property
    def direct_snr_db(self) -> float | None:
        """Median SNR of the direct path in one sample of one chirp and channel, dB.

        None if unknown (cubes that another program synchronised).
        """
        values = _known([r["direct_snr"] for r in self.rows.values()])
        return float(10 * np.log10(np.median(values))) if values.size else None

    def residual(self, stage: str) -> float | None:
        """Return the standard deviation of the phase after a synchronisation stage, radians; None if unknown."""
        found = [r["stages"][stage][1] for r in self.rows.values() if stage in r["stages"]]
        return float(np.median(found)) if found else None

    def summary(self, backlash: bool = True) -> BoardQuality:
        """Return the board's entry of quality.json. Residuals are RMS over rows, weighted by valid positions.

        `backlash=False` skips the estimate of the stage's backlash, which takes 2 ms per row.
        """
        ordered = dict(sorted(self.rows.items()))  # threads add rows in any order
        expected = sum(row["frames_expected"] for row in ordered.values())
        received = sum(row["frames_received"] for row in ordered.values())
        direct = _known([row["direct_hz"] for row in ordered.values()])
        snr = self.direct_snr_db
        return BoardQuality(
            frames_expected=expected,
            frames_received=received,
            bytes_missing=sum(row["bytes_missing"] for row in ordered.values()),
            positions=self.positions,
            positions_masked=self.positions_masked,
            frames_masked=expected - received,
            direct_path_hz=_frequency_range(direct) if direct.size else UNSET,
            direct_path_snr_db=None if snr is None else round(snr, 2),
            stage_backlash_mm=self._backlash() if backlash else None,
            masked_columns={
                row: figures["masked_columns"] for row, figures in ordered.items() if figures["masked_columns"]
            },
            rows_recorded=list(ordered),
            raw_crc32={number: row["crc32"] for number, row in ordered.items() if row["crc32"]},
            synchronisation=_residuals(list(ordered.values())),
        )

    def _backlash(self) -> Backlash | None:
        """Return the shift of odd rows towards +x relative to the plan, estimated from echoes; None if undetermined."""
        estimate = estimate_backlash(self.echoes, self.rig)
        if estimate is None:
            return None
        return Backlash(shift=round(estimate.shift_mm, 4), std=round(estimate.std_mm, 4))


def _frequency_range(direct_hz: NDArray[np.float64]) -> FrequencyRange:
    return FrequencyRange(float(np.median(direct_hz)), float(direct_hz.min()), float(direct_hz.max()))


def _residuals(rows: list[dict[str, Any]]) -> dict[str, Residual]:
    """Return the RMS over rows of the residuals after each stage, weighted by valid positions."""
    residuals = {}
    for stage in dict.fromkeys(name for row in rows for name in row["stages"]):
        with_stage = [row for row in rows if stage in row["stages"]]
        weights = np.array([row["positions"] - row["positions_masked"] for row in with_stage], np.float64)
        squares = np.array([row["stages"][stage] for row in with_stage], np.float64) ** 2
        frequency, phase, amplitude = np.sqrt(weights @ squares / weights.sum()).tolist()
        residuals[stage] = Residual(frequency_std_hz=frequency, phase_std_rad=phase, amplitude_std=amplitude)
    return residuals


def _direct_snr(row: SyncedRow) -> NDArray[np.float64]:
    """Return the SNR of the direct path in one sample of one chirp and channel, power ratio, float64 [position].

    NaN at invalid positions and where the noise is unknown.
    """
    out = np.full(row.valid.size, np.nan)
    if row.noise is not None:
        good = row.valid & np.isfinite(row.noise) & (row.noise > 0)
        out[good] = row.direct_amplitude[good] ** 2 / row.noise[good]
    return out


def _known(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the finite values of all rows in one array."""
    values = np.concatenate(rows) if rows else np.zeros(0)
    return values[np.isfinite(values)]


def masked_runs(masked: NDArray[np.bool_]) -> list[list[int]]:
    """Return the half-open ranges [start, stop) of True values, ascending."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(np.int8), [0]])))
    return edges.reshape(-1, 2).tolist()


class Quality:
    """Collects the quality figures of a scan during processing; `rig` is the source's rig, calibrated."""

    def __init__(self, rig: Instrument, source: Source) -> None:
        self.source = source
        self.boards = {board.name: BoardRows(rig, board) for board in rig.receivers}
        self.seconds: dict[str, float] = {}
        self.notes: dict[str, Any] = {}
        self._lock = threading.Lock()  # rows are processed in several threads

    @property
    def boards_masked(self) -> list[str]:
        """Boards with rows of which no position has a direct path."""
        return [name for name, b in self.boards.items() if b.positions and b.positions_masked == b.positions]

    def coverage(self) -> Coverage:
        """Compare rows, positions and frames with the plan; missing rows count as not received."""
        plan, boards = self.source.plan, list(self.boards.values())
        absent = [row for row in range(plan.rows) if any(row not in board.rows for board in boards)]
        frames_at = 1 if self.source.synchronised else self.source.instrument.burst.chirps_a_position
        return Coverage(
            rows_planned=plan.rows,
            rows_recorded=plan.rows - len(absent),
            frames_planned=len(boards) * plan.positions * frames_at,
            frames_received=sum(row["frames_received"] for board in boards for row in board.rows.values()),
            manifest=tuple(f"{fault.where}: {fault.what}" for fault in self.source.manifest_faults),
            rows_absent=tuple(absent),
            positions_planned=plan.positions,
            positions_absent=len(absent) * plan.columns,
        )

    def note(self, **entries: Any) -> None:
        """Add entries to quality.json."""
        self.notes |= entries

    def note_imaging(self, builder: ImageBuilder, images: Images) -> None:
        """Add the point response of the aperture to quality.json."""
        with self.timed("point response"):
            self.note(imaging=imaging_facts(builder, images))

    def note_materials(
        self, found: MaterialsResult, angles: IncidenceChoice, valid: NDArray[np.bool_], plane: PlaneReference | None
    ) -> None:
        """Add the effect of the incidence angle and the use of the metal plate to quality.json."""
        self.note(incidence={**angles.facts(valid), **permittivity_change(found, angles)})
        if plane is not None:
            self.note(metal_reference=plane.facts())

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of a block to a stage; parallel rows add up."""
        began = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began

    def result(
        self, verdict: Verdict | None = None, pixel_accuracy: float | None = None, backlash: bool = True
    ) -> ScanQuality:
        """Return the content of quality.json; `backlash=False` leaves the estimate of the stage's backlash out."""
        notes = msgspec.convert(plain(self.notes), ScanQuality)
        return msgspec.structs.replace(
            notes,
            boards={name: board.summary(backlash) for name, board in self.boards.items()},
            coverage=self.coverage(),
            seconds_per_stage={stage: round(s, 4) for stage, s in self.seconds.items()},
            verdict=verdict or UNSET,
            pixel_accuracy=pixel_accuracy,
        )
