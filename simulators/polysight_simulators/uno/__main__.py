"""The emulated UNO in real time: like `python -m polysight_simulators.stage`, but it runs the flashed machine code.

`--time-scale` is the speed of the whole board, its heartbeat clock included: the stage stops when no command has come
for a heartbeat. Use at most 2 with a program that sends `status` four times per heartbeat of real time: at 4 each
would come too late. On a machine that cannot keep up, the simulated world runs slower than asked for.
"""

import argparse
import os
import sys
from pathlib import Path

from polysight_shared.config import load_instrument
from polysight_shared.errors import PolysightError
from polysight_shared.program import die_with_parent
from polysight_simulators.process import check_link, make_parser, run_program
from polysight_simulators.stage import count_steps_to_zero
from polysight_simulators.uno import ENABLING_COMMAND, compile_emulator, compile_firmware, list_missing_packages


def main(argv: list[str] | None = None) -> int:
    """Run until SIGTERM or SIGINT."""
    parser = make_parser("polysight_simulators.uno", str(__doc__), "--config instrument.toml --link out/ttySTAGE")
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="rig file, instrument.toml")
    parser.add_argument(
        "--wires", type=Path, metavar="SOCKET", help="hub of the simulated wires: gets trigger and motion"
    )
    parser.add_argument("--link", type=Path, required=True, metavar="PATH", help="name of the serial port to make")
    parser.add_argument(
        "--time-scale",
        type=float,
        default=1.0,
        metavar="X",
        help="speed of the board, relative to real time; see above",
    )
    parser.add_argument(
        "--boot-ms",
        type=int,
        default=200,
        metavar="N",
        help="time of the boot loader after the port is opened, in the board's own time",
    )
    args = parser.parse_args(argv)
    if not args.time_scale > 0:
        parser.error("--time-scale must be positive")
    die_with_parent()
    return run_program(lambda: _run(args))


def _run(args: argparse.Namespace) -> None:
    """Compile emulator and firmware, and become the emulator. Raises PolysightError if a package is missing."""
    check_link(args.link)
    if missing_packages := list_missing_packages():
        problem = f"not installed: {' '.join(missing_packages)}"
        raise PolysightError(problem, "the emulated board is compiled on this machine", ENABLING_COMMAND)
    rig = load_instrument(args.config)
    # Steps from the closing point of a limit switch to the stage's zero, on both axes.
    zero_steps = count_steps_to_zero()
    program = str(compile_emulator())
    command = [program, "--pty", str(args.link), "--speed", repr(args.time_scale), "--boot-ms", str(args.boot_ms)]
    command += [
        "--zero",
        f"{zero_steps},{zero_steps}",
        "--um-per-step",
        repr(1000.0 / rig.stage.steps_per_mm),
    ]
    # The GPIO line of the Pi that the board's trigger output drives.
    command += ["--line", str(rig.pi.trigger_in)]
    if args.wires:
        command += ["--wires", str(args.wires)]
    os.execv(program, [*command, str(compile_firmware())])


if __name__ == "__main__":
    sys.exit(main())
