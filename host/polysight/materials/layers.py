"""Model and fit stacks of layers: sheets thinner than the wave, sheets on metal, liquids behind a container's wall.

Eq. 3 of the POLySIGHT paper (the permittivity of a half space from the ratio of H to V and the incidence angle) holds
for one interface. A sheet has two, a filled container three, and the echoes of the rear ones are as strong as the
first. Here the model is the whole stack (:func:`polysight.polarimetry.multilayer`), and the data are V / H and |H| in
the sub-bands of the sweep (`Spectrum`, `Bands`).

`fit_layer` fits the one unknown layer: its permittivity, and its thickness if it is not known. The solution has the
least chi-square

    (data - model)^T C^-1 (data - model) + (error of the incidence angle / its standard deviation)^2

with the full covariance C of the data: errors common to all sub-bands do not average out, differences between them are
known better. Start values come from a grid over index, loss and phase, so that no local minimum (half a wave more in
the sheet) is missed. Error bars follow from the curvature at the minimum, or from samples of the posterior if the
valley of chi-square is bent. Other solutions that the data do not exclude are listed as rivals.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import make_window
from polysight.materials.names import format_permittivity
from polysight.polarimetry import multilayer
from polysight_shared.config import Chirp
from polysight_shared.errors import ConfigError, DataError, ErrorCode, PolysightError
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
# Frequencies of a sub-band at which a layer is modelled; chosen.
_FREQUENCIES = 24
METAL_PERMITTIVITY = complex(np.inf, 0.0)
"""Permittivity that means a layer of metal: a perfect conductor."""


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
    def from_chirp(cls, chirp: Chirp, bands: int = 1, window: str = "hann") -> Spectrum:
        """Return sub-bands of the linear part of a chirp: windows that overlap by half, as in Welch's method.

        One band is the whole linear part under the image's own window
        (:func:`polysight.imaging.samples.reduction`).
        """
        first, last = chirp.linear_samples
        length = 2 * (last - first) / (bands + 1)
        starts = np.linspace(first, last - length, bands)
        # A few frequencies suffice for a smooth window: the phase of inner echoes changes slowly with frequency.
        share_of_band = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        # Every second point of the longer window lies where `share_of_band` does: in the middle of one of equal parts.
        weight = make_window(window, 2 * _FREQUENCIES - 1)[::2]
        frequency = chirp.first_sample_hz + chirp.hz_per_sample * (starts[:, None] + length * share_of_band)
        return cls(frequency, np.tile(weight / weight.sum(), (bands, 1)))

    def thin(self, step: int) -> Spectrum:
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
        Phase of V / H in radians per radian of the angle's error: where the angle is wrong, the plane is out of
        focus too.
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
        """Check that the arrays fit: PolysightError if not, DataError if a ratio or deviation cannot be used."""
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
            raise PolysightError("bands: amplitude_h and sigma_h must be given together", code=ErrorCode.KEY_MISSING)
        if self.covariance is not None and self.covariance.shape != (2 * k[0], 2 * k[0]):
            raise PolysightError(
                f"bands: a covariance {self.covariance.shape} of {k[0]} complex ratios", code=ErrorCode.MISMATCH
            )

    @property
    def data_covariance(self) -> Real:
        """Covariance of all data: real and imaginary parts of the ratios, band by band, then |H|; [n, n]."""
        if self.covariance is None:
            ratios = np.diag(np.repeat(self.sigma**2, 2))
        else:
            ratios = self.covariance
        if self.amplitude_h is None or self.sigma_h is None:
            return ratios
        shared = self.common_h * self.amplitude_h
        return np.asarray(
            scipy.linalg.block_diag(ratios, np.diag(self.sigma_h**2) + np.outer(shared, shared)), np.float64
        )


MAX_PERMITTIVITY = 1000.0
"""Largest permittivity and loss of a known layer; chosen."""


@dataclass(frozen=True)
class Layer:
    """One layer.

    Attributes
    ----------
    name
        Text for messages.
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
    """Return V / H complex128 [K] and |H| float64 [K] of a known stack in K sub-bands, relative to metal.

    A sub-band's image is the weighted coherent sum over its frequencies: r_s and r_p are averaged before their ratio.
    Layers stand in the order the wave meets them; air follows the last unless it is a half space. `theta_rad` is the
    incidence angle in air.

    Raises PolysightError if a layer is unknown, or one before the last has no thickness.
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
    """Return V / H and |H| [..., K] of stacks of layers, relative to metal: :func:`predict` for many stacks together.

    `eps` and `thickness` (metres) of each layer, and `theta_rad`, are numbers or arrays [..., 1, 1].
    """
    # Metal has -1 in both polarisations: reflections are relative to it except for a sign that ratio and magnitude
    # drop.
    reflections = multilayer(eps, thickness, spectrum.frequency_hz, theta_rad)
    r_s, r_p = (np.asarray((r * spectrum.weight).sum(axis=-1), np.complex128) for r in reflections)
    with np.errstate(divide="ignore", invalid="ignore"):
        return r_p / r_s, np.asarray(np.abs(r_s), np.float64)


def check_stack(stack: Sequence[Layer]) -> None:
    """Raise PolysightError unless every layer before the last has a thickness, and known permittivities are possible.

    Possible here: a real part of 1 and more, a loss of 0 and more, both up to MAX_PERMITTIVITY, or infinite (metal).
    """
    open_ended = [layer.name for layer in stack[:-1] if layer.thickness_m is None]
    if not stack or open_ended:
        raise ConfigError(
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
                f"no material of a layer has less than 1 or a negative loss; more than {MAX_PERMITTIVITY:g} is a metal",
                "give eps' of at least 1 and eps'' of at least 0; a metal layer as the word metal",
                code=ErrorCode.VALUE_INVALID,
            )


REAL_RANGE = (1.0, 40.0)
LOSS_RANGE = (0.0, 60.0)
"""Search ranges of the permittivity: from air to beyond water at these frequencies (9.4 - j18)."""
THICKNESS_RANGE_M = (0.1e-3, 12e-3)
"""Search range of an unknown thickness; chosen."""
START_PHASE_RAD = 0.25
"""Step of the start grid in the phase of the path through the layer and back: no valley is narrower."""
# Grid of start values: loss tangents, number of indices, and number of its local minima that are solved; chosen.
# "Index" here and below is sqrt(eps' - sin^2): the wave vector's component along the normal, relative to vacuum.
LOSS_TANGENTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 2.0)
INDEX_STEPS = 60
STARTS_SOLVED = 24
RIVAL_CHI2 = 9.0
"""A second solution is a rival if its chi-square is at most this above the best one: three standard deviations. The
limit is enlarged, as the error bars are, by the chi-square per degree of freedom if that is above 1."""
MAX_THICKNESS_M = 30e-3
"""Largest thickness to fit; chosen."""
UNLIKELY_PROBABILITY = 1e-3
"""Probability of a larger chi-square below which the stack does not explain the data; chosen."""
DETERMINED_HALF_WIDTH = 0.05
"""Largest relative half width of 95 % regions of a fit that is not ambiguous; chosen."""
# Draws of the posterior for its second moments; chosen.
_DRAWS = 1500
# Draws farther away than this, in standard deviations, are left out; chosen.
_MAX_DEVIATION = 4.0
# Width of the distribution that samples are drawn from, relative to the linear standard deviations; chosen: a wider one
# covers a bent valley, but leaves fewer draws in a straight one.
_DRAW_WIDTH = 1.15
# Range of the incidence angle's error, in standard deviations; chosen, wide enough never to bind.
_ANGLE_RANGE = (-8.0, 8.0)
# Ratio of sampled to linear standard deviations above which the sampled ones are used; chosen.
_NONLINEAR_RATIO = 1.15


@dataclass(frozen=True)
class LayerFit:
    """One solution.

    Attributes
    ----------
    permittivity
        eps' - j eps''.
    thickness_m
        Thickness of the unknown layer, fitted or given; None: half space.
    std_real, std_loss, std_thickness_m
        Standard deviations, enlarged by sqrt(chi-square per degree of freedom) if that is above 1. Zero for a given
        thickness.
    chi2, freedom
        Sum of squared residuals over their deviations; data minus unknowns.
    rivals
        Other solutions that the data do not exclude (`RIVAL_CHI2`).
    at_limit
        Unknowns at an end of their search range, except a loss of zero.
    covariance
        float64 [2, 2] of (eps', eps''), or [3, 3] of (eps', eps'', thickness in metres) where that was fitted.
    """

    permittivity: complex
    thickness_m: float | None
    std_real: float
    std_loss: float
    std_thickness_m: float
    chi2: float
    freedom: int
    rivals: tuple[LayerFit, ...] = field(default=())
    at_limit: tuple[str, ...] = ()
    covariance: Real | None = field(default=None, compare=False)

    @property
    def stretch(self) -> float:
        """Chi-square per degree of freedom, at least 1."""
        return max(1.0, self.chi2 / self.freedom) if self.freedom > 0 else 1.0

    @property
    def relative_std(self) -> float:
        """The larger of the standard deviations (one sigma) of permittivity and of thickness, relative."""
        permittivity_std = float(np.hypot(self.std_real, self.std_loss)) / abs(self.permittivity)
        if not self.thickness_m:
            return permittivity_std
        return max(permittivity_std, self.std_thickness_m / self.thickness_m)

    @property
    def ambiguous(self) -> bool:
        """True if there are rivals, or two sigma of a fitted thickness or permittivity exceed 5 %.

        The limit is `DETERMINED_HALF_WIDTH`.
        """
        return bool(self.rivals) or (self.std_thickness_m > 0 and 2 * self.relative_std > DETERMINED_HALF_WIDTH)

    def warnings(self) -> list[str]:
        """Return the warnings about this fit, one sentence each."""
        out = []
        for rival in self.rivals:
            if rival.thickness_m is None or not self.std_thickness_m:
                size = ""
            else:
                size = f" at {1e3 * rival.thickness_m:.3g} mm"
            freedom = f" for {self.freedom} degrees of freedom" if self.freedom > 0 else ""
            out.append(
                f"{format_permittivity(rival.permittivity)}{size} is not excluded: chi-square {rival.chi2:.1f},"
                f" the best has {self.chi2:.1f}{freedom}"
            )
        if self.rivals and self.freedom <= 0:
            out.append(
                "there are as many unknowns as measured numbers: image the scan in 4 sub-bands or more"
                " (`polysight process --bands 4`), or give the thickness"
            )
        if not self.rivals and self.ambiguous:
            out.append(
                f"ambiguous: permittivity and thickness are determined to {100 * self.relative_std:.0f} % only;"
                " measure the thickness"
            )
        if self.freedom > 0 and scipy.special.chdtrc(self.freedom, self.chi2) < UNLIKELY_PROBABILITY:
            out.append(
                f"the stack does not explain the data: chi-square {self.chi2:.0f} for {self.freedom} degrees of freedom"
            )
        # An error above a fifth of the value is large; of a small loss, one above 0.2. Chosen.
        if self.std_real > 0.2 * self.permittivity.real:
            out.append("the data hardly depend on this layer: its error bar is large")
        elif self.std_loss > max(0.2 * -self.permittivity.imag, 0.2):
            out.append(f"the data hardly determine the loss of this layer: it is known to +- {self.std_loss:.2f}")
        if self.at_limit:
            out.append(f"{' and '.join(self.at_limit)} at the limit of the search range: the true value may be beyond")
        return out


def fit_layer(
    bands: Bands, stack: Sequence[Layer], theta_rad: float, thickness_range_m: tuple[float, float] | None = None
) -> LayerFit:
    """Fit the permittivity of the one layer whose permittivity is None, and its thickness if a range is given.

    The result is the best solution with its error bars; see its `ambiguous`, `rivals` and `warnings()`. `theta_rad` is
    the incidence angle in air; `thickness_range_m` replaces the layer's own `thickness_m` or `thickness_range_m`.

    Raises
    ------
    PolysightError
        if not exactly one layer is unknown, a thickness is missing, a known layer is not passive, or the range of
        thicknesses reaches beyond `MAX_THICKNESS_M`.
    DataError
        with fewer data than unknowns.
    """
    unknown_layers = [i for i, layer in enumerate(stack) if layer.permittivity is None]
    if len(unknown_layers) != 1:
        remedy = "give the permittivity of the others"
        if not unknown_layers:
            remedy = "give one layer as NAME,?,MM or NAME,?,?"
        raise ConfigError(
            f"{len(unknown_layers)} layers of unknown permittivity",
            "only one can be fitted",
            remedy,
            code=ErrorCode.VALUES_CONFLICT,
        )
    check_range(thickness_range_m or stack[unknown_layers[0]].thickness_range_m)
    model = _Model(
        bands,
        tuple(stack),
        unknown_layers[0],
        theta_rad,
        thickness_range_m or stack[unknown_layers[0]].thickness_range_m,
    )
    if model.freedom < 0:
        raise DataError(
            f"{model.data} numbers for {model.unknowns} unknowns",
            "one sub-band's ratio does not determine a thickness",
            "give more sub-bands, the amplitude, or the thickness",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    # Solve roughly from every start, and exactly where the result may be the best or a rival.
    read_chi2 = operator.attrgetter("chi2")
    rough = sorted((model.solve(start, precision=1e-3) for start in model.starts()), key=read_chi2)
    # Chi-square is not exact yet: three times the margin is kept.
    level = rough[0].chi2 + 3 * RIVAL_CHI2 * model.fit(rough[0], by_sampling=False).stretch
    solutions = sorted((model.solve(solution.x) for solution in _drop_repetitions(rough, level, 0.01)), key=read_chi2)
    level = solutions[0].chi2 + RIVAL_CHI2 * model.fit(solutions[0], by_sampling=False).stretch
    sampled_fits = [model.fit(solution, by_sampling=True) for solution in _drop_repetitions(solutions, level, 1e-3)]
    best = sampled_fits[0]
    rivals = list[LayerFit]()
    for rival in sampled_fits[1:]:
        if all(_differ(rival, accepted) for accepted in (best, *rivals)):
            rivals.append(rival)
    return replace(best, rivals=tuple(rivals))


def check_range(thickness_range_m: tuple[float, float] | None) -> None:
    """Raise PolysightError if the search range is too large for a sweep of a few GHz."""
    if thickness_range_m is not None and thickness_range_m[1] > MAX_THICKNESS_M:
        raise PolysightError(
            f"a thickness of up to {1e3 * thickness_range_m[1]:g} mm",
            f"above {1e3 * MAX_THICKNESS_M:g} mm a layer has too many half waves to distinguish them",
            "narrow the range, or measure the thickness; a thick lossy layer is a half space",
            code=ErrorCode.VALUE_INVALID,
        )


def _differ(a: LayerFit, b: LayerFit) -> bool:
    """Return true if two solutions differ by more than two standard deviations and the solver's precision."""
    real = abs(a.permittivity.real - b.permittivity.real)
    loss = abs(a.permittivity.imag - b.permittivity.imag)
    thick = abs((a.thickness_m or 0.0) - (b.thickness_m or 0.0))
    return bool(
        real > 2 * min(a.std_real, b.std_real) + 1e-3 * abs(b.permittivity)
        or loss > 2 * min(a.std_loss, b.std_loss) + 1e-3 * abs(b.permittivity)
        or thick > 2 * min(a.std_thickness_m, b.std_thickness_m) + 1e-3 * (b.thickness_m or 0.0)
    )


