"""Options and commands of the polarimetric calibration: metal scanned on its own, leakage, incidence, sub-bands."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.host.cli_numbers import count
from polysight.shared.errors import ConfigError

if TYPE_CHECKING:
    from polysight.host.cli_materials import Add
    from polysight.host.process.request import Options


def add_polarimetry_options(sub: argparse.ArgumentParser) -> None:
    """`--reference`, `--reference-by`, `--incidence` and `--bands` of `polysight process`."""
    sub.add_argument(
        "--reference",
        type=Path,
        metavar="SCAN",
        help="scan of a metal plate over the whole plane, as the metal reference (default: metal in the scene)",
    )
    sub.add_argument(
        "--reference-by",
        choices=["position", "mean"],
        help="with --reference: divide by it pixel by pixel, masked where it is weak (default), or by one number a"
        " channel",
    )
    sub.add_argument(
        "--incidence",
        choices=["one", "pixel"],
        default="one",
        help="incidence angle: one number for the image (default), or each pixel's own; both are in quality.json",
    )
    sub.add_argument(
        "--bands",
        type=count,
        default=1,
        metavar="K",
        help="image K sub-bands of the sweep too, for `polysight permittivity --layer ... --bands K` (default: none)",
    )


def with_polarimetry(options: Options, args: argparse.Namespace, config: Path | None) -> Options:
    """Options with what was asked for; the reference scan is processed here. Raises PolysightError."""
    options = replace(options, bands=args.bands, incidence=args.incidence)
    if args.reference is None and args.reference_by is not None:
        raise ConfigError(
            f"--reference-by {args.reference_by} without --reference would do nothing",
            "it says how the metal scan named by --reference is used",
            "add --reference SCAN, or leave it out",
        )
    if args.reference is None:
        return options
    from polysight.host.jobs.calibrate import load_reference

    by_position = args.reference_by != "mean"
    return replace(options, reference=load_reference(args.reference, config, by_position, args.bands))


def _leakage(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import leakage

    return leakage(args.plate, args.strips, args.config, args.json)


def add_leakage_command(add: Add, rig: Path) -> None:
    """`polysight leakage`."""
    sub = add(
        "leakage",
        _leakage,
        "cross-polar leakage of both receivers, from metal at two orientations: lines for the rig file",
        "polysight leakage scans/plate --strips 0=scans/vertical --strips 90=scans/horizontal",
    )
    sub.add_argument("plate", type=Path, metavar="PLATE", help="scan of a whole metal plate over the plane")
    sub.add_argument(
        "--strips",
        type=_turned,
        action="append",
        required=True,
        metavar="DEG=SCAN",
        help="scan of thin metal strips in its place, turned by so much from the vertical towards +x; give two, best 0"
        " and 90 (one alone: both receivers are taken to leak alike)",
    )
    sub.add_argument(
        "--config", type=Path, default=None, metavar="FILE", help=f"rig file for unsynced/<scan>, as {rig}"
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _turned(text: str) -> tuple[float, Path]:
    degrees, _, folder = text.partition("=")
    try:
        angle = float(degrees)
    except ValueError:
        angle = float("nan")
    if not -180 <= angle <= 180 or not folder:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form DEGREES=SCAN, e.g. 90=scans/horizontal")
    return angle, Path(folder)
