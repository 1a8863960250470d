"""`polysight-pi` with an SPI controller: its own code, the real gpiod bindings, and a stand-in for spidev (simulated).

The stand-in is built from the kernel's header and drivers, in C: it knows transfers, and nothing of bursts.
"""

from __future__ import annotations

import json
from itertools import pairwise

import msgspec
import pytest

from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.shared.wires import WireEdge
from polysight.simulators import gpio
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import Process, run
from tests.support.pi.wires_log import WiresLog

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
if lacking := gpio.missing():
    pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}", allow_module_level=True)

MOSI, TRIGGER = 10, 26
CORES = {"as believed": (250e6, 1.0), "0.4 % fast": (251e6, 1 / 1.004)}


@pytest.fixture
def rig(instrument, tmp_path):
    """The shipped wiring, on a stand-in chip and a stand-in controller."""
    assert instrument.pi.wiring == "spi"
    pi = msgspec.structs.replace(
        instrument.pi, gpio_chip=str(tmp_path / "chip"), spi_device=str(tmp_path / "spidev0.0")
    )  # fmt: skip
    return msgspec.structs.replace(instrument, pi=pi)


@pytest.fixture
def wires(hub):
    log = WiresLog(hub, TRIGGER, MOSI)
    yield log
    log.close()


def controller(rig, hub=None, **settings):
    """Environment of the program; time within bursts is wire time."""
    return gpio.environment(rig.pi.gpio_chip, hub, wire_time=True, spi=rig.pi.spi_device, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("core", CORES)
def test_every_position_is_a_burst_by_the_controllers_clock(rig, write_config, stage, hub, wires, core):
    """A row of the shipped wiring: bits on MOSI, their widths and spacing those of the clock that is there."""
    core_hz, rate = CORES[core]
    with Process(
        write_config(rig), "--stage-port", stage.port, **controller(rig, hub, core_hz=f"250e6,{core_hz}")
    ) as p:
        assert p.ready, p.popen.communicate()
        host = HostSide(p.ready[1], p.events[1], rig)
        assert host.ask(m.Hello()).backend == "spi"
        host.accepted(host.begin())
        host.home()
        done = host.row(0)
        assert (done.status, done.timed_by) == ("done", "spi"), done.reason
        status, _, err = p.end()
        assert status == 0, err
    captures = [e for e in host.events if isinstance(e, m.Capture)]
    host.close()
    n, period_ns = rig.burst.pulses, rig.burst.period_us * 1e3
    wires.until(lambda: len([e for e in wires.edges if e.line == MOSI]) == 2 * n * rig.grid.columns)
    pulses = [e for e in wires.edges if e.line == MOSI]
    rises, falls = pulses[::2], pulses[1::2]
    assert ({e.value for e in rises}, {e.value for e in falls}) == ({1}, {0})
    assert all(abs(b.t_ns - a.t_ns - 1000 * rate) <= 1 for a, b in zip(rises, falls, strict=True))
    for i, c in enumerate(captures):
        burst = rises[i * n : (i + 1) * n]
        assert all(abs(b.t_ns - a.t_ns - period_ns * rate) <= 1 for a, b in pairwise(burst))
        assert abs(burst[0].t_ns - c.first_pulse_ns) <= c.jitter_ns + 1
        assert c.edge_ns < burst[0].t_ns
        assert c.width_max_ns >= 1000 * rate


@pytest.mark.slow
@pytest.mark.parametrize(("core_hz", "fault"), [(400e6, PiFault.PERIOD_TOO_SHORT), (50e6, PiFault.PULSE_TOO_LONG)])
def test_a_core_clock_that_is_not_the_drivers_ends_the_row(rig, write_config, stage, hub, core_hz, fault):
    with Process(
        write_config(rig), "--stage-port", stage.port, **controller(rig, hub, core_hz=f"250e6,{core_hz}")
    ) as p:
        assert p.ready, p.popen.communicate()
        host = HostSide(p.ready[1], p.events[1], rig)
        host.accepted(host.begin())
        host.home()
        done = host.row(0)
        assert (done.status, done.fault) == ("fault", fault)
        assert host.ask(m.Status()).state == "ready"
        host.close()


@pytest.mark.slow
def test_a_burst_longer_than_the_buffer_is_refused_and_the_lines_live_on(rig, write_config, stage, hub):
    """spidev takes `bufsiz` bytes. A run whose bursts are longer is refused at once; the next one runs."""
    with Process(write_config(rig), "--stage-port", stage.port, **controller(rig, hub, bufsiz="512")) as p:
        assert p.ready, p.popen.communicate()
        host = HostSide(p.ready[1], p.events[1], rig)
        long = msgspec.structs.replace(host.begin(), pulses=2, period_us=20_000.0, speed_mm_s=5.0)
        refused = host.ask(long)
        assert isinstance(refused, m.Refused)
        assert (refused.number, "bufsiz=" in refused.remedy) == (PiFault.BAD_REQUEST, True)
        host.accepted(host.begin())
        host.home()
        assert host.row(0).status == "done"
        host.close()


@pytest.mark.slow
def test_a_killed_program_leaves_the_line_low(rig, write_config, stage, hub, wires):
    """The kernel ends the transfer; its last bits are low."""
    stage.skip = set(range(rig.grid.columns))
    environment = gpio.environment(rig.pi.gpio_chip, hub, spi=rig.pi.spi_device)  # at real time
    with Process(write_config(rig), "--stage-port", stage.port, **environment) as p:
        assert p.ready, p.popen.communicate()
        host = HostSide(p.ready[1], p.events[1], rig)
        host.accepted(host.begin())
        host.home()
        host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
        host.wait(m.RowStarted)
        wires.drive(WireEdge(1000, TRIGGER, 1), WireEdge(21_000, TRIGGER, 0))
        wires.until(lambda: bool(wires.rises(MOSI)))
        p.popen.kill()
        p.popen.wait()
        wires.until(lambda: len(wires.rises(MOSI)) == rig.burst.pulses)
        wires.until(lambda: wires.level(MOSI) == 0)
        host.close()


@pytest.mark.slow
@pytest.mark.parametrize(("core_hz", "verdict"), [(250e6, "ok"), (400e6, "fail"), (100e6, "fail")])
def test_check_measures_the_clock_that_is_there(rig, write_config, core_hz, verdict):
    """With the line low all the time. A computer too busy for five transfers in time is asked again."""
    environment = gpio.environment(rig.pi.gpio_chip, spi=rig.pi.spi_device, core_hz=f"250e6,{core_hz}")
    for _ in range(20):
        findings = {f["name"]: f for f in json.loads(
            run("check", "--json", "--config", write_config(rig), **environment).stdout
        )}  # fmt: skip
        if findings["pulse width"]["verdict"] == verdict:
            break
    assert findings["SYNC_IN line 10"]["verdict"] == "ok"
    assert findings["pulse width"]["verdict"] == verdict
    assert ("core_freq" in findings["pulse width"]["remedy"]) == (verdict == "fail")


def test_check_names_the_buffer_that_the_burst_needs(rig, write_config):
    environment = gpio.environment(rig.pi.gpio_chip, spi=rig.pi.spi_device, bufsiz="512")
    longer = msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=16))
    findings = {f["name"]: f for f in json.loads(
        run("check", "--json", "--config", write_config(longer), **environment).stdout
    )}  # fmt: skip
    assert "512 bytes" in findings["SYNC_IN line 10"]["found"]
    assert "options spidev bufsiz=4096" in findings["pulse width"]["remedy"]
