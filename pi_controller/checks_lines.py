"""The lines' part of `polysight-pi check`: wiring, chip, every line, and what death of the program does to outputs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from polysight.pi_controller.burst import SHORTEST_PART, BurstSpec, bits_of
from polysight.pi_controller.finding import Finding, attempt
from polysight.pi_controller.lines_gpiod import (
    EVENT_BUFFER,
    GpiodLines,
    find_chip,
    load_gpiod,
    output_settings,
    request,
    trigger_settings,
)
from polysight.pi_controller.lines_gpiomem import GpiomemLines
from polysight.pi_controller.lines_spi import SpiDevice, read_bufsiz
from polysight.pi_controller.wiring import check_wiring, pi_generation
from polysight.shared.config import Instrument, Pi
from polysight.shared.errors import PolysightError
from polysight.shared.raster import MAX_WIDTH_NS, WIDTH_TEXT

TRANSFERS = 5
LONGEST_PART = 1.05  # of the time asked for: a system call takes some 100 us of the 22 ms
PAUSE_NS = 300_000
MODULES = Path("/sys/module")
STRICT = "put `dtparam=strict_gpiod` into /boot/firmware/config.txt and start the Pi again"


def check_lines(instrument: Instrument, model: str, modules: Path = MODULES) -> Iterator[Finding]:
    """Check every line of [pi], and measure the widths that this computer makes, with SYNC_IN low all the time.

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
        if pi.wiring == "spi":
            yield attempt(f"SYNC_IN line {pi.sync_out[0]}", lambda: _spi(pi))
        else:
            for n in pi.sync_out:
                yield attempt(f"SYNC_IN line {n}", lambda n=n: _output(path, n))
        if pi.wiring == "gpiomem":
            yield attempt("GPIO registers", lambda: _registers(pi, path))
        yield attempt("pulse width", lambda: _width(instrument, path))
    if pi_generation(model) is not None:
        yield attempt("line release", lambda: _release(modules))


def _wiring(instrument: Instrument, model: str) -> str | Finding:
    warning = check_wiring(instrument, model)
    if warning:
        return Finding("wiring", "warn", warning, "fit a clock buffer behind one line (docs/how-to/wiring.md)")
    width = "checked pulse by pulse"
    if instrument.pi.wiring == "spi":
        width = "the SPI controller's"
    elif instrument.pi.one_shot:
        width = "a one-shot's"
    return f"{instrument.pi.wiring}; its width is {width}"


def _spi(pi: Pi) -> str:
    SpiDevice(pi.spi_device).close()
    return f"MOSI of {pi.spi_device}, low; it takes transfers of {read_bufsiz()} bytes"


def _width(instrument: Instrument, path: str) -> str | Finding:
    """Measure the width of pulses without sending one: the same calls, and SYNC_IN stays low."""
    if instrument.pi.wiring == "spi":
        return measure_clock(instrument)
    gpiod = load_gpiod()
    lines = (GpiomemLines if instrument.pi.wiring == "gpiomem" else GpiodLines)(instrument.pi, gpiod, path)
    try:
        widths_ns = measure_calls(lines)
    finally:
        lines.close()
    return judge_widths(widths_ns, instrument.pi.one_shot)


def measure_clock(instrument: Instrument) -> str | Finding:
    """Clock out a burst's length of zeros, a few times; the shortest one tells the bit clock. Raises DeviceError."""
    device = SpiDevice(instrument.pi.spi_device)
    try:
        burst = bits_of(BurstSpec.of(instrument.burst), read_bufsiz())
        zeros = bytes(len(burst.data))
        took = [after - before for before, after in (device.transfer(zeros, burst.clock_hz) for _ in range(TRANSFERS))]
    finally:
        device.close()
    bit_ns = min(took) / (8 * len(zeros))
    found = f"a bit lasts {bit_ns / 1e3:.3f} us, asked for {burst.bit_ns / 1e3:.3f} us; spaced by the same clock"
    if SHORTEST_PART <= bit_ns / burst.bit_ns <= LONGEST_PART:
        return found + " (SPI controller, measured now with the line low)"
    remedy = "fix the Pi's core clock in /boot/firmware/config.txt: `core_freq=250` on a 3, `core_freq_min=500` on a 4"
    return Finding("pulse width", "fail", found, remedy)


def measure_calls(lines: GpiodLines, pairs: int = 500) -> list[int]:
    """Time from before a line is set until after it is cleared, where both calls leave it low, nanoseconds, sorted."""
    widths_ns = []
    for _ in range(pairs):
        lines.sleep_until(lines.now_ns() + PAUSE_NS)
        before = lines.now_ns()
        lines.set_output(False)
        lines.set_output(False)
        widths_ns.append(lines.now_ns() - before)
    return sorted(widths_ns)


def judge_widths(widths_ns: list[int], one_shot: bool) -> str | Finding:
    """A row needs thousands of pulses below 4 us: a hundredth above it is too much."""
    middle, high = widths_ns[len(widths_ns) // 2], widths_ns[len(widths_ns) * 99 // 100]
    found = f"two calls take {middle / 1e3:.1f} us in the middle, one in a hundred {high / 1e3:.1f} us or more"
    if one_shot:
        return f"{found}; a one-shot makes the width"
    if high <= MAX_WIDTH_NS:
        return f"{found} (measured now with the line low)"
    remedy = (
        'wire SYNC_IN to MOSI and set wiring = "spi", or fit a one-shot and set one_shot = true (docs/how-to/wiring.md)'
    )
    return Finding(
        "pulse width", "fail", f"{found}: the radar takes at most {WIDTH_TEXT}; rows would end in fault 105", remedy
    )


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
