"""Forecast of a scan from its rig file: time, data, point response, alias-free field, noise, and warnings.

`scan_time` estimates the duration: rows with their ramps, turns, and the standstill between rows
(docs/spec/stage-line.md, "A row"); motion has trapezoidal speed with constant acceleration.
`imaging.compute_field_limits` gives the distance from an object to its nearest ghost for a step size, and the mirror
zone around flat plates. `forecast` returns all of it; `find_warnings` only the warnings, which include settings that
stage, Pi or radars would refuse.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight import imaging
from polysight.capture import PACKET_TIME_US
from polysight.process import explain_unnamed
from polysight.radar import list_constraints
from polysight.settings import DEFAULT
from polysight.sync import PUBLISHED_STD
from polysight_shared.config import CARD_TAIL_S, Instrument
from polysight_shared.errors import ConfigError
from polysight_shared.findings import Finding
from polysight_shared.raster import Grid, Stage, burst_duration_s, check_burst_fits, plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

ROW_OVERHEAD_S = 0.3
"""Default standstill between rows, for storing the row, arming cards and radars, and commands.

Simulated: 0.14 and 0.29 s between rows of 350 points x 13 and 16 chirps on the simulated rig at real time, on a busy
machine. Not measured on hardware; `polysight plan --like SCAN` measures it in a scan.
"""
Real = NDArray[np.float64]

# Limit of the stage's firmware (docs/spec/stage-line.md, timing).
MAX_STEPS_PER_S = 20_000
# Default of the simulators' `direct_snr_db`, from recorded data (docs/spec/scene-file.md).
SIMULATED_DIRECT_SNR_DB = 5.5
# Speed of the stage of the published rig.
_PUBLISHED_SPEED_MM_S = 20.0
# Loss by the motion during a burst from which on the forecast warns (chosen).
_MAX_BURST_LOSS_DB = 0.5
# Share of the time with chirps below which more pulses are suggested (chosen).
_LEAST_DUTY = 0.5
# The window that polysight.imaging.ImageBuilder uses.
_FAST_TIME_WINDOW = "hann"


@dataclass(frozen=True)
class ScanTime:
    """Duration of a scan by cause, summed over its rows, without homing, which depends on the stage's position.

    Attributes
    ----------
    approach_s
        From the home corner to the start of the first row.
    measuring_s
        Time at constant speed, from the first point of each row to its last.
    ramps_s
        Acceleration, deceleration, and the run-up of one step (or the backlash) on either side.
    turns_s
        From each row's end to the next one's beginning.
    tail_s
        Waiting for the cards' short last packets.
    overhead_s
        Other standstill between rows.
    """

    approach_s: float
    measuring_s: float
    ramps_s: float
    turns_s: float
    tail_s: float
    overhead_s: float

    @property
    def total_s(self) -> float:
        """Sum of all parts, seconds."""
        return self.approach_s + self.measuring_s + self.ramps_s + self.turns_s + self.tail_s + self.overhead_s

    @property
    def minutes(self) -> float:
        """Sum of all parts, minutes."""
        return self.total_s / 60


def straight_move_s(distance_mm: float, speed_mm_s: float, accel_mm_s2: float) -> float:
    """Return the duration of a move from rest to rest with constant acceleration.

    The two ramps of a move together take the distance v^2 / a. A longer distance d takes d / v + v / a, a shorter one,
    on which the speed v is not reached, 2 sqrt(d / a).
    """
    if distance_mm <= 0:
        return 0.0
    if distance_mm < speed_mm_s**2 / accel_mm_s2:
        return 2 * math.sqrt(distance_mm / accel_mm_s2)
    return distance_mm / speed_mm_s + speed_mm_s / accel_mm_s2


def row_motion_s(grid: Grid, stage: Stage) -> float:
    """Return the duration of a row from rest to rest."""
    length = (grid.columns - 1) * grid.step_x_mm + 2 * stage.run_up_mm(grid.step_x_mm)
    return straight_move_s(length, stage.speed_mm_s, stage.accel_mm_s2)


def measuring_s(rig: Instrument) -> float:
    """Return the duration from a row's first point to its last, at constant speed."""
    return (rig.grid.columns - 1) * rig.grid.step_x_mm / rig.stage.speed_mm_s


def turn_s(grid: Grid, stage: Stage) -> float:
    """Return the duration from a row's end to the next one's beginning; only y moves, and takes up its backlash."""
    step = grid.step_y_mm
    if stage.backlash_mm <= step:
        legs = (step,)
    else:
        # The row is approached from below, over the whole backlash: the stage first moves down, then up.
        legs = (stage.backlash_mm - step, stage.backlash_mm)
    return sum(straight_move_s(leg, stage.travel_speed_mm_s, stage.accel_mm_s2) for leg in legs)


