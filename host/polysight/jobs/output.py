"""Output of commands: results and questions on stdout; progress on stderr.

Each step prints one line. The progress of a step with a known number of parts is shown by a bar on a terminal, and
elsewhere by occasional lines.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, TypeVar

from polysight_shared.config import Instrument, load_instrument

if TYPE_CHECKING:
    from polysight.process import Progress

T = TypeVar("T")
# Least time from one line of progress to the next; chosen.
_LINE_S = 5.0


def exit_status(worked: bool) -> int:
    """Exit status of a command: 0 if it worked, else 1."""
    return int(not worked)


def load_rig_file(config: Path | None) -> Instrument | None:
    """Return the rig of a file; None without a file: the rig in the scan's folder is used. Raises ConfigError."""
    if config is None:
        return None
    return load_instrument(config)


def name_scan(scan_id: str, is_simulated: bool) -> str:
    """Return how a scan is named in a text: `scan ID`, or `simulated scan ID`."""
    if is_simulated:
        return f"simulated scan {scan_id}"
    return f"scan {scan_id}"


def print_json(content: Any) -> None:
    """Print a result that programs read, as JSON."""
    sys.stdout.write(json.dumps(content, indent=1) + "\n")


def print_lines(lines: Iterable[str]) -> None:
    """Print a result that people read."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))


def say(step: str) -> None:
    """Print the name of a step that begins. A closed stderr is ignored."""
    with suppress(OSError):
        sys.stderr.write(f"{step} ...\n")
        sys.stderr.flush()


def steps(items: Sequence[T], names: Sequence[str]) -> Iterator[T]:
    """Yield the items, each of which is a step; print the name of a step before it, and its wall time after it.

    Name and time are on two lines, because a step may print lines between them.
    """
    for k, (item, name) in enumerate(zip(items, names, strict=True), 1):
        say(f"[{k}/{len(items)}] {name}")
        started_s = monotonic()
        yield item
        sys.stderr.write(f"[{k}/{len(items)}] {name}: {monotonic() - started_s:.0f} s\n")


def count_steps(items: Iterable[T], total: int, name: str) -> Iterator[T]:
    """Yield the items, and show on a bar how many of `total` are done.

    Without a terminal a line is printed at the start, and after each tenth of the items unless less than 5 s have
    passed since the last line.
    """
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    if console.is_terminal:
        yield from track(items, name, total=total, console=console)
        return
    say(f"{total} {name}")
    printed = monotonic()
    tenth = 0
    for steps_done, item in enumerate(items, 1):
        yield item
        if 10 * steps_done // total > tenth and monotonic() - printed > _LINE_S:
            printed = monotonic()
            tenth = 10 * steps_done // total
            say(f"{steps_done} of {total} {name}")


@contextmanager
def current_step(first: str) -> Iterator[Progress]:
    """Show the current step, beginning with `first`; yield the function that shows the next one.

    It is a status line on a terminal, a line for each step elsewhere.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        with console.status(first) as status:
            yield status.update
    else:
        say(first)
        yield say


def confirm(what: str, word: str, yes: bool) -> str:
    """Print the planned action and return the typed answer, which confirms it if it is `word`.

    With `yes` return `word` without asking. At the end of the input the answer is empty.
    """
    sys.stdout.write(f"{what}\n")
    if yes:
        return word
    sys.stdout.write(f"type {word} to do it: ")
    sys.stdout.flush()
    return sys.stdin.readline().strip()
