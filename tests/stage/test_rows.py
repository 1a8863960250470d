"""Laws of a row: one trigger at each exact step count, evenly spaced in time, in both directions, and no step lost.

The laws hold for the firmware and for its stand-in in Python. Both send the same bytes and edges at the same ticks.

Arguments of ROW are x of the first point, pitch, number of points, y and rate; those of MOVE are x, y and rate. Lengths
are in steps, rates in steps/s.
"""

import itertools
import random

import pytest
from tests.support.stage.drivers import list_edges, list_motions

from polysight_shared.stage_line import Command, Immediate, Parameter

# Micrometres per step.
UM = 5
# Acceleration of a stage after power-on, steps/s^2.
ACCEL = 40_000
# A tick of the stage's timer.
TICK_NS = 500


def compute_ramp_steps(rate: int) -> int:
    """Steps from rest to this rate: v^2 / (2 a) and at most one more."""
    return rate * rate // (2 * ACCEL) + 1


def list_rising(wires) -> list:
    """The beginnings of all triggers."""
    return [edge for edge in list_edges(wires) if edge.value]


def check_row(wires, *, x0: int, pitch: int, points: int, y: int, width_us: int):
    """Check all laws of a row except the even spacing, which a held row does not have.

    Returns the rising edges of the triggers.
    """
    times = [w.t_ns for w in wires]
    assert times == sorted(times)
    rising = list_rising(wires)
    falling = [e for e in list_edges(wires) if not e.value]
    assert len(rising) == len(falling) == points
    assert [f.t_ns - r.t_ns for r, f in zip(rising, falling, strict=True)] == [width_us * 1000] * points
    # The motion reported just before each rising edge, at the same time, is at the exact step count.
    for i, edge in enumerate(rising):
        earlier_messages = wires[: wires.index(edge)]
        motion = [m for m in list_motions(earlier_messages) if m.t_ns == edge.t_ns][-1]
        assert (motion.x_um, motion.y_um) == ((x0 + i * pitch) * UM, y * UM)
    return rising


@pytest.mark.parametrize("seed", range(6))
def test_random_rows_have_a_trigger_at_each_point_evenly_in_time(stage, seed: int):
    rng = random.Random(seed)
    stage.prepare()
    for _ in range(4):
        # Rates from the lowest to the highest, some of which divide the timer's 2 MHz and some of which do not.
        if rng.random() < 0.5:
            rate = rng.choice([31, 100, 640, 3999, 4000, 7001, 20_000])
        else:
            rate = rng.randint(500, 20_000)
        # Slow rows are short, so that the test is not long.
        is_slow = rate < 500
        pitch = rng.choice([-1, 1]) * rng.randint(40, 150 if is_slow else 1200)
        points = rng.randint(1, 4 if is_slow else 40)
        width_us = rng.randint(1, 40)
        # The row and its ramps lie within the travel.
        reach = abs(pitch) * points + compute_ramp_steps(rate)
        x0 = rng.randint(reach, 160_000 - reach)
        y = rng.randint(0, 100_000)
        assert stage.send_command("SET", Parameter.TRIGGER, width_us).kind == "ok"
        done, wires = stage.run_motion("ROW", x0, pitch, points, y, rate)
        assert (done.kind, done.integer("points"), done.integer("pulses")) == ("done", points, points)
        assert done.integer("held") == 0
        rising = check_row(wires, x0=x0, pitch=pitch, points=points, y=y, width_us=width_us)
        # Even spacing: each edge within one timer tick of its ideal time, errors never add up.
        first = rising[0].t_ns
        spacing_ns = abs(pitch) / rate * 1e9
        assert all(abs(e.t_ns - first - i * spacing_ns) <= TICK_NS for i, e in enumerate(rising))
        # Constant speed from one pitch before the first point to one pitch after the last. Of several motions that are
        # reported at one time, the last counts.
        motion_at = {m.t_ns: m for m in list_motions(wires)}
        cruise = [m for t, m in motion_at.items() if first - spacing_ns - TICK_NS <= t <= rising[-1].t_ns]
        sign = 1 if pitch > 0 else -1
        assert all(m.vx_um_s == sign * rate * UM for m in cruise)
        assert cruise[0].x_um == (x0 - pitch) * UM
        # At rest the reported motion has the position that the stage reports.
        last = list_motions(wires)[-1]
        assert (last.vx_um_s, last.x_um, last.y_um) == (0, done.integer("x") * UM, y * UM)
    done, wires = stage.run_motion("MOVE", 0, 0, 10_000)
    last = list_motions(wires)[-1]
    assert (last.x_um, last.y_um) == (0, 0)


