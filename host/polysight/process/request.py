"""Settings of processing: the request as plain data, and the options with their files loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import msgspec
import numpy.typing as npt

from polysight.materials import (
    SAME_ANGLE_DEG,
    SIMULATED_LIBRARY,
    Box,
    Classifier,
    Labels,
    Library,
    Segmentation,
    check_labels,
)
from polysight.polarimetry import Incidence, PlaneReference
from polysight_shared.config import Instrument
from polysight_shared.geometry import incidence_deg


class ProcessRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request to process one scan, as plain data: parsed from the command line, sent to workers by batch and Dask.

    Attributes
    ----------
    data, out
        Recorded scan, and the folder for its products.
    config
        Rig file, for data without one; None: the rig file of the data.
    library, model
        Reference library (None: the simulated one) and classifier (None: the library's default, "none": no naming).
    metal_box_mm
        Box of the metal reference: x0, y0, x1, y1 in millimetres from the image centre; None: find it.
    labels
        File of boxes drawn by hand, used instead of detected patches.
    reference
        Scan of a metal plate, used as reference at each pixel instead of metal in the scene.
    incidence
        One incidence angle for the image, or one per pixel.
    bands
        Number of sub-bands of the sweep to image as well; 1: none.
    """

    data: str
    out: str
    config: str | None = None
    library: str | None = None
    model: str | None = None
    metal_box_mm: tuple[float, float, float, float] | None = None
    labels: str | None = None
    reference: str | None = None
    incidence: Literal["one", "pixel"] = "one"
    bands: int = 1

    def paths(self) -> dict[str, Path]:
        """Return the files and folders that affect the products, by field, without those that are None."""
        given = {name: getattr(self, name) for name in ("config", "library", "labels", "reference")}
        return {name: Path(value) for name, value in given.items() if value is not None}

    def choices(self) -> dict[str, Any]:
        """Return the other settings that affect the products, by field."""
        return {name: getattr(self, name) for name in ("model", "metal_box_mm", "incidence", "bands")}

    def absolute(self) -> ProcessRequest:
        """Return the request with absolute paths, for a worker in another folder."""
        paths = {name: str(path.absolute()) for name, path in self.paths().items()}
        return msgspec.structs.replace(
            self, data=str(Path(self.data).absolute()), out=str(Path(self.out).absolute()), **paths
        )


class DrawnBoxes(NamedTuple):
    """Boxes drawn by hand as patches, their names by patch number, and the number of the metal reference."""

    segmentation: Segmentation | None = None
    names: Mapping[int, str] = MappingProxyType({})
    metal: int | None = None


@dataclass(frozen=True)
class Options:
    """Settings of a :class:`ProcessRequest` with their files loaded; the fields have the same meaning.

    `reference` is the processed scan of a metal plate, `labels` the content of the label file.
    """

    metal_box_mm: Box | None = None
    library: Path | None = None
    model: str | None = None
    reference: PlaneReference | None = None
    bands: int = 1
    incidence: Incidence = "one"
    labels: Labels | None = None

    def drawn(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> DrawnBoxes:
        """Return the boxes drawn by hand as patches of an image with axes `x_m`, `y_m`; empty without labels.

        Raises DataError if a box holds no pixel, or too few to be used.
        """
        if self.labels is None:
            return DrawnBoxes()
        labels = check_labels(self.labels, x_m, y_m) if self.labels.by_hand else self.labels
        patches, names = labels.patches(x_m, y_m)
        metal = next((label for label, name in names.items() if labels.is_metal(name)), None)
        return DrawnBoxes(patches, names, metal if self.reference is None and self.metal_box_mm is None else None)

    def unnamed(self, rig: Instrument) -> str:
        """Return the reason why nothing will be named in scans of a rig, as a sentence; "" if names are given.

        Raises DataError if the library cannot be loaded.
        """
        if self.model == "none":
            return "Nothing was named: naming was left out (--model none)."
        path, angle = self.library or SIMULATED_LIBRARY, incidence_deg(rig, rig.receivers[0])
        known = Library.load(path).angles_deg
        if not known or any(abs(a - angle) <= SAME_ANGLE_DEG for a in known):  # Classifier refuses an empty library
            return ""
        return (
            f"Nothing was named: the scan looks at {angle:.1f} degrees of incidence, and {path.name} holds"
            f" {' and '.join(f'{a:g}' for a in known)} degrees only (|P| changes by a tenth in a degree)."
            " Train a library at this angle, and process the scan again with --library."
        )

    def classifier(self, rig: Instrument) -> Classifier | None:
        """Return the classifier for scans of a rig; None without naming, see :meth:`unnamed`. Raises DataError."""
        if self.unnamed(rig):
            return None
        angle = incidence_deg(rig, rig.receivers[0])
        return Classifier(Library.load(self.library or SIMULATED_LIBRARY), model=self.model, angles_deg=[angle])