def fills_whole_packets(rig: Instrument, pulses: int | None = None) -> bool:
    """Return True if a row with `pulses` pulses a position (None: the rig's) fills whole packets.

    No short packet is left then, which the card would delay, and which would mark the row's end.
    """
    row_bytes = rig.grid.columns * (pulses or rig.burst.pulses) * rig.frame_bytes
    return row_bytes % rig.card.payload_bytes == 0


def tail_s(rig: Instrument) -> float:
    """Return the wait for the cards' last packet at the end of each row, after the stage has stopped, seconds."""
    if fills_whole_packets(rig):
        return 0.0
    # From a row's last point, where its last burst begins, to the stage's rest. The card sends its last packet
    # `CARD_TAIL_S` after the end of that burst.
    run_out_s = (row_motion_s(rig.grid, rig.stage) - measuring_s(rig)) / 2
    return max(0.0, burst_duration_s(rig.burst) + CARD_TAIL_S - run_out_s)


def scan_time(rig: Instrument, row_overhead_s: float = ROW_OVERHEAD_S) -> ScanTime:
    """Estimate the duration of a scan without retakes.

    `row_overhead_s` is the standstill for each row apart from motion and the wait for the last packet, seconds.
    """
    grid = rig.grid
    stage = rig.stage
    row_s = row_motion_s(grid, stage)
    measuring_row_s = measuring_s(rig)
    # The start of the first row, from the home corner; both axes move at the same time.
    start_x_mm = stage.centre_x_mm - (grid.columns - 1) / 2 * grid.step_x_mm - stage.run_up_mm(grid.step_x_mm)
    start_y_mm = stage.centre_y_mm - (grid.rows - 1) / 2 * grid.step_y_mm
    return ScanTime(
        approach_s=straight_move_s(max(start_x_mm, start_y_mm), stage.travel_speed_mm_s, stage.accel_mm_s2),
        measuring_s=grid.rows * measuring_row_s,
        ramps_s=grid.rows * (row_s - measuring_row_s),
        turns_s=(grid.rows - 1) * turn_s(grid, stage),
        tail_s=grid.rows * tail_s(rig),
        overhead_s=grid.rows * row_overhead_s,
    )


@dataclass(frozen=True)
class Noise:
    """Assumed power of the direct path over noise (one channel, sample and chirp), dB, and its source."""

    direct_snr_db: float = SIMULATED_DIRECT_SNR_DB
    source: str = "the simulated rig's"


@dataclass(frozen=True)
class BurstForecast:
    """Burst of one position.

    Attributes
    ----------
    duration_ms
        Pulses x period: the minimum time to the next position.
    between_ms
        Time from one position to the next.
    travel_mm, travel_wavelengths
        Travel of the stage from the first to the last chirp.
    edge_loss_db
        Loss of a point's echo in the average over a burst at the aperture's ends, where its phase changes fastest.
        An average is placed at the middle of its burst, so that no shift remains.
    """

    duration_ms: float
    between_ms: float
    travel_mm: float
    travel_wavelengths: float
    edge_loss_db: float

    @property
    def duty(self) -> float:
        """Fraction of the time in which chirps are sent."""
        return self.duration_ms / self.between_ms


@dataclass(frozen=True)
class NoiseForecast:
    """Signal-to-noise ratios after averaging.

    Attributes
    ----------
    position_db
        Direct path over noise in a position's average, one channel, one sample.
    direct_phase_rad
        Standard deviation of the direct path's phase, the phase reference of a position: Cramer-Rao bound of one tone
        in all channels, 1 / sqrt(2 N snr) (Rife and Boorstyn 1974).
    image_db
        Peak over noise in the image, for a point whose echo is as strong as the direct path.
    """

    position_db: float
    direct_phase_rad: float
    image_db: float


@dataclass(frozen=True)
class Forecast:
    """Prediction of a scan with `rig`, with `raw_bytes` of all boards; `noise_source` says where its noise is from."""

    rig: Instrument
    time: ScanTime
    raw_bytes: int
    burst: BurstForecast
    response: imaging.PointResponse
    field: imaging.FieldLimits
    noise: NoiseForecast
    noise_source: str
    warnings: tuple[Finding, ...]

    @property
    def possible(self) -> bool:
        """False if stage, Pi or radars would refuse the plan."""
        return not any(w.level == "error" for w in self.warnings)


