"""The chain on a kernel's own GPIO chip: emulated UNO, serial port, trigger wire, libgpiod, the Pi's program, SYNC_IN.

`make test-uml` runs these; docs/decisions/0005-firmware.md lists its real parts. Figures are printed.
"""

import itertools
import sys
from statistics import quantiles
from typing import Any, NamedTuple

import pytest

from polysight_pi.edges import TOLERANCE
from polysight_shared.faults import PiFault

# Of instrument.toml: pulses of a burst, their period, and the GPIO line of SYNC_IN.
PULSES = 16
PERIOD_NS = 1_500_000
SYNC_OUT = 22
# Time between two positions: 2 mm at 20 mm/s.
SPACING_NS = 100_000_000
# Attempts at a row in real time, each half as fast as the one before
TAKES = 6
# Each reading of the clock advances virtual time by this (Linux, arch/um/kernel/time.c, TIMER_MULTIPLIER).
CLOCK_READING_NS = 256
FAULTS_OF_A_LATE_PROGRAM = (PiFault.EDGE_DURING_BURST, PiFault.PERIOD_TOO_SHORT, PiFault.PROGRAM_LATE)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


class Capture(NamedTuple):
    """A capture event of the Pi."""

    point: int
    column: int
    pulses: int
    edge_ns: int
    first_ns: int
    last_ns: int
    width_max_ns: int
    jitter_ns: int


class Pulse(NamedTuple):
    """A pulse as the kernel recorded it."""

    rise_ns: int
    fall_ns: int


def read_bursts(result: dict[str, Any]) -> list[tuple[Capture, list[Pulse]]]:
    """The Pi's capture events with their pulses, after checking that they agree with the kernel's record."""
    changes = result["changes"]
    assert {line for _, line, _ in changes} == {SYNC_OUT}
    levels = [value for _, _, value in changes]
    times_ns = [t_ns for t_ns, _, _ in changes]
    rises = [i for i, level in enumerate(levels) if level]
    # Each pulse ends before the next one begins.
    assert all(levels[i + 1] == 0 for i in rises)
    pulses = iter([Pulse(rise_ns=times_ns[i], fall_ns=times_ns[i + 1]) for i in rises])
    bursts = []
    for capture in itertools.starmap(Capture, result["captures"]):
        burst = list(itertools.islice(pulses, capture.pulses))
        assert len(burst) == capture.pulses
        assert capture.edge_ns < capture.first_ns <= burst[0].rise_ns
        assert burst[-2].rise_ns < capture.last_ns <= burst[-1].rise_ns
        assert max(p.fall_ns - p.rise_ns for p in burst) <= capture.width_max_ns
        bursts.append((capture, burst))
    # No pulse is left that no event reports.
    assert list(pulses) == []
    assert [c.point for c, _ in bursts] == list(range(len(bursts)))
    assert (result["pi_status"], result["left_high"]) == (0, 0)
    return bursts


def is_complete(result: dict[str, Any], points: int) -> bool:
    """True if the row ended without a fault, with a full burst at every point."""
    pulses = [Capture(*values).pulses for values in result["captures"]]
    no_fault, no_reason = 0, ""
    return result["finished"] == [points, no_fault, no_reason] and pulses == [PULSES] * points


def compute_period_errors_ns(bursts: list[tuple[Capture, list[Pulse]]]) -> list[int]:
    """Times between the rising edges of a burst, less the nominal period."""
    errors_ns = []
    for _, burst in bursts:
        for earlier, later in itertools.pairwise(burst):
            errors_ns.append(later.rise_ns - earlier.rise_ns - PERIOD_NS)
    return errors_ns


def print_figure(text: str) -> None:
    """One line to standard output, which `make test-uml` shows."""
    sys.stdout.write(text + "\n")


