"""Label files (`labels.json`): boxes with names, the metal reference among them, and their specimens.

`polysight label` writes the boxes of a person, in millimetres; `polysight process` writes a box inside each patch that
it found, in pixels, named by the classifier. Both forms are read, and the published data set's files too.
`Labels.patches` makes patches of the boxes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from polysight.materials.result import MaterialsResult
from polysight.materials.segment import Box, Patch, Segmentation, axis_mm, box_mask, make_patch
from polysight.materials.truth import TruthPlate
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import read_json

METALS = ("metal", "copper", "aluminium", "aluminum", "steel", "brass", "iron")
SPECIMEN = "#"
"""Separates a box's material from its specimen: `oak#2` is a second piece of oak."""


def is_metal(name: str) -> bool:
    """Return true if a material's name is that of a metal."""
    return any(word in METALS for word in re.findall(r"[a-z]+", name.lower()))


def material_of(name: str) -> str:
    """Return the material of a box named material or material#specimen."""
    return name.partition(SPECIMEN)[0]


def format_box(box: Box) -> str:
    """Format a box: `x -22.5 to 22.5, y 0.0 to 45.0 mm`."""
    x0, y0, x1, y1 = (b + 0.0 for b in box)
    return f"x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f} mm"


@dataclass(frozen=True)
class Labels:
    """Boxes with names.

    Attributes
    ----------
    boxes
        Name to (x0, y0, x1, y1): millimetres from the image centre, or pixel indices (end excluded).
    unit
        Unit of the boxes.
    metal
        Name of the box with the metal reference; None: the first box with the name of a metal.
    specimens
        Name of a box to its physical piece, if known.
    by_hand
        True if a person drew and named them; boxes of `polysight process` have the classifier's names.
    description
        Free text.
    """

    boxes: Mapping[str, Box]
    unit: Literal["mm", "pixel"] = "pixel"
    metal: str | None = None
    specimens: Mapping[str, str] = field(default_factory=dict)
    by_hand: bool = False
    description: str = ""

    def is_metal(self, name: str) -> bool:
        """Return true if this box is the metal reference, or has a metal's name if the file has no reference."""
        return name == self.metal if self.metal is not None else is_metal(material_of(name))

    def specimen(self, name: str) -> str | None:
        """Return the physical piece in a box: as given, or the part of its name after `#`; None if not known."""
        return self.specimens.get(name) or name.partition(SPECIMEN)[2] or None

    def in_mm(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Labels:
        """Return the labels with boxes in millimetres from the centre of an image with these axes."""
        if self.unit == "mm":
            return self
        x, y = axis_mm(x_m), axis_mm(y_m)
        dx, dy = float(x[1] - x[0]), float(y[1] - y[0])

        def converted(box: Box) -> Box:
            x0, x1 = (float(x[0]) + (at - 0.5) * dx for at in (box[0], box[2]))
            y0, y1 = (float(y[0]) + (at - 0.5) * dy for at in (box[1], box[3]))
            return x0, y0, x1, y1

        return replace(self, boxes={n: converted(b) for n, b in self.boxes.items()}, unit="mm")

    def patches(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[Segmentation, dict[int, str]]:
        """Return patches of the boxes, and the box name of each; see :func:`patches_from_labels`."""
        return patches_from_labels(dict(self.boxes), x_m, y_m, unit=self.unit)


def read_labels(path: Path) -> Labels:
    """Read a label file; names and boxes are not checked, see :func:`check_labels`.

    Raises
    ------
    DataError
        if the file is missing, not JSON, an entry is not four numbers, or a key is invalid.
    """
    remedy = "correct it, or draw the boxes again: polysight label SCAN"
    try:
        raw: Any = read_json(path)
    except FileNotFoundError:
        raise DataError(
            f"{path}: no such label file", "the path is wrong", "polysight label SCAN makes one",
            code=ErrorCode.FILE_MISSING,
        ) from None  # fmt: skip
    except (OSError, ValueError) as e:
        raise DataError(
            f"{path}: not a label file: {e}", "a label file is JSON with a key `labels`", remedy,
            code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip

    def invalid(what: str, expected: str) -> DataError:
        return DataError(f"{path}: {what}", f"expected {expected}", remedy, code=ErrorCode.VALUE_INVALID)

    boxes = raw.get("labels") if isinstance(raw, dict) else None
    if not isinstance(boxes, dict):
        raise invalid("no `labels`", "{name: [x0, y0, x1, y1]} under that key")
    out: dict[str, Box] = {}
    for name, box in boxes.items():
        if not (isinstance(box, list) and len(box) == 4 and all(_is_number(b) for b in box)):
            raise invalid(f"labels.{name} = {box!r}", "four numbers [x0, y0, x1, y1]")
        out[str(name)] = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    unit, metal, specimens = raw.get("unit", "pixel"), raw.get("metal"), raw.get("specimens") or {}
    if unit not in ("mm", "pixel"):
        raise invalid(f"unit = {unit!r}", '"mm" or "pixel"')
    if not (metal is None or (isinstance(metal, str) and metal in out)):
        raise invalid(f"metal = {metal!r}", f"the name of a box: {', '.join(out)}")
    if not (isinstance(specimens, dict) and all(n in out and isinstance(s, str) for n, s in specimens.items())):
        raise invalid(f"specimens = {specimens!r}", "{name of a box: name of the piece}")
    by_hand, text = raw.get("by_hand") is True, raw.get("description")
    return Labels(out, unit, metal, specimens, by_hand, text if isinstance(text, str) else "")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def pack_labels(labels: Labels) -> bytes:
    """Return the content of a label file for :func:`read_labels`."""
    content: dict[str, Any] = {
        "description": labels.description,
        "unit": labels.unit,
        "by_hand": labels.by_hand,
        "labels": {n: [round(b, 3) for b in box] for n, box in labels.boxes.items()},
        "metal": labels.metal,
        "specimens": dict(labels.specimens),
    }
    return (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode("utf-8")


def labels_of(found: MaterialsResult, description: str = "") -> Labels:
    """Return boxes around the interiors of a result's patches, in pixels, with unique names as drawn or classified."""
    out: dict[str, Box] = {}
    for r in found.patches:
        named = r.verdict.name if r.verdict is not None else None
        name = found.boxes.get(r.patch.label) or ("metal" if r.patch.label == found.metal.label else named or "patch")
        inside = r.patch.interior if r.patch.interior.any() else r.patch.mask
        rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        key = name if name not in out else f"{name} ({r.patch.label})"
        out[key] = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
    return Labels(out, description=description)


def patches_from_plates(
    plates: Sequence[TruthPlate], x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float
) -> tuple[Segmentation, dict[int, str]]:
    """Return patches at the known plates, and label to name; several plates may have the same name.

    Parameters as of :func:`patches_from_labels`. Raises DataError if a plate has no pixel.
    """
    boxes = {f"{plate.name} ({n})": plate.box_mm for n, plate in enumerate(plates, 1)}
    found, _ = patches_from_labels(boxes, x_m, y_m, unit="mm", margin_mm=margin_mm)
    return found, {n: plate.name for n, plate in enumerate(plates, 1)}


def patches_from_labels(
    boxes: dict[str, Box],
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    unit: Literal["pixel", "mm"] = "pixel",
    margin_mm: float = 0.0,
) -> tuple[Segmentation, dict[int, str]]:
    """Make patches of boxes drawn by hand.

    Parameters
    ----------
    boxes
        Name to (x0, y0, x1, y1): pixel indices (end excluded), or millimetres from the image centre.
    x_m, y_m
        Pixel centres in metres.
    unit
        Unit of the boxes.
    margin_mm
        Margin inside the box; hand-drawn boxes usually lie inside the material already.

    Returns
    -------
    segmentation, names
        Patches, and label to name.

    Raises
    ------
    DataError
        if a box has no pixel.
    """
    x, y = axis_mm(x_m), axis_mm(y_m)
    labels = np.zeros((y.size, x.size), np.int32)
    patches: list[Patch] = []
    names: dict[int, str] = {}
    for name, box in boxes.items():
        if unit == "mm":
            mask = box_mask(box, x_m, y_m)
        else:
            x0, y0, x1, y1 = (round(b) for b in box)
            mask = np.zeros(labels.shape, bool)
            mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = True
        if not mask.any():
            raise DataError(
                f"label {name}: box {box} has no pixel", f"the image has {x.size} x {y.size} pixels",
                code=ErrorCode.NO_DATA,
            )  # fmt: skip
        n = len(patches) + 1
        patches.append(make_patch(n, mask, x_m, y_m, margin_mm))
        labels[mask] = n
        names[n] = name
    return Segmentation(labels, tuple(patches)), names
