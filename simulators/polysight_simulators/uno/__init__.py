"""The firmware's machine code on an emulated Arduino UNO, for the tests and for a simulated rig without hardware.

`unosim` runs the flashed image in libsimavr, in exact time, with simulated motors and switches. It is compiled on
demand; :func:`list_missing_packages` lists the packages needed.
"""

from polysight_simulators.uno.board import (
    ENABLING_COMMAND,
    HZ,
    EmulatedUno,
    PinEdge,
    compile_emulator,
    compile_firmware,
    list_missing_packages,
)
