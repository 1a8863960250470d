"""Options that several commands of `polysight` share."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from polysight.data import packaged
from polysight.shared.errors import ConfigError

RIG = Path("instrument.toml")


class Add(Protocol):
    """Adds a command to `polysight`, and returns its parser."""

    def __call__(
        self, name: str, run: Callable[[argparse.Namespace], int], text: str, example: str
    ) -> argparse.ArgumentParser:
        """A parser for the options of the command."""
        ...


def material_request(args: argparse.Namespace) -> dict[str, Any]:
    """Fields of a ProcessRequest from the options of :func:`add_material_options`.

    Raises
    ------
    ConfigError
        when an option would have no effect.
    """
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
    return {
        "metal_box_mm": args.metal,
        "library": text_of(args.library),
        "model": args.model,
        "labels": text_of(args.labels),
    }


def text_of(path: Path | None) -> str | None:
    """A path as a request holds it."""
    return None if path is None else str(path)


def rig_file(config: Path | None, data: Path) -> Path | None:
    """The rig file that was given, or else the one in the folder of the data, or in the current folder."""
    return config or next((rig for rig in (data / RIG, RIG) if rig.exists()), None)


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
    """A command line in which numbers that begin with a minus are no options: `--metal -45,0,40,40`, `probe -60,0`."""
    out: list[str] = []
    for word in words:
        if not re.fullmatch(r"-[\d.]+(,[-\d.]+)+", word):
            out.append(word)
        elif out and out[-1].startswith("--") and "=" not in out[-1]:
            out[-1] += f"={word}"
        else:
            out.append(f" {word}")  # argparse takes a word with a minus in front for an option
    return out


def add_model_option(sub: argparse.ArgumentParser, none: bool = False) -> None:
    """`--model`: which classifier; `none`: whether naming can be left out."""
    names = ["knn", "discriminant", *(["none"] if none else [])]
    told = "classifier to use instead of the discriminant; knn is the paper's"
    sub.add_argument("--model", choices=names, help=told + ("; none names nothing" if none else ""))


def add_config_option(sub: argparse.ArgumentParser, shipped: bool = False) -> None:
    """Add `--config`. `shipped`: the rig file that comes with polysight will do where none is here (no hardware)."""
    where = "instrument.toml here, or else the one that comes with polysight" if shipped else "instrument.toml"
    default = packaged(RIG) if shipped else RIG
    sub.add_argument("--config", type=Path, default=default, metavar="FILE", help=f"rig file (default: {where})")


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
        help="boxes drawn by hand, instead of patches that are found: labels.json of polysight label, or the authors'"
        " label file; the box told to be metal, or named so, is the reference",
    )
    add_model_option(sub, none=True)


Number = TypeVar("Number", int, float)


def number(kind: Callable[[str], Number], rule: str, holds: Callable[[Number], bool]) -> Callable[[str], Number]:
    """A `type` for argparse: a number for which `holds` is true; else the error is "... is not `rule`"."""

    def convert(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            raise argparse.ArgumentTypeError(f"{text} is not {rule}")
        return value

    return convert


positive = number(float, "a number above 0", lambda value: 0 < value < math.inf)
count = number(int, "a whole number, 1 or more", lambda value: value >= 1)
