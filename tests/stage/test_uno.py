"""Laws of the compiled sketch on an emulated UNO.

The emulator's clock advances only when a test commands it, so that counts and times are the same on any machine.

Arguments of ROW are x of the first point, pitch, number of points, y and rate; those of MOVE are x, y and rate. Lengths
are in steps, rates in steps/s. Times of the emulator are cycles of its processor.
"""

import itertools
import math
import random

import pytest

from polysight_shared.faults import StageError
from polysight_shared.stage_line import Command, Immediate, Parameter
from polysight_simulators.stage import count_steps_to_zero
from polysight_simulators.uno import HZ

# Cycles of the processor in a microsecond and in a millisecond.
US = HZ // 1_000_000
MS = HZ // 1000
# Pins of the UNO: the trigger, and the steps of the motor in x and of the right motor in y. The left motor in y steps
# just before the right one.
TRIGGER = 2
X_PUL = 5
RIGHT_PUL = 4
# Random rows of one test.
ROWS_OF_BATCH = 20
# Highest rate of the stage, steps/s.
TOP_RATE = 20_000


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "batch" in metafunc.fixturenames:
        metafunc.parametrize("batch", range(500 if metafunc.config.getoption("--long") else 4))


def test_random_rows_have_a_trigger_at_each_point_and_lose_no_step(host, batch: int):
    """Each trigger is at its exact step count, in both directions. Triggers are evenly in time unless a row was held.

    A quarter of the rows is held and resumed once or twice at random moments: in travel, in a ramp, between triggers.
    """
    rng = random.Random(batch)
    host.set(Parameter.TRAVEL_SPEED, TOP_RATE)
    steps_to_trigger = set()
    x = 0
    y = 0
    zero_x, zero_y = host.zero
    for _ in range(ROWS_OF_BATCH):
        accel = rng.choice([200_000, 400_000, 1_000_000])
        rate = rng.choice([4000, TOP_RATE, rng.randint(3000, TOP_RATE)])
        # At most 800 points a second.
        shortest_pitch = math.ceil(rate / 800)
        pitch = rng.choice([-1, 1]) * rng.randint(shortest_pitch, 240)
        points = rng.randint(1, 14)
        width_us = rng.choice([1, 20, rng.randint(1, 500)])
        backlash = rng.choice([0, 0, 300])
        # Points, ramp and backlash lie within the travel: 160,000 steps in x and 100,000 in y.
        reach = abs(pitch) * points + rate * rate // (2 * accel) + 301
        x0 = min(max(x + rng.randint(-3000, 3000), reach), 160_000 - reach)
        y = min(max(y + rng.randint(-1000, 1000), backlash), 100_000)
        for parameter, value in (
            (Parameter.ACCEL, accel),
            (Parameter.TRIGGER, width_us),
            (Parameter.BACKLASH, backlash),
        ):
            host.set(parameter, value)
        host.uno.edges.clear()
        host.must_obey("ROW", x0, pitch, points, y, rate)
        holds = rng.choice([0, 0, 0, 0, 0, 0, 1, 2])
        for _ in range(holds):
            host.uno.run_ms(rng.uniform(0, 500))
            host.uno.feed(bytes([Immediate.HOLD]))
            host.uno.run_ms(rng.uniform(0, 150))
            host.uno.feed(Immediate.RESUME.sent)
        host.uno.run_until_rest()
        (done,) = host.read_replies()
        x = done.integer("x")
        hold_count = done.integer("held")
        assert (done.kind, done.integer("points"), done.integer("pulses")) == ("done", points, points)
        assert hold_count <= holds
        rising = host.uno.edges[::2]
        falling = host.uno.edges[1::2]
        assert [e.value for e in host.uno.edges] == [1, 0] * points
        assert [host.find_position(e) for e in rising] == [(x0 + i * pitch, y) for i in range(points)]
        steps_to_trigger |= {e.cycle - e.step_cycle for e in rising}
        # A step waits at most for another interrupt to end, which takes less than 16 us, and delays never add up.
        spacing = abs(pitch) * HZ / rate
        delays = [e.cycle - i * spacing for i, e in enumerate(rising)]
        if hold_count == 0:
            assert max(delays) - min(delays) <= 16 * US
        # Pulses are 1.5 to 31 us longer than they were set to be (measured).
        for rise, fall in zip(rising, falling, strict=True):
            excess = fall.cycle - rise.cycle - width_us * US
            assert -2 * US <= excess <= 60 * US
        assert host.uno.motors == (zero_x + x, zero_y + y, zero_y + y)
    # A trigger follows its step within 4 us, in which the stage moves 0.4 um at the highest rate.
    assert max(steps_to_trigger) - min(steps_to_trigger) <= 4 * US
    assert max(steps_to_trigger) <= 4 * US
    host.run_motion("MOVE", 0, 0, TOP_RATE)
    assert host.uno.motors == (zero_x, zero_y, zero_y)
    assert [t for t in host.uno.troubles if t != "reset"] == []


