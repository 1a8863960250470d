"""Quality of a processed scan: the figures of quality.json, the verdict on it, and the error budget of its results.

`Quality` collects frames received, positions masked, synchronisation residuals and run time. `judge` weighs the
evidence of recording, rig and scene.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from polysight.imaging import ImageBuilder, Images, PlaneEstimate, imaging_facts
from polysight.materials import NOT_PASSIVE, STRONGER_V, Classifier, MaterialsResult, find_copies, permittivity_change
from polysight.polarimetry import IncidenceChoice, PlaneReference
from polysight.results import (
    Backlash,
    BoardQuality,
    CalibrationSource,
    Coverage,
    ErrorBudget,
    FrequencyRange,
    IncidenceError,
    LeakageError,
    MetalScore,
    PlaneError,
    ReconstructedPositions,
    Residual,
    ScanQuality,
    Verdict,
    check_plate,
    check_reasons,
    join_reasons,
    rules,
)
from polysight.store import CubeRow, RowData, Source
from polysight.sync import SyncedRow, block_frequencies_hz, estimate_backlash, object_filter, sample_frequencies_hz
from polysight_shared.config import Board, CheckPlate, Instrument
from polysight_shared.findings import Finding
from polysight_shared.raster import plan_raster

# Nothing is calibrated.
NO_FILES: Mapping[str, CalibrationSource] = {}
Count = Annotated[int, msgspec.Meta(ge=0)]


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
    """

    figures: RowFigures
    direct_hz: NDArray[np.float64]
    direct_snr: NDArray[np.float64]
    echo: NDArray[np.complex64]


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
        )
        direct_hz = np.where(synced.valid, synced.direct_hz, np.nan)
        echo = synced.through(self._filters[synced.sweep_hz.size])
        self.rows[row] = RowQuality(figures, direct_hz, _compute_direct_snr(synced), echo)

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
    def direct_snr_db(self) -> float | None:
        """Median SNR of the direct path in one sample of one chirp and channel, dB.

        None if unknown (cubes that another program synchronised).
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
        return Backlash(shift=round(estimate.shift_mm, 4), std=round(estimate.std_mm, 4))


def _find_frequency_range(direct_hz: NDArray[np.float64]) -> FrequencyRange | UnsetType:
    """Return median, least and largest IF, Hz; unset without any."""
    if direct_hz.size == 0:
        return UNSET
    return FrequencyRange(float(np.median(direct_hz)), float(direct_hz.min()), float(direct_hz.max()))


def _collect_residuals(rows: list[RowFigures]) -> dict[str, Residual]:
    """Return the RMS over rows of the residuals after each stage, weighted by valid positions."""
    residuals = {}
    for stage in dict.fromkeys(name for row in rows for name in row.residuals):
        with_stage = [row for row in rows if stage in row.residuals]
        weights = np.array([row.positions - row.positions_masked for row in with_stage], np.float64)
        squares = np.array([row.residuals[stage] for row in with_stage], np.float64) ** 2
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

    def note(self, **entries: Any) -> None:
        """Add entries to quality.json, as `ScanQuality` declares them."""
        self.notes |= entries

    def note_imaging(self, builder: ImageBuilder, images: Images) -> None:
        """Add the point response of the aperture to quality.json."""
        with self.measure_time("point response"):
            self.note(imaging=imaging_facts(builder, images))

    def note_filled(self, filled: Mapping[str, ReconstructedPositions]) -> None:
        """Add the errors of reconstructed positions, by board, to quality.json and the verdict."""
        self.filled = filled
        self.note(sparse=dict(filled))

    def note_materials(
        self, result: MaterialsResult, angles: IncidenceChoice, valid: NDArray[np.bool_], plane: PlaneReference | None
    ) -> None:
        """Add the effect of the incidence angle and the use of the metal plate to quality.json.

        `valid` as of :meth:`IncidenceChoice.facts`.
        """
        self.note(incidence=msgspec.structs.replace(angles.facts(valid), **permittivity_change(result, angles)))
        if plane is not None:
            self.note(metal_reference=plane.facts())

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


def recording_verdict(quality: Quality) -> list[Finding]:
    """Return reasons from recording and synchronisation: rows, frames, manifest, and the direct path of each board."""
    coverage = quality.coverage()
    positions = sum(b.positions for b in quality.boards.values())
    masked = sum(b.positions_masked for b in quality.boards.values())
    missing: list[Finding] = []
    for name, board in quality.boards.items():
        share_with_path = _divide(board.positions - board.positions_masked, board.positions, default=0.0)
        received = _divide(board.frames_received, board.frames_expected, default=0.0)
        # Positions without a whole frame have no direct path either; do not count that loss twice.
        share_of_received = _divide(share_with_path, received, default=1.0)
        missing += rules.judge_direct_path(name, board.direct_snr_db, board.residual("averaged"), share_of_received)
        missing += _report_disturbances(name, list(board.figures.values()))
        missing += rules.judge_dead_rx(name, board.dead_rx, len(board.rows))
    recorded = rules.judge_recording(coverage, _divide(masked, positions, default=1.0))
    filled = [(board, e.missing_share, e.image_error) for board, e in quality.filled.items()]
    return recorded + missing + rules.judge_reconstruction(filled)


def _divide(part: float, whole: float, default: float) -> float:
    """Return part / whole; `default` if there is no whole."""
    if not whole:
        return default
    return part / whole


def _report_disturbances(name: str, rows: list[RowFigures]) -> list[Finding]:
    """Return reasons from the chirps of a board that were left out."""
    chirps = sum(r.frames_received for r in rows)
    positions = sum(r.positions for r in rows)
    clipped = sum(r.chirps_clipped for r in rows)
    disturbed = sum(r.chirps_disturbed for r in rows)
    positions_clipped = sum(r.positions_clipped for r in rows)
    return rules.judge_left_out_chirps(
        name,
        clipped=clipped / max(1, chirps),
        disturbed=disturbed / max(1, chirps),
        positions_clipped=positions_clipped / max(1, positions),
    )


def judge(
    quality: Quality,
    result: MaterialsResult,
    plane: PlaneEstimate | None,
    classifier: Classifier | None,
    check: CheckPlate,
) -> Verdict:
    """Return the verdict on a processed scan.

    Parameters
    ----------
    quality
        Figures of all rows.
    result
        Patches, metal reference and joint inversion.
    plane
        Plane of the plates; None if it was not estimated.
    classifier
        The classifier that named the patches; None without naming.
    check
        The rig file's plate of known permittivity.
    """
    reasons = recording_verdict(quality) + scene_reasons(result, plane, classifier)
    if check.name:
        reasons += check_reasons(check_plate(check, result.rows()))
    return join_reasons(reasons)


def scene_reasons(result: MaterialsResult, plane: PlaneEstimate | None, classifier: Classifier | None) -> list[Finding]:
    """Return reasons from the scene and its images; parameters are those of :func:`judge`."""
    reasons: list[Finding] = []
    refused = {r.patch.label: r.refused.what for r in result.patches if r.refused is not None}
    no_half_spaces = _find_no_half_spaces(result)
    no_plates = {k: v for k, v in refused.items() if k not in no_half_spaces}
    # Patches and images.
    reasons += rules.judge_patches(no_plates, len(result.patches), len(result.segmentation.left_out))
    pixel_mm = abs(float(result.calibrated.x_m[1] - result.calibrated.x_m[0])) * 1e3
    copies = find_copies([r.patch for r in result.patches], result.calibrated.h, result.calibrated.v, pixel_mm)
    if copies is not None:
        reasons += rules.judge_copies(copies.labels, copies.shift_mm, copies.level_db)
    reasons += rules.judge_image_shift(result.apart_mm)
    if result.drift is not None:
        reasons += rules.judge_drift(*result.drift.largest_drift(), result.drift.drifts)
        reasons += rules.judge_fringes(result.drift.fringes)
    reasons += rules.judge_halo(result.halo)
    reasons += rules.judge_background(result.behind)
    reasons += rules.judge_flatness(result.ripple, result.relief_rad, is_boxed=bool(result.boxes))
    reasons += rules.judge_disturbed_plates(result.errors_by_disturbance())
    reasons += rules.judge_passivity(no_half_spaces)
    # Many plates with more V than H: the channels may be exchanged.
    plates = len(result.patches) - len(no_plates) - (result.metal.label is not None)
    reasons += rules.judge_exchange([k for k, v in no_half_spaces.items() if v.what == STRONGER_V], plates)
    metal = result.metal
    if result.patches and metal.evidence is not None:
        evidence = metal.evidence
        patch = "the given box" if metal.label is None else f"patch {metal.label}"
        enough = evidence.enough and (metal.given or metal.label not in refused)
        reasons += rules.judge_metal(
            patch,
            likely=enough,
            certain=enough and evidence.sure,
            is_given=metal.given,
            contradicted=evidence.against,
            only_patch=evidence.others == 0,
            culprit=evidence.culprit,
            painted=result.inversion.painted,
            paint_mm=result.inversion.paint_mm,
        )
        if metal.given:
            reasons += rules.judge_dark_reference(patch, *_find_brightest(result))
    # Levels of metal relative to the direct path, boards, leakage, and the plane.
    light = result.calibrated.illumination
    if result.prior.channels_known and (light is None or light.known):
        gains = {"H": result.calibrated.metal_h, "V": result.calibrated.metal_v}
        reasons += rules.judge_levels({channel: _measure_median_level(gain) for channel, gain in gains.items()})
    reasons += rules.judge_moved_boards(result.inversion.moved)
    reasons += rules.judge_leakage(
        result.prior.leakage_measured, result.inversion.leakage_determined, _estimate_leakage_error(result)
    )
    if plane is not None:
        std = float(np.degrees(result.prior.theta_std_rad))
        tilt = (float(np.degrees(plane.tilt_rad[0])), float(np.degrees(plane.tilt_rad[1])))
        reasons += rules.judge_plane(plane.known, 1e3 * plane.offset_m, tilt, std)
    # Plates that have a permittivity: their tilts and brightness, and the angle of the library.
    judged = {r.patch.label for r in result.patches if r.refused is None}
    reasons += rules.judge_tilts({k: float(np.degrees(result.tilts.across_rad(k))) for k in judged})
    reasons += rules.judge_brightness({k: ln for k, ln in result.brightness_off.items() if k in judged})
    if classifier is not None and len(classifier.angles_deg) == 1:
        angle = float(np.degrees(np.mean(result.theta_rad)))
        reasons += rules.judge_incidence(angle, float(classifier.angles_deg[0]))
    return reasons


def _find_no_half_spaces(result: MaterialsResult) -> dict[int, Finding]:
    """Return patch number to the reason why a patch is a plate but no half space (not noise or several materials)."""
    return {
        r.patch.label: r.refused
        for r in result.patches
        if r.refused is not None
        and (r.refused.what == STRONGER_V or (r.refused.what in NOT_PASSIVE and r.permittivity.value is not None))
    }


def _find_brightest(result: MaterialsResult) -> tuple[int, float]:
    """Return the number of the brightest patch but the metal, and its median |H| relative to metal, dB; 0, 0: none."""
    levels_db = {}
    for r in result.patches:
        h = np.abs(result.h[r.patch.interior])
        levels = h[np.isfinite(h) & (h > 0)]
        if levels.size and r.patch.label != result.metal.label:
            levels_db[r.patch.label] = 20 * float(np.log10(np.median(levels)))
    brightest = max(levels_db, key=lambda label: levels_db[label], default=0)
    return brightest, levels_db.get(brightest, 0.0)


def _measure_median_level(gain: npt.NDArray[np.complexfloating] | complex | None) -> float | None:
    """Return the median magnitude of metal's gain where it is known; None if it is known nowhere.

    `gain` is a number, or an image [ny, nx] that a plate need not cover.
    """
    if gain is None:
        return None
    magnitude = np.abs(np.asarray(gain))
    magnitude = magnitude[np.isfinite(magnitude)]
    if magnitude.size == 0:
        return None
    return float(np.median(magnitude))


def _estimate_leakage_error(result: MaterialsResult) -> float:
    """Return the median relative error of the permittivities due to leakage; 0 without permittivities."""
    parts = []
    for r in result.patches:
        e = r.permittivity
        if e.value is not None and e.covariance is not None and e.shares:
            share = e.shares.get("leakage", 0.0)
            parts.append(float(np.sqrt(share * np.trace(e.covariance) / 2)) / abs(e.value))
    if parts:
        return float(np.median(parts))
    return 0.0


def error_budget(result: MaterialsResult, plane: PlaneEstimate | None) -> ErrorBudget:
    """Return `error_budget` of materials.json: leakage, incidence angle, plane and evidence for metal."""
    inversion = result.inversion
    source = "prior and scene"
    if result.prior.leakage_measured:
        source = "measured"
    elif inversion.leakage_determined:
        source = "scene"
    evidence = result.metal.evidence
    metal = None
    if evidence is not None:
        ratio_db = evidence.channel_ratio_db
        if ratio_db is not None:
            ratio_db = round(ratio_db, 2)
        metal = MetalScore(
            score=round(evidence.score, 2),
            others=evidence.others,
            channel_ratio_db=ratio_db,
            painted=round(inversion.painted, 3),
            paint_mm=round(inversion.paint_mm, 3),
        )
    leakage_h, leakage_v = inversion.leakage
    removed_h, removed_v = inversion.known_leakage(result.prior)
    std_h, std_v = inversion.leakage_std
    angle_deg = float(np.degrees(np.mean(result.theta_rad) + inversion.theta_error_rad))
    angle_std_deg = float(np.degrees(inversion.theta_std_rad))
    plane_error = PlaneError()
    if plane is not None:
        plane_error = msgspec.convert(plane.to_dict(), PlaneError)
    return ErrorBudget(
        leakage=LeakageError(
            h=_round_complex(leakage_h),
            v=_round_complex(leakage_v),
            std=(round(std_h, 5), round(std_v, 5)),
            source=source,
            removed_h=_round_complex(removed_h),
            removed_v=_round_complex(removed_v),
        ),
        incidence=IncidenceError(deg=round(angle_deg, 4), std_deg=round(angle_std_deg, 4)),
        plane=plane_error,
        metal=metal,
    )


def _round_complex(value: complex) -> tuple[float, float]:
    """Return real and imaginary part, rounded for the file."""
    return round(value.real, 5), round(value.imag, 5)
