"""The commands that measure the rig with itself: calibrate, leakage."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from polysight.host.cli.options import Add, count, number

_FORM = argparse.RawDescriptionHelpFormatter


def _direct_path(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import direct_path

    return direct_path(args.scan, args.target, args.config, args.prior, args.out, args.json)


def _hpf(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import hpf

    return hpf(args.scans, args.config, args.out, args.json)


def _metal(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import metal

    return metal(args.scan, args.config, args.bands, args.out, args.json)


def _start_frequency(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import start_frequency

    return start_frequency(args.scan, args.config, args.out, args.json)


def add_commands(add: Add) -> None:
    """Register the commands."""
    _add_calibrate(add)
    _add_leakage(add)


_millimetres = number(float, "a length above 0, at most 50 mm", lambda value: 0 < value <= 50)


def _add_action(
    actions: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], int],
    text: str,
    example: str,
) -> argparse.ArgumentParser:
    part = actions.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}. Writes one dated file, and nothing else.",
        epilog=f"example:\n  {example}",
        formatter_class=_FORM,
    )
    part.set_defaults(run=run)
    part.add_argument(
        "--out",
        type=Path,
        default=Path("calibration"),
        metavar="DIR",
        help="folder of the file (default: calibration)",
    )
    part.add_argument(
        "--config",
        type=Path,
        metavar="RIG",
        help="rig file, for recordings that bring none; for direct-path also: refine its places, not the scan's",
    )
    part.add_argument("--json", action="store_true", help="print JSON, for programs")
    return part


def _add_direct_path(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    part = _add_action(
        actions,
        "direct-path",
        _direct_path,
        "where receivers and object plane really are, from a scan of points at known places",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    part.add_argument("scan", type=Path, metavar="SCAN", help="scan of the target")
    part.add_argument(
        "--target",
        type=Path,
        required=True,
        metavar="FILE",
        help="its points: [[points]] position_mm = [x, y], 3 or more",
    )
    part.add_argument(
        "--prior",
        type=_millimetres,
        default=5.0,
        metavar="MM",
        help="how well boards and plane were measured by hand, one standard deviation (default: 5 mm)",
    )


def _add_calibrate(add: Add) -> None:
    """`polysight calibrate` and its actions."""
    sub = add(
        "calibrate",
        _direct_path,
        "measure the rig with itself: places, filters, metal reference, start frequencies; from recorded scans",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    actions = sub.add_subparsers(dest="action", required=True, metavar="WHAT")

    _add_direct_path(actions)
    part = _add_action(
        actions,
        "hpf",
        _hpf,
        "the receivers' high-pass filters, from scans of one scene at several start frequencies",
        "polysight calibrate hpf scans/if-200 scans/if-500 scans/if-900 scans/if-1500",
    )
    part.add_argument("scans", type=Path, nargs="+", metavar="SCAN", help="scans, each with another start_offset_hz")
    part = _add_action(
        actions,
        "metal",
        _metal,
        "the gains of both channels at every pixel, from a scan of a metal plate that covers the plane",
        "polysight calibrate metal scans/metal-plate",
    )
    part.add_argument("scan", type=Path, metavar="SCAN", help="scan of the plate")
    part.add_argument(
        "--bands",
        type=count,
        default=1,
        metavar="K",
        help="keep K sub-bands of the sweep too, for `polysight process --bands K` (default: none)",
    )
    part = _add_action(
        actions,
        "start-frequency",
        _start_frequency,
        "the start frequency of each receiver that puts its direct path in the middle of the band",
        "polysight calibrate start-frequency scans/first-light",
    )
    part.add_argument("scan", type=Path, metavar="SCAN", help="any scan")


def _leakage(args: argparse.Namespace) -> int:
    from polysight.host.jobs.calibrate import leakage

    return leakage(args.plate, args.strips, args.config, args.json)


def _add_leakage(add: Add) -> None:
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
        "--config", type=Path, default=None, metavar="FILE", help="rig file for unsynced/<scan>, as instrument.toml"
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
