"""Commands of `polysight` that the page starts, each a process that outlives page and server.

A program's process number and log lie in `<folder>/program/`, where another server finds them. It is paused and stopped
as from a terminal, by files in `<scan>/control/`; no signal is ever sent to a process number that a file names.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import msgspec

from polysight.catalogue import PROGRAM, is_plain, log_tail
from polysight.serve import launcher
from polysight.serve.launcher import started_ticks
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError, ScanError

KINDS = ("scan", "process", "export", "doctor", "train")


class Program(msgspec.Struct, frozen=True):
    """A program that was started: its exit status is None while it runs, and if it was killed."""

    kind: str
    running: bool
    status: int | None
    words: tuple[str, ...]
    started_utc: str
    log: str


class Programs:
    """Starts programs; create it before the server lowers its priority (see `launcher`)."""

    def __init__(self) -> None:
        # As a module it would load all of this server.
        command = [sys.executable, "-I", str(Path(launcher.__file__))]
        self._launcher = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self._lock = threading.Lock()

    def start(self, folder: Path, kind: str, words: Sequence[str | Path]) -> None:
        """Run `polysight WORDS`, with its log in `folder`.

        Raises
        ------
        ScanError
            if a program of this kind is running there.
        DeviceError
            if none can be started.
        """
        with self._lock:
            earlier = find_program(folder, kind)
            if earlier is not None and earlier.running:
                raise ScanError(
                    f"{folder}: {kind} runs already", "it was started before", "wait for it, or stop it",
                    code=ErrorCode.BUSY,
                )  # fmt: skip
            _check_place(folder / PROGRAM, kind)
            base = str((folder / PROGRAM).absolute() / kind)
            command = [sys.executable, "-m", "polysight", *map(str, words)]
            answer = self._ask(json.dumps({"words": command, "cwd": str(Path.cwd()), "base": base}))
        if answer:
            raise DeviceError(
                f"{folder}: {kind} cannot be started: {answer}", "no room, no permission, or no memory",
                "see what it says; the same command works in a terminal",
            )  # fmt: skip

    def _ask(self, request: str) -> str:
        """Send a request to the launcher; return its complaint, "" for none."""
        if self._launcher.stdin is None or self._launcher.stdout is None:
            return "the launcher has no pipes"
        try:
            self._launcher.stdin.write(f"{request}\n")
            self._launcher.stdin.flush()
            line = self._launcher.stdout.readline()
        except OSError as e:
            return str(e)
        return str(json.loads(line)) if line else "the launcher has ended"

    def close(self) -> None:
        """End the launcher; started programs go on."""
        for pipe in (self._launcher.stdin, self._launcher.stdout):
            if pipe is not None:
                pipe.close()
        self._launcher.wait(10)


def _check_place(place: Path, kind: str) -> None:
    """Refuse a folder of logs with links, through which other files would be overwritten. Raises DeviceError."""
    files = [place / f"{kind}{suffix}" for suffix in (".json", ".log", ".status", ".part")]
    for path in (place, *files):
        if path.is_symlink() or (path != place and path.exists() and not is_plain(path)):
            raise DeviceError(
                f"{path} is no file of its own", "the folder was made by another program",
                "remove it, and find out who made it", code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip


def find_programs(folder: Path) -> list[Program]:
    """All programs started for a folder, the newest first."""
    programs = [find_program(folder, kind) for kind in KINDS]
    return sorted((p for p in programs if p is not None), key=lambda p: p.started_utc, reverse=True)


def find_program(folder: Path, kind: str) -> Program | None:
    """The program of a kind that was started last for a folder; None if there is none."""
    base = folder / PROGRAM / kind
    path = base.with_suffix(".json")
    if (folder / PROGRAM).is_symlink() or not is_plain(path):
        return None
    try:
        record = msgspec.json.decode(path.read_bytes()[:100_000], type=launcher.Record)
    except (OSError, ValueError):
        return None
    words = record.words
    if words[1:3] == ["-m", "polysight"]:
        words = ["polysight", *words[3:]]
    running = started_ticks(record.pid) == record.ticks
    status = None if running else _read_status(base.with_suffix(".status"))
    return Program(kind, running, status, tuple(words), record.started_utc, log_tail(base.with_suffix(".log")))


def _read_status(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii")[:8])
    except (OSError, ValueError):
        return None