@dataclass(frozen=True)
class _Solution:
    """Result of the solver; `active` [n] is -1 or 1 where an unknown is at its lower or upper bound."""

    # Unknowns [n], as of :class:`_Model`.
    x: Real
    chi2: float
    # Derivatives of the residuals by the unknowns, [residual, n].
    jacobian: Real
    active: npt.NDArray[np.intp]


def _drop_repetitions(solutions: Sequence[_Solution], level: float, relative: float) -> list[_Solution]:
    """Return solutions up to a chi-square `level`, without repetitions, best first.

    A repetition has all unknowns closer to another's than the share `relative` of the value; 0.1 (chosen) stands for a
    smaller one.
    """
    distinct: list[_Solution] = []
    for solution in solutions:
        if solution.chi2 <= level and all(
            np.any(np.abs(solution.x - o.x) > relative * np.maximum(np.abs(o.x), 0.1)) for o in distinct
        ):
            distinct.append(solution)
    return distinct


class _Model:
    """Residuals of one fit.

    Unknowns are eps', eps'', the thickness in mm if it is fitted, and the error of the incidence angle in standard
    deviations if it has one. The last is not counted as an unknown of the layer; its prior is a residual of its own.
    """

    def __init__(
        self,
        bands: Bands,
        stack: tuple[Layer, ...],
        layer_index: int,
        theta_rad: float,
        thickness_range_m: tuple[float, float] | None,
    ) -> None:
        self.fits_thickness = thickness_range_m is not None
        # Any thickness replaces one that is fitted.
        check_stack(
            [
                replace(layer, thickness_m=1.0) if self.fits_thickness and i == layer_index else layer
                for i, layer in enumerate(stack)
            ]
        )
        self.bands = bands
        self.stack = stack
        self.layer_index = layer_index
        self.theta_rad = theta_rad
        self.range_mm = tuple(1e3 * d for d in thickness_range_m or (0.0, 0.0))
        self.fits_angle = bands.theta_std_rad > 0
        limits: list[tuple[float, ...]] = [REAL_RANGE, LOSS_RANGE]
        if self.fits_thickness:
            limits.append(self.range_mm)
        if self.fits_angle:
            limits.append(_ANGLE_RANGE)
        self.lower, self.upper = (np.array(end, np.float64) for end in zip(*limits, strict=True))
        # Numbers of the layer's unknowns and of the data.
        self.unknowns = 2 + self.fits_thickness
        self.data = (2 if bands.amplitude_h is None else 3) * bands.inverse_ratio.size
        self.freedom = self.data - self.unknowns
        self.whiten = np.linalg.inv(np.linalg.cholesky(bands.data_covariance))
        # Wavenumber in vacuum, radians per millimetre.
        self.wavenumber = 2 * np.pi * float(np.mean(bands.spectrum.frequency_hz)) / SPEED_OF_LIGHT_M_S * 1e-3

    def residuals(self, x: npt.ArrayLike, thin: int = 1) -> Real:
        """Return residuals of unknowns [..., n] in standard deviations, uncorrelated, [..., data (+ 1 for the angle)].

        Only every `thin`-th frequency of each sub-band is computed.
        """
        x = np.asarray(x, np.float64)
        # [..., 1, 1, n]: with axes of sub-band and frequency.
        wide = x[..., None, None, :]
        eps: list[npt.ArrayLike] = [
            wide[..., 0] - 1j * wide[..., 1] if i == self.layer_index else complex(layer.permittivity or 1.0)
            for i, layer in enumerate(self.stack)
        ]
        thick: list[npt.ArrayLike] = [np.inf if y.thickness_m is None else y.thickness_m for y in self.stack]
        if self.fits_thickness:
            thick[self.layer_index] = wide[..., 2] * 1e-3
        theta: npt.ArrayLike = self.theta_rad
        if self.fits_angle:
            theta = self.theta_rad + self.bands.theta_std_rad * wide[..., -1]
        spectrum = self.bands.spectrum.thin(thin) if thin > 1 else self.bands.spectrum
        inverse_ratio, amplitude_h = average(eps, thick, spectrum, theta)
        if self.fits_angle:
            inverse_ratio = inverse_ratio * np.exp(
                1j * self.bands.phase_per_angle * self.bands.theta_std_rad * x[..., -1:]
            )
        miss = inverse_ratio - self.bands.inverse_ratio
        parts = np.stack([miss.real, miss.imag], axis=-1).reshape(*miss.shape[:-1], -1)
        if self.bands.amplitude_h is not None:
            parts = np.concatenate([parts, amplitude_h - self.bands.amplitude_h], axis=-1)
        # Stacks without a finite reflection, such as one that reflects no s, fit as badly as can be.
        normalised = np.nan_to_num(parts @ self.whiten.T, nan=1e6, posinf=1e6, neginf=-1e6)
        return np.concatenate([normalised, x[..., -1:]], axis=-1) if self.fits_angle else normalised

    def starts(self) -> list[Real]:
        """Return unknowns [n] at local minima of chi-square on a grid of index, phase and loss, best first."""
        sine2 = float(np.sin(self.theta_rad) ** 2)
        low, high = (float(np.sqrt(max(real - sine2, 1e-3))) for real in REAL_RANGE)
        known_mm = 1e3 * (self.stack[self.layer_index].thickness_m or 0.0)
        # With an unknown thickness the axes are index, loss tangent and the phase through the layer and back; with a
        # known one index and loss, the index in steps that the phase needs.
        axes = [np.geomspace(low, high, INDEX_STEPS), np.array(LOSS_TANGENTS)]
        if self.fits_thickness:
            max_phase_rad = 2 * self.wavenumber * self.range_mm[1] * high
            axes.append(np.linspace(0.0, max_phase_rad, int(max_phase_rad / START_PHASE_RAD) + 2)[1:])
        else:
            steps = max(INDEX_STEPS, int(2 * self.wavenumber * known_mm * (high - low) / START_PHASE_RAD))
            axes[0] = np.linspace(low, high, steps)
            # From no loss on, finest there; chosen.
            axes[1] = np.geomspace(0.02, LOSS_RANGE[1] + 0.02, 25) - 0.02
        mesh = np.meshgrid(*axes, indexing="ij")
        real = mesh[0] ** 2 + sine2
        x = [real, mesh[1]]
        is_outside = np.zeros(real.shape, bool)
        if self.fits_thickness:
            x[1] = np.minimum(mesh[1] * real, LOSS_RANGE[1])
            x.append(mesh[2] / (2 * self.wavenumber * mesh[0]))
            is_outside = (x[2] < self.range_mm[0]) | (x[2] > self.range_mm[1])
        if self.fits_angle:
            x.append(np.zeros(real.shape))
        grid = np.stack(x, axis=-1)
        chi2 = np.full(real.shape, np.inf)
        # A few frequencies of a sub-band are enough for start values.
        chi2[~is_outside] = np.sum(self.residuals(grid[~is_outside], thin=6) ** 2, axis=-1)
        valleys = (chi2 == scipy.ndimage.minimum_filter(chi2, size=3, mode="nearest")) & ~is_outside
        cells = np.argwhere(valleys)
        order = np.argsort(chi2[tuple(cells.T)])[:STARTS_SOLVED]
        return [grid[tuple(cell)] for cell in cells[order]]

    def _differentiate(self, x: Real) -> Real:
        """Return the Jacobian of the residuals, [data, n], by central differences."""
        step = np.diag(1e-6 * np.maximum(np.abs(x), 0.1))
        residuals = self.residuals(np.concatenate([x + step, x - step]))
        return ((residuals[: x.size] - residuals[x.size :]) / (2 * np.diag(step)[:, None])).T

    def solve(self, start: Real, precision: float = 1e-10) -> _Solution:
        """Solve by least squares from one start [n]."""
        width = self.upper - self.lower
        optimum = scipy.optimize.least_squares(
            self.residuals,
            np.clip(start, self.lower + 1e-9 * width, self.upper - 1e-9 * width),
            bounds=(self.lower, self.upper),
            x_scale="jac",
            # The cast: scipy-stubs accept only the name of a method.
            jac=cast("Any", self._differentiate),
            xtol=precision,
            ftol=precision,
            gtol=precision,
            max_nfev=200,
        )
        # At a bound (no loss) the solver's Jacobian still has the slope for the error bar.
        return _Solution(optimum.x, float(2 * optimum.cost), optimum.jac, optimum.active_mask)

    def fit(self, solution: _Solution, by_sampling: bool) -> LayerFit:
        """Return a solution with its error bars; `by_sampling`: by samples of the posterior if the valley is bent."""
        n = self.unknowns
        covariance = np.asarray(np.linalg.pinv(solution.jacobian.T @ solution.jacobian), np.float64)
        own_covariance = self._draw_second_moments(solution, covariance) if by_sampling else covariance[:n, :n]
        # The factor is that of `LayerFit.stretch`.
        stretch = max(1.0, solution.chi2 / self.freedom) if self.freedom > 0 else 1.0
        # The thickness is stored in metres instead of millimetres.
        units = np.array([1.0, 1.0, 1e-3])[:n]
        own_covariance = np.asarray(stretch * own_covariance * np.outer(units, units), np.float64)
        std = np.sqrt(np.maximum(np.diag(own_covariance), 0.0))
        thickness_m = self.stack[self.layer_index].thickness_m
        if self.fits_thickness:
            thickness_m = float(solution.x[2]) * 1e-3
        # The last column is true if the lower end is a limit of the search, which a loss of zero is not.
        ends = zip(("the real part", "the loss", "the thickness"), solution.active, (True, False, True), strict=False)
        return LayerFit(
            permittivity=complex(solution.x[0], -solution.x[1]),
            thickness_m=thickness_m,
            std_real=float(std[0]),
            std_loss=float(std[1]),
            std_thickness_m=float(std[2]) if self.fits_thickness else 0.0,
            chi2=solution.chi2,
            freedom=self.freedom,
            at_limit=tuple(
                name for name, end, two_sided in itertools.islice(ends, n) if end > 0 or (two_sided and end < 0)
            ),
            covariance=own_covariance,
        )

    def _draw_second_moments(self, solution: _Solution, covariance: Real) -> Real:
        """Return second moments of the posterior about a solution, [unknowns, unknowns].

        In a straight valley they are the linear ones, `covariance`. In a bent one they are found by importance sampling
        along thickness times index, in which the valley is straighter than in thickness.
        """
        n = self.unknowns
        x = solution.x
        derivatives = self._differentiate_straight(x)
        spread = derivatives @ covariance @ derivatives.T
        # A little is added, so that rounding leaves no negative eigenvalue.
        spread = spread + np.diag(1e-12 * np.maximum(np.diag(spread), 1e-18))
        # A wide proposal (Student's t, five degrees of freedom); beyond _MAX_DEVIATION there is another valley: a
        # rival.
        rng = np.random.default_rng(0)
        freedom = 5.0
        unit = rng.standard_normal((_DRAWS, x.size)) / np.sqrt(rng.chisquare(freedom, (_DRAWS, 1)) / freedom)
        unit = _DRAW_WIDTH * unit[np.sum(unit**2, axis=1) < (_MAX_DEVIATION / _DRAW_WIDTH) ** 2]
        draws = self._convert_from_straight(x, unit @ np.linalg.cholesky(spread).T)
        is_inside = np.all((draws >= self.lower) & (draws <= self.upper), axis=-1)
        linear = covariance[:n, :n]
        if not np.any(is_inside):
            return linear
        draws = draws[is_inside]
        unit = unit[is_inside]
        # Logarithm of the posterior over the proposal's density, up to a constant.
        log = -0.5 * np.sum(self.residuals(draws) ** 2, axis=-1)
        log += (freedom + x.size) / 2 * np.log1p(np.sum((unit / _DRAW_WIDTH) ** 2, axis=1) / freedom)
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        differences = (draws - x)[:, :n]
        second = (differences * weight[:, None]).T @ differences
        ratio = np.sqrt(np.diag(second) / np.maximum(np.diag(linear), 1e-30))
        return second if np.any(ratio > _NONLINEAR_RATIO) else linear

    def _differentiate_straight(self, x: Real) -> Real:
        """Return derivatives of (eps', eps'', thickness times index, angle) by the unknowns, [n, n]."""
        out = np.eye(x.size)
        if self.fits_thickness:
            index = float(np.sqrt(max(x[0] - np.sin(self.theta_rad) ** 2, 1e-3)))
            out[2, 0] = x[2] / (2 * index)
            out[2, 2] = index
        return out

    def _convert_from_straight(self, x: Real, draws: Real) -> Real:
        """Return unknowns [..., n] at samples (eps', eps'', thickness times index, angle) about x."""
        out = x + draws
        if self.fits_thickness:
            sine2 = np.sin(self.theta_rad) ** 2
            path = x[2] * np.sqrt(max(x[0] - sine2, 1e-3)) + draws[:, 2]
            out[:, 2] = path / np.sqrt(np.maximum(out[:, 0] - sine2, 1e-3))
        return out
