"""Settings of processing: what a person asked for, as plain data from the command line to the pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec

FILES = ("config", "library", "labels", "reference")
"""Settings that name a file or a folder."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of one scan's processing. Batch and Dask send them to their workers.

    Attributes
    ----------
    config
        Rig file, for data without one; None: the rig file of the data.
    depth_mm
        Shift of the imaged plane away from the rig, relative to the rig file.
    depth_range_mm
        The range gate keeps echoes from planes up to this much nearer or farther; None: 15 mm for the rig file's plane
        and pixels, 0 for others.
    columns, rows, pixel_mm
        Number and distance of the pixels; None: the rig file's.
    bands
        Number of sub-bands of the sweep to image as well; 1: none.
    sparse
        Reconstruct positions that are masked, were not recorded, or lie between steps too wide for the image.
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
    incidence_deg
        Incidence angle of given images; None: that of their file, or of the rig file.
    """

    config: str | None = None
    depth_mm: float = 0.0
    depth_range_mm: float | None = None
    columns: int | None = None
    rows: int | None = None
    pixel_mm: float | None = None
    bands: int = 1
    sparse: bool = False
    library: str | None = None
    model: str | None = None
    metal_box_mm: tuple[float, float, float, float] | None = None
    labels: str | None = None
    reference: str | None = None
    incidence: Literal["one", "pixel"] = "one"
    incidence_deg: float | None = None

    def path(self, name: str) -> Path | None:
        """Return one of `FILES` as a path; None if it is not given."""
        value = getattr(self, name)
        if value is None:
            return None
        return Path(value)

    def files(self) -> dict[str, Path]:
        """Return the files and folders that are given, by field."""
        paths = {name: self.path(name) for name in FILES}
        return {name: path for name, path in paths.items() if path is not None}

    def choices(self) -> dict[str, Any]:
        """Return the settings that are not files, as plain data by field."""
        values = msgspec.to_builtins(self)
        return {name: value for name, value in values.items() if name not in FILES}

    def absolute(self) -> Settings:
        """Return the settings with absolute paths, for a worker in another folder."""
        return msgspec.structs.replace(self, **{name: str(path.absolute()) for name, path in self.files().items()})


DEFAULT = Settings()


def path_text(path: Path | None) -> str | None:
    """Return a path as settings hold it: text, or None."""
    if path is None:
        return None
    return str(path)
