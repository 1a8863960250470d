"""The permittivity of one unknown layer in a stack: sheets thinner than the wave, liquids behind a container's wall.

Eq. 3 of the paper sees one interface. A sheet has two, a filled container three, and the wave that returns from the
ones behind is as strong as the first. Here the whole stack is the model
(:func:`polysight.host.polarimetry.multilayer`), the measured quantities are those of the sub-bands of the sweep
(`Spectrum`, `Bands`), and `fit_layer` finds the unknown by least squares from every promising start. What the data
cannot tell apart is listed, not hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage, optimize, signal, stats

from polysight.host.materials.permittivity import format_permittivity
from polysight.host.polarimetry import multilayer
from polysight.shared.config import Chirp
from polysight.shared.errors import DataError, PolysightError
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
_FREQUENCIES = 24  # of a sub-band
REAL_RANGE = (1.0, 40.0)
LOSS_RANGE = (0.0, 60.0)
"""Where permittivities are looked for: from air to beyond water at these frequencies (9.4 - j18)."""
START_PHASE_RAD = 0.5
"""Steps of the grid of starts in the phase of the wave's way through the layer and back: no valley lies between."""
LOSS_STARTS = 25
RIVAL = 9.0
"""A second solution is a rival when its chi-square is within this of the best: three standard deviations, as wide as
the error bars are where the model misses the data."""
UNLIKELY = 1e-3
"""The stack does not explain data that it would miss by as much in one of a thousand scans."""


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

        One band is the whole linear part under the image's own window
        (:func:`polysight.host.imaging.reduce.reduction`).
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


@dataclass(frozen=True)
class Layer:
    """One layer. `permittivity` None: unknown. `thickness_m` None: a half space (only the last layer)."""

    name: str
    permittivity: complex | None = None
    thickness_m: float | None = None


