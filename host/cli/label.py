"""The command that names materials in a scan: label."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from polysight.host.cli.options import Add

_EXAMPLES = (
    "polysight label scans/one                               # asks for the name of each patch\n"
    "  polysight label scans/one --from-patches --metal 1 --rename 2=oak --rename 3=glass\n"
    "  polysight label scans/one --box oak=-20,-20,20,20 --specimen 'oak=board 7'"
)


def _label(args: argparse.Namespace) -> int:
    from polysight.host.jobs.label import Edits, label

    edits = Edits(args.from_patches, args.remove, args.rename, args.box, args.specimen, args.metal)
    return label(args.scan, edits, args.list, input if sys.stdin.isatty() else None)


def _box(text: str) -> tuple[str, tuple[float, float, float, float]]:
    name, _, corners = text.rpartition("=")
    try:
        x0, y0, x1, y1 = (float(part) for part in corners.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=x0,y0,x1,y1 in mm") from None
    return name, (x0, y0, x1, y1)


def _pair(text: str) -> str:
    if "=" not in text.strip("="):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=TEXT")
    return text


def add_commands(add: Add) -> None:
    """Register the command."""
    sub = add(
        "label",
        _label,
        "say what lies where in a scan: boxes with names, which of them is metal; for polysight train",
        _EXAMPLES,
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="processed scan folder, or a folder of products")
    sub.add_argument(
        "--from-patches", action="store_true", help="begin with the patches that were found, called by their numbers"
    )
    sub.add_argument(
        "--box",
        type=_box,
        action="append",
        default=[],
        metavar="NAME=x0,y0,x1,y1",
        help="draw a box: lower left and upper right corner, mm from the image centre, inside the material;"
        " NAME#2 is a second piece of the same material",
    )
    sub.add_argument(
        "--rename", type=_pair, action="append", default=[], metavar="OLD=NEW", help="rename a box or a patch's number"
    )
    sub.add_argument("--remove", action="append", default=[], metavar="NAME", help="remove a box")
    sub.add_argument("--metal", metavar="NAME", help="the metal reference (default: the box with a metal's name)")
    sub.add_argument(
        "--specimen",
        type=_pair,
        action="append",
        default=[],
        metavar="NAME=WHICH",
        help="which piece of the material lies there, the same word in every scan of this piece",
    )
    sub.add_argument("--list", action="store_true", help="print boxes and patches, and write nothing")
