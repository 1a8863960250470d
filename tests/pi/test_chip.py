"""`polysight-pi` with the unmodified gpiod bindings on a stand-in GPIO chip and SPI controller (simulated).

The stand-ins are built from the kernel's headers and drivers, in C. Every wait is for a condition; nothing here is
asserted on the wall clock.
"""

import ctypes
import json
import os
import re
import resource
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from tests.support.paths import REPO
from tests.support.pi.program import WiresLog, require_stand_in_chip, run
from tests.support.processes import wait_for
from tests.support.rigs import time_by_spi

from polysight_pi.system import OTHERS_PRIORITY, TRIGGER_PRIORITY
from polysight_shared import messages as m
from polysight_shared.errors import DeviceError
from polysight_shared.faults import PiFault
from polysight_shared.wires import WireEdge
from polysight_simulators import gpio

require_stand_in_chip()

# Lines (GPIO numbers) of the published rig: trigger input, output to the radars, and the output of the SPI controller.
TRIGGER = 26
SYNC = 22
MOSI = 10
# An input that the program does not use.
UNUSED = 5
POINTS = 4
replace = msgspec.structs.replace


@pytest.fixture
def rig(gpio_rig):
    """A rig whose pulses get their width from a one-shot: this machine may be too busy for the 4 us allowed without."""
    burst = replace(gpio_rig.burst, pulses=4, period_us=2000.0)
    grid = replace(gpio_rig.grid, columns=POINTS)
    pi = replace(gpio_rig.pi, one_shot=True)
    return replace(gpio_rig, pi=pi, burst=burst, grid=grid)


@pytest.fixture
def long_bursts(rig):
    """Bursts of nine pulses 0.1 s apart, 0.8 s long, so that tests can act within one."""
    burst = replace(rig.burst, pulses=9, period_us=100_000.0)
    return replace(rig, burst=burst, stage=replace(rig.stage, speed_mm_s=2.0))


@pytest.fixture
def wires(hub):
    log = WiresLog(hub, TRIGGER, SYNC, MOSI)
    yield log
    log.close()


@pytest.fixture
def in_row(start, stage, hub, wires):
    """Function that starts the program on a chip with these faults, and a row, and sends the first edge.

    The stage stays before its first point, so that all edges come from the test. Time is that of the wires.
    """

    def in_row(rig, *faults):
        program, host = start(rig, **gpio.environment(rig.pi.gpio_chip, hub, faults=faults, wire_time=True))
        stage.stays_after = 0
        host.must_accept(host.make_begin())
        host.home()
        host.start_row()
        host.wait_for_event(m.RowStarted)
        wires.drive(*make_edge())
        return program, host

    return in_row


# Time of the first edge on the wires, late enough to begin a row.
FIRST_EDGE_NS = 1_000_000_000


def make_edge(t_ns=FIRST_EDGE_NS):
    """Return the rising and the falling change of a trigger pulse, which lasts 20 us."""
    return WireEdge(t_ns, TRIGGER, value=1), WireEdge(t_ns + 20_000, TRIGGER, value=0)


@pytest.mark.parametrize("wire_time", [True, False], ids=["wire time", "real time"])
def test_a_row_is_answered_pulse_by_pulse(rig, start, stage, hub, wires, wire_time):
    """Every edge of the row gets its burst, and the capture events agree with the wire."""
    stage.pace_s = 0.1
    rig = replace(rig, stage=replace(rig.stage, speed_mm_s=2.0))
    program, host = start(rig, **gpio.environment(rig.pi.gpio_chip, hub, wire_time=wire_time))
    assert host.ask(m.Hello()).backend == "gpiod"
    host.must_accept(host.make_begin())
    host.home()
    report = host.run_row(0)
    captures = [c for c in host.list_events(m.Capture) if c.pulses]
    wires.wait_until(lambda: len(wires.list_rises(SYNC)) == report.pulses)
    assert sum(c.pulses for c in captures) == report.pulses
    if wire_time or report.status == "done":
        assert (report.points, report.edges, report.bursts, report.pulses) == (POINTS, POINTS, POINTS, 4 * POINTS)
    else:
        # In real time a machine may be too busy for a row, which is then a fault.
        busy = (PiFault.EDGE_DURING_BURST, PiFault.PERIOD_TOO_SHORT, PiFault.EDGE_TIME)
        assert report.fault in busy, report.reason
    # The program needs 30 to 60 MB (`polysight_pi/system.py`). VmHWM is the most memory that was resident, in kB.
    process_status = Path(f"/proc/{program.popen.pid}/status").read_text()
    (memory_kb,) = re.findall(r"VmHWM:\s+(\d+) kB", process_status)
    assert int(memory_kb) < 60_000
    rises = wires.list_rises(SYNC)
    for c in captures:
        burst = rises[: c.pulses]
        rises = rises[c.pulses :]
        # The program's stamps are from before its call, the chip's from within it.
        assert c.edge_ns < c.first_pulse_ns <= burst[0]
        assert c.last_pulse_ns <= burst[-1] <= c.last_pulse_ns + c.width_max_ns
        # The radar needs 300 us between two pulses.
        assert all(later - earlier >= 300_000 for earlier, later in pairwise(burst))
    status, _, err = program.end()
    assert status == 0, err
    wires.wait_until(lambda: wires.read_level(SYNC) == 0)


