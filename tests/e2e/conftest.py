"""The whole simulated rig as real processes, and the commands of both halves run as a user runs them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import tomli_w

from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import PolysightError
from polysight.shared.tables import decode, to_builtins
from polysight.simulators.loopback import on_free_subnet
from tests.small_scene import small_scene

REPO = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
LIMIT_S = 60.0
SCENE = small_scene(12, 6, pulses=4, pixels=40, pixel_mm=4.0)
METAL = "0,0,50,50"  # the aperture is too small for the plate to be found by itself


@dataclass
class Ended:
    """A command that has ended."""

    status: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """The one error message, from its `program:` on. Fails when there is a traceback, none, or more than one."""
        assert "Traceback" not in self.err, self.err
        starts = ("polysight ", "error: ", "usage: ")
        begun = [i for i, line in enumerate(self.err.splitlines()) if line.startswith(starts)]
        assert len(begun) == 1, self.err
        return "\n".join(self.err.splitlines()[begun[0] :])


def wait_for(condition: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
    """Return when the condition holds; fail after the limit."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {limit_s} s: {what}"
        time.sleep(0.005)


def processes_naming(text: str) -> dict[int, str]:
    """Command lines of living processes in which `text` occurs."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with suppress(OSError):
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                if text in line:
                    found[int(entry.name)] = line
    return found


class Program:
    """A command in a process group of its own, its output in files."""

    def __init__(self, command: Sequence[str | Path], folder: Path, cwd: Path, env: dict[str, str] | None) -> None:
        self._out, self._err = folder / f"out-{time.monotonic_ns()}", folder / f"err-{time.monotonic_ns()}"
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
        """What it has written to stdout so far."""
        return self._out.read_text(encoding="utf-8")

    @property
    def err(self) -> str:
        """What it has written to stderr so far."""
        return self._err.read_text(encoding="utf-8")

    def interrupt(self) -> None:
        """Ctrl-C: SIGINT to the process group."""
        os.killpg(self.process.pid, signal.SIGINT)

    def wait(self, limit_s: float = LIMIT_S) -> Ended:
        """Its end; fails when it does not come within the limit."""
        try:
            status = self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            self.kill()
            pytest.fail(f"{self.process.args} hangs; it said:\n{self.out}\n{self.err}")
        return Ended(status, self.out, self.err)

    def wait_ready(self) -> str:
        """The rest of its `ready` line."""

        def there() -> bool:
            assert self.process.poll() is None, self.err
            return self.out.startswith("ready ") and "\n" in self.out

        wait_for(there, f"{self.process.args} ready")
        return self.out.partition("\n")[0].removeprefix("ready ")

    def kill(self) -> None:
        """SIGKILL to it alone, as the kernel kills a process."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def end(self) -> None:
        """SIGTERM, and SIGKILL when that does not help."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10.0)
            except subprocess.TimeoutExpired:
                self.kill()
                pytest.fail(f"{self.process.args} does not end on SIGTERM")


class Bench:
    """Starts programs in a folder and ends them all."""

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

    def polysight(self, *arguments: str | Path, limit_s: float = LIMIT_S) -> Ended:
        """Run a command of the host."""
        return self.run("polysight", *arguments, limit_s=limit_s)

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Return when the condition holds; fail after a minute."""
        wait_for(condition, what)

    def processes(self) -> dict[int, str]:
        """Command lines of living processes that name this folder."""
        return processes_naming(str(self.folder))

    def close(self) -> None:
        """End everything, the last one first."""
        for program in reversed(self.programs):
            program.end()


class Rig(Bench):
    """A simulated rig that runs, with its Pi; `scan` and `folder/"rig.toml"` are for the host."""

    def __init__(self, folder: Path, time_scale: float, env: dict[str, str] | None, scene: str) -> None:
        super().__init__(folder)
        self._scene = scene
        self._env = env
        self.config = folder / "rig.toml"
        self._time_scale = time_scale

    def begin(self) -> None:
        """Start the simulators and the Pi."""
        folder = self.folder
        (folder / "scene.toml").write_text(self._scene)
        self.simulators = self.start(
            "python", "-m", "polysight.simulators.rig", "--config", REPO / "instrument.toml",
            "--scene", folder / "scene.toml", "--dir", folder / "rig",
            "--time-scale", str(self._time_scale), env=self._env,
        )  # fmt: skip
        base = Path(self.simulators.wait_ready())
        table = to_builtins(load_instrument(base))
        table["limits"] |= {"command_timeout_s": 1.5, "end_of_record_s": 1.0}
        table["pi"]["heartbeat_ms"] = 100
        self.instrument = decode(table, Instrument, "test")
        self.config.write_text(tomli_w.dumps(table))
        self.pi = self.start_pi()

    def start_pi(self) -> Program:
        """Start the Pi's program; an earlier one has ended."""
        wires = self.folder / "rig" / "wires.sock"
        self.pi = self.start("polysight-pi", "run", "--config", self.config, "--wires", wires)
        self.pi.wait_ready()
        return self.pi

    def scan(self, *more: str) -> Program:
        """Start a scan into `folder`."""
        return self.start("polysight", "scan", "--config", self.config, "--out", self.folder / "scan", *more)

    def wait_mid_row(self, scan: Program, rows: int) -> None:
        """Until so many rows are committed and something of the next one has come."""

        def there() -> bool:
            assert scan.process.poll() is None, f"the scan ended too early: {scan.err}"
            return self.committed() >= rows and self._receiving()

        wait_for(there, f"row {rows} being received")

    def committed(self) -> int:
        """How many rows of the scan are committed."""
        with suppress(PolysightError):  # not begun yet
            return len(ScanFolder.load(self.folder / "scan").committed())
        return 0

    def _receiving(self) -> bool:
        """Whether any byte of a row that is not committed has come; the file is made at its full size, as zeros."""
        with suppress(FileNotFoundError):  # committed this moment
            return any(any(p.read_bytes()[:4096]) for p in self.folder.glob("scan/raw/*/*.part"))
        return False

    def close(self) -> None:
        """End everything; nothing of this rig may live on."""
        super().close()
        left = self.processes()
        assert not left, left


@contextmanager
def running(
    folder: Path, time_scale: float = 40.0, env: dict[str, str] | None = None, scene: str = SCENE
) -> Iterator[Rig]:
    """A simulated rig in `folder` that runs; nothing of it is left afterwards, whatever happened."""
    made = Rig(folder, time_scale, env, scene)
    try:
        made.begin()
        yield made
    finally:
        made.close()


@pytest.fixture(scope="session")
def running_rig() -> Callable[..., AbstractContextManager[Rig]]:
    return running


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with running(tmp_path) as made:
        yield made


@pytest.fixture
def rig_without_compiler(tmp_path: Path) -> Iterator[Rig]:
    with running(tmp_path, env={"PATH": str(tmp_path)}) as made:
        yield made


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def lonely_instrument(tmp_path: Path) -> Instrument:
    """A rig file's content on a free loopback subnet, where nobody answers."""
    table = to_builtins(load_instrument(REPO / "instrument.toml"))
    table["limits"] |= {"command_timeout_s": 0.6}
    table["pi"]["journal_dir"] = str(tmp_path / "journal")
    table["stage"]["port"] = str(tmp_path / "ttyNONE")
    return on_free_subnet(decode(table, Instrument, "lonely"))
