"""Joint inversion of a scene: permittivities of all patches together with the rig's errors, and the error budget.

Relative to metal, a patch of true inverse ratio t = r_p / r_s = 1 / P is measured as

    V / H = (1 + rho) (1 + a) / (1 + b) (t + b) / (1 + a t)        |H| = kappa |r_s + a r_p| / |1 + a|

with a, b the leakage of p into H and of s into V, rho the error of the metal reference, kappa the patch's brightness
relative to an ideal one (roughness, tilt, edges). r_s and r_p follow from t and the incidence angle by Eq. 2 and 3.
Unknown are a, b, rho, the angle's error, and t of every patch. The data are the measured ratios and brightnesses with
their standard deviations; all that was not measured has a prior of zero mean and stated width. The solution is the
maximum of the posterior (least squares, scipy), its covariance the inverse of the information matrix there.

If brightness and ratio of several patches determine the leakage, the scene has measured it; otherwise the prior
remains. Each source of data or prior has a share in the variance of each permittivity; the shares add up to it: with J
the Jacobian of all residuals and C the covariance, source s contributes C J_s' J_s C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from polysight.polarimetry import fresnel, permittivity_from_ratio

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

BRIGHTNESS_STD = 0.05
"""Prior of ln kappa: plates rough by 0.2 mm lose 7 %, edges and tilts change |H| by some per cent."""
BRIGHTNESS_FREEDOM = 4.0
"""Weight of that prior against the patches' own scatter, in number of patches."""
OUTLIER = 3.0
"""Standard deviations of brightness beyond which a patch (a thin sheet, a shadow) loses weight (Cauchy)."""
METAL_LIKE = 0.25
"""|t - 1| below which no permittivity is given: it grows as 4 / |t - 1|^2, and so does its error."""
LEAST_DISTANCE = 4.0
"""|t - 1| in its standard deviations below which no permittivity is given."""
SOURCES = ("noise", "metal reference", "leakage", "incidence", "brightness")
_NUISANCES = 8  # a, b (2 each), rho (2), angle, brightness of the metal
_BENT = 0.1  # standard deviation over radius of curvature of Eq. 3 above which errors are sampled, not propagated
_DRAWS = 4000
_LEAST_STD = 1e-6  # of a ratio: below it the information matrix has no inverse in double precision


@dataclass(frozen=True)
class PatchMeasurement:
    """Measurement of one patch, relative to metal; leakage is not removed.

    Attributes
    ----------
    inverse_ratio
        V / H.
    std
        Standard deviation of its real part and of its imaginary part: noise, speckle, edges.
    theta_rad
        Nominal incidence angle.
    brightness
        |H|; None if it is not used.
    """

    inverse_ratio: complex
    std: float
    theta_rad: float
    brightness: float | None = None


@dataclass(frozen=True)
class RigPrior:
    """Prior of the rig's errors: means and standard deviations.

    Attributes
    ----------
    theta_std_rad
        Standard deviation of the incidence angle's error, equal for all patches.
    leakage
        Leakage of p into H and of s into V: as measured, or zero.
    leakage_std
        Standard deviation of each real and imaginary part.
    leakage_measured
        True if it was measured; otherwise it is the prior of the mount.
    channels_known
        True if the images' amplitudes are relative to the direct path.
    reference_std
        Relative standard deviation of metal's V / H, each part.
    brightness_std
        Standard deviation of ln |H| relative to Eq. 2, of single patches.
    """

    theta_std_rad: float
    leakage: tuple[complex, complex] = (0j, 0j)
    leakage_std: float = 0.041
    leakage_measured: bool = False
    channels_known: bool = False
    reference_std: float = 0.01
    brightness_std: float = BRIGHTNESS_STD


@dataclass(frozen=True)
class PatchEstimate:
    """Permittivity of one patch.

    Attributes
    ----------
    inverse_ratio
        1 / P = r_p / r_s, corrected for all estimated errors.
    inverse_ratio_covariance
        float64 [2, 2] of its real and imaginary part.
    permittivity
        eps' - j eps''; None if the patch is metal-like.
    covariance
        float64 [2, 2] of its real and its imaginary part; None if metal-like.
    shares
        Source to its share of the covariance's trace; the sum is 1.
    """

    inverse_ratio: complex
    inverse_ratio_covariance: Real
    permittivity: complex | None
    covariance: Real | None
    shares: Mapping[str, float]

    @property
    def dominated_by(self) -> str | None:
        """The source with the largest share of the error."""
        return max(self.shares, key=lambda s: self.shares[s]) if self.shares else None


