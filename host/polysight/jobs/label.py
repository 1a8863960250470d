"""`polysight label`: boxes of a scan drawn or taken from its patches, named, and saved for training.

`apply_edits` applies options to boxes, `ask_for_names` asks a person at a terminal. The result is checked as a whole
before anything is written.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.cells import cell_len

from polysight.jobs.output import name_scan, print_lines
from polysight.materials import (
    SPECIMEN_SEPARATOR,
    Box,
    Labels,
    SegmentSettings,
    box_mask,
    check_labels,
    clean_name,
    format_box,
    image_extent_mm,
    make_name_taken_error,
    make_unknown_box_error,
    normalise_box_name,
    pack_labels,
    remove_specimen,
)
from polysight.products import IMAGE, LABELS, LABELS_PICTURE, ProcessedScan, find_labels, find_products, label_folder
from polysight.store import MANIFEST
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError, quote
from polysight_shared.files import hold_folder, write_together

METAL = "metal"
MIN_PIXELS = 16
"""A box of fewer pixels (chosen) gets a note: a library would learn speckle from it."""
# Largest margin at each edge, as a share of a patch's side; chosen. Two fifths of a narrow patch remain between two of
# them.
_LARGEST_MARGIN = 0.3
Ask = Callable[[str], str]
"""Prints a question and returns the answer; raises EOFError when the input ends."""


@dataclass(frozen=True)
class PatchToName:
    """A patch of the products that may get a box: its number, a box inside it (mm), and its present name or state.

    `is_metal_reference` is true for the patch that the analysis took as metal without a box.
    """

    number: int
    box: Box
    description: str
    is_metal_reference: bool = False


@dataclass(frozen=True)
class Edits:
    """Changes to labels, applied in this order.

    `from_patches` replaces the boxes by one inside each patch of the products, named by the patch's number. `removed`
    are names of boxes, `renames` are `OLD=NEW`. `boxes` are names and corners, in millimetres from the image centre.
    `specimens` are `NAME=SPECIMEN`: a specimen is one physical piece of a material, which is kept apart from others
    when a library is judged. `metal` is the name of the box that becomes the metal reference; None keeps the present
    one.
    """

    from_patches: bool = False
    removed: Sequence[str] = ()
    renames: Sequence[str] = ()
    boxes: Sequence[tuple[str, Box]] = ()
    specimens: Sequence[str] = ()
    metal: str | None = None

    @property
    def has_changes(self) -> bool:
        """True if any option is given."""
        changes = (self.removed, self.renames, self.boxes, self.specimens)
        return self.from_patches or self.metal is not None or any(changes)


def label(folder: Path, edits: Edits, list_only: bool = False, ask: Ask | None = None) -> int:
    """Draw, name and save the boxes of a scan or of its products; return the exit status.

    Without `edits` the person is asked for the name of each patch. If there is no person to ask (`ask` is None), or
    with `list_only`, boxes and patches are printed and nothing is written.

    Raises
    ------
    PolysightError
        when there is no image, a box or name is refused, `list_only` is given with edits, or the person does not
        confirm. Then nothing was written.
    """
    products = find_products(folder)
    if products is None:
        is_scan = (folder / MANIFEST).exists()
        products_folder = folder / "products" if is_scan else "OUT"
        raise DataError(
            f"{folder}: no {IMAGE} to draw on",
            "the scan was not processed yet, its products lie elsewhere, or the path is wrong",
            f"polysight process {quote(folder)} --out {quote(products_folder)}; or give the folder of its products",
            code=ErrorCode.FILE_MISSING,
        )
    # The label file's path and its content, or None.
    saved_labels = find_labels(folder)
    patches = list_patches(products)
    if edits.has_changes and list_only:
        raise ConfigError(
            "--list cannot be combined with options that change boxes", "--list writes nothing", "leave --list out",
            code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    labels = Labels({}, "mm")
    if saved_labels:
        _, by_hand = saved_labels
        labels = by_hand.convert_to_mm(products.x_m, products.y_m)
    if edits.has_changes:
        labels, left_out = apply_edits(labels, patches, edits)
    elif list_only or ask is None:
        sys.stdout.write(_describe_boxes(folder, products, saved_labels, patches))
        return 0
    else:
        sys.stdout.write(_describe_boxes(folder, products, saved_labels, patches))
        question = "name the patches again, instead of the boxes drawn by hand? type yes: "
        if saved_labels and ask(question).strip() != "yes":
            raise ConfigError(
                "nothing was changed", "the answer was not yes", "for options: polysight label --help",
                code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        labels = ask_for_names(patches, ask)
        left_out = []
    labels_folder = label_folder(products.folder)
    checked_labels, notes = save_labels(labels_folder, products, labels, lambda: _check_unchanged(folder, saved_labels))
    print_lines(_format_table(checked_labels))
    if left_out:
        sys.stdout.write(f"left out, without a name: {', '.join(left_out)}\n")
    sys.stdout.write("".join(f"note: {note}\n" for note in notes))
    sys.stdout.write(f"labels:   {labels_folder / LABELS}\npicture:  {labels_folder / LABELS_PICTURE}\n")
    return 0


def _check_unchanged(folder: Path, saved_labels: tuple[Path, Labels] | None) -> None:
    """Raise ScanError if the boxes of a scan are not those that were read."""
    if find_labels(folder) != saved_labels:
        raise ScanError(
            f"the boxes of {folder} have changed", "another program saved boxes after they were read here",
            "look at them (--list), and give the command again", code=ErrorCode.MISMATCH,
        )  # fmt: skip


def save_labels(
    folder: Path, products: ProcessedScan, labels: Labels, check_present: Callable[[], None] = lambda: None
) -> tuple[Labels, list[str]]:
    """Check boxes drawn on products, and write them with their picture into a folder; return the boxes and notes.

    `check_present` is called before writing, while no other program can change the boxes in the folder. If it raises an
    error, these are kept.

    Raises
    ------
    DataError
        when there is no box, or a box is refused; nothing was written then.
    """
    if not labels.boxes:
        raise DataError(
            "no box is left",
            "every patch was left out, or every box removed",
            f"to have no boxes, delete {folder / LABELS}",
            code=ErrorCode.NO_DATA,
        )
    checked_labels = check_labels(labels, products.x_m, products.y_m, products.valid)
    checked_labels = replace(
        checked_labels, by_hand=True, description=f"boxes of scan {products.scan_id}, in mm from the image centre"
    )
    # Imported here, because it loads matplotlib, which is needed neither to list boxes nor to refuse them.
    from polysight.report import label_figure

    picture = label_figure(products, checked_labels.boxes, checked_labels.metal)
    # The boxes are written last, so that saved boxes always have a picture.
    with hold_folder(folder):
        check_present()
        write_together({folder / LABELS_PICTURE: picture, folder / LABELS: pack_labels(checked_labels)})
    masks = {name: box_mask(box, products.x_m, products.y_m) for name, box in checked_labels.boxes.items()}
    notes = []
    if small_boxes := [name for name, mask in masks.items() if (mask & products.valid).sum() < MIN_PIXELS]:
        notes.append(
            f"fewer than {MIN_PIXELS} pixels: {', '.join(small_boxes)}; a library would learn speckle from so few"
        )
    if dark := _find_dark_boxes(products, masks):
        notes.append(f"as dark as empty background: {', '.join(dark)}; look at the picture")
    if checked_labels.metal is None:
        notes.append("no box is metal; train then needs a rig calibrated with `polysight calibrate metal`")
    return checked_labels, notes


def remove_labels(folder: Path) -> Path:
    """Delete the boxes drawn by hand of a scan or its products, and their picture; return the deleted label file.

    Raises
    ------
    DataError
        if there are none.
    """
    saved_labels = find_labels(folder)
    if saved_labels is None:
        raise DataError(f"{folder}: has no boxes", "none were saved", "draw some first", code=ErrorCode.FILE_MISSING)
    path, _ = saved_labels
    path.unlink()
    path.with_name(LABELS_PICTURE).unlink(missing_ok=True)
    return path


def _find_dark_boxes(products: ProcessedScan, masks: Mapping[str, npt.NDArray[np.bool_]]) -> list[str]:
    """Return the names of boxes whose power in H and V is too low to be detected as plates automatically."""
    power = np.where(products.valid, np.abs(products.h) ** 2 + np.abs(products.v) ** 2, np.nan)
    if not np.isfinite(power).any():
        return []
    # The power is compared with that of the brightest pixels, without the brightest per cent, which may be a glint.
    least_power = np.nanpercentile(power, 99) * 10 ** (SegmentSettings().dimmest_db / 10)
    power_in_box = {name: power[mask & products.valid] for name, mask in masks.items()}
    return [name for name, values in power_in_box.items() if values.size and np.nanmedian(values) < least_power]


def list_patches(products: ProcessedScan) -> list[PatchToName]:
    """Return the patches of materials.json, each with a box inside it that avoids its edges if it is wide enough."""
    margin_mm = SegmentSettings().margin_mm
    patches = []
    for patch in products.segments:
        x0, y0, x1, y1 = patch.box_mm
        margin_x_mm = min(margin_mm, _LARGEST_MARGIN * (x1 - x0))
        margin_y_mm = min(margin_mm, _LARGEST_MARGIN * (y1 - y0))
        inner_box = (x0 + margin_x_mm, y0 + margin_y_mm, x1 - margin_x_mm, y1 - margin_y_mm)
        description = "not named"
        is_metal_reference = False
        # The `box` of a patch is the name of the drawn box, not its corners.
        if patch.box:
            description = patch.box
        elif patch.refused is not None:
            description = "not judged"
        elif patch.metal_reference:
            description = "the metal reference"
            is_metal_reference = True
        elif patch.name:
            description = f"named {patch.name}"
            if patch.confidence is not None:
                description += f" {100 * patch.confidence:.0f} %"
        patches.append(PatchToName(patch.label, inner_box, description, is_metal_reference))
    return patches


def _require_patches(patches: Sequence[PatchToName]) -> None:
    """Raise DataError if there are none."""
    if not patches:
        raise DataError(
            "no patch was found", "only images were made, or no object stands out in them", "draw a box: --box"
        )


def apply_edits(labels: Labels, patches: Sequence[PatchToName], edits: Edits) -> tuple[Labels, list[str]]:
    """Return boxes after the edits, and the numbers of unnamed patches.

    Raises
    ------
    DataError
        when a name does not exist, exists twice, or is invalid.
    """
    boxes = dict(labels.boxes)
    specimens = dict(labels.specimens)
    metal = labels.metal
    if edits.from_patches:
        _require_patches(patches)
        boxes = {str(patch.number): patch.box for patch in patches}
        specimens = {}
        metal = None

    for option in edits.removed:
        name = _find_box(option, boxes)
        del boxes[name]
        specimens.pop(name, None)
        if name == metal:
            metal = None

    # If the metal is given by the number of a patch, this patch is named "metal", unless it is renamed too.
    if edits.from_patches and edits.metal in boxes:
        renamed = {old for old, _ in (_split_at_equals(text, boxes) for text in edits.renames)}
        if edits.metal not in renamed:
            edits = replace(edits, renames=(*edits.renames, f"{edits.metal}={METAL}"))
    new_names = {name: name for name in boxes}
    for text in edits.renames:
        old, new = _split_at_equals(text, boxes)
        new_names[old] = normalise_box_name(new)
    boxes = _rename_boxes(boxes, new_names)
    specimens = {new_names[name]: specimen for name, specimen in specimens.items()}
    # No box has an empty name: without a metal reference the result is None.
    metal = new_names.get(metal or "")

    for name, box in edits.boxes:
        clean_box_name = normalise_box_name(name)
        # The same box under the same name is accepted, so that a command that was killed can be repeated.
        if boxes.get(clean_box_name) != box:
            _refuse_taken_name(clean_box_name, boxes)
            boxes[clean_box_name] = box

    # A patch that is still called by its number was not named.
    left_out = [name for name in boxes if name.isdecimal()]
    boxes = {name: box for name, box in boxes.items() if name not in left_out}

    for text in edits.specimens:
        name, specimen = _split_at_equals(text, boxes)
        specimens[name] = clean_name(specimen, "specimen")

    if edits.metal is not None:
        if edits.from_patches and edits.metal in new_names:
            metal = new_names[edits.metal]
        else:
            metal = _find_box(edits.metal, boxes)
    return Labels(boxes, "mm", metal, specimens), left_out


def _rename_boxes(boxes: Mapping[str, Box], new_names: Mapping[str, str]) -> dict[str, Box]:
    """Return the boxes under their new names. Raises DataError if two would have the same name."""
    renamed: dict[str, Box] = {}
    for old, box in boxes.items():
        new = new_names[old]
        _refuse_taken_name(new, renamed)
        renamed[new] = box
    return renamed


def _refuse_taken_name(name: str, boxes: Mapping[str, Box]) -> None:
    """Raise DataError if a box has this name, in large or small letters."""
    for other in boxes:
        if other.casefold() == name.casefold():
            raise make_name_taken_error(name, other)


def _find_box(name: str, boxes: Mapping[str, Box]) -> str:
    """Find the box that an option names. Raises DataError if there is none."""
    if name in boxes:
        return name
    # A patch that has no name yet is called by its number.
    clean_name = name.strip()
    if not clean_name.isdecimal():
        clean_name = normalise_box_name(name)
    if clean_name not in boxes:
        raise make_unknown_box_error(clean_name, boxes)
    return clean_name


def _split_at_equals(text: str, boxes: Mapping[str, Box]) -> tuple[str, str]:
    """Split `NAME=TEXT`, where NAME is a box and may contain `=`. Raises DataError."""
    # Take the longest part that is the name of a box.
    parts = text.split("=")
    for count in range(len(parts) - 1, 0, -1):
        name = "=".join(parts[:count])
        if name in boxes:
            return name, "=".join(parts[count:])
    name, _, value = text.partition("=")
    return _find_box(name, boxes), value


def ask_for_names(patches: Sequence[PatchToName], ask: Ask) -> Labels:
    """Ask for the names of patches. Raises DataError without patches, ConfigError when the input ends."""
    _require_patches(patches)
    boxes: dict[str, Box] = {}
    metal = None
    sys.stdout.write(f"name each patch; Enter leaves it out, m is the metal reference (named {METAL})\n")
    try:
        for patch in patches:
            question = f"patch {patch.number}, {format_box(patch.box)}, {patch.description}: "
            name, is_metal = _ask_for_name(question, boxes, ask, metal is None)
            if name:
                boxes[name] = patch.box
            if is_metal:
                metal = name
        if len(boxes) > 1 and metal is None:
            metal = _ask_for_metal(boxes, ask)
    except EOFError:
        raise ConfigError(
            "nothing was written: the answers ended", "the input was closed", "give options instead",
            code=ErrorCode.KEY_MISSING,
        ) from None  # fmt: skip
    return Labels(boxes, "mm", metal)


def _ask_for_name(question: str, boxes: Mapping[str, Box], ask: Ask, metal_missing: bool) -> tuple[str, bool]:
    """Ask until the answer is a valid new name or empty; return it, and True if it is the metal.

    If a box has this name already, another piece of the same material gets the name MATERIAL#PIECE.
    """
    while True:
        answer = ask(question).strip()
        is_metal = answer in ("m", "M") and metal_missing
        if not answer:
            return "", False
        try:
            name = METAL if is_metal else answer
            name = normalise_box_name(name)
            if name not in boxes:
                _refuse_taken_name(name, boxes)
                return name, is_metal
            piece = ask(
                f"  {name} exists already. If this is another piece of it: name of the piece, such as 2 "
                "(Enter: another name): "
            )
            if piece.strip():
                name = normalise_box_name(f"{remove_specimen(name)}{SPECIMEN_SEPARATOR}{piece}")
                _refuse_taken_name(name, boxes)
                return name, is_metal
        except DataError as e:
            sys.stdout.write(f"  {e.what}: {e.why}\n")


def _ask_for_metal(boxes: Mapping[str, Box], ask: Ask) -> str | None:
    """Ask which box is the metal reference; None without an answer: then it is the box with a metal's name."""
    while answer := ask("which of them is the metal reference (Enter: the one with a metal's name): ").strip():
        try:
            return _find_box(answer, boxes)
        except DataError as e:
            sys.stdout.write(f"  {e.what}; {e.why}\n")
    return None