@dataclass(frozen=True)
class LayerFit:
    """One solution.

    Attributes
    ----------
    permittivity
        eps' - j eps''.
    thickness_m
        Of the unknown layer: fitted or as given (None: half space).
    std_real, std_loss, std_thickness_m
        Standard deviations from the curvature of chi-square; enlarged by sqrt(chi-square per degree of freedom) where
        the model misses the data by more than their deviations. Zero for a thickness that was given.
    chi2, freedom
        Sum of squared residuals over their deviations; data minus unknowns.
    rivals
        Other solutions that the data cannot exclude (chi-square within 9, or more where the model misses the data).
    at_limit
        Unknowns that lie at an end of where they are looked for; no loss is not one.
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

    @property
    def stretch(self) -> float:
        """Chi-square per degree of freedom where the model misses the data by more than their deviations, else 1."""
        return max(1.0, self.chi2 / self.freedom) if self.freedom > 0 else 1.0

    @property
    def ambiguous(self) -> bool:
        """Whether another permittivity explains the data as well."""
        return bool(self.rivals)

    def warnings(self) -> list[str]:
        """What a reader of the number must know, in words."""
        out = []
        for r in self.rivals:
            size = "" if r.thickness_m == self.thickness_m else f" at {r.thickness_m or 0:.3g} m"
            out.append(
                f"{format_permittivity(r.permittivity)}{size} explains the data as well (chi-square {r.chi2:.1f})"
            )
        if self.freedom > 0 and stats.chi2.sf(self.chi2, self.freedom) < UNLIKELY:
            out.append(f"the stack does not explain the data: chi-square {self.chi2:.0f} for {self.freedom} degrees")
        if self.std_real > 0.2 * self.permittivity.real or self.std_loss > max(0.2 * -self.permittivity.imag, 0.2):
            out.append("the data hardly depend on this layer: its error bar is large")
        if self.at_limit:
            out.append(f"{' and '.join(self.at_limit)} at the limit of what was looked for: the truth may lie beyond")
        return out


def predict(stack: Sequence[Layer], spectrum: Spectrum, theta_rad: float) -> tuple[Complex, Real]:
    """V / H and |H| of a known stack in each sub-band, relative to metal.

    A sub-band's image is the weighted coherent sum over its frequencies: r_s and r_p are averaged before their ratio.

    Parameters
    ----------
    stack
        Layers in the order the wave meets them; air follows the last unless it is a half space.
    spectrum
        Of K sub-bands.
    theta_rad
        Incidence angle in air.

    Returns
    -------
    inverse_ratio : complex128 [K]
    amplitude_h : float64 [K]

    Raises
    ------
    PolysightError
        when a layer is unknown, or one before the last has no thickness.
    """
    unknown = [layer.name for layer in stack if layer.permittivity is None]
    if unknown:
        raise PolysightError(f"layers without permittivity: {unknown}", "nothing is to be fitted here")
    _check(stack)
    eps: list[npt.ArrayLike] = [complex(layer.permittivity or 1.0) for layer in stack]
    thick: list[npt.ArrayLike] = [np.inf if x.thickness_m is None else x.thickness_m for x in stack]
    return _average(eps, thick, spectrum, theta_rad)


def _average(
    eps: list[npt.ArrayLike], thickness: list[npt.ArrayLike], spectrum: Spectrum, theta_rad: float
) -> tuple[Complex, Real]:
    both = multilayer(eps, thickness, spectrum.frequency_hz, theta_rad)
    r_s, r_p = (np.asarray((r * spectrum.weight).sum(axis=-1), np.complex128) for r in both)
    with np.errstate(divide="ignore", invalid="ignore"):
        return r_p / r_s, np.asarray(np.abs(r_s), np.float64)


def _check(stack: Sequence[Layer]) -> None:
    open_ended = [layer.name for layer in stack[:-1] if layer.thickness_m is None]
    if not stack or open_ended:
        raise PolysightError(
            f"layers without thickness before the last: {open_ended}" if stack else "an empty stack",
            "only the last layer may be a half space",
            "give each layer its thickness",
        )


def fit_layer(
    bands: Bands, stack: Sequence[Layer], theta_rad: float, thickness_range_m: tuple[float, float] | None = None
) -> LayerFit:
    """The permittivity of the one layer whose permittivity is None.

    Parameters
    ----------
    bands
        The measurement.
    stack
        Layers in the order the wave meets them, exactly one of unknown permittivity.
    theta_rad
        Incidence angle in air.
    thickness_range_m
        When given, the unknown layer's thickness is fitted too, within this range; else it is as the stack says.

    Returns
    -------
    LayerFit
        The best solution with its error bars; look at `rivals` and `warnings()`.

    Raises
    ------
    PolysightError
        when not exactly one layer is unknown, or a thickness is missing.
    DataError
        when there are fewer data than unknowns.
    """
    at = [i for i, layer in enumerate(stack) if layer.permittivity is None]
    if len(at) != 1:
        raise PolysightError(
            f"{len(at)} layers of unknown permittivity", "one can be fitted", "give the permittivity of the others"
        )
    model = _Model(bands, tuple(stack), at[0], theta_rad, thickness_range_m)
    if model.freedom < 0:
        raise DataError(
            f"{model.data} numbers for {model.unknowns} unknowns",
            "a thickness cannot be told from one sub-band's ratio",
            "give more sub-bands, the amplitude, or the thickness",
        )
    found = sorted((model.solve(start) for start in model.starts()), key=lambda fit: fit.chi2)
    best = found[0]
    rivals: list[LayerFit] = []
    for other in found[1:]:
        if other.chi2 <= best.chi2 + RIVAL * best.stretch and all(_differ(other, known) for known in (best, *rivals)):
            rivals.append(other)
    return replace(best, rivals=tuple(rivals))


def _differ(a: LayerFit, b: LayerFit) -> bool:
    """Whether two solutions are two: farther apart than their error bars and than the solver's step."""
    real = abs(a.permittivity.real - b.permittivity.real)
    loss = abs(a.permittivity.imag - b.permittivity.imag)
    return bool(
        real > 3 * min(a.std_real, b.std_real) + 1e-3 * abs(b.permittivity)
        or loss > 3 * min(a.std_loss, b.std_loss) + 1e-3 * abs(b.permittivity)
    )


