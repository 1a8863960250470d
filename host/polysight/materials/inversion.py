"""Joint inversion of a scene: permittivities of all patches together with the rig's errors, and the error budget.

Relative to metal, a patch of true inverse ratio t = r_p / r_s = 1 / P is measured as

    V / H = (1 + rho) exp(j c + G.w) (1 + a) / (1 + b) (t + b) / (1 + a t)        |H| = kappa |r_s + a r_p| / |1 + a|

* a, b: leakage of p into H and of s into V; rho: relative error of the metal reference, complex.
* c: phase by paint on the metal, radians; 0 of bare metal.
* w: rise (slope angle) of the plate minus the metal's, [along the plane of incidence, across it], radians.
* G: derivative of ln(V / H) with respect to w; H's board and V's see a plate from different points.
* r_s, r_p: reflection coefficients, which follow from t and the angle of incidence by Eq. 2, 3 (POLySIGHT paper).
* kappa: brightness of the patch relative to an ideal one (thickness, roughness, illumination).

A plate that rises by w across the plane of incidence turns the s axis of both waves by d = w sin(theta). To first order
H receives (1 - d) r_s - d r_p, and V (1 + d) r_p + d r_s. So the patch has a - d and b + d instead of a and b, and
V / H a factor 1 + 2 d. (1 + a) / (1 + b) is of the metal and does not change, but is computed from the patch's a and b,
smaller by 2 d. G across has 4 sin(theta) for both.

The *common errors* of a scene are a, b, rho, c, G, the turn d / w, the error of the angle, the metal's brightness, the
usual size of ln kappa, whether the mount has moved, and the share of the library's materials. Their posterior is
sampled (sequential Monte Carlo with tempering; Del Moral, Doucet and Jasra, J. R. Stat. Soc. B 68, 2006), given that
each patch's t is of some material (`Kinds`), and that each |H| fits its t up to kappa.
The permittivity and the name of a patch come from the common errors' posterior without the evidence of that patch's own
material. So the permittivity is measured, not moved to the nearest material, and the name is the kind that fits it.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.kinds import (
    USUAL_LIBRARY_SHARE,
    DensityMaps,
    HalfSpaces,
    Kinds,
    PatchEstimate,
    PatchMeasurement,
    RatioCase,
    RatioEvidence,
    compute_brightness_density,
    compute_log_layer_odds,
    compute_probability_of_same_material,
    find_permittivity_slope,
    split_complex,
    turn_covariance,
)
from polysight.materials.specimens import METAL_WITHOUT_BRIGHTNESS, METAL_WITHOUT_PERMITTIVITY
from polysight.polarimetry import permittivity_from_ratio

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

BRIGHTNESS_RANGE = (0.03, 0.7)
"""Prior range of the standard deviation of ln kappa in a scene, uniform on a logarithmic scale. Flat simulated plates
differ by 3 %; thin, tilted, unevenly lit ones by a factor of two (published pictures)."""
METAL_BRIGHTNESS_STD = 0.5
"""Prior standard deviation of the metal's own ln kappa; chosen."""
LIBRARY_SHARE = (0.05, 0.85)
"""Prior range of the share of a scene's patches that are of the library's materials; uniform. With 0.05 to 0.95 the
estimate was 55 % where 50 % are true (308 scenes of the independent generator): names had too high probabilities."""
WEIGHT_OF_KINDS = 0.8
"""Weight of the patches' materials as evidence if the leakage was never measured (coarsened posterior; Miller and
Dunson, 2019): plates are alike, but count as independent. With 1, eps'' of 33 scenes were 0.9 standard errors low."""
MOVED_PROBABILITY = 0.5
MOVED_STD = 0.025
"""Probability that the mount has moved since its leakage was measured, and the standard deviation of the leakage then
(1 to 3 degrees, chosen). With a probability of 0.1, and V's board turned, the 95 % regions held the truth in 85 %."""
TURN_PER_RISE = -0.82
TURN_STD = 0.1
"""Change of a per radian of rise across the plane of incidence, -d / w = -sin(theta) of the published rig (with a TX
turned to the other side: sin(theta)), and its standard deviation, for antennas that turn polarisation off axis."""
UNEVEN_LIGHT = (1.0, 1.0)
EVEN_LIGHT = (0.3, 0.5)
"""Standard deviations of G, per radian, along the plane of incidence and across it, without and with the correction of
illumination. The independent generator has 0.6 along."""
PAINTED_PROBABILITY = 0.02
POSSIBLY_PAINTED = 0.2
"""Prior probability that the metal is painted or coated; and posterior probability above which paint is an error of
pixels and sub-bands, too. Both chosen: a lower second one would widen the errors of what is rather bare metal."""
LEAST_PAINTED = 0.05
"""If paint and bare metal both have at least this probability, each patch is estimated with the scene's probability of
paint, and named from both cases separately; chosen."""
MOST_PAINT_RAD = 0.65
PAINT_RAD_PER_MM = 2.65
"""Largest phase c by paint on metal, and c per thickness: 4 pi / lambda sin^2(theta) / cos(theta) (1 - 1 / eps) of a
thin layer at 55 degrees with eps = 3.3 (2.3 to 2.9 for eps of 2.5 to 4). p is delayed more than s, never less. Paint is
0.05 to 0.25 mm thick."""
CHI2_95 = 5.991
CHI2_997 = 11.8
"""Squared distances, in standard deviations, within which 95 and 99.7 % of a 2-D normal distribution lie."""
OWN_FREEDOM = 3.0
OWN_SCALE = float(np.sqrt(CHI2_95 / (OWN_FREEDOM * (0.05 ** (-2 / OWN_FREEDOM) - 1))))
"""Degrees of freedom of a patch's own errors (2-D Student's t): their size is estimated from a few places of the plate.
And the scale at which the 95 % region is as large as that of the normal distribution. Where own errors dominate, the
interval that holds 95 % is 2.1 to 3.6 times as wide as that of 68 % (drawn scenes; normal distribution: 1.96)."""
LEAST_DISTANCE = 4.0
"""Least distance of t, or of 1 / t, from 1 (metal) for a permittivity, in standard deviations of t; chosen."""
SOURCES = ("scatter", "metal reference", "leakage", "incidence", "tilt")
"""Sources of error in `PatchEstimate.shares`."""
# Columns of a particle (see `SceneLikelihood`).
LEAKAGE_H = (0, 1)
LEAKAGE_V = (2, 3)
REFERENCE = (4, 5)
ANGLE = 6
METAL_BRIGHTNESS = 7
SIZE_OF_BRIGHTNESS = 8
HAS_MOVED = 9
SHARE_OF_LIBRARY = 10
TURN_BY_RISE = 11
LIGHT_ACROSS = (12, 13)
LIGHT_ALONG = 14
PAINT = 15
PARTICLE_WIDTH = 16
COLUMNS_OF_SOURCE = {
    "metal reference": (*REFERENCE, PAINT),
    "leakage": (*LEAKAGE_H, *LEAKAGE_V, HAS_MOVED),
    "incidence": (ANGLE,),
    "tilt": (TURN_BY_RISE, *LIGHT_ACROSS, LIGHT_ALONG),
}
# Particles, moves at each temperature, and draws of a patch's own errors for each particle; chosen.
PARTICLES = 600
MOVES = 6
DRAWS = 8


