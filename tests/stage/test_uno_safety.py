"""Noise on line and switches of an emulated UNO with the compiled sketch, in lockstep: nothing moves."""

from __future__ import annotations

import random

import pytest

from polysight_shared.stage_line import Immediate, Parameter
from polysight_simulators.uno import HZ

US = HZ // 1_000_000
MS = HZ // 1000
TRIGGER = 2
X_PUL = 5
DRIVERS_OFF = 7
WATCHDOG_MS = 250 * 1.1  # its oscillator is one of 10 %
# Steps/s
TOP_RATE = 20_000
CHATTER = {
    "silence": lambda _: b"",
    "yes": lambda _: b"y\n" * 6,
    "line ends": lambda _: b"\n" * 12,
    "no line ends": lambda _: b"N" * 12,
    "heartbeats without end": lambda _: bytes([Immediate.STATUS]) * 12,
    "half lines": lambda _: b"N1 MOVE 0 0",
    "a wrong baud rate": lambda rng: bytes(rng.choice([0x00, 0x78, 0x80, 0x84, 0xE6, 0xF8]) for _ in range(12)),
}  # each a millisecond and more of the line at 115,200 baud


@pytest.mark.parametrize("kind", CHATTER)
def test_chatter_is_no_heartbeat(host, kind: str):
    """The stage stops within its heartbeat and ramp after the last STATUS byte, whatever else it receives."""
    rng = random.Random(kind)
    host.set(Parameter.HEARTBEAT, 500)
    host.uno.watch(X_PUL)
    host.must_obey("MOVE", 100_000, 0, 4000)
    for _ in range(5):
        host.uno.run_ms(100)
        host.uno.feed(bytes([Immediate.STATUS]))
    host.uno.settle()
    silent_from = host.uno.cycle
    host.uno.edges.clear()
    for _ in range(900):
        host.uno.feed(CHATTER[kind](rng))
        host.uno.run_ms(1)
    steps = [e.cycle for e in host.uno.edges if e.value]
    assert silent_from + 400 * MS < steps[-1] <= silent_from + (600 + 100 + 10) * MS
    host.uno.settle()
    host.uno.run_ms(50)
    host.uno.received.clear()
    host.uno.feed(b"\n")
    host.uno.run_ms(20)
    host.uno.received.clear()
    status = host.status()
    assert (status.integer("alarm"), status.integer("homed")) == (11, 0)
    host.uno.edges.clear()
    host.uno.run_ms(500)
    assert host.uno.edges == []
    host.must_obey("CLEAR")
    # Home first
    assert host.command("MOVE", 0, 0, 4000).number == 8


@pytest.mark.parametrize("verb", ["MOVE", "ROW", "HOME"])
def test_a_program_that_hangs_is_reset_by_the_watchdog(host, verb: str):
    """The main program hangs during motion: the motors stop, and the position is unknown."""
    arguments = {"MOVE": (100_000, 0, TOP_RATE), "ROW": (9000, 400, 100, 0, 4000), "HOME": ()}[verb]
    if verb == "HOME":
        host.motion("MOVE", 20_000, 20_000, TOP_RATE)
    host.uno.watch(X_PUL, TRIGGER, DRIVERS_OFF)
    host.must_obey(verb, *arguments)
    host.uno.run_ms(800)
    host.uno.edges.clear()
    host.uno.hang()
    hung = host.uno.cycle
    # A host that notices nothing
    for _ in range(20):
        host.uno.feed(bytes([Immediate.STATUS]))
        host.uno.run_ms(25)
    assert host.uno.troubles == ["watchdog"]
    assert [e.cycle for e in host.uno.edges if e.pin == X_PUL and e.value][-1] <= hung + WATCHDOG_MS * MS
    assert [(e.pin, e.value) for e in host.uno.edges][-1] == (DRIVERS_OFF, 1)
    replies = host.replies()
    assert replies[0].kind == "banner"
    assert replies[-1].integer("homed") == 0
    assert host.command("MOVE", 0, 0, 4000).number == 18
    host.must_obey("HELLO")
    assert host.command("MOVE", 0, 0, 4000).number == 19
    host.must_obey("ENABLE", 1)
    assert host.command("MOVE", 0, 0, 4000).number == 8
    host.set(Parameter.HEARTBEAT, 60_000)
    host.motion("HOME")