class _Model:
    """The residuals of one fit: unknowns are eps', eps'' and, when fitted, the thickness."""

    def __init__(
        self,
        bands: Bands,
        stack: tuple[Layer, ...],
        at: int,
        theta_rad: float,
        thickness_range_m: tuple[float, float] | None,
    ) -> None:
        fitted = thickness_range_m is not None
        _check([replace(layer, thickness_m=1.0) if fitted and i == at else layer for i, layer in enumerate(stack)])
        self.bands, self.stack, self.at, self.theta_rad = bands, stack, at, theta_rad
        self.thickness_range = thickness_range_m or (0.0, 0.0)
        self.lower = [REAL_RANGE[0], LOSS_RANGE[0], *([thickness_range_m[0]] if thickness_range_m else [])]
        self.upper = [REAL_RANGE[1], LOSS_RANGE[1], *([thickness_range_m[1]] if thickness_range_m else [])]
        self.unknowns = len(self.lower)
        self.data = (2 if bands.amplitude_h is None else 3) * bands.inverse_ratio.size
        self.freedom = self.data - self.unknowns

    def residuals(
        self, real: npt.ArrayLike, loss: npt.ArrayLike, thickness_m: npt.ArrayLike | None, thin: int = 1
    ) -> Real:
        """Residuals over deviations, [..., data], for unknowns of any common shape; every `thin`-th frequency."""
        value = np.asarray(real, np.float64) - 1j * np.asarray(loss, np.float64)
        eps: list[npt.ArrayLike] = []
        thick: list[npt.ArrayLike] = []
        for i, layer in enumerate(self.stack):
            own = i == self.at
            size = thickness_m if own and thickness_m is not None else layer.thickness_m
            eps.append(value[..., None, None] if own else complex(layer.permittivity or 1.0))
            thick.append(np.inf if size is None else np.asarray(size, np.float64)[..., None, None])
        spectrum = self.bands.spectrum.thinned(thin) if thin > 1 else self.bands.spectrum
        q, h = _average(eps, thick, spectrum, self.theta_rad)
        miss = (q - self.bands.inverse_ratio) / self.bands.sigma
        parts = [miss.real, miss.imag]
        if self.bands.amplitude_h is not None and self.bands.sigma_h is not None:
            parts.append((h - self.bands.amplitude_h) / self.bands.sigma_h)
        return np.nan_to_num(np.concatenate(parts, axis=-1).astype(np.float64), nan=1e6, posinf=1e6, neginf=-1e6)

    def starts(self) -> list[Real]:
        """Local minima of chi-square over a grid, at most 24 of them, best first."""
        last = self.stack[self.at].thickness_m if self.unknowns == 2 else self.upper[2]
        turns = (
            4 * np.pi * float(self.bands.spectrum.frequency_hz.max()) / SPEED_OF_LIGHT_M_S / START_PHASE_RAD
        )  # per metre
        lowest, highest = (np.sqrt(real - np.sin(self.theta_rad) ** 2) for real in REAL_RANGE)
        steps = max(40, int(turns * (last or 0.0) * (highest - lowest)))
        axes = [
            np.linspace(lowest, highest, steps) ** 2 + np.sin(self.theta_rad) ** 2,
            np.geomspace(0.02, LOSS_RANGE[1], LOSS_STARTS) - 0.02,
        ]
        if self.unknowns == 3:
            # Through a layer of index about two, in steps of the same phase.
            axes.append(np.linspace(*self.thickness_range, max(5, int(2 * turns * np.diff(self.thickness_range)[0]))))
        mesh = np.meshgrid(*axes, indexing="ij", sparse=True)
        chi2 = np.sum(self.residuals(mesh[0], mesh[1], mesh[2] if len(mesh) == 3 else None, thin=6) ** 2, axis=-1)
        valleys = np.argwhere(chi2 == ndimage.minimum_filter(chi2, size=3, mode="nearest"))
        order = np.argsort(chi2[tuple(valleys.T)])[:24]
        return [np.array([axis[i] for axis, i in zip(axes, index, strict=True)]) for index in valleys[order]]

    def solve(self, start: Real) -> LayerFit:
        """Least squares from one start."""
        lower, upper = np.array(self.lower), np.array(self.upper)
        width = upper - lower
        done = optimize.least_squares(
            lambda x: self.residuals(x[0], x[1], x[2] if self.unknowns == 3 else None),
            np.clip(start, lower + 1e-9 * width, upper - 1e-9 * width),
            bounds=(lower, upper),
            x_scale=[1.0, 1.0, *([self.upper[2] / 10] if self.unknowns == 3 else [])],
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        # On a bound (no loss at all) the solver's Jacobian still has the slope that the error bar needs.
        std = np.sqrt(np.maximum(np.diag(np.linalg.pinv(done.jac.T @ done.jac)), 0.0))
        thickness = float(done.x[2]) if self.unknowns == 3 else self.stack[self.at].thickness_m
        names = ("the real part", "the loss", "the thickness")
        ends = zip(names, done.active_mask, (True, False, True), strict=False)
        fit = LayerFit(
            complex(done.x[0], -done.x[1]),
            thickness,
            float(std[0]),
            float(std[1]),
            float(std[2]) if self.unknowns == 3 else 0.0,
            float(2 * done.cost),
            self.freedom,
            at_limit=tuple(name for name, end, both in ends if end > 0 or (both and end < 0)),
        )
        wider = float(np.sqrt(fit.stretch))
        return replace(
            fit,
            std_real=fit.std_real * wider,
            std_loss=fit.std_loss * wider,
            std_thickness_m=fit.std_thickness_m * wider,
        )
