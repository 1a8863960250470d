"""The firmware's machine code on an emulated Arduino UNO, for the tests and for a simulated rig without hardware.

`unosim` runs the image that is flashed in libsimavr, in exact time, with motors and switches around it. It is compiled
on demand; :func:`missing` tells what that needs.
"""

from polysight.simulators.uno.board import ENABLING_COMMAND, HZ, Cost, EmulatedUno, PinEdge, emulator, firmware, missing

__all__ = ["ENABLING_COMMAND", "HZ", "Cost", "EmulatedUno", "PinEdge", "emulator", "firmware", "missing"]