def forecast(
    rig: Instrument,
    noise: Noise | None = None,
    row_overhead_s: float = ROW_OVERHEAD_S,
    scene_mm: tuple[float, float] | None = None,
) -> Forecast:
    """Predict a scan of a rig file; of a plan, with the plan's changes in it.

    `noise`: default the simulated rig's. `row_overhead_s`: standstill for each row apart from motion. `scene_mm`: width
    and height of the scene in the object plane; default: the image's.
    """
    noise = noise or Noise()
    aperture, taper = describe_aperture(rig)
    response = imaging.compute_point_response(aperture, taper)
    return Forecast(
        rig=rig,
        time=scan_time(rig, row_overhead_s),
        raw_bytes=rig.scan_bytes,
        burst=predict_burst(rig),
        response=response,
        field=imaging.compute_field_limits(rig),
        noise=predict_noise(rig, noise),
        noise_source=noise.source,
        warnings=(*find_warnings(rig, noise, scene_mm), *_check_resolution(rig, response)),
    )


def describe_aperture(rig: Instrument) -> tuple[imaging.Aperture, Real]:
    """Return the aperture of the H receiver, at the frequencies that the imager keeps, and its taper [row, column]."""
    grid = imaging.image_grid(rig)
    antennas = tuple(imaging.Antennas.from_rig(rig, board) for board in rig.receivers)
    gate_m = imaging.find_scene_gate_m(antennas, plan_raster(rig.grid), grid)
    frequencies_hz = imaging.reduction(rig.chirp, gate_m, _FAST_TIME_WINDOW).frequencies_hz
    aperture = imaging.Aperture(antennas[0], imaging.scan_offsets_m(rig), frequencies_hz, grid)
    return aperture, np.outer(*_compute_tapers(rig))


def _compute_tapers(rig: Instrument) -> tuple[Real, Real]:
    """Return the tapers over the rows [row] and over the columns [column], as the rig file names them."""
    name = imaging.TAPERS[rig.image.apodisation]
    return imaging.make_window(name, rig.grid.rows), imaging.make_window(name, rig.grid.columns)


def predict_burst(rig: Instrument) -> BurstForecast:
    """Predict duration and travel of a burst, and the loss by motion."""
    grid = rig.grid
    stage = rig.stage
    travel_mm = stage.speed_mm_s * burst_duration_s(rig.burst)
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * sum(rig.chirp.linear_samples) / 2
    half_m = (grid.columns - 1) / 2 * grid.step_x_mm / 1e3
    # During the burst an echo's phase changes by change = travel |d phase / dx|, most at the aperture's end in x (axis
    # 0). The average of exp(j phase) over this change is sin(change / 2) / (change / 2).
    change_rad = travel_mm / 1e3 * abs(imaging.PhaseSlope(rig, 0).slope(half_m, middle_hz))
    average = abs(np.sinc(change_rad / (2 * np.pi)))
    return BurstForecast(
        duration_ms=rig.burst.pulses * rig.burst.period_us * 1e-3,
        between_ms=1e3 * grid.step_x_mm / stage.speed_mm_s,
        travel_mm=travel_mm,
        travel_wavelengths=travel_mm / 1e3 * middle_hz / SPEED_OF_LIGHT_M_S,
        # At most 120 dB, where the average vanishes.
        edge_loss_db=float(-20 * np.log10(max(average, 1e-6))),
    )


def predict_noise(rig: Instrument, noise: Noise) -> NoiseForecast:
    """Predict signal-to-noise ratios after averaging, and in the image.

    A weighted sum of n equal signals in independent noise gains `(sum w)^2 / sum w^2`: over pulses, RX, fast time and
    positions.
    """
    first, end = rig.chirp.linear_samples
    samples = end - first
    rx = len(rig.antennas.rx_mm)
    position = 10 ** (noise.direct_snr_db / 10) * rig.burst.chirps_a_position
    gain = rx
    for window in (imaging.make_window(_FAST_TIME_WINDOW, samples), *_compute_tapers(rig)):
        gain *= window.sum() ** 2 / (window**2).sum()
    return NoiseForecast(
        position_db=float(10 * np.log10(position)),
        direct_phase_rad=float(1 / np.sqrt(2 * samples * rx * position)),
        image_db=float(10 * np.log10(position * gain)),
    )


# --- warnings ---


