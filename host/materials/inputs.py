"""What `analyse` is given: the image pair, the optics, which metal is the reference, and what is known of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from polysight.host.imaging import ChannelImages, Illumination
from polysight.host.materials.inversion import RigPrior
from polysight.host.materials.segment import Box, Segmentation, SegmentSettings
from polysight.host.materials.truth import TruthPlate
from polysight.host.polarimetry import IncidenceChoice, PlaneReference
from polysight.shared.config import Instrument

Image = npt.NDArray[np.complexfloating]
LEAST_LEAKAGE_STD = 5e-4
"""No leakage is known better than this, whatever the rig file says."""


@dataclass(frozen=True)
class ImagePair:
    """The two channel images that are analysed.

    Attributes
    ----------
    h, v
        complex [ny, nx], flattened by the footprint of a mirror, not yet metal-referenced.
    x_m, y_m
        Pixel centres, metres, [nx] and [ny].
    valid
        bool [ny, nx]; None: all of it.
    lit
        How both channels light the plane; None: nothing is known of tilts.
    """

    h: Image
    v: Image
    x_m: npt.ArrayLike
    y_m: npt.ArrayLike
    valid: npt.NDArray[np.bool_] | None = None
    lit: Illumination | None = None

    @classmethod
    def of(cls, images: ChannelImages) -> ImagePair:
        """The pair of channel images as imaging makes them."""
        return cls(images.h, images.v, images.x_m, images.y_m, images.valid, images.lit)

    @property
    def usable(self) -> npt.NDArray[np.bool_]:
        """Pixels that are valid and finite, bool [ny, nx]."""
        finite = np.isfinite(self.h) & np.isfinite(self.v)
        return finite if self.valid is None else finite & self.valid

    def within(self, area: npt.NDArray[np.bool_]) -> ImagePair:
        """The same, valid only inside `area`, bool [ny, nx]."""
        return replace(self, valid=area if self.valid is None else self.valid & area)


@dataclass(frozen=True)
class Optics:
    """What turns images into permittivity, and how well it is known.

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
        Standard deviation of the angle's error, the same everywhere.
    leakage_std
        Standard deviation of each part of the leakage: as measured, or of the mount's prior.
    leakage_measured
        Which of both.
    channel_ratio_known
        Whether V beside H of the images is referenced to the direct path, which reaches both boards alike.
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
        """A rig's leakage and filter, under the angles that were chosen.

        Leakage that the rig file does not call measured (`leakage_std`) is not subtracted: its mean is zero then.
        """
        p = rig.polarimetry
        measured = p.leakage_std is not None
        leakage = (complex(*p.leakage_h), complex(*p.leakage_v)) if measured else (0j, 0j)
        std = p.leakage_prior / np.sqrt(2) if p.leakage_std is None else p.leakage_std
        least = max(float(std), LEAST_LEAKAGE_STD)
        return cls(angles.used_rad, leakage, p.smooth_px, theta_std_rad, least, measured, channel_ratio_known)

    def prior(self, reference_std: float) -> RigPrior:
        """What is known beforehand of the rig, for the joint inversion."""
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
    """Which metal is the reference: a box, a known patch, a plate scanned on its own; none of them: the metal is found.

    Attributes
    ----------
    box_mm
        x0, y0, x1, y1 in millimetres from the image centre.
    label
        Number of one of the known patches.
    plane
        A metal plate over the whole plane, instead of metal in this scene; where it is not valid nothing is looked at.
    """

    box_mm: Box | None = None
    label: int | None = None
    plane: PlaneReference | None = None


@dataclass(frozen=True)
class KnownScene:
    """What is known of the scene.

    Attributes
    ----------
    segmentation
        Patches that are known (boxes drawn by hand); None: they are found.
    plates
        The truth, where known: only carried along to the results, never used for them.
    settings
        How to find patches.
    """

    segmentation: Segmentation | None = None
    plates: Sequence[TruthPlate] = ()
    settings: SegmentSettings | None = None


FOUND = MetalChoice()
"""The metal reference is found in the scene."""
UNKNOWN_SCENE = KnownScene()
