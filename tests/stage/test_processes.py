"""Every simulated stage as a process in its own time: port, banner, wires, signals."""

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from tests.support.paths import RIG_FILE
from tests.support.processes import HANG_S
from tests.support.stage.conversation import play
from tests.support.stage.drivers import PortDriver
from tests.support.stage.processes import COMMANDS, StageProcess, outlives_its_parent

from polysight_shared.wires import WireMotion

# x, y in um at the triggers of dialogues/row.txt
ROW_POINTS = [(5 * x, 5000) for x in range(20_000, 22_000, 400)] + [(5 * x, 7000) for x in range(21_600, 19_600, -400)]
Start = Callable[..., StageProcess]


@pytest.fixture(params=COMMANDS)
def kind(request: pytest.FixtureRequest) -> str:
    """Kind of stage, compiled before a timeout starts."""
    if request.param == "pc":
        request.getfixturevalue("firmware_program")
    elif request.param == "uno":
        request.getfixturevalue("uno_programs")
    return request.param


@pytest.fixture
def speed(kind: str) -> float:
    """Speed relative to real time that a busy machine can emulate."""
    return 4.0 if kind == "uno" else 20.0


@pytest.fixture
def start(kind: str, tmp_path: Path) -> Iterator[Start]:
    """Starts the process at a time scale."""
    with ExitStack() as started:
        yield lambda time_scale=1.0: started.enter_context(closing(StageProcess(tmp_path, kind, time_scale)))


def test_rows_over_the_port(start: Start, speed: float):
    """Every trigger reaches the wires, and just before it, with the same time, the stage's position and speed."""
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        play(driver, Path(__file__).parent / "dialogues" / "row.txt")
    messages = stage.end()
    times = [m.t_ns for m in messages]
    assert times == sorted(times)
    assert {e.line for e in stage.rising} == {26}
    spacing = [b.t_ns - a.t_ns for a, b in itertools.pairwise(stage.rising[:5])]
    # 400 steps at 4000 steps/s
    assert all(abs(s - 100_000_000) <= 16_000 for s in spacing)
    messages_before = [messages[messages.index(e) - 1] for e in stage.rising]
    motions = [m for m in messages_before if isinstance(m, WireMotion)]
    assert [m.t_ns for m in motions] == [e.t_ns for e in stage.rising]
    assert [(m.x_um, m.y_um) for m in motions] == ROW_POINTS
    assert all(abs(abs(m.vx_um_s) - 20_000) <= 40 for m in motions)
    assert stage.motions[-1].vx_um_s == 0
    # The x that each line predicts for the next one is right, to a step.
    row = [m for m in stage.motions if motions[0].t_ns <= m.t_ns <= motions[4].t_ns]
    for a, b in itertools.pairwise(row):
        assert abs(a.x_um + a.vx_um_s * (b.t_ns - a.t_ns) * 1e-9 - b.x_um) <= 5


def test_opening_resets(start: Start, speed: float):
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        assert driver.received.startswith(b"polysight-stage")
        driver.read_replies()
        assert driver.send_command("HELLO").kind == "ok"
    with closing(PortDriver(str(stage.link), speed)) as driver:
        driver.read_replies()
        assert driver.send_command("ENABLE", 1).number == 18
        assert driver.ask_status().integer("homed") == 0
    stage.end()
    assert stage.rising == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly(start: Start, number: signal.Signals):
    stage = start()
    assert stage.link.is_symlink()
    stage.end(number)


def test_the_stage_ends_when_its_wires_are_closed(start: Start, speed: float):
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        driver.read_replies()
        for command in (("HELLO",), ("SET", 1, 20_000), ("ENABLE", 1), ("HOME",)):
            assert driver.send_command(*command).kind == "ok"
        stage.wires.shutdown(2)
        stage.process.wait(HANG_S)


def test_dies_with_its_parent(kind: str, tmp_path: Path):
    module, *options = COMMANDS[kind]
    command = [sys.executable, "-m", f"polysight_simulators.{module}", "--config", RIG_FILE, *options]
    assert not outlives_its_parent([*command, "--link", tmp_path / "tty"])


def test_an_emulator_in_lockstep_dies_with_its_parent(uno_programs: tuple[Path, Path]):
    """A killed test run leaves no emulator running, even if the parent ended before the emulator checked."""
    program, image = uno_programs
    assert not outlives_its_parent(uno_programs, "rest 1000000000000000\nrun 1000000000000000\n")
    with subprocess.Popen([program, "--parent", str(os.getppid()), image], stdin=subprocess.PIPE) as uno:
        assert uno.wait(HANG_S) == 0
