"""Several SYNC_IN lines: which computer takes which wiring, what it costs, and the registers of the Pi 1 to 4."""

from __future__ import annotations

import struct

import msgspec
import pytest

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")

from polysight.pi_controller.burst import BurstSpec, send_burst
from polysight.pi_controller.lines_gpiomem import GPCLR0, GPFSEL0, GPSET0, GpiomemLines, GpioRegisters
from polysight.pi_controller.service import open_lines
from polysight.pi_controller.wiring import check_wiring, pi_generation, read_model, skew_in_if_hz
from polysight.shared.config import Pi
from polysight.shared.errors import ConfigError, DeviceError
from tests.support.pi.fake_gpiod import FakeChip

PI_4, PI_5 = "Raspberry Pi 4 Model B Rev 1.4", "Raspberry Pi 5 Model B Rev 1.0"
LINES = (22, 23, 24)


def with_pi(instrument, **changes):
    return msgspec.structs.replace(instrument, pi=msgspec.structs.replace(instrument.pi, **changes))


@pytest.mark.parametrize(
    ("model", "generation"),
    [
        ("", None),
        ("QEMU Virtual Machine", None),
        ("Raspberry Pi Model B Rev 2", 1),
        ("Raspberry Pi Zero W Rev 1.1", 1),
        ("Raspberry Pi Zero 2 W Rev 1.0", 3),
        ("Raspberry Pi 3 Model B Plus Rev 1.3", 3),
        (PI_4, 4),
        ("Raspberry Pi 400 Rev 1.0", 4),
        ("Raspberry Pi Compute Module 4 Rev 1.0", 4),
        (PI_5, 5),
        ("Raspberry Pi 500 Rev 1.0", 5),
    ],
)
def test_models(model, generation, tmp_path):
    assert pi_generation(model) == generation
    (tmp_path / "model").write_bytes(model.encode() + b"\0")
    assert read_model(tmp_path / "model") == model
    assert read_model(tmp_path / "none") == ""


def test_skew_in_if_terms(instrument):
    """38.8 kHz of IF for each nanosecond."""
    slope = instrument.chirp.slope_hz_per_s
    assert skew_in_if_hz(2, 1.0, slope) == pytest.approx(38_816.929)
    assert skew_in_if_hz(1, 50.0, slope) == 0.0
    warning = check_wiring(with_pi(instrument, wiring="lines", sync_out=LINES), PI_4)
    assert "100 ns, 3.9 MHz of IF, in a band of 1.9 MHz" in warning


def test_fanout_goes_everywhere(instrument):
    for model in ("", PI_4, PI_5):
        assert check_wiring(instrument, model) == ""


@pytest.mark.parametrize(
    ("wiring", "model", "chip"),
    [
        ("lines", PI_5, "pinctrl-bcm2835"),
        ("lines", "", "pinctrl-rp1"),
        ("gpiomem", PI_5, "pinctrl-bcm2835"),
        ("gpiomem", "", "pinctrl-bcm2835"),
    ],
)
def test_what_cannot_work_is_refused_before_a_line_is_touched(instrument, wiring, model, chip):
    rig = with_pi(instrument, wiring=wiring, sync_out=LINES, gpio_chip=chip)
    with pytest.raises(ConfigError, match=wiring) as e:
        open_lines(rig, None, model)
    assert "fanout" in e.value.remedy


@pytest.fixture
def registers(tmp_path):
    """An ordinary file in place of the register block; lines 22..24 are outputs, as the kernel would have made them."""
    path = tmp_path / "gpiomem"
    block = bytearray(4096)
    struct.pack_into("<I", block, GPFSEL0 + 4 * 2, 0b001_001_001 << 6)  # GPFSEL2: lines 20..29, three bits each
    path.write_bytes(block)
    return path


def word(path, offset):
    return struct.unpack_from("<I", path.read_bytes(), offset)[0]


def test_one_store_sets_all_lines(registers, instrument):
    rig = with_pi(instrument, wiring="gpiomem", sync_out=LINES, gpiomem=str(registers))
    chip = FakeChip()
    lines = GpiomemLines(rig.pi, chip.module, chip.path, clock=chip)
    assert lines.name == "gpiomem"
    assert all(chip.owner[n] for n in LINES), "the kernel keeps others away"
    untouched = registers.read_bytes()
    lines.set_output(True)
    assert word(registers, GPSET0) == 0b111 << 22
    assert word(registers, GPCLR0) == 0
    lines.set_output(False)
    assert word(registers, GPCLR0) == 0b111 << 22
    changed = {k // 4 * 4 for k, (a, b) in enumerate(zip(untouched, registers.read_bytes(), strict=True)) if a != b}
    assert changed == {GPSET0, GPCLR0}, "no other register was written"
    sent = send_burst(lines, BurstSpec(4, 1_500_000, 1000), 1000)
    assert (sent.pulses, sent.fault, chip.log) == (4, 0, []), "levels are not written through the kernel"
    lines.close()
    assert not any(chip.owner)


def test_lines_of_another_register_are_refused_in_the_rig_file():
    with pytest.raises(ValueError, match=r"lines 0\.\.31"):
        Pi(wiring="gpiomem", sync_out=(22, 32))


def test_registers_that_are_not_this_chips_are_refused(registers, instrument):
    rig = with_pi(instrument, wiring="gpiomem", sync_out=(21, 22), gpiomem=str(registers))
    chip = FakeChip()
    with pytest.raises(DeviceError, match="line 21 as no output"):
        GpiomemLines(rig.pi, chip.module, chip.path, clock=chip)
    assert not any(chip.owner)


def test_registers_that_cannot_be_mapped(tmp_path):
    with pytest.raises(DeviceError, match="cannot be mapped"):
        GpioRegisters(str(tmp_path / "none"))
    (tmp_path / "short").write_bytes(b"")
    with pytest.raises(DeviceError, match="cannot be mapped"):
        GpioRegisters(str(tmp_path / "short"))
