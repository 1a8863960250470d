"""Run commands of the host and of the Pi as a user does: as processes, or faster in the process of the tests."""

import io
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from polysight.cli.main import main
from tests.support.paths import BIN

# A test that waits for something fails when the processor has been idle for this many seconds (see `read_idle_s`).
LIMIT_S = 60.0
# A call that blocks (socket, queue, thread) counts as hanging after this many seconds by the clock, also on a busy
# machine.
HANG_S = 900.0


def read_idle_s() -> float:
    """Return the seconds for which the processor has been idle since the machine started, the mean of its cores.

    Tests limit their waits by idle seconds instead of the clock. On a busy machine a slow program does not reach the
    limit, while a program that hangs leaves the processor idle.
    """
    # The first line of proc_stat(5): after the name the ticks in user, nice, system and idle state.
    ticks = Path("/proc/stat").read_text(encoding="ascii").split(maxsplit=5)[4]
    return int(ticks) / os.sysconf("SC_CLK_TCK") / (os.cpu_count() or 1)


@dataclass
class Ended:
    """A command that has ended."""

    status: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """The error message and the lines after it. Fails if there is a traceback, or not exactly one message."""
        assert "Traceback" not in self.err, self.err
        starts = ("polysight ", "error: ", "usage: ")
        lines = self.err.splitlines()
        first_lines = [number for number, line in enumerate(lines) if line.startswith(starts)]
        assert len(first_lines) == 1, self.err
        return "\n".join(lines[first_lines[0] :])


def wait_for(condition: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
    """Return when the condition holds; fail after `limit_s` idle seconds. `what` describes the condition."""
    deadline = read_idle_s() + limit_s
    while not condition():
        assert read_idle_s() < deadline, f"not within {limit_s} s: {what}"
        time.sleep(0.005)


def list_processes_naming(text: str) -> dict[int, str]:
    """Return the command lines of running processes that have `text` in them, by process id."""
    processes = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with suppress(OSError):
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                if text in line:
                    processes[int(entry.name)] = line
    return processes


def read_output(*arguments: object) -> str:
    """Run a host command in this process, which must succeed; return its stdout."""
    out = io.StringIO()
    with redirect_stdout(out):
        assert main([str(word) for word in arguments]) == 0
    return out.getvalue()


class Program:
    """A command that runs in a process group of its own, and whose output goes to files."""

    def __init__(self, command: Sequence[str | Path], folder: Path, cwd: Path, env: dict[str, str] | None) -> None:
        self._out = folder / f"out-{time.monotonic_ns()}"
        self._err = folder / f"err-{time.monotonic_ns()}"
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [str(word) for word in command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                cwd=cwd,
                env={**os.environ, **(env or {})},
                start_new_session=True,
            )

    @property
    def out(self) -> str:
        """Its stdout so far."""
        return self._out.read_text(encoding="utf-8")

    @property
    def err(self) -> str:
        """Its stderr so far."""
        return self._err.read_text(encoding="utf-8")

    def interrupt(self) -> None:
        """Ctrl-C: SIGINT to the process group."""
        os.killpg(self.process.pid, signal.SIGINT)

    def wait(self, limit_s: float = LIMIT_S) -> Ended:
        """Wait until the program has ended; fail after `limit_s` idle seconds."""
        deadline = read_idle_s() + limit_s
        while (status := self.process.poll()) is None:
            if read_idle_s() > deadline:
                self.kill()
                pytest.fail(f"{self.process.args} hangs; its output:\n{self.out}\n{self.err}")
            time.sleep(0.02)
        return Ended(status, self.out, self.err)

    def wait_ready(self) -> str:
        """Wait until the program prints its line `ready`; return the rest of that line."""

        def is_ready() -> bool:
            assert self.process.poll() is None, self.err
            return self.out.startswith("ready ") and "\n" in self.out

        wait_for(is_ready, f"{self.process.args} ready")
        return self.out.partition("\n")[0].removeprefix("ready ")

    def kill(self) -> None:
        """Send SIGKILL to this process only."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def end(self) -> None:
        """Send SIGTERM. Fails if the program does not end within ten idle seconds, and kills it."""
        if self.process.poll() is None:
            self.process.terminate()
            self.wait(limit_s=10.0)


class Bench:
    """A folder in which programs are started; `close` ends them all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.programs: list[Program] = []

    def start(self, *command: str | Path, env: dict[str, str] | None = None) -> Program:
        """Start a command of this environment's bin folder."""
        program = Program([BIN / command[0], *command[1:]], self.folder, self.folder, env)
        self.programs.append(program)
        return program

    def run(self, *command: str | Path, env: dict[str, str] | None = None, limit_s: float = LIMIT_S) -> Ended:
        """Run a command to its end."""
        return self.start(*command, env=env).wait(limit_s)

    def run_polysight(self, *arguments: str | Path, limit_s: float = LIMIT_S) -> Ended:
        """Run a command of the host."""
        return self.run("polysight", *arguments, limit_s=limit_s)

    def run_here(self, *arguments: str | Path) -> Ended:
        """Run a host command in this process, which saves the second in which a program starts."""
        out = io.StringIO()
        err = io.StringIO()
        # A command may replace the signal handler of this process.
        handler_before = signal.getsignal(signal.SIGTERM)
        try:
            with chdir(self.folder), redirect_stdout(out), redirect_stderr(err):
                status = main([str(word) for word in arguments])
        except SystemExit as e:
            # The parser of arguments ends the program after an error and after its help.
            status = e.code if isinstance(e.code, int) else 1
        finally:
            signal.signal(signal.SIGTERM, handler_before)
        return Ended(status, out.getvalue(), err.getvalue())

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Return when the condition holds, see :func:`wait_for`."""
        wait_for(condition, what)

    def list_processes(self) -> dict[int, str]:
        """Command lines of living processes that name this folder."""
        return list_processes_naming(str(self.folder))

    def close(self) -> None:
        """End all programs, the one that was started last first."""
        for program in reversed(self.programs):
            program.end()
