"""Each simulated stage runs as a process of its own: its port, its triggers on the simulated wires, and its end."""

import itertools
import os
import signal
import socket
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

from polysight_shared.faults import StageError
from polysight_shared.stage_line import Parameter
from polysight_shared.wires import WireMotion

# A step is 5 um.
UM = 5
# x and y in um at the triggers of the two rows in dialogues/row.txt: 5 points 400 steps apart, at y of 1000 and 1400
# steps, towards larger and towards smaller x.
FIRST_ROW = [(UM * x, UM * 1000) for x in range(20_000, 22_000, 400)]
SECOND_ROW = [(UM * x, UM * 1400) for x in range(21_600, 19_600, -400)]
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


def test_each_trigger_of_rows_over_the_port_has_its_time_position_and_speed(start: Start, speed: float):
    """Every trigger reaches the wires, and just before it, with the same time, the stage's position and speed."""
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        play(driver, Path(__file__).parent / "dialogues" / "row.txt")
    messages = stage.end()
    times = [m.t_ns for m in messages]
    assert times == sorted(times)
    # The Pi's line of the trigger.
    assert {e.line for e in stage.rising} == {26}
    first_row = stage.rising[: len(FIRST_ROW)]
    spacing_ns = [after.t_ns - before.t_ns for before, after in itertools.pairwise(first_row)]
    # Points are 400 steps apart, at 4000 steps/s. 16 us are the most by which a step may wait for an interrupt.
    expected_ns = 400 / 4000 * 1e9
    assert all(abs(spacing - expected_ns) <= 16_000 for spacing in spacing_ns)

    messages_before = [messages[messages.index(e) - 1] for e in stage.rising]
    motions = [m for m in messages_before if isinstance(m, WireMotion)]
    assert [m.t_ns for m in motions] == [e.t_ns for e in stage.rising]
    assert [(m.x_um, m.y_um) for m in motions] == FIRST_ROW + SECOND_ROW
    # The interval of steps is a whole number of timer ticks, so that speeds are rounded: 0.2 per cent are allowed.
    speed_um_s = 4000 * 5
    assert all(abs(abs(m.vx_um_s) - speed_um_s) <= 0.002 * speed_um_s for m in motions)
    assert stage.motions[-1].vx_um_s == 0

    # From each message's position and speed, the position of the next one can be predicted within a step.
    first_trigger_ns = motions[0].t_ns
    last_trigger_ns = motions[len(FIRST_ROW) - 1].t_ns
    row = [m for m in stage.motions if first_trigger_ns <= m.t_ns <= last_trigger_ns]
    for before, after in itertools.pairwise(row):
        predicted_um = before.x_um + before.vx_um_s * (after.t_ns - before.t_ns) * 1e-9
        assert abs(predicted_um - after.x_um) <= UM


def test_opening_the_port_resets_the_stage(start: Start, speed: float):
    """Opening its port resets an Arduino, too. Afterwards a greeting and homing are needed."""
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        assert driver.received.startswith(b"polysight-stage")
        driver.read_replies()
        assert driver.send_command("HELLO").kind == "ok"
    with closing(PortDriver(str(stage.link), speed)) as driver:
        driver.read_replies()
        assert driver.send_command("ENABLE", 1).number == StageError.SEQUENCE
        assert driver.ask_status().integer("homed") == 0
    stage.end()
    assert stage.rising == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_a_simulated_stage_cleanly(start: Start, number: signal.Signals):
    stage = start()
    assert stage.link.is_symlink()
    stage.end(number)


def test_the_stage_ends_when_its_wires_are_closed(start: Start, speed: float):
    stage = start(speed)
    with closing(PortDriver(str(stage.link), speed)) as driver:
        driver.read_replies()
        for command in (("HELLO",), ("SET", Parameter.HEARTBEAT, 20_000), ("ENABLE", 1), ("HOME",)):
            assert driver.send_command(*command).kind == "ok"
        stage.wires.shutdown(socket.SHUT_RDWR)
        stage.process.wait(HANG_S)


def test_a_simulated_stage_ends_with_its_parent(kind: str, tmp_path: Path):
    module, *options = COMMANDS[kind]
    command = [sys.executable, "-m", f"polysight_simulators.{module}", "--config", RIG_FILE, *options]
    assert not outlives_its_parent([*command, "--link", tmp_path / "tty"])


def test_an_emulator_in_lockstep_ends_with_its_parent(uno_programs: tuple[Path, Path]):
    """A killed test run leaves no emulator running, even if the parent ended before the emulator checked."""
    program, image = uno_programs
    # So many cycles take years.
    assert not outlives_its_parent(uno_programs, "rest 1000000000000000\nrun 1000000000000000\n")
    # The emulator is told that the parent of this process is its own. As that is wrong, it believes that its parent has
    # ended.
    not_its_parent = str(os.getppid())
    with subprocess.Popen([program, "--parent", not_its_parent, image], stdin=subprocess.PIPE) as uno:
        assert uno.wait(HANG_S) == 0