@dataclass(frozen=True)
class RigPrior:
    """Prior of the rig's errors: means and standard deviations.

    Attributes
    ----------
    theta_std_rad
        Standard deviation of the incidence angle's error, which all patches share.
    leakage, leakage_std
        Leakage (a, b) as measured, or zero; standard deviation of the real part, and of the imaginary part, of either
        (default: that of the rig file, `leakage_prior`, over sqrt(2)).
    leakage_measured
        True if the leakage was measured; otherwise it is the prior of the mount.
    channels_known
        True if the images' amplitudes are relative to the direct path.
    reference_std
        Standard deviation of the real part, and of the imaginary part, of rho.
    brightness_range
        Range of the standard deviation of ln kappa.
    moved
        Probability that a mount whose leakage was measured has moved since.
    metal_rise
        Rise of the metal reference along the plane of incidence and across it, radians.
    lighting_std
        Standard deviations of G along the plane of incidence and across it, per radian of rise.
    painted
        Probability that the metal reference is painted.
    """

    theta_std_rad: float
    leakage: tuple[complex, complex] = (0j, 0j)
    leakage_std: float = 0.041
    leakage_measured: bool = False
    channels_known: bool = False
    reference_std: float = 0.01
    brightness_range: tuple[float, float] = BRIGHTNESS_RANGE
    moved: float = 0.0
    metal_rise: tuple[float, float] = (0.0, 0.0)
    lighting_std: tuple[float, float] = UNEVEN_LIGHT
    painted: float = PAINTED_PROBABILITY


