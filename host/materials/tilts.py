"""How the plates of a scene lie beside the image's plane, and their images as level plates would show them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from polysight.host.imaging import Rise, correct_tilt
from polysight.host.materials.inputs import ImagePair
from polysight.host.materials.segment import Segmentation


@dataclass(frozen=True)
class Tilts:
    """Patch number to its rise along x and y, radians; and which of both lies across the plane of incidence.

    A patch of which nothing can be told is not there.
    """

    rises: dict[int, Rise]
    across: int

    def across_rad(self, label: int) -> float:
        """Rise of a patch across the plane of incidence, radians; 0 where it is not told."""
        return self.rises[label][self.across] if label in self.rises else 0.0


def level(images: ImagePair, found: Segmentation, tilts: Tilts | None = None) -> tuple[ImagePair, Tilts]:
    """The pair with every patch as a level plate would show it, and the tilts: as given, or as the phase tells them.

    Where nothing is known of how the plane is lit the pair stays as it is.
    """
    if images.lit is None:
        return images, Tilts({}, 1)
    if tilts is None:
        rises = {p.label: images.lit.rise(images.h, images.v, p.interior) for p in found.patches}
        tilts = Tilts(rises, images.lit.across)
    there = [p for p in found.patches if p.label in tilts.rises]
    masks, own = [p.mask for p in there], [tilts.rises[p.label] for p in there]
    h, v = correct_tilt(images.h, images.v, images.lit, masks, own)
    return replace(images, h=h, v=v), tilts
