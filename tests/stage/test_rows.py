"""Laws of a row: one trigger at each exact step count, evenly spaced in time, in both directions, and no step lost.

They hold for firmware and Python stand-in, which send the same bytes and edges at the same ticks.
"""

import itertools
import random

import pytest
from tests.support.stage.drivers import list_edges, list_motions

from polysight_shared.stage_line import Command, Immediate

# Steps
UM = 5  # per step
ACCEL = 40_000


def check_row(wires, x0: int, pitch: int, points: int, y: int, width_us: int):
    """The laws that hold for every row, held or not, except the even spacing."""
    times = [w.t_ns for w in wires]
    assert times == sorted(times)
    rising = [e for e in list_edges(wires) if e.value]
    falling = [e for e in list_edges(wires) if not e.value]
    assert len(rising) == len(falling) == points
    assert [f.t_ns - r.t_ns for r, f in zip(rising, falling, strict=True)] == [width_us * 1000] * points
    # The motion reported just before each rising edge, at the same time, is at the exact step count.
    for i, edge in enumerate(rising):
        motion = [m for m in list_motions(wires[: wires.index(edge)]) if m.t_ns == edge.t_ns][-1]
        assert (motion.x_um, motion.y_um) == ((x0 + i * pitch) * UM, y * UM)
    return rising


@pytest.mark.parametrize("seed", range(6))
def test_random_rows(stage, seed: int):
    rng = random.Random(seed)
    stage.prepare()
    for _ in range(4):
        if rng.random() < 0.5:
            rate = rng.choice([31, 100, 640, 3999, 4000, 7001, 20_000])
        else:
            rate = rng.randint(500, 20_000)
        pitch = rng.choice([-1, 1]) * rng.randint(40, 1200 if rate >= 500 else 150)
        points = rng.randint(1, 40 if rate >= 500 else 4)
        width_us = rng.randint(1, 40)
        reach = abs(pitch) * points + rate * rate // (2 * ACCEL) + 1
        x0 = rng.randint(reach, 160_000 - reach)
        y = rng.randint(0, 100_000)
        assert stage.send_command("SET", 2, width_us).kind == "ok"
        done, wires = stage.run_motion("ROW", x0, pitch, points, y, rate)
        assert (done.kind, done.integer("points"), done.integer("pulses")) == ("done", points, points)
        assert done.integer("held") == 0
        rising = check_row(wires, x0, pitch, points, y, width_us)
        # Even spacing: each edge within one timer tick of its ideal time, errors never add up.
        first = rising[0].t_ns
        spacing_ns = abs(pitch) / rate * 1e9
        assert all(abs(e.t_ns - first - i * spacing_ns) <= 500 for i, e in enumerate(rising))
        # Constant speed from one pitch before the first point to one pitch after the last.
        latest = {m.t_ns: m for m in list_motions(wires)}  # of several at one time, the last counts
        cruise = [m for t, m in latest.items() if first - spacing_ns - 500 <= t <= rising[-1].t_ns]
        sign = 1 if pitch > 0 else -1
        assert all(m.vx_um_s == sign * rate * UM for m in cruise)
        assert cruise[0].x_um == (x0 - pitch) * UM
        # At rest the reported motion is where the stage says it is.
        last = list_motions(wires)[-1]
        assert (last.vx_um_s, last.x_um, last.y_um) == (0, done.integer("x") * UM, y * UM)
    done, wires = stage.run_motion("MOVE", 0, 0, 10_000)
    assert (list_motions(wires)[-1].x_um, list_motions(wires)[-1].y_um) == (0, 0)