@dataclass(frozen=True)
class Inversion:
    """The solution for a scene.

    Attributes
    ----------
    patches
        Estimates of the patches, in the given order.
    leakage, leakage_std
        Estimated (a, b), and their standard deviations: root of the mean variance of the real and the imaginary part.
    prior_std
        The same standard deviation by the prior alone.
    theta_error_rad, theta_std_rad
        True minus nominal incidence angle, and its standard deviation.
    brightness_off
        float64 [patch]: ln kappa, with the metal's own brightness taken out; NaN if |H| was not used.
    brightness_std
        Standard deviation of ln kappa in this scene.
    nuisance_covariance
        float64 [6, 6] of the real and imaginary parts of a, b, rho, in standard deviations of their prior.
    moved
        Probability that the mount has moved since its leakage was measured.
    painted, log_bare
        Probability that the metal reference is painted, and the logarithm of the probability that it is bare.
    paint_rad
        Mean of the phase c if the metal is painted; 0 if it is certainly bare.
    log_evidence
        Logarithm of the probability density of the measurements under the prior.
    fit
        float64 [patch]: log density of each patch's V / H over this metal if it is of some kind; zeros without kinds.
    """

    patches: tuple[PatchEstimate, ...]
    leakage: tuple[complex, complex]
    leakage_std: tuple[float, float]
    prior_std: float
    theta_error_rad: float
    theta_std_rad: float
    brightness_off: Real
    brightness_std: float
    nuisance_covariance: Real = field(repr=False)
    moved: float
    painted: float
    log_bare: float
    paint_rad: float
    log_evidence: float
    fit: Real = field(repr=False)

    @property
    def paint_mm(self) -> float:
        """Thickness of the paint on the metal reference, if it is painted."""
        return self.paint_rad / PAINT_RAD_PER_MM

    @property
    def leakage_determined(self) -> bool:
        """True if the scene reduced the uncertainty of both leakages to less than half of the prior's."""
        return max(self.leakage_std) < 0.5 * self.prior_std

    def choose_leakage_to_remove(self, prior: RigPrior) -> tuple[complex, complex]:
        """Return the leakage (a, b) that is removed from pixels: the scene's if determined, else the prior's mean.

        An estimate that is not determined depends mostly on the assumed materials of the patches.
        """
        if self.leakage_determined:
            return self.leakage
        return prior.leakage


def true_ratio(inverse: npt.ArrayLike, a: npt.ArrayLike, b: npt.ArrayLike, rho: npt.ArrayLike = 0j) -> Complex:
    """Return t of a measured V / H: the first formula of the module's docstring, solved for t, with c = 0 and w = 0."""
    a = np.asarray(a, np.complex128)
    b = np.asarray(b, np.complex128)
    ratio_without_reference = np.asarray(inverse, np.complex128) * (1 + b) / ((1 + a) * (1 + np.asarray(rho)))
    return np.asarray((ratio_without_reference - b) / (1 - a * ratio_without_reference), np.complex128)


def invert(measurements: Sequence[PatchMeasurement], prior: RigPrior, kinds: Kinds | None = None) -> Inversion:
    """Solve for all patches of a scene together.

    `measurements` are the patches without the metal reference. With `kinds` each patch has to be of some kind.
    """
    model = SceneLikelihood(measurements, prior, kinds)
    rng = np.random.default_rng(0)
    z, log_evidence, log_bare = sample_posterior(model, rng)
    weights = model.weights.copy()
    if not prior.leakage_measured:
        weights[1:] *= WEIGHT_OF_KINDS
        z, _ = _anneal(model, z, model.weights, weights, rng)
    patches = []
    parts = model.log_likelihoods(z)
    for i in range(model.patch_count):
        # A patch is measured without the evidence that it, or another of its material, must be some material.
        weights_without_patch = weights.copy()
        weights_without_patch[1:] *= 1 - model.same[i]
        particles = _anneal_without_patch(model, z, weights, weights_without_patch, rng, parts)
        patches.append(_estimate(model, particles, i, rng))
    return _collect_solution(model, (z, log_evidence, log_bare), tuple(patches))


def sample_posterior(model: SceneLikelihood, rng: np.random.Generator) -> tuple[Real, float, float]:
    """Return particles of the posterior of the common errors, the log evidence, and the log probability of bare metal.

    The cases that the mount has moved or not, and that the metal is painted or not, are sampled separately and weighted
    by their evidence. In one common sample, few particles or none would be of a case with a small prior that fits.
    """
    no_evidence = np.zeros_like(model.weights)
    samples = []
    log_weights: list[float] = []
    log_bare = -np.inf
    for hypothesis, probability in model.hypotheses():
        prior_particles = rng.standard_normal((PARTICLES, model.width))
        z, log_evidence = _anneal(hypothesis, prior_particles, no_evidence, model.weights, rng)
        samples.append(hypothesis.move_into(model.prior, z))
        log_weights.append(float(np.log(probability) + log_evidence))
        if hypothesis.prior.painted == 0:
            log_bare = np.logaddexp(log_bare, log_weights[-1])
    log_evidence = float(scipy.special.logsumexp(log_weights))
    # Resampling returns as many indices as it gets; every n-th of n hypotheses leaves `PARTICLES`.
    chosen = _resample(np.repeat(np.exp(np.array(log_weights) - log_evidence), PARTICLES), rng)[:: len(samples)]
    return np.concatenate(samples)[chosen], log_evidence, float(log_bare) - log_evidence


