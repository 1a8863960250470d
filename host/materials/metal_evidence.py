"""Whether a patch is metal, judged by everything but itself.

Two explanations of the whole scene are fitted to the same data: the patch is metal (r_s = r_p = -1), or it is some
dielectric. Each says what the other patches are relative to it, and the other patches must then be possible materials:
brightness |H| that agrees with their ratio (Eq. 2 and 3), no gain, a permittivity from 1 to about ten. And each says
how strong V is beside H in the patch itself, relative to the direct path, which reaches both boards alike: metal
returns both polarisations fully, a dielectric loses most of p at these angles.

The evidence is the difference of both best sums of squares, dielectric minus metal: positive speaks for metal. It is
half of minus twice the log likelihood ratio up to the priors of leakage, angle and brightness, which both share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from polysight.host.materials.inversion import BRIGHTNESS_STD, OUTLIER, PatchMeasurement, RigPrior, forward_differences
from polysight.host.polarimetry import fresnel, permittivity_from_ratio, ratio_from_permittivity

Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]

CHANNEL_RATIO_STD_DB = 2.5
"""How far V over H of metal may lie from that of the direct path: the boards' patterns differ off their axis."""
SURE_SCORE = 3.5
WEAK_V_DB = -3.0
"""V over H beside the direct path below which a patch is hardly metal: 0 is metal, -4 dB is bare water."""
_UNLIKE = 0.2
_LARGEST = 10.0  # |eps| of common materials; beyond it costs
_NEAR_METAL = 0.12  # |t - 1|: another piece of metal need not be a possible dielectric
_STARTS = [
    complex(real, -real * loss) for real in (2.0, 2.6, 3.2, 4.0, 5.0, 7.0, 10.0) for loss in (0.01, 0.15, 0.4, 1.2)
]
_REFINED = 3
_DEAR = 1e3


@dataclass(frozen=True)
class MetalEvidence:
    """For and against one patch.

    Attributes
    ----------
    score
        Sum of squares of the best dielectric less that of metal; positive speaks for metal.
    others
        How many other patches tell: those that are unlike the judged one. One that looks the same is metal beside
        metal, or water beside water.
    channel_ratio_db
        V over H of the patch relative to the direct path; None where that was not known.
    """

    score: float
    others: int
    channel_ratio_db: float | None

    @property
    def needed(self) -> float:
        """Score from which the patch counts as metal: the fewer patches tell, the more.

        Limits are from random scenes with and without metal, of common and of very lossy materials
        (tests/materials/test_metal_evidence.py draws such).
        """
        return np.inf if self.others == 0 else 1.5 if self.others == 1 else 0.5 if self.others < 6 else -2.0

    @property
    def sure(self) -> bool:
        """Whether it is metal beyond doubt: very lossy dielectrics (wet, conducting) come close to metal."""
        return self.enough and self.score >= SURE_SCORE

    @property
    def against(self) -> bool:
        """Whether what is seen speaks against metal, whoever says that it is."""
        weak = self.channel_ratio_db is not None and self.channel_ratio_db < WEAK_V_DB
        return weak or (self.others > 0 and self.score < -1.0)

    @property
    def enough(self) -> bool:
        """Whether the patch is shown to be metal."""
        return self.score >= self.needed


def metal_evidence(seen: list[PatchMeasurement], prior: RigPrior, channel_ratio: complex | None) -> MetalEvidence:
    """Compare both explanations.

    Parameters
    ----------
    seen
        The other patches, relative to the one that is judged.
    prior
        What is known of the rig.
    channel_ratio
        V / H of the patch itself in images that are referenced to the direct path; None where they are not.
    """
    level = None if channel_ratio is None or not abs(channel_ratio) > 0 else 20 * float(np.log10(abs(channel_ratio)))
    if not seen:
        return MetalEvidence(0.0, 0, level)
    metal = _Explanation(seen, prior, level)
    as_metal = _best(metal, np.zeros(8))
    starts = np.array([[0.0] * 8 + [np.log(e.real), np.log(-e.imag)] for e in _STARTS])
    starts = starts[np.argsort(np.sum(metal.residuals(starts) ** 2, axis=-1), kind="stable")]
    as_dielectric = min(_best(metal, x) for x in starts[:_REFINED])
    unlike = sum(abs(s.inverse_ratio - 1) > _UNLIKE for s in seen)
    return MetalEvidence(as_dielectric - as_metal, unlike, level)


def _best(model: _Explanation, start: Real) -> float:
    """The least sum of squares from one start."""
    limit = 40 * start.size
    found = scipy.optimize.least_squares(model.residuals, start, jac=model.jacobian, method="lm", max_nfev=limit)
    return 2 * float(found.cost)


class _Explanation:
    """Residuals of the other patches when the judged one is metal (8 parameters), or has a permittivity (2 more)."""

    def __init__(self, seen: list[PatchMeasurement], prior: RigPrior, level_db: float | None) -> None:
        self.prior, self.level_db = prior, level_db
        self.q = np.array([s.inverse_ratio for s in seen], np.complex128)
        levels = np.array([np.nan if s.brightness is None else s.brightness for s in seen], np.float64)
        self.bright = np.isfinite(levels) & (levels > 0)
        self.log_level = np.log(np.where(self.bright, levels, 1.0))
        self.loose = np.array([s.std for s in seen])
        self.theta = np.array([s.theta_rad for s in seen], np.float64)

    def residuals(self, x: Real) -> Real:
        """Priors, brightness, and how possible each other patch is; [..., parameter] to [..., residual]."""
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
        metal, slack = np.abs(t - 1) < _NEAR_METAL, 1 + 10 * self.loose
        patches = [brightness, *(np.where(metal, 0.0, part) / slack for part in impossible)]
        channel = [] if self.level_db is None else [(self._level(own, a, b) - self.level_db) / CHANNEL_RATIO_STD_DB]
        return np.concatenate([x[..., :8], _robust(np.concatenate(patches, -1)), *channel, *bounds], -1)

    def jacobian(self, x: Real) -> Real:
        """[residual, parameter]."""
        return forward_differences(self.residuals, x)

    @staticmethod
    def _level(own: Complex, a: Complex, b: Complex) -> Real:
        """V over H beside the direct path's, dB: the direct path holds 1 + a and 1 + b."""
        return 20 * np.log10(np.maximum(np.abs((own + b) / (1 + a * own) * (1 + a) / (1 + b)), 1e-6))


def _robust(r: Real) -> Real:
    """Cauchy's loss, so that one odd patch does not decide; what is no number is far out."""
    r = np.clip(np.nan_to_num(r, nan=_DEAR, posinf=_DEAR, neginf=-_DEAR), -_DEAR, _DEAR)
    return np.sign(r) * OUTLIER * np.sqrt(np.log1p((r / OUTLIER) ** 2))
