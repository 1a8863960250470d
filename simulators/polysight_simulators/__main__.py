"""`simulate SCENE.toml --out DIR` writes the raw data of a scene and its truth; `check` validates scene files."""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError
from polysight_shared.raster import check_burst_fits
from polysight_simulators.process import make_parser, parse_count, run_program
from polysight_simulators.scene import apply_scene, load_scene, simulate


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simulate`."""
    parser.add_argument("scene", type=Path, help="scene file (docs/spec/scene-file.md)")
    parser.add_argument("--config", type=Path, default=Path("instrument.toml"), help="rig file")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    layouts = ("own", "authors")
    parser.add_argument("--layout", choices=layouts, default="own", help="scan folder, or the published data set's")
    parser.add_argument("--seed", type=parse_count, default=None, help="of gains and noise, instead of the scene's")
    parser.add_argument("--columns", action="store_true", help="authors' layout: scanned column by column")
    parser.add_argument("--absent", action="store_true", help="authors' layout: lost packets are absent, not zeros")
    text = "use another set of specimens, number N (scene seed + 1000 N)"
    parser.add_argument("--specimens", type=parse_count, default=0, metavar="N", help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def _simulate(args: argparse.Namespace) -> None:
    """Run `simulate`. Raises PolysightError."""
    if args.layout == "own" and (args.columns or args.absent):
        option = "--columns" if args.columns else "--absent"
        cause = "only the published data has such scans"
        raise ConfigError(f"{option} with --layout own", cause, "add --layout authors")
    rig = load_instrument(args.config)
    scene = load_scene(args.scene)
    if args.specimens:
        scene = msgspec.structs.replace(scene, seed=scene.seed + 1000 * args.specimens)
    began = time.perf_counter()

    def show(rows_done: int, rows: int) -> None:
        left_s = (time.perf_counter() - began) / rows_done * (rows - rows_done)
        sys.stderr.write(f"\rsimulated row {rows_done} of {rows}, {left_s:.0f} s left ")

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
        if not quiet:
            # The progress line has no end yet.
            sys.stdout.write("\n")
        sys.stdout.write(f"simulated scan in {folder}, {seconds:.1f} s\n")


def _check(args: argparse.Namespace) -> None:
    """Run `check`: load each scene and apply it to the rig. Raises PolysightError for the first scene with an error."""
    rig = load_instrument(args.config)
    for path in args.scenes:
        scanned_rig = apply_scene(rig, load_scene(path))
        check_burst_fits(scanned_rig.grid, scanned_rig.burst, scanned_rig.stage)


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; return the exit status."""
    example = "simulate examples/metal-plate.toml --out out/plate"
    parser = make_parser("polysight_simulators", "Simulate scans without hardware.", example)
    commands = parser.add_subparsers(dest="command", required=True)

    def add_command(name: str, run: Callable[..., None], text: str, epilog: str | None) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, epilog=epilog, formatter_class=parser.formatter_class
        )
        sub.set_defaults(run=run)
        return sub

    sub = add_command("simulate", _simulate, "raw data of a scene, without sockets", parser.epilog)
    _add_arguments(sub)
    text = "check scene files alone and with the rig file; print only the first error"
    example = "example:\n  python -m polysight_simulators check examples/metal-plate.toml"
    sub = add_command("check", _check, text, example)
    sub.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="scene files")
    sub.add_argument("--config", type=Path, default=Path("instrument.toml"), help="rig file")
    args = parser.parse_args(argv)
    return run_program(lambda: args.run(args))


if __name__ == "__main__":
    sys.exit(main())
