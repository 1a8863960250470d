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

from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.shared.wires import WireEdge
from polysight.simulators import gpio
from tests.support.paths import REPO
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import Process, run
from tests.support.pi.wires_log import WiresLog
from tests.support.rigs import timed_by_the_program

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
if lacking := gpio.missing():
    pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}", allow_module_level=True)

TRIGGER, SYNC = 26, 22
POINTS = 4


@pytest.fixture
def instrument(instrument):
    """With SYNC_IN on a GPIO line."""
    return timed_by_the_program(instrument)


@pytest.fixture
def rig(instrument, tmp_path):
    """Pulses behind a one-shot: this machine may be too busy for 4 us."""
    replace = msgspec.structs.replace
    pi = replace(instrument.pi, gpio_chip=str(tmp_path / "chip"), one_shot=True)
    burst = replace(instrument.burst, pulses=4, period_us=2000.0)
    return replace(instrument, pi=pi, burst=burst, grid=replace(instrument.grid, columns=POINTS))


@pytest.fixture
def wires(hub):
    log = WiresLog(hub, TRIGGER, SYNC)
    yield log
    log.close()


@pytest.fixture
def chip(rig, hub):
    """Environment of the program."""
    return lambda *faults: gpio.environment(rig.pi.gpio_chip, hub, faults=faults)


class Row:
    """A program that runs a row whose edges come from the test."""

    def __init__(self, process, rig, stage):
        stage.skip = set(range(rig.grid.columns))  # no edges of its own
        stage.pace_s = 0.05
        self.host = HostSide(process.ready[1], process.events[1], rig)
        self.host.accepted(self.host.begin())
        self.host.home()
        self.host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
        self.host.wait(m.RowStarted)

    def finished(self):
        return self.host.wait(m.RowFinished, limit_s=60)


def with_long_bursts(rig):
    """0.8 s: time for the test to do something within one, on a busy machine too."""
    replace = msgspec.structs.replace
    burst = replace(rig.burst, pulses=9, period_us=100_000.0)
    return replace(rig, burst=burst, stage=replace(rig.stage, speed_mm_s=2.0))


def edge(t_us=1):
    return WireEdge(t_us * 1000, TRIGGER, 1), WireEdge(t_us * 1000 + 20_000, TRIGGER, 0)


def test_a_row_is_answered_pulse_by_pulse(rig, write_config, stage, wires, chip):
    """Every edge of the row gets its burst, and the capture events say what is on the wire."""
    stage.pace_s = 0.1
    with Process(write_config(rig), "--stage-port", stage.port, **chip()) as p:
        assert p.ready, p.popen.communicate()
        host = HostSide(p.ready[1], p.events[1], rig)
        assert host.ask(m.Hello()).backend == "gpiod"
        host.accepted(host.begin())
        host.home()
        for take in range(1, 6):  # a machine that was too busy for a row says so, and the row is taken again
            before = len(wires.rises(SYNC))
            done = host.row(0, take)
            captures = [e for e in host.events if isinstance(e, m.Capture) and e.take == take]
            wires.until(lambda: len(wires.rises(SYNC)) - before == done.pulses)  # noqa: B023
            assert sum(c.pulses for c in captures) == done.pulses
            if done.status == "done":
                break
            assert done.fault in (PiFault.EDGE_DURING_BURST, PiFault.PERIOD_TOO_SHORT), done.reason
        assert (done.points, done.edges, done.bursts, done.pulses) == (POINTS, POINTS, POINTS, 4 * POINTS)
        memory = next(x for x in Path(f"/proc/{p.popen.pid}/status").read_text().splitlines() if x.startswith("VmHWM"))
        assert int(memory.split()[1]) < 60_000, f"more than 60 MB: {memory}"
        rises = wires.rises(SYNC)[before:]
        for c, k in zip(captures, range(0, len(rises), 4), strict=True):
            burst = rises[k : k + 4]
            # The program's stamps are from before its call, the chip's from within it.
            assert c.edge_ns < c.first_pulse_ns <= burst[0]
            assert c.last_pulse_ns <= burst[-1] <= c.last_pulse_ns + c.width_max_ns
            assert all(b - a >= 300_000 for a, b in pairwise(burst)), "never closer than the radar allows"
        status, _, err = p.end()
        assert status == 0, err
        assert wires.level(SYNC) == 0
        host.close()