class SceneLikelihood:
    """Likelihood of the common errors.

    A particle z [width] holds the common errors as deviations from the prior's mean in its standard deviations; its
    columns are named at the top of the module. Methods take z [..., width].

    Arrays [patch]: `measured` V / H, `rise` [patch, 2] and `theta` as in `PatchMeasurement`; `bright`: True if |H| is
    used; `log_level`: ln |H|; `own` [patch, 2, 2]: covariance of t by a patch's own errors; `own_variance`: that of
    each part of V / H; `densities`: of t by kinds, or None; `log_layer_odds`: ln odds of layers by the sweep;
    `weights` [1 + patch]: of the log likelihoods; `same` [patch, patch]: probability of the same material.
    """

    width = PARTICLE_WIDTH

    def __init__(self, measurements: Sequence[PatchMeasurement], prior: RigPrior, kinds: Kinds | None) -> None:
        self.prior = prior
        self.kinds = kinds
        self.patch_count = len(measurements)
        self.measured = np.array([s.inverse_ratio for s in measurements], np.complex128)
        self.rise = np.array([s.rise for s in measurements], np.float64).reshape(-1, 2)
        self.theta = np.array([s.theta_rad for s in measurements], np.float64)
        level = np.array([np.nan if s.brightness is None else s.brightness for s in measurements], np.float64)
        # Metal-like patches have |H| = 1 with any leakage: they give no information on it.
        unlike_metal = np.abs(self.measured - 1) > METAL_WITHOUT_BRIGHTNESS
        self.bright = np.isfinite(level) & (level > 0) & unlike_metal
        self.log_level = np.log(np.where(self.bright, level, 1.0))
        self.own = self._compute_own_covariances(measurements)
        self.own_variance = np.array([np.trace(s.covariance) / 2 for s in measurements], np.float64)
        self.densities = None if kinds is None or not measurements else self._map_densities(kinds)
        self.same = compute_probability_of_same_material(measurements)
        # Plates of one material count as one: else six of a material that no library has would shift the leakage.
        self.weights = np.append(1.0, 1 / self.same.sum(axis=1))
        self.dispersions = tuple(s.dispersion for s in measurements)
        self.log_layer_odds = np.array([compute_log_layer_odds(d, kinds) for d in self.dispersions])

    def _compute_own_covariances(self, measurements: Sequence[PatchMeasurement]) -> Real:
        """Return the covariance of each patch's t by its own errors, [patch, 2, 2]: V / H's, turned to first order."""
        if not measurements:
            return np.zeros((0, 2, 2))
        nominal = np.zeros((1, self.width))
        step = 1e-4 * np.maximum(np.abs(self.measured), 1e-3)
        ratios = self.ratios(nominal)[0]
        stepped = self.ratios(nominal, step)[0]
        return turn_covariance((stepped - ratios) / step, np.stack([s.covariance for s in measurements]))

    def _map_densities(self, kinds: Kinds) -> DensityMaps:
        """Return maps of the density of t by kinds of materials, one for each patch around its possible values of t."""
        drawn_ratios = self.ratios(np.random.default_rng(1).standard_normal((PARTICLES, self.width)))
        maps = []
        for i in range(self.patch_count):
            t = drawn_ratios[np.isfinite(drawn_ratios[:, i]) & (np.abs(drawn_ratios[:, i]) < 3.0), i]
            if not t.size:
                t = np.zeros(1, np.complex128)
            # Particles may wander beyond these (wild ones, of 3 times metal's t, are left out): by three own errors and
            # 30 % of their span (chosen).
            reach = 3 * np.sqrt(np.trace(self.own[i])) + 0.3 * float(np.abs(t - t.mean()).max()) + 1e-3
            low = complex(t.real.min() - reach, t.imag.min() - reach)
            high = complex(t.real.max() + reach, t.imag.max() + reach)
            maps.append(kinds.density_map(low, high, self.own[i]))
        return DensityMaps.collect(maps)

    def hypotheses(self) -> list[tuple[SceneLikelihood, float]]:
        """Return the scene with the mount moved or not, and the metal painted or not; and the probability of each."""
        out: list[tuple[SceneLikelihood, float]] = []
        paint_cases = _list_cases(self._estimate_paint_probability())
        for (moved, share), (painted, paint_share) in itertools.product(_list_cases(self.prior.moved), paint_cases):
            hypothesis = copy.copy(self)
            hypothesis.prior = replace(self.prior, moved=moved, painted=painted)
            out.append((hypothesis, share * paint_share))
        return out

    def move_into(self, prior: RigPrior, z: Real) -> Real:
        """Convert particles of this hypothesis to particles of `prior`, in which it is one of several cases."""
        out = z.copy()
        out[:, HAS_MOVED] = _convert_to_prior(z[:, HAS_MOVED], self.prior.moved, prior.moved)
        out[:, PAINT] = _convert_to_prior(z[:, PAINT], self.prior.painted, prior.painted)
        return out

    def _estimate_paint_probability(self) -> float:
        """Return the probability of paint; 0 without kinds of materials: only they distinguish paint."""
        return self.prior.painted if self.kinds is not None else 0.0

    def leakage(self, z: Real) -> tuple[Complex, Complex]:
        """Return a and b at the metal's place, [..., 1] each."""
        p = self.prior
        scale = np.where(self.has_moved(z), max(MOVED_STD, p.leakage_std), p.leakage_std)
        a = p.leakage[0] + scale * _join_complex(z, LEAKAGE_H)
        b = p.leakage[1] + scale * _join_complex(z, LEAKAGE_V)
        return a, b

    def has_moved(self, z: Real) -> npt.NDArray[np.bool_]:
        """Return where the mount has moved since its leakage was measured, [..., 1]."""
        return z[..., HAS_MOVED, None] > scipy.special.ndtri(1 - self.prior.moved)

    def leakage_of_patches(self, z: Real) -> tuple[Complex, Complex]:
        """Return a and b of each patch, changed by its rise across the plane of incidence, [..., patch] each."""
        a, b = self.leakage(z)
        turned_by = self.turn(z) * self.rise[:, 1]
        return a + turned_by, b - turned_by

    def turn(self, z: Real) -> Real:
        """Return the change of a, and minus that of b, per radian of rise across the plane of incidence, [..., 1]."""
        return TURN_PER_RISE + TURN_STD * z[..., TURN_BY_RISE, None]

    def lighting(self, z: Real) -> Complex:
        """Return G.w, the change of ln(V / H) of each patch by its rise relative to the metal's, [..., patch]."""
        std_along, std_across = self.prior.lighting_std
        rise = self.rise - np.array(self.prior.metal_rise)
        # The phase of V / H is taken to change by a tenth of what the amplitude does (chosen).
        pattern_slope = z[..., LIGHT_ACROSS[0], None] + 0.1j * z[..., LIGHT_ACROSS[1], None]
        # turn(z) is -sin(theta), see the module's docstring.
        change_across = std_across * pattern_slope - 4 * self.turn(z)
        change_along = std_along * z[..., LIGHT_ALONG, None]
        return change_along * rise[:, 0] + change_across * rise[:, 1]

    def angle(self, z: Real) -> Real:
        """Return the true angles, [..., patch]."""
        return self.theta + self.prior.theta_std_rad * z[..., ANGLE, None]

    def reference_ratio(self, z: Real) -> Complex:
        """Return t of the metal reference, exp(-j c), [..., 1]: paint delays p more than s."""
        return np.exp(-1j * self.paint(z))

    def log_reference_brightness(self, z: Real) -> Real:
        """Return ln |r_s| of the reference, [..., 1]: 0 for metal."""
        return np.zeros((*z.shape[:-1], 1))

    def paint(self, z: Real) -> Real:
        """Return c, [..., 1], radians: 0 of bare metal, else uniform up to `MOST_PAINT_RAD`."""
        painted = self._estimate_paint_probability()
        if painted <= 0:
            return np.zeros((*z.shape[:-1], 1))
        beyond_bare = scipy.special.ndtr(z[..., PAINT, None]) - (1 - painted)
        return MOST_PAINT_RAD * np.maximum(beyond_bare, 0.0) / painted

    def ratios(self, z: Real, change: Real | float = 0.0) -> Complex:
        """Return t of every patch, [..., patch], from the measured V / H plus a `change` [patch] of it."""
        measured = self.measured + change
        a, b = self.leakage_of_patches(z)
        rho = self.prior.reference_std * _join_complex(z, REFERENCE)
        return true_ratio(measured * np.exp(-self.lighting(z)) * self.reference_ratio(z), a, b, rho)

    def permittivities(self, z: Real) -> Complex:
        """Return the permittivity of every patch, [..., patch]."""
        return np.asarray(permittivity_from_ratio(self.ratios(z), self.angle(z)), np.complex128)

    def half_spaces(self, z: Real) -> HalfSpaces:
        """Return the patches' half spaces, [..., patch]."""
        return HalfSpaces(self.ratios(z), self.angle(z))

    def brightness_off(self, z: Real, half_spaces: HalfSpaces) -> Real:
        """Return ln kappa, [..., patch], without the metal's brightness, from `half_spaces` at z; at most +-10."""
        a, _ = self.leakage_of_patches(z)
        with np.errstate(divide="ignore", invalid="ignore"):
            model = half_spaces.log_brightness() + np.log(np.abs((1 + a * half_spaces.t) / (1 + a)))
        difference = self.log_level - model - METAL_BRIGHTNESS_STD * z[..., METAL_BRIGHTNESS, None]
        difference = difference + self.log_reference_brightness(z)
        return np.where(np.isfinite(difference), np.clip(difference, -10, 10), 10.0)

    def brightness_std(self, z: Real) -> Real:
        """Return the standard deviation of ln kappa, [...]."""
        low, high = self.prior.brightness_range
        return low * (high / low) ** scipy.special.ndtr(z[..., SIZE_OF_BRIGHTNESS])

    def library_share(self, z: Real) -> Real:
        """Return the share of the library's materials in this scene, [...]; 1e-12 without a library."""
        if self.kinds is None or not self.kinds.in_library.any():
            return np.full(z.shape[:-1], 1e-12)
        low, high = LIBRARY_SHARE
        return low + (high - low) * scipy.special.ndtr(z[..., SHARE_OF_LIBRARY])

    def log_likelihoods(self, z: Real) -> Real:
        """Return log likelihoods [..., 1 + patch]: of all patches' |H| together, and of each patch as some material."""
        return self._log_likelihoods(z, self.half_spaces(z))

    def _log_likelihoods(self, z: Real, half_spaces: HalfSpaces) -> Real:
        """Return the `log_likelihoods` of z, given the half spaces of the patches at z."""
        density = compute_brightness_density(self.brightness_off(z, half_spaces), self.brightness_std(z)[..., None])
        brightness_log = np.where(self.bright, np.log(density + 1e-300), 0.0).sum(axis=-1, keepdims=True)
        if self.kinds is None:
            no_evidence = np.zeros((*brightness_log.shape[:-1], self.patch_count))
            return np.concatenate([brightness_log, no_evidence], axis=-1)
        if self.densities is None:
            return brightness_log
        ratios_of_kinds = half_spaces.move_to_angle(self.kinds.theta_rad)
        library_density, half_space_density, layer_density = np.exp(self.densities.log_densities(ratios_of_kinds))
        other_density = half_space_density + layer_density * np.exp(self.log_layer_odds)
        library_share = self.library_share(z)[..., None]
        log_kind_density = np.log(library_share * library_density + (1 - library_share) * other_density)
        return np.concatenate([brightness_log, log_kind_density], axis=-1)


