"""What a scan is to be processed with: the request as plain data, and the options with their files read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import msgspec
import numpy.typing as npt

from polysight.host.materials import (
    SAME_ANGLE_DEG,
    SIMULATED_LIBRARY,
    Box,
    Classifier,
    Labels,
    Library,
    Segmentation,
    check_labels,
)
from polysight.host.polarimetry import Incidence, PlaneReference
from polysight.shared.config import Instrument
from polysight.shared.geometry import incidence_deg


class ProcessRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One scan to process, as plain data: what the command line parses, and what batch and Dask send to their workers.

    Attributes
    ----------
    data, out
        The recorded scan, and the folder for its products.
    config
        Rig file, for data that brings none; None: the data's own.
    library, model
        Reference library (None: the simulated one) and classifier (None: the library's own, "none": name nothing).
    metal_box_mm
        Where the metal reference is: x0, y0, x1, y1 in millimetres from the image centre; None: found.
    labels
        File of boxes drawn by hand, which take the place of patches that are found.
    reference, reference_by
        Scan of a metal plate, the reference instead of metal in the scene: by position, or one number a channel.
    incidence
        One angle for the image, or each pixel's own.
    bands
        Above 1: image so many sub-bands of the sweep too.
    """

    data: str
    out: str
    config: str | None = None
    library: str | None = None
    model: str | None = None
    metal_box_mm: tuple[float, float, float, float] | None = None
    labels: str | None = None
    reference: str | None = None
    reference_by: Literal["position", "mean"] = "position"
    incidence: Literal["one", "pixel"] = "one"
    bands: int = 1

    def paths(self) -> dict[str, Path]:
        """The files and folders that shape the products, by field; those that are not given are left out."""
        given = {name: getattr(self, name) for name in ("config", "library", "labels", "reference")}
        return {name: Path(value) for name, value in given.items() if value is not None}

    def choices(self) -> dict[str, Any]:
        """The other choices that shape the products, by field."""
        return {name: getattr(self, name) for name in ("model", "metal_box_mm", "reference_by", "incidence", "bands")}

    def absolute(self) -> ProcessRequest:
        """The same with absolute paths, for a worker in another folder."""
        paths = {name: str(path.absolute()) for name, path in self.paths().items()}
        return msgspec.structs.replace(
            self, data=str(Path(self.data).absolute()), out=str(Path(self.out).absolute()), **paths
        )


class DrawnBoxes(NamedTuple):
    """Boxes drawn by hand as patches, their names by patch number, and which of them is the metal reference."""

    segmentation: Segmentation | None = None
    names: Mapping[int, str] = MappingProxyType({})
    metal: int | None = None


@dataclass(frozen=True)
class Options:
    """Where the metal is (else it is found), the classifier's library and its model, and how far to look.

    `model` None is the one chosen for the library, "none" no naming at all. `reference` is metal scanned on its own,
    instead of metal in the scene; `bands` above 1 images so many sub-bands, for thin layers; `incidence` is one angle
    for the image or each pixel's own. `labels` are boxes drawn by hand, instead of patches that are found.
    """

    metal_box_mm: Box | None = None
    library: Path | None = None
    model: str | None = None
    reference: PlaneReference | None = None
    bands: int = 1
    incidence: Incidence = "one"
    labels: Labels | None = None

    def drawn(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> DrawnBoxes:
        """The boxes drawn by hand on an image; empty without them.

        `x_m`, `y_m` are the image's axes. Raises DataError when a box holds no pixel, or nothing could be learnt of
        boxes that a person drew.
        """
        if self.labels is None:
            return DrawnBoxes()
        labels = check_labels(self.labels, x_m, y_m) if self.labels.by_hand else self.labels
        patches, names = labels.patches(x_m, y_m)
        metal = next((label for label, name in names.items() if labels.is_metal(name)), None)
        return DrawnBoxes(patches, names, metal if self.reference is None and self.metal_box_mm is None else None)

    def unnamed(self, rig: Instrument) -> str:
        """Why nothing of a rig's scans will be named, in a sentence; "" when it will. Raises DataError."""
        if self.model == "none":
            return "Nothing was named: naming was left out (--model none)."
        path, angle = self.library or SIMULATED_LIBRARY, incidence_deg(rig, rig.receivers[0])
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
        return Classifier(Library.load(self.library or SIMULATED_LIBRARY), model=self.model, angles_deg=[angle])