@dataclass(frozen=True)
class Inversion:
    """The solution for a scene.

    Attributes
    ----------
    patches
        Estimates of the patches, in the given order.
    leakage
        Estimated leakage of p into H, of s into V.
    leakage_std
        Standard deviation of each: root mean variance of its two parts.
    prior_std
        The same of the prior.
    theta_error_rad, theta_std_rad
        True minus nominal incidence angle, and its standard deviation.
    misfit
        Brightness minus the model's, in standard deviations, of each patch; NaN if it was not used.
    brightness_std
        Standard deviation of ln |H| from the patches' scatter and the prior.
    cost
        Sum of squared residuals at the solution, priors included.
    """

    patches: tuple[PatchEstimate, ...]
    leakage: tuple[complex, complex]
    leakage_std: tuple[float, float]
    prior_std: float
    theta_error_rad: float
    theta_std_rad: float
    misfit: Real
    brightness_std: float
    cost: float
    nuisance_covariance: Real = field(repr=False)

    @property
    def leakage_determined(self) -> bool:
        """True if the scene reduced the uncertainty of both leakages to less than half of the prior's."""
        return max(self.leakage_std) < 0.5 * self.prior_std


def true_ratio(inverse: npt.ArrayLike, a: complex, b: complex, rho: complex = 0j) -> Complex:
    """Return t of a measured V / H: the first formula of the module's docstring, solved for t."""
    c = np.asarray(inverse, np.complex128) * (1 + b) / ((1 + a) * (1 + rho))
    return (c - b) / (1 - a * c)


def measured_ratio(
    t: npt.ArrayLike, a: Complex | complex, b: Complex | complex, rho: Complex | complex = 0j
) -> Complex:
    """Return V / H of a true t: the first formula of the module's docstring."""
    t = np.asarray(t, np.complex128)
    return (1 + rho) * (1 + a) / (1 + b) * (t + b) / (1 + a * t)


def slope(t: npt.ArrayLike, theta_rad: float) -> Complex:
    """Return d eps / d t of Eq. 3 with t = 1 / P: eps = sin^2 (1 + tan^2 u^2), u = (1 + t) / (1 - t)."""
    t = np.asarray(t, np.complex128)
    return 4 * np.sin(theta_rad) ** 2 * np.tan(theta_rad) ** 2 * (1 + t) / (1 - t) ** 3


def forward_differences(f: Callable[[Real], Real], x: Real) -> Real:
    """Return the Jacobian of f at x, [value, parameter]; f is called once, with x of shape [step, parameter]."""
    step = np.sqrt(np.finfo(np.float64).eps) * np.maximum(1.0, np.abs(x))
    at = f(np.concatenate([x[None], x + np.diag(step)]))
    return ((at[1:] - at[0]) / step[:, None]).T


