"""Noise on the line and the switches of an emulated UNO with the compiled sketch must not move the stage.

The test advances the emulator's clock (`run_ms`); times are cycles of its processor.
"""

import random

import pytest

from polysight_shared.faults import StageError
from polysight_shared.stage_line import Immediate, Parameter
from polysight_simulators.uno import HZ

# Cycles of the processor in a microsecond and in a millisecond.
US = HZ // 1_000_000
MS = HZ // 1000
# Pins of the UNO.
TRIGGER = 2
X_PUL = 5
DRIVERS_OFF = 7
# Time after which the watchdog resets a program; its oscillator is accurate to 10 per cent.
WATCHDOG_MS = 250 * 1.1
# Highest rate of the stage, steps per second.
TOP_RATE = 20_000
# Bytes that a receiver reads from a slower sender are runs of equal bits; STATUS may come up among them by chance.
WRONG_BAUD_BYTES = [0x00, 0x78, 0x80, Immediate.STATUS, 0xE6, 0xF8]
# Traffic that is no heartbeat, by kind: a function that makes the bytes of a millisecond. At 115,200 baud the line
# carries 11.5 bytes in that time.
CHATTER = {
    "silence": lambda _: b"",
    "yes": lambda _: b"y\n" * 6,
    "line ends": lambda _: b"\n" * 12,
    "no line ends": lambda _: b"N" * 12,
    "heartbeats without end": lambda _: bytes([Immediate.STATUS]) * 12,
    "half lines": lambda _: b"N1 MOVE 0 0",
    "a wrong baud rate": lambda rng: bytes(rng.choice(WRONG_BAUD_BYTES) for _ in range(12)),
}


def move(x: int, y: int, rate: int) -> tuple[str, int, int, int]:
    """Verb and arguments of a motion to this position, steps, at this rate, steps per second."""
    return "MOVE", x, y, rate


def row(x0: int, dx: int, points: int, y: int, rate: int) -> tuple[str, int, int, int, int, int]:
    """Verb and arguments of a row: triggers at x0, x0 + dx, ... (steps), passed at this rate, steps per second."""
    return "ROW", x0, dx, points, y, rate


@pytest.mark.parametrize("kind", CHATTER)
def test_other_traffic_is_not_a_heartbeat(host, kind: str):
    """The stage stops within its heartbeat and ramp after the last STATUS byte, whatever else it receives."""
    rng = random.Random(kind)
    host.set(Parameter.HEARTBEAT, 500)
    host.uno.watch(X_PUL)
    host.must_obey(*move(x=100_000, y=0, rate=4000))
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

    # The heartbeat is 500 ms, to within 100 ms; the ramp from 4000 steps/s takes 100 ms, and 10 ms are to spare.
    assert silent_from + 400 * MS < steps[-1] <= silent_from + (600 + 100 + 10) * MS

    host.uno.settle()
    host.uno.run_ms(50)
    host.uno.received.clear()
    # The last line of the traffic may be incomplete.
    host.uno.feed(b"\n")
    host.uno.run_ms(20)
    host.uno.received.clear()
    status = host.ask_status()
    assert (status.integer("alarm"), status.integer("homed")) == (StageError.HEARTBEAT_LOST, 0)

    host.uno.edges.clear()
    host.uno.run_ms(500)
    assert host.uno.edges == []

    host.must_obey("CLEAR")
    assert host.send_command(*move(x=0, y=0, rate=4000)).number == StageError.NOT_HOMED


@pytest.mark.parametrize("verb", ["MOVE", "ROW", "HOME"])
def test_a_program_that_hangs_is_reset_by_the_watchdog(host, verb: str):
    """The main program hangs during motion: the motors stop, and the position is unknown."""
    commands = {
        "MOVE": move(x=100_000, y=0, rate=TOP_RATE),
        "ROW": row(x0=9000, dx=400, points=100, y=0, rate=4000),
        "HOME": ("HOME",),
    }
    if verb == "HOME":
        # The stage is then 100 mm from both switches: it is still on its way to one of them when the program hangs.
        host.run_motion(*move(x=20_000, y=20_000, rate=TOP_RATE))
    host.uno.watch(X_PUL, TRIGGER, DRIVERS_OFF)
    host.must_obey(*commands[verb])
    host.uno.run_ms(800)
    host.uno.edges.clear()

    host.uno.hang()
    hung = host.uno.cycle
    # The host does not notice it and still requests the status.
    for _ in range(20):
        host.uno.feed(bytes([Immediate.STATUS]))
        host.uno.run_ms(25)

    assert host.uno.troubles == ["watchdog"]
    last_step = max(e.cycle for e in host.uno.edges if e.pin == X_PUL and e.value)
    assert last_step <= hung + WATCHDOG_MS * MS
    last_edge = host.uno.edges[-1]
    assert (last_edge.pin, last_edge.value) == (DRIVERS_OFF, 1)
    replies = host.read_replies()
    assert replies[0].kind == "banner"
    assert replies[-1].integer("homed") == 0

    # After a reset it requires everything again: a greeting, motors on, homing.
    move_home = move(x=0, y=0, rate=4000)
    assert host.send_command(*move_home).number == StageError.SEQUENCE
    host.must_obey("HELLO")
    assert host.send_command(*move_home).number == StageError.DISABLED
    host.must_obey("ENABLE", 1)
    assert host.send_command(*move_home).number == StageError.NOT_HOMED
    host.set(Parameter.HEARTBEAT, 60_000)
    host.run_motion("HOME")


