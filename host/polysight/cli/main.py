"""The program `polysight`: parse the command line and run one command. Exit status 0 only when it worked.

Only the module of the command is imported, so that every command starts at once. Errors go to stderr: what happened,
why, and what to do.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from polysight.cli.options import CommandParser, describe, joined
from polysight_shared import __version__
from polysight_shared.errors import PolysightError, os_error

FAMILIES = {
    "rig": (
        *("demo", "simulate", "reproduce"),
        *("plan", "doctor", "card", "inspect", "radar", "scan", "resume", "validate", "drop-raw"),
    ),
    "serve": ("serve", "preview", "scans", "note", "ask", "probe", "compare"),
    "process": ("process", "image", "focus", "sync-report", "calibrate", "leakage"),
    "materials": ("materials", "report", "permittivity", "concentration", "classify", "train", "export", "label"),
}
"""Module of this package to the commands that it adds, in the order of the help."""


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """The command line: of one command's family, or of all of them when it is not known."""
    parser = argparse.ArgumentParser(
        prog="polysight",
        description="See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  polysight demo --out out/demo\n\n`polysight COMMAND --help` says more about a command.",
    )
    parser.add_argument("--version", action="version", version=f"polysight {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandParser)

    def add(
        name: str, run: Callable[[argparse.Namespace], int], text: str, example: str, most_used: tuple[str, ...] = ()
    ) -> CommandParser:
        sub = commands.add_parser(name, help=text)
        describe(sub, text, example)
        sub.set_defaults(run=run)
        sub.most_used = most_used
        return sub

    wanted = [family for family, names in FAMILIES.items() if command in names]
    for family in wanted or FAMILIES:
        import_module(f"polysight.cli.{family}").add_commands(add)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = joined(sys.argv[1:] if argv is None else argv)
    args = build_parser(words[0] if words else None).parse_args(words)
    # Two BLAS threads on two busy cores wait for each other in a spin: ten times slower than one thread each.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends as cleanly as Ctrl-C
    try:
        return args.run(args)
    except PolysightError as e:
        sys.stderr.write(f"polysight {args.command}: {e}\n")
        return e.exit_status
    except KeyboardInterrupt:
        sys.stderr.write(f"polysight {args.command}: stopped\n")
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # Whoever read our output has enough; nothing must be flushed to it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as e:
        error = os_error(e)
        sys.stderr.write(f"polysight {args.command}: {error}\n")
        return error.exit_status