def test_an_edge_during_a_burst_ends_the_row_but_not_the_run(long_bursts, in_row, wires):
    _, host = in_row(long_bursts)
    # The burst of the first edge lasts 800 ms.
    wires.drive(*make_edge(FIRST_EDGE_NS + 1_000_000))
    report = host.wait_for_event(m.RowFinished)
    assert (report.status, report.fault, report.bursts) == ("fault", PiFault.EDGE_DURING_BURST, 1), report.reason
    assert host.list_events(m.Fault)[-1].number == PiFault.EDGE_DURING_BURST
    host.wait_for_state("ready")


def test_a_chip_that_vanishes_is_a_lasting_fault_of_the_trigger_line(long_bursts, in_row, wires):
    program, host = in_row(long_bursts)
    host.wait_for_event(m.Capture)
    program.popen.send_signal(gpio.VANISH_SIGNAL)
    report = host.wait_for_event(m.RowFinished)
    assert (report.status, report.fault) == ("fault", PiFault.TRIGGER_LINE_LOST)
    assert "No such device" in host.wait_for_state("fault").reason
    assert host.must_refuse(m.Home()) == PiFault.TRIGGER_LINE_LOST
    ended, _, err = program.end()
    assert ended == 0, err
    wires.wait_until(lambda: wires.read_level(SYNC) == 0)


def test_a_line_in_use_ends_the_program_with_fault_and_remedy(rig, write_config, stage, hub):
    """test_checks.py has the other faults of a chip: the same code opens the lines for `polysight-pi check`."""
    environment = gpio.environment(rig.pi.gpio_chip, hub, faults=("busy:22",))
    process = run("run", "--config", write_config(rig), "--stage-port", stage.port, **environment)
    assert process.returncode == DeviceError.exit_status
    assert all(
        text in process.stderr
        for text in (f"fault {int(PiFault.TRIGGER_LINE_LOST)}", "line 22", "'another-program'", "do: ")
    ), process.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_outputs_are_low_after_a_signal_inside_a_pulse(rig, in_row, wires, number):
    """The call that sets the line high does not return, so that the signal comes while the line is high."""
    program, _ = in_row(rig, "stuck")
    wires.wait_until(lambda: wires.read_level(SYNC) == 1)
    status, _, err = program.end(number)
    expected_status = 0 if number == signal.SIGTERM else -signal.SIGKILL
    assert status == expected_status, err
    wires.wait_until(lambda: wires.read_level(SYNC) == 0)
    assert len(wires.list_rises(SYNC)) == 1


# Opens the trigger line with a pull-up and debouncing, and prints the settings that the chip reports. Then it reads an
# edge, waits for a level on the unused input (its argument) without reading, and prints the number of the next edge.
CHIP_PROGRAM = """
import os, sys, time
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
with gpiod.request_lines(str(chip), {int(sys.argv[1]): gpiod.LineSettings()}) as others:
    while others.get_value(int(sys.argv[1])) == gpiod.line.Value.INACTIVE:
        time.sleep(0.005)
print("then", lines.wait_edge(60).seqno, flush=True)
lines.close()
"""


