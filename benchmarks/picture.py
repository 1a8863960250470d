"""The published rig's own picture: patches, permittivities, names and verdict, for each form of the input.

The picture is not part of the repository: `--images DIR` or POLYSIGHT_PUBLISHED_IMAGES names its folder, with
`<name>.npz` (h, v) and `<name>.json` (`boxes_px`); of several the first is taken. It is processed as `.npz` and as the
published `labels/<scan>`, with its boxes and without. Table 2 of the POLySIGHT paper (permittivities of its plates)
stands beside the figures; the incidence angle, which is not given, is assumed to be 55 degrees. With `--table-2` the
library is Table 2 as half spaces, all of it or the materials of these plates alone, and the names by a posterior of
ten lines stand beside ours (`weigh_ratio_alone`).
"""

import argparse
import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.worlds import table_2_classifier
from polysight.data import find_packaged
from polysight.materials import Labels, Library, fit_library
from polysight.process import Inputs, analyse_given_images, read_given_images
from polysight.products import ProcessedScan
from polysight.results import PatchFigures
from polysight.settings import Settings, path_text
from polysight_shared.config import load_instrument
from polysight_worlds import TABLE_2

# Environment variable with the folder of the picture.
FOLDER = "POLYSIGHT_PUBLISHED_IMAGES"
ANGLE_DEG = 55.0
PLATES = {
    "rubber": ("rubber", "rubber"),
    "cardboard_rough": ("cardboard (rough)", "cardboard_rough"),
    "silicone_rubber": ("silicone rubber", "silicone_rubber"),
    "PET_0.5mm": ("PET (0.5 mm)", "pet_0.5mm"),
    "ceramic": ("ceramic", "ceramic"),
    "acrylic_3mm": ("acrylic (3 mm)", "acrylic_3mm"),
    "PCB": ("glass fiber", "glass_fibre"),
    "wood_thin": ("wood (thin, smooth)", "wood_thin"),
}
"""Name of a box to the material's name in the paper, and to that in Table 2 of the independent generator."""
# Box of the metal reference.
METAL_BOX = "copper"
RATIO_STD = 0.08
PHASE_STD_RAD = np.radians(10)
MOST_STDS = 3.0
"""Standard deviations of ln |P| and of its phase (`weigh_ratio_alone`); "unknown" weighs as much as a material that is
`MOST_STDS` of them away. All chosen."""
# Probability from which a wrong name counts as sure and wrong; chosen.
SURE = 0.8
# Standard deviations on both sides of a normal distribution's mean that hold 95 %.
TWO_SIDED_95 = 1.96


@dataclass(frozen=True)
class Form:
    """One way to give the picture: file or folder, with its boxes or without."""

    name: str
    path: Path
    with_boxes: bool


def write_forms(source: Path, boxes: dict[str, list[int]], scratch: Path) -> list[Form]:
    """Write the picture in its four forms below `scratch`; `boxes` are x0, y0, x1, y1 in pixels, row 0 at the top."""
    with np.load(source) as arrays:
        h = arrays["h"]
        v = arrays["v"]
    forms = []
    for with_boxes in (True, False):
        kind = "without boxes"
        if with_boxes:
            kind = "with boxes"
        folder = scratch / kind.replace(" ", "-")
        folder.mkdir()
        np.save(folder / "sar_h.npy", h)
        np.save(folder / "sar_v.npy", v)
        content = {"description": "", "labels": boxes if with_boxes else {}}
        (folder / f"{folder.name}.json").write_text(json.dumps(content))
        # The picture is taken to be square, with pixels of 2 mm; its row 0 is the top.
        top_first = np.arange(h.shape[0])[::-1] * 2e-3
        archive = scratch / f"{folder.name}.npz"
        # The published imaging code makes conjugate images (materials' `restore_phase_sign`): the .npz says so, and the
        # reader of `labels/` folders expects it.
        np.savez(archive, h=h, v=v, x_m=top_first[::-1], y_m=top_first, conjugate=True)
        forms += [Form(f".npz {kind}", archive, with_boxes), Form(f"labels/ {kind}", folder, with_boxes)]
    return forms


