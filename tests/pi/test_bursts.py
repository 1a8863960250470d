"""Laws of bursts, by the program and by the SPI controller, and of the trigger loop, with clocks set by tests."""

import queue
import random
import re
import threading
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.pi.fakes import FakeLines, gone
from tests.support.processes import HANG_S
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig, time_by_spi

from polysight_pi import lines as pi_lines, trigger
from polysight_pi.lines import SpiWireLines
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.raster import MAX_WIDTH_NS, MIN_PERIOD_NS, MIN_WIDTH_NS
from polysight_shared.wires import WireClient, WireEdge

# The burst of the published rig: 16 pulses of 1 us, 1.5 ms apart. Times here are nanoseconds.
PERIOD_NS = 1_500_000
SPEC = trigger.BurstSpec(16, PERIOD_NS, 1000)
# The fake lines count sleeps and changes of the output from 0. Pulse k, from 0, has two of each: it waits for its time
# in sleep 2 k and for its end in sleep 2 k + 1, and its changes are 2 k (high) and 2 k + 1 (low).


@given(
    pulses=st.integers(1, 40),
    period=st.integers(MIN_PERIOD_NS, 10**7),
    start=st.integers(0, 10**12),
    delays=st.lists(st.integers(0, 50_000), min_size=1),
)
def test_deadlines_do_not_drift(pulses, period, start, delays):
    """The delay of a pulse does not depend on those of earlier pulses."""

    def delay_sleep(n: int) -> int:
        """Delay the sleep before each pulse, and not the one within it."""
        if n % 2 == 0:
            return delays[n // 2 % len(delays)]
        return 0

    lines = FakeLines(late=delay_sleep)
    # With the longest delay, 50 us, pulses still keep the shortest period that the radar allows.
    spec = trigger.BurstSpec(pulses, period + 50_000, 1000)
    sent = trigger.send_burst(lines, spec, start + 1)
    assert sent.fault == 0
    pulse_delays = [delays[k % len(delays)] for k in range(pulses)]
    assert lines.rises == [start + 1 + k * spec.period_ns + pulse_delays[k] for k in range(pulses)]
    assert sent.jitter_ns == max(pulse_delays)
    assert (sent.first_ns, sent.last_ns, sent.pulses) == (lines.rises[0], lines.rises[-1], pulses)
    assert not lines.level


def test_a_start_that_has_passed_moves_the_whole_burst():
    lines = FakeLines()
    lines.t = 5_000
    trigger.send_burst(lines, SPEC, 1_000)
    assert lines.rises == [5_000 + k * PERIOD_NS for k in range(16)]


@given(st.integers(0, 15), st.integers(0, 10_000), st.integers(0, 10_000))
def test_width_is_an_upper_bound_of_every_pulse(k, set_ns, clear_ns):
    """The line changes at an unknown time within each call, so the bound covers both calls completely."""
    durations_ns = {2 * k: set_ns, 2 * k + 1: clear_ns}
    lines = FakeLines(long=lambda n: durations_ns.get(n, 0))
    sent = trigger.send_burst(lines, SPEC, 1_000)
    # The call that clears the line comes 1000 ns after the beginning of the call that sets it, or after its end if that
    # is later.
    widest_ns = max(1000, set_ns) + clear_ns
    assert sent.width_max_ns == widest_ns
    # The radar's longest pulse: 4 us.
    is_too_long = widest_ns > MAX_WIDTH_NS
    assert sent.fault == (PiFault.PULSE_TOO_LONG if is_too_long else 0)
    assert sent.pulses == (k + 1 if is_too_long else 16)

    # Behind a one-shot, which makes the width itself, it is not checked.
    lines = FakeLines(long=lines.long)
    lines.check_width = False
    unchecked = trigger.send_burst(lines, SPEC, 1_000)
    assert (unchecked.fault, unchecked.pulses) == (0, 16)


@given(st.integers(1, 15), st.integers(0, 3 * PERIOD_NS))
def test_a_pulse_too_early_for_the_radar_is_never_sent(k, late_ns):
    """Pulse k, counted from 1, is late. If the next pulse would come too soon after it, that pulse is left out."""
    lines = FakeLines(late=lambda n: late_ns if n == 2 * (k - 1) else 0)
    sent = trigger.send_burst(lines, SPEC, 1_000)
    assert all(later - earlier >= MIN_PERIOD_NS for earlier, later in pairwise(lines.rises))
    # Pulse 16 is the last one: no pulse follows it too soon.
    next_is_too_soon = late_ns > PERIOD_NS - MIN_PERIOD_NS and k < 16
    assert sent.fault == (PiFault.PERIOD_TOO_SHORT if next_is_too_soon else 0)
    assert sent.pulses == len(lines.rises)


def test_the_least_spacing_of_pulses_also_holds_between_two_bursts():
    sent = trigger.send_burst(FakeLines(), SPEC, 1_000_000, previous_rise_ns=1_000_000 - MIN_PERIOD_NS + 1)
    assert (sent.pulses, sent.fault) == (0, PiFault.PERIOD_TOO_SHORT)


class ArmedRow:
    """A trigger loop that answers a row's edges in its own thread; ends with its lines closed and low."""

    def __init__(self, points=3, lines=None):
        self.lines = lines or FakeLines()
        self.posted = queue.SimpleQueue()
        self.loop = trigger.TriggerLoop(self.lines, self.posted.put, lambda: None)
        self.job = self.loop.arm(points, SPEC)
        self.loop.start()

    def edge(self, t_ms, seqno):
        """Put an edge on the trigger line; the kernel numbers all edges, so a missing number is a lost edge."""
        self.lines.edges.put(trigger.Edge(t_ms * 1_000_000, seqno))

    def next(self):
        """Return the next report of the loop: a burst that was sent, or a fault."""
        return self.posted.get(timeout=HANG_S)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        assert self.loop.stop(HANG_S)
        assert self.lines.closed
        assert not self.lines.level


def test_each_edge_gets_its_burst_at_a_fixed_delay():
    with ArmedRow() as row:
        for i in range(3):
            row.edge(100 * (i + 1), 7 + i)
        for i in range(3):
            sent = row.next()
            assert (sent.point, sent.edge_ns, sent.record.pulses) == (i, 100_000_000 * (i + 1), 16)
            assert sent.record.first_ns == sent.edge_ns + trigger.FIRST_PULSE_DELAY_NS
        assert row.loop.disarm() == trigger.Counts(edges=3, bursts=3, pulses=3 * 16)


@pytest.mark.parametrize(
    ("edges", "number", "bursts"),
    [
        # Edges as (time in ms, kernel's number). In the first case edge 2 is missing.
        ([(100, 1), (200, 3)], PiFault.EDGE_LOST, 1),
        # The second edge comes during the burst of the first one, which lasts 15 x 1.5 ms = 22.5 ms.
        ([(100, 1), (110, 2)], PiFault.EDGE_DURING_BURST, 1),
        # There is one edge more than the row has points.
        ([(100, 1), (200, 2), (300, 3), (400, 4)], PiFault.POINTS_MISMATCH, 3),
    ],
)
def test_an_edge_that_is_lost_too_early_or_too_many_is_a_fault(edges, number, bursts):
    with ArmedRow() as row:
        for edge in edges:
            row.edge(*edge)
        for _ in range(bursts):
            assert isinstance(row.next(), trigger.BurstSent)
        fault = row.next()
        assert isinstance(fault, trigger.LoopFault)
        assert (fault.number, fault.job) == (number, row.job)
        # After the fault edges are counted as strays and get no burst.
        row.edge(900, 99)
        row.edge(901, 100)
        while row.loop.strays < 2:
            pass
        assert row.loop.disarm() == trigger.Counts(edges=len(edges), bursts=bursts, pulses=16 * bursts)


@pytest.mark.parametrize("number", [PiFault.PULSE_TOO_LONG, PiFault.PERIOD_TOO_SHORT])
def test_a_failed_burst_is_reported_and_then_a_fault(number):
    if number == PiFault.PULSE_TOO_LONG:
        # Setting the line for the third pulse takes 5 us, longer than the radar's 4 us.
        lines = FakeLines(long=lambda n: 5_000 if n == 4 else 0)
        pulses_sent = 3
    else:
        # The second pulse is so late that the third one would follow 0.1 ms after it; the radar allows 0.3 ms.
        lines = FakeLines(late=lambda n: PERIOD_NS - 100_000 if n == 2 else 0)
        pulses_sent = 2
    with ArmedRow(lines=lines) as row:
        row.edge(100, 1)
        assert row.next().record.pulses == pulses_sent
        assert row.next().number == number


def test_edges_before_arming_or_while_disarmed_are_not_points():
    with ArmedRow() as row:
        row.loop.disarm()
        row.edge(100, 1)
        while not row.loop.strays:
            pass
        job = row.loop.arm(3, SPEC)
        assert job.armed_ns == 100_000_000
        row.edge(100, 2)
        row.edge(200, 3)
        assert row.next().point == 0
        assert row.loop.strays == 2


def test_lines_that_vanish_are_a_fault():
    with ArmedRow() as row:
        row.lines.edges.put(gone())
        fault = row.next()
        assert (fault.number, fault.job) == (PiFault.TRIGGER_LINE_LOST, None)


def test_an_exception_inside_a_pulse_leaves_the_outputs_low_and_is_a_fault(monkeypatch):
    raised = queue.SimpleQueue()
    monkeypatch.setattr("threading.excepthook", lambda args: raised.put(args.exc_value))

    def fail(n):
        if n == 1:
            raise ZeroDivisionError("a bug")
        return 0

    with ArmedRow(lines=FakeLines(late=fail)) as row:
        row.edge(100, 1)
        fault = row.next()
        assert (fault.number, fault.job) == (PiFault.TRIGGER_LINE_LOST, None)
        assert "a bug" in fault.detail
        assert isinstance(raised.get(timeout=HANG_S), ZeroDivisionError)
        # The output was set once, and cleared.
        assert [active for _, active in row.lines.changes] == [True, False]


def test_disarming_ends_a_running_burst_after_its_pulse():
    def disarm(n):
        # Sleep 4 is the one before the third pulse.
        if n == 4:
            threading.Thread(target=lambda: counted.put(row.loop.disarm())).start()
            while row.loop._job is not None:
                pass
        return 0

    counted = queue.SimpleQueue()
    with ArmedRow(lines=FakeLines(late=disarm)) as row:
        row.edge(100, 1)
        assert row.next().record.pulses == 3
        assert counted.get(timeout=HANG_S) == trigger.Counts(edges=1, bursts=1, pulses=3)


def test_stop_within_a_burst_ends_it_at_a_whole_pulse():
    stop = iter([False, False, True])
    lines = FakeLines()
    assert trigger.send_burst(lines, SPEC, 0, stop=lambda: next(stop)).pulses == 2
    assert not lines.level


# --- the SPI controller: a burst is a sequence of bits on its output MOSI, and each pulse one set bit -----------------

# Pulses, period and width in nanoseconds of bursts that the controller can make.
bursts = st.tuples(st.integers(1, 256), st.integers(MIN_PERIOD_NS, 20_000_000), st.integers(500, 2000))
# Bytes of a buffer of spidev that every burst of these tests fits into.
LARGE_BUFFER = 1 << 22


def list_set_bits(data: bytes) -> list[int]:
    """Indices of the set bits, most significant bit first."""
    return np.flatnonzero(np.unpackbits(np.frombuffer(data, np.uint8))).tolist()


@given(bursts)
def test_each_pulse_is_one_set_bit_at_the_place_nearest_to_its_time(burst):
    """A pulse is off by at most half a bit, and the distance of two by a bit. Rounding a bit's length adds 1 ns."""
    pulses, period_ns, width_ns = burst
    made_burst = trigger.make_spi_burst(trigger.BurstSpec(pulses, period_ns, width_ns), LARGE_BUFFER)
    # The clock is a whole number of hertz: of 0.5 to 2 MHz, half a hertz is 1e-6.
    assert made_burst.bit_ns == pytest.approx(width_ns, rel=1e-5)
    set_bits = list_set_bits(made_burst.data)
    assert tuple(set_bits) == made_burst.bits
    assert len(set_bits) == pulses
    for k, bit in enumerate(set_bits):
        assert abs((bit - set_bits[0]) * made_burst.bit_ns - k * period_ns) <= made_burst.bit_ns / 2 + 1
    for earlier, later in pairwise(set_bits):
        assert abs((later - earlier) * made_burst.bit_ns - period_ns) <= made_burst.bit_ns + 1
    # The output is low before and after the burst.
    assert made_burst.data[0] == 0
    assert made_burst.data[-1] == 0
    assert len(made_burst.data) >= trigger.MIN_BYTES


@given(bursts, st.integers(trigger.MIN_BYTES, 65_536))
def test_a_burst_that_exceeds_the_buffer_of_spidev_is_refused_with_the_size_to_set(burst, bufsiz):
    needed_bytes = len(trigger.make_spi_burst(trigger.BurstSpec(*burst), LARGE_BUFFER).data)
    if needed_bytes > bufsiz:
        with expect_refusal(ErrorCode.VALUES_CONFLICT, bufsiz) as e:
            trigger.make_spi_burst(trigger.BurstSpec(*burst), bufsiz)
        advice = re.search(r"bufsiz=(\d+)`", e.value.remedy)
        assert advice is not None
        advised_bytes = int(advice[1])
        assert needed_bytes <= advised_bytes
        trigger.make_spi_burst(trigger.BurstSpec(*burst), advised_bytes)
    else:
        assert len(trigger.make_spi_burst(trigger.BurstSpec(*burst), bufsiz).data) == needed_bytes


@pytest.mark.parametrize("width_ns", [MIN_WIDTH_NS, 499, 2001, MAX_WIDTH_NS])
def test_a_width_that_the_controller_cannot_make_is_refused(width_ns):
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "0.5..2 us"):
        trigger.make_spi_burst(trigger.BurstSpec(1, PERIOD_NS, width_ns), LARGE_BUFFER)


