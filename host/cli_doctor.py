"""The options of `polysight doctor`."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli_materials import Add
from polysight.host.cli_numbers import number
from polysight.shared.errors import ConfigError


def _doctor(args: argparse.Namespace) -> int:
    from polysight.host.doctor.bench import Wanted
    from polysight.host.doctor.walk import doctor

    if args.move and not args.pulse:
        raise ConfigError(
            "--move and --no-pulse", "each point of the row is a burst of SYNC_IN pulses", "leave one of them out"
        )
    return doctor(Wanted(args.config, args.out, args.move, args.pulse, args.bursts), args.json)


_bursts = number(int, "a whole number from 1 to 16", lambda value: 1 <= value <= 16)


def add_doctor_command(add: Add, rig: Path) -> None:
    """`polysight doctor`."""
    sub = add(
        "doctor",
        _doctor,
        "try every hop of the rig in order, and say what is wrong and what to do; nothing moves without --move",
        "polysight doctor --config instrument.toml --out scans",
    )
    sub.add_argument("--config", type=Path, default=rig, metavar="FILE", help="rig file (default: instrument.toml)")
    sub.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where scans will go: its disk is tried (default: here)"
    )
    sub.add_argument(
        "--move",
        action="store_true",
        help="THE STAGE MOVES: home it and run a short row, to try the trigger line; each of its points is a burst of"
        " SYNC_IN pulses",
    )
    sub.add_argument(
        "--no-pulse",
        dest="pulse",
        action="store_false",
        help="send no SYNC_IN pulses (default: a few bursts at rest; radars that are armed transmit meanwhile)",
    )
    sub.add_argument("--bursts", type=_bursts, default=4, metavar="N", help="how many bursts to capture (default: 4)")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")
