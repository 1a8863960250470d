"""What a scan with this rig file will take and give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from polysight.host.imaging.aperture import Aperture
from polysight.host.imaging.geometry import Antennas, image_grid, scan_offsets_m
from polysight.host.imaging.images import TAPERS
from polysight.host.imaging.reduce import Window, reduction, scene_gate_m
from polysight.host.imaging.resolution import PointResponse, point_response
from polysight.host.plan.field import FieldLimits, PhaseSlope, field_limits
from polysight.host.plan.timing import ROW_OVERHEAD_S, ScanTime, scan_time
from polysight.host.plan.warn import Caution, warnings_of
from polysight.shared.config import Instrument
from polysight.shared.raster import burst_duration_s, plan_raster
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Real = NDArray[np.float64]
SIMULATED_DIRECT_SNR_DB = 5.5
_FAST_TIME_WINDOW = "hann"  # of polysight.host.imaging.ImageBuilder


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
    return _window(name, rig.grid.rows), _window(name, rig.grid.columns)


def _window(name: Window, n: int) -> Real:
    """As the imager makes it: symmetric, without the zeros at its ends."""
    return np.asarray(scipy.signal.get_window(name, n + 2, fftbins=False), np.float64)[1:-1]


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
    position = 10 ** (noise.direct_snr_db / 10) * rig.burst.pulses
    gain = rx * _gain(_window(_FAST_TIME_WINDOW, b - a))
    for taper in _tapers(rig):
        gain *= _gain(taper)
    return NoiseFacts(
        position_db=float(10 * np.log10(position)),
        direct_phase_rad=float(1 / np.sqrt(2 * (b - a) * rx * position)),
        image_db=float(10 * np.log10(position * gain)),
    )


def _gain(window: Real) -> float:
    return float(window.sum() ** 2 / (window**2).sum())
