"""Choose the metal reference, and judge whether it is metal by everything but itself.

For the evidence, two explanations of the whole scene are fitted to the same data: the patch is metal (r_s = r_p = -1),
or it is some dielectric. Each explanation determines the other patches relative to it, and these must then be possible
materials: brightness |H| that agrees with their ratio (Eq. 2 and 3), no gain, a permittivity from 1 to about ten. Each
also predicts V / H of the patch itself relative to the direct path, which reaches both boards with equal strength:
metal reflects both polarisations fully, a dielectric loses most of p at these angles.

The score is the difference of both best sums of squares, dielectric minus metal: positive values support metal. It is
half of minus twice the log likelihood ratio up to the priors of leakage, angle and brightness, which both share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.inversion import BRIGHTNESS_STD, OUTLIER, PatchMeasurement, RigPrior, forward_differences
from polysight.materials.segment import Box, Mask, Segmentation, box_mask
from polysight.polarimetry import fresnel, permittivity_from_ratio, ratio_from_permittivity
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError


@dataclass(frozen=True)
class MetalReference:
    """The metal region and its origin.

    Attributes
    ----------
    mask
        bool [ny, nx], interior of the region.
    label
        Patch number; None for a given box outside all patches.
    how
        One sentence for the report.
    given
        True if the user or a calibration declares it metal.
    evidence
        Evidence of the rest of the scene; None if it was not computed.
    """

    mask: Mask
    label: int | None
    how: str
    given: bool = False
    evidence: MetalEvidence | None = None

    @property
    def certain(self) -> bool:
        """True if the rest of the scene shows that it is metal, or it is given and nothing contradicts it."""
        if self.evidence is None:
            return self.given
        return self.evidence.enough or (self.given and not self.evidence.against)


def metal_in_box(
    box_mm: Box, segmentation: Segmentation, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None
) -> MetalReference:
    """Take the metal reference from a box (x0, y0, x1, y1), millimetres from the image centre.

    If the box overlaps a found patch, only that patch's interior inside the box is used, so that the box may be too
    large. Raises DataError if the box has no valid pixel.
    """
    mask = box_mask(box_mm, x_m, y_m)
    if valid is not None:
        mask &= valid
    overlaps = [(int((p.interior & mask).sum()), p) for p in segmentation.patches]
    count, patch = max(overlaps, key=lambda o: o[0], default=(0, None))
    label = None
    if patch is not None and count >= 9:
        mask, label = mask & patch.interior, patch.label
    if not mask.any():
        raise DataError(
            f"the metal box {tuple(round(b, 1) for b in box_mm)} mm holds no valid pixel",
            "it lies outside the image; boxes are in millimetres from the image centre",
            "give --metal x,y,w,h inside the image",
            code=ErrorCode.NO_DATA,
        )
    where = "" if label is None else f", inside patch {label}"
    return MetalReference(
        mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{where}", given=True
    )


def metal_by_label(label: int, segmentation: Segmentation) -> MetalReference:
    """Take this patch as the metal reference. Raises DataError if there is no such patch."""
    for p in segmentation.patches:
        if p.label == label:
            return MetalReference(p.interior, label, f"given as patch {label}", given=True)
    raise DataError(
        f"there is no patch {label} to take as metal",
        f"{len(segmentation.patches)} patches were found",
        code=ErrorCode.NO_DATA,
    )


def no_metal(usable: Mask) -> MetalReference:
    """Return the reference of a scene without patches: images are scaled by their own mean brightness."""
    return MetalReference(usable, None, "none: no patch was found")


def find_metal(
    h: npt.NDArray[np.complexfloating], v: npt.NDArray[np.complexfloating], segmentation: Segmentation
) -> MetalReference | None:
    """Return the patch that is brightest in both channels; None without patches.

    The measure is median |H||V| over the interior. Metal reflects both polarisations fully (|r_s| = |r_p| = 1), every
    dielectric loses most of p at these angles; the product does not depend on the unknown gains of H and V. The
    brightest patch of a scene without metal is a dielectric: whether it is metal is another question
    (:func:`metal_evidence`).

    Parameters
    ----------
    h, v
        complex [ny, nx], flattened by the footprint.
    segmentation
        Patches.
    """
    scores = sorted(
        (
            (float(np.median(np.abs(h[p.interior]) * np.abs(v[p.interior]))), p)
            for p in segmentation.patches
            if p.interior.any()
        ),
        key=lambda s: -s[0],
    )
    if not scores:
        return None
    best, patch = scores[0]
    margin = best / scores[1][0] if len(scores) > 1 and scores[1][0] > 0 else float("inf")
    beside = "the only patch found" if len(scores) == 1 else f"|H||V| {margin:.1f} times the next"
    how = f"chosen as the patch that is brightest in both channels ({beside})"
    return MetalReference(patch.interior, patch.label, how)


Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]

CHANNEL_RATIO_STD_DB = 2.5
"""Standard deviation of metal's V / H relative to the direct path's: the boards' patterns differ off their axis."""
SURE_SCORE = 3.5
WEAK_V_DB = -3.0
"""V / H relative to the direct path below which a patch is hardly metal: metal has 0 dB, bare water -4 dB."""
_UNLIKE = 0.2
_LARGEST = 10.0  # |eps| of common materials; larger values are penalised
_NEAR_METAL = 0.12  # |t - 1| of further pieces of metal, which need not be possible dielectrics
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
        return np.inf if self.others == 0 else 1.5 if self.others == 1 else 0.5 if self.others < 6 else -2.0

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

    Parameters
    ----------
    seen
        The other patches, relative to the judged one.
    prior
        Prior of the rig.
    channel_ratio
        V / H of the patch itself in images referenced to the direct path; None for other images.
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
        metal, slack = np.abs(t - 1) < _NEAR_METAL, 1 + 10 * self.loose
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
