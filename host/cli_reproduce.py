"""The options of `polysight reproduce`."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli_materials import Add
from polysight.host.cli_options import RIG
from polysight.shared.config import load_instrument
from polysight.shared.errors import ConfigError


def _reproduce(args: argparse.Namespace) -> int:
    if args.config != RIG:
        load_instrument(args.config)  # a wrong one is told now, not with the first item that needs it
    if args.authors is not None:
        from polysight.papers.sensys2026.dataset_run import reproduce_authors

        return reproduce_authors(args.authors, args.out, args.config, args.items, args.images, args.names)
    if args.images is not None or args.names is not None:
        raise ConfigError("--images and --names say how to read the published files", "no --authors was given")
    from polysight.papers.sensys2026.item import Run
    from polysight.papers.sensys2026.run import reproduce

    return reproduce(args.out, args.items, Run(args.quick, args.config))


def add_reproduce_command(add: Add, rig: Path) -> None:
    """`polysight reproduce`."""
    sub = add(
        "reproduce",
        _reproduce,
        "make the paper's tables and figures from simulation or from the published files, beside the published values",
        "polysight reproduce --out out/reproduce fig18 fig20\n"
        "  polysight reproduce --authors dataset --out out/authors",
    )
    sub.add_argument("items", nargs="*", metavar="ITEM", help="fig3, fig18, table2 ... (default: all there are)")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the page and the files")
    sub.add_argument("--config", type=Path, default=rig, metavar="FILE", help="rig file (default: instrument.toml)")
    sub.add_argument("--quick", action="store_true", help="fewer draws, models and placements")
    sub.add_argument(
        "--authors",
        type=Path,
        metavar="DIR",
        help="the published data set (materials/, labels/): Table 2, Fig. 18, 20 and 21 from its files",
    )
    sub.add_argument(
        "--images",
        type=Path,
        metavar="DIR",
        help="with --authors: folder in which `polysight process` made images of its scans, judged as well",
    )
    sub.add_argument(
        "--names",
        type=Path,
        metavar="FILE",
        help='with --authors: JSON that says which row of Table 2 a name means, {"plexi 3": 3}',
    )
