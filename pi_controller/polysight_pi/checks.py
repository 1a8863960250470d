"""`polysight-pi check`: tests lines, permissions, ports, keys and disk. Moves nothing, sends no pulse."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zmq
from zmq.auth import load_certificate

from polysight_pi import RIG_FILE, advise_as_service, system
from polysight_pi.journal import Journal
from polysight_pi.keys import read_allowed
from polysight_pi.lines import (
    GpiodLines,
    SpiDevice,
    TriggerInput,
    check_wiring,
    find_chip,
    load_gpiod,
    open_lines,
    request_output,
)
from polysight_pi.stage import BenchStage
from polysight_pi.trigger import MIN_DURATION_SHARE, BurstSpec, make_spi_burst
from polysight_shared.config import Instrument, Pi
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError, convert_os_error, quote
from polysight_shared.findings import Finding
from polysight_shared.raster import MAX_WIDTH_NS, WIDTH_TEXT, check_burst_fits
from polysight_shared.sockets import (
    PI_SECRET_KEY,
    advise_keys,
    advise_owner,
    create_publisher,
    create_replier,
    is_loopback,
    make_server_context,
)

# Free space that the journals need: a scan of 70,000 positions journals about 20 MB.
JOURNAL_BYTES = 100 << 20
# Number of SPI transfers that are timed; chosen, the shortest counts.
TIMED_TRANSFERS = 5
# Longest duration of a bit relative to the nominal one (`MIN_DURATION_SHARE` is the shortest): the system call adds
# about 100 us to a transfer of 22 ms.
MAX_DURATION_SHARE = 1.05
# Number of pulses whose two system calls (set the line, clear it) are timed; chosen.
TIMED_PULSES = 500
# Pause between two pairs: the shortest period of the pulses.
PAUSE_NS = 300_000
# The device tree's name of the computer.
MODEL_FILE = Path("/proc/device-tree/model")
# Parameters of the kernel's modules.
MODULES_FOLDER = Path("/sys/module")
# Remedy for a kernel that does not release outputs.
STRICT_REMEDY = "put `dtparam=strict_gpiod` into /boot/firmware/config.txt and reboot the Pi"
# Verdict in the command's output for each level of a finding.
VERDICTS = {"ok": "ok", "note": "ok", "warning": "warn", "error": "fail"}


def to_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as the object that `check --json` prints."""
    text = finding.what + (f" ({finding.why})" if finding.why else "")
    return {"name": finding.where, "verdict": VERDICTS[finding.level], "found": text, "remedy": finding.do}


def run_check(name: str, check: Callable[..., str | Finding], *args: object) -> Finding:
    """Run `check(*args)`. A text it returns becomes a finding of level `ok`, an error it raises one of level `error`.

    `name` is the subject of the finding.
    """
    try:
        result = check(*args)
    except PolysightError as e:
        return Finding.of_error(e, where=name)
    except OSError as e:
        return Finding(
            "error", convert_os_error(e).what, do=advise_as_service(["check", "--config", RIG_FILE]), where=name
        )
    if isinstance(result, Finding):
        return result
    return Finding("ok", result, where=name)


def check_all(instrument: Instrument, wires: Path | None) -> Iterator[Finding]:
    """Run every check, in the order of bring-up; `wires` is the socket of simulated wires, None for GPIO."""
    pi = instrument.pi
    keys = Path(pi.key_dir)
    yield run_check("plan", _check_plan, instrument)
    if wires is not None:
        yield run_check("simulated wires", _check_wires, instrument, wires)
    else:
        yield _check_real_time()
        yield from check_lines(instrument)
    yield run_check("stage", _check_stage, instrument)
    # The rig file may ask for less free space than the journals usually need: then that is enough.
    needed_bytes = min(instrument.limits.free_disk_bytes, JOURNAL_BYTES)
    yield run_check("journal", _check_journal, Path(pi.journal_dir), needed_bytes)
    yield run_check("keys", _check_keys, keys, (pi.command_address, pi.event_address))
    yield run_check("command address", _check_address, create_replier, pi.command_address, keys)
    yield run_check("event address", _check_address, create_publisher, pi.event_address, keys)


def _check_plan(instrument: Instrument) -> str:
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    burst = instrument.burst
    return f"burst of {burst.pulses} x {burst.period_us:g} us ends before the next point"


def _check_wires(instrument: Instrument, wires: Path) -> str:
    open_lines(instrument, wires).close()
    return f"{wires}: trigger {instrument.pi.trigger_in}, SYNC_IN {', '.join(map(str, instrument.pi.sync_out))}"


