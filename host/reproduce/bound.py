"""The most that any classifier can get from the features: the error of Bayes' rule at the simulated noise."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from polysight.host.materials import Published
from polysight.host.polarimetry import fresnel
from polysight.host.reproduce.patches import Errors

TRIALS = 4000


@cache
def pixel_bound(
    materials: tuple[Published, ...], angles_deg: Sequence[float], errors: Errors, reference: bool, pixels: int
) -> float:
    """Share of pixels that Bayes' rule names right when it knows every material's mean and the errors' sizes.

    On ln|H|, ln|V| and arg P the errors are normal up to their second order, and the same for all materials: Bayes'
    rule is the nearest mean. Found by drawing, `TRIALS` a material.

    Parameters
    ----------
    materials, angles_deg, errors
        As they are drawn.
    reference
        Whether the error of the scan's metal reference is in the pixels, or known and taken off.
    pixels
        Pixels a decision is taken from: their own errors average out, those of the patch do not.
    """
    eps = np.array([m.permittivity for m in materials])
    variance = errors.shared * (2 if reference else 1) + (1 - errors.shared) / pixels
    columns, std = [], []
    for angle in angles_deg:
        r_s, r_p = fresnel(eps, np.radians(angle))
        p = r_s / r_p
        columns += [np.log(np.abs(r_s)), np.log(np.abs(r_p)), p / np.abs(p)]
        std += [errors.amplitude, errors.amplitude, errors.phase_rad * np.sqrt(2)]
    mean = np.stack(columns, axis=1)
    rng, right = np.random.default_rng(0), []
    for k in range(len(materials)):
        cost = np.zeros((TRIALS, len(materials)))
        for c, s in enumerate(std):
            noise = s * np.sqrt(variance) * rng.standard_normal((TRIALS, 1))
            if c % 3 == 2:  # a direction: its angle to that of every material
                apart = np.angle(mean[k, c] * np.exp(1j * noise) / mean[None, :, c])
            else:
                apart = np.real(mean[k, c]) + noise - np.real(mean[None, :, c])
            cost += (apart / s) ** 2
        right.append((cost.argmin(axis=1) == k).mean())
    return float(np.mean(right))
