"""Model, compensation and fit of the receiver's high-pass filter.

The AWR2243 has two high-pass sections in the IF, with corners selected in the profile (175/235/350/700 kHz and
350/700/1400/2800 kHz). Direct path and object have different IF, which change with the timing of every chirp, so the
filter is compensated before anything else is estimated (POLySIGHT paper, section 5.2).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight_shared.config import Chirp
from polysight_shared.errors import DataError, ErrorCode

SMALLEST_GAIN = 0.25
"""Smallest filter gain that is fully compensated (chosen): noise is amplified four times at most."""

REACH_BINS = 3.0
"""Distance from the centre of a signal's band, in IF bins, at which the compensation is exact. Chosen: direct path and
object of the published rig lie within 1.8 bins of the middle between them."""


@dataclass(frozen=True)
class HighPass:
    """A linear constant-coefficient filter: a product of first-order high-pass sections.

    `H(f) = prod_i (jf / f_i) / (1 + jf / f_i)`, the response of `y' + 2 pi f_i y = x'` for each corner `f_i`.
    Without corners: the identity.
    """

    corners_hz: tuple[float, ...] = ()

    def response(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the complex response at IF frequencies (Hz, any shape)."""
        response = np.ones(np.shape(frequency_hz), complex)
        for corner in self.corners_hz:
            x = 1j * np.asarray(frequency_hz) / corner
            response *= x / (1 + x)
        return response

    def inverse(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return `conj(H) / max(|H|^2, SMALLEST_GAIN^2)` at IF frequencies (Hz, any shape): 1/H where H is not small.

        Noise is amplified four times at most.
        """
        # 1/H is infinite at zero frequency; 1 Hz is used instead.
        f = np.where(np.abs(frequency_hz) < 1.0, 1.0, frequency_hz)
        inverse: NDArray[np.complex128] = np.ones(np.shape(f), complex)
        for corner in self.corners_hz:
            inverse *= 1 - 1j * corner / f
        # 1/H = conj(H) / |H|^2, so conj(H) / SMALLEST_GAIN^2 is 1/H times |H|^2 / SMALLEST_GAIN^2.
        power_gain = 1 / (inverse.real**2 + inverse.imag**2)
        return inverse * np.minimum(1.0, power_gain / SMALLEST_GAIN**2)


@dataclass(frozen=True)
class Equaliser:
    """Compensates the filter in the narrow band of a chirp's signal, with three taps.

    The signal of a chirp is mixed down by f, the centre of its band, and then lies within some tens of kHz of zero. A
    tone at the frequency f + d becomes a tone at d. Taps t_0, t_1, t_2 at -spacing, 0 and +spacing samples have the
    response

        R(d) = t_0 exp(-j w) + t_1 + t_2 exp(j w),    w = 2 pi d spacing

    R(d) equals the inverse filter at f + d for d = -reach, 0 and reach (d in cycles per sample). R is periodic, so that
    noise far from the band is not amplified by the slope of 1/H.

    Attributes
    ----------
    model
        The filter.
    sample_rate_hz
        Sample rate.
    signed
        True if IF are -1/2..1/2 of the sample rate (complex 2x), False if they are 0..1 of it (complex 1x).
    spacing
        Samples between taps.
    reach
        Largest distance from the band's centre at which the compensation is exact, cycles per sample.
    """

    model: HighPass
    sample_rate_hz: float
    signed: bool
    spacing: int
    reach: float

    @classmethod
    def from_model(cls, model: HighPass, chirp: Chirp, spacing: int) -> Equaliser:
        """Return the equaliser of a chirp: exact at the signal's centre and `REACH_BINS` IF bins away."""
        first, end = chirp.linear_samples
        return cls(model, chirp.sample_rate_hz, chirp.if_mode == "complex2x", spacing, REACH_BINS / (end - first))

    def taps(self, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the taps [..., 3] for signals centred at frequencies [...] in cycles per sample."""
        f = frequency[..., None] + self.reach * np.array([-1.0, 0.0, 1.0])
        if self.signed:
            f = (f + 0.5) % 1.0 - 0.5
        else:
            f = f % 1.0
        low, middle, high = np.moveaxis(self.model.inverse(f * self.sample_rate_hz), -1, 0)
        w = 2 * np.pi * self.reach * self.spacing
        # R(0) = t_1 + even and R(+-reach) = t_1 + even cos(w) +- j odd sin(w), with even = t_0 + t_2, odd = t_2 - t_0.
        even_part = ((low + high) / 2 - middle) / (np.cos(w) - 1)
        odd_part = (high - low) / (2j * np.sin(w))
        return np.stack([(even_part - odd_part) / 2, middle - even_part, (even_part + odd_part) / 2], axis=-1)


def apply_filter(signal: NDArray[np.complex64], taps: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Filter a signal [position, chirp, rx, block] with taps [position, chirp, 3], one block apart.

    A block is one sample of the signal after decimation: the `spacing` of the equaliser.
    One block before and one after the signal are extrapolated by a parabola through three blocks.
    """
    block_before = 3 * (signal[..., :1] - signal[..., 1:2]) + signal[..., 2:3]
    block_after = 3 * (signal[..., -1:] - signal[..., -2:-1]) + signal[..., -3:-2]
    extended = np.concatenate([block_before, signal, block_after], axis=-1)
    t = taps[..., None, None, :]
    filtered = t[..., 0] * extended[..., :-2] + t[..., 1] * extended[..., 1:-1] + t[..., 2] * extended[..., 2:]
    return filtered.astype(np.complex64, copy=False)


def high_pass(chirp: Chirp) -> HighPass:
    """Return the filter in a chirp profile; a corner of 0 means no section (simulated rigs only)."""
    return HighPass(tuple(khz * 1e3 for khz in (chirp.hpf1_khz, chirp.hpf2_khz) if khz))


def fit_high_pass(if_hz: NDArray[np.float64], amplitude: NDArray[np.float64]) -> HighPass:
    """Fit two first-order sections to one reflector, measured at several IF by changing the start frequency.

    Both corners and a common gain are fitted to the logarithm of the amplitude (paper, Fig. 9).

    Parameters
    ----------
    if_hz, amplitude
        float64 [point]: IF and linear amplitude, in any unit.

    Raises
    ------
    DataError
        if there are too few points, values that are not above zero, or no points near a corner.
    """
    if_hz = np.asarray(if_hz, np.float64)
    amplitude = np.asarray(amplitude, np.float64)
    if if_hz.size < 8 or np.any(amplitude <= 0) or np.any(if_hz <= 0):
        raise DataError(
            f"{if_hz.size} points do not determine two corners",
            "a sweep needs at least eight points, and IF and amplitudes above zero",
            "measure the same reflector at more start frequencies",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    measured = np.log(amplitude)

    def misfit(log_corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the deviations [point] of log amplitudes from those of a filter."""
        gain = measured - np.log(np.abs(HighPass(tuple(np.exp(log_corners))).response(if_hz)))
        return gain - gain.mean()

    # Limits of the corners, starts, and the loss are chosen.
    limits = np.log(if_hz.min() / 10), np.log(if_hz.max() * 3)
    # Start from several pairs of corners: the misfit may have several minima.
    starts = itertools.combinations(np.linspace(*limits, 6)[1:-1], 2)
    fits = [scipy.optimize.least_squares(misfit, start, bounds=limits, loss="soft_l1", f_scale=0.1) for start in starts]
    corners = np.exp(np.sort(min(fits, key=lambda fit: fit.cost).x))
    # Corners within 10 % of the limits are taken as at the limits: the sweep does not determine them.
    if corners[0] < 1.1 * np.exp(limits[0]) or corners[-1] > 0.9 * np.exp(limits[1]):
        raise DataError(
            f"no filter fits the sweep: corners of {', '.join(f'{c / 1e3:.0f}' for c in corners)} kHz",
            "the IF range does not include the filter's corners, or the reflector moved",
            "measure at start frequencies whose mean IFs reach from about 250 kHz to several times the upper corner;"
            " trigger jitter of 200 kHz moves single IFs down to half the lower corner (docs/how-to/calibration.md)",
            code=ErrorCode.MISMATCH,
        )
    return HighPass(tuple(float(c) for c in corners))
