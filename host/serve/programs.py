"""Programs that the page starts: commands of `polysight`, each a process that outlives page and server.

A program's number and log lie in `<folder>/program/`, so that another server finds it again. It is asked to pause or
stop as from a terminal: by files in `<scan>/control/`. No signal is ever sent to a number that a file names.
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

from polysight.host.catalogue import PROGRAM, is_plain, log_tail
from polysight.host.serve import launcher
from polysight.host.serve.launcher import started_ticks
from polysight.shared.errors import DeviceError, ScanError

KINDS = ("scan", "process", "export", "doctor", "train")


@dataclass(frozen=True)
class Program:
    """A program that was started.

    Attributes
    ----------
    kind
        One of `KINDS`.
    running
        Whether it lives.
    status
        Its exit status; None while it lives, or when it was killed before it could say.
    words
        Its command line, from `polysight` on.
    """

    kind: str
    running: bool
    status: int | None
    words: tuple[str, ...]
    started_utc: str
    log: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return self.__dict__ | {"words": list(self.words)}


class Programs:
    """Starts programs, and says how those of a folder are.

    Make it before the server steps back: programs inherit nothing of that (see `launcher`).
    """

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
            when a program of this kind runs there already.
        DeviceError
            when none can be started.
        """
        with self._lock:
            if (found := program_of(folder, kind)) is not None and found.running:
                raise ScanError(f"{folder}: {kind} runs already", "it was started before", "wait for it, or stop it")
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
        """Start nothing more; what runs goes on."""
        for pipe in (self._launcher.stdin, self._launcher.stdout):
            if pipe is not None:
                pipe.close()
        self._launcher.wait(10)


def _check_place(place: Path, kind: str) -> None:
    """Refuse a folder of logs that somebody has made so that other files would be written. Raises DeviceError."""
    files = [place / f"{kind}{suffix}" for suffix in (".json", ".log", ".status", ".part")]
    for path in (place, *files):
        if path.is_symlink() or (path != place and path.exists() and not is_plain(path)):
            raise DeviceError(
                f"{path} is no file of its own",
                "the folder was made by another program",
                "remove it, and look who made it",
            )


def programs_of(folder: Path) -> list[Program]:
    """Every program that was started for a folder, the newest first."""
    found = [program for kind in KINDS if (program := program_of(folder, kind)) is not None]
    return sorted(found, key=lambda p: p.started_utc, reverse=True)


def program_of(folder: Path, kind: str) -> Program | None:
    """One of them; None where none was started."""
    base = folder / PROGRAM / kind
    if (folder / PROGRAM).is_symlink() or not is_plain(base.with_suffix(".json")):
        return None
    try:
        told = json.loads(base.with_suffix(".json").read_text(encoding="utf-8")[:100_000])
        pid, ticks = int(told["pid"]), int(told["ticks"])
        words, began = [str(w) for w in told["words"]], str(told["started_utc"])
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