class _Model:
    """Residuals of the fit. Parameters are deviations from the prior's mean in its standard deviations.

    Those of a patch are the deviation of t from the measured ratio, in its standard deviations.
    """

    def __init__(self, seen: Sequence[PatchMeasurement], prior: RigPrior, brightness_std: float) -> None:
        self.prior, self.n, self.brightness_std = prior, len(seen), brightness_std
        self.q = np.array([s.inverse_ratio for s in seen], np.complex128)
        self.std = np.maximum(np.array([s.std for s in seen], np.float64), _LEAST_STD)
        level = np.array([np.nan if s.brightness is None else s.brightness for s in seen], np.float64)
        # Metal-like patches have |H| = 1 with any leakage: they give no information on it.
        self.bright = np.isfinite(level) & (level > 0) & (np.abs(self.q - 1) > METAL_LIKE)
        self.log_level = np.log(np.where(self.bright, level, 1.0))
        self.start = true_ratio(self.q, *prior.leakage)
        self.theta = np.array([s.theta_rad for s in seen], np.float64)

    def nuisances(self, x: Real) -> tuple[Complex, Complex, Complex, Real]:
        """Return a, b, rho and the angle's error; [..., parameter] to [..., 1] each."""
        p, u = self.prior, [x[..., k, None] for k in range(7)]
        a = p.leakage[0] + p.leakage_std * (u[0] + 1j * u[1])
        b = p.leakage[1] + p.leakage_std * (u[2] + 1j * u[3])
        return a, b, p.reference_std * (u[4] + 1j * u[5]), p.theta_std_rad * u[6]

    def ratios(self, x: Real) -> Complex:
        """Return t of every patch, [..., patch]."""
        real, imag = np.split(x[..., _NUISANCES:], 2, axis=-1)
        return self.start + self.std * (real + 1j * imag)

    def misfit(self, x: Real) -> Real:
        """Return brightness minus the model's in standard deviations, [..., patch]; 0 if it is not used."""
        a, _, _, error = self.nuisances(x)
        t, theta = self.ratios(x), self.theta + error
        r_s = fresnel(permittivity_from_ratio(t, theta), theta)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            model = np.log(np.abs(r_s * (1 + a * t) / (1 + a)))
            off = (self.log_level - model) / self.brightness_std - x[..., 7, None]
        return np.where(self.bright & np.isfinite(off), np.clip(off, -1e3, 1e3), 0.0)

    def residuals(self, x: Real) -> Real:
        """Return residuals of the priors, of ratios, and of brightness; [..., parameter] to [..., residual]."""
        a, b, rho, _ = self.nuisances(x)
        off = (measured_ratio(self.ratios(x), a, b, rho) - self.q) / self.std
        misfit = self.misfit(x)
        robust = np.sign(misfit) * OUTLIER * np.sqrt(np.log1p((misfit / OUTLIER) ** 2))
        return np.concatenate([x[..., :_NUISANCES], off.real, off.imag, robust], axis=-1)

    def jacobian(self, x: Real) -> Real:
        """[residual, parameter]."""
        return forward_differences(self.residuals, x)

    def source_rows(self) -> dict[str, npt.NDArray[np.intp]]:
        """Return source to the indices of its residuals."""
        ratios = np.arange(_NUISANCES, _NUISANCES + 2 * self.n)
        bright = np.concatenate([[7], np.arange(_NUISANCES + 2 * self.n, _NUISANCES + 3 * self.n)])
        rows = {"noise": ratios, "metal reference": np.array([4, 5]), "leakage": np.arange(4)}
        return rows | {"incidence": np.array([6]), "brightness": bright.astype(np.intp)}


def invert(seen: Sequence[PatchMeasurement], prior: RigPrior) -> Inversion:
    """Solve for all patches of a scene together.

    The standard deviation of brightness is estimated in two steps: the patches' scatter about the first solution
    corrects its prior (mean of a scaled inverse chi-square; Gelman et al., Bayesian Data Analysis, section 2.6).

    Parameters
    ----------
    seen
        The patches without the metal reference.
    prior
        Prior of the rig's errors.

    Returns
    -------
    Inversion
    """
    first = _Model(seen, prior, prior.brightness_std)
    start = _least_squares(first, np.zeros(_NUISANCES + 2 * first.n))
    off = np.minimum(np.abs(first.misfit(start.x)[first.bright]), OUTLIER) * prior.brightness_std
    freedom = BRIGHTNESS_FREEDOM + max(off.size - 4, 0)  # four numbers of leakage are fitted to them
    level = float(np.sqrt((BRIGHTNESS_FREEDOM * prior.brightness_std**2 + np.sum(off**2)) / freedom))
    model = _Model(seen, prior, level)
    found = _least_squares(model, start.x)
    return _solution(model, found)


def _least_squares(model: _Model, start: Real) -> scipy.optimize.OptimizeResult:
    options = {"jac": model.jacobian, "method": "lm", "xtol": 1e-10, "ftol": 1e-10}
    return scipy.optimize.least_squares(model.residuals, start, **options)


def _solution(model: _Model, found: scipy.optimize.OptimizeResult) -> Inversion:
    x, jac, prior, n = found.x, found.jac, model.prior, model.n
    covariance = np.linalg.inv(jac.T @ jac)
    (a,), (b,), _, (error,) = model.nuisances(x)
    a, b, error = complex(a), complex(b), float(error)
    spread = prior.leakage_std * np.sqrt(np.diag(covariance)[:4])
    t = model.ratios(x)
    patches = tuple(
        _estimate(model, x, jac, covariance, i, complex(t[i]), float(model.theta[i] + error)) for i in range(n)
    )
    return Inversion(
        patches,
        (a, b),
        (float(np.hypot(*spread[:2]) / np.sqrt(2)), float(np.hypot(*spread[2:]) / np.sqrt(2))),
        prior.leakage_std,
        error,
        float(prior.theta_std_rad * np.sqrt(covariance[6, 6])),
        np.where(model.bright, model.misfit(x), np.nan),
        model.brightness_std,
        float(2 * found.cost),
        covariance[:_NUISANCES, :_NUISANCES],
    )


