"""`simulate SCENE.toml --out DIR` writes the raw data of a scene and its truth; `check` validates scene files."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path

import msgspec

from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, PolysightError, os_error
from polysight_shared.raster import check_burst_fits
from polysight_simulators.process import command_line
from polysight_simulators.scene import apply_scene, load_scene, simulate


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `simulate`."""
    parser.add_argument("scene", type=Path, help="scene file (docs/spec/scene-file.md)")
    parser.add_argument("--config", type=Path, default=Path("instrument.toml"), help="rig file")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument(
        "--layout", choices=("own", "authors"), default="own", help="scan folder, or the published data set's"
    )
    parser.add_argument("--seed", type=int, default=None, help="instead of the scene's seed")
    parser.add_argument("--columns", action="store_true", help="authors' layout: scanned column by column")
    parser.add_argument("--absent", action="store_true", help="authors' layout: lost packets are absent, not zeros")
    parser.add_argument(
        "--specimens",
        type=int,
        default=0,
        metavar="N",
        help="use another set of specimens, number N (scene seed + 1000 N)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def _simulate(args: argparse.Namespace) -> int:
    """Run `simulate`. Raises PolysightError."""
    if args.layout == "own" and (args.columns or args.absent):
        given = "--columns" if args.columns else "--absent"
        raise ConfigError(
            f"{given} with --layout own", "only the published data has such scans", "add --layout authors"
        )
    rig = load_instrument(args.config)
    scene = load_scene(args.scene)
    if args.specimens:
        scene = msgspec.structs.replace(scene, seed=scene.seed + 1000 * args.specimens)
    began = time.perf_counter()

    def show(done: int, rows: int) -> None:
        left = (time.perf_counter() - began) / done * (rows - done)
        sys.stderr.write(f"\rsimulated row {done} of {rows}, {left:.0f} s left ")

    quiet = args.json or not sys.stderr.isatty()
    folder = simulate(
        rig,
        scene,
        args.out,
        args.layout,
        args.seed,
        zero_filling=not args.absent,
        progress=None if quiet else show,
        by_columns=args.columns,
    )
    seconds = time.perf_counter() - began
    if args.json:
        sys.stdout.write(json.dumps({"folder": str(folder), "seconds": round(seconds, 2), "simulated": True}) + "\n")
    else:
        sys.stdout.write(f"{'' if quiet else chr(10)}simulated scan in {folder}, {seconds:.1f} s\n")
    return 0


def _check(args: argparse.Namespace) -> int:
    rig = load_instrument(args.config)
    for path in args.scenes:
        scanned = apply_scene(rig, load_scene(path))
        check_burst_fits(scanned.grid, scanned.burst, scanned.stage)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; return the exit status."""
    example = "simulate examples/metal-plate.toml --out out/plate"
    parser = command_line("polysight_simulators", "Simulate scans without hardware.", example)
    commands = parser.add_subparsers(dest="command", required=True)
    text = "raw data of a scene, without sockets"
    sub = commands.add_parser(
        "simulate", help=text, description=text, epilog=parser.epilog, formatter_class=parser.formatter_class
    )
    _add_arguments(sub)
    sub.set_defaults(run=_simulate)
    text = "check scene files alone and with the rig file; print only errors"
    example = "example:\n  python -m polysight_simulators check examples/metal-plate.toml"
    sub = commands.add_parser(
        "check", help=text, description=text, epilog=example, formatter_class=parser.formatter_class
    )
    sub.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="scene files")
    sub.add_argument("--config", type=Path, default=Path("instrument.toml"), help="rig file")
    sub.set_defaults(run=_check)
    args = parser.parse_args(argv)
    try:
        return args.run(args)
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except OSError as e:
        error = os_error(e)
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main())