def find_warnings(rig: Instrument, noise: Noise, scene_mm: tuple[float, float] | None = None) -> tuple[Finding, ...]:
    """Return every warning about a plan; much faster than the whole forecast.

    First those of level "error": stage, Pi or radars would refuse the plan. `where` is the topic. `scene_mm` is as of
    :func:`forecast`.
    """
    image_mm = (rig.image.columns * rig.image.pixel_mm, rig.image.rows * rig.image.pixel_mm)
    scene_mm = scene_mm or image_mm
    warnings = [
        *_check_stage(rig),
        *_check_burst(rig, predict_burst(rig)),
        *_check_card(rig),
        *_check_radar(rig),
        *_check_field(rig, scene_mm, image_mm),
    ]
    phase = predict_noise(rig, noise).direct_phase_rad
    published_rad = PUBLISHED_STD["phase_rad"]
    if phase > published_rad:
        text = f"standard deviation of the direct path's phase {phase:.3f} rad (published rig after all stages:"
        warnings.append(_note("noise", f"{text} {published_rad}): use more pulses a position"))
    if text := explain_unnamed(DEFAULT, rig, will_be=True):
        warnings.append(_note("library", text))
    return tuple(sorted(warnings, key=lambda w: w.level != "error"))


def _check_resolution(rig: Instrument, response: imaging.PointResponse) -> Iterator[Finding]:
    """Yield a finding for each axis along which nothing is resolved."""
    image_mm = (rig.image.columns * rig.image.pixel_mm, rig.image.rows * rig.image.pixel_mm)
    apertures_mm = ((rig.grid.columns - 1) * rig.grid.step_x_mm, (rig.grid.rows - 1) * rig.grid.step_y_mm)
    for axis, width_mm, aperture_mm, size_mm in zip("xy", response.width_mm, apertures_mm, image_mm, strict=True):
        if math.isinf(width_mm):
            yield _note(
                "resolution",
                f"an aperture of {aperture_mm:g} mm resolves nothing in {axis}: a point would fill the image of"
                f" {size_mm:g} mm; plan a wider one",
            )


def _note(topic: str, text: str) -> Finding:
    """Return a finding that does not refuse a plan."""
    return Finding("note", text, where=topic)


def _make_refusal(topic: str, text: str) -> Finding:
    """Return a finding that refuses a plan."""
    return Finding("error", text, where=topic)


def _check_stage(rig: Instrument) -> Iterator[Finding]:
    """Yield findings about speed and steps of the stage."""
    stage = rig.stage
    grid = rig.grid
    rate = stage.speed_mm_s * stage.steps_per_mm
    if rate > MAX_STEPS_PER_S:
        limit = MAX_STEPS_PER_S / stage.steps_per_mm
        text = f"{stage.speed_mm_s:g} mm/s are {rate:g} steps/s; the maximum of the stage is {limit:g} mm/s"
        yield _make_refusal("speed", text)
    for axis, step in (("x", grid.step_x_mm), ("y", grid.step_y_mm)):
        steps = step * stage.steps_per_mm
        if abs(steps - round(steps)) > 1e-6:
            text = f"a step of {step:g} mm in {axis} is {steps:g} motor steps, not a whole number"
            yield _make_refusal(f"step {axis}", text)
    if stage.speed_mm_s > _PUBLISHED_SPEED_MM_S:
        yield _note(
            "speed",
            f"faster than the published rig's {_PUBLISHED_SPEED_MM_S:g} mm/s: vibration of a real stage at"
            f" {stage.speed_mm_s:g} mm/s was not measured (a jitter of 0.2 mm towards the object costs 0.9 dB,"
            " simulated)",
        )


def _check_burst(rig: Instrument, burst: BurstForecast) -> Iterator[Finding]:
    """Yield findings about duration, travel and number of chirps of a burst."""
    max_pulses = int(1e3 * burst.between_ms / rig.burst.period_us)
    try:
        check_burst_fits(rig.grid, rig.burst, rig.stage)
    except ConfigError as e:
        remedy = f"at most {1e3 * rig.grid.step_x_mm / burst.duration_ms:.3g} mm/s"
        if max_pulses:
            remedy += f", or at most {max_pulses} pulses"
        yield _make_refusal("burst", f"too fast for the burst: {e.what}; {remedy}")
    if burst.edge_loss_db > _MAX_BURST_LOSS_DB:
        yield _note(
            "motion",
            f"the stage moves {burst.travel_mm:.2f} mm ({burst.travel_wavelengths:.2f} wavelengths) during a burst:"
            f" echoes at the aperture's ends lose {burst.edge_loss_db:.1f} dB in the average; use fewer or faster"
            " pulses",
        )
    if rig.burst.pulses > 1 and burst.duty < _LEAST_DUTY:
        text = f"the radars are idle for {1 - burst.duty:.0%} of a row: up to {max_pulses} pulses a position take no"
        yield _note("idle", f"{text} extra time")
    if rig.burst.chirps_a_position == 1:
        text = "with one chirp a position, noise and the residual of the alignment cannot be measured"
        yield _note("burst", text)


