"""Whether the wiring of the SYNC_IN lines is right for this computer, and what several lines cost in the IF.

The kernel takes a request of several lines as one, but no Pi's GPIO driver writes them as one: they change one after
another (bcm2835 and bcm2711 tens of nanoseconds apart, rp1 of the Pi 5 some 200). Lines that differ by `t` shift the
boards' IF by `slope * t` against each other.
"""

from __future__ import annotations

import re
from pathlib import Path

from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError

MODEL_FILE = Path("/proc/device-tree/model")
# From one line to the next. Drawn from the drivers' sources; never measured by this project.
APART_NS = 50
APART_ON_PI_5_NS = 200
RP1_CHIP = "pinctrl-rp1"


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
    """Compare the wiring with the computer.

    Parameters
    ----------
    instrument
        The rig.
    model
        From :func:`read_model`.

    Returns
    -------
    str
        A warning with its figures; empty when there is nothing to warn of.

    Raises
    ------
    ConfigError
        when this wiring cannot work on this computer.
    """
    pi, chirp, generation = instrument.pi, instrument.chirp, pi_generation(model)
    name = model or "this computer"
    if pi.wiring == "gpiomem" and (generation is None or generation > 4):
        raise ConfigError(
            f'wiring = "gpiomem" is for a Raspberry Pi 1 to 4, not for {name}',
            "it writes registers that only those have",
            'use wiring = "fanout" with a clock buffer (docs/how-to/wiring.md)',
        )
    if pi.wiring != "lines" or len(pi.sync_out) == 1:
        return ""
    on_rp1 = pi.gpio_chip == RP1_CHIP or (generation or 0) >= 5
    apart_ns = APART_ON_PI_5_NS if on_rp1 else APART_NS
    shift_hz = skew_in_if_hz(len(pi.sync_out), apart_ns, chirp.slope_hz_per_s)
    figures = (
        f"its {len(pi.sync_out)} lines change some {apart_ns} ns one after another (not measured): from first to last"
        f" {(len(pi.sync_out) - 1) * apart_ns} ns, {shift_hz / 1e6:.1f} MHz of IF, in a band of"
        f" {0.9 * chirp.sample_rate_hz / 1e6:.1f} MHz"
    )
    if on_rp1:
        raise ConfigError(
            f'wiring = "lines" does not work on {name}: {figures}',
            "the Pi 5's GPIO driver paces its writes",
            'use wiring = "fanout" with a clock buffer (docs/how-to/wiring.md)',
        )
    return f'wiring = "lines": {figures}; a clock buffer behind one line (wiring = "fanout") has no such skew'
