"""Label files (`labels.json`) and truth files (`truth.json`): patches with names.

A label file contains boxes with the names of their materials; one may be the metal reference, and a box may have the
name of its specimen. `polysight label` writes boxes drawn by a person, in millimetres. `polysight process` writes a box
around the interior of each patch that it found, in pixels, with the classifier's name. Both forms are read, and also
the files of the published data set. `Labels.patches` makes patches of the boxes; `check_labels` checks a file before
training, `clean_name` and `normalise_box_name` check one name.

A truth file contains the plates of a simulated scene.
"""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from polysight.imaging import Mask
from polysight.materials.segment import Box, Patch, Segmentation, TruthPlate, axis_mm, box_mask, make_patch
from polysight.store import TRUTH
from polysight_shared.errors import DataError, ErrorCode, quote
from polysight_shared.files import read_json

# Name of the label files that `polysight label` writes. Label files of the published data have the names of their
# scans.
_DRAWN_HERE = "labels.json"


def read_true_plates(truth: Mapping[str, Any]) -> tuple[TruthPlate, ...]:
    """Return the plates in the content of truth.json.

    A plate has a name, `centre_mm`, `size_mm`, and its material: permittivity, metal, layers or strips.

    Plates that are marked as background, such as a table, are left out: they need no name. Raises DataError if the
    content is invalid.
    """
    try:
        return tuple(_read_plate(p) for p in truth["plates"] if not p.get("background", False))
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError) as e:
        raise DataError(
            f"the content of the truth file is invalid: {type(e).__name__}: {e}",
            "expected plates = [{name, centre_mm, size_mm, permittivity or metal}]",
            "remove the file: a report does without it",
            code=ErrorCode.VALUE_INVALID,
        ) from None


# True plates of a scene; empty if they are not known.
Plates = tuple[TruthPlate, ...]


