"""What the user may choose when a scan is processed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from host.imaging import ChannelImages
from host.materials import Classifier, Library
from host.materials.authors_labels import is_metal
from host.materials.labels import patches_from_labels, read_labels
from host.materials.segment import Box, Segmentation
from host.polarimetry import Incidence, PlaneReference
from shared.config import Instrument
from shared.geometry import incidence_deg

LIBRARY = Path(__file__).parent / "materials" / "simulated-library.npz"


@dataclass(frozen=True)
class Options:
    """Where the metal is (else it is found), the classifier's library and its model, and how far to look.

    `model` None is the one chosen for the library, "none" no naming at all. `reference` is metal scanned on its own,
    instead of metal in the scene; `bands` above 1 images so many sub-bands, for thin layers; `incidence` is one angle
    for the image or each pixel's own. `labels` holds boxes drawn by hand, instead of patches that are found.
    """

    metal_box_mm: Box | None = None
    library: Path | None = None
    model: str | None = None
    reference: PlaneReference | None = None
    bands: int = 1
    incidence: Incidence = "one"
    labels: Path | None = None

    def drawn(self, images: ChannelImages) -> tuple[Segmentation | None, dict[int, str], int | None]:
        """Patches of the boxes drawn by hand, their names, and which is the metal reference; nothing without them.

        Raises
        ------
        DataError
            when the file is no label file, or a box holds no pixel.
        """
        if self.labels is None:
            return None, {}, None
        patches, names = patches_from_labels(read_labels(self.labels), images.x_m, images.y_m)
        metal = next((label for label, name in names.items() if is_metal(name)), None)
        return patches, names, metal if self.reference is None and self.metal_box_mm is None else None

    def classifier(self, rig: Instrument) -> Classifier | None:
        """For scans of a rig. Raises DataError, also when the library holds no patch at the rig's angle."""
        if self.model == "none":
            return None
        angle = incidence_deg(rig, rig.receivers[0])
        return Classifier(Library.load(self.library or LIBRARY), model=self.model, angles_deg=[angle])
