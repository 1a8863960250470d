"""How likely a patch is when it is none of the library's materials, but any half space.

Before anything is measured such a stranger lies anywhere in permittivity: ln eps' is even from nearly air's to beyond
water's, and so is the loss on a scale that is logarithmic above `SOFT_LOSS` and linear below. The likelihood of what
was measured is the integral over all of them, by Laplace's method about the half space that fits best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polysight.host.materials.specimens import apparent_permittivity, features, relative

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

REAL_RANGE = (1.2, 30.0)
LOSS_RANGE = (0.0, 30.0)
SOFT_LOSS = 0.05
_STEPS, _STEP = 8, 1e-4
_PRIOR = 1 / (np.log(REAL_RANGE[1] / REAL_RANGE[0]) * np.arcsinh(LOSS_RANGE[1] / SOFT_LOSS))


def cost_of_none(log_h: Real, t: Complex, covariances: Real, angles_rad: Sequence[float]) -> Real:
    """Minus twice the log likelihood of each patch as any half space.

    Parameters
    ----------
    log_h, t
        ln|H| and V / H of the patches, [patch, angles].
    covariances
        float64 [patch, 3 * angles, 3 * angles] of their ln|H|, ln|V|, arg P, specimens' spread apart.
    angles_rad
        Incidence angles.
    """
    inverse = np.asarray(np.linalg.inv(covariances), np.float64)
    constant = np.linalg.slogdet(covariances)[1] + covariances.shape[1] * np.log(2 * np.pi)
    start = np.array([apparent_permittivity(q, angles_rad) for q in t], np.complex128)
    low = np.array([np.log(REAL_RANGE[0]), 0.0])
    high = np.array([np.log(REAL_RANGE[1]), np.arcsinh(LOSS_RANGE[1] / SOFT_LOSS)])
    at: Real = np.stack([np.log(start.real), np.arcsinh(-start.imag / SOFT_LOSS)], axis=1)
    at = np.asarray(np.clip(at, low, high), np.float64)
    best, curvature = np.full(len(t), np.inf), np.tile(np.eye(2), (len(t), 1, 1))
    for _ in range(_STEPS):
        off, slope = _off(at, log_h, t, angles_rad)
        weighed = slope.mT @ inverse
        information = weighed @ slope + 1e-9 * np.eye(2)
        cost = np.einsum("pd,pde,pe->p", off, inverse, off)
        better = cost < best
        best, curvature = np.where(better, cost, best), np.where(better[:, None, None], information, curvature)
        step = np.linalg.solve(information, weighed @ off[..., None])[..., 0]
        at = np.asarray(np.clip(at - step, low, high), np.float64)
    return np.asarray(constant + best - 2 * np.log(_PRIOR * 2 * np.pi) + np.linalg.slogdet(curvature)[1], np.float64)


def _off(at: Real, log_h: Real, t: Complex, angles_rad: Sequence[float]) -> tuple[Real, Real]:
    """Deviations of half spaces at [patch, 2] from what was seen, [patch, d], and their derivatives, [patch, d, 2]."""

    def deviations(where: Real) -> Real:
        own_h, own_t = features(np.exp(where[:, 0]) - 1j * SOFT_LOSS * np.sinh(where[:, 1]), angles_rad)
        return relative(own_h - log_h, own_t - t, t).reshape(len(t), -1)

    here = deviations(at)
    columns = [(deviations(at + step) - here) / _STEP for step in np.eye(2) * _STEP]
    return here, np.stack(columns, axis=-1)