def read_truth(path: Path) -> tuple[TruthPlate, ...]:
    """Read the plates of a truth.json. Raises DataError."""
    remedy = f"give the file that polysight simulate wrote into the folder of its data, or move {path.name} away"
    try:
        return read_true_plates(read_json(path))
    except DataError as e:
        raise DataError(f"{path}: {e.what}", e.why, remedy, code=e.code) from None
    except (OSError, ValueError) as e:
        raise DataError(
            f"{path}: cannot be read as truth: {e}", "another program's file, or damaged", remedy,
            code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def specimen_seed(path: Path) -> int | None:
    """Return the seed of the plates' random permittivities (`specimen_spread`) in a truth.json; None if not random.

    Raises DataError.
    """
    # This only checks the file, which is read again below.
    read_truth(path)
    # [real, loss]: relative standard deviations of the plates' permittivities; zeros: no deviation.
    scene = read_json(path).get("scene")
    spread = scene.get("specimen_spread") if isinstance(scene, dict) else None
    if isinstance(scene, dict) and isinstance(spread, list) and any(spread):
        return scene.get("seed")
    return None


def find_truth(folder: Path) -> tuple[Plates, str]:
    """Read the plates of a scan folder's truth.json, if there is one.

    If the file is invalid, no plates are returned, and the text gives the reason in one line; otherwise it is "".
    """
    path = folder / TRUTH
    if not path.exists():
        return (), ""
    try:
        return read_truth(path), ""
    except DataError as e:
        return (), f"{e.what}; {e.why}. The truth is not used.".replace("\n", " ")


def _read_plate(raw: Mapping[str, Any]) -> TruthPlate:
    """Read a plate of a truth file; plates of metal, strips or layers have no single permittivity.

    `strips_deg` is the direction of ideal thin metal strips, `layers` a stack from front to back. Raises KeyError,
    TypeError, ValueError or OverflowError for a malformed plate.
    """
    cx, cy = (float(c) for c in raw["centre_mm"])
    width, height = (float(s) for s in raw["size_mm"])
    eps = None
    metal = bool(raw.get("metal", False))
    if not metal and not raw.get("layers") and raw.get("strips_deg") is None:
        real, loss = raw["permittivity"]
        eps = complex(float(real), -float(loss))
    thickness = raw.get("thickness_mm")
    numbers = [cx, cy, width, height]
    if eps is not None:
        numbers += [eps.real, eps.imag]
    if not np.isfinite(numbers).all():
        raise ValueError(f"a number of plate {raw['name']} is not finite")
    box = (cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2)
    return TruthPlate(str(raw["name"]), box, eps, None if thickness is None else float(thickness), metal)


METAL_WORDS = ("metal", "copper", "aluminium", "aluminum", "steel", "brass", "iron")
"""A material with one of these words in its name is a metal."""
SPECIMEN_SEPARATOR = "#"
"""Separates a box's material from its specimen: `oak#2` is a second piece of oak."""


def is_metal(name: str) -> bool:
    """Return true if a material's name is that of a metal."""
    return any(word in METAL_WORDS for word in re.findall(r"[a-z]+", name.lower()))


def remove_specimen(name: str) -> str:
    """Return the material of a box named material or material#specimen."""
    return name.partition(SPECIMEN_SEPARATOR)[0]


def format_box(box: Box) -> str:
    """Format a box: `x -22.5 to 22.5, y 0.0 to 45.0 mm`."""
    # Adding zero removes the sign of a negative zero, which would be printed as "-0.0".
    x0, y0, x1, y1 = (b + 0.0 for b in box)
    return f"x {x0:z.1f} to {x1:z.1f}, y {y0:z.1f} to {y1:z.1f} mm"


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
        Name of the box with the metal reference. If it is None, every box with the name of a metal counts as metal, and
        processing takes the first of them as its reference; among boxes drawn by hand only one may have such a name.
    specimens
        Name of a box to the name of its specimen, the physical piece of material, if known.
    by_hand
        True if a person drew and named the boxes; boxes of `polysight process` have the classifier's names.
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
        if self.metal is not None:
            return name == self.metal
        return is_metal(remove_specimen(name))

    def specimen(self, name: str) -> str | None:
        """Return the physical piece in a box: as given, or the part of its name after `#`; None if not known."""
        return self.specimens.get(name) or name.partition(SPECIMEN_SEPARATOR)[2] or None

    def convert_to_mm(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Labels:
        """Return the labels with boxes in millimetres from the centre of an image with these axes."""
        if self.unit == "mm":
            return self
        x = axis_mm(x_m)
        y = axis_mm(y_m)
        dx = float(x[1] - x[0])
        dy = float(y[1] - y[0])

        def convert_box(box: Box) -> Box:
            x0 = float(x[0]) + (box[0] - 0.5) * dx
            x1 = float(x[0]) + (box[2] - 0.5) * dx
            y0 = float(y[0]) + (box[1] - 0.5) * dy
            y1 = float(y[0]) + (box[3] - 0.5) * dy
            return x0, y0, x1, y1

        return replace(self, boxes={n: convert_box(b) for n, b in self.boxes.items()}, unit="mm")

    def patches(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[Segmentation, dict[int, str]]:
        """Return patches of the boxes, and the box name of each; see :func:`make_patches_from_labels`."""
        return make_patches_from_labels(dict(self.boxes), x_m, y_m, unit=self.unit)


def find_label_file(folder: Path) -> Path:
    """Return the label file of a scan of the published data set, whose folder is `labels/<scan>`.

    It is `<scan>.json`, or the only JSON file there. Raises DataError if there is none, or several of other names.
    """
    file = folder / f"{folder.name}.json"
    if file.exists():
        return file
    json_files = sorted(folder.glob("*.json"))
    if len(json_files) == 1:
        return json_files[0]
    raise DataError(
        f"{file}: no such label file", "the download is not complete", "fetch the scan again",
        code=ErrorCode.FILE_MISSING,
    )  # fmt: skip


def read_labels(path: Path) -> Labels:
    """Read a label file; names and boxes are not checked, see :func:`check_labels`.

    Raises DataError if the file is missing, not JSON, an entry is not four numbers, or the value of `unit`, `metal` or
    `specimens` is invalid.
    """
    remedy = "correct it, or fetch it again"
    if path.name == _DRAWN_HERE:
        remedy = f"correct it, or remove it and draw the boxes again: rm {quote(path)}; polysight label SCAN"
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

    def make_error(what: str, expected: str) -> DataError:
        return DataError(f"{path}: {what}", f"expected {expected}", remedy, code=ErrorCode.VALUE_INVALID)

    boxes = raw.get("labels") if isinstance(raw, dict) else None
    if not isinstance(boxes, dict):
        raise make_error("no `labels`", "{name: [x0, y0, x1, y1]} under that key")
    out: dict[str, Box] = {}
    for name, box in boxes.items():
        if not (isinstance(box, list) and len(box) == 4 and all(_is_number(b) for b in box)):
            raise make_error(f"labels.{name} = {box!r}", "four finite numbers [x0, y0, x1, y1]")
        out[str(name)] = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    unit = raw.get("unit", "pixel")
    metal = raw.get("metal")
    specimens = raw.get("specimens") or {}
    if unit not in ("mm", "pixel"):
        raise make_error(f"unit = {unit!r}", '"mm" or "pixel"')
    if not (metal is None or (isinstance(metal, str) and metal in out)):
        raise make_error(f"metal = {metal!r}", f"the name of a box: {', '.join(out)}")
    if not (isinstance(specimens, dict) and all(n in out and isinstance(s, str) for n, s in specimens.items())):
        raise make_error(f"specimens = {specimens!r}", "{name of a box: name of the piece}")
    is_by_hand = raw.get("by_hand") is True
    text = raw.get("description")
    return Labels(out, unit, metal, specimens, is_by_hand, text if isinstance(text, str) else "")


def _is_number(value: Any) -> bool:
    """True for a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


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


def make_patches_from_plates(
    plates: Sequence[TruthPlate], x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float
) -> tuple[Segmentation, dict[int, str]]:
    """Return patches at the known plates, and the number of each patch to its name, which several plates may share.

    Pixels nearer than `margin_mm` to a plate's edge belong to its patch, but not to the patch's interior. Raises
    DataError if a plate has no pixel.
    """
    boxes = {f"{plate.name} ({n})": plate.box_mm for n, plate in enumerate(plates, 1)}
    patches, _ = make_patches_from_labels(boxes, x_m, y_m, unit="mm", margin_mm=margin_mm)
    return patches, {n: plate.name for n, plate in enumerate(plates, 1)}


def make_patches_from_labels(
    boxes: dict[str, Box],
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    unit: Literal["pixel", "mm"] = "pixel",
    margin_mm: float = 0.0,
) -> tuple[Segmentation, dict[int, str]]:
    """Make patches of boxes; return them, and the number of each patch, from 1, to the name of its box.

    `boxes` are name to (x0, y0, x1, y1): pixel indices (end excluded), or millimetres from the image centre. A patch
    is the whole box; its interior begins `margin_mm` inside. Hand-drawn boxes usually lie inside the material already.

    Raises DataError if a box has no pixel.
    """
    x = axis_mm(x_m)
    y = axis_mm(y_m)
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
                "correct the box in the label file", code=ErrorCode.NO_DATA,
            )  # fmt: skip
        n = len(patches) + 1
        patches.append(make_patch(n, mask, x_m, y_m, margin_mm))
        labels[mask] = n
        names[n] = name
    return Segmentation(labels, tuple(patches)), names


# Largest number of characters of a name: it has to fit into a line of a report.
LONGEST_NAME = 80
RESERVED = ("unknown", "none of these", "possible layer")
"""Words that the classifier uses."""
# Accepted overlap of two boxes, and accepted width of the part of a box outside the image. Label files have three
# decimals, so that edges that touch may differ by 0.001 mm. Chosen ten times as large, which is far below a pixel.
_TOLERANCE_MM = 0.01
# Invisible characters: two names that differ by one of them look the same.
_HIDDEN = re.compile("[\u00ad\u200b\u200e\u200f\u202a-\u202e\u2060-\u2069\ufeff]")


def clean_name(text: str, kind: str = "name") -> str:
    """Return a name in Unicode form NFC, without spaces around it and repeated ones; `kind` describes it in errors.

    Raises DataError if it is empty, longer than `LONGEST_NAME` or has control or hidden characters; if `kind` is "name"
    also if it is a plain number, a reserved word, or ends with "(literature)".
    """
    name = re.sub(" +", " ", unicodedata.normalize("NFC", text).strip())
    shortened = name if len(name) <= 40 else f"{name[:40]}..."
    reason = ""
    # Categories: control, surrogate and private characters, line and paragraph separators.
    if not name:
        reason = "it is empty"
    elif len(name) > LONGEST_NAME:
        reason = f"it has {len(name)} characters, the limit is {LONGEST_NAME}"
    elif _HIDDEN.search(name) or any(unicodedata.category(c) in ("Cc", "Cs", "Co", "Zl", "Zp") for c in name):
        reason = "it has control characters, which figures and tables cannot show"
    elif kind == "name" and name.casefold() in RESERVED:
        reason = "the classifier uses this word for unknown materials"
    elif kind == "name" and name.casefold().endswith("(literature)"):
        reason = "this ending marks names of the literature, which the library has not measured"
    elif kind == "name" and name.isdecimal():
        reason = "a plain number is the number of a patch"
    if reason:
        raise DataError(
            f"{kind} {shortened!a} cannot be used", reason, "give another one, such as oak or PMMA 3 mm",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return name


def clean_line(value: object) -> str:
    """Return a text of a foreign file as one line: its words with a space between them, `?` for unprintable characters.

    Control characters must not reach the terminal.
    """
    line = " ".join(str(value).split())
    return "".join(character if character.isprintable() else "?" for character in line)


def normalise_box_name(text: str) -> str:
    """Clean the name of a box: material or material#specimen. Raises DataError as :func:`clean_name`."""
    material, mark, specimen = text.partition(SPECIMEN_SEPARATOR)
    if not mark:
        return clean_name(material)
    return f"{clean_name(material)}{SPECIMEN_SEPARATOR}{clean_name(specimen, 'specimen')}"


def image_extent_mm(x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Box:
    """Return the outer edges (x0, y0, x1, y1) of an image, millimetres from its centre."""
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    dx = float(x[1] - x[0]) / 2
    dy = float(y[1] - y[0]) / 2
    return float(x[0]) - dx, float(y[0]) - dy, float(x[-1]) + dx, float(y[-1]) + dy


def check_labels(labels: Labels, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None) -> Labels:
    """Check labels for training; return them in millimetres, with clean names and the metal box.

    `x_m` and `y_m` are the axes of the image, `valid` bool [ny, nx] its scanned pixels (None: all).

    Raises DataError if a box is empty, not finite, outside the image or without a valid pixel; if two boxes overlap; if
    a name is invalid or used twice; if a metal reference or a specimen has no box; if there are several boxes and the
    metal reference is not known.
    """
    labels_mm = labels.convert_to_mm(x_m, y_m)
    boxes = {}
    extent = image_extent_mm(x_m, y_m)
    for name, box in labels_mm.boxes.items():
        clean_box = normalise_box_name(name)
        same_names = [existing for existing in boxes if existing.casefold() == clean_box.casefold()]
        if same_names:
            raise make_name_taken_error(clean_box, same_names[0])
        boxes[clean_box] = _check_box(clean_box, box, extent)
        mask = box_mask(box, x_m, y_m)
        if valid is not None:
            mask &= valid
        if not mask.any():
            raise DataError(
                f"box of {clean_box}, {format_box(box)}: no scanned pixel",
                "it is smaller than a pixel, or outside the scanned area",
                "draw it where labels.png shows the material",
                code=ErrorCode.NO_DATA,
            )
    for (first_name, a), (other_name, b) in combinations(boxes.items(), 2):
        _check_apart(first_name, a, other_name, b)
    specimens = {normalise_box_name(n): clean_name(s, "specimen") for n, s in labels_mm.specimens.items()}
    metal = None if labels_mm.metal is None else normalise_box_name(labels_mm.metal)
    named_boxes = list(specimens)
    if metal is not None:
        named_boxes.append(metal)
    missing = [n for n in named_boxes if n not in boxes]
    if missing:
        raise make_unknown_box_error(missing[0], boxes)
    return replace(labels_mm, boxes=boxes, specimens=specimens, metal=metal or _find_metal_by_name(boxes))


def make_name_taken_error(name: str, existing_name: str) -> DataError:
    """Return the error for a box name that exists already; `existing_name` is its spelling there."""
    spelling_text = "" if name == existing_name else f" (as {existing_name})"
    return DataError(
        f"the name {name} exists already{spelling_text}",
        "each box needs its own name",
        f"name a second piece of the same material {remove_specimen(name)}{SPECIMEN_SEPARATOR}2;"
        f" to move a box: --remove {existing_name} --box {existing_name}=x0,y0,x1,y1",
        code=ErrorCode.NAME_TAKEN,
    )


def make_unknown_box_error(name: str, boxes: Mapping[str, Any]) -> DataError:
    """Return the error for an unknown name of a box; the keys of `boxes` are the known ones."""
    listed = ", ".join(boxes) if boxes else "there are none"
    return DataError(
        f"no box is called {name}", f"the boxes: {listed}", "polysight label SCAN --list shows them",
        code=ErrorCode.KEY_UNKNOWN,
    )  # fmt: skip


def _check_box(name: str, box: Box, extent: Box) -> Box:
    """Return the box. Raises DataError if it is empty or reaches outside the image, whose edges are `extent`, in mm."""
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


def _check_apart(name: str, a: Box, other_name: str, b: Box) -> None:
    """Raise DataError if two boxes overlap by more than rounding."""
    overlap_x = min(a[2], b[2]) - max(a[0], b[0])
    overlap_y = min(a[3], b[3]) - max(a[1], b[1])
    if overlap_x > _TOLERANCE_MM and overlap_y > _TOLERANCE_MM:
        raise DataError(
            f"the boxes of {name} and {other_name} overlap by {overlap_x:.1f} x {overlap_y:.1f} mm",
            f"pixels of one material would count as another; {name}: {format_box(a)}; {other_name}: {format_box(b)}",
            "make one of them smaller: a box lies inside its material, 5 mm or more from the edge",
            code=ErrorCode.VALUES_CONFLICT,
        )


def _find_metal_by_name(boxes: Mapping[str, Box]) -> str | None:
    """Return the only box with a metal's name; None if there is a single box without such a name, or none.

    Raises DataError if there are several boxes and not exactly one has such a name.
    """
    metals = [name for name in boxes if is_metal(remove_specimen(name))]
    if len(metals) == 1:
        return metals[0]
    if len(boxes) > 1:
        candidates = f"{' and '.join(metals)} are possible" if metals else "no name is that of a metal"
        raise DataError(
            f"the metal reference among the {len(boxes)} boxes is not known: {candidates}",
            "training data are relative to metal in the same scan",
            f"name its box, --metal NAME (in Python metal=NAME): {', '.join(metals or boxes)}",
            code=ErrorCode.KEY_MISSING,
        )
    return None