def process(form: Form, boxes: dict[str, list[int]], library: Path | None) -> tuple[ProcessedScan, dict[str, int]]:
    """Process one form; return the result, and for each box the number of the patch that covers most pixels of it.

    The number is 0 if all patches together cover no more than half of the box.
    """
    rig = load_instrument(find_packaged(Path("instrument.toml")))
    pair = read_given_images(form.path, rig)
    drawn = None
    if form.with_boxes and pair.labels is None:
        drawn = Labels({name: (b[0], b[1], b[2], b[3]) for name, b in boxes.items()})
    settings = Settings(incidence_deg=ANGLE_DEG, library=path_text(library))
    scan, _, _ = analyse_given_images(pair, settings, Inputs(labels=drawn), rig)
    # Row 0 of the boxes is the top, that of the labels the bottom.
    labels = scan.labels[::-1]
    patch_of = {}
    for name, (x0, y0, x1, y1) in boxes.items():
        inside = labels[y0:y1, x0:x1]
        pixel_counts = np.bincount(inside[inside > 0], minlength=1)
        if pixel_counts.sum() > 0.5 * inside.size:
            patch_of[name] = int(pixel_counts.argmax())
        else:
            patch_of[name] = 0
    return scan, patch_of


@dataclass(frozen=True)
class PlateFigures:
    """Result of one plate, compared with Table 2."""

    # Its line of the printed table.
    text: str
    # True if the 95 % interval of the real part holds Table 2's.
    inside: bool = False
    # True if the name is right.
    right: bool = False
    # True for a wrong material whose confidence is at least `SURE`.
    sure_and_wrong: bool = False
    # Relative half width of the real part's 95 % interval; None without a permittivity.
    half_width: float | None = None


def judge_plate(box: str, patch: PatchFigures | None) -> PlateFigures:
    """Compare a plate with Table 2; `patch` is None if none was found in its box."""
    name, world_name = PLATES[box]
    real = TABLE_2[world_name].real
    loss = -TABLE_2[world_name].imag
    if patch is None:
        return PlateFigures(f"  {box:16} not found")
    if patch.refused is not None:
        return PlateFigures(f"  {box:16} {real:5.2f} {loss:5.2f}   refused: {patch.refused.what}")
    e = patch.permittivity
    inside = False
    half_width = None
    estimate = "no permittivity"
    if e is not None and e.spread is not None:
        half_width = TWO_SIDED_95 * e.spread.real_std / e.real
        inside = abs(e.real - real) <= TWO_SIDED_95 * e.spread.real_std
        estimate = f"{e.real:5.2f} +- {e.spread.real_std:4.2f}  {e.loss:5.2f} +- {e.spread.loss_std:4.2f}"
    sure = patch.confidence or 0.0
    right = patch.name == name
    mark = "in" if inside else "OUT"
    return PlateFigures(
        text=f"  {box:16} {real:5.2f} {loss:5.2f}   {estimate:32} {mark:3}  {patch.name} {sure:.2f}",
        inside=inside,
        right=right,
        sure_and_wrong=not right and patch.name not in (None, "unknown") and sure >= SURE,
        half_width=half_width,
    )


def table_2_library(extent: str) -> Library:
    """Return a library of the paper's Table 2 as half spaces under the picture's angle: "all" or these "plates"."""
    library = table_2_classifier(float(np.radians(ANGLE_DEG))).library
    paper_names = {world_name: name for name, world_name in PLATES.values()}
    entries = []
    for entry in library.entries:
        is_of_picture = entry.name in paper_names or entry.name == METAL_BOX
        if extent == "all" or is_of_picture:
            entries.append(replace(entry, name=paper_names.get(entry.name, entry.name)))
    return fit_library(Library(tuple(entries)))


def measure_ratios(source: Path, boxes: dict[str, list[int]]) -> dict[str, complex]:
    """Return the ratio P = h / v of each box relative to copper's, nothing corrected.

    That of a box is the inverse of the median of v / h over its pixels.
    """
    with np.load(source) as arrays, np.errstate(divide="ignore", invalid="ignore"):
        inverse_ratio = arrays["v"] / arrays["h"]
    ratios = {}
    for name, (x0, y0, x1, y1) in boxes.items():
        pixels = inverse_ratio[y0:y1, x0:x1]
        ratios[name] = 1 / complex(np.median(pixels.real), np.median(pixels.imag))
    return {name: ratio / ratios[METAL_BOX] for name, ratio in ratios.items()}


