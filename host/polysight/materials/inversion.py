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

`metal_evidence` judges whether a patch is metal by everything but itself: two explanations of the whole scene are
fitted to the same data. The patch is metal (r_s = r_p = -1), or it is some dielectric. Each explanation determines the
other patches relative to it, and these must then be possible materials: brightness |H| that agrees with their ratio
(Eq. 2 and 3), no gain, a permittivity from 1 to about ten. Each also predicts V / H of the patch itself relative to the
direct path, which reaches both boards with equal strength: metal reflects both polarisations fully, a dielectric loses
most of p at these angles. The score is the difference of both best sums of squares, dielectric minus metal: positive
values support metal. It is half of minus twice the log likelihood ratio up to the priors of leakage, angle and
brightness, which both share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.specimens import (
    METAL_PIECE,
    METAL_UNLIKE,
    METAL_WITHOUT_BRIGHTNESS,
    METAL_WITHOUT_PERMITTIVITY,
)
from polysight.polarimetry import fresnel, permittivity_from_ratio, ratio_from_permittivity

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

BRIGHTNESS_STD = 0.05
"""Prior of ln kappa: plates rough by 0.2 mm lose 7 %, edges and tilts change |H| by some per cent."""
BRIGHTNESS_FREEDOM = 4.0
"""Weight of that prior against the patches' own scatter, in number of patches."""
OUTLIER = 3.0
"""Standard deviations of brightness beyond which a patch (a thin sheet, a shadow) loses weight (Cauchy)."""
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
        self.bright = np.isfinite(level) & (level > 0) & (np.abs(self.q - 1) > METAL_WITHOUT_BRIGHTNESS)
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

    `seen` are the patches without the metal reference.
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
    if not distance >= max(METAL_WITHOUT_PERMITTIVITY, LEAST_DISTANCE * np.sqrt(np.trace(of_ratio) / 2)):
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


CHANNEL_RATIO_STD_DB = 2.5
"""Standard deviation of metal's V / H relative to the direct path's: the boards' patterns differ off their axis."""
SURE_SCORE = 3.5
WEAK_V_DB = -3.0
"""V / H relative to the direct path below which a patch is hardly metal: metal has 0 dB, bare water -4 dB."""
_LARGEST = 10.0  # |eps| of common materials; larger values are penalised
_STARTS = [
    complex(real, -real * loss) for real in (2.0, 2.6, 3.2, 4.0, 5.0, 7.0, 10.0) for loss in (0.01, 0.15, 0.4, 1.2)
]
_REFINED = 3
_LARGEST_RESIDUAL = 1e3


@dataclass(frozen=True)
class MetalEvidence:
    """Evidence for and against a patch being metal.

    Attributes
    ----------
    score
        Sum of squares of the best dielectric minus that of metal; positive values support metal.
    others
        Number of other patches that differ from the judged one. Similar patches give no evidence: metal beside metal
        looks like water beside water.
    channel_ratio_db
        V / H of the patch relative to the direct path; None if not known.
    """

    score: float
    others: int
    channel_ratio_db: float | None

    @property
    def needed(self) -> float:
        """Least score to count as metal; it rises with fewer other patches.

        Limits are from random scenes with and without metal, of common and of very lossy materials
        (see tests/materials/test_metal_evidence.py).
        """
        if self.others == 0:
            return np.inf
        if self.others == 1:
            return 1.5
        return 0.5 if self.others < 6 else -2.0

    @property
    def sure(self) -> bool:
        """True if it is certainly metal: very lossy dielectrics (wet, conducting) come close to metal."""
        return self.enough and self.score >= SURE_SCORE

    @property
    def against(self) -> bool:
        """True if the data contradict metal, even if the user declares it."""
        weak = self.channel_ratio_db is not None and self.channel_ratio_db < WEAK_V_DB
        return weak or (self.others > 0 and self.score < -1.0)

    @property
    def enough(self) -> bool:
        """True if the patch is shown to be metal."""
        return self.score >= self.needed


def metal_evidence(seen: list[PatchMeasurement], prior: RigPrior, channel_ratio: complex | None) -> MetalEvidence:
    """Compare the explanations of a patch as metal and as a dielectric.

    `seen` are the other patches, relative to the judged one; `channel_ratio` is V / H of the patch itself in images
    referenced to the direct path, None for other images.
    """
    level = None if channel_ratio is None or not abs(channel_ratio) > 0 else 20 * float(np.log10(abs(channel_ratio)))
    if not seen:
        return MetalEvidence(0.0, 0, level)
    metal = _Explanation(seen, prior, level)
    as_metal = _best(metal, np.zeros(8))
    starts = np.array([[0.0] * 8 + [np.log(e.real), np.log(-e.imag)] for e in _STARTS])
    starts = starts[np.argsort(np.sum(metal.residuals(starts) ** 2, axis=-1), kind="stable")]
    as_dielectric = min(_best(metal, x) for x in starts[:_REFINED])
    unlike = sum(abs(s.inverse_ratio - 1) > METAL_UNLIKE for s in seen)
    return MetalEvidence(as_dielectric - as_metal, unlike, level)


