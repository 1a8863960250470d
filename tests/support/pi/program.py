"""`polysight-pi` as a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from polysight_simulators import gpio
from tests.support.paths import REPO

PROGRAM = (sys.executable, "-m", "polysight_pi")


class Process:
    """`polysight-pi run`, once it is ready; with further arguments and environment variables."""

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
        self.ready = self.popen.stdout.readline().split()
        self.events = self.popen.stdout.readline().split()

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Its exit status and what else it said."""
        self.popen.send_signal(number)
        out = self.popen.communicate(timeout=60)
        return self.popen.returncode, *out

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.communicate(timeout=60)


def require_stand_in_chip() -> None:
    """Skip the module where the stand-in GPIO chip cannot be used."""
    pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
    if lacking := gpio.missing():
        pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}", allow_module_level=True)


def resident_bytes(pid: int | str = "self") -> int:
    """Memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


def run(*args: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Any command, to its end."""
    done = subprocess.run(
        [*PROGRAM, *map(str, args)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=REPO,
        env={**os.environ, **environment},
    )
    assert "Traceback" not in done.stderr
    return done
