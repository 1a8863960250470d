"""Calibration from recorded scans: antenna positions, high-pass filters, metal reference, start frequencies.

`polysight calibrate` estimates one kind at a time (`fit_places`, `fit_filter`, `fit_start`, `write_metal`) and writes a
dated calibration file. The rig file names the files that apply; a new scan gets copies (`copy_into_scan`).
`calibration_of_scan` loads the active calibration of a scan: its `Calibration` corrects the rig, and gives the measured
filters and the metal reference.
"""

from polysight.calibration.direct_signal import (
    FULL_SCALE,
    DirectSignal,
    band_hz,
    find_direct,
    fit_filter,
    fit_start,
    jitter_hz,
    unwrap_if,
)
from polysight.calibration.files import (
    Calibration,
    CalibrationFile,
    FilterFile,
    MetalFile,
    SphereFile,
    StartFile,
    board_rows,
    calibration_of_rig,
    calibration_of_scan,
    copy_into_scan,
    load_checked_calibration,
    make_header,
    open_raw,
    read_calibration,
    source_scan,
    write_calibration,
    write_metal,
)
from polysight.calibration.places import Prior, fit_places, load_echoes, places_file, read_target
