"""The GPIO backend against a stand-in chip with the real enums and settings."""

import msgspec
import pytest

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")

from gpiod import line

from polysight.pi_controller.bursts import BurstSpec, send_burst
from polysight.pi_controller.lines import EVENT_BUFFER, GpiodLines, find_chip, load_gpiod, open_lines
from polysight.pi_controller.trigger import FIRST_PULSE_DELAY_NS, Counts, TriggerLoop
from polysight.shared.config import Pi
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.faults import PiFault
from tests.support.pi.fake_gpiod import FakeChip
from tests.support.rigs import timed_by_the_program

SPEC = BurstSpec(4, 1_500_000, 1000)


@pytest.fixture
def instrument(instrument):
    """With SYNC_IN on a GPIO line."""
    return timed_by_the_program(instrument)


@pytest.fixture
def chip():
    return FakeChip()


@pytest.fixture
def lines(chip, instrument):
    return GpiodLines(instrument.pi, chip.module, chip.path, clock=chip, ioctl=chip.ioctl)


def test_lines_are_requested_as_the_rig_file_says(chip, lines, instrument):
    pi = instrument.pi
    trigger = chip.owner[pi.trigger_in]
    s = trigger.settings[pi.trigger_in]
    assert (s.edge_detection, s.event_clock, s.bias) == (line.Edge.RISING, line.Clock.MONOTONIC, line.Bias.PULL_DOWN)
    assert trigger.capacity == EVENT_BUFFER
    out = chip.owner[pi.sync_out[0]].settings[pi.sync_out[0]]
    assert (out.direction, out.output_value) == (line.Direction.OUTPUT, line.Value.INACTIVE)
    assert chip.level[pi.sync_out[0]] == 0
    lines.close()
    assert not any(chip.owner)


@pytest.mark.parametrize(("width_ns", "made_ns"), [(25, 0), (1000, 0), (1001, 1001), (4000, 4000)])
def test_an_edge_and_its_burst(chip, lines, width_ns, made_ns):
    """A short pulse is two calls with nothing between them: the clock stands still. A longer one is waited for."""
    chip.drive(26, 1, 5_000)
    chip.drive(26, 0, 25_000)
    edge = lines.wait_edge(0.1)
    assert edge == (5_000, 1)
    sent = send_burst(lines, SPEC._replace(width_ns=width_ns), edge.t_ns + FIRST_PULSE_DELAY_NS)
    starts = [edge.t_ns + FIRST_PULSE_DELAY_NS + k * SPEC.period_ns for k in range(4)]
    assert chip.log == [x for t in starts for x in ((t, 22, 1), (t + made_ns, 22, 0))]
    assert (sent.pulses, sent.width_max_ns) == (4, made_ns)


@pytest.mark.parametrize(("wiring", "sync_out"), [("lines", (22, 23, 24)), ("gpiomem", (22,))])
def test_what_is_not_driven_any_more_is_refused_before_a_line_is_touched(instrument, wiring, sync_out):
    pi = msgspec.structs.replace(instrument.pi, wiring=wiring, sync_out=sync_out)
    with pytest.raises(ConfigError, match=wiring) as e:
        open_lines(msgspec.structs.replace(instrument, pi=pi))
    assert "fanout" in e.value.remedy


def test_lines_of_another_register_are_refused_in_the_rig_file():
    with pytest.raises(ValueError, match=r"lines 0\.\.31"):
        Pi(wiring="gpiomem", sync_out=(22, 32))


def test_a_buffer_that_ran_over_is_seen_in_the_numbers(chip, instrument):
    lines = GpiodLines(instrument.pi, chip.module, chip.path, clock=chip, ioctl=chip.ioctl)
    posted = []
    loop = TriggerLoop(lines, posted.append, lambda: None)
    loop.arm(5000, SPEC)
    for i in range(EVENT_BUFFER + 3):
        chip.drive(26, 1, 10_000_000 * (i + 1))
        chip.drive(26, 0, 10_000_000 * (i + 1) + 20_000)
    first = lines.wait_edge(0)
    assert first is not None
    assert first.seqno == 4  # three were dropped
    loop._last_seqno = 0
    with loop._lock:
        loop._take(first)
    assert posted[0].number == PiFault.EDGE_LOST
    assert "3 edges" in posted[0].detail
    assert loop.disarm() == Counts(1, 0, 0)


def test_a_line_in_use_is_an_error_with_its_name(chip, lines, instrument):
    with pytest.raises(DeviceError, match=r"fault 107: GPIO line 22 .*held by 'polysight'"):
        GpiodLines(instrument.pi, chip.module, chip.path)
    lines.close()
    other = msgspec.structs.replace(instrument.pi, trigger_in=40)
    with pytest.raises(DeviceError, match="40"):
        GpiodLines(other, chip.module, chip.path)
    assert not any(chip.owner), "what was had before the error is released"


def test_a_chip_that_vanishes(chip, lines):
    chip.vanished = True
    with pytest.raises(DeviceError, match="gone"):
        lines.wait_edge(0.1)
    with pytest.raises(DeviceError, match="gone"):
        lines.pulse(1000)


def test_a_chip_that_is_not_there_lists_what_is(tmp_path):
    assert find_chip("/dev/gpiochip7", load_gpiod()) == "/dev/gpiochip7"
    (tmp_path / "gpiochip0").write_text("")
    with pytest.raises(DeviceError, match=r"pinctrl-bcm2835.*gpiochip0"):
        find_chip("pinctrl-bcm2835", load_gpiod(), tmp_path)
