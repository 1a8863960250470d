"""The stage as a process: port, banner, wires, signals. Through the pseudo terminal, in real time."""

from __future__ import annotations

import itertools
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from polysight.shared.stage_line import Command, Immediate, Reply
from polysight.shared.wires import WireEdge, WireMessage, WireMotion, parse
from tests.support.paths import REPO, RIG_FILE

LIMIT_S = 60.0


class Wires:
    """The hub's end of the stage's connection."""

    def __init__(self, path: Path) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.settimeout(LIMIT_S)
        self._peer: socket.socket | None = None
        self._data = b""

    def accept(self) -> None:
        self._peer, _ = self._listener.accept()
        self._peer.setblocking(False)

    def messages(self) -> list[WireMessage]:
        """Everything that has come since the start."""
        assert self._peer is not None
        while select.select([self._peer], [], [], 0)[0] and (data := self._peer.recv(1 << 16)):
            self._data += data
        complete, _, _ = self._data.rpartition(b"\n")
        return [parse(line) for line in complete.decode("ascii").splitlines()]

    def close(self) -> None:
        for s in (self._peer, self._listener):
            if s is not None:
                s.close()


class Host:
    """A serial client."""

    def __init__(self, link: Path) -> None:
        self.port = serial.Serial(str(link), 115200, timeout=0.01)
        self.sequence = 0

    def reply(self, *kinds: str, alive: bool = True) -> Reply:
        """The next reply of one of these kinds; others are skipped. Keeps the heartbeat up meanwhile if `alive`."""
        limit = time.monotonic() + LIMIT_S
        asked = 0.0
        while time.monotonic() < limit:
            if alive and time.monotonic() - asked > 0.1:
                asked = time.monotonic()
                self.port.write(bytes([Immediate.STATUS]))
            line = self.port.readline()
            while line and not line.endswith(b"\n"):
                line += self.port.readline()
            if line and (reply := Reply.decode(line)).kind in kinds:
                return reply
        raise AssertionError(f"no {kinds} within {LIMIT_S} s")

    def command(self, verb: str, *args: int) -> Reply:
        self.sequence += 1
        self.port.write(Command(self.sequence, verb, args).encode())
        return self.reply("ok", "error", alive=False)

    def begin_homing(self, heartbeat_ms: int) -> None:
        """After the banner: greet, set up, switch on, home."""
        self.reply("banner", alive=False)
        answers = [self.command("HELLO"), self.command("SET", 1, heartbeat_ms), self.command("ENABLE", 1)]
        assert [r.kind for r in [*answers, self.command("HOME")]] == ["ok"] * 4


class Simulator:
    def __init__(self, folder: Path, extra: list[str], time_scale: float) -> None:
        self.link, self.wires = folder / "ttySTAGE", Wires(folder / "wires")
        command = [
            sys.executable,
            "-m",
            "polysight.simulators.stage",
            "--config",
            str(RIG_FILE),
            "--wires",
        ]
        command += [str(folder / "wires"), "--link", str(self.link), "--time-scale", str(time_scale), *extra]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=REPO)
        assert self.process.stdout is not None
        try:
            self.wires.accept()
            assert select.select([self.process.stdout], [], [], LIMIT_S)[0], "it does not get ready"
            self.announced = self.process.stdout.readline().strip()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate(timeout=LIMIT_S)
        self.wires.close()


Start = Callable[..., Simulator]


@pytest.fixture(params=["firmware", "python"])
def start(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Start]:
    """Starts the process; call with a time scale and further arguments."""
    if request.param == "firmware":
        assert request.getfixturevalue("firmware_program").is_file()  # compiled before a limit runs
    started: list[Simulator] = []

    def go(time_scale: float = 1.0, *extra: str) -> Simulator:
        arguments = ["--boot-ms", "50", *(["--python"] if request.param == "python" else []), *extra]
        started.append(Simulator(tmp_path, arguments, time_scale))
        return started[-1]

    yield go
    for simulator in started:
        simulator.close()


def test_a_row_over_the_port(start: Start):
    rig = start(200.0)
    assert rig.announced == f"ready {rig.link}"
    host = Host(rig.link)
    host.begin_homing(20_000)
    assert host.reply("done", "alarm").kind == "done"
    assert host.command("ROW", 20_000, 400, 60, 1000, 4000).kind == "ok"
    done = host.reply("done", "alarm")
    assert (done.kind, done.integer("points"), done.integer("pulses")) == ("done", 60, 60)
    messages = rig.wires.messages()
    times = [m.t_ns for m in messages]
    assert times == sorted(times)
    rising = [m for m in messages if isinstance(m, WireEdge) and m.value == 1]
    assert len(rising) == 60
    assert {m.line for m in rising} == {26}
    assert {b.t_ns - a.t_ns for a, b in itertools.pairwise(rising)} == {100_000_000}
    assert isinstance(messages[-1], WireMotion)
    assert messages[-1].vx_um_s == 0
    host.port.close()


def test_opening_resets(start: Start):
    rig = start(200.0)
    host = Host(rig.link)
    host.begin_homing(20_000)
    assert host.reply("done", "alarm").kind == "done"
    host.port.close()
    host = Host(rig.link)
    host.reply("banner", alive=False)
    assert host.command("ENABLE", 1).number == 18
    status = host.reply("status")
    assert status.integer("homed") == 0
    host.port.close()


def test_silent_host_stops_the_stage(start: Start):
    """The heartbeat counts wall time, however fast the motion runs."""
    rig = start(1.0)
    host = Host(rig.link)
    host.begin_homing(60)
    assert host.reply("alarm", "done", alive=False).number == 11
    assert [m for m in rig.wires.messages() if isinstance(m, WireMotion)][-1].vx_um_s == 0
    host.port.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly(start: Start, number: signal.Signals):
    rig = start()
    assert rig.link.is_symlink()
    rig.process.send_signal(number)
    assert rig.process.wait(LIMIT_S) == 0
    assert not rig.link.is_symlink()


def test_ends_when_the_wires_are_gone(start: Start):
    rig = start(100.0)
    host = Host(rig.link)
    host.begin_homing(20_000)
    rig.wires.close()
    assert rig.process.wait(LIMIT_S) != 0
    assert "wires" in rig.process.communicate()[1]
    host.port.close()


def test_dies_with_its_parent(tmp_path: Path):
    wires = Wires(tmp_path / "wires")
    program = (
        "import subprocess, sys, time\n"
        "command = [sys.executable, '-m', 'polysight.simulators.stage', *sys.argv[1:]]\n"
        "p = subprocess.Popen(command, stdout=subprocess.PIPE)\n"
        "p.stdout.readline()\nprint(p.pid, flush=True)\ntime.sleep(600)\n"
    )
    arguments = ["--config", str(RIG_FILE), "--wires", str(tmp_path / "wires"), "--link"]
    parent = subprocess.Popen(
        [sys.executable, "-c", program, *arguments, str(tmp_path / "tty")], stdout=subprocess.PIPE, text=True, cwd=REPO
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    wires.accept()
    parent.kill()
    parent.communicate()
    limit = time.monotonic() + LIMIT_S
    while _lives(child) and time.monotonic() < limit:
        time.sleep(0.02)
    wires.close()
    assert not _lives(child)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
