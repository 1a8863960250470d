"""Result of `analyse`: patches with permittivities and names, and their rows for materials.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.imaging import Image, Images
from polysight.materials.classify import NamedPatch, PatchName
from polysight.materials.inputs import Tilts
from polysight.materials.inversion import Inversion, RigPrior, ratio_error
from polysight.materials.measure import Refused, background, ratio_sigma
from polysight.materials.metal import MetalReference
from polysight.materials.permittivity import NOTHING, Permittivity
from polysight.materials.samples import SceneErrors
from polysight.materials.segment import Patch, Segmentation
from polysight.materials.truth import TruthPlate

LEVEL = Tilts({}, 1)
SHRINKS = {
    "noise": "a larger plate, a finer grid or more pulses a position",
    "metal reference": "a larger metal plate, or `polysight calibrate metal`",
    "leakage": "measure leakage with metal strips: `polysight leakage`",
    "incidence": "measure where the antennas are: `polysight calibrate direct-path`",
    "brightness": "measure leakage with metal strips: `polysight leakage`",
}
"""Source of error to the measurement that reduces it."""


@dataclass(frozen=True)
class PatchResult:
    """One patch with its permittivity and name.

    Attributes
    ----------
    patch, permittivity
        Its geometry and its permittivity.
    named
        Names of the patch and of its pixels; None if it was not named (no classifier, or the metal reference).
    truth
        The true plate, if known.
    refused
        Reason for giving neither name nor permittivity; None if they are given.
    """

    patch: Patch
    permittivity: Permittivity
    named: NamedPatch | None = None
    truth: TruthPlate | None = None
    refused: Refused | None = None

    @property
    def verdict(self) -> PatchName | None:
        """Name with confidence and votes; None if it was not named or is refused."""
        return None if self.named is None or self.refused is not None else self.named.verdict

    @property
    def names(self) -> npt.NDArray[np.str_] | None:
        """Names of the interior's pixels, in image order; None as for `verdict`."""
        return None if self.named is None or self.refused is not None else self.named.names