def _list_cases(probability: float) -> list[tuple[float, float]]:
    """Return pairs (0: it is not so, or 1: it is so; probability of that), without pairs of probability 0."""
    return [(value, share) for value, share in ((0.0, 1 - probability), (1.0, probability)) if share > 0]


def _convert_to_prior(z: Real, certainty: float, probability: float) -> Real:
    """Convert a column z of a hypothesis (`certainty` 1: it is so, 0: not) to one of a prior with this `probability`.

    Columns are standard normal. In the prior's, it is so for the largest numbers, whose share is `probability`.
    """
    if certainty == probability:
        return z
    low = 1 - probability if certainty else 0.0
    high = 1.0 if certainty else 1 - probability
    return scipy.special.ndtri(low + (high - low) * scipy.special.ndtr(z))


def _join_complex(z: Real, columns: tuple[int, int]) -> Complex:
    """Return the complex number whose real and imaginary part are two columns of particles, [..., 1]."""
    return z[..., columns[0], None] + 1j * z[..., columns[1], None]


def _anneal_without_patch(
    model: SceneLikelihood, z: Real, before: Real, after: Real, rng: np.random.Generator, parts: Real
) -> Real:
    """Move particles as `_anneal` to the posterior without a patch's evidence; paint stays as probable as before.

    Paint is a fact of the scene, which all patches show together. Without the patch that shows it best the metal would
    count as bare, and the error bar of that patch would not include the paint.
    """
    painted = model.paint(z)[:, 0] > 0
    if painted.mean() < LEAST_PAINTED:
        return _anneal(model, z, before, after, rng, parts)[0]
    groups = []
    for group in (painted, ~painted):
        if group.any():
            chosen = rng.choice(np.flatnonzero(group), len(z))
            moved, _ = _anneal(model, z[chosen], before, after, rng, parts[chosen], keep_paint=True)
            groups.append(moved[: group.sum()])
    return np.concatenate(groups)