def _estimate(model: _Model, x: Real, jac: Real, covariance: Real, i: int, t: complex, theta: float) -> PatchEstimate:
    """Estimate one patch: ratio and permittivity with covariance, and the shares of the sources."""
    at = [_NUISANCES + i, _NUISANCES + model.n + i]
    unit = model.std[i]
    of_ratio = unit**2 * covariance[np.ix_(at, at)]
    distance = min(abs(t - 1), abs(1 / t - 1) if t else np.inf)
    if not distance >= max(METAL_LIKE, LEAST_DISTANCE * np.sqrt(np.trace(of_ratio) / 2)):
        return PatchEstimate(t, of_ratio, None, None, {})
    value = complex(permittivity_from_ratio(t, theta))
    by_t = complex(slope(t, theta)) * unit
    step = 1e-5
    by_theta = (
        complex(permittivity_from_ratio(t, theta + step) - permittivity_from_ratio(t, theta - step))
        / (2 * step)
        * model.prior.theta_std_rad
    )
    # The permittivity's real and imaginary part by all parameters, [2, parameter].
    gradient = np.zeros((2, x.size))
    gradient[:, at[0]], gradient[:, at[1]] = (by_t.real, by_t.imag), (-by_t.imag, by_t.real)
    gradient[:, 6] = by_theta.real, by_theta.imag
    linear = gradient @ covariance @ gradient.T
    total = float(np.trace(linear))
    shares = {}
    for source, rows in model.source_rows().items():
        part = jac[rows] @ covariance @ gradient.T
        shares[source] = float(np.sum(part**2)) / total
    bend = 3 * np.sqrt(np.trace(of_ratio) / 2) / abs(1 - t)
    if bend > _BENT:
        linear = _drawn(t, theta, covariance[np.ix_([*at, 6], [*at, 6])], unit, model.prior.theta_std_rad)
    return PatchEstimate(t, of_ratio, value, linear, shares)


def _drawn(t: complex, theta: float, covariance: Real, unit: float, theta_std: float) -> Real:
    """Return the covariance of the permittivity by sampling ratio and angle, if Eq. 3 bends within the error.

    Samples beyond three standard deviations are dropped: near metal the moments of the far tail do not exist.
    """
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(np.zeros(3), covariance, _DRAWS, method="cholesky")
    keep = np.sum(np.linalg.solve(covariance, drawn.T).T * drawn, axis=1) < 14.2  # 99.7 % of three dimensions
    drawn = drawn[keep]
    value = permittivity_from_ratio(t + unit * (drawn[:, 0] + 1j * drawn[:, 1]), theta + theta_std * drawn[:, 2])
    away = value - complex(permittivity_from_ratio(t, theta))
    parts = np.stack([away.real, away.imag])
    return (parts @ parts.T / parts.shape[1]).astype(np.float64)


def ratio_slopes(estimate: Inversion, prior: RigPrior, t: npt.ArrayLike) -> Real:
    """Return the errors of 1 / P at t [...] by leakage and metal reference after the inversion, float64 [..., 2, 6].

    The product with its transpose is the covariance, for several t also between them. To first order
    d t = -(1 - t) (b + a t) - t rho.
    """
    t = np.asarray(t, np.complex128)
    scale = np.array([prior.leakage_std, prior.leakage_std, prior.reference_std])
    by = np.stack([-(1 - t) * t, -(1 - t), -t], axis=-1) * scale
    turned = np.stack([by, 1j * by], axis=-1).reshape(*t.shape, 6)
    values, vectors = np.linalg.eigh(estimate.nuisance_covariance[:6, :6])
    return np.stack([turned.real, turned.imag], axis=-2) @ (vectors * np.sqrt(np.maximum(values, 0.0)))


def ratio_error(estimate: Inversion, prior: RigPrior, t: npt.ArrayLike) -> Real:
    """Return the standard deviation of 1 / P at t by leakage and reference: root mean variance of both parts."""
    return np.sqrt(np.sum(ratio_slopes(estimate, prior, t) ** 2, axis=(-2, -1)) / 2)
