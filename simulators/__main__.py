"""`python -m simulators simulate SCENE.toml --out DIR`: raw data of a scene, with its truth.json."""

from __future__ import annotations

import argparse
import sys

from shared.errors import PolysightError
from simulators import simulate


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m simulators", description="Stand-ins for everything that is not there."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    simulate.add_arguments(commands.add_parser("simulate", help="raw data of a scene, without sockets"))
    args = parser.parse_args(argv)
    try:
        return simulate.run(args)
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status


if __name__ == "__main__":
    sys.exit(main())
