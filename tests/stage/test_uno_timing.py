"""Speed and reaction time of the compiled sketch on an emulated UNO, in lockstep: exact on any machine."""

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
US = HZ // 1_000_000
MS = HZ // 1000
# Pin of the UNO for the steps in x.
X_PUL = 5
# Number of the step timer's interrupt (timer 1, compare A).
STEP_VECTOR = 11
# Highest rate of the stage, steps/s.
TOP_RATE = 20_000
# Cycles of a step's time at TOP_RATE that have to stay free, whichever compiler made the image: 1 us
MARGIN_CYCLES = 16
# Places of the Arduino IDE's compilers in a user's home folder
IDE_COMPILERS = (".arduino15/packages/arduino/tools/avr-gcc/*/bin", "arduino-*/hardware/tools/avr/bin")


def list_other_compilers() -> list[Path]:
    """Folders with an avr-gcc of the Arduino IDE, and those that POLYSIGHT_AVR_GCC lists, separated by colons."""
    named = [Path(p) for p in os.environ.get("POLYSIGHT_AVR_GCC", "").split(":") if p]
    return named + [compiler for pattern in IDE_COMPILERS for compiler in sorted(Path.home().glob(pattern))]


def read_documented_cycles() -> int:
    match = re.search(r"// Measured worst case: (\d+) cycles", (SKETCH / "hal_uno.cpp").read_text(encoding="ascii"))
    assert match is not None
    return int(match[1])


def measure_busiest_step(host: Host) -> int:
    """Cycles of the longest step interrupt of ramps, rows and moves in x and y together, at the highest rate.

    Bytes arrive all the time.
    """
    host.set(Parameter.TRAVEL_SPEED, TOP_RATE)
    host.set(Parameter.TRIGGER, 1)
    most = 0
    for accel in (40_000, 400_000, 1_000_000):
        host.set(Parameter.ACCEL, accel)
        for verb, args in (
            ("MOVE", (30_000, 29_000, TOP_RATE)),
            ("MOVE", (100, 8_000, TOP_RATE)),
            ("ROW", (12_000, 20, 300, 20_000, TOP_RATE)),
            ("ROW", (18_000, -40, 100, 0, TOP_RATE)),
        ):
            host.must_obey(verb, *args)
            for byte in (Immediate.STATUS, Immediate.HOLD, Immediate.RESUME) * 12:
                host.uno.feed(bytes([byte]) * 4)
                host.uno.run_ms(30)
            host.uno.run_until_rest()
            assert host.read_replies()[-1].kind == "done"
        cost = host.uno.read_cost()
        # A step waits for another interrupt that has begun: for 8 us at most.
        assert max(v for k, v in cost.interrupts.items() if k != STEP_VECTOR) <= 8 * US
        most = max(most, cost.interrupts[STEP_VECTOR])
        # What the motor drivers need (docs/spec/stage-line.md)
        assert cost.step_pulse >= 4 * US
        assert cost.direction_setup >= 20 * US
        assert cost.direction_hold >= 20 * US
    return most


def test_the_step_interrupt_fits_between_two_steps_and_takes_as_long_as_its_comment_says(host):
    most = measure_busiest_step(host)
    documented = read_documented_cycles()
    # The documented figure is an upper bound, at most 60 cycles above the measured one.
    assert documented - 60 <= most <= documented
    assert documented <= HZ // TOP_RATE - MARGIN_CYCLES


@pytest.mark.parametrize("folder", list_other_compilers() or [None])
def test_the_step_interrupt_of_another_compiler_fits_between_two_steps(make_uno, folder: Path | None):
    if folder is None:
        pytest.skip("no other avr-gcc: the Arduino IDE's is looked for in ~/.arduino15, others in POLYSIGHT_AVR_GCC")
    host = Host(make_uno(start=(300, 250), image=compile_firmware(folder))).prepare()
    assert measure_busiest_step(host) <= HZ // TOP_RATE - MARGIN_CYCLES


def test_the_highest_rate_is_kept_over_thousands_of_steps_while_the_host_asks_for_the_status(host):
    host.set(Parameter.ACCEL, 400_000)
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("MOVE", 20_000, 0, TOP_RATE)
    for _ in range(120):
        host.uno.feed(bytes([Immediate.STATUS]))
        host.uno.run_ms(8)
    host.uno.run_until_rest()
    times = [e.cycle for e in host.uno.edges if e.value]
    assert len(times) == 20_000
    # The ramps take v^2 / (2 a) = 500 steps; these steps lie well between them.
    cruise = times[2000:18_000]
    deviations = [t - i * HZ / TOP_RATE for i, t in enumerate(cruise)]
    # More than half of the 50 us between two steps would be felt by the motor.
    assert max(deviations) - min(deviations) <= 30 * US
    assert host.read_replies()[-1].kind == "done"


@pytest.mark.parametrize("byte", [Immediate.HOLD, Immediate.STOP])
@pytest.mark.parametrize("rate", [500, 4000, TOP_RATE])
def test_hold_and_stop_begin_within_20_ms(host, byte: Immediate, rate: int):
    accel = 40_000
    host.uno.watch(X_PUL)
    host.uno.edges.clear()
    host.must_obey("MOVE", 40_000, 0, rate)
    host.uno.run_ms(900.7)
    host.uno.feed(bytes([byte]))
    sent = host.uno.cycle
    host.uno.run_until_rest()
    times = [e.cycle for e in host.uno.edges if e.value]
    # Steps in which the stage slows down: v^2 / (2 a), rounded up.
    ramp = -(-rate * rate // (2 * accel))
    begins = times[-ramp - 1]
    assert sent <= begins <= sent + 20 * MS
    # The steps themselves show it, too: 20 ms after the byte they are slower by a per cent at least, over any 20 of
    # them. They end after the time of the ramp, of which 10 per cent more are allowed.
    late_edges = [t for t in times if t >= sent + 20 * MS]
    mean_intervals = [(after - before) / 20 for before, after in zip(late_edges, late_edges[20:], strict=False)]
    assert not mean_intervals or min(mean_intervals) > 1.01 * HZ / rate
    assert times[-1] <= sent + 20 * MS + 1.1 * HZ * rate / accel
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
    silent_from = host.uno.cycle
    host.must_obey("HOME")
    host.uno.run_until_rest()
    assert [(r.kind, r.number) for r in host.read_replies()] == [("alarm", StageError.HEARTBEAT_LOST)]
    steps = [e.cycle for e in host.uno.edges if e.value]
    # After the 500 ms the stage takes up to 100 ms to slow down. The command itself takes up to 15 ms before them.
    assert silent_from + 500 * MS < steps[-1] <= silent_from + (500 + 100 + 15) * MS
