"""Features of half spaces, and how they change between specimens of a material.

Two plates of the same material differ by some per cent in the real part of the permittivity and by tens of per cent in
the loss (Fig. 17 of the POLySIGHT paper). A specimen deviates from its material by s = (d ln eps', d ln eps''), which
is assumed to be normal. The features are ln|H|, ln|V| and arg P relative to metal, with P = H / V, at each angle of
incidence. They deviate by F s: the matrix F is the derivative of Eq. 2 of the paper, Fresnel's coefficients. F has rows
for all angles, because all of them show the same specimen.

The thresholds near metal and the scale `SOFT_RATIO` are chosen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polysight.polarimetry import fresnel, permittivity_from_ratio

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

PUBLISHED_SPREAD = (0.027, 0.19)
"""Standard deviations of ln eps' and ln eps'' if a library has no estimate: root mean square of PET's and ceramic's in
Fig. 17 of the paper (variances 0.0021 and 0.0295 of 3.78 and 4.75; 0.0255 and 0.1081 of 0.70 and 2.43)."""
PRIOR_FREEDOM = 4.0
"""Weight of `PUBLISHED_SPREAD` in the spread of all materials together, as a number of specimens; chosen. It counts,
because libraries have few specimens of a material."""
OWN_FREEDOM = 20.0
"""Weight of the spread of all materials together in that of a single material, as a number of specimens; chosen."""
METAL_WITHOUT_PERMITTIVITY = 0.25
"""|P - 1| or |1/P - 1|, the smaller, below which a patch gets no permittivity.

