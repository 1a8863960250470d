"""Sub-bands of the sweep, and what was measured in each: the data of a fit of layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import signal

from polysight.shared.config import Chirp
from polysight.shared.errors import DataError, PolysightError

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
_FREQUENCIES = 24


@dataclass(frozen=True)
class Spectrum:
    """Frequencies and their weights in the image of each of K sub-bands.

    Attributes
    ----------
    frequency_hz, weight
        float64 [K, n]; the weights of a sub-band add to 1.
    """

    frequency_hz: Real
    weight: Real

    @classmethod
    def of(cls, chirp: Chirp, bands: int = 1, window: str = "hann") -> Spectrum:
        """Sub-bands of the linear part of a chirp: windows that overlap by half, as in Welch's method.

        One band is the whole linear part under the image's own window (:func:`polysight.host.imaging.reduce.reduction`).
        """
        first, last = chirp.linear_samples
        length = 2 * (last - first) / (bands + 1)
        starts = np.linspace(first, last - length, bands)
        # The sum over all samples of a smooth window is that over a few: inner echoes turn slowly with frequency.
        inside = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        weight = np.asarray(signal.get_window(window, 2 * _FREQUENCIES + 1, fftbins=False), np.float64)[1::2]
        frequency = chirp.first_sample_hz + chirp.hz_per_sample * (starts[:, None] + length * inside)
        return cls(frequency, np.tile(weight / weight.sum(), (bands, 1)))

    def thinned(self, step: int) -> Spectrum:
        """Every `step`-th frequency, four at least: enough to find where to start."""
        step = max(1, min(step, self.weight.shape[1] // 4))
        weight = self.weight[:, step // 2 :: step]
        return Spectrum(self.frequency_hz[:, step // 2 :: step], weight / weight.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class Bands:
    """What was measured, one entry for each of K sub-bands.

    Attributes
    ----------
    spectrum
        The frequencies over which the image of each sub-band sums coherently.
    inverse_ratio
        complex128 [K]: V / H, metal-referenced, leakage removed. The strong channel is below the line.
    sigma
        float64 [K]: standard deviation of its real part and of its imaginary part.
    amplitude_h, sigma_h
        float64 [K] or None: |H| relative to metal and its standard deviation, where it may be trusted (it depends on
        the size and the place of a patch, the ratio does not).
    """

    spectrum: Spectrum
    inverse_ratio: Complex
    sigma: Real
    amplitude_h: Real | None = None
    sigma_h: Real | None = None

    def __post_init__(self) -> None:
        k = self.inverse_ratio.shape
        if self.spectrum.frequency_hz.shape[:1] != k or self.sigma.shape != k:
            raise PolysightError(
                f"{len(self.spectrum.frequency_hz)} sub-bands, ratios {k} and deviations {self.sigma.shape} do not fit",
                "each sub-band has its frequencies, one ratio and one deviation",
            )
        if not (np.all(np.isfinite(self.inverse_ratio)) and np.all(self.sigma > 0)):
            raise DataError(
                "a sub-band holds no usable ratio", "it was masked, or its deviation is zero", "leave that sub-band out"
            )
        if (self.amplitude_h is None) != (self.sigma_h is None):
            raise PolysightError("bands: amplitude_h and sigma_h go together")
