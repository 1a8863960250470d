"""Label files in the authors' form: boxes drawn by hand, `labels: {name: [x0, y0, x1, y1]}`.

The boxes of the published files are read as pixel indices of the image, x to the right and y along the rows, the last
index left out. Whether their y counts from the top or the bottom was not seen on real files; `flip_y` is there for it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from polysight.host.materials.analyse import MaterialsResult
from polysight.host.materials.segment import Box, Patch, Segmentation, axis_mm, box_mask, make_patch
from polysight.host.materials.truth import TruthPlate
from polysight.shared.errors import DataError


def read_labels(path: Path) -> dict[str, Box]:
    """Read `labels` of a label file.

    Raises
    ------
    DataError
        when the file is absent, not JSON, or an entry is not four numbers.
    """
    try:
        raw: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such label file", "the path is wrong") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as e:
        raise DataError(f"{path}: not a label file: {e}", "a label file is JSON with a key `labels`") from None
    boxes = raw.get("labels") if isinstance(raw, dict) else None
    if not isinstance(boxes, dict):
        raise DataError(f"{path}: has no `labels`", "expected {name: [x0, y0, x1, y1]} under that key")
    out: dict[str, Box] = {}
    for name, box in boxes.items():
        numbers = isinstance(box, list) and len(box) == 4 and all(isinstance(b, int | float) for b in box)
        if not numbers:
            raise DataError(f"{path}: labels.{name} = {box!r}", "expected four numbers [x0, y0, x1, y1]")
        out[str(name)] = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    return out


def write_labels(path: Path, boxes: dict[str, Box], description: str = "") -> None:
    """Write a label file that :func:`read_labels` reads back."""
    text = json.dumps({"description": description, "labels": {n: list(b) for n, b in boxes.items()}}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def labels_of(found: MaterialsResult) -> dict[str, Box]:
    """Boxes around the insides of a result's patches, in pixels, called what each was drawn or named; all differ."""
    out: dict[str, Box] = {}
    for r in found.patches:
        named = r.verdict.name if r.verdict is not None else None
        name = found.boxes.get(r.patch.label) or ("metal" if r.patch.label == found.metal.label else named or "patch")
        inside = r.patch.interior if r.patch.interior.any() else r.patch.mask
        rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        key = name if name not in out else f"{name} ({r.patch.label})"
        out[key] = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
    return out


def patches_from_plates(
    plates: Sequence[TruthPlate], x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float
) -> tuple[Segmentation, dict[int, str]]:
    """Patches where plates are known to be, and the name of each label; several plates may have the same name.

    Parameters as of :func:`patches_from_labels`. Raises DataError when a plate holds no pixel.
    """
    boxes = {f"{plate.name} ({n})": plate.box_mm for n, plate in enumerate(plates, 1)}
    found, _ = patches_from_labels(boxes, x_m, y_m, unit="mm", margin_mm=margin_mm)
    return found, {n: plate.name for n, plate in enumerate(plates, 1)}


def patches_from_labels(
    boxes: dict[str, Box],
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    unit: Literal["pixel", "mm"] = "pixel",
    flip_y: bool = False,
    margin_mm: float = 0.0,
) -> tuple[Segmentation, dict[int, str]]:
    """Patches from boxes drawn by hand.

    Parameters
    ----------
    boxes
        Name to (x0, y0, x1, y1): pixel indices (end left out), or millimetres from the image centre.
    x_m, y_m
        Pixel centres in metres.
    unit
        Unit of the boxes.
    flip_y
        Pixel rows count from the top (largest y).
    margin_mm
        Kept free inside the box; hand-drawn boxes usually lie inside the material already.

    Returns
    -------
    segmentation, names
        and the name of each label.

    Raises
    ------
    DataError
        when a box holds no pixel.
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
            if flip_y:
                y0, y1 = y.size - y1, y.size - y0
            mask = np.zeros(labels.shape, bool)
            mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = True
        if not mask.any():
            raise DataError(f"label {name}: box {box} holds no pixel", f"the image has {x.size} x {y.size} pixels")
        n = len(patches) + 1
        patches.append(make_patch(n, mask, x_m, y_m, margin_mm))
        labels[mask] = n
        names[n] = name
    return Segmentation(labels, tuple(patches), float("nan")), names
