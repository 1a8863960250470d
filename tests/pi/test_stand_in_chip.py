"""`polysight-pi` with the unmodified gpiod bindings, on a stand-in GPIO chip (simulated): faults, signals, death.

Every wait is for a condition; nothing here is asserted on the wall clock.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from tests.support.paths import REPO
from tests.support.pi.program import require_stand_in_chip, run
from tests.support.pi.wires_log import WiresLog

from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.wires import WireEdge
from polysight_simulators import gpio

require_stand_in_chip()

TRIGGER, SYNC = 26, 22
POINTS = 4
replace = msgspec.structs.replace


@pytest.fixture
def rig(gpio_rig):
    """Pulses behind a one-shot: this machine may be too busy for 4 us."""
    burst = replace(gpio_rig.burst, pulses=4, period_us=2000.0)
    grid, pi = replace(gpio_rig.grid, columns=POINTS), replace(gpio_rig.pi, one_shot=True)
    return replace(gpio_rig, pi=pi, burst=burst, grid=grid)


@pytest.fixture
def long_bursts(rig):
    """Bursts of 0.8 s, so that the test can act during a burst on a busy machine."""
    burst = replace(rig.burst, pulses=9, period_us=100_000.0)
    return replace(rig, burst=burst, stage=replace(rig.stage, speed_mm_s=2.0))


@pytest.fixture
def wires(hub):
    log = WiresLog(hub, TRIGGER, SYNC)
    yield log
    log.close()


@pytest.fixture
def in_row(start, stage, hub, wires):
    """Starts the program on a chip with these faults and a row whose edges the test sends; sends the first one."""

    def in_row(rig, *faults):
        program, host = start(rig, **gpio.environment(rig.pi.gpio_chip, hub, faults=faults))
        stage.skip = set(range(rig.grid.columns))  # no edges of its own
        stage.pace_s = 0.05
        host.accepted(host.begin())
        host.home()
        host.start_row()
        host.wait(m.RowStarted)
        wires.drive(*edge())
        return program, host

    return in_row


def edge(t_us=1):
    return WireEdge(t_us * 1000, TRIGGER, 1), WireEdge(t_us * 1000 + 20_000, TRIGGER, 0)


def test_a_row_is_answered_pulse_by_pulse(rig, start, stage, hub, wires):
    """Every edge of the row gets its burst, and the capture events agree with the wire."""
    stage.pace_s = 0.1
    program, host = start(rig, **gpio.environment(rig.pi.gpio_chip, hub))
    assert host.ask(m.Hello()).backend == "gpiod"
    host.accepted(host.begin())
    host.home()
    for take in range(1, 6):  # a machine that was too busy for a row reports so, and the row is retaken
        before = len(wires.rises(SYNC))
        done = host.row(0, take)
        captures = [e for e in host.of(m.Capture) if e.take == take]
        wires.until(lambda: len(wires.rises(SYNC)) - before == done.pulses)  # noqa: B023
        assert sum(c.pulses for c in captures) == done.pulses
        if done.status == "done":
            break
        assert done.fault in (PiFault.EDGE_DURING_BURST, PiFault.PERIOD_TOO_SHORT), done.reason
    assert (done.points, done.edges, done.bursts, done.pulses) == (POINTS, POINTS, POINTS, 4 * POINTS)
    memory = Path(f"/proc/{program.popen.pid}/status").read_text().partition("VmHWM:")[2].split()[0]
    assert int(memory) < 60_000, f"more than 60 MB: {memory} KB"
    rises = wires.rises(SYNC)[before:]
    for c, k in zip(captures, range(0, len(rises), 4), strict=True):
        burst = rises[k : k + 4]
        # The program's stamps are from before its call, the chip's from within it.
        assert c.edge_ns < c.first_pulse_ns <= burst[0]
        assert c.last_pulse_ns <= burst[-1] <= c.last_pulse_ns + c.width_max_ns
        assert all(b - a >= 300_000 for a, b in pairwise(burst)), "never closer than the radar allows"
    status, _, err = program.end()
    assert status == 0, err
    assert wires.level(SYNC) == 0


@pytest.mark.parametrize(
    ("edges", "fault", "lost"),
    [
        ([1000], PiFault.EDGE_DURING_BURST, ""),
        # While the first burst is sent, more edges come than the kernel keeps, the newest 1024.
        ([1000 + 100 * k for k in range(1100)], PiFault.EDGE_LOST, "76 edges"),
    ],
)
def test_edges_during_a_burst_end_the_row_alone(long_bursts, in_row, wires, edges, fault, lost):
    _, host = in_row(long_bursts)
    wires.until(lambda: bool(wires.rises(SYNC)))
    wires.drive(*(e for t_us in edges for e in edge(t_us)))
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault, done.bursts) == ("fault", fault, 1), done.reason
    assert lost in done.reason
    assert host.of(m.Fault)[-1].number == fault
    host.until_state("ready")


def test_a_chip_that_vanishes_is_fault_107(rig, in_row, wires):
    program, host = in_row(rig)
    host.wait(m.Capture)
    program.popen.send_signal(gpio.VANISH)
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault) == ("fault", PiFault.TRIGGER_LINE_LOST)
    assert "No such device" in host.until_state("fault").reason
    assert host.refused(m.Home()) == PiFault.TRIGGER_LINE_LOST
    ended, _, err = program.end()
    assert ended == 0, err
    wires.until(lambda: wires.level(SYNC) == 0)


def test_a_line_in_use_ends_the_program_with_fault_and_remedy(rig, write_config, stage, hub):
    """The other faults of a chip are those of `polysight-pi check` (test_checks.py): the same code opens the lines."""
    environment = gpio.environment(rig.pi.gpio_chip, hub, faults=("busy:22",))
    done = run("run", "--config", write_config(rig), "--stage-port", stage.port, **environment)
    assert done.returncode == 5
    assert all(text in done.stderr for text in ("fault 107", "line 22", "'another-program'", "do: ")), done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_outputs_are_low_after_a_signal_inside_a_pulse(rig, in_row, wires, number):
    """The chip takes half a second to change an output: the signal comes while the line is high."""
    program, _ = in_row(rig, "slow:500000")
    wires.until(lambda: wires.level(SYNC) == 1)
    status, _, err = program.end(number)
    assert status == (0 if number == signal.SIGTERM else -signal.SIGKILL), err
    wires.until(lambda: wires.level(SYNC) == 0)
    assert len(wires.rises(SYNC)) == 1


CHIP_PROGRAM = """
import os, sys
from datetime import timedelta
from pathlib import Path
import gpiod, msgspec
from polysight_pi.lines import GpiodLines, find_chip
from polysight_shared.config import load_instrument
chip = Path(os.environ["GPIOSHIM_CHIP"])
assert find_chip("pinctrl-bcm2835", chip.parent) == str(chip)
rig = load_instrument(Path("instrument.toml"))
pi = msgspec.structs.replace(rig.pi, gpio_chip=str(chip), trigger_bias="pull-up", trigger_debounce_us=2000)
lines = GpiodLines(pi)
with gpiod.Chip(str(chip)) as c:
    i, o = c.get_line_info(pi.trigger_in), c.get_line_info(pi.sync_out[0])