def test_the_published_burst_fits_the_default_buffer_of_a_pi():
    published_burst = load_published_rig().burst
    burst = trigger.make_spi_burst(trigger.BurstSpec.from_burst(published_burst))
    assert SpiWireLines.bufsiz == trigger.DEFAULT_BUFSIZ == 4096
    assert burst.clock_hz == 1_000_000
    # 15 periods of 1500 bits between 8 low bits before and after, (22,500 + 16) / 8 bytes, and one byte more.
    assert len(burst.data) == 2815
    assert [later - earlier for earlier, later in pairwise(burst.bits)] == [1500] * 15


class Controller:
    """An SPI controller whose clock is `rate` times the requested one, and that begins `late_ns` late."""

    name = "fake"
    check_width = True
    is_real_time = True

    def __init__(self, rate: float = 1.0, late_ns: int = 30_000, bufsiz: int = 4096) -> None:
        self.t = 0
        self.rate = rate
        self.late_ns = late_ns
        self.bufsiz = bufsiz
        self.sent: list[tuple[int, trigger.SpiBurst]] = []

    def now_ns(self) -> int:
        return self.t

    def sleep_until(self, t_ns: int) -> None:
        self.t = max(self.t, t_ns)

    def wait_edge(self, timeout_s: float) -> None: ...
    def count_returned(self, sent: int) -> None: ...
    def close(self) -> None: ...

    def transfer(self, burst: trigger.SpiBurst) -> tuple[int, int]:
        start_t = self.t
        self.t = self.t + self.late_ns + round(burst.duration_ns / self.rate)
        self.sent.append((start_t + self.late_ns, burst))
        return start_t, self.t


