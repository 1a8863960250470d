"""The commands that need no hardware: demo, simulate, reproduce."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from polysight.cli.options import RIG, Add, add_config_option, positive
from polysight.data import packaged
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError


def _demo(args: argparse.Namespace) -> int:
    from polysight.jobs.demo import run_demo

    return run_demo(packaged(args.scene), args.config, args.out, args.time_scale)


def _simulate(args: argparse.Namespace) -> int:
    from polysight.jobs.demo import run_simulator

    command = ["simulate", str(packaged(args.scene)), "--config", str(args.config), "--out", str(args.out)]
    command += ["--layout", args.layout]
    if args.seed is not None:
        command += ["--seed", str(args.seed)]
    return run_simulator(command)


def _reproduce(args: argparse.Namespace) -> int:
    if args.config != packaged(RIG):
        load_instrument(args.config)  # refuse a wrong one now, not with the first item that needs it
    sys.stderr.write("polysight reproduce: starting\n")  # its figures' libraries take seconds to load
    sys.stderr.flush()
    if args.authors is not None:
        from polysight_papers.sensys2026.dataset_items import reproduce_authors

        return reproduce_authors(args.authors, args.out, args.config, args.items, args.images, args.names)
    if args.images is not None or args.names is not None:
        raise ConfigError("--images and --names say how to read the published files", "no --authors was given")
    from polysight_papers.sensys2026.item import Run
    from polysight_papers.sensys2026.run import reproduce

    return reproduce(args.out, args.items, Run(args.quick, args.config))


def add_commands(add: Add) -> None:
    """Register the commands."""
    sub = add(
        "demo",
        _demo,
        "scan a scene with a simulated rig and write the report; needs no hardware",
        "polysight demo --out out/demo",
        ("--out", "--scene"),
    )
    sub.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder to make (default: out/demo); an existing demo folder is overwritten",
    )
    sub.add_argument(
        "--scene",
        type=Path,
        default=packaged(Path("examples/nine-materials.toml")),
        metavar="FILE",
        help="scene file (default: nine materials)",
    )
    sub.add_argument("--time-scale", type=positive, metavar="X", help="simulated seconds per second (default: 40)")
    add_config_option(sub, shipped=True)

    sub = add(
        "simulate",
        _simulate,
        "write the raw data of a scene, with truth.json",
        "polysight simulate examples/point-targets.toml --out out/points",
    )
    sub.add_argument("scene", type=Path, metavar="SCENE.toml", help="scene file, e.g. examples/metal-plate.toml")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    sub.add_argument(
        "--layout",
        choices=["own", "authors"],
        default="own",
        help="a scan folder (default), or unsynced/<scan> as the paper's authors publish it",
    )
    sub.add_argument("--seed", type=int, help="noise seed (default: the scene's)")
    add_config_option(sub, shipped=True)

    sub = add(
        "reproduce",
        _reproduce,
        "make the paper's tables and figures beside the published values",
        "polysight reproduce --out out/reproduce fig18 fig20\n"
        "  polysight reproduce --authors dataset --out out/authors",
    )
    sub.add_argument("items", nargs="*", metavar="ITEM", help="fig3, fig18, table2 ... (default: all there are)")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the page and the files")
    sub.add_argument("--quick", action="store_true", help="fewer draws, models and placements")
    sub.add_argument("--authors", type=Path, metavar="DIR", help="use the published data set (materials/, labels/)")
    add_config_option(sub, shipped=True)
    group = sub.add_argument_group("with --authors")
    group.add_argument("--images", type=Path, metavar="DIR", help="also judge images that `polysight process` made")
    group.add_argument(
        "--names", type=Path, metavar="FILE", help='JSON with the row of Table 2 of a name, {"plexi 3": 3}'
    )
