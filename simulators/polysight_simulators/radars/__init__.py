"""Simulated radar boards at their control connections; `scene` simulates their signals.

`board` is an AWR2243 at its SPI lines (mmWaveLink), `cores` its two cores, flash, messages and firmware. `control`
connects it to a host: through its USB chip, at a TCP address, or by the line server that simulates the published rig's
MATLAB servers.
"""

from polysight_simulators.radars.board import FUNCTIONAL_LEVELS, Fault, RadarBoard
from polysight_simulators.radars.control import LineServer, RadarSocket, UsbChip
from polysight_simulators.radars.cores import make_image