print(i.used, i.consumer, i.edge_detection.name, i.bias.name, i.event_clock.name, i.debounce_period, flush=True)
print(o.used, o.consumer, o.direction.name, flush=True)
edge = lines.wait_edge(60)
print("edge", edge.seqno, lines.wait_edge(0.2), flush=True)
lines.close()
"""


def test_settings_reach_the_chip_and_glitches_do_not_reach_us(hub, wires, tmp_path):
    """Bias, debouncing, clock, consumer: read back from the chip, which is found by its label."""
    environment = {**os.environ, **gpio.environment(tmp_path / "gpiochip0", hub)}
    process = subprocess.Popen(
        [sys.executable, "-c", CHIP_PROGRAM], stdout=subprocess.PIPE, text=True, cwd=REPO, env=environment
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "True polysight RISING PULL_UP MONOTONIC 0:00:00.002000\n"
        assert process.stdout.readline() == "True polysight OUTPUT\n"
        wires.drive(WireEdge(0, TRIGGER, 0))
        wires.drive(WireEdge(10_000_000, TRIGGER, 1), WireEdge(10_500_000, TRIGGER, 0))  # 0.5 ms: a glitch
        wires.drive(WireEdge(20_000_000, TRIGGER, 1), WireEdge(25_000_000, TRIGGER, 0))  # 5 ms
        assert process.stdout.readline() == "edge 1 None\n"
    finally:
        process.kill()
        process.communicate()