@dataclass(frozen=True)
class MaterialsResult:
    """Results of one scan's images.

    Attributes
    ----------
    calibrated
        Images with metal reference and leakage removed, not smoothed.
    h, v, p
        The same after the Gaussian filter inside each patch: the features of classification and permittivity. NaN
        outside the patches' interiors, to exclude edges and neighbours.
    metal
        The reference and how it was chosen.
    segmentation
        Patches and label image.
    patches
        Permittivity and name of each patch.
    theta_rad
        Incidence angle, a number or [ny, nx].
    inversion, prior
        The joint inversion of all patches, and its prior.
    bands
        Patch number to its ratios in sub-bands of the sweep (:mod:`polysight.materials.sub_bands`); may be empty.
    boxes
        Patch number to the name of the box drawn by hand; empty if the patches were found.
    library
        Names of the library's materials; empty if nothing was named.
    withheld
        True if the verdict is `no result`: rows have no name, no ratio and no permittivity then.
    tilts
        Tilts of the plates; `h` and `v` are already corrected for them.
    errors
        Numbers of the judged patches, and their errors for naming by the error budget; None without judged patches.
    brightness_off
        Patch number to ln of |H| over that of a half space of its permittivity; not for metal-like patches.
    """

    calibrated: Images
    h: Image
    v: Image
    p: Image
    metal: MetalReference
    segmentation: Segmentation
    patches: tuple[PatchResult, ...]
    theta_rad: npt.NDArray[np.float64]
    inversion: Inversion
    prior: RigPrior
    bands: dict[int, list[dict[str, Any]]] = field(default_factory=dict)
    boxes: dict[int, str] = field(default_factory=dict)
    library: tuple[str, ...] = ()
    withheld: bool = False
    tilts: Tilts = LEVEL
    brightness_off: Mapping[int, float] = field(default_factory=dict)
    errors: tuple[tuple[int, ...], SceneErrors] | None = None

    def rows(self) -> list[dict[str, Any]]:
        """Return one plain dict for each patch, for materials.json (no infinities, complex numbers as two parts)."""
        return [self._row(r) for r in self.patches]

    def without_result(self) -> MaterialsResult:
        """Return the same patches without names, ratios, permittivities and metal reference."""
        patches = tuple(replace(r, permittivity=NOTHING, named=None) for r in self.patches)
        metal = replace(self.metal, label=None, given=False, how=f"none ({self.metal.how})")
        return replace(self, patches=patches, metal=metal, bands={}, withheld=True)

    def p_sigma(self, usable: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
        """Return the standard deviation of each pixel's P, [ny, nx]; NaN without a result or if not `usable`."""
        h, v = self.calibrated.h, self.calibrated.v
        if self.withheld:
            return np.full(h.shape, np.nan, np.float32)
        dark = background(h, v, self.segmentation, usable)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(usable, v / h, np.nan)
        return ratio_sigma(h, v, dark, ratio_error(self.inversion, self.prior, inverse))

    def incidence_deg(self, patch: Patch) -> float:
        """Return the mean incidence angle over a patch's interior, degrees."""
        inside = self.theta_rad[patch.interior] if self.theta_rad.ndim and patch.interior.any() else self.theta_rad
        return float(np.degrees(np.mean(inside)))

    def _row(self, r: PatchResult) -> dict[str, Any]:
        row = _row(r, self.metal, self.incidence_deg(r.patch))
        if row["truth"] is not None:
            row["truth"]["in_library"] = row["truth"]["name"] in self.library
        if self.withheld:
            return row | {"amplitude_h": None}
        level = np.abs(self.h[r.patch.interior])
        level = level[np.isfinite(level)]
        row["amplitude_h"] = round(float(np.median(level)), 6) if level.size else None
        if r.patch.label in self.tilts.rises and r.refused is None:
            row["tilt_across_deg"] = round(float(np.degrees(self.tilts.across_rad(r.patch.label))), 3)
        if r.patch.label in self.bands:
            row["bands"] = self.bands[r.patch.label]
        if r.patch.label in self.boxes:
            row["box"] = self.boxes[r.patch.label]
        return row


def _complex(z: complex | None) -> dict[str, float] | None:
    if z is None or not (math.isfinite(z.real) and math.isfinite(z.imag)):
        return None
    return {"real": z.real, "imag": z.imag}


def _row(r: PatchResult, metal: MetalReference, incidence_deg: float) -> dict[str, Any]:
    e, v = r.permittivity, r.verdict
    permittivity = None
    if e.value is not None and e.real_range is not None and e.imag_range is not None and r.refused is None:
        permittivity = {
            "real": e.value.real,
            "imag": e.value.imag,
            "real_p30_p70": list(e.real_range),
            "imag_p30_p70": list(e.imag_range),
            "real_std": e.real_std,
            "imag_std": e.loss_std,
            "covariance": None if e.covariance is None else e.covariance.tolist(),
            "shares": dict(e.shares),
            "dominated_by": e.dominated_by,
            "do": SHRINKS.get(e.dominated_by or "", ""),
        }
    truth = None
    if r.truth is not None:
        truth = {
            "name": r.truth.name,
            "metal": r.truth.metal,
            "permittivity": _complex(r.truth.permittivity),
            "thickness_mm": r.truth.thickness_mm,
        }
    return {
        "label": r.patch.label,
        "name": v.name if v else None,
        "confidence": v.confidence if v else None,
        "votes": v.votes if v else {},
        "probabilities": v.probabilities if v else {},
        "why": v.why if v else "",
        "distance": v.distance if v and math.isfinite(v.distance) else None,
        "metal_reference": r.patch.label == metal.label,
        "box_mm": [round(b, 3) for b in r.patch.box_mm],
        "outline_mm": [[round(float(x), 2), round(float(y), 2)] for x, y in r.patch.outline_mm],
        "pixels": r.patch.pixels,
        "interior_pixels": e.pixels,
        "incidence_deg": incidence_deg,
        "ratio": _complex(e.ratio),
        "inverse_ratio_std": e.inverse_std if math.isfinite(e.inverse_std) else None,
        "permittivity": permittivity,
        "metal_like": e.metal_like and r.refused is None,
        "refused": None if r.refused is None else r.refused.to_dict(),
        "truth": truth,
    }
