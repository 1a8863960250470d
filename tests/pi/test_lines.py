"""GPIO and SPI lines without a chip: which lines are opened, and their system calls on a clock that tests turn."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import msgspec
import pytest
from tests.support.refusals import refused

from polysight_pi import lines as pi_lines
from polysight_pi.lines import GpiodLines, find_chip, open_lines
from polysight_pi.trigger import BurstSpec, send_burst
from polysight_shared.config import Instrument, Pi
from polysight_shared.error_codes import ErrorCode
from polysight_shared.tables import decode, to_builtins

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
SET_VALUES = 3 << 30 | 16 << 16 | 0xB4 << 8 | 0x0F  # <linux/gpio.h>: _IOWR(0xB4, 0x0F, two 64-bit words)


@pytest.mark.parametrize(("width_ns", "sent_ns"), [(25, 0), (1000, 0), (1001, 1001), (4000, 4000)])
def test_a_short_pulse_is_two_calls_with_nothing_between_them(gpio_rig, monkeypatch, width_ns, sent_ns):
    """The clock stands still between them; a longer pulse is waited for."""
    clock, log = SimpleNamespace(t=0), []

    def ioctl(fd, number, values):
        bits, mask = struct.unpack("=QQ", values)
        assert (fd, number, mask) == (7, SET_VALUES, 1)
        if not log or log[-1][1] != bits:
            log.append((clock.t, bits))

    request = SimpleNamespace(fd=7, release=lambda: None)
    monkeypatch.setattr(pi_lines, "_request", lambda *_, **__: request)
    monkeypatch.setattr(pi_lines.fcntl, "ioctl", ioctl)
    monkeypatch.setattr(pi_lines, "time", SimpleNamespace(monotonic_ns=lambda: clock.t))
    monkeypatch.setattr(pi_lines.TriggerInput, "sleep_until", lambda _, t_ns: setattr(clock, "t", max(clock.t, t_ns)))
    spec = BurstSpec(4, 1_500_000, width_ns)
    sent = send_burst(GpiodLines(gpio_rig.pi), spec, 5_000)
    starts = [5_000 + k * spec.period_ns for k in range(4)]
    assert [x for x in log if x[0]] == [x for t in starts for x in ((t, 1), (t + sent_ns, 0))]
    assert (sent.pulses, sent.width_max_ns) == (4, sent_ns)


@pytest.mark.parametrize(("wiring", "sync_out"), [("lines", (22, 23, 24)), ("gpiomem", (22,))])
def test_wirings_of_the_past_are_read_and_never_opened(gpio_rig, hub, wiring, sync_out):
    old = {"wiring": wiring, "sync_out": sync_out, "gpiomem": "/dev/gpiomem"}
    rig = msgspec.structs.replace(gpio_rig, pi=msgspec.structs.replace(gpio_rig.pi, **old))
    assert decode(to_builtins(rig), Instrument, "manifest") == rig
    for wires in (None, hub):
        with refused(ErrorCode.VALUE_INVALID, wiring, "fanout"):
            open_lines(rig, wires)


def test_spi_drives_its_mosi():
    with pytest.raises(ValueError, match="GPIO 10"):
        Pi(wiring="spi", sync_out=(22,))
    assert Pi(wiring="spi", sync_out=(20,), spi_device="/dev/spidev1.0").sync_out == (20,)


def test_a_missing_chip_is_reported_with_those_that_exist(tmp_path):
    assert find_chip("/dev/gpiochip7") == "/dev/gpiochip7"
    (tmp_path / "gpiochip0").write_text("")
    with refused(ErrorCode.FILE_MISSING, "pinctrl-bcm2835", "gpiochip0"):
        find_chip("pinctrl-bcm2835", tmp_path)
