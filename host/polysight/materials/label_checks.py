"""Check the boxes and names of label files before training.

`check_labels` checks a whole file; `clean_name` and `box_name` one name.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy.typing as npt

from polysight.materials.labels import SPECIMEN, Labels, format_box, is_metal, material_of
from polysight.materials.segment import Box, Mask, axis_mm, box_mask
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

LONGEST_NAME = 80
RESERVED = ("unknown", "none of these")
"""Words that the classifier uses."""
_TOLERANCE_MM = 0.01  # files hold three decimals
_HIDDEN = re.compile("[\u00ad\u200b\u200e\u200f\u202a-\u202e\u2060-\u2069\ufeff]")  # invisible characters


def clean_name(text: str, kind: str = "name") -> str:
    """Return a name in Unicode form NFC, with trimmed spaces; `kind` is its description in errors.

    Raises
    ------
    DataError
        if it is empty, longer than `LONGEST_NAME`, has control characters, is a plain number or a reserved word.
    """
    name = re.sub(" +", " ", unicodedata.normalize("NFC", text).strip())
    shown = name if len(name) <= 40 else f"{name[:40]}..."
    wrong = ""
    if not name:
        wrong = "it is empty"
    elif len(name) > LONGEST_NAME:
        wrong = f"it has {len(name)} characters, the limit is {LONGEST_NAME}"
    elif _HIDDEN.search(name) or any(unicodedata.category(c) in ("Cc", "Cs", "Co", "Zl", "Zp") for c in name):
        wrong = "it has control characters, which figures and tables cannot show"
    elif kind == "name" and name.casefold() in RESERVED:
        wrong = "the classifier uses this word for unknown materials"
    elif kind == "name" and name.isdecimal():
        wrong = "a plain number is the number of a patch"
    if wrong:
        raise DataError(
            f"{kind} {shown!a} cannot be used", wrong, "give another one, such as oak or PMMA 3 mm",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return name


def box_name(text: str) -> str:
    """Clean the name of a box: material or material#specimen. Raises DataError as :func:`clean_name`."""
    material, mark, specimen = text.partition(SPECIMEN)
    if not mark:
        return clean_name(material)
    return f"{clean_name(material)}{SPECIMEN}{clean_name(specimen, 'specimen')}"


def image_extent_mm(x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Box:
    """Return the outer edges (x0, y0, x1, y1) of an image, millimetres from its centre."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    dx, dy = float(x[1] - x[0]) / 2, float(y[1] - y[0]) / 2
    return float(x[0]) - dx, float(y[0]) - dy, float(x[-1]) + dx, float(y[-1]) + dy


def check_labels(labels: Labels, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None) -> Labels:
    """Check labels for training; return them in millimetres, with clean names and the metal box.

    Parameters
    ----------
    labels
        Boxes of an image.
    x_m, y_m
        Its axes.
    valid
        bool [ny, nx], illuminated pixels; None: all.

    Raises
    ------
    DataError
        if a box is empty, not finite, outside the image or without a valid pixel; if two boxes overlap; if a name is
        invalid or used twice; if there are several boxes and the metal reference is not known.
    """
    given = labels.in_mm(x_m, y_m)
    boxes, extent = {}, image_extent_mm(x_m, y_m)
    for name, box in given.boxes.items():
        clean = box_name(name)
        if twin := next((other for other in boxes if other.casefold() == clean.casefold()), None):
            raise name_taken(clean, twin)
        boxes[clean] = _checked_box(clean, box, extent)
        mask = box_mask(box, x_m, y_m)
        if not (mask if valid is None else mask & valid).any():
            raise DataError(
                f"box of {clean}, {format_box(box)}: no scanned pixel",
                "it is smaller than a pixel, or outside the scanned area",
                "draw it where labels.png shows the material",
                code=ErrorCode.NO_DATA,
            )
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        _check_apart(one, a, other, b)
    specimens = {box_name(n): clean_name(s, "specimen") for n, s in given.specimens.items()}
    metal = None if given.metal is None else box_name(given.metal)
    missing = [n for n in (*specimens, *([] if metal is None else [metal])) if n not in boxes]
    if missing:
        raise no_box(missing[0], boxes)
    return replace(given, boxes=boxes, specimens=specimens, metal=metal or _metal_by_name(boxes))


def name_taken(name: str, twin: str) -> DataError:
    """Return the error for a name that exists already."""
    as_said = "" if name == twin else f" (as {twin})"
    return DataError(
        f"the name {name} exists already{as_said}",
        "each box needs its own name",
        f"name a second piece of the same material {material_of(name)}{SPECIMEN}2;"
        f" to move a box: --remove {twin} --box {twin}=x0,y0,x1,y1",
        code=ErrorCode.NAME_TAKEN,
    )


def no_box(name: str, boxes: Mapping[str, Any]) -> DataError:
    """Return the error for an unknown name of a box."""
    known = ", ".join(boxes) if boxes else "there are none"
    return DataError(
        f"no box is called {name}", f"the boxes: {known}", "polysight label SCAN --list shows them",
        code=ErrorCode.KEY_UNKNOWN,
    )  # fmt: skip


def _checked_box(name: str, box: Box, extent: Box) -> Box:
    if not all(math.isfinite(b) for b in box) or not (box[0] < box[2] and box[1] < box[3]):
        raise DataError(
            f"box of {name}, {', '.join(f'{b:g}' for b in box)}: it is empty",
            "x0 must be below x1 and y0 below y1, in millimetres from the image centre",
            f"--box {name}=x0,y0,x1,y1 with the lower left and the upper right corner",
            code=ErrorCode.VALUE_INVALID,
        )
    over = max(extent[0] - box[0], extent[1] - box[1], box[2] - extent[2], box[3] - extent[3])
    if over > _TOLERANCE_MM:
        raise DataError(
            f"box of {name}, {format_box(box)}, reaches {over:.1f} mm outside the image",
            f"the image spans {format_box(extent)} from its centre",
            "draw the box inside the image, or scan again with the plate nearer to the centre",
            code=ErrorCode.VALUE_INVALID,
        )
    return box


def _check_apart(one: str, a: Box, other: str, b: Box) -> None:
    across, up = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if across > _TOLERANCE_MM and up > _TOLERANCE_MM:
        raise DataError(
            f"the boxes of {one} and {other} overlap by {across:.1f} x {up:.1f} mm",
            f"pixels of one material would count as another; {one}: {format_box(a)}; {other}: {format_box(b)}",
            "make one of them smaller: a box lies inside its material, 5 mm or more from the edge",
            code=ErrorCode.VALUES_CONFLICT,
        )


def _metal_by_name(boxes: Mapping[str, Box]) -> str | None:
    """Return the only box with a metal's name. Raises DataError if there are several boxes and not exactly one."""
    metals = [name for name in boxes if is_metal(material_of(name))]
    if len(metals) == 1:
        return metals[0]
    if len(boxes) > 1:
        found = f"{' and '.join(metals)} are possible" if metals else "no name is that of a metal"
        raise DataError(
            f"the metal reference among the {len(boxes)} boxes is not known: {found}",
            "training data are relative to metal in the same scan",
            f"add --metal NAME: {', '.join(metals or boxes)}",
            code=ErrorCode.KEY_MISSING,
        )
    return None
