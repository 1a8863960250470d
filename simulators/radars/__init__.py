"""The radar boards of a simulated rig, as their control connections show them.

`board` is one AWR2243 at its SPI lines (mmWaveLink), `cores` what is behind them, `wire` its messages as bytes, `image`
firmware for it; `control` is how a host reaches it: through its USB chip, at a TCP
address, or by the line server that stands for the published rig's MATLAB servers. What the radars see is in `scene`.
"""

from polysight.simulators.radars.board import FUNCTIONAL, Fault, RadarBoard
from polysight.simulators.radars.control import LineServer, RadarSocket, UsbChip
from polysight.simulators.radars.image import make_image

__all__ = ["FUNCTIONAL", "Fault", "LineServer", "RadarBoard", "RadarSocket", "UsbChip", "make_image"]
