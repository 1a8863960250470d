"""A row through the whole chain: the sketch's machine code on an emulated UNO, its serial line and trigger wire, the
Pi's program with the unmodified gpiod bindings on a stand-in chip. Simulated.

Bursts are in wire time, so that the machine may be busy; tests/pi/test_stand_in_chip.py has bursts in real time, and
`make test-uml` the published row of 350 points.
"""

from __future__ import annotations

from contextlib import closing
from itertools import pairwise

import msgspec
import pytest
from tests.support.pi.wires_log import WiresLog
from tests.support.stage.processes import StageProcess

from polysight_shared import messages as m
from polysight_simulators import gpio, uno

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
if lacking := gpio.missing() + uno.missing():
    pytest.skip(f"no chain without {' '.join(lacking)}: {uno.ENABLING_COMMAND}", allow_module_level=True)

TRIGGER, SYNC = 26, 22
POINTS, PULSES, PERIOD_NS, SPEED = 100, 16, 1_500_000, 3.0


@pytest.fixture
def rig(gpio_rig, tmp_path):
    """A row of the published burst and spacing: points 2 mm apart at 20 mm/s, 16 pulses 1.5 ms apart at each."""
    replace = msgspec.structs.replace
    return replace(
        gpio_rig,
        grid=replace(gpio_rig.grid, columns=POINTS, rows=1),
        burst=replace(gpio_rig.burst, pulses=PULSES, period_us=PERIOD_NS / 1e3),
        stage=replace(
            gpio_rig.stage,
            port=str(tmp_path / "ttySTAGE"),
            centre_x_mm=POINTS + 3.0,
            centre_y_mm=2.0,
            heartbeat_ms=10_000,
        ),
    )  # fmt: skip


@pytest.mark.slow
def test_every_point_of_a_row_is_a_burst(rig, hub, start, write_config, tmp_path):
    board = StageProcess(tmp_path, "uno", SPEED, hub, write_config(rig))
    with closing(board), closing(WiresLog(hub, TRIGGER, SYNC)) as wires:
        program, host = start(rig, **gpio.environment(rig.pi.gpio_chip, hub, wire_time=True))
        host.accepted(host.begin())
        host.home()
        done = host.row(0)
        wires.until(lambda: len(wires.rises(SYNC)) == done.pulses)
        assert done.status == "done", done.reason
        status, _, err = program.end()
        assert status == 0, err
        assert wires.level(SYNC) == 0
    assert (done.points, done.edges, done.bursts, done.pulses) == (POINTS, POINTS, POINTS, POINTS * PULSES)
    assert len(wires.rises(TRIGGER)) == POINTS
    assert [e.seq for e in host.journalled] == list(range(1, len(host.journalled) + 1))
    captures = host.of(m.Capture)
    assert [(c.point, c.column, c.pulses) for c in captures] == [(i, i, PULSES) for i in range(POINTS)]
    assert all(b.edge_ns > a.edge_ns for a, b in pairwise(captures))
    pulses = [e for e in wires.edges if e.line == SYNC]
    rises, falls = pulses[::2], pulses[1::2]
    assert ({e.value for e in rises}, {e.value for e in falls}) == ({1}, {0})
    for c in captures:
        burst = slice(c.point * PULSES, (c.point + 1) * PULSES)
        widths = [b.t_ns - a.t_ns for a, b in zip(rises[burst], falls[burst], strict=True)]
        assert max(widths) <= c.width_max_ns, "the bound holds for every pulse on the wire"
        assert c.edge_ns < c.first_pulse_ns <= rises[burst][0].t_ns
        drift = c.last_pulse_ns - c.first_pulse_ns - (PULSES - 1) * PERIOD_NS
        assert abs(drift) <= c.jitter_ns, "deadlines are absolute: only the last pulse's own lateness shows"