def _format_table(labels: Labels) -> list[str]:
    """Format the boxes as lines of a table."""
    rows = [("name", "specimen", "box", "")]
    for name, box in labels.boxes.items():
        text = "metal reference" if name == labels.metal else ""
        rows.append((remove_specimen(name), labels.specimen(name) or "-", format_box(box), text))
    # The last column needs no padding.
    widths = [*(max(cell_len(row[column]) for row in rows) for column in range(3)), 0]
    lines = []
    for row in rows:
        cells = [cell + " " * (width - cell_len(cell)) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines


def _describe_boxes(
    folder: Path, products: ProcessedScan, saved_labels: tuple[Path, Labels] | None, patches: Sequence[PatchToName]
) -> str:
    """Describe the drawn boxes, the detected patches, and how to name them."""
    lines = [f"{products.folder}: {name_scan(products.scan_id, bool(products.simulated))}"]
    lines.append(f"image: {format_box(image_extent_mm(products.x_m, products.y_m))} from its centre")
    if saved_labels:
        path, by_hand = saved_labels
        boxes = by_hand.convert_to_mm(products.x_m, products.y_m)
        lines += [f"drawn by hand: {path}", *(f"  {line}" for line in _format_table(boxes))]
    if patches:
        lines += ["patches that were found, a box inside each:"]
        lines += [f"  {patch.number:>3}  {format_box(patch.box)}  {patch.description}" for patch in patches]
        metal = next((patch.number for patch in patches if patch.is_metal_reference), "NUMBER")
        lines.append(
            f"to name them: polysight label {quote(folder)} --from-patches --metal {metal} --rename NUMBER=NAME ..."
        )
    lines.append(f"to draw one:  polysight label {quote(folder)} --box NAME=-20,-20,20,20 (x0,y0,x1,y1 in mm)")
    return "".join(f"{line}\n" for line in lines)
