"""What the user may choose when a scan is processed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy.typing as npt

from polysight.host.materials import Classifier, Library
from polysight.host.materials.library import SAME_ANGLE_DEG
from polysight.host.materials.patch_files import patches_from_labels
from polysight.host.materials.published import is_metal
from polysight.host.materials.segment import Box, Segmentation
from polysight.host.polarimetry import Incidence, PlaneReference
from polysight.shared.config import Instrument
from polysight.shared.geometry import incidence_deg

LIBRARY = Path(__file__).parents[1] / "materials" / "simulated-library.npz"


@dataclass(frozen=True)
class Options:
    """Where the metal is (else it is found), the classifier's library and its model, and how far to look.

    `model` None is the one chosen for the library, "none" no naming at all. `reference` is metal scanned on its own,
    instead of metal in the scene; `bands` above 1 images so many sub-bands, for thin layers; `incidence` is one angle
    for the image or each pixel's own. `labels` are boxes drawn by hand, in pixels, instead of patches that are found.
    """

    metal_box_mm: Box | None = None
    library: Path | None = None
    model: str | None = None
    reference: PlaneReference | None = None
    bands: int = 1
    incidence: Incidence = "one"
    labels: Mapping[str, Box] | None = None

    def drawn(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[Segmentation | None, dict[int, str], int | None]:
        """Patches of the boxes drawn by hand, their names, and which is the metal reference; nothing without them.

        `x_m`, `y_m` are the image's axes. Raises DataError when a box holds no pixel.
        """
        if self.labels is None:
            return None, {}, None
        patches, names = patches_from_labels(dict(self.labels), x_m, y_m)
        metal = next((label for label, name in names.items() if is_metal(name)), None)
        return patches, names, metal if self.reference is None and self.metal_box_mm is None else None

    def unnamed(self, rig: Instrument) -> str:
        """Why nothing of a rig's scans will be named, in a sentence; "" when it will. Raises DataError."""
        if self.model == "none":
            return "Nothing was named: naming was left out (--model none)."
        path, angle = self.library or LIBRARY, incidence_deg(rig, rig.receivers[0])
        known = Library.load(path).angles_deg
        if not known or any(abs(a - angle) <= SAME_ANGLE_DEG for a in known):  # an empty one is an error of its own
            return ""
        return (
            f"Nothing was named: the scan looks at {angle:.1f} degrees of incidence, and {path.name} holds"
            f" {' and '.join(f'{a:g}' for a in known)} degrees only (|P| changes by a tenth in a degree)."
            " Train a library at this angle, and process the scan again with --library."
        )

    def classifier(self, rig: Instrument) -> Classifier | None:
        """For scans of a rig; None where nothing is to be named, see :meth:`unnamed`. Raises DataError."""
        if self.unnamed(rig):
            return None
        angle = incidence_deg(rig, rig.receivers[0])
        return Classifier(Library.load(self.library or LIBRARY), model=self.model, angles_deg=[angle])
