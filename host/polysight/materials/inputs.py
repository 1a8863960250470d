"""Inputs of `analyse` beside the images: optics, choice of the metal reference, known facts of the scene; tilts.

`level` corrects the images for the tilts of the plates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.imaging import Images, Rise, correct_tilt
from polysight.materials.inversion import RigPrior
from polysight.materials.segment import Box, Segmentation, SegmentSettings
from polysight.materials.truth import TruthPlate
from polysight.polarimetry import IncidenceChoice, PlaneReference
from polysight_shared.config import Instrument

LEAST_LEAKAGE_STD = 5e-4
"""Least standard deviation of the leakage, whatever the rig file says."""


@dataclass(frozen=True)
class Optics:
    """Quantities that turn images into permittivity, with their standard deviations.

    Attributes
    ----------
    theta_rad
        Incidence angle, a number or [ny, nx].
    leakage
        Cross-polar leakage (p in H, s in V): as measured, or zero.
    smooth_px
        Width (standard deviation, pixels) of the filter against speckle before permittivity and classification,
        inside each patch.
    theta_std_rad
        Standard deviation of the angle's error, equal for all pixels.
    leakage_std
        Standard deviation of each part of the leakage: as measured, or that of the mount's prior.
    leakage_measured
        True if it was measured.
    channel_ratio_known
        True if V / H of the images is referenced to the direct path, which reaches both boards with equal strength.
    """

    theta_rad: npt.ArrayLike
    leakage: tuple[complex, complex] = (0.0, 0.0)
    smooth_px: float = 2.0
    theta_std_rad: float = 1e-3
    leakage_std: float = 0.003
    leakage_measured: bool = True
    channel_ratio_known: bool = False

    @classmethod
    def of(
        cls, rig: Instrument, angles: IncidenceChoice, theta_std_rad: float = 1e-3, channel_ratio_known: bool = False
    ) -> Optics:
        """Return the optics of a rig under the chosen incidence angles.

        Leakage without a `leakage_std` in the rig file was not measured: it is not subtracted, its mean is zero.
        """
        p = rig.polarimetry
        measured = p.leakage_std is not None
        leakage = (complex(*p.leakage_h), complex(*p.leakage_v)) if measured else (0j, 0j)
        std = p.leakage_prior / np.sqrt(2) if p.leakage_std is None else p.leakage_std
        least = max(float(std), LEAST_LEAKAGE_STD)
        return cls(angles.used_rad, leakage, p.smooth_px, theta_std_rad, least, measured, channel_ratio_known)

    def prior(self, reference_std: float) -> RigPrior:
        """Return the prior of the joint inversion."""
        return RigPrior(
            self.theta_std_rad,
            self.leakage,
            self.leakage_std,
            self.leakage_measured,
            self.channel_ratio_known,
            reference_std,
        )


@dataclass(frozen=True)
class MetalChoice:
    """The metal reference: a box, a known patch, or a plate scanned separately; none of them: it is searched for.

    Attributes
    ----------
    box_mm
        x0, y0, x1, y1 in millimetres from the image centre.
    label
        Number of one of the known patches.
    plane
        A metal plate over the whole plane, scanned separately; pixels where it is invalid are ignored.
    """

    box_mm: Box | None = None
    label: int | None = None
    plane: PlaneReference | None = None


@dataclass(frozen=True)
class KnownScene:
    """Known facts of the scene.

    Attributes
    ----------
    segmentation
        Known patches (boxes drawn by hand); None: patches are searched for.
    plates
        The truth, if known: copied to the results, never used for them.
    settings
        Settings of the segmentation.
    """

    segmentation: Segmentation | None = None
    plates: Sequence[TruthPlate] = ()
    settings: SegmentSettings | None = None


FOUND = MetalChoice()
"""Search for the metal reference in the scene."""
UNKNOWN_SCENE = KnownScene()


@dataclass(frozen=True)
class Tilts:
    """Tilts of the plates: patch number to rise along x and y, radians; patches without an estimate are missing.

    `across` is the index of the axis across the plane of incidence.
    """

    rises: dict[int, Rise]
    across: int

    def across_rad(self, label: int) -> float:
        """Return the rise of a patch across the plane of incidence, radians; 0 if it is not known."""
        return self.rises[label][self.across] if label in self.rises else 0.0


def level(images: Images, found: Segmentation, tilts: Tilts | None = None) -> tuple[Images, Tilts]:
    """Correct each patch for its tilt; return the images and the tilts, as given or estimated from the phase.

    Without the illumination of the plane the images are returned unchanged.
    """
    if images.illumination is None:
        return images, Tilts({}, 1)
    if tilts is None:
        rises = {p.label: images.illumination.rise(images.h, images.v, p.interior) for p in found.patches}
        tilts = Tilts(rises, images.illumination.across)
    there = [p for p in found.patches if p.label in tilts.rises]
    masks, own = [p.mask for p in there], [tilts.rises[p.label] for p in there]
    return correct_tilt(images, masks, own), tilts
