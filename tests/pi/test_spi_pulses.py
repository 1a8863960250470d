"""Bursts as SPI transfers: the bits are a pure function of the burst, and the shipped one fits every Pi."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.refusals import refused
from tests.support.rigs import published_rig

from polysight_pi.lines import SpiWireLines
from polysight_pi.trigger import (
    DEFAULT_BUFSIZ,
    MAX_HZ,
    MIN_BYTES,
    MIN_HZ,
    BurstSpec,
    SpiBurst,
    send_burst,
    spi_burst,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.raster import MAX_WIDTH_NS, MIN_PERIOD_NS, MIN_WIDTH_NS

bursts = st.tuples(st.integers(1, 256), st.integers(MIN_PERIOD_NS, 20_000_000), st.integers(MIN_WIDTH_NS, MAX_WIDTH_NS))
ROOMY = 1 << 22


def ones(data: bytes) -> list[int]:
    """Indices of the set bits, most significant bit first."""
    return np.flatnonzero(np.unpackbits(np.frombuffer(data, np.uint8))).tolist()


@given(bursts)
def test_one_set_bit_a_pulse_at_its_place(burst):
    pulses, period_ns, width_ns = burst
    made = spi_burst(BurstSpec(pulses, period_ns, width_ns), ROOMY)
    assert MIN_HZ <= made.clock_hz <= MAX_HZ
    assert 500 <= made.bit_ns <= 2000
    assert MIN_WIDTH_NS <= made.bit_ns <= MAX_WIDTH_NS
    found = ones(made.data)
    assert tuple(found) == made.bits
    assert len(found) == pulses
    for k, bit in enumerate(found):
        assert abs((bit - found[0]) * made.bit_ns - k * period_ns) <= made.bit_ns / 2 + 1
    for a, b in itertools.pairwise(found):
        assert abs((b - a) * made.bit_ns - period_ns) <= made.bit_ns + 1
    assert made.data[0] == made.data[-1] == 0, "low before and after"
    assert len(made.data) >= MIN_BYTES


@given(bursts, st.integers(MIN_BYTES, 65_536))
def test_what_spidev_does_not_take_is_refused_with_what_to_set(burst, bufsiz):
    needed = len(spi_burst(BurstSpec(*burst), ROOMY).data)
    slowest = len(spi_burst(BurstSpec(burst[0], burst[1], 2000), ROOMY).data)
    if slowest > bufsiz:
        with refused(ErrorCode.VALUES_CONFLICT, bufsiz) as e:
            spi_burst(BurstSpec(*burst), bufsiz)
        wanted = int(e.value.remedy.partition("bufsiz=")[2].partition("`")[0])
        assert slowest <= wanted
        spi_burst(BurstSpec(*burst), wanted)
    else:
        assert len(spi_burst(BurstSpec(*burst), bufsiz).data) <= min(bufsiz, max(needed, slowest))


def test_the_published_burst_fits_every_pi_as_it_comes():
    b = published_rig().burst
    made = spi_burst(BurstSpec.of(b))
    assert SpiWireLines.bufsiz == DEFAULT_BUFSIZ == 4096
    assert (made.clock_hz, len(made.data)) == (1_000_000, 2815)
    assert [y - x for x, y in itertools.pairwise(made.bits)] == [1500] * 15


class Controller:
    """An SPI controller whose clock is `rate` times the requested one, and that begins `late_ns` late."""

    name = "fake"
    check_width = True

    def __init__(self, rate: float = 1.0, late_ns: int = 30_000, bufsiz: int = 4096) -> None:
        self.t, self.rate, self.late_ns, self.bufsiz = 0, rate, late_ns, bufsiz
        self.sent: list[tuple[int, SpiBurst]] = []

    def now_ns(self) -> int:
        return self.t

    def sleep_until(self, t_ns: int) -> None:
        self.t = max(self.t, t_ns)

    def wait_edge(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        before, self.t = self.t, self.t + self.late_ns + round(burst.duration_ns / self.rate)
        self.sent.append((before + self.late_ns, burst))
        return before, self.t


SPEC = BurstSpec(16, 1_500_000, 1000)


@pytest.mark.parametrize("late_ns", [0, 30_000, 200_000])
def test_a_record_bounds_what_the_controller_did(late_ns):
    lines = Controller(late_ns=late_ns)
    record = send_burst(lines, SPEC, 1_000_000)
    ((began, burst),) = lines.sent
    first = began + round(burst.bits[0] * burst.bit_ns)
    assert (record.pulses, record.fault) == (16, 0)
    assert abs(record.first_ns - first) <= record.jitter_ns
    assert record.last_ns - record.first_ns == 15 * 1_500_000
    assert 1000 <= record.width_max_ns <= 1010
    assert record.jitter_ns <= late_ns


def test_no_position_is_lost_to_a_width_fault():
    """10,000 positions of the shipped rig file; the kernel is up to 5 ms late in every call."""
    pi, rng = published_rig().pi, random.Random(1)
    assert pi.wiring == "spi"
    lines = Controller()
    faults = 0
    for _ in range(10_000):
        lines.late_ns = rng.randrange(5_000_000)
        faults += send_burst(lines, SPEC, lines.t + 100_000_000).fault != 0
    assert (faults, len(lines.sent)) == (0, 10_000)


def test_a_burst_can_be_stopped_only_before_it_begins():
    lines = Controller()
    asked = []
    record = send_burst(lines, SPEC, 0, None, lambda: bool(asked.append(1)))
    assert (record.pulses, len(asked)) == (16, 1)
    assert send_burst(lines, SPEC, 50_000_000, None, lambda: True).pulses == 0
    assert len(lines.sent) == 1


@pytest.mark.parametrize(("rate", "fault"), [(1.0, 0), (1.6, PiFault.PERIOD_TOO_SHORT), (0.2, PiFault.PULSE_TOO_LONG)])
def test_a_wrong_clock_is_a_fault(rate, fault):
    """A Pi's core clock changes where `core_freq` is not fixed, and with it the SPI clock."""
    assert send_burst(Controller(rate), SPEC, 0).fault == fault


def test_a_burst_that_would_come_too_soon_is_not_sent():
    lines = Controller()
    record = send_burst(lines, SPEC, 1_000_000, previous_rise_ns=1_000_000 - MIN_PERIOD_NS + 50_000)
    assert (record.pulses, record.fault, lines.sent) == (0, PiFault.PERIOD_TOO_SHORT, [])