def _check_card(rig: Instrument) -> Iterator[Finding]:
    """Yield findings about packets and data rate of the cards."""
    if fills_whole_packets(rig):
        neighbours = (rig.burst.pulses - 1, rig.burst.pulses + 1)
        pulses_with_end_mark = [pulses for pulses in neighbours if pulses and not fills_whole_packets(rig, pulses)]
        if pulses_with_end_mark:
            remedy = f"{pulses_with_end_mark[0]} pulses a position have an end mark"
        else:
            remedy = f"no number of pulses has an end mark with {rig.grid.columns} points in a row"
        yield _note(
            "card",
            f"a row of {rig.row_bytes} bytes fills whole packets of {rig.card.payload_bytes}: no short packet marks its"
            f" end, and an extra frame whose packets are lost shows by its arrival time only; {remedy}",
        )
    elif tail := tail_s(rig):
        yield _note(
            "card",
            f"the card delays the last packet of each row, which marks its end: {tail * rig.grid.rows / 60:.1f} min in"
            " total",
        )
    if rig.frame_bytes < rig.card.payload_bytes:
        yield _make_refusal(
            "card",
            f"a frame of {rig.frame_bytes} bytes is smaller than a packet of {rig.card.payload_bytes}: a missed and a"
            " spurious edge within a packet cannot be seen; use more samples or chirps a frame",
        )
    frame_us = rig.frame_bytes / rig.card.payload_bytes * (rig.card.packet_delay_us + PACKET_TIME_US)
    if frame_us > rig.burst.period_us:
        text = f"a card needs {frame_us:.0f} us to send a frame and gets one every {rig.burst.period_us:g} us"
        yield _note("card", text)


def _check_radar(rig: Instrument) -> Iterator[Finding]:
    """Yield findings about the constraints of the radars, and the unknown IF."""
    native = rig.radar.control == "native"
    offsets_known = native or any(board.start_offset_hz for board in rig.boards)
    # Another program that configures the radars may accept settings that this release would refuse.
    level = "error" if native else "note"
    for constraint in list_constraints(rig, rig.grid.columns * rig.burst.pulses):
        is_about_if = constraint.name.startswith("IF")
        if constraint.holds or (is_about_if and not offsets_known):
            continue
        topic = "IF" if is_about_if else "radar"
        yield Finding(level, f"{constraint}: {constraint.remedy}", where=topic)
    if not offsets_known:
        # Slope times 5 ns, a jitter chosen to show the order of magnitude.
        yield _note(
            "IF",
            "the rig file has no start_offset_hz, so the IF depends on the program that configures the radars: the"
            f" direct path needs a margin of {rig.chirp.slope_hz_per_s * 5e-9 / 1e3:.0f} kHz for 5 ns of trigger"
            " jitter",
        )


def _check_field(rig: Instrument, scene_mm: tuple[float, float], image_mm: tuple[float, float]) -> Iterator[Finding]:
    """Yield findings about ghosts by the step, and about the aperture that flat plates need; sizes are (x, y)."""
    grid = rig.grid
    field = imaging.compute_field_limits(rig)
    axes = (("x", grid.step_x_mm, grid.columns), ("y", grid.step_y_mm, grid.rows))
    for i, (axis, step, count) in enumerate(axes):
        scene = scene_mm[i]
        alias_free_mm = field.alias_free_mm[i]
        zone = field.mirror_zone_mm[i]
        size = (count - 1) * step
        # From an object at one edge of the scene to a pixel at the other edge of the image.
        need = (scene + image_mm[i]) / 2
        if alias_free_mm < need:
            yield _note(
                "aliasing",
                f"in {axis}, steps of {step:g} mm make ghosts {alias_free_mm:.0f} mm from each object; a scene of"
                f" {scene:.0f} mm in an image of {image_mm[i]:.0f} mm needs {need:.0f} mm: use steps of at most"
                f" {step * alias_free_mm / need:.2g} mm, a smaller image, or `polysight process --sparse`",
            )
        if (good_mm := max(0.0, size - 2 * zone)) < scene:
            yield _note(
                "aperture",
                f"flat plates are mirrors: an aperture of {size:.0f} mm in {axis} images {good_mm:.0f} mm of them well"
                f" ({zone:.0f} mm of margin on either side); the scene has {scene:.0f} mm",
            )
