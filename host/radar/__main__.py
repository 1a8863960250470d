"""`python -m polysight.host.radar`: one board by itself, for its first days. Not run on hardware yet.

`plan RIG.toml`: constraints and every byte a board would be sent, without touching one. `check RIG.toml BOARD`:
power-up to configured, with what it says of itself. `firmware RIG.toml BOARD IMAGE`: write TI's image to its flash.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from polysight.host.radar.board import RadarBoard
from polysight.host.radar.constraints import constraints, require
from polysight.host.radar.messages import command, encode
from polysight.host.radar.native import open_board
from polysight.host.radar.program import program
from polysight.host.radar.spi import SystemClock
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError, PolysightError


def _plan(rig: Instrument) -> str:
    frames = rig.grid.columns * rig.burst.pulses
    lines = [f"{'holds ' if c.holds else 'BROKEN'}  {c}" for c in constraints(rig, frames)]
    for board in rig.boards:
        lines.append(f"\n{board.name}, sequence numbers from 0:")
        made = program(rig, board)
        for number, sent in enumerate((*made.basic, *made.waveform, *made.frames(frames))):
            raw = encode(command((sent.block(),), sequence=number % 16))
            lines.append(f"  {type(sent).__name__:19} {raw.hex()}")
    return "\n".join(lines) + "\n"


def _board(rig: Instrument, name: str, image: Path | None) -> str:
    if name not in rig.radar.native:
        raise ConfigError(f"radar.native has no board {name!r}", "a typing error", f"one of {sorted(rig.radar.native)}")
    content = b"" if image is None else image.read_bytes()
    words = open_board(rig.radar.native[name].usb_serial)
    board = RadarBoard(name, words, SystemClock(), program(rig, rig.by_name(name)))
    try:
        board.configure(on_power=(lambda: board.download(content)) if content else lambda: None)
        board.read_temperatures()
    finally:
        sys.stdout.write(json.dumps(board.report(), indent=2) + "\n")
        board.close()
    return f"{name}: {board.state.value}\n"


def main() -> int:
    """Run a command; 0 only when it worked."""
    parser = argparse.ArgumentParser(
        prog="python -m polysight.host.radar",
        description=__doc__,
        epilog="example:\n  python -m polysight.host.radar check instrument.toml RH",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("plan", "check", "firmware"), help="what to do; only plan touches no board")
    parser.add_argument("rig", type=Path, metavar="RIG", help='rig file with control = "native"')
    parser.add_argument("board", nargs="?", default="", metavar="BOARD", help="name of the board, e.g. RH")
    parser.add_argument("image", nargs="?", type=Path, metavar="IMAGE", help="TI's firmware image, for firmware")
    args = parser.parse_args()
    if (args.what == "firmware") != (args.image is not None):
        parser.error("firmware needs BOARD and IMAGE, the others no IMAGE")
    try:
        rig = load_instrument(args.rig)
        if not rig.radar.native:
            raise ConfigError(
                f"{args.rig}: no boards under [radar] native",
                f'control is "{rig.radar.control}": something else configures these radars',
                'control = "native", native = { NAME = { usb_serial = "..." } }; see docs/how-to/radar-bring-up.md',
            )
        if args.what != "plan":
            require(rig, rig.grid.columns * rig.burst.pulses)
        told = _plan(rig) if args.what == "plan" else _board(rig, args.board, args.image)
    except (PolysightError, OSError) as e:
        sys.stderr.write(f"{e}\n")
        return e.exit_status if isinstance(e, PolysightError) else 1
    sys.stdout.write(told)
    return 0


if __name__ == "__main__":
    sys.exit(main())
