"""Options and life of a simulator process: print `ready`, end on SIGTERM or SIGINT, and end with the parent process."""

import argparse
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from polysight_shared.errors import ConfigError, ErrorCode, PolysightError, convert_os_error
from polysight_shared.program import die_with_parent


def make_parser(module: str, description: str, example: str) -> argparse.ArgumentParser:
    """Create a parser for `python -m <module>`, without options; `example` are arguments for the end of its help."""
    return argparse.ArgumentParser(
        prog=f"python -m {module}",
        description=description,
        epilog=f"example:\n  python -m {module} {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def parse_count(text: str) -> int:
    """Parse a whole number of at least 0, of 63 bits. Raises ArgumentTypeError."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 1 << 63:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number, 0 or more")
    return value


def announce_ready(text: str = "") -> None:
    """Print `ready <text>`, for which the parent process waits."""
    sys.stdout.write(f"ready {text}".rstrip() + "\n")
    sys.stdout.flush()


def check_link(link: Path) -> None:
    """Raise ConfigError if a port cannot get this name: the link to it would replace a file, or a real port."""
    if link.exists() and not link.is_symlink():
        raise ConfigError(
            f"--link {link}: exists already",
            "the link to the simulated port would replace it",
            "give another name",
            code=ErrorCode.FILE_EXISTS,
        )


def run_program(run: Callable[[], object]) -> int:
    """Run a program; return its exit status: 0, that of the error (one message on stderr), or 130 after Ctrl-C."""
    try:
        run()
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status
    except OSError as e:
        error = convert_os_error(e)
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    return 0


def run_until_stopped(run: Callable[[threading.Event], object]) -> int:
    """Run a simulator until SIGTERM, SIGINT or the end of the parent process; return the exit status.

    `run` gets an event that is set by the signals.
    """
    stop = catch_stop_signals()
    die_with_parent()
    return run_program(lambda: run(stop))


def catch_stop_signals() -> threading.Event:
    """Return an event that SIGTERM and SIGINT will set. Call it in the main thread."""
    event = threading.Event()

    def stop(_signal: int, _frame: object) -> None:
        event.set()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    return event
