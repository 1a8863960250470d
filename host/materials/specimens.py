"""How specimens of one material differ: their spread in permittivity, and what that does to what a rig sees.

Two plates of the same material differ by some per cent in the real part of the permittivity and by tens of per cent in
the loss (Fig. 17 of the paper). In `(ln eps', ln eps'')` that is taken to be normal; Eq. 2 turns it into errors of
ln|H|, ln|V| and arg P that belong together, under all angles at once, for it is one specimen that they see.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polysight.host.polarimetry import fresnel, permittivity_from_ratio

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

PUBLISHED_SPREAD = (0.027, 0.19)
"""Standard deviations of ln eps' and ln eps'' where a library does not tell: root mean square of PET's and ceramic's in
Fig. 17 of the paper (variances 0.0021 and 0.0295 of 3.78 and 4.75; 0.0255 and 0.1081 of 0.70 and 2.43)."""
PRIOR_FREEDOM = 4.0
"""How many specimens' worth of evidence that is, beside the library's own specimens."""
OWN_FREEDOM = 20.0
"""How many specimens' worth of evidence the mean of all materials is, for one material's own spread."""
SOFT = 0.05
"""|V / H| below which its errors are taken to be additive (leakage, noise) instead of relative (gain, phase)."""
_STEP = 1e-4
_ROUNDS = 300
_SETTLED = 1e-3
_LEAST_LOSS = 1e-3
_METAL = 0.1  # |t - 1| below which a material is metal, whose specimens do not differ


def softened(t: npt.ArrayLike) -> Real:
    """The scale to which errors of t = V / H are relative, `sqrt(|t|^2 + SOFT^2)`: V may vanish (Brewster's angle)."""
    return np.asarray(np.hypot(np.abs(t), SOFT), np.float64)


def features(permittivity: npt.ArrayLike, angles_rad: Sequence[float]) -> tuple[Real, Complex]:
    """ln|H| and V / H of half spaces relative to metal (Eq. 2), each [..., angles]."""
    both = [fresnel(permittivity, angle) for angle in angles_rad]
    log_h = np.stack([np.log(np.abs(s)) for s, _ in both], axis=-1)
    return log_h, np.stack([p / s for s, p in both], axis=-1)


def effect(t: Complex, angles_rad: Sequence[float]) -> Real:
    """What a specimen's ln eps' and ln eps'' do to ln|H|, ln|V| and arg P of a material seen as t, [3 * angles, 2].

    Parameters
    ----------
    t
        complex128 [angles], V / H of the material.
    angles_rad
        Its incidence angles.

    Returns
    -------
    Zero for metal, and where the angles are not known.
    """
    if len(angles_rad) != len(t) or not np.isfinite(t).all() or bool((np.abs(t - 1) < _METAL).any()):
        return np.zeros((3 * len(t), 2))
    eps = apparent_permittivity(t, angles_rad)
    here_h, here_t = features(eps, angles_rad)
    columns = []
    for stretched in (complex(eps.real * np.exp(_STEP), eps.imag), complex(eps.real, eps.imag * np.exp(_STEP))):
        there_h, there_t = features(stretched, angles_rad)
        columns.append(relative(there_h - here_h, there_t - here_t, here_t).ravel() / _STEP)
    return np.stack(columns, axis=1)


def relative(log_h: Real, dt: Complex, t: Complex) -> Real:
    """Deviations of ln|H| and of t, [..., angles] each, as those of ln|H|, ln|V| and arg P, [..., angles, 3].

    To first order; with :func:`softened` instead of |t|, so that they stay finite where V vanishes.
    """
    along = dt * np.exp(-1j * np.angle(t)) / softened(t)
    return np.stack([log_h, log_h + along.real, -along.imag], axis=-1)


def without(log_h: Real, t: Complex, deviations: Real) -> tuple[Real, Complex]:
    """ln|H| and t [..., angles] with deviations [..., angles, 3] taken off: :func:`relative` undone."""
    h, v, phase = (deviations[..., i] for i in range(3))
    return log_h - h, t - softened(t) * ((v - h) - 1j * phase) * np.exp(1j * np.angle(t))


def apparent_permittivity(t: Complex, angles_rad: Sequence[float]) -> complex:
    """The half space that looks like t [angles], mean of what Eq. 3 gives for each angle; passive, at least air's."""
    eps = complex(np.mean([complex(permittivity_from_ratio(q, angle)) for q, angle in zip(t, angles_rad, strict=True)]))
    return complex(max(eps.real, 1.01), min(eps.imag, -_LEAST_LOSS))


def fit_spread(
    residuals: Real,
    material: npt.NDArray[np.intp],
    specimen: npt.NDArray[np.intp],
    effects: Real,
    noise: Real,
    gains_alike: bool = True,
) -> tuple[Real, Real]:
    """The specimens' spread and the placements' covariance that patches' residuals tell: expectation maximisation.

    A patch's residual is `F_m s + u`, s the specimen's deviation, the same in all its patches, u the placement's.

    Parameters
    ----------
    residuals
        float64 [patches, d], of patch means about their material's.
    material, specimen
        Of each patch; specimens are numbered over all materials.
    effects
        float64 [materials, d, 2], of :func:`effect`.
    noise
        float64 [d, d], covariance to start from.
    gains_alike
        Whether the features are ln|H|, ln|V|, arg P of each angle, and gains of H and V err alike (:func:`alike`).

    Returns
    -------
    spread : float64 [materials, 2], variances of ln eps' and ln eps''
        Of all materials together, with the published spread as prior, corrected by each material's own. A material of
        which one specimen was seen tells nothing.
    placement : float64 [d, d]
    """
    one = np.array([np.unique(specimen[material == k]).size < 2 for k in range(len(effects))])
    telling = ~one & (np.abs(effects).max(axis=(1, 2), initial=0) > 0)
    _, group = np.unique(specimen, return_inverse=True)
    count = np.bincount(group)
    kind = np.zeros(count.size, np.intp)
    kind[group] = material
    sums = np.stack([np.bincount(group, c) for c in residuals.T], axis=1)
    used, f = telling[kind], effects[kind]
    prior = np.square(PUBLISHED_SPREAD)
    pooled, placement, second = prior, noise, np.zeros((count.size, 2))
    for _ in range(_ROUNDS):
        information = f.mT @ np.linalg.inv(placement + _floor(noise))
        spread = np.linalg.inv(np.diag(1 / pooled) + count[:, None, None] * (information @ f))
        spread[~used] = 0.0
        mean = np.einsum("gab,gbd,gd->ga", spread, information, sums)
        second = mean**2 + np.einsum("gaa->ga", spread)
        before = pooled
        pooled = (PRIOR_FREEDOM * prior + second[used].sum(axis=0)) / (PRIOR_FREEDOM + used.sum())
        left = residuals - np.einsum("gda,ga->gd", f, mean)[group]
        blur = np.einsum("g,gda,gab,geb->de", count.astype(float), f, spread, f)
        placement = (left.T @ left + blur) / len(residuals)
        placement = alike(placement) if gains_alike else placement
        if np.abs(pooled / before - 1).max() < _SETTLED:
            break
    return _each(pooled, second, kind, telling), placement


def _each(pooled: Real, second: Real, kind: npt.NDArray[np.intp], telling: npt.NDArray[np.bool_]) -> Real:
    """The spread of each material: that of all together, corrected by its own specimens' squares [specimen, 2]."""
    own = np.tile(pooled, (telling.size, 1))
    for k in np.flatnonzero(telling):
        mine = second[kind == k]
        own[k] = (OWN_FREEDOM * pooled + mine.sum(axis=0)) / (OWN_FREEDOM + len(mine))
    return own


def alike(covariance: Real) -> Real:
    """A covariance of ln|H|, ln|V|, arg P, [3 * angles, 3 * angles], with gains of H and V that err alike.

    A specimen's deviation changes mostly V, so that V's own gain error can hardly be told from it; H's can.
    """
    out = np.zeros_like(covariance)
    for i in range(0, len(covariance), 3):
        h, v, phase = range(i, i + 3)
        out[h, h] = out[v, v] = (covariance[h, h] + covariance[v, v]) / 2
        out[h, v] = out[v, h] = covariance[h, v]
        out[phase, phase] = covariance[phase, phase]
    return out


def _floor(covariance: Real) -> Real:
    return (1e-9 * np.trace(covariance) + 1e-14) * np.eye(len(covariance))
