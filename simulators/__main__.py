"""`python -m simulators simulate SCENE.toml --out DIR`: raw data of a scene, with its truth.json."""

from __future__ import annotations

import sys

from shared.errors import PolysightError
from simulators import simulate
from simulators._process import command_line


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns the exit status."""
    example = "simulate examples/metal-plate.toml --out out/plate"
    parser = command_line("simulators", "Stand-ins for everything that is not there.", example)
    commands = parser.add_subparsers(dest="command", required=True)
    text = "raw data of a scene, without sockets"
    sub = commands.add_parser(
        "simulate", help=text, description=text, epilog=parser.epilog, formatter_class=parser.formatter_class
    )
    simulate.add_arguments(sub)
    args = parser.parse_args(argv)
    try:
        return simulate.run(args)
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status


if __name__ == "__main__":
    sys.exit(main())