def _anneal(
    model: SceneLikelihood, z: Real, before: Real, after: Real, rng: np.random.Generator,
    parts: Real | None = None, keep_paint: bool = False,
) -> tuple[Real, float]:  # fmt: skip
    """Move particles `z` from one posterior to another; return them, and ln of the second's evidence over the first's.

    `before` and `after` [1 + patch] are the weights of the log likelihoods in the two posteriors. `parts` are the log
    likelihoods of `z`; None: they are computed. `keep_paint`: bare metal stays bare, painted metal painted.
    """
    parts = model.log_likelihoods(z) if parts is None else parts
    change = after - before
    # As the temperature goes from 0 to 1, the weights go from `before` to `after`, and log likelihoods rise by `gain`.
    temperature = 0.0
    log_evidence = 0.0
    while temperature < 1:
        gain = parts @ change
        step = _choose_step(gain, 1 - temperature)
        temperature = 1.0 if step >= 1 - temperature else temperature + step
        weight = before + temperature * change
        log_evidence += step * float(gain.max()) + float(np.log(np.mean(np.exp(step * (gain - gain.max())))))
        chosen = _resample(np.exp(step * (gain - gain.max())), rng)
        z = z[chosen]
        parts = parts[chosen]
        # Random walk with the particles' covariance, scaled as usual by the number of dimensions.
        spread = np.linalg.cholesky(np.cov(z.T) + 1e-9 * np.eye(model.width)) * 2.0 / np.sqrt(model.width)
        for _ in range(MOVES):
            proposed = z + rng.standard_normal(z.shape) @ spread.T
            parts_proposed = model.log_likelihoods(proposed)
            log_odds = (parts_proposed - parts) @ weight - 0.5 * np.sum(proposed**2 - z**2, axis=1)
            accepted = (np.log(rng.random(len(z))) < log_odds)[:, None]
            if keep_paint:
                accepted &= (model.paint(proposed) > 0) == (model.paint(z) > 0)
            z = np.where(accepted, proposed, z)
            parts = np.where(accepted, parts_proposed, parts)
    return z, log_evidence