@pytest.mark.parametrize("seed", range(6))
def test_after_a_hold_a_row_continues_on_its_exact_grid(stage, seed: int):
    rng = random.Random(seed)
    stage.prepare()
    x0 = 40_000
    pitch = rng.choice([-300, 300])
    points = 30
    y = 500
    rate = 5000
    stage.run_motion("MOVE", x0 - pitch, y, 10_000)
    stage.wires.clear()
    assert stage.send_command("ROW", x0, pitch, points, y, rate).kind == "ok"
    hold_count = 0
    # The row takes 30 x 300 steps / 5000 steps/s = 1.8 s. Three holds fall into it, and after 600 ms the stage is at
    # rest: its ramp takes 125 ms.
    for _ in range(3):
        stage.run_ms(rng.uniform(350, 650))
        stage.send(bytes([Immediate.HOLD]))
        stage.run_ms(600)
        if stage.ask_status().fields["state"] == "hold":
            hold_count += 1
        assert list_motions(stage.wires)[-1].vx_um_s == 0
        stage.send(Immediate.RESUME.sent)
    stage.run_until_rest()
    (done,) = stage.read_replies()
    assert hold_count == 3
    assert (done.integer("points"), done.integer("pulses"), done.integer("held")) == (points, points, 1)
    # A trigger is 20 us wide unless it is set.
    check_row(stage.wires, x0=x0, pitch=pitch, points=points, y=y, width_us=20)
    # The row ends one pitch after its last point, and the stage slows down from there.
    direction = 1 if pitch > 0 else -1
    assert done.integer("x") == x0 + pitch * points + direction * compute_ramp_steps(rate)


@pytest.mark.parametrize("accel", [2_000, 40_000, 400_000])
def test_ramps_keep_to_the_acceleration(stage, accel: int):
    rate = 6000
    distance = 60_000
    stage.prepare()
    assert stage.send_command("SET", Parameter.ACCEL, accel).kind == "ok"
    stage.wires.clear()
    _, wires = stage.run_motion("MOVE", distance, 20_000, rate)
    speeds = {m.t_ns: m.vx_um_s / UM for m in list_motions(wires) if m.vx_um_s > 0}
    for (earlier_ns, earlier_speed), (later_ns, later_speed) in itertools.pairwise(speeds.items()):
        longest_change = accel * (later_ns - earlier_ns) * 1e-9
        # The time between two steps is a whole number of timer ticks: 10 per cent and 5 steps/s more are allowed.
        assert abs(later_speed - earlier_speed) <= 1.1 * longest_change + 5
    assert max(speeds.values()) == rate
    # The speed over time is a trapezium: the two ramps add the time of one ramp to that of the distance at full speed.
    duration_s = (wires[-1].t_ns - wires[0].t_ns) * 1e-9
    assert duration_s == pytest.approx(distance / rate + rate / accel, rel=0.02)


def test_stop_ends_the_triggers_and_keeps_the_position(stage):
    stage.prepare()
    stage.wires.clear()
    assert stage.send_command("ROW", 20_000, 400, 50, 0, 4000).kind == "ok"
    # The stage reaches the row after some 5 s, and the row takes as long.
    stage.run_ms(5_500)
    triggers_before_stop = len(list_rising(stage.wires))
    assert 0 < triggers_before_stop < 50
    stage.send(bytes([Immediate.STOP]))
    stage.run_until_rest()
    assert [r.kind for r in stage.read_replies()] == ["alarm"]
    status = stage.ask_status()
    triggers = len(list_rising(stage.wires))
    # One more trigger may have begun before the byte was read.
    assert triggers in (triggers_before_stop, triggers_before_stop + 1)
    assert status.integer("points") == status.integer("pulses") == triggers
    assert list_motions(stage.wires)[-1].x_um == status.integer("x") * UM
    stage.run_ms(5_000)
    assert len(list_rising(stage.wires)) == triggers


