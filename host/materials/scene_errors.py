"""From the joint inversion's error budget to what naming has to reckon with (`SceneErrors`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from polysight.host.materials.inversion import Inversion, PatchMeasurement, RigPrior
from polysight.host.materials.samples import SceneErrors
from polysight.host.materials.specimens import features, relative, softened

Real = npt.NDArray[np.float64]
REFERENCE_BRIGHTNESS_STD = 0.1
"""Of ln|H| and ln|V| of all patches: a stated prior for a metal plate that lies high or askew; not measured."""


def scene_errors(found: Inversion, prior: RigPrior, seen: Sequence[PatchMeasurement]) -> SceneErrors:
    """What the budget leaves uncertain of ln|H|, ln|V| and arg P of the patches, for naming them together.

    In common are leakage of p into H (da) and of s into V (db), the metal reference (rho) and the angle, as the
    inversion left them, and the reference's brightness, of which V / H tells nothing. Each patch has the error of its
    own V / H and its brightness, common to both channels.
    To first order about the solution, for the patches' true features with t = r_p / r_s and fixed permittivity:
    d ln|H| = Re((1 - t) da), d t = -(1 - t) (t da + db) - t rho - (dt / dtheta) dtheta.
    """
    t = np.array([p.inverse_ratio for p in found.patches], np.complex128)
    none = np.zeros_like(t)
    by_h = np.stack([1 - t, none, none], axis=1)
    by_t = np.stack([-(1 - t) * t, -(1 - t), -t], axis=1)
    scale = np.array([prior.leakage_std, prior.leakage_std, prior.reference_std])
    columns = [relative((unit * scale * by_h).real, unit * scale * by_t, t[:, None]) for unit in (1.0, 1j)]
    design = np.stack(columns, axis=2).reshape(len(t), 6, 3)
    bright = np.tile([1.0, 1.0, 0.0], (len(t), 1, 1))
    design = np.concatenate([design, _by_angle(found, prior, seen)[:, None], bright], axis=1).swapaxes(1, 2)
    covariance = np.zeros((8, 8))
    covariance[:7, :7] = found.nuisance_covariance[:7, :7]
    covariance[7, 7] = REFERENCE_BRIGHTNESS_STD**2
    own_h = np.zeros((len(t), 3, 3))
    own_h[:, :2, :2] = found.brightness_std**2
    noise = np.array([s.std for s in seen]) / softened(t)
    return SceneErrors(own_h + noise[:, None, None] ** 2 * np.diag([0.0, 1.0, 1.0]), design, covariance)


def _by_angle(found: Inversion, prior: RigPrior, seen: Sequence[PatchMeasurement]) -> Real:
    """What one standard deviation of the angle's error changes in the features, at fixed permittivity, [patch, 3]."""
    out = np.zeros((len(seen), 3))
    for i, (patch, one) in enumerate(zip(found.patches, seen, strict=True)):
        if patch.permittivity is not None:
            step = prior.theta_std_rad
            (here_h, here_t), (there_h, there_t) = (
                features(patch.permittivity, [one.theta_rad + found.theta_error_rad + more]) for more in (0.0, step)
            )
            out[i] = relative(here_h - there_h, here_t - there_t, here_t)[0]
    return out