@pytest.mark.parametrize("late_ns", [0, 30_000, 200_000])
def test_a_record_bounds_what_the_controller_did(late_ns):
    lines = Controller(late_ns=late_ns)
    record = trigger.send_burst(lines, SPEC, 1_000_000)
    ((begin_ns, burst),) = lines.sent
    true_first_ns = begin_ns + round(burst.bits[0] * burst.bit_ns)
    assert (record.pulses, record.fault) == (16, 0)
    assert abs(record.first_ns - true_first_ns) <= record.jitter_ns
    assert record.last_ns - record.first_ns == 15 * PERIOD_NS
    # The width follows from the time of the whole call, 22.5 ms: 0.2 ms more are 0.9 %.
    assert 1000 <= record.width_max_ns <= 1010
    # Half of the call's time beyond the burst: it may have been spent before the burst or after it.
    assert record.jitter_ns <= late_ns / 2 + burst.bit_ns


@pytest.mark.parametrize(("period_ns", "rounding_bits"), [(PERIOD_NS, 0), (PERIOD_NS + 1, 0.5)])
def test_only_pulses_between_bits_are_rounded(period_ns, rounding_bits):
    """A period of whole bits puts every pulse at its exact time."""
    lines = Controller(late_ns=0)
    spec = trigger.BurstSpec(pulses=16, period_ns=period_ns, width_ns=1000)
    record = trigger.send_burst(lines, spec, 1_000_000)
    ((_, burst),) = lines.sent
    # The jitter is a whole number of nanoseconds.
    assert record.jitter_ns == pytest.approx(rounding_bits * burst.bit_ns, abs=1)