def test_an_overrun_event_buffer_is_fault_103(rig, write_config, stage, wires, chip):
    """While the first burst is sent, more edges come than the kernel keeps: the number of the next one tells."""
    rig = with_long_bursts(rig)
    with Process(write_config(rig), "--stage-port", stage.port, **chip()) as p:
        row = Row(p, rig, stage)
        wires.drive(*edge())
        wires.until(lambda: bool(wires.rises(SYNC)))
        wires.drive(*(e for k in range(1100) for e in edge(1000 + 100 * k)))
        done = row.finished()
        assert (done.status, done.fault) == ("fault", PiFault.EDGE_LOST), done.reason
        assert "76 edges lost" in done.reason  # 1100 came, the newest 1024 were kept
        assert PiFault.EDGE_LOST in [e.number for e in row.host.events if isinstance(e, m.Fault)]
        row.host.close()


def test_an_edge_during_a_burst_is_fault_104(rig, write_config, stage, wires, chip):
    rig = with_long_bursts(rig)
    with Process(write_config(rig), "--stage-port", stage.port, **chip()) as p:
        row = Row(p, rig, stage)
        wires.drive(*edge())
        wires.until(lambda: bool(wires.rises(SYNC)))
        wires.drive(*edge(1000))
        done = row.finished()
        assert (done.status, done.fault, done.bursts) == ("fault", PiFault.EDGE_DURING_BURST, 1), done.reason
        row.host.until_state("ready")  # a row's fault: the row may be taken again
        row.host.close()


def test_a_pulse_that_may_be_too_long_is_fault_105(rig, write_config, stage, wires, chip):
    """Without a one-shot, and with a chip that takes 5 ms to change an output."""
    rig = msgspec.structs.replace(rig, pi=msgspec.structs.replace(rig.pi, one_shot=False))
    with Process(write_config(rig), "--stage-port", stage.port, **chip("slow:5000")) as p:
        row = Row(p, rig, stage)
        wires.drive(*edge())
        done = row.finished()
        assert (done.fault, done.pulses) == (PiFault.PULSE_TOO_LONG, 1)
        capture = next(e for e in row.host.events if isinstance(e, m.Capture))
        assert capture.width_max_ns >= 5_000_000
        wires.until(lambda: wires.level(SYNC) == 0)
        row.host.close()


def test_a_chip_that_vanishes_is_fault_107(rig, write_config, stage, wires, chip):
    with Process(write_config(rig), "--stage-port", stage.port, **chip()) as p:
        row = Row(p, rig, stage)
        wires.drive(*edge())
        row.host.wait(m.Capture)
        p.popen.send_signal(gpio.VANISH)
        done = row.finished()
        assert (done.status, done.fault) == ("fault", PiFault.TRIGGER_LINE_LOST)
        status = row.host.until_state("fault")
        assert "No such device" in status.reason
        assert row.host.ask(m.Home()).number == PiFault.TRIGGER_LINE_LOST
        ended, _, err = p.end()
        assert ended == 0, err
        wires.until(lambda: wires.level(SYNC) == 0)
        row.host.close()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("busy:22", "it is held by 'another-program'"),
        ("busy:26", "it is held by 'another-program'"),
        ("no-edges", "reports no edges"),
        ("denied", "no permission"),
    ],
)
def test_lines_that_cannot_be_had_are_told_with_fault_and_remedy(rig, write_config, stage, chip, fault, words):
    done = run("run", "--config", write_config(rig), "--stage-port", stage.port, **chip(fault))
    assert done.returncode == 5
    assert "fault 107" in done.stderr
    assert words in done.stderr
    assert "do: " in done.stderr


