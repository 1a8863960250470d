"""The program `polysight`: parse the command line and run one command.

The exit status is 0 only if the command worked, or if the reader of its output has closed the pipe (`| head`).

Only the module of the command is imported, so that every command starts without delay. It is imported after `main` was
called, so that Ctrl-C during the import ends the program without a traceback. Errors go to stderr: what happened, why,
and what to do.
"""

from __future__ import annotations

import os
import signal
import sys

from polysight_shared import __version__

TYPE_CHECKING = False
"""True for a type checker. The same constant of `typing` is not used, because that module takes longer to import than
all modules above together."""

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from polysight.cli.options import CommandParser, Run

FAMILIES = {
    "rig": (
        *("demo", "simulate", "reproduce"),
        *("plan", "doctor", "card", "inspect", "radar", "jog", "scan", "resume", "validate", "drop-raw"),
    ),
    "serve": ("serve", "preview", "scans", "note", "ask", "probe", "compare", "check"),
    "process": ("process", "surface", "image", "focus", "sync-report", "calibrate", "leakage"),
    "materials": ("materials", "report", "permittivity", "concentration", "classify", "train", "export", "label"),
}
"""Module of this package to the commands that it adds, in the order of the help."""


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Build the parser of one command's family, or of all families if the command is not known."""
    import argparse
    from importlib import import_module

    from polysight.cli.options import CommandParser, describe, set_run

    parser = argparse.ArgumentParser(
        prog="polysight",
        description="See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  polysight demo --out out/demo\n\n`polysight COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"polysight {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandParser)

    def add(name: str, run: Run, text: str, example: str, most_used: tuple[str, ...] = ()) -> CommandParser:
        """Add a command: its one-line help `text`, and its options of which `most_used` are shown first."""
        sub = commands.add_parser(name, help=text)
        describe(sub, text, example)
        set_run(sub, run)
        sub.most_used = most_used
        return sub

    families = [family for family, names in FAMILIES.items() if command in names]
    for family in families or FAMILIES:
        import_module(f"polysight.cli.{family}").add_commands(add)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    handler_before = signal.getsignal(signal.SIGINT)
    if handler_before is signal.default_int_handler:
        # Until the modules below are loaded Ctrl-C ends the program immediately, without a traceback.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return _run_safely(sys.argv[1:] if argv is None else argv)
    finally:
        signal.signal(signal.SIGINT, handler_before)


def _run_safely(argv: Sequence[str]) -> int:
    """Run one command; return its exit status, also after an error, whose message goes to stderr."""
    from polysight_shared.program import (
        close_standard_output,
        expand_home,
        interrupts_between_imports,
        open_standard_streams,
    )

    words = expand_home(argv)
    name = " ".join(["polysight", *words[:1]])
    open_standard_streams()
    try:
        with interrupts_between_imports():
            return _run(words)
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: stopped\n")
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # The reader of our output has closed the pipe.
        close_standard_output()
        return 0
    except Exception as e:
        from polysight_shared.errors import PolysightError, convert_os_error

        if isinstance(e, OSError):
            error = convert_os_error(e)
        else:
            error = e
        if not isinstance(error, PolysightError):
            raise
        sys.stderr.write(f"{name}: {error}\n")
        return error.exit_status


def _run(words: list[str]) -> int:
    """Parse the words and run the command; what it printed is written when this returns."""
    from polysight.cli.options import join_negative_values
    from polysight_shared.program import flush_standard_output

    try:
        parser = build_parser(next(iter(words), None))
        args = parser.parse_args(join_negative_values(words))
    except SystemExit:
        flush_standard_output()
        raise
    # On busy cores the threads of BLAS wait for each other in a loop: two threads on two busy cores take ten times as
    # long as one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    status = args.run(args)
    flush_standard_output()
    return status
