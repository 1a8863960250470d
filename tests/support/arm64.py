"""The compiled loops of the synchronisation on an emulated ARM64 processor (QEMU).

So the vector instructions in the wheel for ARM64 are tested on any machine.
"""

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
# Debian packages that have both.
PACKAGES = "gcc-aarch64-linux-gnu qemu-user-static"
# Bits of a vector of ARM64's NEON instructions
VECTOR_BITS = 128
# In place of the size of an array in a message, for a single number
NO_ARRAY = -1


def is_installed() -> bool:
    """Return True if the cross-compiler and the emulator are installed."""
    return all(shutil.which(name) for name in (COMPILER, EMULATOR))


class EmulatedLibrary(Library):
    """The loops compiled for ARM64 into `folder`. Each call runs a program in QEMU."""

    def __init__(self, folder: Path) -> None:
        self.bits = VECTOR_BITS
        self._decimator = decimator()
        self._program = folder / "call_loop"
        sources = [build.HERE / name for name in build.SOURCES]
        driver = Path(__file__).with_name("call_loop.c")
        flags = [*build._FLAGS.split(), f"-DWIDTH={VECTOR_BITS}", "-static"]
        command = [COMPILER, *flags, driver, *sources, "-lm", "-o", self._program]
        subprocess.run(command, check=True)

    def _call(self, name: str, arguments: Sequence[NDArray[Any] | float]) -> None:
        """Call a loop in the emulator, and copy its results back into the arrays (call_loop.c has the format)."""
        plain_arguments = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) else int(x) for x in arguments]
        message = b""
        for argument in plain_arguments:
            if isinstance(argument, int):
                message += struct.pack("<qq", NO_ARRAY, argument)
            else:
                message += struct.pack("<q", argument.nbytes) + argument.tobytes()
        process = subprocess.run([EMULATOR, self._program, name], input=message, stdout=subprocess.PIPE, check=True)
        # The program prints the content of all arrays after the call.
        start = 0
        for argument in plain_arguments:
            if isinstance(argument, np.ndarray):
                stop = start + argument.nbytes
                values = np.frombuffer(process.stdout[start:stop], argument.dtype)
                argument[...] = values.reshape(argument.shape)
                start = stop
