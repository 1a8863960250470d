"""Opens the lines of a rig, after checking that their wiring suits this computer.

No Pi's GPIO driver writes several lines at once: they change one after another, on bcm2835 and bcm2711 tens of
nanoseconds apart, on rp1 (Pi 5) some 200. Lines that differ by `t` shift the boards' IF by `slope * t`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from polysight.pi_controller.gpio import GpiodLines, load_gpiod
from polysight.pi_controller.lines import TriggerLines
from polysight.pi_controller.sim_lines import SpiWireLines, WireLines
from polysight.pi_controller.spi import SpiLines
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError

MODEL_FILE = Path("/proc/device-tree/model")
# From one line to the next. Drawn from the drivers' sources; never measured by this project.
APART_NS = 50
APART_ON_PI_5_NS = 200
RP1_CHIP = "pinctrl-rp1"
ONE_LINE = 'use wiring = "spi", or "fanout", with a clock buffer behind one line (docs/how-to/wiring.md)'


def open_lines(
    instrument: Instrument, wires: Path | None, warn: Callable[[str], None], model: str | None = None
) -> TriggerLines:
    """The rig's lines on GPIO, or on simulated wires. `warn` takes what this wiring costs on this computer.

    Raises ConfigError or DeviceError when they cannot be had, or this wiring cannot work on this computer (`model`:
    what it calls itself).
    """
    if wires is not None:
        return (SpiWireLines if instrument.pi.wiring == "spi" else WireLines)(wires, instrument.pi)
    warning = check_wiring(instrument, read_model() if model is None else model)
    if warning:
        warn(warning)
    return (SpiLines if instrument.pi.wiring == "spi" else GpiodLines)(instrument.pi, load_gpiod())


def read_model(file: Path = MODEL_FILE) -> str:
    """What the computer calls itself; empty when it has no device tree."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip("\0 \n")
    except OSError:
        return ""


def pi_generation(model: str) -> int | None:
    """5 for `Raspberry Pi 5 Model B Rev 1.0`, 1 for the models before the numbers, None for what is no Pi."""
    if not model.startswith("Raspberry Pi"):
        return None
    number = re.match(r"Raspberry Pi (?:Compute Module )?(\d)", model)
    return int(number[1]) if number else 3 if "Zero 2" in model else 1


def skew_in_if_hz(lines: int, apart_ns: float, slope_hz_per_s: float) -> float:
    """IF shift between the boards of the first and the last line: slope x time between them, hertz."""
    return (lines - 1) * apart_ns * 1e-9 * slope_hz_per_s


def check_wiring(instrument: Instrument, model: str) -> str:
    """Compare the wiring with the computer. Returns a warning, or nothing. Raises ConfigError for what cannot work."""
    pi, chirp = instrument.pi, instrument.chirp
    name = model or "this computer"
    if pi.wiring == "gpiomem":
        raise ConfigError('wiring = "gpiomem" is not driven any more', "it wrote registers past the kernel", ONE_LINE)
    if pi.wiring != "lines" or len(pi.sync_out) == 1:
        return ""
    on_rp1 = pi.gpio_chip == RP1_CHIP or (pi_generation(model) or 0) >= 5
    apart_ns = APART_ON_PI_5_NS if on_rp1 else APART_NS
    shift_hz = skew_in_if_hz(len(pi.sync_out), apart_ns, chirp.slope_hz_per_s)
    figures = (
        f"its {len(pi.sync_out)} lines change some {apart_ns} ns one after another (not measured): from first to last"
        f" {(len(pi.sync_out) - 1) * apart_ns} ns, {shift_hz / 1e6:.1f} MHz of IF, in a band of"
        f" {0.9 * chirp.sample_rate_hz / 1e6:.1f} MHz"
    )
    if on_rp1:
        raise ConfigError(
            f'wiring = "lines" does not work on {name}: {figures}', "the Pi 5's GPIO driver paces its writes", ONE_LINE
        )
    return f'wiring = "lines": {figures}; a clock buffer behind one line (wiring = "fanout") has no such skew'
