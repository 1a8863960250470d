"""The Pi's program `polysight-pi` as a process, and a recorder of the edges on simulated wires."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from polysight_shared.errors import DeviceError
from polysight_shared.wires import WireClient, WireEdge
from polysight_simulators import gpio
from tests.support.paths import REPO
from tests.support.processes import HANG_S, wait_for

PROGRAM = (sys.executable, "-m", "polysight_pi")


class Process:
    """`polysight-pi run`, with further arguments and environment variables. The object is made when it is ready.

    `ready_line` and `events_line` are the words of its first two lines: `ready` with the address for commands, and
    `events` with that of the events.
    """

    def __init__(
        self, config: Path, *args: object, preexec_fn: Callable[[], None] | None = None, **environment: str
    ) -> None:
        self.popen = subprocess.Popen(
            [*PROGRAM, "run", "--config", str(config), *map(str, args)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=REPO,
            env={**os.environ, **environment},
            preexec_fn=preexec_fn,
        )
        assert self.popen.stdout is not None
        self.ready_line = self.popen.stdout.readline().split()
        self.events_line = self.popen.stdout.readline().split()

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Send a signal and wait for the end; return exit status, stdout and stderr."""
        self.popen.send_signal(number)
        out, err = self.popen.communicate(timeout=HANG_S)
        return self.popen.returncode, out, err

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.communicate(timeout=HANG_S)


def require_stand_in_chip() -> None:
    """Skip the module if the emulated GPIO chip cannot be used on this machine."""
    pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
    if lacking := gpio.list_missing_packages():
        pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}", allow_module_level=True)


def read_resident_bytes(pid: int | str = "self") -> int:
    """Return the resident memory of a process."""
    # The second number of proc_pid_statm(5): resident pages.
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def run(*args: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command of `polysight-pi` to its end."""
    process = subprocess.run(
        [*PROGRAM, *map(str, args)],
        capture_output=True,
        text=True,
        cwd=REPO,
        env={**os.environ, **environment},
    )
    assert "Traceback" not in process.stderr
    return process


class WiresLog:
    """Records every edge on the given GPIO lines of the simulated wires, whose socket is `wires_socket`."""

    def __init__(self, wires_socket: Path, *lines: int) -> None:
        self._client = WireClient(wires_socket, listen=lines)
        self.edges: list[WireEdge] = []
        self._closed = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while not self._closed:
            try:
                message = self._client.receive(0.1)
            except DeviceError:
                return
            if isinstance(message, WireEdge):
                self.edges.append(message)

    def list_rises(self, line: int) -> list[int]:
        """Return the times of a line's rising edges, ns."""
        return [e.t_ns for e in self.edges if e.line == line and e.value]

    def read_level(self, line: int) -> int:
        """Return the last level of a line; 0 before its first edge."""
        return next((e.value for e in reversed(self.edges) if e.line == line), 0)

    def drive(self, *edges: WireEdge) -> None:
        """Put edges on the wires."""
        self._client.send(*edges)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        wait_for(condition, "edges on the wires")

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._client.close()