def _best(model: _Explanation, start: Real) -> float:
    """Return the least sum of squares from one start."""
    limit = 40 * start.size
    found = scipy.optimize.least_squares(model.residuals, start, jac=model.jacobian, method="lm", max_nfev=limit)
    return 2 * float(found.cost)


class _Explanation:
    """Residuals of the other patches if the judged one is metal (8 parameters) or has a permittivity (2 more)."""

    def __init__(self, seen: list[PatchMeasurement], prior: RigPrior, level_db: float | None) -> None:
        self.prior, self.level_db = prior, level_db
        self.q = np.array([s.inverse_ratio for s in seen], np.complex128)
        levels = np.array([np.nan if s.brightness is None else s.brightness for s in seen], np.float64)
        self.bright = np.isfinite(levels) & (levels > 0)
        self.log_level = np.log(np.where(self.bright, levels, 1.0))
        self.loose = np.array([s.std for s in seen])
        self.theta = np.array([s.theta_rad for s in seen], np.float64)

    def residuals(self, x: Real) -> Real:
        """Return priors, brightness, and violations of possible permittivities; [..., parameter] to [..., residual]."""
        p = self.prior
        u = [x[..., k, None] for k in range(x.shape[-1])]
        a = p.leakage[0] + p.leakage_std * (u[0] + 1j * u[1])
        b = p.leakage[1] + p.leakage_std * (u[2] + 1j * u[3])
        theta = self.theta + p.theta_std_rad * u[4]
        own, own_s, bounds = np.ones((1,), np.complex128), -np.ones((1,), np.complex128), []
        if len(u) > 8:
            eps, middle = (
                np.exp(np.minimum(u[8], 4.0)) - 1j * np.exp(np.minimum(u[9], 4.0)),
                theta.mean(-1, keepdims=True),
            )
            own, own_s = 1 / ratio_from_permittivity(eps, middle), fresnel(eps, middle)[0]
            large = [u[8] - np.log(30), u[9] - np.log(30), -u[8]]
            bounds = [np.maximum(0.0, beyond) / 0.1 for beyond in large]
            bounds.append(np.maximum(0.0, np.log(np.abs(eps) / _LARGEST)) / 0.6)  # such dielectrics are rare
        c = self.q * (own + b) / (1 + a * own) / (1 + p.reference_std * (u[5] + 1j * u[6]))
        t = (c - b) / (1 - a * c)
        with np.errstate(divide="ignore", invalid="ignore"):
            eps_of = permittivity_from_ratio(t, theta)
            r_s = fresnel(eps_of, theta)[0]
            model = np.log(np.abs(r_s * (1 + a * t) / (own_s * (1 + a * own))))
            brightness = np.where(self.bright, (self.log_level - model) / BRIGHTNESS_STD - u[7], 0.0)
            size = np.abs(eps_of)
            impossible = [
                np.maximum(0.0, 1 - eps_of.real) / 0.1,
                np.maximum(0.0, eps_of.imag - 0.02) / (0.1 + 0.1 * size),
                np.maximum(0.0, np.log(size / _LARGEST)) / 0.5,
            ]
        metal, slack = np.abs(t - 1) < METAL_PIECE, 1 + 10 * self.loose
        patches = [brightness, *(np.where(metal, 0.0, part) / slack for part in impossible)]
        channel = [] if self.level_db is None else [(self._level(own, a, b) - self.level_db) / CHANNEL_RATIO_STD_DB]
        return np.concatenate([x[..., :8], _robust(np.concatenate(patches, -1)), *channel, *bounds], -1)

    def jacobian(self, x: Real) -> Real:
        """[residual, parameter]."""
        return forward_differences(self.residuals, x)

    @staticmethod
    def _level(own: Complex, a: Complex, b: Complex) -> Real:
        """Return V / H relative to the direct path, dB; the direct path has the factors 1 + a and 1 + b."""
        return 20 * np.log10(np.maximum(np.abs((own + b) / (1 + a * own) * (1 + a) / (1 + b)), 1e-6))


def _robust(r: Real) -> Real:
    """Apply Cauchy's loss, so that one odd patch does not decide; NaN counts as a large residual."""
    top = _LARGEST_RESIDUAL
    r = np.clip(np.nan_to_num(r, nan=top, posinf=top, neginf=-top), -top, top)
    return np.sign(r) * OUTLIER * np.sqrt(np.log1p((r / OUTLIER) ** 2))