def test_settings_reach_the_chip_and_glitches_do_not_reach_the_program(hub, wires, tmp_path):
    """Bias, debouncing, clock, consumer: read back from the chip, which is found by its label.

    Of unread edges the kernel keeps the newest 1024; the number of the next one shows how many were lost.
    """
    environment = {**os.environ, **gpio.environment(tmp_path / "gpiochip0", hub)}
    process = subprocess.Popen(
        [sys.executable, "-c", CHIP_PROGRAM, str(UNUSED)], stdout=subprocess.PIPE, text=True, cwd=REPO, env=environment
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "True polysight RISING PULL_UP MONOTONIC 0:00:00.002000\n"
        assert process.stdout.readline() == "True polysight OUTPUT\n"
        wires.drive(WireEdge(0, TRIGGER, 0))
        # 0.5 ms is shorter than the debouncing of 2 ms: a glitch. 5 ms is a pulse.
        wires.drive(WireEdge(10_000_000, TRIGGER, 1), WireEdge(10_500_000, TRIGGER, 0))
        wires.drive(WireEdge(20_000_000, TRIGGER, 1), WireEdge(25_000_000, TRIGGER, 0))
        assert process.stdout.readline() == "edge 1 None\n"
        # 1100 edges that are not read.
        for k in range(1100):
            t_ns = 100_000_000 + k * 10_000_000
            wires.drive(WireEdge(t_ns, TRIGGER, 1), WireEdge(t_ns + 5_000_000, TRIGGER, 0))
        wires.drive(WireEdge(t_ns + 10_000_000, UNUSED, 1))
        # After edge 1, the oldest of the newest 1024.
        assert process.stdout.readline() == f"then {1 + 1100 - 1024 + 1}\n"
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def spi_rig(instrument, tmp_path):
    """The wiring without a one-shot, on a stand-in chip and a stand-in controller."""
    instrument = time_by_spi(instrument)
    devices = {"gpio_chip": str(tmp_path / "chip"), "spi_device": str(tmp_path / "spidev0.0")}
    return msgspec.structs.replace(instrument, pi=msgspec.structs.replace(instrument.pi, **devices))


@pytest.fixture
def start_homed(spi_rig, start):
    """Starts the program with these settings of the controller, begins a run and homes; gives both ends."""

    def start_and_home(hub=None, wire_time=True, **settings):
        environment = gpio.environment(
            spi_rig.pi.gpio_chip, hub, wire_time=wire_time, spi=spi_rig.pi.spi_device, **settings
        )
        program, host = start(spi_rig, **environment)
        host.must_accept(host.make_begin())
        host.home()
        return program, host

    return start_and_home


@pytest.mark.slow
@pytest.mark.parametrize("real_hz", [250e6, 251e6])
def test_every_position_is_a_burst_by_the_controllers_clock(spi_rig, start_homed, hub, wires, real_hz):
    """Pulses on MOSI have the widths and spacing of the controller's real clock; the program assumes 250 MHz.

    The duration of the system call bounds how late the controller began. A faster clock shortens the transfer, which
    hides a delay of up to that difference.
    """
    program, host = start_homed(hub, core_hz=f"250e6,{real_hz:g}")
    # Durations relative to the nominal ones.
    rate = 250e6 / real_hz
    assert host.ask(m.Hello()).backend == "spi"
    report = host.run_row(0)
    assert (report.status, report.timed_by) == ("done", "spi"), report.reason
    status, _, err = program.end()
    assert status == 0, err
    pulses_of_burst = spi_rig.burst.pulses
    pulses_of_row = pulses_of_burst * spi_rig.grid.columns
    period_ns = spi_rig.burst.period_us * 1e3
    # A rise and a fall for each pulse.
    wires.wait_until(lambda: len([e for e in wires.edges if e.line == MOSI]) == 2 * pulses_of_row)
    edges = [e for e in wires.edges if e.line == MOSI]
    rises = edges[::2]
    falls = edges[1::2]
    assert [e.value for e in edges] == [1, 0] * pulses_of_row
    # Times are whole nanoseconds.
    assert all(abs(b.t_ns - a.t_ns - 1000 * rate) <= 1 for a, b in zip(rises, falls, strict=True))
    hidden_ns = (1 - rate) * pulses_of_burst * period_ns
    for i, c in enumerate(host.list_events(m.Capture)):
        burst = rises[i * pulses_of_burst : (i + 1) * pulses_of_burst]
        assert all(abs(b.t_ns - a.t_ns - period_ns * rate) <= 1 for a, b in pairwise(burst))
        assert abs(burst[0].t_ns - c.first_pulse_ns) <= c.jitter_ns + hidden_ns + 1
        assert c.edge_ns < burst[0].t_ns
        assert c.width_max_ns >= 1000 * rate


@pytest.mark.slow
def test_a_run_with_bursts_longer_than_the_buffer_is_refused_and_the_next_one_runs(start_homed, hub):
    """Two pulses 20 ms apart are 20,000 bits, 2.5 kB; spidev has a buffer of 640 bytes here."""
    _, host = start_homed(hub, bufsiz="640")
    refused = host.ask(msgspec.structs.replace(host.make_begin(), pulses=2, period_us=20_000.0, speed_mm_s=5.0))
    assert isinstance(refused, m.Refused)
    assert refused.number == PiFault.BAD_REQUEST
    assert "bufsiz=" in refused.remedy
    assert host.run_row(0).status == "done"


@pytest.mark.slow
def test_a_killed_program_leaves_the_line_low(spi_rig, start_homed, hub, wires, stage):
    """The kernel ends the transfer; its last bits are low."""
    # The stage sends no edge itself.
    stage.skip = set(range(spi_rig.grid.columns))
    program, host = start_homed(hub, wire_time=False)
    host.start_row()
    host.wait_for_event(m.RowStarted)
    wires.drive(WireEdge(1000, TRIGGER, 1), WireEdge(21_000, TRIGGER, 0))
    wires.wait_until(lambda: bool(wires.list_rises(MOSI)))
    program.popen.kill()
    program.popen.wait()
    wires.wait_until(lambda: len(wires.list_rises(MOSI)) == spi_rig.burst.pulses)
    wires.wait_until(lambda: wires.read_level(MOSI) == 0)


@pytest.mark.slow
def test_check_measures_the_clock_and_names_the_buffer_that_the_burst_needs(spi_rig, write_config, hub, wires):
    """The check sends no pulse: the line is low all the time."""

    def read_findings(rig, **settings):
        environment = gpio.environment(rig.pi.gpio_chip, hub, spi=rig.pi.spi_device, exact="1", **settings)
        printed = run("check", "--json", "--config", write_config(rig), **environment).stdout
        return {f["name"]: f for f in json.loads(printed)}

    findings = read_findings(spi_rig)
    assert findings["pulse width"]["verdict"] == "ok"
    assert findings["SYNC_IN line 10"]["verdict"] == "ok"
    for actual in ("400e6", "150e6"):
        finding_of_wrong_clock = read_findings(spi_rig, core_hz=f"250e6,{actual}")["pulse width"]
        assert finding_of_wrong_clock["verdict"] == "fail"
        assert "core_freq" in finding_of_wrong_clock["remedy"]
    longer = replace(spi_rig, burst=replace(spi_rig.burst, pulses=16))
    findings = read_findings(longer, bufsiz="512")
    assert "512 bytes" in findings["SYNC_IN line 10"]["found"]
    assert "options spidev bufsiz=4096" in findings["pulse width"]["remedy"]
    assert not wires.list_rises(MOSI)


# <linux/prctl.h> and <linux/capability.h>.
PR_CAPBSET_DROP = 24
CAP_IPC_LOCK = 14
CAP_SYS_NICE = 23


def may_schedule():
    """True if this user may give a process real-time priority."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def read_priorities(pid):
    """Return the real-time priorities of the threads of a process; threads without one are left out."""
    tasks = [int(t.name) for t in Path(f"/proc/{pid}/task").iterdir()]
    return [os.sched_getparam(t).sched_priority for t in tasks if os.sched_getscheduler(t) == os.SCHED_FIFO]


def test_all_threads_have_real_time_priority_and_the_trigger_thread_the_highest(start, gpio_rig):
    """The threads share the interpreter's lock: a thread that holds it must not be preempted by other programs."""
    if not may_schedule():
        pytest.skip("SCHED_FIFO is not permitted here: run as root, or with RLIMIT_RTPRIO")
    program, _ = start(gpio_rig, **gpio.environment(gpio_rig.pi.gpio_chip))
    # The program is `ready` before its threads run.
    wait_for(lambda: TRIGGER_PRIORITY in read_priorities(program.popen.pid), "the trigger thread")
    thread_priorities = read_priorities(program.popen.pid)
    assert thread_priorities.count(TRIGGER_PRIORITY) == 1
    # At least the threads of the program itself, the stage and the executor.
    assert thread_priorities.count(OTHERS_PRIORITY) >= 3
    _, _, err = program.end()
    assert "real-time" not in err


def test_rights_that_are_missing_are_reported_once_and_the_program_runs(start, gpio_rig):
    def without_rights():
        libc = ctypes.CDLL(None)
        for capability in (CAP_SYS_NICE, CAP_IPC_LOCK):
            # Root has these rights and drops them; other users have none, and the call does nothing.
            libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
        for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
            resource.setrlimit(limit, (0, 0))

    program, _ = start(gpio_rig, preexec_fn=without_rights, **gpio.environment(gpio_rig.pi.gpio_chip))
    status, _, err = program.end()
    assert status == 0
    for text in ("no real-time scheduling", "LimitRTPRIO=99", "memory is not locked", "LimitMEMLOCK=infinity"):
        assert err.count(text) == 1, text
