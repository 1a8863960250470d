"""A full row through everything: the sketch's machine code on an emulated UNO, its serial line and trigger wire, the
Pi's program with the unmodified gpiod bindings on a stand-in chip. Simulated.

Bursts are in wire time, so that the machine may be busy; tests/pi/test_stand_in_chip.py has bursts at real time.
"""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise

import msgspec
import pytest

from polysight.shared import messages as m
from polysight.simulators import gpio, uno
from tests.support.paths import REPO
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import Process
from tests.support.pi.wires_log import WiresLog
from tests.support.rigs import timed_by_the_program

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
if lacking := gpio.missing() + uno.missing():
    pytest.skip(f"no chain without {' '.join(lacking)}: {uno.ENABLING_COMMAND}", allow_module_level=True)

TRIGGER, SYNC = 26, 22
POINTS, PULSES, PERIOD_NS, SPEED = 350, 16, 1_500_000, 3.0


@pytest.fixture
def instrument(instrument):
    """With SYNC_IN on a GPIO line."""
    return timed_by_the_program(instrument)


@pytest.fixture
def rig(instrument, tmp_path):
    """The published row: 350 points 2 mm apart at 20 mm/s, 16 pulses 1.5 ms apart at each."""
    replace = msgspec.structs.replace
    return replace(
        instrument,
        grid=replace(instrument.grid, columns=POINTS, rows=1),
        burst=replace(instrument.burst, pulses=PULSES, period_us=PERIOD_NS / 1e3),
        stage=replace(
            instrument.stage, port=str(tmp_path / "tty"), centre_x_mm=353.0, centre_y_mm=2.0, heartbeat_ms=10_000
        ),
        pi=replace(instrument.pi, gpio_chip=str(tmp_path / "chip")),
    )  # fmt: skip


@pytest.fixture
def board(rig, write_config, tmp_path):
    """Hub and board; gives the rig file."""
    config, hub = write_config(rig), tmp_path / "wires"
    started = []
    for command in (
        ["polysight.simulators.wires", "--socket", hub],
        [
            "polysight.simulators.uno",
            "--config",
            config,
            "--wires",
            hub,
            "--link",
            rig.stage.port,
            "--time-scale",
            SPEED,
        ],
    ):
        process = subprocess.Popen(
            [sys.executable, "-m", *map(str, command)], cwd=REPO, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready")
    yield config
    for process in reversed(started):
        process.terminate()
        process.communicate(timeout=60)


@pytest.mark.slow
def test_a_row_of_350_points_is_5600_pulses(rig, board, tmp_path):
    hub = tmp_path / "wires"
    wires = WiresLog(hub, TRIGGER, SYNC)
    try:
        with Process(board, **gpio.environment(rig.pi.gpio_chip, hub, wire_time=True)) as p:
            assert p.ready, p.popen.communicate()
            host = HostSide(p.ready[1], p.events[1], rig)
            host.accepted(host.begin())
            host.home()
            done = host.row(0)
            wires.until(lambda: len(wires.rises(SYNC)) == done.pulses)
            assert done.status == "done", done.reason
            status, _, err = p.end()
            assert status == 0, err
        assert wires.level(SYNC) == 0
        assert (done.points, done.edges, done.bursts, done.pulses) == (POINTS, POINTS, POINTS, POINTS * PULSES)
        assert len(wires.rises(TRIGGER)) == POINTS
        seen = host.journalled
        assert [e.seq for e in seen] == list(range(1, len(seen) + 1))
        captures = [e for e in seen if isinstance(e, m.Capture)]
        assert [(c.point, c.column, c.pulses) for c in captures] == [(i, i, PULSES) for i in range(POINTS)]
        assert all(b.edge_ns > a.edge_ns for a, b in pairwise(captures))
        pulses = [e for e in wires.edges if e.line == SYNC]
        rises, falls = pulses[::2], pulses[1::2]
        assert {e.value for e in rises} == {1}
        assert {e.value for e in falls} == {0}
        for c in captures:
            burst = slice(c.point * PULSES, (c.point + 1) * PULSES)
            widths = [b.t_ns - a.t_ns for a, b in zip(rises[burst], falls[burst], strict=True)]
            assert max(widths) <= c.width_max_ns, "the bound holds for every pulse on the wire"
            assert c.edge_ns < c.first_pulse_ns <= rises[burst][0].t_ns
            drift = c.last_pulse_ns - c.first_pulse_ns - (PULSES - 1) * PERIOD_NS
            assert abs(drift) <= c.jitter_ns, "deadlines are absolute: only the last pulse's own lateness shows"
        host.close()
    finally:
        wires.close()
