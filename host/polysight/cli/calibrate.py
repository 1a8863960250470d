"""The commands that calibrate the rig from recorded scans: calibrate, leakage."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.cli.options import Add, CommandParser, add_action, add_json_option, count, number


def _direct_path(args: argparse.Namespace) -> int:
    from polysight.jobs.calibrate import direct_path

    return direct_path(args.scan, args.target, args.config, args.prior, args.out, args.json)


def _hpf(args: argparse.Namespace) -> int:
    from polysight.jobs.calibrate import hpf

    return hpf(args.scans, args.config, args.out, args.json)


def _metal(args: argparse.Namespace) -> int:
    from polysight.jobs.calibrate import metal

    return metal(args.scan, args.config, args.bands, args.out, args.json)


def _start_frequency(args: argparse.Namespace) -> int:
    from polysight.jobs.calibrate import start_frequency

    return start_frequency(args.scan, args.config, args.out, args.json)


_millimetres = number(float, "a length above 0, at most 50 mm", lambda value: 0 < value <= 50)


def add_commands(add: Add) -> None:
    """Register the commands."""
    sub = add(
        "calibrate",
        _direct_path,
        "calibrate the rig from recorded scans; each action writes one dated file",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    actions = sub.add_subparsers(dest="action", required=True, metavar="ACTION")

    _add_direct_path(actions)
    sub = add_action(
        actions,
        "hpf",
        _hpf,
        "fit the receivers' high-pass filters to scans of one scene at several start frequencies",
        "polysight calibrate hpf scans/if-200 scans/if-500 scans/if-900 scans/if-1500",
    )
    sub.add_argument("scans", type=Path, nargs="+", metavar="SCAN", help="scans with different start_offset_hz")
    _add_outputs(sub)
    sub = add_action(
        actions,
        "metal",
        _metal,
        "measure the gains of both channels at every pixel from a scan of a metal plate",
        "polysight calibrate metal scans/metal-plate",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan of a plate that covers the plane")
    sub.add_argument(
        "--bands",
        type=count,
        default=1,
        metavar="K",
        help="keep K sub-bands for `polysight process --bands K` (default: none)",
    )
    _add_outputs(sub)
    sub = add_action(
        actions,
        "start-frequency",
        _start_frequency,
        "find the start frequency that puts each direct path in the middle of the band",
        "polysight calibrate start-frequency scans/first-light",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="any scan")
    _add_outputs(sub)
    _add_leakage(add)


def _add_direct_path(actions: argparse._SubParsersAction[CommandParser]) -> None:
    sub = add_action(
        actions,
        "direct-path",
        _direct_path,
        "fit the places of receivers and object plane to a scan of points at known places",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan of the target")
    sub.add_argument(
        "--target", type=Path, required=True, metavar="FILE", help="3 points or more: [[points]] position_mm = [x, y]"
    )
    sub.add_argument(
        "--prior",
        type=_millimetres,
        default=5.0,
        metavar="MM",
        help="standard deviation of the places measured by hand (default: 5 mm)",
    )
    _add_outputs(sub, "; direct-path: refine its places instead of the scan's")


def _add_outputs(sub: argparse.ArgumentParser, more: str = "") -> None:
    sub.add_argument(
        "--out", type=Path, default=Path("calibration"), metavar="DIR", help="folder (default: calibration)"
    )
    sub.add_argument("--config", type=Path, metavar="RIG", help=f"rig file of published recordings{more}")
    add_json_option(sub)


def _leakage(args: argparse.Namespace) -> int:
    from polysight.jobs.calibrate import leakage

    return leakage(args.plate, args.strips, args.config, args.json)


def _add_leakage(add: Add) -> None:
    sub = add(
        "leakage",
        _leakage,
        "measure the cross-polar leakage of both receivers, as lines for the rig file",
        "polysight leakage scans/plate --strips 0=scans/vertical --strips 90=scans/horizontal",
    )
    sub.add_argument("plate", type=Path, metavar="PLATE", help="scan of a whole metal plate over the plane")
    sub.add_argument(
        "--strips",
        type=_turned,
        action="append",
        required=True,
        metavar="DEG=SCAN",
        help="scan of thin metal strips in its place, turned by DEG from the vertical towards +x; give two, best 0 and"
        " 90 (with one, both receivers are taken to leak alike)",
    )
    sub.add_argument("--config", type=Path, metavar="FILE", help="rig file of published data")
    add_json_option(sub)


def _turned(text: str) -> tuple[float, Path]:
    degrees, _, folder = text.partition("=")
    try:
        angle = float(degrees)
    except ValueError:
        angle = float("nan")
    if not -180 <= angle <= 180 or not folder:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form DEGREES=SCAN, e.g. 90=scans/horizontal")
    return angle, Path(folder)
