"""Quality of a processed scan: the figures of quality.json, by row, board and scan; `judge.py` has the verdict on them.

`Quality` collects frames received, positions masked, synchronisation residuals and run time, and what only all rows of
a board show together: the order of its RX, and jumps of its phase.

A jump of the phase between two rows comes, for example, from a cable that was touched. Referencing to the direct path
leaves it if only the echo has it. Echoes of neighbouring positions are alike: a linear predictor from the two rows on
either side, fitted to the rows around, explains an echo but for 15 to 30 % of its amplitude where plates reflect (rows
6 mm apart). If the phase jumps by phi between two rows, the parts of the prediction from the other side of the jump
have to be turned by phi; least squares gives it.

A jump where nothing reflects (gaps between plates, rows at the ends of the scan) is not seen, and one between the last
row of one plate and the first of the next looks like a difference of the plates.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from polysight.imaging import ImageBuilder, Images, describe_imaging
from polysight.materials import MaterialsResult, permittivity_change
from polysight.polarimetry import IncidenceChoice, PlaneReference
from polysight.results import (
    Backlash,
    BoardQuality,
    CalibrationSource,
    Coverage,
    FrequencyRange,
    ReconstructedPositions,
    Residual,
    ScanQuality,
    Verdict,
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
from polysight_shared.raster import plan_raster

# Nothing is calibrated.
NO_FILES: Mapping[str, CalibrationSource] = {}
# Least share of a board's rows that tell another order of the RX; chosen.
OTHER_ORDER_SHARE = 0.1
Count = Annotated[int, msgspec.Meta(ge=0)]

# Rows on either side that an echo is predicted from, and positions on either side in each of them; chosen.
_PREDICTOR_ROWS = (-2, -1, 1, 2)
_PREDICTOR_POSITIONS = 1
# Rows on either side of a jump that the predictor is fitted to, and regularisation relative to its mean power; chosen.
_FIT_ROWS = 6
_RIDGE = 1e-3
# Least jump that is told; chosen.
_LEAST_RAD = np.radians(9)
# Least clearness of a jump: its ratio to the error of the prediction, times how far that ratio stands out from the
# third largest one (a jump's neighbours have a share of it). Of 136 boards in drawn scenes without a jump, two thirds
# of them with rows 6 mm apart, which are predicted badly from their neighbours, the clearest reached 1.5. Of jumps of
# 60 degrees 82 % reach 2, of 30 degrees 65 % (all simulated); with rows 2 mm apart those of 15 degrees reach 11.
_LEAST_CLEAR = 2.0
# The error of the prediction relative to the part that turns, above which a row tells nothing; chosen.
_MAX_ERROR = 1.0
# Least number of rows that tell something: the clearest is compared with the third. Scenes with rows 12 mm apart, where
# a row is not predicted from its neighbours, have 3 to 5, and jumps of their own; others 8 and more.
_LEAST_ROWS = 10
# Times that a jump is measured again with what was found turned back: until then the predictor was fitted across it.
_REPEATS = 2
# Most jumps of a board that are looked for, one after another (a loose cable makes several); chosen.
_MOST_JUMPS = 4
# Rows at either end of a scan, where the predictor is not fitted to both sides; chosen.
_END_ROWS = 3


class RowFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one row and board, as the kept samples store them (docs/spec/samples.md).

    Attributes
    ----------
    frames_expected, frames_received
        Frames of the row, and those that were received whole; counted in chirps, for most frames hold one.
    bytes_missing, crc32
        Bytes of raw data that are missing, and the digest of the recorded payload ("" without one).
    positions, positions_masked
        Positions of the row, and those without usable data.
    masked_columns
        Half-open ranges [start, stop) of masked columns, from the smallest x.
    stages
        Each stage of synchronisation with the standard deviations after it: Hz, rad, and relative amplitude.
    chirps_clipped, chirps_disturbed, positions_clipped
        Chirps left out because the receiver clipped or because they differ from the rest of their burst, and positions
        of which all chirps clipped; 0 in files of earlier releases, which did not look for them.
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
        """Prepare the filters that single out the object's echo, one for samples and one for blocks of them."""
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
        """Place in the rig file of each recorded RX, counted from 1: the order that most rows with another order show.

        Empty if fewer than `OTHER_ORDER_SHARE` of all rows show it; rows without an echo cannot.
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

    def find_phase_jumps(self) -> tuple[PhaseJump, ...]:
        """Find the clear jumps of the echo's phase between two rows, in the order of rows."""
        # A copy: threads may add rows meanwhile.
        rows = dict(self.rows)
        is_searched = rows.keys() == self._searched_rows.keys() and all(
            quality is self._searched_rows[row] for row, quality in rows.items()
        )
        if not is_searched:
            plan = plan_raster(self.rig.grid)
            self._jumps = find_phase_jumps({row: r.echo[:, :: plan.row(row).direction] for row, r in rows.items()})
            self._searched_rows = rows
        return self._jumps

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
        """Return the phase's standard deviation after a synchronisation stage, median over rows, radians, or None."""
        residuals = [r.residuals[stage] for r in self.figures.values() if stage in r.residuals]
        phases = [phase_rad for _, phase_rad, _ in residuals]
        if phases:
            return float(np.median(phases))
        return None

    def summary(self, backlash: bool = True) -> BoardQuality:
        """Return the board's entry of quality.json. Residuals are RMS over rows, weighted by valid positions.

        `backlash=False` skips the estimate of the stage's backlash, which takes 2 ms per row.
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


class PhaseJump(NamedTuple):
    """A jump of the phase of a board's echo: the row that it comes before, and its size in radians."""

    row: int
    angle_rad: float


