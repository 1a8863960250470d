"""What the rig is, measured with the rig: places, filters, metal, start frequencies; and what applies to a scan.

`polysight calibrate` writes dated files (`files`), one module a kind. The rig file names those that apply; a scan keeps
copies of them. `of_scan` gives a scan's `Calibration`, which turns the rig file into the rig as measured.
"""

from polysight.host.calibration.active import Calibration, checked, keep_in_scan, of_rig, of_scan
from polysight.host.calibration.direct_signal import (
    FULL_SCALE,
    DirectSignal,
    band_hz,
    find_direct,
    fit_start,
    jitter_hz,
    unwrapped,
)
from polysight.host.calibration.files import CalibrationFile, FilterFile, MetalFile, StartFile, head, read, write
from polysight.host.calibration.filters import fit_filter
from polysight.host.calibration.metal import write_metal
from polysight.host.calibration.places import Prior, fit_places, look, places_file, read_target
from polysight.host.calibration.rows import facts_of, open_raw

__all__ = [
    "FULL_SCALE",
    "Calibration",
    "CalibrationFile",
    "DirectSignal",
    "FilterFile",
    "MetalFile",
    "Prior",
    "StartFile",
    "band_hz",
    "checked",
    "facts_of",
    "find_direct",
    "fit_filter",
    "fit_places",
    "fit_start",
    "head",
    "jitter_hz",
    "keep_in_scan",
    "look",
    "of_rig",
    "of_scan",
    "open_raw",
    "places_file",
    "read",
    "read_target",
    "unwrapped",
    "write",
    "write_metal",
]
