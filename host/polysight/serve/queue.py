"""Scans that wait for the rig, one after another over night.

Each is a file with its request in `<scans>/.polysight/queue/`, so that a queue survives a restart of the server. The
next one is started when the rig is free. After a scan that did not finish the queue waits for a person: what stopped
one scan may stop all of them, or somebody works at the rig.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, PolysightError, ScanError
from polysight_shared.files import write_atomically

# More than a weekend of scans of two hours each.
MAX_WAITING = 50
# Time between two attempts to start the next scan.
LOOK_S = 2.0
# States of a scan (`page.status`) after which a person has to look at the rig.
UNFINISHED = ("stopped", "failed", "lost", "frozen", "damaged")


class Waiting(msgspec.Struct, frozen=True):
    """The names in the queue, the next one first. `held`: why the queue waits for a person, "" while it does not."""

    names: list[str]
    held: str = ""


class Queue:
    """The queue of one server; `start` starts a request, and raises ScanError with `BUSY` while the rig is in use.

    `state_of` gives the state of a scan by its name, as lists show it.
    """

    def __init__(self, folder: Path, start: Callable[[bytes], None], state_of: Callable[[str], str]) -> None:
        self._folder = folder
        self._start = start
        self._state_of = state_of
        self._held = ""
        # The last scan that the queue has started.
        self._last = ""
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="queue", daemon=True)
        self._thread.start()

    def waiting(self) -> Waiting:
        """Return the names in the queue, and why it is held."""
        return Waiting([name for name, _ in self._list_requests()], self._held)

    def add(self, name: str, request: bytes) -> None:
        """Add a request at the end. Raises ConfigError if its name waits already, or the queue is full."""
        with self._lock:
            names = [waiting for waiting, _ in self._list_requests()]
            if name in names or len(names) >= MAX_WAITING:
                raise ConfigError(
                    f"{name} cannot be queued", f"it is queued already, or {MAX_WAITING} scans are",
                    "wait, or give another name", code=ErrorCode.NAME_TAKEN,
                )  # fmt: skip
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._folder / f"{time.time_ns()}.json", request)

    def remove(self, name: str) -> None:
        """Take a request out; one that is not there is out already."""
        with self._lock:
            for waiting, path in self._list_requests():
                if waiting == name:
                    path.unlink(missing_ok=True)

    def release(self) -> None:
        """Go on after a scan that did not finish."""
        self._held = ""
        self._last = ""

    def _list_requests(self) -> list[tuple[str, Path]]:
        """Return the names and files of the requests, oldest first; files that are no requests are left out."""
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
        """Start the first request if the rig is free; hold the queue if the last scan, or this start, failed."""
        requests = self._list_requests()
        if not requests or self._held:
            return
        name, path = requests[0]
        try:
            state = "finished"
            if self._last:
                state = self._state_of(self._last)
            if state in UNFINISHED:
                self._held = f"{self._last}: {state}"
                return
            self._start(path.read_bytes())
        except ScanError as e:
            if e.code is not ErrorCode.BUSY:
                self._held = f"{name}: {e.what}"
            return
        except (PolysightError, OSError) as e:
            self._held = f"{name}: {e}".splitlines()[0]
            return
        self._last = name
        path.unlink(missing_ok=True)

    def close(self) -> None:
        """Stop starting scans; those in the queue stay there."""
        self._ended.set()
        self._thread.join()
