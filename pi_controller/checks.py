"""`polysight-pi check`: every line, port, permission, clock, right, key and disk, named, with what to do."""

from __future__ import annotations

import ctypes
import os
import shutil
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import zmq

from polysight.pi_controller import AS_THE_SERVICE
from polysight.pi_controller.gpio import (
    EVENT_BUFFER,
    GpiodLines,
    find_chip,
    load_gpiod,
    output_settings,
    request,
    trigger_settings,
)
from polysight.pi_controller.journal import JournalFolder
from polysight.pi_controller.lines import BurstSpec, spi_burst
from polysight.pi_controller.sim_lines import WireLines
from polysight.pi_controller.spi import SpiDevice, read_bufsiz
from polysight.pi_controller.stage import bench_stage
from polysight.pi_controller.trigger import SHORTEST_PART
from polysight.pi_controller.wiring import check_wiring, pi_generation, read_model
from polysight.shared.config import Instrument, Pi
from polysight.shared.errors import DeviceError, PolysightError, os_error
from polysight.shared.raster import MAX_WIDTH_NS, WIDTH_TEXT, check_burst_fits
from polysight.shared.sockets import is_loopback, publisher, replier

JOURNAL_BYTES = 100 << 20  # a scan of 70,000 positions journals about 20 MB
TRANSFERS = 5
LONGEST_PART = 1.05  # of the time asked for: a system call takes some 100 us of the 22 ms
PAUSE_NS = 300_000
MODULES = Path("/sys/module")
STRICT = "put `dtparam=strict_gpiod` into /boot/firmware/config.txt and start the Pi again"
Verdict = Literal["ok", "warn", "fail"]


