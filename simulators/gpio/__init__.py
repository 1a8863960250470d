"""A stand-in GPIO chip, for one program at a time: the unmodified libgpiod bindings talk to it as to a kernel.

A library (`gpioshim.c` the calls, `lines.c` the lines, `spidev.c` an SPI controller beside them) is preloaded into the
program and answers the calls of the GPIO character device and of spidev; its outside world are the simulated wires
(shared/wires.py). It is compiled on demand; :func:`missing` tells what that needs.
"""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

from polysight.simulators.builds import compiled

ENABLING_COMMAND = "sudo apt-get install gcc libc6-dev"
VANISH = signal.SIGUSR1
_SOURCES = sorted(p for p in Path(__file__).parent.iterdir() if p.suffix in (".c", ".h"))
_CC = ("gcc", "-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror")
_LIBRARIES = ("-ldl", "-lpthread")


def missing() -> list[str]:
    """Debian packages without which it cannot be compiled here; empty when all are there."""
    lacking = {"gcc": shutil.which("gcc") is None, "libc6-dev": not Path("/usr/include/linux/gpio.h").is_file()}
    return [package for package, lacks in lacking.items() if lacks]


def shim() -> Path:
    """The compiled library. Raises DeviceError when it does not compile."""
    code = [str(p) for p in _SOURCES if p.suffix == ".c"]
    return compiled(
        "gpioshim.so",
        _SOURCES,
        [*_CC, "-o", "{folder}/gpioshim.so", *code, *_LIBRARIES],
        ("a package is missing, or the source was changed", ENABLING_COMMAND),
    )


def environment(
    chip: Path,
    wires: Path | None = None,
    label: str = "pinctrl-bcm2835",
    faults: tuple[str, ...] = (),
    wire_time: bool = False,
    spi: Path | None = None,
    **spi_settings: str,
) -> dict[str, str]:
    """Environment variables of a program that shall find a chip at `chip`.

    Parameters
    ----------
    chip
        Path of the device; it is made when the program starts, so one program at a time.
    wires
        Socket of the hub; None: nothing is connected to the chip.
    label
        What the chip calls itself.
    faults
        From the start: `denied` (no permission), `no-edges` (no interrupts), `busy:LINE` (held by another program),
        `slow:US` (every change of an output takes so long). Signal :data:`VANISH` makes the chip vanish.
    wire_time
        The thread that reads edges lives in wire time, where a sleep is exact and over at once: nothing is late,
        however busy the machine is. Else everything is at real time.
    spi
        Path of a spidev device, made too: its transfers are edges of MOSI, GPIO 10.
    spi_settings
        `mosi`, `bufsiz`, `core_hz`: spidev.c says what they are.

    Raises
    ------
    DeviceError
        when the library does not compile.
    """
    variables = {"LD_PRELOAD": str(shim()), "GPIOSHIM_CHIP": str(chip), "GPIOSHIM_LABEL": label}
    if spi is not None:
        variables |= {"GPIOSHIM_SPI": str(spi)} | {f"GPIOSHIM_{k.upper()}": v for k, v in spi_settings.items()}
    if wire_time:
        variables["GPIOSHIM_CLOCK"] = "wires"
    if wires is not None:
        variables["GPIOSHIM_WIRES"] = str(wires)
    if faults:
        variables["GPIOSHIM_FAULTS"] = ",".join(faults)
    return variables
