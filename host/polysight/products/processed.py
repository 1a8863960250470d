"""A processed scan with the patch of each pixel: read from a folder of products, or just computed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import skimage

from polysight.imaging import Images
from polysight.materials import PATCHES, axis_mm, box_mask
from polysight.products.files import SavedProducts

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


class ProcessedScan(SavedProducts):
    """A processed scan with the patch of each pixel: saved products, or results that were just computed."""

    @classmethod
    def computed(
        cls, folder: Path, labels: Labels, interior: Mask | None, **content: Images | dict[str, Any]
    ) -> ProcessedScan:
        """Return results that are not saved; `content` replaces `image`, `scan`, `quality` and `materials`."""
        made = cls(folder)
        vars(made).update(content, labels=labels, interior=interior)
        return made

    @cached_property
    def labels(self) -> Labels:
        """Patch number of each pixel, 0 for none, int32 [ny, nx]; saved outlines are accurate to half a pixel."""
        x, y = axis_mm(self.x_m), axis_mm(self.y_m)
        labels = np.zeros((y.size, x.size), np.int32)
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        for s in self.segments:
            outline = np.asarray(s.get("outline_mm") or [], np.float64)
            if len(outline):
                inside = skimage.measure.points_in_poly(points, outline).reshape(labels.shape)
            else:
                inside = box_mask(tuple(s["box_mm"]), self.x_m, self.y_m)
            labels[inside] = s["label"]
        for patch in self.patches.patches if self._has_pixels else ():
            labels[self._pixels(patch.places_mm)] = patch.label
        return labels

    @cached_property
    def interior(self) -> Mask | None:
        """Pixels used for the patches' statistics, bool [ny, nx]; None if unknown."""
        if not self._has_pixels:
            return None
        interior = np.zeros(self.valid.shape, bool)
        for patch in self.patches.patches:
            interior[self._pixels(patch.places_mm)] = True
        return interior

    @property
    def _has_pixels(self) -> bool:
        return (self.folder / PATCHES).exists()

    def _pixels(self, places_mm: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Rows and columns of the pixels at places x, y [n, 2]."""
        columns, rows = (_nearest(axis_mm(a), places_mm[:, i]) for i, a in enumerate((self.x_m, self.y_m)))
        return rows, columns

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


def _nearest(axis: npt.NDArray[np.float64], places: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Return the indices of the nearest values of an evenly spaced axis."""
    return np.rint((places - axis[0]) / (axis[1] - axis[0])).astype(np.intp)