class Finding(NamedTuple):
    """One check: its name, how it went, what was found, and what to do when it is not ok."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""


def attempt(name: str, check: Callable[[], str | Finding]) -> Finding:
    """Run a check: ok with what it returns, its own finding, or fail with the error it raises."""
    try:
        found = check()
    except PolysightError as e:
        return Finding(name, "fail", e.what + (f" ({e.why})" if e.why else ""), e.remedy)
    except OSError as e:
        return Finding(name, "fail", os_error(e).what, AS_THE_SERVICE)
    return found if isinstance(found, Finding) else Finding(name, "ok", found)


def check_all(instrument: Instrument, wires: Path | None, stage_port: str, journal: Path) -> Iterator[Finding]:
    """Run every check, in the order in which a rig comes to life. Moves nothing and sends no pulse."""
    pi = instrument.pi
    yield attempt("plan", lambda: _plan(instrument))
    yield _clock()
    if wires is not None:
        yield Finding("real time", "ok", "simulated wires have their own time; no real-time rights are needed")
        yield attempt("simulated wires", lambda: _wires(instrument, wires))
    else:
        yield _schedule()
        yield _memory()
        yield from check_lines(instrument, read_model())
    yield attempt("stage port", lambda: _port(stage_port))
    yield attempt("stage", lambda: _stage(instrument, stage_port))
    yield attempt("journal", lambda: _journal(journal))
    yield attempt("disk", lambda: _disk(journal, min(instrument.limits.free_disk_bytes, JOURNAL_BYTES)))
    yield attempt("keys", lambda: _keys(Path(pi.key_dir), (pi.command_address, pi.event_address)))
    for name, address in (("command address", pi.command_address), ("event address", pi.event_address)):
        yield attempt(name, partial(_address, name, address, Path(pi.key_dir)))


def _plan(instrument: Instrument) -> str:
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    b = instrument.burst
    return f"burst of {b.pulses} x {b.period_us:g} us ends before the next point"


def _clock() -> Finding:
    step_ns = time.clock_getres(time.CLOCK_MONOTONIC) * 1e9
    if step_ns > 1000:
        return Finding("clock", "fail", f"CLOCK_MONOTONIC steps by {step_ns:.0f} ns", "use a kernel with hrtimers")
    return Finding("clock", "ok", f"CLOCK_MONOTONIC resolves {step_ns:.0f} ns")


def _schedule() -> Finding:
    old = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *old)
    except OSError as e:
        remedy = "LimitRTPRIO=99 in the service; without it other programs can delay a pulse"
        return Finding("schedule right", "warn", f"SCHED_FIFO is not permitted: {e.strerror}", remedy)
    return Finding("schedule right", "ok", "SCHED_FIFO is permitted")


def _memory() -> Finding:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(1) != 0:
        error = os.strerror(ctypes.get_errno())
        remedy = "LimitMEMLOCK=infinity in the service; without it a page fault can delay a pulse"
        return Finding("locked memory", "warn", f"not permitted: {error}", remedy)
    libc.munlockall()
    return Finding("locked memory", "ok", "memory may be locked")


def _wires(instrument: Instrument, wires: Path) -> str:
    WireLines(wires, instrument.pi, timeout_s=1.0).close()
    return f"{wires}: trigger {instrument.pi.trigger_in}, SYNC_IN {', '.join(map(str, instrument.pi.sync_out))}"


def _port(port: str) -> str:
    try:
        os.close(os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
    except OSError as e:
        remedy = {
            "PermissionError": "add the user to the group dialout",
            "FileNotFoundError": "plug it in, and correct stage.port: `ls -l /dev/ttyACM* /dev/ttyUSB*`",
        }.get(type(e).__name__, "end the other program, or unplug and plug in the board")
        raise DeviceError(f"{port}: {e.strerror}", "", remedy) from None
    return f"{port} can be opened"


def _stage(instrument: Instrument, port: str) -> str:
    with bench_stage(instrument.stage, port) as stage:
        here = stage.position()
        return f"{port} answers, firmware {stage.firmware or '?'}, at {here.x_mm:.2f}, {here.y_mm:.2f} mm"


def _journal(path: Path) -> str:
    JournalFolder(path).close()
    return f"{path} can be written"


def _disk(path: Path, needed: int) -> str:
    try:
        free = shutil.disk_usage(path if path.exists() else path.parent).free
    except OSError as e:
        raise DeviceError(f"{path}: {e.strerror}", "", "correct pi.journal_dir") from None
    if free < needed:
        raise DeviceError(
            f"{path}: {free >> 20} MiB free, {needed >> 20} MiB wanted", "the disk fills", "remove old journals there"
        )
    return f"{free >> 20} MiB free for journals"


def _keys(folder: Path, addresses: tuple[str, ...]) -> str | Finding:
    if all(is_loopback(a) for a in addresses):
        return "not needed: both addresses are loopback"
    secret = folder / "pi.key_secret"
    if not secret.is_file():
        raise DeviceError(f"{secret} is not there", "keys were not made yet", "polysight-pi keys")
    if secret.stat().st_mode & 0o077:
        found = f"{secret} can be read by others than its owner"
        return Finding("keys", "warn", found, f"chmod 600 {secret}; new ones with `polysight-pi keys --replace`")
    return f"{secret}"


def _address(name: str, address: str, key_dir: Path) -> str:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        make = replier if name.startswith("command") else publisher
        make(context, address, key_dir).close()
    finally:
        context.destroy(linger=0)
    return f"{address} can be bound" + (" (loopback, no keys needed)" if is_loopback(address) else " with CURVE keys")


# --- the lines --------------------------------------------------------------------------------------------------------


def check_lines(instrument: Instrument, model: str, modules: Path = MODULES) -> Iterator[Finding]:
    """Check every line of [pi], and measure the widths that this computer makes, with SYNC_IN low all the time.

    `model` is what the computer calls itself, `modules` where the kernel shows its modules' parameters.
    """
    pi = instrument.pi
    yield attempt("wiring", lambda: _wiring(instrument, model))
    chip = attempt("GPIO chip", lambda: _chip(pi))
    yield chip
    if chip.verdict == "ok":
        path = chip.found.partition(" is ")[0]
        yield attempt(f"trigger line {pi.trigger_in}", lambda: _trigger(pi, path))
        for n in pi.sync_out:
            yield attempt(f"SYNC_IN line {n}", partial(_spi, pi) if pi.wiring == "spi" else partial(_output, path, n))
        yield attempt("pulse width", lambda: _width(instrument, path))
    if pi_generation(model) is not None:
        yield attempt("line release", lambda: _release(modules))


def _wiring(instrument: Instrument, model: str) -> str | Finding:
    warning, pi = check_wiring(instrument, model), instrument.pi
    if warning:
        return Finding("wiring", "warn", warning, "fit a clock buffer behind one line (docs/how-to/wiring.md)")
    width = "a one-shot's" if pi.one_shot else "checked pulse by pulse"
    return f"{pi.wiring}; its width is {'the SPI controller' if pi.wiring == 'spi' else width}"


def _chip(pi: Pi) -> str:
    gpiod = load_gpiod()
    path = find_chip(pi.gpio_chip, gpiod)
    try:
        with gpiod.Chip(path) as c:
            return f"{path} is {c.get_info().label!r}"
    except OSError as e:
        raise PolysightError(
            f"{path}: {e.strerror}", "no such device, or no permission", "set pi.gpio_chip; group gpio"
        ) from None


def _trigger(pi: Pi, path: str) -> str:
    gpiod = load_gpiod()
    request(gpiod, path, (pi.trigger_in,), trigger_settings(pi, gpiod), EVENT_BUFFER).release()
    return f"rising edges with time stamps, {pi.trigger_bias}, debounced by {pi.trigger_debounce_us} us"


def _output(path: str, line: int) -> str:
    gpiod = load_gpiod()
    request(gpiod, path, (line,), output_settings(gpiod)).release()
    return "can be had, and is low"


def _spi(pi: Pi) -> str:
    SpiDevice(pi.spi_device).close()
    return f"MOSI of {pi.spi_device}, low; it takes transfers of {read_bufsiz()} bytes"


def _width(instrument: Instrument, path: str) -> str | Finding:
    """Measure the width of pulses without sending one: the same calls, and SYNC_IN stays low."""
    if instrument.pi.wiring == "spi":
        return measure_clock(instrument)
    lines = GpiodLines(instrument.pi, load_gpiod(), path)
    try:
        return judge_widths(measure_calls(lines), instrument.pi.one_shot)
    finally:
        lines.close()


def measure_clock(instrument: Instrument) -> str | Finding:
    """Clock out a burst's length of zeros, a few times; the shortest one tells the bit clock. Raises DeviceError."""
    device = SpiDevice(instrument.pi.spi_device)
    try:
        burst = spi_burst(BurstSpec.of(instrument.burst), read_bufsiz())
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
        widths_ns.append(lines.measure())
    return sorted(widths_ns)