@pytest.mark.parametrize("seed", range(6))
def test_hold_resumes_on_the_exact_grid(stage, seed: int):
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
    for _ in range(3):
        stage.run_ms(rng.uniform(350, 650))
        stage.send(bytes([Immediate.HOLD]))
        stage.run_ms(600)
        hold_count += stage.ask_status().fields["state"] == "hold"
        assert list_motions(stage.wires)[-1].vx_um_s == 0
        stage.send(Immediate.RESUME.sent)
    stage.run_until_rest()
    (done,) = stage.read_replies()
    assert hold_count == 3
    assert (done.integer("points"), done.integer("pulses"), done.integer("held")) == (points, points, 1)
    check_row(stage.wires, x0, pitch, points, y, 20)
    assert done.integer("x") == x0 + pitch * points + (pitch // 300) * (rate * rate // (2 * ACCEL) + 1)


@pytest.mark.parametrize("accel", [2_000, 40_000, 400_000])
def test_ramps_keep_to_the_acceleration(stage, accel: int):
    stage.prepare()
    assert stage.send_command("SET", 0, accel).kind == "ok"
    stage.wires.clear()
    _, wires = stage.run_motion("MOVE", 60_000, 20_000, 6000)
    speeds = {m.t_ns: m.vx_um_s / UM for m in list_motions(wires) if m.vx_um_s > 0}
    for (t0, v0), (t1, v1) in itertools.pairwise(speeds.items()):
        assert abs(v1 - v0) <= 1.1 * accel * (t1 - t0) * 1e-9 + 5
    assert max(speeds.values()) == 6000
    # The whole move takes the time of a trapezium: cruise time plus one ramp.
    took_s = (wires[-1].t_ns - wires[0].t_ns) * 1e-9
    assert took_s == pytest.approx(60_000 / 6000 + 6000 / accel, rel=0.02)


def test_stop_ends_the_triggers_and_keeps_the_position(stage):
    stage.prepare()
    stage.wires.clear()
    assert stage.send_command("ROW", 20_000, 400, 50, 0, 4000).kind == "ok"
    stage.run_ms(5_500)
    rising_edges = len([e for e in list_edges(stage.wires) if e.value])
    assert 0 < rising_edges < 50
    stage.send(bytes([Immediate.STOP]))
    stage.run_until_rest()
    assert [r.kind for r in stage.read_replies()] == ["alarm"]
    status = stage.ask_status()
    rising = [e for e in list_edges(stage.wires) if e.value]
    assert rising_edges <= len(rising) <= rising_edges + 1
    assert status.integer("points") == status.integer("pulses") == len(rising)
    assert list_motions(stage.wires)[-1].x_um == status.integer("x") * UM
    stage.run_ms(5_000)
    assert len([e for e in list_edges(stage.wires) if e.value]) == len(rising)


def _draw_action(rng: random.Random, sequence: int) -> tuple[str, object]:
    kind = rng.choices(["command", "byte", "run", "rest", "press", "slip", "reset"], [40, 15, 30, 10, 2, 2, 1])[0]
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
    if kind == "run":
        return "run", rng.randint(1, 3_000_000)
    if kind == "rest":
        return "run_until_rest", 40_000_000
    if kind == "press":
        return "press", rng.choice([0, 0, 0, 1, 2, 4])
    if kind == "slip":
        return "slip", (rng.randint(-50, 50), rng.randint(-50, 50))
    return "reset", None


@pytest.mark.parametrize("seed", range(10))
def test_same_words_and_same_wires(both, seed: int):
    firmware, python = drivers = both()
    rng = random.Random(seed)
    greetings = [
        ("send", Command(n, v, a).encode()) for n, v, a in ((0, "HELLO", ()), (1, "ENABLE", (1,)), (2, "HOME", ()))
    ]
    script = [*greetings, ("run_until_rest", 40_000_000)]
    sequence = 2
    for _ in range(120):
        sequence += rng.random() < 0.9
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
def test_same_positions_with_other_screws(both, steps_per_mm: float):
    firmware, python = both(steps_per_mm)
    for driver in (firmware, python):
        driver.prepare()
        driver.run_motion("ROW", 3000, 77, 10, 1234, 1111)
    assert firmware.wires == python.wires
