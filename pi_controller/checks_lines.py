"""The lines' part of `polysight-pi check`: wiring, chip, every line, and what death of the program does to outputs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from polysight.pi_controller.finding import Finding, attempt
from polysight.pi_controller.lines_gpiod import (
    EVENT_BUFFER,
    find_chip,
    load_gpiod,
    output_settings,
    request,
    trigger_settings,
)
from polysight.pi_controller.lines_gpiomem import GpiomemLines
from polysight.pi_controller.wiring import check_wiring, pi_generation
from polysight.shared.config import Instrument, Pi
from polysight.shared.errors import PolysightError

MODULES = Path("/sys/module")
STRICT = "put `dtparam=strict_gpiod` into /boot/firmware/config.txt and start the Pi again"


def check_lines(instrument: Instrument, model: str, modules: Path = MODULES) -> Iterator[Finding]:
    """Check every line of [pi]. An output is held low for a moment; no pulse is sent.

    Parameters
    ----------
    instrument
        The rig.
    model
        What the computer calls itself.
    modules
        Where the kernel shows its modules' parameters.
    """
    pi = instrument.pi
    yield attempt("wiring", lambda: _wiring(instrument, model))
    path = ""

    def chip() -> str:
        nonlocal path
        gpiod = load_gpiod()
        found = find_chip(pi.gpio_chip, gpiod)
        try:
            with gpiod.Chip(found) as c:
                label = c.get_info().label
        except OSError as e:
            raise PolysightError(
                f"{found}: {e.strerror}", "no such device, or no permission", "set pi.gpio_chip; group gpio"
            ) from None
        path = found
        return f"{found} is {label!r}"

    yield attempt("GPIO chip", chip)
    if path:
        yield attempt(f"trigger line {pi.trigger_in}", lambda: _trigger(pi, path))
        for n in pi.sync_out:
            yield attempt(f"SYNC_IN line {n}", lambda n=n: _output(path, n))
        if pi.wiring == "gpiomem":
            yield attempt("GPIO registers", lambda: _registers(pi, path))
    if pi_generation(model) is not None:
        yield attempt("line release", lambda: _release(modules))


def _wiring(instrument: Instrument, model: str) -> str | Finding:
    warning = check_wiring(instrument, model)
    if warning:
        return Finding("wiring", "warn", warning, "fit a clock buffer behind one line (docs/how-to/wiring.md)")
    width = "its width is a one-shot's" if instrument.pi.one_shot else "its width is checked pulse by pulse"
    return f"{instrument.pi.wiring}; {width}"


def _trigger(pi: Pi, path: str) -> str:
    gpiod = load_gpiod()
    request(gpiod, path, (pi.trigger_in,), trigger_settings(pi, gpiod), EVENT_BUFFER).release()
    return f"rising edges with time stamps, {pi.trigger_bias}, debounced by {pi.trigger_debounce_us} us"


def _output(path: str, line: int) -> str:
    gpiod = load_gpiod()
    request(gpiod, path, (line,), output_settings(gpiod)).release()
    return "can be had, and is low"


def _registers(pi: Pi, path: str) -> str:
    GpiomemLines(pi, load_gpiod(), path).close()
    return f"{pi.gpiomem} shows the lines as the kernel does (not run on hardware)"


def _release(modules: Path) -> str | Finding:
    for module in ("pinctrl_bcm2835", "pinctrl_rp1"):
        try:
            keeps = (modules / module / "parameters" / "persist_gpio_outputs").read_text().strip() == "Y"
        except OSError:
            continue
        if keeps:
            found = (
                f"{module} keeps outputs as they were when a program dies: killed inside a pulse, it leaves them high"
            )
            return Finding("line release", "warn", found, STRICT)
        return "lines become inputs again when their program ends"
    return Finding(
        "line release", "warn", "this kernel does not say what becomes of outputs when their program dies", STRICT
    )