def weigh_ratio_alone(ratio: complex, library: Library) -> dict[str, float]:
    """Return the probabilities of the library's materials and of "unknown", by |P| and the size of its phase alone.

    Copper is left out. All other materials are as likely, and losses are absolute values as in the published table. The
    whole analysis has to be better than this.
    """
    weights = {"unknown": np.exp(-0.5 * MOST_STDS**2)}
    for entry in library.entries:
        of_material = complex(np.median(entry.p))
        by_modulus = np.log(abs(ratio / of_material)) / RATIO_STD
        by_phase = (abs(np.angle(ratio)) - abs(np.angle(of_material))) / PHASE_STD_RAD
        if entry.name != METAL_BOX:
            weights[entry.name] = float(np.exp(-0.5 * (by_modulus**2 + by_phase**2)))
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def print_names_of_ratio_alone(ratios: dict[str, complex], library: Library) -> None:
    """Print the likeliest name of each plate by `weigh_ratio_alone`, and how many are right."""
    names = []
    right_count = 0
    for box, (true_name, _) in PLATES.items():
        probability = weigh_ratio_alone(ratios[box], library)
        name = max(probability, key=lambda key: probability[key])
        right_count += name == true_name
        names.append(f"{box} {name} {probability[name]:.2f}")
    print(f"  |P| and its phase alone: names right {right_count}: " + ", ".join(names))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--images", type=Path, default=os.environ.get(FOLDER), help=f"folder (default: ${FOLDER})")
    parser.add_argument("--library", type=Path, help="library (default: the simulated one)")
    parser.add_argument(
        "--table-2",
        choices=("all", "plates"),
        nargs="?",
        const="all",
        help="library of Table 2 as half spaces instead: all of it (default), or the materials of these plates",
    )
    parser.add_argument("--reasons", type=int, default=4, help="reasons of the verdict to print (default: 4)")
    parser.add_argument("--json", type=Path, help="file for the figures")


def run(args: argparse.Namespace) -> int:
    """Print figures and a table for each form; without the picture print that one benchmark is skipped. Return 0."""
    sources = []
    if args.images:
        sources = sorted(Path(args.images).glob("*.npz"))
    if not sources:
        print(f"picture: skipped (1): no picture; give --images DIR or set {FOLDER}")
        return 0
    boxes = json.loads(sources[0].with_suffix(".json").read_text())["boxes_px"]
    figures = {}
    with tempfile.TemporaryDirectory() as scratch:
        library = args.library
        if args.table_2:
            table_2 = table_2_library(args.table_2)
            library = Path(scratch) / "table-2.npz"
            table_2.save(library)
            print_names_of_ratio_alone(measure_ratios(sources[0], boxes), table_2)
        for form in write_forms(sources[0], boxes, Path(scratch)):
            scan, patch_of = process(form, boxes, library)
            by_number = {patch.label: patch for patch in scan.segments}
            plates = [judge_plate(box, by_number.get(patch_of[box])) for box in PLATES]
            widths = [plate.half_width for plate in plates if plate.half_width is not None]
            metal = by_number.get(patch_of[METAL_BOX])
            # Patches that are not the main one of any box.
            extra = len(by_number) - len({n for n in patch_of.values() if n})
            verdict = ""
            if scan.verdict:
                verdict = scan.verdict.text
            reference = "NOT copper"
            if metal is not None and metal.metal_reference:
                reference = "copper"
            figures[form.name] = {
                "patches": len(by_number),
                "not_plates": extra,
                "reference": reference,
                "verdict": verdict,
                "regions_hold_table_2": sum(plate.inside for plate in plates),
                "estimated": len(widths),
                "median_half_width_percent": round(100 * float(np.median(widths)), 1) if widths else None,
                "names_right": sum(plate.right for plate in plates),
                "sure_and_wrong": sum(plate.sure_and_wrong for plate in plates),
            }
            print(f"{form.name}: " + ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in figures[form.name].items()))
            print("  plate            Table 2       permittivity +- std, loss +- std         name")
            print("\n".join(plate.text for plate in plates))
            for reason in (scan.verdict.reasons if scan.verdict else ())[: args.reasons]:
                print(f"  - {reason.what}")
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))
    return 0