def test_no_such_chip_and_no_such_line(rig, write_config, stage, chip, tmp_path):
    nowhere = msgspec.structs.replace(rig, pi=msgspec.structs.replace(rig.pi, gpio_chip=str(tmp_path / "none")))
    done = run("run", "--config", write_config(nowhere), "--stage-port", stage.port, **chip())
    assert (done.returncode, "no such device" in done.stderr) == (5, True)
    beyond = msgspec.structs.replace(rig, pi=msgspec.structs.replace(rig.pi, trigger_in=60))
    done = run("run", "--config", write_config(beyond), "--stage-port", stage.port, **chip())
    assert (done.returncode, "has no such line" in done.stderr) == (5, True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_outputs_are_low_after_a_signal_inside_a_pulse(rig, write_config, stage, wires, chip, number):
    """The chip takes half a second to change an output: the signal comes while the line is high."""
    with Process(write_config(rig), "--stage-port", stage.port, **chip("slow:500000")) as p:
        row = Row(p, rig, stage)
        wires.drive(*edge())
        wires.until(lambda: wires.level(SYNC) == 1)
        row.host.close()
        status, _, err = p.end(number)
        assert status == (0 if number == signal.SIGTERM else -signal.SIGKILL), err
        wires.until(lambda: wires.level(SYNC) == 0)
        assert len(wires.rises(SYNC)) == 1


CHIP_PROGRAM = """
import os, sys
from datetime import timedelta
from pathlib import Path
import gpiod, msgspec
from polysight.pi_controller.lines import GpiodLines, find_chip
from polysight.shared.config import load_instrument
chip = Path(os.environ["GPIOSHIM_CHIP"])
assert find_chip("pinctrl-bcm2835", gpiod, chip.parent) == str(chip)
rig = load_instrument(Path("instrument.toml"))
pi = msgspec.structs.replace(rig.pi, gpio_chip=str(chip), trigger_bias="pull-up", trigger_debounce_us=2000)
lines = GpiodLines(pi, gpiod)
with gpiod.Chip(str(chip)) as c:
    i, o = c.get_line_info(pi.trigger_in), c.get_line_info(pi.sync_out[0])
print(i.used, i.consumer, i.edge_detection.name, i.bias.name, i.event_clock.name, i.debounce_period, flush=True)
print(o.used, o.consumer, o.direction.name, flush=True)
edge = lines.wait_edge(60)
print("edge", edge.seqno, lines.wait_edge(0.2), flush=True)
lines.close()
"""


def test_settings_reach_the_chip_and_glitches_do_not_reach_us(hub, wires, tmp_path):
    """Bias, debouncing, clock, consumer: read back from the chip. The label finds it, whatever its number."""
    environment = {**os.environ, **gpio.environment(tmp_path / "gpiochip0", hub)}
    process = subprocess.Popen(
        [sys.executable, "-c", CHIP_PROGRAM], stdout=subprocess.PIPE, text=True, cwd=REPO, env=environment
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().split() == [
            "True",
            "polysight",
            "RISING",
            "PULL_UP",
            "MONOTONIC",
            "0:00:00.002000",
        ]
        assert process.stdout.readline() == "True polysight OUTPUT\n"
        wires.drive(WireEdge(0, TRIGGER, 0))
        wires.drive(WireEdge(10_000_000, TRIGGER, 1), WireEdge(10_500_000, TRIGGER, 0))  # 0.5 ms: a glitch
        wires.drive(WireEdge(20_000_000, TRIGGER, 1), WireEdge(25_000_000, TRIGGER, 0))  # 5 ms
        assert process.stdout.readline() == "edge 1 None\n"
    finally:
        process.kill()
        process.communicate()
