"""The options of `polysight plan`."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli_materials import Add
from polysight.host.cli_numbers import count, positive

_NUMBERS = (
    ("--speed-mm-s", positive, "stage speed in a row"),
    ("--pulses", count, "chirps a position"),
    ("--period-us", positive, "time from one chirp of a burst to the next"),
    ("--step-x-mm", positive, "distance of positions in a row; the aperture keeps its size"),
    ("--step-y-mm", positive, "distance of rows; the aperture keeps its size"),
    ("--columns", count, "positions in a row"),
    ("--rows", count, "rows"),
    ("--width-mm", positive, "aperture in x"),
    ("--height-mm", positive, "aperture in y"),
    ("--accel-mm-s2", positive, "acceleration of the stage"),
    ("--object-distance-mm", positive, "z of the object plane"),
)


def _plan(args: argparse.Namespace) -> int:
    from polysight.host.plan.search import Changes
    from polysight.host.plan.text import Wanted, plan

    names = [flag[2:].replace("-", "_") for flag, _, _ in _NUMBERS]
    wanted = Wanted(args.minutes, args.count, args.like, args.snr_db, args.row_overhead_s, args.scene_mm, args.json)
    return plan(args.config, Changes(**{name: getattr(args, name) for name in names}), wanted)


def _size(text: str) -> tuple[float, float]:
    try:
        width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form WIDTH,HEIGHT in mm, e.g. 170,170") from None
    return width, height


def add_plan_command(add: Add, rig: Path) -> None:
    """`polysight plan`."""
    sub = add(
        "plan",
        _plan,
        "time, resolution, noise, aliases and data of a scan before it is made; or the best scan within a time",
        "polysight plan --minutes 30\n  polysight plan --speed-mm-s 100 --pulses 16 --period-us 750",
    )
    sub.add_argument("--config", type=Path, default=rig, metavar="FILE", help="rig file (default: instrument.toml)")
    for flag, kind, text in _NUMBERS:
        sub.add_argument(flag, type=kind, metavar="N", help=f"{text} (default: the rig file's)")
    sub.add_argument("--minutes", type=positive, metavar="M", help="propose the best plans within this time")
    sub.add_argument("--count", type=count, default=5, metavar="N", help="how many (default: 5)")
    sub.add_argument(
        "--scene-mm", type=_size, metavar="W,H", help="size of what lies on the plane (default: the image's)"
    )
    sub.add_argument("--like", type=Path, metavar="SCAN", help="take noise and standstill between rows from this scan")
    sub.add_argument(
        "--snr-db", type=float, metavar="DB", help="direct path over noise: a channel, a sample, a chirp (default: 5.5)"
    )
    sub.add_argument(
        "--row-overhead-s", type=float, metavar="S", help="standstill between rows (default: 0.3, simulated)"
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")
