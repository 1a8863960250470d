"""The stage of a simulated rig: a serial port that behaves like the board, trigger and motion on the simulated wires.

It is the sketch's own code, compiled for this machine (arduino_stage/pc); without a C++ compiler, or with `--python`,
a stand-in with the same dialogue and the same step times.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from pathlib import Path

from polysight.shared.config import load_instrument
from polysight.shared.errors import PolysightError
from polysight.shared.wires import WireClient
from polysight.simulators._process import announce_ready, command_line, die_with_parent, stop_requested
from polysight.simulators.build_cache import compiled
from polysight.simulators.stage_port import SerialPort, serve
from polysight.simulators.stage_python import PythonStage, Rig

SKETCH_DIR = Path(__file__).resolve().parents[1] / "arduino_stage"
BOOT_MS = 200
_FLAGS = ("-std=gnu++11", "-O2", "-Wall", "-Wextra", "-fno-exceptions", "-fno-rtti")


def compiler() -> str | None:
    """The C++ compiler's path; None without one, or without the sketch's sources."""
    return shutil.which("g++") if (SKETCH_DIR / "pc" / "main.cpp").is_file() else None


def build(gxx: str, flags: tuple[str, ...] = _FLAGS) -> Path:
    """The sketch compiled for this machine. Raises DeviceError when the compiler fails."""
    sources = [*SKETCH_DIR.glob("*.cpp"), *(SKETCH_DIR / "pc").glob("*.cpp")]
    headers = [*SKETCH_DIR.glob("*.h"), *(SKETCH_DIR / "pc").glob("*.h")]
    return compiled(
        "stage",
        [*sources, *headers],
        [gxx, *flags, "-o", "{folder}/stage", *map(str, sorted(sources))],
        (
            "the sources were changed, or the compiler is too old",
            "correct them, or use the Python stand-in: --python",
        ),
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = command_line("polysight.simulators.stage", str(__doc__), "--config instrument.toml --link out/ttySTAGE")
    p.add_argument("--config", type=Path, required=True, metavar="FILE", help="rig file, instrument.toml")
    p.add_argument("--wires", type=Path, metavar="SOCKET", help="hub of the simulated wires; without it no edges")
    p.add_argument("--link", type=Path, required=True, metavar="PATH", help="name of the serial port to make")
    p.add_argument("--time-scale", type=float, default=1.0, metavar="X", help="motion runs X times the wall clock")
    p.add_argument("--boot-ms", type=int, default=BOOT_MS, metavar="N", help="reset to banner, wall time")
    p.add_argument("--python", action="store_true", help="the Python stand-in, even where a C++ compiler exists")
    return p


def main(argv: list[str] | None = None) -> int:
    """Run until SIGTERM or SIGINT."""
    p = parser()
    args = p.parse_args(argv)
    if not args.time_scale > 0:
        p.error("--time-scale must be positive")
    die_with_parent()
    try:
        rig = load_instrument(args.config)
        gxx = None if args.python else compiler()
        if gxx is not None:
            program = str(build(gxx))
            command = [program, "--link", str(args.link), "--time-scale", repr(args.time_scale)]
            command += ["--boot-ms", str(args.boot_ms), "--trigger-line", str(rig.pi.trigger_in)]
            command += ["--steps-per-mm", repr(rig.stage.steps_per_mm)]
            command += ["--wires", str(args.wires)] if args.wires else []
            os.execv(program, command)
        if not args.python:
            sys.stderr.write("stage: no C++ compiler or no sketch here: the Python stand-in runs instead\n")
        stop = stop_requested()
        wires = WireClient(args.wires) if args.wires else None
        port = SerialPort(args.link)
        try:
            announce_ready(str(args.link))
            stage = PythonStage(Rig(rig.stage.steps_per_mm, rig.pi.trigger_in))
            serve(stage, port, wires, args.time_scale, args.boot_ms, stop)
        finally:
            port.close()
    except PolysightError as e:
        sys.stderr.write(f"stage: {e}\n")
        return e.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
