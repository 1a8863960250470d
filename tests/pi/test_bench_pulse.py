"""A burst at rest: as many pulses as were asked for, on their deadlines, and never while a run is begun."""

from contextlib import closing
from itertools import pairwise

import pytest

from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.shared.wires import WireClient, WireEdge


def rises(radar, pulses):
    """Wire times of so many rising edges, every one followed by its falling one a microsecond later."""
    edges = [radar.receive(5) for _ in range(2 * pulses)]
    assert all(isinstance(e, WireEdge) for e in edges)
    assert [e.value for e in edges] == [1, 0] * pulses
    assert {b.t_ns - a.t_ns for a, b in zip(edges[::2], edges[1::2], strict=True)} == {1000}
    return [e.t_ns for e in edges[::2]]


def test_every_pulse_is_sent_once_and_bursts_keep_their_distance(pi, hub, instrument):
    radar = WireClient(hub, listen=instrument.pi.sync_out)
    told = [pi.host.ask(m.Pulse(pulses=n, period_us=400.0, width_us=1.0)) for n in (3, 20)]
    assert [(t.pulses, t.width_max_ns, t.fault) for t in told] == [(3, 1000, 0), (20, 1000, 0)]
    assert {t.timed_by for t in told} == {"spi"}
    at = rises(radar, 23)
    steps = [b - a for a, b in pairwise(at)]
    assert steps[:2] == [400_000] * 2
    assert steps[2] >= 400_000  # between two bursts
    assert steps[3:] == [400_000] * 19
    assert radar.receive(0.2) is None
    radar.close()


def test_a_row_after_it_is_whole(pi, instrument):
    pi.host.ask(m.Pulse(pulses=5, period_us=1500.0, width_us=1.0))
    pi.host.accepted(pi.host.begin())
    pi.host.home()
    done = pi.host.row(0)
    assert (done.status, done.pulses) == ("done", instrument.grid.columns * instrument.burst.pulses)


def test_none_while_a_run_is_begun(pi):
    assert not pi.host.ask(m.Hello()).in_run
    pi.host.accepted(pi.host.begin())
    assert pi.host.ask(m.Hello()).in_run
    refused = pi.host.ask(m.Pulse(pulses=3, period_us=1500.0, width_us=1.0))
    assert refused.number == PiFault.NOT_READY


@pytest.mark.parametrize(
    ("period_us", "width_us", "number"), [(299.0, 1.0, PiFault.PERIOD_TOO_SHORT), (1500.0, 4.5, PiFault.PULSE_TOO_LONG)]
)
def test_what_a_radar_cannot_take_is_refused(pi, period_us, width_us, number):
    assert pi.host.ask(m.Pulse(pulses=3, period_us=period_us, width_us=width_us)).number == number


def test_the_pi_tells_its_wall_clock(pi):
    assert pi.host.ask(m.Hello()).t_unix_ns > 1_600_000_000 * 10**9


def test_pulses_beyond_one_transfer_are_sent_in_several(pi, hub, instrument):
    """64 pulses are longer than spidev's buffer: none is lost, none comes too early."""
    with closing(WireClient(hub, listen=instrument.pi.sync_out)) as radar:
        told = pi.host.ask(m.Pulse(pulses=64, period_us=1500.0, width_us=1.0))
        assert (told.pulses, told.fault, told.timed_by) == (64, 0, "spi")
        edges = [radar.receive(5) for _ in range(128)]
    up = [e.t_ns for e in edges if isinstance(e, WireEdge) and e.value == 1]
    assert len(up) == 64
    assert min(b - a for a, b in pairwise(up)) >= 1_500_000