def test_a_program_that_works_is_never_reset(host):
    """Four seconds of rows and of everything that takes the main program's time, with 250 ms of watchdog."""
    for turn in range(4):
        host.must_obey("ROW", 6000, 40, 150, 400 * (turn % 2), TOP_RATE)
        for _ in range(40):
            host.uno.feed(b"N1 SET 0 1 2 3 4 5 6 7 8 9 1 2 3 4 5 6 7 8 9 1 2 3 4 5 6 7 8 9*0000\n" * 4)
            host.uno.feed(bytes([Immediate.STATUS]))
            host.uno.run_ms(25)
        host.uno.rest()
        host.replies()
    assert host.uno.troubles == []


@pytest.mark.parametrize("mask", [1, 2, 4, 7])
def test_a_glitch_is_no_switch(host, request: pytest.FixtureRequest, mask: int):
    """Up to 100 us long, at any moment of a row at 100 mm/s: the row ends as if there had been none."""
    rng = random.Random(mask)
    host.set(Parameter.ACCEL, 400_000)
    host.uno.edges.clear()
    points = 120
    glitches = 0
    glitch_count = 1000 if request.config.getoption("--long") else 250
    while glitches < glitch_count:
        host.must_obey("ROW", 4000, 400, points, 500, TOP_RATE)
        for _ in range(250):
            host.uno.run(rng.randint(0, 8 * MS))
            host.uno.press(mask)
            host.uno.run(rng.choice([30, 60, 100]) * US)
            host.uno.press(0)
        glitches += 250
        host.uno.rest()
        (done,) = host.replies()
        assert (done.kind, done.integer("points"), done.integer("pulses")) == ("done", points, points)
    rising = [e for e in host.uno.edges if e.value]
    assert [host.at(e) for e in rising[-points:]] == [(4000 + 400 * i, 500) for i in range(points)]


@pytest.mark.parametrize("rate", [500, 4000, TOP_RATE])
@pytest.mark.parametrize(("mask", "number"), [(1, 12), (4, 14)])
def test_a_real_switch_stops_at_once(host, rate: int, mask: int, number: int):
    """One that stays closed for 15 ms, as every switch does: within five steps or six."""
    host.set(Parameter.ACCEL, 400_000)
    host.uno.watch(X_PUL)
    host.must_obey("MOVE", 40_000, 0, rate)
    host.uno.run_ms(400)
    host.uno.edges.clear()
    pressed = host.uno.cycle
    host.uno.press(mask)
    host.uno.run_ms(15)
    steps = [e.cycle for e in host.uno.edges if e.value]
    assert len(steps) <= 6
    assert not steps or steps[-1] <= pressed + 6 * HZ // rate
    host.uno.press(0)
    host.uno.run_ms(50)
    assert [(r.kind, r.number) for r in host.replies()] == [("alarm", number)]


def test_no_stray_byte_ends_a_hold(host):
    """Every byte but STOP during a hold: the stage does not move, and RESUME continues the row."""
    host.uno.watch(X_PUL)
    host.must_obey("ROW", 4000, 200, 60, 500, 4000)
    host.uno.run_ms(1200)
    host.uno.feed(bytes([Immediate.HOLD]))
    host.uno.rest()
    host.replies()
    host.uno.edges.clear()
    for byte in set(range(256)) - {Immediate.STOP}:
        host.uno.feed(bytes([byte]) + b"\n")
        host.uno.run_ms(15)
    host.uno.settle()
    assert host.uno.edges == []
    host.uno.feed(Immediate.RESUME.sent)
    host.uno.rest()
    assert host.replies()[-1].kind == "done"


@pytest.mark.parametrize("accel", [400, 2_000, 40_000])
def test_homing_overruns_the_switch_by_little(host, accel: int):
    """At any acceleration of rows at most about a millimetre, which a switch must tolerate."""
    host.motion("MOVE", 12_000, 300, TOP_RATE)
    host.set(Parameter.ACCEL, accel)
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("HOME")
    host.uno.rest()
    host.replies()
    lowest = min(e.x for e in host.uno.edges)
    # Steps behind the closing point; 200 are 1 mm
    assert -250 <= lowest <= 0
    assert host.motion("ROW", 6000 if accel > 400 else 60_000, 200, 3, 500, 1000).integer("points") == 3


def test_homing_tells_the_steps_that_were_lost(host):
    host.motion("MOVE", 9000, 700, TOP_RATE)
    host.uno.slip(-7, 12)
    done = host.motion("HOME")
    assert (done.integer("lostx"), done.integer("losty")) == (-7, 12)
    assert (host.motion("HOME").integer("lostx"), done.integer("x"), done.integer("y")) == (0, 0, 0)
