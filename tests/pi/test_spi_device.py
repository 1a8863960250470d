"""`polysight-pi` with an SPI controller: its own code, the real gpiod bindings, and a stand-in for spidev (simulated).

The stand-in is built from the kernel's header and drivers, in C: it knows transfers, and nothing of bursts.
"""

from __future__ import annotations

import json
from itertools import pairwise

import msgspec
import pytest
from tests.support.pi.program import require_stand_in_chip, run
from tests.support.pi.wires_log import WiresLog

from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.wires import WireEdge
from polysight_simulators import gpio

require_stand_in_chip()

MOSI, TRIGGER = 10, 26
pytestmark = pytest.mark.slow


@pytest.fixture
def rig(instrument, tmp_path):
    """The shipped wiring, on a stand-in chip and a stand-in controller."""
    assert instrument.pi.wiring == "spi"
    devices = {"gpio_chip": str(tmp_path / "chip"), "spi_device": str(tmp_path / "spidev0.0")}
    return msgspec.structs.replace(instrument, pi=msgspec.structs.replace(instrument.pi, **devices))


@pytest.fixture
def wires(hub):
    log = WiresLog(hub, TRIGGER, MOSI)
    yield log
    log.close()


@pytest.fixture
def homed(rig, start):
    """Starts the program with these settings of the controller, begins a run and homes; gives both ends."""

    def homed(hub=None, wire_time=True, **settings):
        environment = gpio.environment(rig.pi.gpio_chip, hub, wire_time=wire_time, spi=rig.pi.spi_device, **settings)
        program, host = start(rig, **environment)
        host.accepted(host.begin())
        host.home()
        return program, host

    return homed


def test_every_position_is_a_burst_by_the_controllers_clock(rig, homed, hub, wires):
    """Bits on MOSI with the widths and spacing of the real clock, here 0.4 % fast: the program believes 250 MHz."""
    program, host = homed(hub, core_hz="250e6,251e6")
    rate = 1 / 1.004
    assert host.ask(m.Hello()).backend == "spi"
    done = host.row(0)
    assert (done.status, done.timed_by) == ("done", "spi"), done.reason
    status, _, err = program.end()
    assert status == 0, err
    n, period_ns = rig.burst.pulses, rig.burst.period_us * 1e3
    wires.until(lambda: len([e for e in wires.edges if e.line == MOSI]) == 2 * n * rig.grid.columns)
    pulses = [e for e in wires.edges if e.line == MOSI]
    rises, falls = pulses[::2], pulses[1::2]
    assert ({e.value for e in rises}, {e.value for e in falls}) == ({1}, {0})
    assert all(abs(b.t_ns - a.t_ns - 1000 * rate) <= 1 for a, b in zip(rises, falls, strict=True))
    for i, c in enumerate(host.of(m.Capture)):
        burst = rises[i * n : (i + 1) * n]
        assert all(abs(b.t_ns - a.t_ns - period_ns * rate) <= 1 for a, b in pairwise(burst))
        assert abs(burst[0].t_ns - c.first_pulse_ns) <= c.jitter_ns + 1
        assert c.edge_ns < burst[0].t_ns
        assert c.width_max_ns >= 1000 * rate


def test_a_burst_longer_than_the_buffer_is_refused_and_the_lines_live_on(homed, hub):
    """A run whose bursts exceed spidev's `bufsiz` is refused at once; the next one runs."""
    _, host = homed(hub, bufsiz="512")
    refused = host.ask(msgspec.structs.replace(host.begin(), pulses=2, period_us=20_000.0, speed_mm_s=5.0))
    assert isinstance(refused, m.Refused)
    assert (refused.number, "bufsiz=" in refused.remedy) == (PiFault.BAD_REQUEST, True)
    assert host.row(0).status == "done"


def test_a_killed_program_leaves_the_line_low(rig, homed, hub, wires, stage):
    """The kernel ends the transfer; its last bits are low."""
    stage.skip = set(range(rig.grid.columns))
    program, host = homed(hub, wire_time=False)
    host.start_row()
    host.wait(m.RowStarted)
    wires.drive(WireEdge(1000, TRIGGER, 1), WireEdge(21_000, TRIGGER, 0))
    wires.until(lambda: bool(wires.rises(MOSI)))
    program.popen.kill()
    program.popen.wait()
    wires.until(lambda: len(wires.rises(MOSI)) == rig.burst.pulses)
    wires.until(lambda: wires.level(MOSI) == 0)


def test_check_measures_the_clock_and_names_the_buffer_that_the_burst_needs(rig, write_config):
    """With the line low all the time; a busy computer may need several attempts."""

    def findings(rig, **settings):
        environment = gpio.environment(rig.pi.gpio_chip, spi=rig.pi.spi_device, **settings)
        found = run("check", "--json", "--config", write_config(rig), **environment).stdout
        return {f["name"]: f for f in json.loads(found)}

    found = next(f for _ in range(20) if (f := findings(rig))["pulse width"]["verdict"] == "ok")
    assert found["SYNC_IN line 10"]["verdict"] == "ok"
    longer = msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=16))
    found = findings(longer, bufsiz="512")
    assert "512 bytes" in found["SYNC_IN line 10"]["found"]
    assert "options spidev bufsiz=4096" in found["pulse width"]["remedy"]