def find_phase_jumps(rows: Mapping[int, NDArray[np.complexfloating]]) -> tuple[PhaseJump, ...]:
    """Find the clear jumps of the phase from row to row, at most `_MOST_JUMPS`, in the order of rows.

    `rows`: number to echoes, complex [rx, position], positions from the smallest x. Numbers that are missing count as
    rows without echo. What was found is turned back before the next jump is looked for.
    """
    if len(rows) < 2 * _END_ROWS:
        return ()
    first = min(rows)
    shape = next(iter(rows.values())).shape
    echoes = np.zeros((max(rows) - first + 1, *shape), complex)
    for number, echo in rows.items():
        echoes[number - first] = echo
    jumps: list[PhaseJump] = []
    while len(jumps) < _MOST_JUMPS:
        jump = _find_clearest_jump(echoes)
        # What is left of a jump is no jump of its own.
        if jump is None or any(abs(jump.row - other.row) <= 1 for other in jumps):
            break
        echoes[jump.row :] *= np.exp(-1j * jump.angle_rad)
        jumps.append(jump)
    return tuple(PhaseJump(first + jump.row, jump.angle_rad) for jump in sorted(jumps))


def _find_clearest_jump(echoes: NDArray[np.complex128]) -> PhaseJump | None:
    """Find the clearest jump of echoes [row, rx, position]; None if no jump is clear."""
    angles, errors = _measure_jumps(echoes)
    is_sound = errors < _MAX_ERROR
    ratio = np.zeros(len(angles))
    ratio[is_sound] = np.abs(angles[is_sound]) / errors[is_sound]
    if np.count_nonzero(is_sound) < _LEAST_ROWS:
        return None
    row = int(np.argmax(ratio))
    third = float(np.sort(ratio[is_sound])[-3])
    is_clear = ratio[row] ** 2 > _LEAST_CLEAR * third
    angle = float(angles[row])
    if not is_clear or abs(angle) < _LEAST_RAD:
        return None
    for _ in range(_REPEATS):
        turned = echoes.copy()
        turned[row:] *= np.exp(-1j * angle)
        angle += float(_measure_jumps(turned)[0][row])
    return PhaseJump(row, angle)


