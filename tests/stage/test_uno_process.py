"""The emulated UNO as a process at real time: port, reset on opening, trigger edges and motion on the wires."""

from __future__ import annotations

import itertools
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from polysight.shared.wires import WireEdge, WireMessage, WireMotion, parse
from tests.support.paths import REPO, RIG_FILE

SPEED = 4.0
LIMIT_S = 60.0
# x, y in um at the triggers of dialogues/row.txt
ROW_POINTS = [(5 * x, 5000) for x in range(20_000, 22_000, 400)] + [(5 * x, 7000) for x in range(21_600, 19_600, -400)]
# A host that homes, starts a row, and keeps the heartbeat up until it is killed. Its heartbeat may be silent for six
# seconds of the board, three of a busy machine's; the default's half second is tested in lockstep. A board that is
# reset late (it sees that its port was opened when it is scheduled) hears nothing meanwhile: HELLO is said again.
PEER = """
import os, select, sys, threading, time
from polysight.shared.stage_line import Command
port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
def until(word, wait_s=60):
    seen, limit = b"", time.monotonic() + wait_s
    while word not in seen:
        if time.monotonic() > limit or b"alarm:" in seen:
            raise TimeoutError(f"no {word!r} in {seen[-2000:]!r}")
        if select.select([port], [], [], 0.1)[0]:
            seen += os.read(port, 1)
def beat():
    while True:
        os.write(port, b"\\x84")
        time.sleep(0.02)
def ask(n, verb, *args, wait_s=60):
    os.write(port, Command(n, verb, args).encode())
    until(b"ok N%d" % n, wait_s)
def greet():
    for _ in range(60):
        try:
            return ask(1, "HELLO", wait_s=1)
        except TimeoutError:
            pass
    raise TimeoutError("the board does not answer HELLO")
until(b"polysight-stage"), until(b"\\n")  # the whole line: a board that is still starting hears nothing
greet(), ask(2, "SET", 1, 6000)
threading.Thread(target=beat, daemon=True).start()
ask(3, "ENABLE", 1), ask(4, "HOME"), until(b"done N4")
ask(5, "ROW", 3000, 100, 400, 0, 4000)
print("row", flush=True)
time.sleep(600)
"""