def test_a_late_kernel_causes_no_width_fault_of_the_controller():
    """10,000 bursts; the kernel begins up to 5 ms late in every call, which lengthens no pulse."""
    rng = random.Random(1)
    lines = Controller()
    faults = 0
    for _ in range(10_000):
        lines.late_ns = rng.randrange(5_000_000)
        if trigger.send_burst(lines, SPEC, lines.t + 100_000_000).fault:
            faults += 1
    assert faults == 0
    assert len(lines.sent) == 10_000


def test_a_burst_can_be_stopped_only_before_it_begins():
    """The controller sends a whole burst as one transfer; before the transfer the program asks once if it must stop."""
    lines = Controller()
    questions = []

    def note_question() -> bool:
        questions.append("stop?")
        return False

    record = trigger.send_burst(lines, SPEC, 0, previous_rise_ns=None, stop=note_question)
    assert record.pulses == 16
    assert len(questions) == 1
    stopped_record = trigger.send_burst(lines, SPEC, 50_000_000, previous_rise_ns=None, stop=lambda: True)
    assert stopped_record.pulses == 0
    assert len(lines.sent) == 1


@pytest.mark.parametrize(("rate", "fault"), [(1.0, 0), (1.6, PiFault.PERIOD_TOO_SHORT), (0.2, PiFault.PULSE_TOO_LONG)])
def test_a_wrong_clock_is_a_fault(rate, fault):
    """A Pi's core clock changes where `core_freq` is not fixed, and with it the SPI clock.

    At 1.6 times the clock the transfer and its periods are too short. At a fifth of it pulses last 5 us, not 1 us.
    """
    assert trigger.send_burst(Controller(rate), SPEC, 0).fault == fault


