"""Options that several commands of `polysight` share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.host.cli_materials import add_model_option
from polysight.shared.errors import ConfigError

if TYPE_CHECKING:
    from polysight.host.process.request import Options

RIG = Path("instrument.toml")


def options_of(args: argparse.Namespace) -> Options:
    """What the options of :func:`add_material_options` ask for; the label file is read here.

    Raises
    ------
    ConfigError
        when one of them would do nothing.
    DataError
        when the label file is none.
    """
    from polysight.host.materials.patch_files import read_labels
    from polysight.host.process.request import Options

    given = {"--library": args.library, "--metal": args.metal, "--labels": args.labels, "--model": args.model}
    asked = [name for name, value in given.items() if value is not None]
    if asked and getattr(args, "no_process", False):
        raise ConfigError(
            f"{' and '.join(asked)} with --no-process would do nothing",
            "it says how the scan is processed, and it will only be recorded",
            "give it to `polysight process` later, or leave --no-process out",
        )
    if args.library is not None and args.model == "none":
        raise ConfigError("--library with --model none would do nothing", "nothing is named", "leave one of them out")
    labels = None if args.labels is None else read_labels(args.labels)
    return Options(metal_box_mm=args.metal, library=args.library, model=args.model, labels=labels)


def rig_file(args: argparse.Namespace) -> Path | None:
    """The rig file that was given, or the one that lies with the data, or here."""
    return args.config or next((rig for rig in (args.data / RIG, RIG) if rig.exists()), None)


def box(text: str) -> tuple[float, float, float, float]:
    """`x,y,width,height` in millimetres as corners (x0, y0, x1, y1)."""
    try:
        x, y, w, h = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not of the form x,y,width,height in mm, e.g. 0,0,40,40"
        ) from None
    if w <= 0 or h <= 0:
        raise argparse.ArgumentTypeError(f"width and height of {text!r} must be positive")
    return x - w / 2, y - h / 2, x + w / 2, y + h / 2


def joined(words: Sequence[str]) -> list[str]:
    """A command line in which numbers that begin with a minus are their option's: `--metal -45,0,40,40` too."""
    out: list[str] = []
    for word in words:
        if out and out[-1].startswith("--") and "=" not in out[-1] and re.fullmatch(r"-[\d.]+(,[-\d.]+)+", word):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def add_config_option(sub: argparse.ArgumentParser) -> None:
    """The rig file."""
    sub.add_argument("--config", type=Path, default=RIG, metavar="FILE", help="rig file (default: instrument.toml)")


def add_material_options(sub: argparse.ArgumentParser) -> None:
    """Library, metal and model: how patches are named."""
    sub.add_argument(
        "--library", type=Path, default=None, metavar="FILE", help="reference library (default: the simulated one)"
    )
    sub.add_argument(
        "--metal",
        type=box,
        metavar="X,Y,W,H",
        help="metal reference: place and size, mm from the image centre, e.g. --metal -60,0,40,40 (default: found)",
    )
    sub.add_argument(
        "--labels",
        type=Path,
        default=None,
        metavar="FILE",
        help="boxes drawn by hand, instead of patches that are found: labels.json of earlier products, edited, or the"
        " authors' label file; a box named metal or copper is the reference",
    )
    add_model_option(sub, none=True)
