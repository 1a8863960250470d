"""Stacks of layers: sheets thinner than the wave, sheets on metal, liquids behind a container's wall.

Eq. 3 of the paper holds for one interface. A sheet has two, a filled container three, and the echoes of the rear ones
are as strong as the first. Here the model is the whole stack (:func:`polysight.polarimetry.multilayer`), and the
data are those of the sub-bands of the sweep (`Spectrum`, `Bands`).
:func:`polysight.materials.layer_fit.fit_layer` fits the unknown layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import window_weights
from polysight.polarimetry import multilayer
from polysight_shared.config import Chirp
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, PolysightError

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
_FREQUENCIES = 24  # of a sub-band
METAL = complex(np.inf, 0.0)
"""Permittivity of a layer of metal: a perfect conductor."""


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
        """Return sub-bands of the linear part of a chirp: windows that overlap by half, as in Welch's method.

        One band is the whole linear part under the image's own window
        (:func:`polysight.imaging.reduce.reduction`).
        """
        first, last = chirp.linear_samples
        length = 2 * (last - first) / (bands + 1)
        starts = np.linspace(first, last - length, bands)
        # A few frequencies suffice for a smooth window: the phase of inner echoes changes slowly with frequency.
        inside = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        weight = window_weights(window, 2 * _FREQUENCIES - 1)[::2]
        frequency = chirp.first_sample_hz + chirp.hz_per_sample * (starts[:, None] + length * inside)
        return cls(frequency, np.tile(weight / weight.sum(), (bands, 1)))

    def thinned(self, step: int) -> Spectrum:
        """Return every `step`-th frequency, at least four: enough for start values."""
        step = max(1, min(step, self.weight.shape[1] // 4))
        weight = self.weight[:, step // 2 :: step]
        return Spectrum(self.frequency_hz[:, step // 2 :: step], weight / weight.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class Bands:
    """Measurement in K sub-bands.

    Attributes
    ----------
    spectrum
        Frequencies of the coherent sum in each sub-band's image.
    inverse_ratio
        complex128 [K]: V / H, metal-referenced, leakage removed. The strong channel is in the denominator.
    sigma
        float64 [K]: standard deviation of its real part and of its imaginary part.
    amplitude_h, sigma_h
        float64 [K] or None: |H| relative to metal and its standard deviation, if it is reliable (unlike the ratio it
        depends on the size and the place of a patch).
    covariance
        float64 [2 K, 2 K] of the errors of `inverse_ratio`, ordered real, imaginary part of the first band, then of
        the second. Errors of leakage, metal reference and edges are common to all bands, so that differences between
        bands are known better. None: independent errors by `sigma`.
    common_h
        Relative standard deviation of a factor of |H| common to all bands, in addition to `sigma_h`.
    theta_std_rad
        Standard deviation of the incidence angle.
    phase_per_angle
        Phase of V / H in radians per radian of the angle's error, which also means that the plane is out of focus.
    """

    spectrum: Spectrum
    inverse_ratio: Complex
    sigma: Real
    amplitude_h: Real | None = None
    sigma_h: Real | None = None
    covariance: Real | None = None
    common_h: float = 0.0
    theta_std_rad: float = 0.0
    phase_per_angle: float = 0.0

    def __post_init__(self) -> None:
        k = self.inverse_ratio.shape
        if self.spectrum.frequency_hz.shape[:1] != k or self.sigma.shape != k:
            raise PolysightError(
                f"{len(self.spectrum.frequency_hz)} sub-bands, ratios {k} and deviations {self.sigma.shape} do not fit",
                "each sub-band has its frequencies, one ratio and one deviation",
                code=ErrorCode.MISMATCH,
            )
        if not (np.all(np.isfinite(self.inverse_ratio)) and np.all(self.sigma > 0)):
            raise DataError(
                "a sub-band has no usable ratio",
                "it was masked, or its deviation is zero",
                "leave that sub-band out",
                code=ErrorCode.VALUE_INVALID,
            )
        if (self.amplitude_h is None) != (self.sigma_h is None):
            raise PolysightError("bands: amplitude_h and sigma_h go together", code=ErrorCode.KEY_MISSING)
        if self.covariance is not None and self.covariance.shape != (2 * k[0], 2 * k[0]):
            raise PolysightError(
                f"bands: a covariance {self.covariance.shape} of {k[0]} complex ratios", code=ErrorCode.MISMATCH
            )

    @property
    def data_covariance(self) -> Real:
        """Covariance of all data: real and imaginary parts of the ratios, band by band, then |H|; [n, n]."""
        ratios = np.diag(np.repeat(self.sigma**2, 2)) if self.covariance is None else self.covariance
        if self.amplitude_h is None or self.sigma_h is None:
            return ratios
        shared = self.common_h * self.amplitude_h
        return np.asarray(
            scipy.linalg.block_diag(ratios, np.diag(self.sigma_h**2) + np.outer(shared, shared)), np.float64
        )


MAX_PERMITTIVITY = 1000.0
"""Largest permittivity and loss of a known layer."""


@dataclass(frozen=True)
class Layer:
    """One layer.

    Attributes
    ----------
    name
        For messages.
    permittivity
        eps' - j eps''; None: unknown. Infinite: metal.
    thickness_m
        None: a half space (only the last layer).
    thickness_range_m
        Range for fitting the unknown layer's thickness too; `thickness_m` is not used then.
    """

    name: str
    permittivity: complex | None = None
    thickness_m: float | None = None
    thickness_range_m: tuple[float, float] | None = None


def predict(stack: Sequence[Layer], spectrum: Spectrum, theta_rad: float) -> tuple[Complex, Real]:
    """Return V / H and |H| of a known stack in each sub-band, relative to metal.

    A sub-band's image is the weighted coherent sum over its frequencies: r_s and r_p are averaged before their ratio.

    Parameters
    ----------
    stack
        Layers in the order the wave meets them; air follows the last unless it is a half space.
    spectrum
        Frequencies of K sub-bands.
    theta_rad
        Incidence angle in air.

    Returns
    -------
    inverse_ratio : complex128 [K]
    amplitude_h : float64 [K]

    Raises
    ------
    PolysightError
        if a layer is unknown, or one before the last has no thickness.
    """
    unknown = [layer.name for layer in stack if layer.permittivity is None]
    if unknown:
        raise PolysightError(
            f"layers without permittivity: {unknown}", "nothing is fitted here", code=ErrorCode.KEY_MISSING
        )
    check_stack(stack)
    eps: list[npt.ArrayLike] = [complex(layer.permittivity or 1.0) for layer in stack]
    thick: list[npt.ArrayLike] = [np.inf if x.thickness_m is None else x.thickness_m for x in stack]
    return average(eps, thick, spectrum, theta_rad)


def average(
    eps: Sequence[npt.ArrayLike], thickness: Sequence[npt.ArrayLike], spectrum: Spectrum, theta_rad: npt.ArrayLike
) -> tuple[Complex, Real]:
    """Return V / H and |H| [..., K] of stacks; entries are numbers or [..., 1, 1]; else as :func:`predict`."""
    both = multilayer(eps, thickness, spectrum.frequency_hz, theta_rad)
    r_s, r_p = (np.asarray((r * spectrum.weight).sum(axis=-1), np.complex128) for r in both)
    with np.errstate(divide="ignore", invalid="ignore"):
        return r_p / r_s, np.asarray(np.abs(r_s), np.float64)


def check_stack(stack: Sequence[Layer]) -> None:
    """Raise PolysightError unless every layer before the last has a thickness."""
    open_ended = [layer.name for layer in stack[:-1] if layer.thickness_m is None]
    if not stack or open_ended:
        raise PolysightError(
            f"layers without thickness before the last: {open_ended}" if stack else "an empty stack",
            "only the last layer may be a half space",
            "give each layer its thickness",
            code=ErrorCode.KEY_MISSING,
        )
    for layer in stack:
        eps = layer.permittivity
        if eps is None or np.isinf(eps):
            continue
        if not (1.0 <= eps.real <= MAX_PERMITTIVITY and 0.0 <= -eps.imag <= MAX_PERMITTIVITY):
            raise PolysightError(
                f"{layer.name}: permittivity {eps.real:g}, loss {-eps.imag:g}",
                f"no passive material has less than 1 or a negative loss; more than {MAX_PERMITTIVITY:g} is a metal",
                "give eps' of at least 1 and eps'' of at least 0; a metal layer as the word metal",
                code=ErrorCode.VALUE_INVALID,
            )