class Board:
    """`python -m polysight.simulators.uno` with a listener at its wires, who keeps all that comes."""

    def __init__(self, folder: Path, time_scale: float) -> None:
        self.port = folder / "tty"
        self.messages: list[WireMessage] = []
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind(str(folder / "wires"))
            listener.listen()
            listener.settimeout(LIMIT_S)
            command = [sys.executable, "-m", "polysight.simulators.uno", "--config", str(RIG_FILE)]
            command += ["--wires", str(folder / "wires"), "--link", str(self.port), "--time-scale", str(time_scale)]
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPO)
            self._wires, _ = listener.accept()
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == f"ready {self.port}\n"
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        with self._wires, self._wires.makefile("r", encoding="ascii") as lines:
            for line in lines:
                self.messages.append(parse(line))

    @property
    def rising(self) -> list[WireEdge]:
        return [e for e in self.messages if isinstance(e, WireEdge) and e.value]

    @property
    def motions(self) -> list[WireMotion]:
        return [m for m in self.messages if isinstance(m, WireMotion)]

    def end(self) -> list[WireMessage]:
        """SIGTERM; everything it has told."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(LIMIT_S) == 0
        self._listener.join(LIMIT_S)
        assert not self.port.is_symlink()
        return self.messages

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self._listener.join(LIMIT_S)


@pytest.fixture
def board(uno_programs: tuple[Path, Path], tmp_path: Path) -> Iterator[Callable[[float], Board]]:
    """Starts a board at so many times real time."""
    made: list[Board] = []

    def make(time_scale: float) -> Board:
        made.append(Board(tmp_path, time_scale))
        return made[-1]

    assert all(path.is_file() for path in uno_programs)
    yield make
    for one in made:
        one.close()


def test_opening_resets(board: Callable[[float], Board], port_driver):
    """The driver for a real port, on a port that behaves like one."""
    uno = board(SPEED)
    driver = port_driver(str(uno.port), SPEED)
    assert driver.received.startswith(b"polysight-stage")
    driver.replies()
    driver.command("HELLO")
    driver.close()
    driver = port_driver(str(uno.port), SPEED)
    driver.replies()
    assert driver.command("ENABLE", 1).number == 18
    driver.close()
    uno.end()
    assert uno.rising == []


def test_a_row_at_real_time(board: Callable[[float], Board], port_driver, conversation):
    """Every trigger reaches the wires, and just before it, with the same time, where the stage is and how fast."""
    uno = board(SPEED)
    driver = port_driver(str(uno.port), SPEED)
    conversation.play(driver, REPO / "tests" / "stage" / "dialogues" / "row.txt")
    driver.close()
    messages = uno.end()
    times = [m.t_ns for m in messages]
    assert times == sorted(times)
    assert {e.line for e in uno.rising} == {26}
    spacing = [b.t_ns - a.t_ns for a, b in itertools.pairwise(uno.rising[:5])]
    assert all(abs(s - 100_000_000) <= 16_000 for s in spacing)  # 400 steps at 4000 steps/s
    before = [messages[messages.index(e) - 1] for e in uno.rising]
    at = [m for m in before if isinstance(m, WireMotion)]
    assert [m.t_ns for m in at] == [e.t_ns for e in uno.rising]
    assert [(m.x_um, m.y_um) for m in at] == ROW_POINTS
    assert all(abs(abs(m.vx_um_s) - 20_000) <= 40 for m in at)
    assert uno.motions[-1].vx_um_s == 0
    # What each line promises of x comes true at the next one, to a step.
    row = [m for m in uno.motions if at[0].t_ns <= m.t_ns <= at[4].t_ns]
    for a, b in itertools.pairwise(row):
        assert abs(a.x_um + a.vx_um_s * (b.t_ns - a.t_ns) * 1e-9 - b.x_um) <= 5


def test_the_peer_is_killed_in_the_middle_of_a_row(board: Callable[[float], Board]):
    """The stage comes to rest with alarm 11 and gives no trigger any more. How soon: test_uno_timing.py."""
    uno = board(2.0)
    port = os.open(uno.port, os.O_RDWR | os.O_NOCTTY)  # resets the board; the peer's opening does not any more
    with subprocess.Popen([sys.executable, "-c", PEER, str(uno.port)], stdout=subprocess.PIPE, cwd=REPO) as peer:
        try:
            assert peer.stdout is not None
            assert peer.stdout.readline() == b"row\n"
            limit = time.monotonic() + LIMIT_S
            while len(uno.rising) < 20:
                assert time.monotonic() < limit
                time.sleep(0.01)
        finally:
            peer.kill()
    said = b""
    while b"alarm:11" not in said:
        assert select.select([port], [], [], LIMIT_S)[0], said
        said += os.read(port, 4096)
    given = len(uno.rising)
    time.sleep(0.2)
    os.close(port)
    uno.end()
    assert 20 <= len(uno.rising) == given < 400
    assert uno.motions[-1].vx_um_s == 0


def test_dies_with_its_parent_in_the_middle_of_a_run(uno_programs: tuple[Path, Path]):
    """A killed test run leaves no emulator behind that eats a core."""
    program = (
        "import subprocess, sys, time\n"
        "p = subprocess.Popen(sys.argv[1:], stdin=subprocess.PIPE, stdout=subprocess.PIPE)\n"
        "p.stdout.readline()\n"  # it has started: before that it cannot know its parent
        "p.stdin.write(b'rest 1000000000000000\\nrun 1000000000000000\\n')\n"
        "p.stdin.flush()\nprint(p.pid, flush=True)\ntime.sleep(600)\n"
    )
    command = [sys.executable, "-c", program, *map(str, uno_programs)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    limit = time.monotonic() + 20
    while _runs(child) and time.monotonic() < limit:
        time.sleep(0.02)
    assert not _runs(child)


def test_ends_when_its_parent_was_gone_before_it_asked(uno_programs: tuple[Path, Path]):
    """Between starting it and its asking the kernel to be told, the parent may end."""
    program, image = map(str, uno_programs)
    somebody_else = str(os.getppid())
    with subprocess.Popen([program, "--parent", somebody_else, image], stdin=subprocess.PIPE) as uno:
        assert uno.wait(LIMIT_S) == 0


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