def _choose_step(gain: Real, largest_step: float) -> float:
    """Return the largest step of the temperature, up to `largest_step`, that leaves half of the particles effective."""

    def effective_share(step: float) -> float:
        weight = np.exp(step * (gain - gain.max()))
        return float(weight.sum() ** 2 / np.sum(weight**2)) / gain.size

    if effective_share(largest_step) >= 0.5:
        return largest_step
    return max(float(scipy.optimize.brentq(lambda step: effective_share(step) - 0.5, 0.0, largest_step)), 1e-6)


def _resample(weight: Real, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    """Return indices of particles in proportion to their weights (systematic resampling)."""
    places = (rng.random() + np.arange(weight.size)) / weight.size
    return np.minimum(np.searchsorted(np.cumsum(weight) / weight.sum(), places), weight.size - 1)


def _collect_solution(
    model: SceneLikelihood, posterior: tuple[Real, float, float], patches: tuple[PatchEstimate, ...]
) -> Inversion:
    """Collect the solution from the `posterior` that `sample_posterior` returns and the estimates of the patches."""
    z, log_evidence, log_bare = posterior
    prior = model.prior
    paint = model.paint(z)
    painted = paint > 0
    a, b = (leakage[:, 0] for leakage in model.leakage(z))
    unit = max(prior.leakage_std, 1e-12)
    leakage_in_units = np.stack([a.real, a.imag, b.real, b.imag], axis=1) / unit
    reference = prior.reference_std * _join_complex(z, REFERENCE)
    if painted.mean() > POSSIBLY_PAINTED:
        reference = reference + 1j * paint
    reference_in_units = split_complex(reference[:, 0]) / max(prior.reference_std, 1e-12)
    covariance = np.cov(np.concatenate([leakage_in_units, reference_in_units], axis=1).T)
    leakage_variance = unit**2 * np.diag(covariance)[:4]
    return Inversion(
        patches=patches,
        leakage=(complex(a.mean()), complex(b.mean())),
        leakage_std=(float(np.sqrt(leakage_variance[:2].mean())), float(np.sqrt(leakage_variance[2:].mean()))),
        prior_std=prior.leakage_std,
        theta_error_rad=float(prior.theta_std_rad * z[:, ANGLE].mean()),
        theta_std_rad=float(prior.theta_std_rad * np.std(z[:, ANGLE])),
        brightness_off=np.where(model.bright, np.median(model.brightness_off(z, model.half_spaces(z)), axis=0), np.nan),
        brightness_std=float(np.exp(np.log(model.brightness_std(z)).mean())),
        nuisance_covariance=covariance,
        moved=float(model.has_moved(z).mean()),
        painted=float(painted.mean()),
        paint_rad=float(paint[painted].mean()) if painted.any() else 0.0,
        log_evidence=log_evidence,
        log_bare=log_bare,
        fit=model.log_likelihoods(z)[:, 1:].mean(axis=0),
    )


def _estimate(model: SceneLikelihood, z: Real, i: int, rng: np.random.Generator) -> PatchEstimate:
    """Estimate patch `i` from particles of the common errors: ratio, permittivity, shares of the sources, evidence."""
    t = model.ratios(z)[:, i]
    middle = complex(t.mean())
    ratio_covariance = np.cov(split_complex(t).T) + model.own[i]
    evidence = None if model.kinds is None else _collect_evidence(model, model.kinds, z, i)
    metal_gap = min(abs(middle - 1), abs(1 / middle - 1)) if middle else 1.0
    # Written with `not`, so that a ratio that is not a number gets no permittivity either.
    if not metal_gap >= max(METAL_WITHOUT_PERMITTIVITY, LEAST_DISTANCE * np.sqrt(np.trace(ratio_covariance) / 2)):
        return PatchEstimate(middle, ratio_covariance, None, None, {}, evidence)

    angles = model.angle(z)[:, i]
    value = complex(permittivity_from_ratio(middle, float(angles.mean())))
    noise = rng.multivariate_normal(np.zeros(2), model.own[i], (DRAWS, len(z)), method="cholesky")
    drawn_t = t + noise[..., 0] + 1j * noise[..., 1]
    drawn_values = np.asarray(permittivity_from_ratio(drawn_t, angles), np.complex128)
    # Near metal the moments of the far tail do not exist: draws within 99.7 % of the ratio's distribution are kept.
    deviation = split_complex(drawn_t - middle)
    distance2 = np.einsum("...i,ij,...j->...", deviation, np.linalg.inv(ratio_covariance), deviation)
    deviation = split_complex(drawn_values[distance2 < CHI2_997] - value)
    covariance = np.asarray(deviation.T @ deviation / len(deviation), np.float64)
    # Its 95 % ellipse is to hold 95 % of the draws; with a tail (the mount may have moved) it would hold more.
    distance2 = np.einsum("...i,ij,...j->...", deviation, np.linalg.inv(covariance), deviation)
    covariance *= float(np.quantile(distance2, 0.95)) / CHI2_95
    shares = _shares_of_sources(model, z, i, value)
    # Student's t: the variance of normal errors is drawn, too; not from `rng`, so that other patches keep their draws.
    scale = OWN_SCALE * np.sqrt(OWN_FREEDOM / np.random.default_rng(i).chisquare(OWN_FREEDOM, noise.shape[:2]))
    drawn_t = t + scale * (noise[..., 0] + 1j * noise[..., 1])
    deviation = split_complex(permittivity_from_ratio(drawn_t, angles) - value)
    real_68, imag_68 = np.nanquantile(np.abs(deviation), 0.6827, axis=(0, 1)).tolist()
    return PatchEstimate(
        inverse_ratio=middle, inverse_ratio_covariance=ratio_covariance, permittivity=value, covariance=covariance,
        shares=shares, evidence=evidence, half_widths_68=(real_68, imag_68),
    )  # fmt: skip


def _shares_of_sources(model: SceneLikelihood, z: Real, i: int, value: complex) -> dict[str, float]:
    """Return the share of each source in a permittivity's variance, sum 1; empty if that is zero or not finite."""
    # Effect of one source: its columns vary as in the particles, all others stay at their mean. Its part of the
    # variance is its covariance with the whole error, so that correlated sources add up to the whole.
    mean = np.tile(z.mean(axis=0), (len(z), 1))
    total_deviation = model.permittivities(z)[:, i] - value
    slope_at_mean = find_permittivity_slope(model.ratios(mean[:1])[0, i], model.theta[i])
    variance = {"scatter": float(abs(slope_at_mean) ** 2 * np.trace(model.own[i]))}
    permittivity_at_mean = model.permittivities(mean[:1])[0, i]
    for source, columns in COLUMNS_OF_SOURCE.items():
        single_source = mean.copy()
        single_source[:, columns] = z[:, columns]
        effect = model.permittivities(single_source)[:, i] - permittivity_at_mean
        variance[source] = max(0.0, float(np.mean((np.conj(effect) * total_deviation).real)))
    total = sum(variance.values())
    usable = np.isfinite(total) and total > 0
    return {source: part / total for source, part in variance.items()} if usable else {}


def _collect_evidence(model: SceneLikelihood, kinds: Kinds, z: Real, i: int) -> RatioEvidence:
    """Return the evidence for the name of patch `i`: its t at the incidence angle of `kinds`, with covariance."""
    half_spaces = model.half_spaces(z)
    t = half_spaces.move_to_angle(kinds.theta_rad)[:, i]
    covariance = np.cov(split_complex(t).T) + model.own[i]
    library_share = float(model.library_share(z).mean()) if kinds.in_library.any() else USUAL_LIBRARY_SHARE
    off = float(np.median(model.brightness_off(z, half_spaces)[:, i])) if model.bright[i] else np.nan
    return RatioEvidence(
        theta_rad=kinds.theta_rad, inverse_ratio=complex(t.mean()), covariance=covariance, library_share=library_share,
        brightness_off=off, brightness_std=float(np.exp(np.log(model.brightness_std(z)).mean())),
        dispersion=model.dispersions[i], cases=_split_by_paint(model, z, t, i),
    )  # fmt: skip


def _split_by_paint(model: SceneLikelihood, z: Real, t: Complex, i: int) -> tuple[RatioCase, ...]:
    """Return t [particle] of patch `i` if the metal is painted, and if it is bare; empty if one of them is unlikely."""
    painted = model.paint(z)[:, 0] > 0
    probability = float(painted.mean())
    if min(probability, 1 - probability) < LEAST_PAINTED:
        return ()
    return tuple(
        RatioCase(share, complex(t[chosen].mean()), np.cov(split_complex(t[chosen]).T) + model.own[i])
        for share, chosen in ((probability, painted), (1 - probability, ~painted))
    )