def test_a_program_that_works_is_never_reset(host):
    """The stage moves, and reads the longest lines and status requests, for four seconds without a reset.

    The watchdog would reset a program that is busy with one thing for 250 ms.
    """
    for y in (0, 400, 0, 400):
        host.must_obey(*row(x0=6000, dx=40, points=150, y=y, rate=TOP_RATE))
        for _ in range(40):
            host.uno.feed(b"N1 SET 0 1 2 3 4 5 6 7 8 9 1 2 3 4 5 6 7 8 9 1 2 3 4 5 6 7 8 9*0000\n" * 4)
            host.uno.feed(bytes([Immediate.STATUS]))
            host.uno.run_ms(25)
        host.uno.run_until_rest()
        host.read_replies()
    assert host.uno.troubles == []


# Bits of the switches: of x (1), of y (2), the emergency stop (4), and all of them.
@pytest.mark.parametrize("mask", [1, 2, 4, 7])
def test_a_glitch_is_not_a_switch(host, request: pytest.FixtureRequest, mask: int):
    """A switch that closes for up to 100 us at any moment of a row at 100 mm/s does not change the row."""
    rng = random.Random(mask)
    # Steps/s^2: the top rate is reached within 500 steps. At the usual 40,000 it would take 5000, and the row begins at
    # step 4000.
    host.set(Parameter.ACCEL, 400_000)
    host.uno.edges.clear()
    x0 = 4000
    dx = 400
    y = 500
    points = 120
    glitches_per_row = 250
    row_count = 4 if request.config.getoption("--long") else 1
    # The glitches take about a second; the row takes 120 * 400 / 20,000 = 2.4 s.
    longest_pause = 8 * MS
    for _ in range(row_count):
        host.must_obey(*row(x0, dx, points, y, rate=TOP_RATE))
        for _ in range(glitches_per_row):
            host.uno.run(rng.randint(0, longest_pause))
            host.uno.press(mask)
            host.uno.run(rng.choice([30, 60, 100]) * US)
            host.uno.press(0)
        host.uno.run_until_rest()
        (answer,) = host.read_replies()
        assert (answer.kind, answer.integer("points"), answer.integer("pulses")) == ("done", points, points)
    rising = [e for e in host.uno.edges if e.value]
    assert [host.find_position(e) for e in rising[-points:]] == [(x0 + dx * i, y) for i in range(points)]


@pytest.mark.parametrize("rate", [500, 4000, TOP_RATE])
@pytest.mark.parametrize(("mask", "number"), [(1, StageError.LIMIT_SWITCH), (4, StageError.EMERGENCY_STOP)])
def test_a_real_switch_stops_immediately(host, rate: int, mask: int, number: int):
    """The stage stops within six steps (30 um) of a hit switch, which stays closed for 15 ms at least."""
    most_steps = 6
    # Steps/s^2: the top rate is reached in 50 ms.
    host.set(Parameter.ACCEL, 400_000)
    host.uno.watch(X_PUL)
    host.must_obey(*move(x=40_000, y=0, rate=rate))
    host.uno.run_ms(400)
    host.uno.edges.clear()

    pressed = host.uno.cycle
    host.uno.press(mask)
    host.uno.run_ms(15)

    steps = [e.cycle for e in host.uno.edges if e.value]
    assert len(steps) <= most_steps
    if steps:
        # A step takes HZ / rate cycles.
        assert steps[-1] <= pressed + most_steps * HZ // rate
    host.uno.press(0)
    host.uno.run_ms(50)
    assert [(r.kind, r.number) for r in host.read_replies()] == [("alarm", number)]


def test_no_stray_byte_ends_a_hold(host):
    """During a hold only STOP ends the row and only RESUME continues it: other bytes do not move the stage."""
    host.uno.watch(X_PUL)
    host.must_obey(*row(x0=4000, dx=200, points=60, y=500, rate=4000))
    host.uno.run_ms(1200)
    host.uno.feed(bytes([Immediate.HOLD]))
    host.uno.run_until_rest()
    host.read_replies()
    host.uno.edges.clear()
    # One RESUME byte is among the stray bytes: only two in succession continue the row.
    stray_bytes = set(range(256)) - {Immediate.STOP}
    for byte in stray_bytes:
        host.uno.feed(bytes([byte]) + b"\n")
        host.uno.run_ms(15)
    host.uno.settle()
    assert host.uno.edges == []
    host.uno.feed(bytes([Immediate.RESUME, Immediate.RESUME]))
    host.uno.run_until_rest()
    assert host.read_replies()[-1].kind == "done"


@pytest.mark.parametrize("accel", [400, 2_000, 40_000])
def test_homing_overruns_the_switch_by_little(host, accel: int):
    """Homing overruns the switch by about a millimetre, which a switch tolerates, at any acceleration of the rows."""
    host.run_motion(*move(x=12_000, y=300, rate=TOP_RATE))
    host.set(Parameter.ACCEL, accel)
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("HOME")
    host.uno.run_until_rest()
    host.read_replies()
    lowest = min(e.x for e in host.uno.edges)
    # Steps after the closing point of the switch. Homing runs at 4000 steps/s, brakes at 40,000 steps/s^2 (1 mm), and
    # takes a few steps to notice the switch: 204 steps are measured.
    braking_steps = 4000**2 / (2 * 40_000)
    assert -1.25 * braking_steps <= lowest <= 0
    assert host.run_motion(*row(x0=6000, dx=200, points=3, y=500, rate=1000)).integer("points") == 3


def test_homing_reports_the_lost_steps(host):
    host.run_motion(*move(x=9000, y=700, rate=TOP_RATE))
    lost_x = -7
    lost_y = 12
    host.uno.slip(lost_x, lost_y)
    homed = host.run_motion("HOME")
    assert (homed.integer("lostx"), homed.integer("losty")) == (lost_x, lost_y)
    assert (homed.integer("x"), homed.integer("y")) == (0, 0)
    homed_again = host.run_motion("HOME")
    assert homed_again.integer("lostx") == 0
