"""What the user may choose when a scan is processed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from host.materials import Classifier, Library
from host.materials.segment import Box
from host.polarimetry import Incidence, PlaneReference
from shared.config import Instrument
from shared.geometry import incidence_deg

LIBRARY = Path(__file__).parent / "materials" / "simulated-library.npz"


@dataclass(frozen=True)
class Options:
    """Where the metal is (else it is found), the classifier's library and its model, and how far to look.

    `model` None is the one chosen for the library, "none" no naming at all. `reference` is metal scanned on its own,
    instead of metal in the scene; `bands` above 1 images so many sub-bands, for thin layers; `incidence` is one angle
    for the image or each pixel's own.
    """

    metal_box_mm: Box | None = None
    library: Path | None = None
    model: str | None = None
    reference: PlaneReference | None = None
    bands: int = 1
    incidence: Incidence = "one"

    def classifier(self, rig: Instrument) -> Classifier | None:
        """For scans of a rig. Raises DataError, also when the library holds no patch at the rig's angle."""
        if self.model == "none":
            return None
        angle = incidence_deg(rig, rig.receivers[0])
        return Classifier(Library.load(self.library or LIBRARY), model=self.model, angles_deg=[angle])