def print_figures(what: str, bursts: list[tuple[Capture, list[Pulse]]]) -> None:
    """The figures of docs/benchmarks.md."""
    errors = [e / 1e3 for e in sorted(compute_period_errors_ns(bursts))]
    latency = [(burst[0].rise_ns - capture.edge_ns) / 1e3 for capture, burst in bursts]
    cuts = quantiles(latency, n=1000, method="inclusive")
    width = max(p.fall_ns - p.rise_ns for _, burst in bursts for p in burst) / 1e3
    bound = max(capture.width_max_ns for capture, _ in bursts) / 1e3
    print_figure(f"{what}: {len(bursts)} positions, {sum(len(burst) for _, burst in bursts)} pulses, none lost")
    print_figure(f"  period error {errors[0]:+.2f} .. {errors[-1]:+.2f} us, median {errors[len(errors) // 2]:+.2f} us")
    print_figure(f"  edge to first pulse p50 {cuts[499]:.2f} us, p99.9 {cuts[998]:.2f} us")
    print_figure(f"  longest pulse {width:.2f} us, the Pi's bound of it {bound:.2f} us")


def test_a_published_row_in_virtual_time(run_row):
    """350 positions, 5600 pulses, nothing lost, and every period within 2 us of nominal."""
    result = run_row(350, "time-travel=inf-cpu")
    assert is_complete(result, 350), result["finished"]
    assert result["homings"] == 1
    bursts = read_bursts(result)
    print_figures("virtual time", bursts)
    assert sum(len(burst) for _, burst in bursts) == 350 * PULSES
    # 2 us are 0.13 % of a period of 1.5 ms.
    assert max(map(abs, compute_period_errors_ns(bursts))) <= 2_000
    edges = [capture.edge_ns for capture, _ in bursts]
    # In 0.5 ms the stage moves by 10 um, which is 0.5 % of the step between two positions.
    assert all(abs(later - earlier - SPACING_NS) <= 500_000 for earlier, later in itertools.pairwise(edges))


def measure_from_first_rise(burst: list[Pulse]) -> list[tuple[int, int]]:
    """Rise and fall of each pulse after the first rise of its burst, nanoseconds."""
    first_ns = burst[0].rise_ns
    return [(pulse.rise_ns - first_ns, pulse.fall_ns - first_ns) for pulse in burst]


def test_virtual_time_repeats_itself(run_row):
    """Two runs make the same bursts to the nanosecond; an edge, with its burst, may be one clock reading early or late.

    libzmq decides by the processor's cycle counter (rdtsc), which is real, whether it reads the guest's clock.
    """
    points = 12
    bursts = read_bursts(run_row(points, "time-travel=inf-cpu"))
    second_run = read_bursts(run_row(points, "time-travel=inf-cpu"))
    assert len(bursts) == points
    assert len(second_run) == points
    for (capture, pulses), (capture_again, pulses_again) in zip(bursts, second_run, strict=True):
        assert measure_from_first_rise(pulses) == measure_from_first_rise(pulses_again)
        edge_shift_ns = capture_again.edge_ns - capture.edge_ns
        assert pulses_again[0].rise_ns - pulses[0].rise_ns == edge_shift_ns
        assert abs(edge_shift_ns) <= CLOCK_READING_NS


def test_a_row_in_real_time(run_row):
    """A row is complete unless this machine was too busy, which the Pi then reports as a fault.

    The Pi requires edges within 1 % of an interval, and pulses within 1.2 ms. On a machine that is too busy for that,
    the row is repeated at half the speed. The simulated wire measures its own delay: a fault alone does not prove that
    the machine was busy.
    """
    speed_mm_s = 20.0
    for _ in range(TAKES):
        result = run_row(20, real_time=True, speed_mm_s=speed_mm_s)
        bursts = read_bursts(result)
        if result["homings"] > 1:
            print_figure(f"homed at the {result['homings']}th attempt: the Pi's program was late")
        if is_complete(result, 20):
            print_figures(f"real time at {speed_mm_s:g} mm/s", bursts)
            return
        fault = result["finished"][1]
        print_figure(f"a take at {speed_mm_s:g} mm/s ended with {result['finished']}, {result['late_ns']} ns late")
        # The Pi accepts edges that are off by up to `TOLERANCE` times the interval; a tenth of that is its own delay.
        interval_ns = SPACING_NS * 20.0 / speed_mm_s
        wire_was_late = result["late_ns"] > 0.9 * TOLERANCE * interval_ns
        assert fault in FAULTS_OF_A_LATE_PROGRAM or (fault == PiFault.EDGE_TIME and wire_was_late), result["finished"]
        speed_mm_s /= 2
    pytest.skip(f"this machine is too busy for a row in real time: each of {TAKES} attempts failed")
