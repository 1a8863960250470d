"""Quality of a processed scan: the figures of quality.json, by row, board and scan; `judge.py` has the verdict on them.

`Quality` collects frames received, positions masked, synchronisation residuals and run time. It also holds what is
found from all rows of a board together: the order of its RX, and jumps and drift of its phase (`row_phases.py`).
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from polysight.imaging import ImageBuilder, Images, describe_imaging
from polysight.materials import MaterialsResult, find_interiors, measure_along_plates, permittivity_change
from polysight.polarimetry import IncidenceChoice, PlaneReference
from polysight.process.row_phases import (
    DRIFT_DONE_RAD,
    JUMP_LEFT,
    LEAST_PLATES,
    MOST_DRIFT_ROUNDS,
    NOT_DISPLACED,
    DisplacedRows,
    estimate_phase_drift,
    find_displaced_rows,
    find_phase_jumps,
    keep_jumps_without_shifts,
)
from polysight.results import (
    Backlash,
    BoardQuality,
    CalibrationSource,
    Coverage,
    FrequencyRange,
    PhaseJump,
    ReconstructedPositions,
    RemovedDrift,
    Residual,
    ScanQuality,
    Verdict,
    rules,
)
from polysight.store import CubeRow, RowData, Source
from polysight.sync import (
    SyncedRow,
    block_frequencies_hz,
    estimate_backlash,
    judge_rx_order,
    object_filter,
    prepare,
    sample_frequencies_hz,
)
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.raster import plan_raster

# Nothing is calibrated.
NO_FILES: Mapping[str, CalibrationSource] = {}
# Least share of a board's rows that must show the same other order of the RX; chosen.
OTHER_ORDER_SHARE = 0.1
Count = Annotated[int, msgspec.Meta(ge=0)]


class RowFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one row and board, as the kept samples store them (docs/spec/samples.md).

    Attributes
    ----------
    frames_expected, frames_received
        Frames of the row, and those that were received whole. A frame is one chirp here.
    bytes_missing, crc32
        Bytes of raw data that are missing, and the digest of the recorded payload ("" without one).
    positions, positions_masked
        Positions of the row, and those without usable data.
    masked_columns
        Half-open ranges [start, stop) of masked columns, from the smallest x.
    stages
        Each stage of synchronisation with the standard deviations after it: Hz, rad, and relative amplitude.
    chirps_clipped, chirps_disturbed, positions_clipped
        Numbers of chirps left out because the receiver clipped, and because they differ from the rest of their burst;
        number of positions of which all chirps clipped. 0 in files of earlier releases, which did not count them.
    dead_rx
        RX without a signal, counted from 1.
    rx_order
        Places in the rig file of the recorded RX, counted from 1, if the row has a direct path only in this order.
    """

    frames_expected: Count
    frames_received: Count
    bytes_missing: Count
    crc32: str
    positions: Count
    positions_masked: Count
    masked_columns: list[tuple[Count, Count]]
    stages: list[tuple[str, float, float, float]]
    chirps_clipped: Count = 0
    chirps_disturbed: Count = 0
    positions_clipped: Count = 0
    dead_rx: list[Count] = []
    rx_order: list[Count] = []

    @property
    def residuals(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations after each stage, by its name."""
        return {name: (frequency, phase, amplitude) for name, frequency, phase, amplitude in self.stages}


@dataclass(frozen=True)
class RowQuality:
    """Figures of one row and board, and what is known of each position, in order of recording.

    Attributes
    ----------
    figures
        The row's figures.
    direct_hz, direct_snr
        float64 [position]: intermediate frequency (IF) of the direct path, NaN where not valid, and its SNR, see
        `_compute_direct_snr`.
    echo
        complex64 [rx, position]: echo of the place that mirrors TX into RX, for the estimate of the stage's backlash.
    direct
        complex [rx]: mean of the samples, the direct path.
    """

    figures: RowFigures
    direct_hz: NDArray[np.float64]
    direct_snr: NDArray[np.float64]
    echo: NDArray[np.complex64]
    direct: NDArray[np.complexfloating]


@dataclass
class BoardRows:
    """Quality figures of one board of a calibrated rig, by row; a row added again replaces its earlier figures."""

    rig: Instrument
    board: Board
    rows: dict[int, RowQuality] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Prepare the filters that select the object's echo: one for rows of samples, one for rows of blocks."""
        sweeps = sample_frequencies_hz(self.rig.chirp), block_frequencies_hz(self.rig.chirp)
        self._filters = {sweep.size: object_filter(self.rig, self.board, sweep) for sweep in sweeps}
        self._path = prepare(self.rig, self.board)
        # Order of the RX that each row shows; empty if it is the rig file's, or not known.
        self._orders: dict[int, tuple[int, ...]] = {}
        # The latest jumps that were looked for, and the rows in which they were.
        self._jumps: tuple[PhaseJump, ...] = ()
        self._searched_rows: dict[int, RowQuality] = {}

    def add(self, row: int, recorded: RowData | CubeRow, frames_valid: int, synced: SyncedRow) -> None:
        """Compute and store the figures of a synchronised row, of which `frames_valid` frames were received whole."""
        # Positions are in the order of recording: odd rows are turned round, so that columns count from the smallest x.
        mask = ~synced.valid[:: plan_raster(self.rig.grid).row(row).direction]
        figures = RowFigures(
            frames_expected=recorded.frames_expected,
            frames_received=frames_valid,
            bytes_missing=recorded.missing_bytes,
            crc32=recorded.crc32,
            positions=int(synced.valid.size),
            positions_masked=int(synced.valid.size - synced.valid.sum()),
            masked_columns=find_masked_runs(mask),
            stages=[(name, *spread) for name, spread in synced.stages.items() if np.isfinite(spread).all()],
            chirps_clipped=synced.chirps_clipped,
            chirps_disturbed=synced.chirps_disturbed,
            positions_clipped=synced.positions_clipped,
            dead_rx=synced.dead_rx,
            rx_order=list(synced.rx_order),
        )
        direct_hz = np.where(synced.valid, synced.direct_hz, np.nan)
        echo = synced.through(self._filters[synced.sweep_hz.size])
        self.rows[row] = RowQuality(
            figures, direct_hz, _compute_direct_snr(synced), echo, synced.samples.mean(axis=(1, 2))
        )
        self._orders.pop(row, None)

    @property
    def figures(self) -> dict[int, RowFigures]:
        """Figures by row, ascending (threads add rows in any order)."""
        return {row: quality.figures for row, quality in sorted(self.rows.items())}

    @property
    def positions(self) -> int:
        """Number of positions in the recorded rows."""
        return sum(r.positions for r in self.figures.values())

    @property
    def positions_masked(self) -> int:
        """Number of recorded positions without usable data."""
        return sum(r.positions_masked for r in self.figures.values())

    @property
    def frames_expected(self) -> int:
        """Number of frames in the recorded rows."""
        return sum(r.frames_expected for r in self.figures.values())

    @property
    def frames_received(self) -> int:
        """Number of frames that were received whole."""
        return sum(r.frames_received for r in self.figures.values())

    @property
    def dead_rx(self) -> dict[int, list[int]]:
        """RX without a signal, counted from 1, to the rows in which they gave none."""
        figures = self.figures
        numbers = sorted({rx for r in figures.values() for rx in r.dead_rx})
        return {rx: [row for row, r in figures.items() if rx in r.dead_rx] for rx in numbers}

    @property
    def rx_order(self) -> list[int]:
        """Place in the rig file of each recorded RX, counted from 1, if it is another order than the rig file's.

        It is the most frequent other order; empty if fewer than `OTHER_ORDER_SHARE` of all rows show it. Rows without
        an echo show none.
        """
        for row, quality in list(self.rows.items()):
            if row not in self._orders:
                self._orders[row] = tuple(quality.figures.rx_order) or judge_rx_order(
                    quality.direct, quality.echo, self._path
                )
        orders = Counter(order for order in list(self._orders.values()) if order)
        if not orders:
            return []
        order, rows = orders.most_common(1)[0]
        if rows < OTHER_ORDER_SHARE * len(self.rows):
            return []
        return list(order)

    def list_echoes(self) -> dict[int, NDArray[np.complexfloating]]:
        """Return the echoes of all rows, complex [rx, position], positions from the smallest x."""
        plan = plan_raster(self.rig.grid)
        # A copy: threads may add rows meanwhile.
        rows = dict(self.rows)
        return {row: quality.echo[:, :: plan.row(row).direction] for row, quality in rows.items()}

    def find_phase_jumps(self, shifts: NDArray[np.float64] | None = None) -> tuple[PhaseJump, ...]:
        """Find the clear jumps of the echo's phase between two rows, in the order of rows.

        `shifts` [round, row] are those of displaced rows (:class:`DisplacedRows`); None without any.
        """
        rows = dict(self.rows)
        if not _hold_same_rows(rows, self._searched_rows):
            self._jumps = find_phase_jumps(self.list_echoes())
            self._searched_rows = rows
        if shifts is None or not self._jumps:
            return self._jumps
        return keep_jumps_without_shifts(self._jumps, self.list_echoes(), shifts)

    @property
    def direct_snr_db(self) -> float | None:
        """Median SNR of the direct path in one sample of one chirp and channel, dB.

        The value is None if it is unknown (cubes that another program synchronised).
        """
        values = _collect_finite_values([r.direct_snr for r in self.rows.values()])
        if values.size:
            return float(10 * np.log10(np.median(values)))
        return None

    def residual(self, stage: str) -> float | None:
        """Return the phase's standard deviation after a synchronisation stage, radians: median over rows, or None."""
        residuals = [r.residuals[stage] for r in self.figures.values() if stage in r.residuals]
        phases = [phase_rad for _, phase_rad, _ in residuals]
        if phases:
            return float(np.median(phases))
        return None

    def summary(self, backlash: bool = True, removed_jumps: Sequence[PhaseJump] = ()) -> BoardQuality:
        """Return the board's entry of quality.json. Residuals are RMS over rows, weighted by valid positions.

        `backlash=False` skips the estimate of the stage's backlash, which takes 2 ms per row. `removed_jumps` are the
        jumps of the phase that were removed from the images.
        """
        figures = self.figures
        direct = _collect_finite_values([self.rows[row].direct_hz for row in figures])
        snr = self.direct_snr_db
        if snr is not None:
            snr = round(snr, 2)
        shift = None
        if backlash:
            shift = self._estimate_backlash()
        return BoardQuality(
            frames_expected=self.frames_expected,
            frames_received=self.frames_received,
            bytes_missing=sum(r.bytes_missing for r in figures.values()),
            positions=self.positions,
            positions_masked=self.positions_masked,
            frames_masked=self.frames_expected - self.frames_received,
            chirps_clipped=sum(r.chirps_clipped for r in figures.values()),
            chirps_disturbed=sum(r.chirps_disturbed for r in figures.values()),
            positions_clipped=sum(r.positions_clipped for r in figures.values()),
            dead_rx=self.dead_rx,
            rx_order=self.rx_order,
            phase_jumps=list(removed_jumps),
            direct_path_hz=_find_frequency_range(direct),
            direct_path_snr_db=snr,
            stage_backlash_mm=shift,
            masked_columns={row: r.masked_columns for row, r in figures.items() if r.masked_columns},
            rows_recorded=list(figures),
            raw_crc32={row: r.crc32 for row, r in figures.items() if r.crc32},
            synchronisation=_collect_residuals(list(figures.values())),
        )

    def _estimate_backlash(self) -> Backlash | None:
        """Return the shift of odd rows towards +x relative to the plan, estimated from echoes; None if undetermined."""
        estimate = estimate_backlash({row: quality.echo for row, quality in self.rows.items()}, self.rig)
        if estimate is None:
            return None
        return Backlash(shift=round(estimate.shift, 4), std=round(estimate.std, 4))


def _hold_same_rows(rows: Mapping[int, RowQuality], others: Mapping[int, RowQuality]) -> bool:
    """Return true if both hold the same rows, none of them added again."""
    return rows.keys() == others.keys() and all(quality is others[row] for row, quality in rows.items())


def _find_frequency_range(direct_hz: NDArray[np.float64]) -> FrequencyRange | UnsetType:
    """Return median, least and largest IF, Hz; unset without any."""
    if direct_hz.size == 0:
        return UNSET
    return FrequencyRange(float(np.median(direct_hz)), float(direct_hz.min()), float(direct_hz.max()))


def _collect_residuals(rows: list[RowFigures]) -> dict[str, Residual]:
    """Return the RMS over rows of the residuals after each stage, weighted by valid positions."""
    residuals = {}
    for stage in dict.fromkeys(name for row in rows for name in row.residuals):
        rows_with_stage = [row for row in rows if stage in row.residuals]
        weights = np.array([row.positions - row.positions_masked for row in rows_with_stage], np.float64)
        squares = np.array([row.residuals[stage] for row in rows_with_stage], np.float64) ** 2
        frequency, phase, amplitude = np.sqrt(weights @ squares / weights.sum()).tolist()
        residuals[stage] = Residual(frequency_std_hz=frequency, phase_std_rad=phase, amplitude_std=amplitude)
    return residuals


def _compute_direct_snr(row: SyncedRow) -> NDArray[np.float64]:
    """Return the SNR of the direct path in one sample of one chirp and channel, power ratio, float64 [position].

    NaN at invalid positions and where the noise is unknown.
    """
    snr = np.full(row.valid.size, np.nan)
    if row.noise is not None:
        is_measured = row.valid & np.isfinite(row.noise) & (row.noise > 0)
        snr[is_measured] = row.direct_amplitude[is_measured] ** 2 / row.noise[is_measured]
    return snr


def _collect_finite_values(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the finite values of all rows in one array [value]."""
    if not rows:
        return np.zeros(0)
    values = np.concatenate(rows)
    return values[np.isfinite(values)]


def find_masked_runs(masked: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the half-open ranges [start, stop) of True values, ascending."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(np.int8), [0]])))
    return [(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


class Quality:
    """Collects the quality figures of a scan during processing.

    `rig` is the source's rig, calibrated with the files `calibration`, by kind.

    Attributes
    ----------
    source
        The scan.
    boards
        Figures of each receiving board, by its name.
    seconds
        Wall time of each stage.
    notes
        Entries of quality.json that others add, by their name.
    filled
        Reconstructed positions of each board that has any.
    drift
        Drift of one board's phase that was removed from the images; None: none.
    """

    def __init__(
        self, rig: Instrument, source: Source, calibration: Mapping[str, CalibrationSource] = NO_FILES
    ) -> None:
        self.source = source
        self.boards = {board.name: BoardRows(rig, board) for board in rig.receivers}
        self.seconds: dict[str, float] = {}
        self.notes: dict[str, Any] = {}
        if calibration:
            self.notes["calibration"] = dict(calibration)
        self.filled: Mapping[str, ReconstructedPositions] = {}
        self.drift: RemovedDrift | None = None
        # Jumps that were removed from the images, of each board that has any.
        self._removed_jumps: dict[str, tuple[PhaseJump, ...]] = {}
        self._displaced = NOT_DISPLACED
        # The rows of each board in which displaced rows were looked for.
        self._searched: list[dict[int, RowQuality]] = []
        # Rows are processed in several threads, which all add to `seconds`.
        self._lock = threading.Lock()

    @property
    def boards_masked(self) -> list[str]:
        """Boards with rows of which no position has a direct path."""
        return [name for name, b in self.boards.items() if b.positions and b.positions_masked == b.positions]

    def find_displaced_rows(self) -> DisplacedRows:
        """Find rows that are not where the stage was commanded: both boards show it."""
        rows = [dict(board.rows) for board in self.boards.values()]
        is_searched = len(rows) == len(self._searched) and all(map(_hold_same_rows, rows, self._searched))
        if not is_searched:
            echoes = [board.list_echoes() for board in self.boards.values()]
            self._displaced = find_displaced_rows(echoes, self.source.plan.step_y_mm)
            self._searched = rows
        return self._displaced

    def find_phase_jumps(self) -> dict[str, tuple[PhaseJump, ...]]:
        """Find the clear jumps of the phase of each board's echo, by its name."""
        displaced = self.find_displaced_rows()
        if displaced.rms_mm > 0:
            return {name: board.find_phase_jumps(displaced.shifts) for name, board in self.boards.items()}
        return {name: board.find_phase_jumps() for name, board in self.boards.items()}

    def form_images(self, builder: ImageBuilder, others: Iterable[ImageBuilder]) -> Images:
        """Return the builder's images without jumps of a board's phase and without its drift over the rows.

        The rows are turned back in all images that this builder and the `others` form.
        """
        builders = (builder, *others)
        self.drift = None
        self._remove_phase_jumps(builders)
        return self._remove_phase_drift(builders)

    def _remove_phase_jumps(self, builders: Iterable[ImageBuilder]) -> None:
        """Turn rows back by each board's phase jumps; the longest section without a jump keeps its phase."""
        self._removed_jumps = self.find_phase_jumps()
        for name, jumps in self._removed_jumps.items():
            angles_rad = np.zeros(self.source.plan.rows)
            for jump in jumps:
                angles_rad[jump.row :] -= jump.angle_rad
            ends = [0, *(jump.row for jump in jumps), len(angles_rad)]
            longest = int(np.argmax(np.diff(ends)))
            angles_rad -= angles_rad[ends[longest]]
            for builder in builders:
                builder.boards[name].turn_rows(angles_rad)

    def _remove_phase_drift(self, builders: Sequence[ImageBuilder]) -> Images:
        """Return the first builder's images without a drift of one board's phase over the rows, if that is clear.

        Nothing is done where positions are missing or the phase jumps: what is left of those looks like a drift.
        """
        images = builders[0].finish()
        if self.lacks_positions or any(self.find_phase_jumps().values()):
            return images
        plates = measure_along_plates(images, find_interiors(images))
        if len(plates) < LEAST_PLATES:
            return images
        drift = estimate_phase_drift(plates)
        if not drift.clear:
            return images
        h, v = self.boards
        name, sign = (v, 1) if drift.of_v else (h, -1)
        rig = self.boards[name].rig
        middle_m = specular_midpoint_m(rig, self.boards[name].board)[1]
        y_m = middle_m + np.array([row.y_mm for row in plan_raster(rig.grid)]) / 1e3
        removed_rad = drift.at(y_m)
        # Drift that the images still have: root mean square difference between two plates. All of it, until images
        # without it are measured.
        remaining_rad = float(np.sqrt(2)) * drift.rms_rad
        for _ in range(MOST_DRIFT_ROUNDS):
            for builder in builders:
                builder.boards[name].turn_rows(sign * removed_rad)
            images = builders[0].finish()
            plates = measure_along_plates(images, find_interiors(images))
            if len(plates) < LEAST_PLATES:
                break
            drift = estimate_phase_drift(plates, (y_m, removed_rad))
            change_rad = drift.at(y_m) - removed_rad
            remaining_rad = float(np.sqrt(2) * np.std(change_rad))
            if np.std(change_rad) < DRIFT_DONE_RAD:
                break
            # Half of the change: with all of it the estimates oscillate about the drift.
            removed_rad = removed_rad + change_rad / 2
        self.drift = RemovedDrift(
            board=name,
            range_rad=drift.range_rad,
            rms_rad=drift.rms_rad,
            left_rad=float(np.hypot(drift.left_rad, remaining_rad)),
        )
        return images

    @property
    def lacks_positions(self) -> bool:
        """True if more than a share `SOME_POSITIONS` of a board's positions have no data and were not reconstructed."""
        if self.filled:
            return False
        rows_absent = len(self._list_absent_rows()) / max(1, self.source.plan.rows)
        # A board without any position lacks all of them.
        masked = [b.positions_masked / b.positions if b.positions else 1.0 for b in self.boards.values()]
        return max(rows_absent, *masked) > rules.SOME_POSITIONS

    def _list_absent_rows(self) -> list[int]:
        """Return the rows of the plan that some board lacks."""
        boards = list(self.boards.values())
        return [row for row in range(self.source.plan.rows) if any(row not in board.rows for board in boards)]

    @property
    def phase_left_rad(self) -> float:
        """Standard deviation of a plate's phase by what may be left of removed jumps and drifts, radians."""
        jumps = [abs(jump.angle_rad) for of_board in self.find_phase_jumps().values() for jump in of_board]
        left_of_drift = 0.0 if self.drift is None else self.drift.left_rad
        return float(np.hypot(JUMP_LEFT * max(jumps, default=0.0), left_of_drift))

    def coverage(self) -> Coverage:
        """Compare rows, positions and frames with the plan; missing rows count as not received."""
        plan = self.source.plan
        boards = list(self.boards.values())
        absent = self._list_absent_rows()
        frames_a_position = self.source.instrument.burst.chirps_a_position
        # A cube that another program synchronised holds the average of each position.
        if self.source.synchronised:
            frames_a_position = 1
        return Coverage(
            rows_planned=plan.rows,
            rows_recorded=plan.rows - len(absent),
            frames_planned=len(boards) * plan.positions * frames_a_position,
            frames_received=sum(board.frames_received for board in boards),
            manifest=tuple(f"{fault.where}: {fault.what}" for fault in self.source.manifest_faults),
            rows_absent=tuple(absent),
            positions_planned=plan.positions,
            positions_absent=len(absent) * plan.columns,
        )

    def add_entries(self, **entries: Any) -> None:
        """Add entries to quality.json, as `ScanQuality` declares them."""
        self.notes |= entries

    def note_imaging(self, builder: ImageBuilder, images: Images) -> None:
        """Add the point response of the aperture to quality.json."""
        with self.measure_time("point response"):
            self.add_entries(imaging=describe_imaging(builder, images))

    def note_filled(self, filled: Mapping[str, ReconstructedPositions]) -> None:
        """Add the errors of reconstructed positions, by board, to quality.json and the verdict."""
        self.filled = filled
        self.add_entries(sparse=dict(filled))

    def add_materials(
        self, result: MaterialsResult, angles: IncidenceChoice, valid: NDArray[np.bool_], plane: PlaneReference | None
    ) -> None:
        """Add the effect of the incidence angle and the use of the metal plate to quality.json.

        `valid` as of :meth:`IncidenceChoice.facts`.
        """
        self.add_entries(incidence=msgspec.structs.replace(angles.facts(valid), **permittivity_change(result, angles)))
        if plane is not None:
            self.add_entries(metal_reference=plane.facts())

    @contextmanager
    def measure_time(self, stage: str) -> Iterator[None]:
        """Add the wall time of a block to a stage; parallel rows add up."""
        started_s = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - started_s

    @property
    def seconds_per_stage(self) -> dict[str, float]:
        """Wall time of each stage, s, as quality.json holds it."""
        return {stage: round(s, 4) for stage, s in self.seconds.items()}

    def result(
        self, verdict: Verdict | None = None, pixel_accuracy: float | None = None, backlash: bool = True
    ) -> ScanQuality:
        """Return the content of quality.json; `backlash=False` leaves the estimate of the stage's backlash out."""
        return ScanQuality(
            **self.notes,
            boards={
                name: board.summary(backlash, self._removed_jumps.get(name, ())) for name, board in self.boards.items()
            },
            coverage=self.coverage(),
            rows_displaced_mm=self._displaced.rms_mm or UNSET,
            phase_drift=self.drift or UNSET,
            seconds_per_stage=self.seconds_per_stage,
            verdict=verdict or UNSET,
            pixel_accuracy=pixel_accuracy,
        )
