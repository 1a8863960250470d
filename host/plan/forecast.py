"""What a scan with this rig file will take and give, and what is wrong with it.

`forecast` computes time, data, point response, alias-free field, noise and the cost of motion. `warnings_of` turns them
into sentences, and says which of them stage, Pi or radars would refuse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.host.imaging import (
    TAPERS,
    Antennas,
    Aperture,
    PointResponse,
    image_grid,
    point_response,
    reduction,
    scan_offsets_m,
    scene_gate_m,
    window_weights,
)
from polysight.host.plan.field import FieldLimits, PhaseSlope, field_limits
from polysight.host.plan.timing import ROW_OVERHEAD_S, ScanTime, payload_bytes, scan_time, tail_s
from polysight.host.process import Options
from polysight.host.radar import constraints
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError
from polysight.shared.raster import burst_duration_s, check_burst_fits, plan_raster
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Real = NDArray[np.float64]

MAX_STEPS_PER_S = 20_000
"""Of the stage's firmware (docs/spec/stage-line.md, timing)."""

PUBLISHED_SPEED_MM_S = 20.0
PUBLISHED_PHASE_RAD = 0.022
"""Phase of the object's peak, standard deviation, paper section 9.1."""

_TOLERABLE_LOSS_DB = 0.5
_WIRE_BYTES = 1470 + 42 + 24  # a full packet on Ethernet: headers, preamble, check sum, gap
_ETHERNET_BYTES_PER_US = 125.0
SIMULATED_DIRECT_SNR_DB = 5.5
_FAST_TIME_WINDOW = "hann"  # of polysight.host.imaging.ImageBuilder


class Caution(NamedTuple):
    """One sentence or two. `refused`: stage, Pi or radars would not do it."""

    topic: str
    text: str
    refused: bool = False


def warnings_of(
    rig: Instrument, burst: BurstFacts, field: FieldLimits, noise: NoiseFacts, scene_mm: tuple[float, float]
) -> tuple[Caution, ...]:
    """Every warning of a plan, refusals first."""
    found = [
        *_stage(rig),
        *_burst(rig, burst),
        *_radar(rig),
        *_aliases(rig, field, scene_mm),
        *_mirrors(rig, field, scene_mm),
        *_noise(noise),
        *_library(rig),
    ]
    return tuple(sorted(found, key=lambda w: not w.refused))


def _stage(rig: Instrument) -> Iterator[Caution]:
    stage, grid = rig.stage, rig.grid
    rate = stage.speed_mm_s * stage.steps_per_mm
    if rate > MAX_STEPS_PER_S:
        fastest = MAX_STEPS_PER_S / stage.steps_per_mm
        yield Caution(
            "speed", f"{stage.speed_mm_s:g} mm/s are {rate:g} steps/s; the stage makes at most {fastest:g} mm/s", True
        )
    for axis, step in (("x", grid.step_x_mm), ("y", grid.step_y_mm)):
        steps = step * stage.steps_per_mm
        if abs(steps - round(steps)) > 1e-6:
            yield Caution(f"step {axis}", f"a step of {step:g} mm in {axis} is {steps:g} motor steps, not whole", True)
    if stage.speed_mm_s > PUBLISHED_SPEED_MM_S:
        yield Caution(
            "speed",
            f"faster than the published rig's {PUBLISHED_SPEED_MM_S:g} mm/s: whether a real stage shakes at"
            f" {stage.speed_mm_s:g} mm/s was not tried (a jitter of 0.2 mm towards the object costs 0.9 dB, simulated)",
        )


def _burst(rig: Instrument, burst: BurstFacts) -> Iterator[Caution]:
    try:
        check_burst_fits(rig.grid, rig.burst, rig.stage)
    except ConfigError as e:
        fits = int(1e3 * burst.between_ms / rig.burst.period_us)
        speed = 1e3 * rig.grid.step_x_mm / burst.duration_ms
        remedy = f"at most {speed:.3g} mm/s" + (f", or at most {fits} pulses" if fits else "")
        yield Caution("burst", f"too fast for the burst: {e.what}; {remedy}", True)
    if burst.edge_loss_db > _TOLERABLE_LOSS_DB:
        yield Caution(
            "motion",
            f"the stage moves {burst.travel_mm:.2f} mm ({burst.travel_wavelengths:.2f} wavelengths) within a burst:"
            f" echoes at the aperture's ends lose {burst.edge_loss_db:.1f} dB in the average; fewer or faster pulses",
        )
    if rig.burst.pulses > 1 and burst.duty < 0.5:
        more = int(1e3 * burst.between_ms / rig.burst.period_us)
        yield Caution(
            "idle", f"the radars rest {1 - burst.duty:.0%} of a row: up to {more} pulses a position cost no time"
        )
    if rig.burst.chirps_a_position == 1:
        yield Caution("burst", "one chirp a position: nothing tells the noise and the alignment's residual")
    if tail := tail_s(rig):
        pulses = nearest_whole(rig) if rig.burst.chirps == 1 else 0
        remedy = f"; with {pulses} pulses it would not" if pulses else ""
        yield Caution(
            "card",
            f"a row of {rig.row_bytes} bytes is not whole packets of {payload_bytes(rig)}: the card keeps its last"
            f" packet back, {tail * rig.grid.rows / 60:.1f} min in all{remedy}",
        )
    full_us = max(rig.card.packet_delay_us, _WIRE_BYTES / _ETHERNET_BYTES_PER_US)
    card_us = rig.frame_bytes / payload_bytes(rig) * full_us
    if card_us > rig.burst.period_us:
        yield Caution(
            "card", f"a card needs {card_us:.0f} us to send a frame and gets one every {rig.burst.period_us:g} us"
        )