def judge_widths(widths_ns: list[int], one_shot: bool) -> str | Finding:
    """A row needs thousands of pulses below 4 us: a hundredth above it is too much."""
    middle, high = widths_ns[len(widths_ns) // 2], widths_ns[len(widths_ns) * 99 // 100]
    found = f"two calls take {middle / 1e3:.1f} us in the middle, one in a hundred {high / 1e3:.1f} us or more"
    if one_shot:
        return f"{found}; a one-shot makes the width"
    if high <= MAX_WIDTH_NS:
        return f"{found} (measured now with the line low)"
    found += f": the radar takes at most {WIDTH_TEXT}; rows would end in fault 105"
    remedy = 'wire SYNC_IN to MOSI and set wiring = "spi", or fit a one-shot and set one_shot = true'
    return Finding("pulse width", "fail", found, f"{remedy} (docs/how-to/wiring.md)")


def _release(modules: Path) -> str | Finding:
    found = "this kernel does not say what becomes of outputs when their program dies"
    for module in ("pinctrl_bcm2835", "pinctrl_rp1"):
        try:
            keeps = (modules / module / "parameters" / "persist_gpio_outputs").read_text().strip() == "Y"
        except OSError:
            continue
        if not keeps:
            return "lines become inputs again when their program ends"
        found = f"{module} keeps outputs as they were when a program dies: killed inside a pulse, it leaves them high"
    return Finding("line release", "warn", found, STRICT)