def _check_real_time() -> Finding:
    """Request the same real-time rights as the service, so that pulse widths are measured with them."""
    # The process and the thread may be refused the same right; a dict names each right once, in this order.
    refused = dict.fromkeys(system.prepare_process() + system.prepare_thread())
    if refused:
        remedy = "the systemd unit grants both (LimitRTPRIO, LimitMEMLOCK); a shell does not"
        return Finding("warning", "; ".join(refused), do=remedy, where="real time")
    return Finding("ok", "SCHED_FIFO and locked memory are permitted", where="real time")


def _check_stage(instrument: Instrument) -> str:
    """Connect to the stage and read its position. Opening the port may reset it."""
    with BenchStage(instrument.stage) as stage:
        x_mm, y_mm = stage.position()
        return f"{instrument.stage.port} answers, firmware {stage.firmware or '?'}, at {x_mm:.2f}, {y_mm:.2f} mm"


def _check_journal(path: Path, needed_bytes: int) -> str:
    """Check that the journal folder can be written and that no service uses it, and the free space."""
    Journal(path).close()
    free_bytes = shutil.disk_usage(path).free
    if free_bytes < needed_bytes:
        summary = f"{path}: {free_bytes >> 20} MiB free, {needed_bytes >> 20} MiB wanted"
        raise DeviceError(summary, "the disk fills", "remove old journals there", code=ErrorCode.DISK_FULL)
    return f"{path} can be written, {free_bytes >> 20} MiB are free"


def _check_keys(folder: Path, addresses: tuple[str, ...]) -> str | Finding:
    """Check that the Pi's secret key exists, that its user alone can read it, and that a client is allowed.

    Without addresses other than loopback no keys are needed.
    """
    if all(is_loopback(a) for a in addresses):
        return "not needed: both addresses are loopback"
    secret = folder / PI_SECRET_KEY
    if not secret.is_file():
        raise DeviceError(f"{secret} is missing", "keys were not made yet", advise_keys(folder))
    if secret.stat().st_mode & 0o077:
        summary = f"{secret} can be read by others than its owner"
        remedy = f"chmod 600 {quote(secret)}; new ones with `polysight-pi keys --dir {quote(folder)} --replace`"
        return Finding("warning", summary, do=remedy, where="keys")
    try:
        load_certificate(secret)
    except PermissionError:
        raise DeviceError(f"{secret} cannot be read", "it belongs to another user", advise_owner(folder)) from None
    except ValueError as e:
        raise DeviceError(f"{secret}: {e}", "the file is damaged", advise_keys(folder)) from None
    clients = sorted(read_allowed(folder).values())
    if not clients:
        remedy = f"allow one: `polysight-pi keys --dir {quote(folder)} --client NAME`"
        return Finding("warning", f"{folder} allows no client", do=remedy, where="keys")
    return f"{secret}; allowed: {', '.join(clients)}"


def _check_address(make_socket: Callable[..., zmq.Socket[bytes]], address: str, key_dir: Path) -> str:
    """Check that a socket of the service can be bound; `make_socket` creates it."""
    context = make_server_context()
    try:
        make_socket(context, address, key_dir).close()
    finally:
        context.destroy(linger=0)
    if is_loopback(address):
        return f"{address} can be bound (loopback, no keys needed)"
    return f"{address} can be bound with CURVE keys"


# --- the lines --------------------------------------------------------------------------------------------------------


def check_lines(instrument: Instrument, model: Path = MODEL_FILE, modules: Path = MODULES_FOLDER) -> Iterator[Finding]:
    """Check the trigger line and the SYNC_IN line, and measure the pulse width on this computer; SYNC_IN stays low.

    `model` is the device tree's file with the computer's name, `modules` the folder of the kernel modules' parameters.
    """
    pi = instrument.pi
    wiring = run_check("wiring", check_wiring, pi)
    if wiring.level != "ok":
        yield wiring
        return
    chip = run_check("GPIO chip", _check_chip, pi)
    yield chip
    if chip.level == "ok":
        yield run_check(f"trigger line {pi.trigger_in}", _check_trigger, pi)
        check_output = _check_output
        measure = measure_width
        if pi.wiring == "spi":
            check_output = _check_spi
            measure = measure_clock
        yield run_check(f"SYNC_IN line {pi.sync_out[0]}", check_output, pi)
        yield Finding("ok", pi.pulse_source, where="pulses")
        yield run_check("pulse width", measure, instrument)
    if pi.wiring != "spi" and model.exists() and model.read_bytes().startswith(b"Raspberry Pi"):
        yield _check_release(modules)