def nearest_whole(rig: Instrument) -> int:
    """Number of pulses nearest to the rig's with which a row fills whole packets and a burst still fits; 0: none."""
    fits = int(1e6 * rig.grid.step_x_mm / rig.stage.speed_mm_s / rig.burst.period_us)
    good = [n for n in range(2, fits + 1) if n * rig.grid.columns * rig.frame_bytes % payload_bytes(rig) == 0]
    return min(good, key=lambda n: abs(n - rig.burst.pulses), default=0)


def _radar(rig: Instrument) -> Iterator[Caution]:
    native = rig.radar.control == "native"
    offsets_known = native or any(b.start_offset_hz for b in rig.boards)
    for c in constraints(rig, rig.grid.columns * rig.burst.pulses):
        if c.holds:
            continue
        if c.name.startswith("IF budget") and not offsets_known:
            continue
        yield Caution("IF" if c.name.startswith("IF") else "radar", f"{c}: {c.remedy}", native)
    if not offsets_known:
        yield Caution(
            "IF",
            "the rig file gives no start_offset_hz, so where the IF lies is up to who programs the radars: the direct"
            f" path needs {rig.chirp.slope_hz_per_s * 5e-9 / 1e3:.0f} kHz of room to either side for 5 ns of trigger",
        )


def _aliases(rig: Instrument, field: FieldLimits, scene_mm: tuple[float, float]) -> Iterator[Caution]:
    image = (rig.image.columns * rig.image.pixel_mm, rig.image.rows * rig.image.pixel_mm)
    for axis, free, scene, shown, step in zip(
        "xy", field.alias_free_mm, scene_mm, image, (rig.grid.step_x_mm, rig.grid.step_y_mm), strict=True
    ):
        need = (scene + shown) / 2
        if free < need:
            yield Caution(
                "aliasing",
                f"in {axis}, steps of {step:g} mm make ghosts {free:.0f} mm from each object; a scene of {scene:.0f} mm"
                f" in an image of {shown:.0f} mm needs {need:.0f} mm: at most {step * free / need:.2g} mm steps, a"
                " smaller image, or a reconstruction (polysight.host.imaging.sparse)",
            )


def _mirrors(rig: Instrument, field: FieldLimits, scene_mm: tuple[float, float]) -> Iterator[Caution]:
    grid = rig.grid
    sizes = ((grid.columns - 1) * grid.step_x_mm, (grid.rows - 1) * grid.step_y_mm)
    for axis, size, zone, scene in zip("xy", sizes, field.mirror_zone_mm, scene_mm, strict=True):
        good = max(0.0, size - 2 * zone)
        if good < scene:
            yield Caution(
                "aperture",
                f"flat plates are mirrors: an aperture of {size:.0f} mm in {axis} shows {good:.0f} mm of them well"
                f" ({zone:.0f} mm beyond a plate on either side), the scene has {scene:.0f} mm",
            )


def _noise(noise: NoiseFacts) -> Iterator[Caution]:
    if noise.direct_phase_rad > PUBLISHED_PHASE_RAD:
        yield Caution(
            "noise",
            f"the direct path's phase is known to {noise.direct_phase_rad:.3f} rad only (published rig after all"
            f" stages: {PUBLISHED_PHASE_RAD}): more pulses a position",
        )


def _library(rig: Instrument) -> Iterator[Caution]:
    if text := Options().unnamed(rig):
        yield Caution("library", text.replace("was named", "will be named", 1))


@dataclass(frozen=True)
class Noise:
    """Direct path over noise: power, one channel, one sample of one chirp, dB; and where the number comes from."""

    direct_snr_db: float = SIMULATED_DIRECT_SNR_DB
    source: str = "the simulated rig's"


@dataclass(frozen=True)
class BurstFacts:
    """One position's burst.

    Attributes
    ----------
    duration_ms
        Pulses x period: what has to pass before the next position.
    between_ms
        From one position to the next.
    travel_mm, travel_wavelengths
        Way of the stage from the first to the last pulse.
    edge_loss_db
        What a point's echo loses in the average over a burst at the aperture's ends, where its phase changes fastest:
        the path to the object changes while the burst lasts. Averages are placed at the middle of their burst, so no
        shift remains.
    """

    duration_ms: float
    between_ms: float
    travel_mm: float
    travel_wavelengths: float
    edge_loss_db: float

    @property
    def duty(self) -> float:
        """Share of the time in which chirps are sent."""
        return self.duration_ms / self.between_ms


