"""Bursts without a row: as many pulses as requested, on their deadlines, and never during a run."""

from contextlib import closing
from itertools import pairwise

import pytest

from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.wires import WireClient, WireEdge


@pytest.fixture
def rises(hub, instrument):
    """Wire times of the next rising edges, each followed by its falling one."""
    with closing(WireClient(hub, listen=instrument.pi.sync_out)) as radar:

        def rises(pulses, width_ns=1000):
            edges = [radar.receive(5) for _ in range(2 * pulses)]
            assert all(isinstance(e, WireEdge) for e in edges)
            assert [e.value for e in edges] == [1, 0] * pulses
            assert {b.t_ns - a.t_ns for a, b in zip(edges[::2], edges[1::2], strict=True)} == {width_ns}
            return [e.t_ns for e in edges[::2]]

        yield rises
        assert radar.receive(0.2) is None, "no pulse more"


def test_every_pulse_is_sent_once_and_bursts_keep_their_distance(pi, rises):
    sent = [pi.host.ask(m.Pulse(pulses=n, period_us=400.0, width_us=1.0)) for n in (3, 20)]
    assert [(s.pulses, s.width_max_ns, s.fault, s.timed_by) for s in sent] == [
        (3, 1000, 0, "spi"),
        (20, 1000, 0, "spi"),
    ]
    steps = [b - a for a, b in pairwise(rises(23))]
    assert steps[2] >= 400_000  # between two bursts
    assert steps[:2] + steps[3:] == [400_000] * 21


def test_pulses_beyond_one_transfer_are_sent_in_several(pi, rises):
    """64 pulses do not fit in spidev's buffer: none is lost, none comes too early."""
    sent = pi.host.ask(m.Pulse(pulses=64, period_us=1500.0, width_us=1.0))
    assert (sent.pulses, sent.fault, sent.timed_by) == (64, 0, "spi")
    assert min(b - a for a, b in pairwise(rises(64, width_ns=2000))) >= 1_500_000


def test_a_row_afterwards_is_complete_and_during_a_run_no_pulse_is_sent(pi, instrument):
    pulse = m.Pulse(pulses=5, period_us=1500.0, width_us=1.0)
    assert not pi.host.ask(m.Hello()).in_run
    assert pi.host.ask(pulse).pulses == 5
    pi.host.accepted(pi.host.begin())
    assert pi.host.ask(m.Hello()).in_run
    assert pi.host.refused(pulse) == PiFault.NOT_READY
    pi.host.home()
    done = pi.host.row(0)
    assert (done.status, done.pulses) == ("done", instrument.grid.columns * instrument.burst.pulses)
