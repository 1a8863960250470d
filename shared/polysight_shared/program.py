"""Start of a command: open standard streams, signals that end it without a traceback, an end with its parent."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

# After this time an interrupted command checks again whether a module is still loading (chosen).
_RETRY_S = 0.02
# <linux/prctl.h>
_PR_SET_PDEATHSIG = 1
# SIGALRM: the next check of an interrupted command (`_interrupt`).
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)


def expand_home(words: Sequence[str]) -> list[str]:
    """Put the home folder in the place of `~/` at the start of a word or of an option's value.

    A shell does not expand it in quotes, and in `--out=~/scans`.
    """
    option_or_nothing = r"^((?:-[\w-]*|[\w.]+)=)?"
    return [re.sub(option_or_nothing + "~/", lambda m: f"{m[1] or ''}{Path.home()}/", word) for word in words]


def open_standard_streams() -> None:
    """Open standard streams that the caller has closed (`>&-`) on the null device; let every character be written.

    Python has None in their place. Left closed, the next file that is opened would become standard output. A character
    that the terminal's encoding lacks is written as its escape, as Python does on standard error.
    """
    # The system gives the lowest number that is free.
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def die_with_parent(sig: signal.Signals = signal.SIGTERM) -> None:
    """Request the signal `sig` at the end of the parent process, so that a simulated rig leaves none behind (Linux)."""
    if not sys.platform.startswith("linux"):
        return
    # Imported here, because few programs need it.
    import ctypes

    parent = os.getppid()
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, int(sig), 0, 0, 0)
    # The parent ended before the request was made.
    if os.getppid() != parent:
        os.kill(os.getpid(), sig)


@contextmanager
def interrupts_between_imports() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt in the block; while a module is loading, soon after.

    A compiled module that is interrupted while it loads ends in a traceback, or in a segmentation fault (measured:
    scipy, 1 of 150 starts). A Ctrl-C that the caller ignores stays ignored (`nohup`).
    """
    numbers = [signal.SIGTERM, signal.SIGALRM]
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        numbers.append(signal.SIGINT)
    handlers_before = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in handlers_before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or try again soon while a module is loading."""
    if _is_importing(frame):
        signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
    else:
        signal.default_int_handler(number, frame)


def _is_importing(frame: FrameType | None) -> bool:
    """True if this frame or one of its callers is in Python's import system."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM in this thread until the block ends.

    Around the start of a process: an exception inside a fork is lost, and the new process begins with both blocked,
    until it calls :func:`ignore_interrupts`.
    """
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)


def ignore_interrupts(*numbers: signal.Signals) -> None:
    """Ignore these signals in a new process, which its parent ends; programs that it starts do not ignore them.

    Ctrl-C reaches every process of a terminal. The other interrupts have their default effect.
    """
    for number in _INTERRUPTS:
        signal.signal(number, _do_nothing if number in numbers else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _INTERRUPTS)


def _do_nothing(number: int, frame: FrameType | None) -> None:
    pass


def flush_standard_output() -> None:
    """Write what was printed; after an error nothing is written again at exit. Raises OSError."""
    try:
        sys.stdout.flush()
    except OSError:
        close_standard_output()
        raise


def close_standard_output() -> None:
    """Replace standard output by the null device: what was not written yet is lost."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.close(null)
