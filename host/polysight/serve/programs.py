"""Programs that the page starts, and the queue of scans that wait for the rig.

A program is a command of `polysight`, a process that outlives page and server. It runs in a session of its own, with
its output in `<folder>/program/<kind>.log`, its process number in `<kind>.json` and finally its exit status in
`<kind>.status`, where another server finds them (`find_program`). It is paused and stopped as from a terminal, by files
in `<scan>/control/`; no signal is ever sent to a process number that a file names.

In the queue scans wait one after another over night. Each is a file with its request in `<scans>/.polysight/queue/`, so
that the queue survives a restart of the server. The next one is started when the rig is free. After a scan that did not
finish, even if a person started it, the queue waits for a person: what stopped one scan may stop all of them, or
somebody works at the rig.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from polysight.acquisition import read_start_ticks
from polysight.catalogue import PROGRAM_FOLDER, ProgramRecord, find_program, is_plain
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, PolysightError, ScanError
from polysight_shared.files import write_atomically

OOM_SCORE = Path("/proc/self/oom_score_adj")
# Shell script that runs a program and records its exit status. Its arguments: $0, the path of the log and status files
# without suffix; $1, the score for the kernel's memory killer; then, after `shift` as "$@", the program's command line.
LAUNCH_SCRIPT = (
    '{ echo "$1" > /proc/self/oom_score_adj; } 2> /dev/null; shift;'
    ' "$@" >> "$0.log" 2>&1 < /dev/null; echo $? > "$0.status"'
)


class Programs:
    """Starts programs with the priority that this process has now: create it before the server lowers its own.

    A scan must not inherit a low priority, or be killed first when memory runs out. Linux has a priority for each
    thread, so one thread that keeps the old one starts all programs. They inherit the score of the memory killer from
    the whole process, and get the old one back.
    """

    def __init__(self) -> None:
        self._oom_score = "0"
        with suppress(OSError):
            self._oom_score = OOM_SCORE.read_text(encoding="ascii").strip()
        self._running: list[int] = []
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="programs")
        # The executor creates its thread, which takes the present priority, with the first job.
        self._thread.submit(self._reap).result()

    def start(self, folder: Path, kind: str, words: Sequence[str | Path]) -> None:
        """Run `polysight WORDS`, with its log in `folder`.

        Raises
        ------
        ScanError
            if a program of this kind is running there.
        DeviceError
            if none can be started.
        """
        self._thread.submit(self._start, folder, kind, words).result()

    def _start(self, folder: Path, kind: str, words: Sequence[str | Path]) -> None:
        """Do the work of `start` in the thread that keeps the old priority; raises as `start`."""
        earlier = find_program(folder, kind)
        if earlier is not None and earlier.running:
            raise ScanError(
                f"{folder}: {kind} runs already", "it was started before", "wait for it, or stop it",
                code=ErrorCode.BUSY,
            )  # fmt: skip
        program_folder = (folder / PROGRAM_FOLDER).absolute()
        _check_place(program_folder, kind)
        try:
            self.launch([sys.executable, "-m", "polysight", *map(str, words)], program_folder / kind)
        except OSError as e:
            raise DeviceError(
                # The error of a full disk has no file name.
                f"{folder}: {kind} cannot be started: {e.filename or program_folder}: {e.strerror or e}",
                "no disk space, no permission, or no memory",
                "remove the cause; or give the same command in a terminal",
            ) from None

    def launch(self, command: Sequence[str], base: Path) -> int:
        """Start one program, and record its process number and start time; returns the number. Raises OSError."""
        self._reap()
        base.parent.mkdir(parents=True, exist_ok=True)
        for suffix in (".status", ".json"):
            base.with_suffix(suffix).unlink(missing_ok=True)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        with base.with_suffix(".log").open("a", encoding="utf-8") as log:
            log.write(f"--- {now} {' '.join(command)}\n")
        shell = ["/bin/sh", "-c", LAUNCH_SCRIPT, str(base), self._oom_score]
        pid = os.posix_spawn(shell[0], [*shell, *command], os.environ, setsid=True)
        self._running.append(pid)
        record = ProgramRecord(pid, read_start_ticks(pid) or 0, list(command), now)
        write_atomically(base.with_suffix(".json"), msgspec.json.encode(record) + b"\n")
        return pid

    def _reap(self) -> None:
        """Let the system forget the programs that have ended."""
        for pid in list(self._running):
            try:
                ended_pid, _ = os.waitpid(pid, os.WNOHANG)
                has_ended = ended_pid != 0
            except ChildProcessError:
                # The system has forgotten it already.
                has_ended = True
            if has_ended:
                self._running.remove(pid)

    def close(self) -> None:
        """End the thread; started programs continue."""
        self._thread.shutdown()


def _check_place(program_folder: Path, kind: str) -> None:
    """Refuse a folder of logs with links, through which other files would be overwritten. Raises DeviceError."""
    files = [program_folder / f"{kind}{suffix}" for suffix in (".json", ".log", ".status")]
    for path in (program_folder, *files):
        if path.is_symlink() or (path != program_folder and path.exists() and not is_plain(path)):
            raise DeviceError(
                f"{path} is a link or not a regular file", "the folder was made by another program",
                "remove it, and find out who made it", code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip


# --- the queue ---

# More than a weekend of scans of two hours each.
MAX_WAITING = 50
# Time between two looks at the scans' states, each of which may start the next scan; chosen.
LOOK_S = 2.0
# States of a scan (`page.status`) after which a person has to look at the rig.
UNFINISHED_STATES = ("stopped", "failed", "lost", "frozen", "damaged")


class WaitingRequests(msgspec.Struct, frozen=True):
    """The names in the queue, the next one first. `held`: why the queue waits for a person, "" while it does not."""

    names: list[str]
    held: str = ""


class Queue:
    """The queue of one server; `start` starts a request, and raises ScanError with `BUSY` while the rig is in use.

    `list_states` gives the states of all scans by name, as lists show them, the newest first.
    """

    def __init__(self, folder: Path, start: Callable[[bytes], None], list_states: Callable[[], dict[str, str]]) -> None:
        self._folder = folder
        self._start = start
        self._list_states = list_states
        self._held = ""
        # Unfinished scans that a person knows of, so that they do not hold the queue: those of the last look, or of the
        # moment at which a person filled an empty queue or released it. None after a start of the server: all
        # unfinished scans but the newest scan, which may have ended while no server ran.
        self._seen: set[str] | None = None
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="queue", daemon=True)
        self._thread.start()

    def waiting(self) -> WaitingRequests:
        """Return the names in the queue, and why it is held."""
        return WaitingRequests([name for name, _ in self._list_requests()], self._held)

    def add(self, name: str, request: bytes) -> None:
        """Add a request at the end. Raises ConfigError if its name waits already, or the queue is full."""
        with self._lock:
            names = [waiting for waiting, _ in self._list_requests()]
            if name in names or len(names) >= MAX_WAITING:
                raise ConfigError(
                    f"{name} cannot be queued", f"it is already in the queue, or the queue has {MAX_WAITING} scans",
                    "wait, or give another name", code=ErrorCode.NAME_TAKEN,
                )  # fmt: skip
            if not names:
                self._seen = self._find_unfinished(self._list_states())
                self._held = ""
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._folder / f"{time.time_ns()}.json", request)

    def remove(self, name: str) -> None:
        """Take a request out of the queue; a name that is not in the queue is no error."""
        with self._lock:
            for waiting, path in self._list_requests():
                if waiting == name:
                    path.unlink(missing_ok=True)

    def release(self) -> None:
        """Continue after a scan that did not finish."""
        with self._lock:
            self._seen = self._find_unfinished(self._list_states())
            self._held = ""

    def _list_requests(self) -> list[tuple[str, Path]]:
        """Return the names and files of the requests, oldest first; files that are not requests are left out."""
        requests = []
        for path in sorted(self._folder.glob("*.json")):
            try:
                requests.append((str(msgspec.json.decode(path.read_bytes())["name"]), path))
            except (OSError, msgspec.MsgspecError, KeyError, TypeError):
                continue
        return requests

    def _run(self) -> None:
        """Try to start the next scan every `LOOK_S` until the queue is closed."""
        while not self._ended.wait(LOOK_S):
            with self._lock:
                self._start_next()

    def _start_next(self) -> None:
        """Start the first request if the rig is free; hold the queue if a scan, or this start, has failed meanwhile."""
        requests = self._list_requests()
        if not requests or self._held:
            return
        name, path = requests[0]
        try:
            states = self._list_states()
            unfinished = self._find_unfinished(states)
            seen_scans = self._seen
            if seen_scans is None:
                newest_scan = next(iter(states), "")
                seen_scans = unfinished - {newest_scan}
            self._seen = unfinished
            # This applies to a scan that a person started, too: the cause of its stop may stop all scans.
            new_scans = sorted(unfinished - seen_scans)
            if new_scans:
                self._held = f"{new_scans[0]}: {states[new_scans[0]]}"
                return
            self._start(path.read_bytes())
        except ScanError as e:
            if e.code is not ErrorCode.BUSY:
                self._held = f"{name}: {e.what}"
            return
        except (PolysightError, OSError) as e:
            self._held = f"{name}: {e}".splitlines()[0]
            return
        path.unlink(missing_ok=True)

    @staticmethod
    def _find_unfinished(states: dict[str, str]) -> set[str]:
        """Return the scans after which a person has to look at the rig."""
        return {name for name, state in states.items() if state in UNFINISHED_STATES}

    def close(self) -> None:
        """Stop starting scans; those in the queue stay there."""
        self._ended.set()
        self._thread.join()
