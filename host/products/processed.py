"""A processed scan in memory, read from a folder of products or just computed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import skimage

from polysight.host.materials import PATCHES, axis_mm, box_mask
from polysight.host.products.files import SavedProducts, withhold
from polysight.host.verdict import Verdict, read_verdict
from polysight.shared.config import Instrument
from polysight.shared.tables import decode

Labels = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Rows:
    """Rows of a scan, counted from 0.

    Attributes
    ----------
    planned
        Number of rows in the plan.
    committed
        Indices of the rows with data, ascending.
    """

    planned: int
    committed: tuple[int, ...]

    @property
    def indices(self) -> range:
        """Indices of all planned rows."""
        return range(self.planned)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the planned rows without data."""
        return tuple(sorted(set(self.indices) - set(self.committed)))


@dataclass(frozen=True)
class ProcessedScan:
    """Content of the product files of a scan, in memory.

    Attributes
    ----------
    image
        Arrays of image.npz: `h`, `v`, `p` complex64 [ny, nx], `valid` bool [ny, nx], `x_m`, `y_m` float64, and if
        known `p_sigma` float32 [ny, nx].
    scan, quality, materials
        Content of scan.json, quality.json and materials.json. Without materials the image is not metal-referenced.
    labels
        int32 [ny, nx]: patch number of each pixel, 0 for none.
    interior
        bool [ny, nx]: pixels used for the patches' statistics; None if unknown.
    """

    image: dict[str, npt.NDArray[Any]]
    scan: dict[str, Any]
    quality: dict[str, Any]
    materials: dict[str, Any]
    labels: Labels
    interior: Mask | None

    @property
    def segments(self) -> list[dict[str, Any]]:
        """Patches in materials.json, see :func:`withhold`."""
        return list(withhold(self.materials).get("segments", []))

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the results; None in products of earlier releases."""
        return read_verdict(self.materials) or read_verdict(self.quality)

    @property
    def metal_referenced(self) -> bool:
        """True if h, v and p are relative to metal."""
        return bool(self.materials)

    @property
    def scan_id(self) -> str:
        """Name of the scan; "" if unknown."""
        return str(self.scan.get("scan_id", self.materials.get("scan_id", "")))

    @property
    def simulated(self) -> bool | None:
        """True if the data was simulated; None if unknown."""
        return self.scan.get("simulated", self.materials.get("simulated"))

    @cached_property
    def rig(self) -> Instrument | None:
        """Rig of the images; None if unknown. Raises ConfigError."""
        raw = self.scan.get("instrument")
        return None if raw is None else decode(raw, Instrument, f"scan.json of {self.scan_id}: instrument")

    @property
    def rows(self) -> Rows | None:
        """Planned rows and rows in the images; None if unknown."""
        boards = self.quality.get("boards", {}).values()
        if self.rig is None or not boards or any("rows_recorded" not in b for b in boards):
            return None
        committed = set.intersection(*(set(b["rows_recorded"]) for b in boards))
        by_columns = self.quality.get("recording", {}).get("direction") == "col"
        planned = self.rig.grid.columns if by_columns else self.rig.grid.rows
        return Rows(planned, tuple(sorted(committed)))


def read_processed(products: SavedProducts) -> ProcessedScan:
    """Read a folder of products. Raises DataError if a file is damaged."""
    image = products.image
    labels, interior = _saved_patches(products)
    return ProcessedScan(image, products.scan, products.quality, products.materials, labels, interior)


def _saved_patches(products: SavedProducts) -> tuple[Labels, Mask | None]:
    """Return labels from the patches' outlines (accurate to half a pixel) and interiors from patches.npz."""
    x, y = axis_mm(products.x_m), axis_mm(products.y_m)
    labels = np.zeros((y.size, x.size), np.int32)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    for s in products.segments:
        outline = np.asarray(s.get("outline_mm") or [], np.float64)
        if len(outline):
            inside = skimage.measure.points_in_poly(points, outline).reshape(labels.shape)
        else:
            inside = box_mask(tuple(s["box_mm"]), products.x_m, products.y_m)
        labels[inside] = s["label"]
    if not (products.folder / PATCHES).exists():
        return labels, None
    interior = np.zeros(labels.shape, bool)
    for patch in products.patches.patches:
        columns, rows = (_nearest(axis, patch.places_mm[:, i]) for i, axis in enumerate((x, y)))
        labels[rows, columns] = patch.label
        interior[rows, columns] = True
    return labels, interior


def _nearest(axis: npt.NDArray[np.float64], places: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Return the indices of the nearest values of an evenly spaced axis."""
    return np.rint((places - axis[0]) / (axis[1] - axis[0])).astype(np.intp)
