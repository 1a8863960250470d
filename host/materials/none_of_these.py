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
    every = zip(log_h, t, inverse, strict=True)
    return np.asarray(constant + np.array([_one(h, q, i, angles_rad) for h, q, i in every]), np.float64)


def _one(log_h: Real, t: Complex, inverse: Real, angles_rad: Sequence[float]) -> float:
    start = apparent_permittivity(t, angles_rad)
    low = np.array([np.log(REAL_RANGE[0]), 0.0])
    high = np.array([np.log(REAL_RANGE[1]), np.arcsinh(LOSS_RANGE[1] / SOFT_LOSS)])
    at = np.clip(np.array([np.log(start.real), np.arcsinh(-start.imag / SOFT_LOSS)]), low, high)
    best, curvature = np.inf, np.eye(2)
    for _ in range(_STEPS):
        off, slope = _off(at, log_h, t, angles_rad)
        information = slope.T @ inverse @ slope + 1e-9 * np.eye(2)
        cost = float(off @ inverse @ off)
        if cost < best:
            best, curvature = cost, information
        step = np.linalg.solve(information, slope.T @ inverse @ off)
        at = np.asarray(np.clip(at - step, low, high), np.float64)
    return best - 2 * np.log(_PRIOR * 2 * np.pi) + float(np.linalg.slogdet(curvature)[1])


def _off(at: Real, log_h: Real, t: Complex, angles_rad: Sequence[float]) -> tuple[Real, Real]:
    """Deviations of a half space from what was seen, [d], and their derivatives by its two numbers, [d, 2]."""

    def deviations(one: Real) -> Real:
        own_h, own_t = features(complex(np.exp(one[0]), -SOFT_LOSS * np.sinh(one[1])), angles_rad)
        return relative(own_h - log_h, own_t - t, t).ravel()

    here = deviations(at)
    steps = np.eye(2) * _STEP
    return here, np.stack([(deviations(at + step) - here) / _STEP for step in steps], axis=1)
