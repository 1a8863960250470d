"""Compiles the emulator and the firmware, once for the same sources."""

from __future__ import annotations

import shutil
from pathlib import Path

from polysight.simulators.build_cache import compiled

SKETCH_DIR = Path(__file__).resolve().parents[2] / "arduino_stage"
CORE_DIR = Path("/usr/share/arduino/hardware/arduino/avr/cores/arduino")
ENABLING_COMMAND = (
    "sudo apt-get install gcc make gcc-avr avr-libc binutils-avr arduino-core-avr libsimavr-dev libelf-dev"
)
_SOURCES = sorted(p for p in Path(__file__).parent.iterdir() if p.suffix in (".c", ".h"))
_CC = ("gcc", "-O2", "-Wall", "-Wextra")
_LIBRARIES = ("-lsimavr", "-lelf", "-lutil", "-lm")
_ON_FAILURE = ("a package is missing, or the sources were changed", ENABLING_COMMAND)


def missing() -> list[str]:
    """Debian packages without which firmware or emulator cannot be compiled here; empty when all are there."""
    lacking = {
        "gcc": shutil.which("gcc") is None,
        "make": shutil.which("make") is None,
        "gcc-avr": shutil.which("avr-g++") is None,
        "avr-libc": not any(Path(p).is_file() for p in ("/usr/lib/avr/include/avr/io.h", "/usr/avr/include/avr/io.h")),
        "arduino-core-avr": not CORE_DIR.is_dir(),
        "libsimavr-dev": not Path("/usr/include/simavr/sim_avr.h").is_file(),
        "libelf-dev": not Path("/usr/include/libelf.h").is_file(),
    }
    return [package for package, lacks in lacking.items() if lacks]


def emulator() -> Path:
    """The compiled emulator. Raises DeviceError when it does not compile."""
    code = [str(p) for p in _SOURCES if p.suffix == ".c"]
    return compiled("unosim", _SOURCES, [*_CC, "-o", "{folder}/unosim", *code, *_LIBRARIES], _ON_FAILURE)


def firmware() -> Path:
    """The image that `make flash` puts on a board, a .hex file. Raises DeviceError when it does not compile."""
    sources = [p for p in SKETCH_DIR.iterdir() if p.suffix in (".cpp", ".h", ".ino", ".mk")]
    command = ["make", "-s", "-C", str(SKETCH_DIR), "firmware", "AVR_B={folder}"]
    return compiled("arduino_stage.hex", sources, command, _ON_FAILURE)