@pytest.mark.parametrize("accel", [400, 40_000, 400_000])
def test_homing_from_any_position_finds_the_zero_of_the_simulated_rig(host, accel: int):
    host.set(Parameter.ACCEL, accel)
    for x, y in ((900, 700), (377, 1111)):
        host.run_motion("MOVE", x, y, 2000)
        host.run_motion("HOME")
        assert host.uno.motors == (count_steps_to_zero(),) * 3


def test_a_row_is_approached_from_below_in_y_and_from_behind_in_x_by_the_backlash(host):
    """The play of the screws is then always on the same side."""
    first_x = 9000
    backlash = 700
    host.set(Parameter.BACKLASH, backlash)
    host.set(Parameter.TRAVEL_SPEED, TOP_RATE)
    host.uno.watch(TRIGGER, RIGHT_PUL, X_PUL)
    for y, pitch in ((3000, 100), (2500, -100), (2500, 100), (4000, -100)):
        host.run_motion("ROW", first_x, pitch, 5, y, 4000)
        ys = [host.find_position(e)[1] for e in host.uno.edges if e.pin == RIGHT_PUL and e.value]
        assert len(ys) >= backlash
        # The last steps in y go upwards.
        assert ys[-backlash:] == list(range(y - backlash + 1, y + 1))
        # The last steps in x before the first point all go in the row's direction.
        xs = [host.find_position(e)[0] for e in host.uno.edges if e.pin == X_PUL and e.value]
        assert xs.count(first_x) == 1
        first = xs.index(first_x)
        approach = xs[first - backlash : first]
        direction = 1 if pitch > 0 else -1
        assert {after - before for before, after in itertools.pairwise(approach)} == {direction}


def test_a_short_hold_is_reported_and_costs_no_step(host):
    """RESUME directly after HOLD: the row is reported as held even if the main program did not see the hold."""
    host.uno.edges.clear()
    host.must_obey("ROW", 3000, 100, 60, 0, 4000)
    while not host.uno.edges:
        host.uno.run_ms(20)
    for _ in range(5):
        host.uno.run_ms(83)
        host.uno.feed(bytes([Immediate.HOLD]) + Immediate.RESUME.sent)
    host.uno.run_until_rest()
    (done,) = host.read_replies()
    assert [done.integer(k) for k in ("points", "pulses", "held")] == [60, 60, 1]
    assert [host.find_position(e) for e in host.uno.edges if e.value] == [(3000 + 100 * i, 0) for i in range(60)]