def _draw_action(rng: random.Random, sequence: int) -> tuple[str, object]:
    """Draw something to do with a stage: the name of a driver's method, and its arguments.

    Some commands are drawn twice, so that the stage is homed and enabled for much of the time; some arguments are
    outside of the travel.
    """
    weights = {"command": 40, "byte": 15, "run": 30, "rest": 10, "press": 2, "slip": 2, "reset": 1}
    (kind,) = rng.choices(list(weights), list(weights.values()))
    if kind == "command":
        x = rng.randint(-500, 20_000)
        y = rng.randint(-200, 9_000)
        verb, args = rng.choice(
            [
                ("HELLO", ()),
                ("CLEAR", ()),
                ("CLEAR", ()),
                ("ENABLE", (rng.choice([1, 1, 1, 0]),)),
                ("HOME", ()),
                ("HOME", ()),
                ("SET", (rng.randint(0, 2), rng.choice([30, 500, 5_000, 60_000]))),
                ("SET", (rng.randint(3, 6), rng.choice([3_000, 30_000]))),
                ("MOVE", (x, y, rng.randint(20, 20_500))),
                ("ROW", (x, rng.randint(-300, 300), rng.randint(1, 30), y, rng.randint(500, 20_000))),
                ("ROW", (x, rng.choice([-250, 250]), rng.randint(1, 20), y, rng.randint(500, 5_000))),
            ]
        )
        return "send", Command(sequence, verb, args).encode()
    if kind == "byte":
        return "send", bytes([rng.choice(list(Immediate))])
    # Ticks of the timer, 2 a microsecond: up to 1.5 s, and to rest within 20 s.
    if kind == "run":
        return "run", rng.randint(1, 3_000_000)
    if kind == "rest":
        return "run_until_rest", 40_000_000
    if kind == "press":
        # Bits of the switches: of x, of y, and the emergency stop; 0 releases them.
        return "press", rng.choice([0, 0, 0, 1, 2, 4])
    if kind == "slip":
        return "slip", (rng.randint(-50, 50), rng.randint(-50, 50))
    return "reset", None


@pytest.mark.parametrize("seed", range(10))
def test_firmware_and_stand_in_have_the_same_replies_wires_and_clock(both, seed: int):
    firmware, python = drivers = both()
    rng = random.Random(seed)
    script = [
        ("send", Command(0, "HELLO", ()).encode()),
        ("send", Command(1, "ENABLE", (1,)).encode()),
        ("send", Command(2, "HOME", ()).encode()),
        ("run_until_rest", 40_000_000),
    ]
    sequence = 2
    for _ in range(120):
        # One action in ten repeats the sequence number of the previous one.
        if rng.random() < 0.9:
            sequence += 1
        script.append(_draw_action(rng, sequence))
    for i, (name, argument) in enumerate(script):
        if isinstance(argument, tuple):
            arguments = argument
        elif argument is None:
            arguments = ()
        else:
            arguments = (argument,)
        for driver in drivers:
            getattr(driver, name)(*arguments)
        place = f"seed {seed}, action {i}: {name} {argument}"
        assert firmware.received == python.received, place
        assert firmware.wires == python.wires, place
        assert firmware.t_ns == python.t_ns, place
        for driver in drivers:
            driver.received = b""
            driver.wires.clear()


@pytest.mark.parametrize("steps_per_mm", [80.0, 157.48])
def test_firmware_and_stand_in_have_the_same_wires_with_other_screws(both, steps_per_mm: float):
    """157.48 steps/mm are 4000 steps an inch: then a step is no whole number of micrometres."""
    firmware, python = both(steps_per_mm)
    for driver in (firmware, python):
        driver.prepare()
        driver.run_motion("ROW", 3000, 77, 10, 1234, 1111)
    assert firmware.wires == python.wires