def test_a_burst_too_soon_after_the_one_before_is_not_sent():
    lines = Controller()
    record = trigger.send_burst(lines, SPEC, 1_000_000, previous_rise_ns=1_000_000 - MIN_PERIOD_NS + 50_000)
    assert (record.pulses, record.fault) == (0, PiFault.PERIOD_TOO_SHORT)
    assert lines.sent == []


@pytest.fixture(params=["one-shot", "spi"])
def instrument(instrument, request):
    """The rig with the shipped wiring (one-shot), and with its alternative (SPI)."""
    if request.param == "one-shot":
        return instrument
    return time_by_spi(instrument)


@pytest.fixture
def source(instrument):
    """The part of the wiring that sets the width of pulses, by the name that events have for it."""
    return "spi" if instrument.pi.wiring == "spi" else "one-shot"


@pytest.fixture
def record_rises(hub, instrument):
    """Wire times of the next rising edges, each followed by its falling one."""
    with closing(WireClient(hub, listen=instrument.pi.sync_out)) as radar:

        def rises(pulses, width_ns=1000):
            edges = [radar.receive(HANG_S) for _ in range(2 * pulses)]
            assert all(isinstance(e, WireEdge) for e in edges)
            assert [e.value for e in edges] == [1, 0] * pulses
            rises_ns = [edge.t_ns for edge in edges[::2]]
            falls_ns = [edge.t_ns for edge in edges[1::2]]
            assert {fall - rise for rise, fall in zip(rises_ns, falls_ns, strict=True)} == {width_ns}
            return rises_ns

        yield rises
        # No further pulse comes.
        assert radar.receive(0.2) is None


