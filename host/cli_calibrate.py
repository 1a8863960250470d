"""The options of `polysight calibrate`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from polysight.host.cli_materials import Add
from polysight.host.cli_numbers import count, number

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


_millimetres = number(float, "a length above 0, at most 50 mm", lambda value: 0 < value <= 50)


def add_calibrate_command(add: Add) -> None:
    """`polysight calibrate` and its actions."""
    sub = add(
        "calibrate",
        _direct_path,
        "measure the rig with itself: places, filters, metal reference, start frequencies; from recorded scans",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    actions = sub.add_subparsers(dest="action", required=True, metavar="WHAT")

    def action(name: str, run: Callable[[argparse.Namespace], int], text: str, example: str) -> argparse.ArgumentParser:
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

    part = action(
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
    part = action(
        "hpf",
        _hpf,
        "the receivers' high-pass filters, from scans of one scene at several start frequencies",
        "polysight calibrate hpf scans/if-200 scans/if-500 scans/if-900 scans/if-1500",
    )
    part.add_argument("scans", type=Path, nargs="+", metavar="SCAN", help="scans, each with another start_offset_hz")
    part = action(
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
    part = action(
        "start-frequency",
        _start_frequency,
        "the start frequency of each receiver that puts its direct path in the middle of the band",
        "polysight calibrate start-frequency scans/first-light",
    )
    part.add_argument("scan", type=Path, metavar="SCAN", help="any scan")