def _check_chip(pi: Pi) -> str:
    """Return path and label of the GPIO chip. Raises DeviceError if it cannot be opened."""
    path = find_chip(pi.gpio_chip)
    try:
        with load_gpiod().Chip(path) as chip:
            return f"{path} is {chip.get_info().label!r}"
    except OSError as e:
        raise DeviceError(
            f"{path}: {e.strerror}", "no such device, or no permission", "set pi.gpio_chip; group gpio"
        ) from e


def _check_trigger(pi: Pi) -> str:
    TriggerInput(pi).close()
    return f"rising edges with time stamps, {pi.trigger_bias}, debounced by {pi.trigger_debounce_us} us"


def _check_output(pi: Pi) -> str:
    request_output(pi).release()
    return "is available, and is low"


def _check_spi(pi: Pi) -> str:
    device = SpiDevice(pi.spi_device)
    device.close()
    return f"MOSI of {pi.spi_device}, low; it accepts transfers of {device.bufsiz} bytes"


def measure_width(instrument: Instrument) -> str | Finding:
    """Time the two system calls of a pulse; both clear SYNC_IN, so that no pulse is sent. Raises DeviceError."""
    lines = GpiodLines(instrument.pi)
    widths_ns: list[int] = []
    try:
        for _ in range(TIMED_PULSES):
            lines.sleep_until(lines.now_ns() + PAUSE_NS)
            widths_ns.append(lines.measure())
    finally:
        lines.close()
    return judge_widths(widths_ns, instrument.pi.one_shot)


def measure_clock(instrument: Instrument) -> str | Finding:
    """Time transfers of zeros as long as a burst; the shortest gives the SPI clock. Raises DeviceError."""
    device = SpiDevice(instrument.pi.spi_device)
    try:
        burst = make_spi_burst(BurstSpec.from_burst(instrument.burst), device.bufsiz)
        zeros = bytes(len(burst.data))
        times_ns = [device.transfer(zeros, burst.clock_hz) for _ in range(TIMED_TRANSFERS)]
    finally:
        device.close()
    bit_ns = min(end_ns - begin_ns for begin_ns, end_ns in times_ns) / (8 * len(zeros))
    summary = f"a bit lasts {bit_ns / 1e3:.3f} us, nominal {burst.bit_ns / 1e3:.3f} us; the same clock sets the period"
    if MIN_DURATION_SHARE <= bit_ns / burst.bit_ns <= MAX_DURATION_SHARE:
        return summary + " (SPI controller, measured now with the line low)"
    remedy = "fix the Pi's core clock in /boot/firmware/config.txt: `core_freq=250` on a 3, `core_freq_min=500` on a 4"
    return Finding("error", summary, do=remedy, where="pulse width")


def judge_widths(widths_ns: list[int], one_shot: bool) -> str | Finding:
    """Judge measured widths: a row needs thousands of pulses of at most 4 us, so none of these may be longer.

    `one_shot`: a one-shot behind the line makes the width, so any is accepted.
    """
    widths_ns = sorted(widths_ns)
    median_us = widths_ns[len(widths_ns) // 2] / 1e3
    longest_ns = widths_ns[-1]
    summary = f"two system calls take {median_us:.1f} us (median), {longest_ns / 1e3:.1f} us (longest)"
    if one_shot:
        return f"{summary}; a one-shot sets the width"
    if longest_ns <= MAX_WIDTH_NS:
        return f"{summary} (measured now with the line low)"
    summary += f": the radar accepts {WIDTH_TEXT}; rows would end with fault 105"
    remedy = 'fit a one-shot and set one_shot = true, or wire SYNC_IN to MOSI and set wiring = "spi"'
    return Finding("error", summary, do=f"{remedy} (docs/how-to/wiring.md)", where="pulse width")


def _check_release(modules: Path) -> Finding:
    """Warn if the kernel keeps an output's level when its program dies: SYNC_IN could stay high."""
    summary = "this kernel does not report whether outputs are released when their program ends"
    for module in ("pinctrl_bcm2835", "pinctrl_rp1"):
        parameter = modules / module / "parameters" / "persist_gpio_outputs"
        if parameter.exists():
            if parameter.read_text().strip() != "Y":
                return Finding("ok", "lines become inputs again when their program ends", where="line release")
            summary = f"{module} keeps the level of outputs: a program killed during a pulse leaves them high"
    return Finding("warning", summary, do=STRICT_REMEDY, where="line release")