def _measure_jumps(echoes: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the jump before each row, radians, and the error of its prediction, [row]; the error is inf if unknown."""
    count, rx, positions = echoes.shape
    padded = np.pad(echoes, ((0, 0), (0, 0), (_PREDICTOR_POSITIONS, _PREDICTOR_POSITIONS)))
    taps = 2 * _PREDICTOR_POSITIONS + 1
    # [row, rx, position, tap]
    shifted = np.stack([padded[:, :, k : k + positions] for k in range(taps)], axis=-1)
    angles = np.zeros(count)
    errors = np.full(count, np.inf)
    targets = range(-_PREDICTOR_ROWS[0], count - _PREDICTOR_ROWS[-1])
    # Neighbours [rx * position, tap] of each target by row, and the sums of least squares over each target's row.
    neighbours = {k: [shifted[k + d].reshape(rx * positions, taps) for d in _PREDICTOR_ROWS] for k in targets}
    products = {}
    for k in targets:
        together = np.concatenate(neighbours[k], axis=1)
        products[k] = together.conj().T @ together, together.conj().T @ echoes[k].ravel()
    for jump in range(_END_ROWS, count - _PREDICTOR_ROWS[-1]):
        fitted = [k for k in range(jump - _FIT_ROWS, jump + _FIT_ROWS) if k in products]
        normal = np.sum([products[k][0] for k in fitted], axis=0)
        power = float(np.trace(normal).real) / len(normal)
        if power == 0:
            continue
        right = np.sum([products[k][1] for k in fitted], axis=0)
        predictor = np.linalg.solve(normal + _RIDGE * power * np.eye(len(normal)), right).reshape(
            len(_PREDICTOR_ROWS), taps
        )
        turn = 0j
        turned_power = 0.0
        residual = 0.0
        for k in range(jump + _PREDICTOR_ROWS[0], jump + _PREDICTOR_ROWS[-1]):
            if k not in products:
                continue
            beyond = np.zeros(rx * positions, complex)
            unpredicted = echoes[k].ravel().copy()
            for d, values, weights in zip(_PREDICTOR_ROWS, neighbours[k], predictor, strict=True):
                is_beyond = (k + d >= jump) != (k >= jump)
                if is_beyond:
                    beyond += values @ weights
                else:
                    unpredicted -= values @ weights
            # Rows before the jump see it turned one way, rows behind it the other way.
            product = np.vdot(beyond, unpredicted)
            turn += product.conjugate() if k < jump else product
            turned_power += float(np.vdot(beyond, beyond).real)
            residual += float(np.vdot(unpredicted - beyond, unpredicted - beyond).real)
        if turned_power > 0:
            angles[jump] = float(np.angle(turn))
            left = max(residual - 2 * (abs(turn) - turn.real), 0.0)
            errors[jump] = max(float(np.sqrt(left / turned_power)), 1e-6)
    return angles, errors


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
        # Rows are processed in several threads, which all add to `seconds`.
        self._lock = threading.Lock()

    @property
    def boards_masked(self) -> list[str]:
        """Boards with rows of which no position has a direct path."""
        return [name for name, b in self.boards.items() if b.positions and b.positions_masked == b.positions]

    def remove_phase_jumps(self, builders: Iterable[ImageBuilder]) -> None:
        """Turn rows back by each board's phase jumps, in all images that the builders form.

        The longest section without a jump keeps its phase.
        """
        for name, board in self.boards.items():
            jumps = board.find_phase_jumps()
            angles_rad = np.zeros(self.source.plan.rows)
            for jump in jumps:
                angles_rad[jump.row :] -= jump.angle_rad
            ends = [0, *(jump.row for jump in jumps), len(angles_rad)]
            longest = int(np.argmax(np.diff(ends)))
            angles_rad -= angles_rad[ends[longest]]
            for builder in builders:
                builder.boards[name].turn_rows(angles_rad)

    @property
    def jump_rad(self) -> float:
        """Largest jump of a board's phase between two rows of the scan, radians; 0 if none was found."""
        jumps = [jump for board in self.boards.values() for jump in board.find_phase_jumps()]
        return max((abs(jump.angle_rad) for jump in jumps), default=0.0)

    def coverage(self) -> Coverage:
        """Compare rows, positions and frames with the plan; missing rows count as not received."""
        plan = self.source.plan
        boards = list(self.boards.values())
        absent = [row for row in range(plan.rows) if any(row not in board.rows for board in boards)]
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
            boards={name: board.summary(backlash) for name, board in self.boards.items()},
            coverage=self.coverage(),
            seconds_per_stage=self.seconds_per_stage,
            verdict=verdict or UNSET,
            pixel_accuracy=pixel_accuracy,
        )