@dataclass(frozen=True)
class NoiseFacts:
    """What remains of the noise.

    Attributes
    ----------
    position_db
        Direct path over noise in a position's average, one channel, one sample.
    direct_phase_rad
        Standard deviation of the direct path's phase, to which a position is referenced: Cramer-Rao bound of one tone
        in all channels, 1 / sqrt(2 N snr) (Rife and Boorstyn 1974).
    image_db
        Peak over noise of a point in the image whose echo is as strong as the direct path.
    """

    position_db: float
    direct_phase_rad: float
    image_db: float


@dataclass(frozen=True)
class Forecast:
    """Everything about a plan. `warnings` say in words what is wrong or worth knowing."""

    rig: Instrument
    time: ScanTime
    raw_bytes: int
    burst: BurstFacts
    response: PointResponse
    field: FieldLimits
    noise: NoiseFacts
    noise_source: str
    warnings: tuple[Caution, ...]

    @property
    def possible(self) -> bool:
        """Whether nothing of it is refused by the stage, the Pi or the radars."""
        return not any(w.refused for w in self.warnings)


def forecast(
    rig: Instrument,
    noise: Noise | None = None,
    row_overhead_s: float = ROW_OVERHEAD_S,
    scene_mm: tuple[float, float] | None = None,
) -> Forecast:
    """Predict a scan.

    Parameters
    ----------
    rig
        Rig file, :class:`polysight.host.plan.Changes` applied.
    noise
        Default: the simulated rig's.
    row_overhead_s
        Standstill for each row besides motion.
    scene_mm
        Width and height of what lies on the plane; default: the image's.
    """
    noise = noise or Noise()
    aperture, taper = aperture_of(rig)
    return Forecast(
        rig,
        scan_time(rig, row_overhead_s),
        rig.scan_bytes,
        burst_facts(rig),
        point_response(aperture, taper),
        field_limits(rig),
        noise_facts(rig, noise),
        noise.source,
        cautions(rig, noise, scene_mm),
    )


def cautions(rig: Instrument, noise: Noise, scene_mm: tuple[float, float] | None = None) -> tuple[Caution, ...]:
    """What is wrong with a plan, at once, without its resolution."""
    image = rig.image
    scene = scene_mm or (image.columns * image.pixel_mm, image.rows * image.pixel_mm)
    return warnings_of(rig, burst_facts(rig), field_limits(rig), noise_facts(rig, noise), scene)


def aperture_of(rig: Instrument) -> tuple[Aperture, Real]:
    """The aperture of the board that makes H, and its taper [row, column]."""
    plan, grid = plan_raster(rig.grid), image_grid(rig)
    antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
    frequencies = reduction(rig.chirp, scene_gate_m(antennas, plan, grid), _FAST_TIME_WINDOW).frequencies_hz
    return Aperture(antennas[0], scan_offsets_m(rig), frequencies, grid), np.outer(*_tapers(rig))


def _tapers(rig: Instrument) -> tuple[Real, Real]:
    name = TAPERS[rig.image.apodisation]
    return window_weights(name, rig.grid.rows), window_weights(name, rig.grid.columns)


def burst_facts(rig: Instrument) -> BurstFacts:
    """What a position's burst is, and what its motion costs."""
    grid, stage, burst = rig.grid, rig.stage, rig.burst
    travel_mm = stage.speed_mm_s * burst_duration_s(burst)
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * sum(rig.chirp.linear_samples) / 2
    half_m = (grid.columns - 1) / 2 * grid.step_x_mm / 1e3
    change_rad = travel_mm / 1e3 * abs(PhaseSlope(rig, 0).at(half_m, middle_hz))
    return BurstFacts(
        duration_ms=burst.pulses * burst.period_us * 1e-3,
        between_ms=1e3 * grid.step_x_mm / stage.speed_mm_s,
        travel_mm=travel_mm,
        travel_wavelengths=travel_mm / 1e3 * middle_hz / SPEED_OF_LIGHT_M_S,
        edge_loss_db=float(-20 * np.log10(max(abs(np.sinc(change_rad / (2 * np.pi))), 1e-6))),
    )


def noise_facts(rig: Instrument, noise: Noise) -> NoiseFacts:
    """Signal to noise after averaging, and in the image.

    A weighted sum of n equal signals in independent noise gains `(sum w)^2 / sum w^2`: over pulses, RX, fast time and
    positions.
    """
    a, b = rig.chirp.linear_samples
    rx = len(rig.antennas.rx_mm)
    position = 10 ** (noise.direct_snr_db / 10) * rig.burst.chirps_a_position
    gain = rx * _gain(window_weights(_FAST_TIME_WINDOW, b - a))
    for taper in _tapers(rig):
        gain *= _gain(taper)
    return NoiseFacts(
        position_db=float(10 * np.log10(position)),
        direct_phase_rad=float(1 / np.sqrt(2 * (b - a) * rx * position)),
        image_db=float(10 * np.log10(position * gain)),
    )


def _gain(window: Real) -> float:
    return float(window.sum() ** 2 / (window**2).sum())