A relative error d of P changes eps by about 4 d / |P - 1/P|: at 0.25 the usual 3 % of P are already a quarter of the
permittivity, and the error grows without bound towards P = 1.
"""
METAL_WITHOUT_BRIGHTNESS = 0.25
"""Measured |V/H - 1| below which |H| is not used to estimate leakage: metal has |H| = 1 with any leakage."""
METAL_WITHOUT_ERROR = 0.25
"""Median |V/H - 1| of a patch below which no error of its own is estimated, and it is not used for common errors."""
METAL_UNLIKE = 0.2
"""|V/H - 1| above which a patch is evidence that its reference is metal: water relative to water looks like metal
relative to metal."""
METAL_SPECIMENS = 0.1
"""|V/H - 1| below which a material counts as metal, whose specimens do not differ."""
SOFT_RATIO = 0.05
"""|V / H| below which its errors are additive (leakage, noise) instead of relative (gain, phase)."""
# Step of ln eps' and ln eps'' in difference quotients of the features; chosen.
_STEP = 1e-4
# Expectation maximisation ends after this number of rounds, or earlier if a round changes the pooled variances by less
# than this share.
_ROUNDS = 300
_SETTLED_CHANGE = 1e-3
# Least loss of a half space, since ln eps'' does not exist for a loss of 0.
_LEAST_LOSS = 1e-3


def soft_modulus(t: npt.ArrayLike) -> Real:
    """Return the scale of errors of t = V / H [any], `sqrt(|t|^2 + SOFT_RATIO^2)`; it is not zero if V is."""
    return np.asarray(np.hypot(np.abs(t), SOFT_RATIO), np.float64)


def features(permittivity: npt.ArrayLike, angles_rad: Sequence[float]) -> tuple[Real, Complex]:
    """Return ln|H| and V / H of half spaces relative to metal (Eq. 2), each [..., angles]."""
    reflections = [fresnel(permittivity, angle) for angle in angles_rad]
    log_h = np.stack([np.log(np.abs(s)) for s, _ in reflections], axis=-1)
    return log_h, np.stack([p / s for s, p in reflections], axis=-1)


def effect(t: Complex, angles_rad: Sequence[float]) -> Real:
    """Return the derivatives of ln|H|, ln|V| and arg P of a material by ln eps' and ln eps'', [3 * angles, 2].

    `t` complex128 [angles] is V / H of the material. The result is zero for metal, and if the angles are not known.
    """
    if len(angles_rad) != len(t) or not np.isfinite(t).all() or bool((np.abs(t - 1) < METAL_SPECIMENS).any()):
        return np.zeros((3 * len(t), 2))
    eps = apparent_permittivity(t, angles_rad)
    log_h, half_space_t = features(eps, angles_rad)
    columns = []
    # ln eps' or ln eps'' larger by `_STEP`.
    real_stretched = complex(eps.real * np.exp(_STEP), eps.imag)
    loss_stretched = complex(eps.real, eps.imag * np.exp(_STEP))
    for stretched in (real_stretched, loss_stretched):
        stretched_log_h, stretched_t = features(stretched, angles_rad)
        change = relative(stretched_log_h - log_h, stretched_t - half_space_t, half_space_t)
        columns.append(change.ravel() / _STEP)
    return np.stack(columns, axis=1)


def relative(log_h: Real, dt: Complex, t: Complex) -> Real:
    """Convert deviations of ln|H| and of t, [..., angles] each, to those of ln|H|, ln|V| and arg P, [..., angles, 3].

    The result is of first order in the deviations. :func:`soft_modulus` takes the place of |t|, so that it stays finite
    if V vanishes.
    """
    # dt / t: its real part is the change of ln|V / H|, its imaginary part that of arg(V / H) = -arg P.
    change_along_t = dt * np.exp(-1j * np.angle(t)) / soft_modulus(t)
    return np.stack([log_h, log_h + change_along_t.real, -change_along_t.imag], axis=-1)


def apparent_permittivity(t: Complex, angles_rad: Sequence[float]) -> complex:
    """Return the permittivity of the half space with t = V / H [angles]: the mean of Eq. 3 over the angles.

    It is changed to a passive one if necessary.
    """
    eps = complex(np.mean([complex(permittivity_from_ratio(q, angle)) for q, angle in zip(t, angles_rad, strict=True)]))
    # The real part is at least 1.01: a half space of 1 would reflect nothing.
    return complex(max(eps.real, 1.01), min(eps.imag, -_LEAST_LOSS))


def fit_spread(
    residuals: Real,
    material: npt.NDArray[np.intp],
    specimen: npt.NDArray[np.intp],
    effects: Real,
    noise: Real,
    gains_alike: bool = True,
) -> tuple[Real, Real]:
    """Estimate the spread of specimens and the covariance of placements from patches, by expectation maximisation.

    A patch is one placement of a specimen in a scan. Its residual is `F_m s + u`: s is the specimen's deviation, equal
    in all its patches, u the placement's.

    `residuals` [patches, d] are patch means minus their material's mean, `material` and `specimen` the numbers of each
    patch (specimens are numbered over all materials), `effects` [materials, d, 2] those of :func:`effect`, `noise`
    [d, d] the covariance to start from. With `gains_alike` the features are ln|H|, ln|V|, arg P of each angle, with
    equal gain errors of H and V (:func:`average_channels`).

    Return the variances of ln eps' and ln eps'' of each material, [materials, 2], and the covariance of placements,
    [d, d]. The spread of all materials together is estimated with the published spread as prior, and is then the prior
    of each material's own spread. A material with a single specimen shows no spread, but its patches count for the
    placements.
    """
    is_single = np.array([np.unique(specimen[material == k]).size < 2 for k in range(len(effects))])
    has_spread = ~is_single & (np.abs(effects).max(axis=(1, 2), initial=0) > 0)
    _, specimen_of_patch = np.unique(specimen, return_inverse=True)
    patches_of_specimen = np.bincount(specimen_of_patch)
    material_of_specimen = np.zeros(patches_of_specimen.size, np.intp)
    material_of_specimen[specimen_of_patch] = material
    residual_sums = np.stack([np.bincount(specimen_of_patch, c) for c in residuals.T], axis=1)
    is_used = has_spread[material_of_specimen]
    effect_of_specimen = effects[material_of_specimen]
    prior = np.square(PUBLISHED_SPREAD)
    pooled = prior
    placement = noise
    second_moments = np.zeros((patches_of_specimen.size, 2))
    for _ in range(_ROUNDS):
        # Expectation: deviation s of each specimen given its patches, normal with this mean and covariance. Axes are
        # g specimen, a and b the two components of s, d and e feature.
        information = effect_of_specimen.mT @ np.linalg.inv(placement + _compute_floor(noise))
        posterior = np.linalg.inv(
            np.diag(1 / pooled) + patches_of_specimen[:, None, None] * (information @ effect_of_specimen)
        )
        posterior[~is_used] = 0.0
        posterior_mean = np.einsum("gab,gbd,gd->ga", posterior, information, residual_sums)
        second_moments = posterior_mean**2 + np.einsum("gaa->ga", posterior)
        # Maximisation: spread of specimens and covariance of placements given these deviations.
        pooled_before = pooled
        pooled = (PRIOR_FREEDOM * prior + second_moments[is_used].sum(axis=0)) / (PRIOR_FREEDOM + is_used.sum())
        residuals_left = residuals - np.einsum("gda,ga->gd", effect_of_specimen, posterior_mean)[specimen_of_patch]
        uncertainty = np.einsum(
            "g,gda,gab,geb->de", patches_of_specimen.astype(float), effect_of_specimen, posterior, effect_of_specimen
        )
        placement = (residuals_left.T @ residuals_left + uncertainty) / len(residuals)
        placement = average_channels(placement) if gains_alike else placement
        if np.abs(pooled / pooled_before - 1).max() < _SETTLED_CHANGE:
            break
    return _spread_each_material(pooled, second_moments, material_of_specimen, has_spread), placement


def _spread_each_material(
    pooled: Real,
    second_moments: Real,
    material_of_specimen: npt.NDArray[np.intp],
    has_spread: npt.NDArray[np.bool_],
) -> Real:
    """Return the variances of each material, [material, 2]: the pooled ones, corrected by its own specimens' squares.

    `second_moments` [specimen, 2] are these squares; `has_spread` [material] is true for a dielectric with several
    specimens.
    """
    spreads = np.tile(pooled, (has_spread.size, 1))
    for k in np.flatnonzero(has_spread):
        moments = second_moments[material_of_specimen == k]
        spreads[k] = (OWN_FREEDOM * pooled + moments.sum(axis=0)) / (OWN_FREEDOM + len(moments))
    return spreads


def average_channels(covariance: Real) -> Real:
    """Return a covariance of ln|H|, ln|V|, arg P, [3 * angles, 3 * angles], with equal gain errors of H and V.

    A specimen's deviation changes mostly V, so that the gain error of V cannot be separated from it; that of H can.
    """
    averaged = np.zeros_like(covariance)
    for i in range(0, len(covariance), 3):
        h, v, phase = range(i, i + 3)
        averaged[h, h] = averaged[v, v] = (covariance[h, h] + covariance[v, v]) / 2
        averaged[h, v] = averaged[v, h] = covariance[h, v]
        averaged[phase, phase] = covariance[phase, phase]
    return averaged


def _compute_floor(covariance: Real) -> Real:
    """Return a small multiple of the identity, which keeps a singular covariance [d, d] invertible."""
    return (1e-9 * np.trace(covariance) + 1e-14) * np.eye(len(covariance))
