"""What the rig is, measured with the rig: places, filters, metal, start frequencies; and what applies to a scan.

`polysight calibrate` writes dated files (`files`), one module a kind. The rig file names those that apply; a scan keeps
copies of them. `of_scan` gives a scan's `Calibration`, which turns the rig file into the rig as measured.
"""

from polysight.host.calibration.active import Calibration, of_rig, of_scan

__all__ = ["Calibration", "of_rig", "of_scan"]
