"""Laws of the burst and the trigger loop, on a clock that tests turn."""

import queue
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.pi.fakes import FakeLines, gone

from polysight_pi.trigger import (
    FIRST_PULSE_DELAY_NS,
    BurstSent,
    BurstSpec,
    Counts,
    Edge,
    LoopFault,
    TriggerLoop,
    send_burst,
)
from polysight_shared.faults import PiFault
from polysight_shared.raster import MIN_PERIOD_NS

PERIOD = 1_500_000
SPEC = BurstSpec(16, PERIOD, 1000)


@given(
    pulses=st.integers(1, 40),
    period=st.integers(MIN_PERIOD_NS, 10**7),
    start=st.integers(0, 10**12),
    late=st.lists(st.integers(0, 50_000), min_size=1),
)
def test_deadlines_do_not_drift(pulses, period, start, late):
    """Each pulse is late by its own lateness alone, whatever happened to those before it."""
    lines = FakeLines(late=lambda n: late[n // 2 % len(late)] if n % 2 == 0 else 0)
    spec = BurstSpec(pulses, period + 50_000, 1000)
    sent = send_burst(lines, spec, start + 1)
    assert sent.fault == 0
    lateness = [late[k % len(late)] for k in range(pulses)]
    assert lines.rises == [start + 1 + k * spec.period_ns + lateness[k] for k in range(pulses)]
    assert sent.jitter_ns == max(lateness)
    assert (sent.first_ns, sent.last_ns, sent.pulses) == (lines.rises[0], lines.rises[-1], pulses)
    assert not lines.level


def test_a_start_that_has_passed_moves_the_whole_burst():
    lines = FakeLines()
    lines.t = 5_000
    send_burst(lines, SPEC, 1_000)
    assert lines.rises == [5_000 + k * PERIOD for k in range(16)]


@given(st.integers(0, 15), st.integers(0, 10_000), st.integers(0, 10_000))
def test_width_is_an_upper_bound_of_every_pulse(k, set_ns, clear_ns):
    """The line changes at an unknown time within each call, so the bound covers both calls completely."""
    lines = FakeLines(long=lambda n: set_ns if n == 2 * k else clear_ns if n == 2 * k + 1 else 0)
    sent = send_burst(lines, SPEC, 1_000)
    worst = max(1000, set_ns) + clear_ns
    assert sent.width_max_ns == worst
    assert sent.fault == (PiFault.PULSE_TOO_LONG if worst > 4000 else 0)
    assert sent.pulses == (k + 1 if worst > 4000 else 16)
    lines = FakeLines(long=lines.long)
    lines.check_width = False
    free = send_burst(lines, SPEC, 1_000)
    assert (free.fault, free.pulses) == (0, 16)


@given(st.integers(1, 15), st.integers(0, 3 * PERIOD))
def test_a_pulse_too_early_for_the_radar_is_never_sent(k, late):
    """Pulse k is late; the next one may be too close, and is then left out."""
    lines = FakeLines(late=lambda n: late if n == 2 * (k - 1) else 0)
    sent = send_burst(lines, SPEC, 1_000)
    gaps = [b - a for a, b in zip(lines.rises, lines.rises[1:], strict=False)]
    assert all(g >= MIN_PERIOD_NS for g in gaps)
    assert sent.fault == (PiFault.PERIOD_TOO_SHORT if late > PERIOD - MIN_PERIOD_NS and k < 16 else 0)
    assert sent.pulses == len(lines.rises)


def test_the_spacing_includes_the_previous_burst():
    sent = send_burst(FakeLines(), SPEC, 1_000_000, previous_rise_ns=1_000_000 - MIN_PERIOD_NS + 1)
    assert (sent.pulses, sent.fault) == (0, PiFault.PERIOD_TOO_SHORT)


class Loop:
    def __init__(self, points=3, lines=None):
        self.lines, self.posted = lines or FakeLines(), queue.SimpleQueue()
        self.loop = TriggerLoop(self.lines, self.posted.put, lambda: None)
        self.job = self.loop.arm(points, SPEC)
        self.loop.start()

    def edge(self, t_ms, seqno):
        self.lines.edges.put(Edge(t_ms * 1_000_000, seqno))

    def next(self):
        return self.posted.get(timeout=5)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        assert self.loop.stop(5)
        assert self.lines.closed
        assert not self.lines.level


def test_each_edge_gets_its_burst_at_a_fixed_delay():
    with Loop() as x:
        for i in range(3):
            x.edge(100 * (i + 1), 7 + i)
        for i in range(3):
            sent = x.next()
            assert (sent.point, sent.edge_ns, sent.record.pulses) == (i, 100_000_000 * (i + 1), 16)
            assert sent.record.first_ns == sent.edge_ns + FIRST_PULSE_DELAY_NS
        assert x.loop.disarm() == Counts(3, 3, 48)


@pytest.mark.parametrize(
    ("edges", "number", "bursts"),
    [
        ([(100, 1), (200, 3)], PiFault.EDGE_LOST, 1),
        ([(100, 1), (110, 2)], PiFault.EDGE_DURING_BURST, 1),
        ([(100, 1), (200, 2), (300, 3), (400, 4)], PiFault.POINTS_MISMATCH, 3),
    ],
)
def test_fault_table_of_the_loop(edges, number, bursts):
    with Loop() as x:
        for e in edges:
            x.edge(*e)
        for _ in range(bursts):
            assert isinstance(x.next(), BurstSent)
        fault = x.next()
        assert isinstance(fault, LoopFault)
        assert (fault.number, fault.job) == (number, x.job)
        x.edge(900, 99)  # nothing is answered after a fault
        x.edge(901, 100)
        while x.loop.strays < 2:
            pass
        assert x.loop.disarm() == Counts(len(edges), bursts, 16 * bursts)


@pytest.mark.parametrize("number", [PiFault.PULSE_TOO_LONG, PiFault.PERIOD_TOO_SHORT])
def test_a_failed_burst_is_reported_and_then_a_fault(number):
    long = number == PiFault.PULSE_TOO_LONG
    lines = FakeLines(
        long=lambda n: 5_000 if long and n == 4 else 0, late=lambda n: 0 if long or n != 2 else PERIOD - 100_000
    )
    with Loop(lines=lines) as x:
        x.edge(100, 1)
        assert x.next().record.pulses == (3 if long else 2)
        assert x.next().number == number


def test_edges_from_before_arming_or_while_disarmed_are_no_points():
    with Loop() as x:
        x.loop.disarm()
        x.edge(100, 1)
        while not x.loop.strays:
            pass
        job = x.loop.arm(3, SPEC)
        assert job.armed_ns == 100_000_000
        x.edge(100, 2)
        x.edge(200, 3)
        assert x.next().point == 0
        assert x.loop.strays == 2


def test_lines_that_vanish_are_a_fault():
    with Loop() as x:
        x.lines.edges.put(gone())
        fault = x.next()
        assert (fault.number, fault.job) == (PiFault.TRIGGER_LINE_LOST, None)


def test_an_exception_inside_a_pulse_leaves_the_outputs_low_and_is_a_fault(monkeypatch):
    raised = queue.SimpleQueue()
    monkeypatch.setattr("threading.excepthook", lambda args: raised.put(args.exc_value))

    def fail(n):
        if n == 1:
            raise ZeroDivisionError("a bug")
        return 0

    with Loop(lines=FakeLines(late=fail)) as x:
        x.edge(100, 1)
        fault = x.next()
        assert (fault.number, fault.job) == (PiFault.TRIGGER_LINE_LOST, None)
        assert "a bug" in fault.detail
        assert isinstance(raised.get(timeout=60), ZeroDivisionError)
        assert tuple(active for _, active in x.lines.changes) == (True, False)


def test_disarming_ends_a_running_burst_after_its_pulse():
    def disarm(n):
        if n == 4:  # the third pulse is awaited
            threading.Thread(target=lambda: counted.put(x.loop.disarm())).start()
            while x.loop._job is not None:
                pass
        return 0

    counted = queue.SimpleQueue()
    with Loop(lines=FakeLines(late=disarm)) as x:
        x.edge(100, 1)
        assert x.next().record.pulses == 3
        assert counted.get(timeout=60) == Counts(1, 1, 3)


def test_stop_within_a_burst_ends_it_at_a_whole_pulse():
    stop = iter([False, False, True])
    lines = FakeLines()
    assert send_burst(lines, SPEC, 0, stop=lambda: next(stop)).pulses == 2
    assert not lines.level
