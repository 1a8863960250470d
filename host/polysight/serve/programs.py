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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polysight.catalogue import PROGRAM, is_plain, log_tail
from polysight.serve import launcher
from polysight.serve.launcher import started_ticks
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError, ScanError

KINDS = ("scan", "process", "export", "doctor", "train")


@dataclass(frozen=True)
class Program:
    """A program that was started: its exit status is None while it runs, and if it was killed."""

    kind: str
    running: bool
    status: int | None
    words: tuple[str, ...]
    started_utc: str
    log: str

    def to_dict(self) -> dict[str, Any]:
        """As plain data for JSON."""
        return self.__dict__ | {"words": list(self.words)}


class Programs:
    """Starts programs; create it before the server lowers its priority (see `launcher`)."""

    def __init__(self) -> None:
        command = [sys.executable, "-I", str(Path(launcher.__file__))]  # as a module it would load all of this server
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
            if (found := program_of(folder, kind)) is not None and found.running:
                raise ScanError(
                    f"{folder}: {kind} runs already",
                    "it was started before",
                    "wait for it, or stop it",
                    code=ErrorCode.BUSY,
                )
            _check_place(folder / PROGRAM, kind)
            base = str((folder / PROGRAM).absolute() / kind)
            words = [sys.executable, "-m", "polysight", *map(str, words)]
            answer = self._ask({"words": words, "cwd": str(Path.cwd()), "base": base})
        if answer:
            raise DeviceError(
                f"{folder}: {kind} cannot be started: {answer}", "no room, no permission, or no memory",
                "see what it says; the same command works in a terminal",
            )  # fmt: skip

    def _ask(self, request: dict[str, Any]) -> str:
        stdin, stdout = self._launcher.stdin, self._launcher.stdout
        if stdin is None or stdout is None:
            return "the launcher has no pipes"
        try:
            stdin.write(json.dumps(request) + "\n")
            stdin.flush()
            line = stdout.readline()
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
                f"{path} is no file of its own",
                "the folder was made by another program",
                "remove it, and find out who made it",
                code=ErrorCode.PATH_OUTSIDE,
            )


def programs_of(folder: Path) -> list[Program]:
    """All programs started for a folder, the newest first."""
    found = [program for kind in KINDS if (program := program_of(folder, kind)) is not None]
    return sorted(found, key=lambda p: p.started_utc, reverse=True)


def program_of(folder: Path, kind: str) -> Program | None:
    """The program of a kind that was started last for a folder; None if there is none."""
    base = folder / PROGRAM / kind
    if (folder / PROGRAM).is_symlink() or not is_plain(base.with_suffix(".json")):
        return None
    try:
        record = json.loads(base.with_suffix(".json").read_text(encoding="utf-8")[:100_000])
        pid, ticks = int(record["pid"]), int(record["ticks"])
        words, began = [str(w) for w in record["words"]], str(record["started_utc"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    running = started_ticks(pid) == ticks
    status = None if running else _status(base.with_suffix(".status"))
    shown = ["polysight", *words[3:]] if words[1:3] == ["-m", "polysight"] else words
    return Program(kind, running, status, tuple(shown), began, log_tail(base.with_suffix(".log")))


def _status(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii")[:8])
    except (OSError, ValueError):
        return None
