"""Firmware and Python stand-in send the same bytes and edges at the same ticks."""

from __future__ import annotations

import random

import pytest

from polysight_shared.stage_line import Command, Immediate


def _act(rng: random.Random, sequence: int) -> tuple[str, object]:
    kind = rng.choices(["command", "byte", "run", "rest", "press", "slip", "reset"], [40, 15, 30, 10, 2, 2, 1])[0]
    if kind == "command":
        x, y = rng.randint(-500, 20_000), rng.randint(-200, 9_000)
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
        return "rx", Command(sequence, verb, args).encode()
    if kind == "byte":
        return "rx", bytes([rng.choice(list(Immediate))])
    if kind == "run":
        return "run", rng.randint(1, 3_000_000)
    if kind == "rest":
        return "rest", 40_000_000
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
        ("rx", Command(n, v, a).encode()) for n, v, a in ((0, "HELLO", ()), (1, "ENABLE", (1,)), (2, "HOME", ()))
    ]
    script = [*greetings, ("rest", 40_000_000)]
    sequence = 2
    for _ in range(120):
        sequence += rng.random() < 0.9
        script.append(_act(rng, sequence))
    for i, (name, argument) in enumerate(script):
        arguments = argument if isinstance(argument, tuple) else () if argument is None else (argument,)
        for driver in drivers:
            getattr(driver, name)(*arguments)
        where = f"seed {seed}, action {i}: {name} {argument}"
        assert firmware.received == python.received, where
        assert firmware.wires == python.wires, where
        assert firmware.t_ns == python.t_ns, where
        for driver in drivers:
            driver.received = b""
            driver.wires.clear()


@pytest.mark.parametrize("steps_per_mm", [80.0, 157.48])
def test_same_positions_with_other_screws(both, steps_per_mm: float):
    firmware, python = both(steps_per_mm)
    for driver in (firmware, python):
        driver.ready()
        driver.motion("ROW", 3000, 77, 10, 1234, 1111)
    assert firmware.wires == python.wires
