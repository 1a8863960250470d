"""The compiled loops of synchronisation on ARM64, in QEMU: the vector code of that wheel, on any machine."""

import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.sync import build
from polysight.sync.decimate import decimator
from polysight.sync.loops import Library

COMPILER = "aarch64-linux-gnu-gcc"
EMULATOR = "qemu-aarch64-static"
PACKAGES = "gcc-aarch64-linux-gnu qemu-user-static"


def is_installed() -> bool:
    """Return True if the cross-compiler and the emulator are installed."""
    return all(shutil.which(name) for name in (COMPILER, EMULATOR))


class EmulatedLibrary(Library):
    """The loops, each call a program in QEMU; compiled into `folder`."""

    def __init__(self, folder: Path) -> None:
        self.bits = 128
        self._decimator = decimator()
        self._program = folder / "call_loop"
        sources = [build.HERE / name for name in build.SOURCES]
        driver = Path(__file__).with_name("call_loop.c")
        flags = [*build._FLAGS.split(), "-DWIDTH=128", "-static"]
        command = [COMPILER, *flags, driver, *sources, "-lm", "-o", self._program]
        subprocess.run(command, check=True)

    def _call(self, name: str, arguments: Sequence[NDArray[Any] | float]) -> None:
        """Call a loop in the emulator (call_loop.c has the format); copy the arrays that it has changed back."""
        plain_arguments = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) else int(x) for x in arguments]
        message = b""
        for argument in plain_arguments:
            if isinstance(argument, int):
                message += struct.pack("<qq", -1, argument)
            else:
                message += struct.pack("<q", argument.nbytes) + argument.tobytes()
        process = subprocess.run([EMULATOR, self._program, name], input=message, stdout=subprocess.PIPE, check=True)
        first = 0
        for argument in plain_arguments:
            if isinstance(argument, np.ndarray):
                values = np.frombuffer(process.stdout[first : first + argument.nbytes], argument.dtype)
                first += argument.nbytes
                argument[...] = values.reshape(argument.shape)
