"""Speed and reaction time of the compiled sketch on an emulated UNO.

The emulator's clock advances only when a test commands it, so that times are the same on any machine. They are cycles
of the UNO's processor. Positions and distances are in steps, rates in steps/s, accelerations in steps/s^2.
"""

import math
import os
import re
from pathlib import Path

import pytest
from tests.support.paths import REPO
from tests.support.stage.drivers import Host

from polysight_shared.faults import StageError
from polysight_shared.stage_line import Immediate, Parameter
from polysight_simulators.uno import HZ, compile_firmware

SKETCH = REPO / "arduino_stage"
# Cycles of the processor in a microsecond and in a millisecond.
US = HZ // 1_000_000
MS = HZ // 1000
# Pin of the UNO for the steps in x.
X_PUL = 5
# Number of the step timer's interrupt (timer 1, compare A).
STEP_VECTOR = 11
# Highest rate of the stage, steps/s.
TOP_RATE = 20_000
# Longest time that the step interrupt may take, whichever compiler made the image: 1 us less than the time between two
# steps at TOP_RATE.
LONGEST_STEP_CYCLES = HZ // TOP_RATE - 1 * US
# Motions in x and y together at TOP_RATE. Arguments of MOVE are x, y and rate; those of ROW are x of the first point,
# distance of two points, number of points, y and rate.
FAST_MOTIONS = (
    ("MOVE", (30_000, 29_000, TOP_RATE)),
    ("MOVE", (100, 8_000, TOP_RATE)),
    ("ROW", (12_000, 20, 300, 20_000, TOP_RATE)),
    ("ROW", (18_000, -40, 100, 0, TOP_RATE)),
)
# Folders of the Arduino IDE's compilers, relative to a user's home folder.
IDE_COMPILERS = (".arduino15/packages/arduino/tools/avr-gcc/*/bin", "arduino-*/hardware/tools/avr/bin")


def list_other_compilers() -> list[Path]:
    """Folders with an avr-gcc: of the Arduino IDE, and from POLYSIGHT_AVR_GCC, which separates folders by colons."""
    named = [Path(p) for p in os.environ.get("POLYSIGHT_AVR_GCC", "").split(":") if p]
    return named + [compiler for pattern in IDE_COMPILERS for compiler in sorted(Path.home().glob(pattern))]


def read_documented_cycles() -> int:
    match = re.search(r"// Measured worst case: (\d+) cycles", (SKETCH / "hal_uno.cpp").read_text(encoding="ascii"))
    assert match is not None
    return int(match[1])


def measure_busiest_step(host: Host) -> int:
    """Cycles of the longest step interrupt in `FAST_MOTIONS`, each with a slow, a faster and the fastest ramp.

    Bytes arrive during the ramps, and during constant speed.
    """
    host.set(Parameter.TRAVEL_SPEED, TOP_RATE)
    host.set(Parameter.TRIGGER, 1)
    most_cycles = 0
    for accel in (40_000, 400_000, 1_000_000):
        host.set(Parameter.ACCEL, accel)
        for verb, arguments in FAST_MOTIONS:
            host.must_obey(verb, *arguments)
            # Status requests, holds and resumptions in turn, for the first second of the motion. Four bytes arrive one
            # directly after another.
            for byte in (Immediate.STATUS, Immediate.HOLD, Immediate.RESUME) * 12:
                host.uno.feed(bytes([byte]) * 4)
                host.uno.run_ms(30)
            host.uno.run_until_rest()
            assert host.read_replies()[-1].kind == "done"
        cost = host.uno.read_cost()
        # A step waits for another interrupt that has begun: for 8 us at most.
        cycles_of_others = [cycles for vector, cycles in cost.interrupts.items() if vector != STEP_VECTOR]
        assert max(cycles_of_others) <= 8 * US
        most_cycles = max(most_cycles, cost.interrupts[STEP_VECTOR])
        # What the motor drivers need (docs/spec/stage-line.md)
        assert cost.step_pulse >= 4 * US
        assert cost.direction_setup >= 20 * US
        assert cost.direction_hold >= 20 * US
    return most_cycles


def test_the_step_interrupt_fits_between_two_steps_and_takes_as_long_as_its_comment_says(host):
    measured_cycles = measure_busiest_step(host)
    documented_cycles = read_documented_cycles()
    # The comment states an upper bound, at most 60 cycles above the measured ones.
    assert measured_cycles <= documented_cycles <= measured_cycles + 60
    assert documented_cycles <= LONGEST_STEP_CYCLES


