"""The options of `polysight reproduce`."""

from __future__ import annotations

import argparse
from pathlib import Path

from host.cli_materials import Add


def _reproduce(args: argparse.Namespace) -> int:
    from host.reproduce.item import Run
    from host.reproduce.run import reproduce

    return reproduce(args.out, args.items, Run(args.quick, args.config))


def add_reproduce_command(add: Add, rig: Path) -> None:
    """`polysight reproduce`."""
    sub = add(
        "reproduce",
        _reproduce,
        "make the paper's tables and figures from simulation, each beside the published value",
        "polysight reproduce --out out/reproduce fig18 fig20",
    )
    sub.add_argument("items", nargs="*", metavar="ITEM", help="fig3, fig18, table2 ... (default: all there are)")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the page and the files")
    sub.add_argument("--config", type=Path, default=rig, metavar="FILE", help="rig file (default: instrument.toml)")
    sub.add_argument("--quick", action="store_true", help="fewer draws, models and placements")
