"""A stand-in GPIO chip for one program at a time, used through the unmodified libgpiod bindings.

A preloaded library (`gpioshim.c`: system calls, `lines.c`: lines, `spidev.c`: SPI controller) replaces the system calls
on the GPIO character device and on spidev; the lines are connected to the simulated wires (`wires` of shared). It is
compiled on demand; :func:`list_missing_packages` lists the packages needed.
"""

import shutil
import signal
from pathlib import Path

from polysight_simulators.builds import compile_once

ENABLING_COMMAND = "sudo apt-get install gcc libc6-dev"
VANISH_SIGNAL = signal.SIGUSR1
"""Signal to the program that makes the chip vanish, as if its driver were unloaded."""
_SOURCES = sorted(p for p in Path(__file__).parent.iterdir() if p.suffix in (".c", ".h"))
_CC = ("gcc", "-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror")
_LIBRARIES = ("-ldl", "-lpthread")


def list_missing_packages() -> list[str]:
    """Return the Debian packages that the stand-in chip is compiled with and that are missing."""
    lacking = {"gcc": shutil.which("gcc") is None, "libc6-dev": not Path("/usr/include/linux/gpio.h").is_file()}
    return [package for package, lacks in lacking.items() if lacks]


def compile_library() -> Path:
    """Compile the library; return its path. Raises DeviceError if it does not compile."""
    code = [str(p) for p in _SOURCES if p.suffix == ".c"]
    return compile_once(
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
    """Return the environment variables of a program that uses the stand-in chip at `chip`.

    Parameters
    ----------
    chip
        Path of the device, made when the program starts; for one program at a time.
    wires
        Socket of the hub; None: the chip is not connected.
    label
        Label of the chip.
    faults
        `denied` (no permission), `no-edges` (no interrupts), `busy:LINE` (held by another program), `slow:US` (duration
        of each change of an output), `stuck` (the call that sets an output high does not return). Signal
        :data:`VANISH_SIGNAL` makes the chip vanish.
    wire_time
        The thread that reads edges uses wire time, in which a sleep is exact and returns immediately, so that nothing
        is late on a busy machine. Else real time.
    spi
        Path of a spidev device to make; its transfers become edges of MOSI, GPIO 10.
    spi_settings
        `mosi`, `bufsiz`, `core_hz`, `exact`: see spidev.c.

    Raises
    ------
    DeviceError
        when the library does not compile.
    """
    variables = {"LD_PRELOAD": str(compile_library()), "GPIOSHIM_CHIP": str(chip), "GPIOSHIM_LABEL": label}
    if spi is not None:
        variables |= {"GPIOSHIM_SPI": str(spi)} | {f"GPIOSHIM_{k.upper()}": v for k, v in spi_settings.items()}
    if wire_time:
        variables["GPIOSHIM_CLOCK"] = "wires"
    if wires is not None:
        variables["GPIOSHIM_WIRES"] = str(wires)
    if faults:
        variables["GPIOSHIM_FAULTS"] = ",".join(faults)
    return variables