@pytest.mark.parametrize("chatty", [False, True])
def test_no_command_is_lost_silently(host, chatty: bool):
    """To a host that does not wait for answers, every line is answered, or a loss is reported."""
    lines = []
    for i in range(100):
        if i % 7 == 0:
            lines.append(host.encode_command("MOVE", 10 + i, 0, 4000))
        else:
            lines.append(host.encode_command("CLEAR"))
    # Short lines that are no commands have answers six times as long: while the board writes these it loses lines.
    before_each_line = b"?\n" * 12 if chatty else b""
    host.uno.feed(b"".join(before_each_line + line for line in lines))
    host.uno.settle()
    host.uno.run_until_rest()
    host.uno.run_ms(300)
    replies = host.read_replies()
    answered = {r.sequence for r in replies if r.kind in ("ok", "error") and r.sequence is not None}
    unread = [r for r in replies if r.kind == "error" and r.sequence is None]
    expected_sequence = set(range(host.sequence - 99, host.sequence + 1))
    assert answered <= expected_sequence
    # Lines were lost, as the test needs, only between many others.
    has_lost_lines = answered != expected_sequence
    assert has_lost_lines == chatty
    # A loss is reported as a line that is too long.
    if has_lost_lines:
        assert any(r.number == StageError.LINE_TOO_LONG for r in unread)
    # The conversation continues: after a greeting any sequence number may follow.
    host.uno.feed(b"\n")
    host.read_replies()
    assert host.send_command("HELLO").kind == "ok"
    host.must_obey("CLEAR")


def test_a_command_during_a_motion_is_refused_as_busy(host):
    host.uno.feed(
        host.encode_command("MOVE", 400, 0, 4000)
        + host.encode_command("MOVE", 0, 0, 4000)
        + host.encode_command("CLEAR")
    )
    host.uno.run_until_rest()
    replies = [(r.kind, r.number) for r in host.read_replies()]
    assert replies == [("ok", 0), ("error", StageError.BUSY), ("error", StageError.BUSY), ("done", 0)]
    assert host.ask_status().integer("x") == 400


@pytest.mark.parametrize(
    ("mask", "alarm"),
    # Bits of the switches of x and y, and of the emergency stop.
    [(1, StageError.LIMIT_SWITCH), (2, StageError.LIMIT_SWITCH), (4, StageError.EMERGENCY_STOP)],
)
def test_a_switch_at_any_moment_is_an_alarm(host, request: pytest.FixtureRequest, mask: int, alarm: int):
    """A switch that closes at any time during a motion is an alarm, never `done`."""
    rng = random.Random(mask)
    host.must_obey("MOVE", 200, 200, 4000)
    host.uno.run_until_rest()
    host.read_replies()
    for _ in range(100 if request.config.getoption("--long") else 3):
        host.must_obey("MOVE", 900, 900, 2000)
        host.uno.run(rng.randint(20 * MS, 200 * MS))
        host.uno.press(mask)
        host.uno.run_ms(60)
        assert [(r.kind, r.number) for r in host.read_replies()] == [("alarm", alarm)]
        host.uno.press(0)
        host.uno.run_ms(8)
        host.must_obey("CLEAR")
        # The emergency stop has switched the motors off as well.
        refusal = StageError.DISABLED if alarm == StageError.EMERGENCY_STOP else StageError.NOT_HOMED
        assert host.send_command("MOVE", 0, 0, 4000).number == refusal
        host.must_obey("ENABLE", 1)
        host.run_motion("HOME")


def test_damaged_lines_do_not_disturb_a_row(host):
    """During a row a command arrives again and again, each time with another of its bits flipped."""
    line = Command(host.sequence + 2, "MOVE", (0, 0, 4000)).encode()
    host.uno.edges.clear()
    host.must_obey("ROW", 4000, 200, 60, 500, 4000)
    for bit in range(8 * len(line)):
        damaged = bytearray(line)
        damaged[bit // 8] ^= 1 << bit % 8
        # An immediate byte is obeyed within a line, too.
        if any(byte in list(Immediate) for byte in damaged):
            continue
        host.uno.feed(bytes(damaged) + b"\n")
        host.uno.run_ms(10)
    host.uno.run_until_rest()
    replies = host.read_replies()
    assert replies[-1].kind == "done"
    assert all(r.kind == "error" and r.sequence is None for r in replies[:-1])
    rising = [e for e in host.uno.edges if e.value]
    assert [host.find_position(e) for e in rising] == [(4000 + 200 * i, 500) for i in range(60)]
