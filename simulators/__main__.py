"""`python -m polysight.simulators simulate SCENE.toml --out DIR`: raw data of a scene, with its truth. `check`: scene files."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from polysight.shared.config import load_instrument
from polysight.shared.errors import PolysightError, os_error
from polysight.shared.raster import check_burst_fits
from polysight.simulators.process import command_line
from polysight.simulators.scene import apply_scene, load_scene
from polysight.simulators.scene import simulated_scan as simulate


def _check(args: argparse.Namespace) -> int:
    rig = load_instrument(args.config)
    for path in args.scenes:
        scanned = apply_scene(rig, load_scene(path))
        check_burst_fits(scanned.grid, scanned.burst, scanned.stage)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns the exit status."""
    example = "simulate examples/metal-plate.toml --out out/plate"
    parser = command_line("polysight.simulators", "Stand-ins for everything that is not there.", example)
    commands = parser.add_subparsers(dest="command", required=True)
    text = "raw data of a scene, without sockets"
    sub = commands.add_parser(
        "simulate", help=text, description=text, epilog=parser.epilog, formatter_class=parser.formatter_class
    )
    simulate.add_arguments(sub)
    sub.set_defaults(run=simulate.run)
    text = "say what is wrong with scene files, or how one does not fit the rig; nothing when all is well"
    example = "example:\n  python -m polysight.simulators check examples/metal-plate.toml"
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