def test_every_pulse_is_sent_once_and_bursts_keep_their_distance(pi, record_rises, source):
    period_ns = 400_000
    sent = [pi.host.ask(m.Pulse(pulses=n, period_us=period_ns / 1e3, width_us=1.0)) for n in (3, 20)]
    assert [s.pulses for s in sent] == [3, 20]
    for burst in sent:
        assert (burst.width_max_ns, burst.fault, burst.timed_by, burst.pulses_seen) == (1000, 0, source, True)
    periods_ns = [later - earlier for earlier, later in pairwise(record_rises(3 + 20))]
    # The third period is that between the two bursts.
    between_bursts_ns = periods_ns.pop(2)
    assert periods_ns == [period_ns] * 21
    assert between_bursts_ns >= period_ns


def test_pulses_beyond_one_transfer_are_sent_in_several(pi, record_rises, source):
    """64 pulses need 11.8 kB, and spidev's buffer holds 4 kB: no pulse is lost, and none comes too early."""
    sent = pi.host.ask(m.Pulse(pulses=64, period_us=1500.0, width_us=1.0))
    assert (sent.pulses, sent.fault, sent.timed_by) == (64, 0, source)
    assert min(later - earlier for earlier, later in pairwise(record_rises(64))) >= PERIOD_NS


# One pulse fewer on the return wire than were sent, one more, and none.
@pytest.mark.parametrize("seen", [lambda sent: sent - 1, lambda sent: sent + 1, lambda _: 0])
def test_other_pulses_on_the_return_wire_than_were_sent_are_a_fault(seen):
    """Each burst is compared with the return wire, so that a defective buffer or cable is found at the first point."""
    lines = FakeLines()
    lines.seen = seen
    posted = []
    loop = trigger.TriggerLoop(lines, posted.append, lambda: None)
    loop.arm(2, SPEC)
    loop._answer_edge(trigger.Edge(100_000_000, 1))
    sent, fault = posted
    assert (sent.record.pulses, fault.number) == (seen(16), PiFault.PULSES_UNSEEN)
    assert f"16 pulses sent, {seen(16)} seen" in fault.detail


def test_a_return_wire_that_is_cut_ends_the_row(pi, hub, instrument, monkeypatch):
    # How long the simulated wires wait for returned pulses; short, for a fast test.
    monkeypatch.setattr(pi_lines, "SIMULATED_LOOK_BACK_S", 0.2)
    with closing(WireClient(hub)) as cutter:
        pi.host.must_accept(pi.host.make_begin())
        pi.host.home()
        assert pi.host.run_row(0).pulses_seen
        # The hub's command to cut a wire, and its acknowledgement.
        cutter._socket.sendall(f"X {instrument.pi.pulses_in} 1\n".encode())
        assert cutter._read_line(HANG_S) == "K"
        row_finished = pi.host.run_row(1)
        assert (row_finished.fault, row_finished.pulses, row_finished.pulses_seen) == (PiFault.PULSES_UNSEEN, 0, True)
        assert all(c.pulses_seen for c in pi.host.list_events(m.Capture))


def test_single_pulses_are_refused_during_a_run_and_do_not_disturb_the_next_row(pi, instrument):
    pulse = m.Pulse(pulses=5, period_us=1500.0, width_us=1.0)
    assert not pi.host.ask(m.Hello()).in_run
    assert pi.host.ask(pulse).pulses == 5
    pi.host.must_accept(pi.host.make_begin())
    assert pi.host.ask(m.Hello()).in_run
    assert pi.host.must_refuse(pulse) == PiFault.NOT_READY
    pi.host.home()
    row_finished = pi.host.run_row(0)
    assert (row_finished.status, row_finished.pulses) == ("done", instrument.grid.columns * instrument.burst.pulses)