@pytest.mark.parametrize("folder", list_other_compilers() or [None])
def test_the_step_interrupt_of_another_compiler_fits_between_two_steps(make_uno, folder: Path | None):
    if folder is None:
        pytest.skip("no other avr-gcc: the Arduino IDE's is looked for in ~/.arduino15, others in POLYSIGHT_AVR_GCC")
    # So near to the switches (1.5 mm in x, 1.25 mm in y) homing is soon done.
    start_steps = (300, 250)
    host = Host(make_uno(start=start_steps, image=compile_firmware(folder))).prepare()
    assert measure_busiest_step(host) <= LONGEST_STEP_CYCLES


def test_the_highest_rate_is_kept_over_thousands_of_steps_while_the_host_asks_for_the_status(host):
    accel = 400_000
    distance = 20_000
    host.set(Parameter.ACCEL, accel)
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("MOVE", distance, 0, TOP_RATE)
    # The move takes distance / TOP_RATE + TOP_RATE / accel = 1.05 s. The host asks for the status in the first 0.96 s.
    for _ in range(120):
        host.uno.feed(bytes([Immediate.STATUS]))
        host.uno.run_ms(8)
    host.uno.run_until_rest()
    times = [e.cycle for e in host.uno.edges if e.value]
    assert len(times) == distance
    # Each ramp takes v^2 / (2 a) = 500 steps. Only the steps between them are at TOP_RATE.
    times_at_top_rate = times[2000 : distance - 2000]
    delays = [t - i * HZ / TOP_RATE for i, t in enumerate(times_at_top_rate)]
    # Steps are 50 us apart; their delays differ by 7 us (measured).
    assert max(delays) - min(delays) <= 30 * US
    assert host.read_replies()[-1].kind == "done"


@pytest.mark.parametrize("byte", [Immediate.HOLD, Immediate.STOP])
@pytest.mark.parametrize("rate", [500, 4000, TOP_RATE])
def test_hold_and_stop_begin_within_20_ms(host, byte: Immediate, rate: int):
    accel = 40_000
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("MOVE", 40_000, 0, rate)
    # Even the longest ramp, to TOP_RATE, takes only rate / accel = 500 ms: the stage moves at a constant rate by then.
    host.uno.run_ms(900.7)
    host.uno.feed(bytes([byte]))
    sent = host.uno.cycle
    host.uno.run_until_rest()
    times = [e.cycle for e in host.uno.edges if e.value]
    # The stage slows down in the last v^2 / (2 a) steps; the step before them is the last one at the full rate.
    ramp_steps = math.ceil(rate**2 / (2 * accel))
    last_at_full_rate = times[-1 - ramp_steps]
    latest_begin = sent + 20 * MS
    assert sent <= last_at_full_rate <= latest_begin
    # After these 20 ms the stage is slower than before by more than 1 per cent. An interrupt delays a step by up to
    # 8 us, 0.8 per cent of 20 intervals at TOP_RATE: so the mean of 20 intervals is compared. At 500 steps/s the whole
    # ramp has only four steps, and nothing is compared.
    late_times = [t for t in times if t >= latest_begin]
    for earlier, later in zip(late_times, late_times[20:], strict=False):
        mean_interval = (later - earlier) / 20
        assert mean_interval > 1.01 * HZ / rate
    # The ramp takes rate / accel seconds; 10 per cent more are allowed.
    assert times[-1] <= latest_begin + 1.1 * rate / accel * HZ
    expected_alarms = [StageError.STOPPED] if byte == Immediate.STOP else []
    assert [r.number for r in host.read_replies()] == expected_alarms


def test_without_set_heartbeat_a_moving_stage_stops_after_half_a_second_of_silence(host):
    host.run_motion("MOVE", 20_000, 0, 8000)
    host.uno.reset()
    host.uno.run_ms(5)
    assert [r.kind for r in host.read_replies()] == ["banner"]
    host.must_obey("HELLO")
    host.must_obey("ENABLE", 1)
    host.uno.watch(X_PUL)
    begin_ms = host.uno.cycle / MS
    host.must_obey("HOME")
    host.uno.run_until_rest()
    assert [(r.kind, r.number) for r in host.read_replies()] == [("alarm", StageError.HEARTBEAT_LOST)]
    last_step_ms = max(e.cycle for e in host.uno.edges if e.value) / MS
    # The command HOME takes up to 15 ms on the line, then come 500 ms of silence, and up to 100 ms for the ramp.
    assert 500 < last_step_ms - begin_ms <= 15 + 500 + 100
