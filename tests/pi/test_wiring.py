"""Several SYNC_IN lines: which computer takes which wiring, what it costs, and what is refused."""

from __future__ import annotations

import msgspec
import pytest

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")

from polysight.pi_controller.wiring import check_wiring, open_lines, pi_generation, read_model, skew_in_if_hz
from polysight.shared.config import Pi
from polysight.shared.errors import ConfigError

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
        ("gpiomem", PI_4, "pinctrl-bcm2835"),
    ],
)
def test_what_cannot_work_is_refused_before_a_line_is_touched(instrument, wiring, model, chip):
    rig = with_pi(instrument, wiring=wiring, sync_out=LINES, gpio_chip=chip)
    with pytest.raises(ConfigError, match=wiring) as e:
        open_lines(rig, None, lambda _: None, model)
    assert "fanout" in e.value.remedy


def test_lines_of_another_register_are_refused_in_the_rig_file():
    with pytest.raises(ValueError, match=r"lines 0\.\.31"):
        Pi(wiring="gpiomem", sync_out=(22, 32))
