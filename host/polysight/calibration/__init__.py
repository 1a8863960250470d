"""Calibration from recorded scans: antenna positions, high-pass filters, metal reference, start frequencies.

`polysight calibrate` estimates one kind at a time (`fit_places`, `fit_filter`, `fit_start`, `write_metal`) and writes a
dated calibration file. The rig file names the files that apply; a new scan gets copies (`copy_into_scan`).
`load_scan_calibration` loads the active calibration of a scan: its `Calibration` corrects the rig, and gives the
measured filters and the metal reference.
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
    copy_into_scan,
    load_checked_calibration,
    load_rig_calibration,
    load_scan_calibration,
    make_header,
    make_source_entry,
    open_raw,
    read_board_rows,
    read_calibration,
    write_calibration,
    write_metal,
)
from polysight.calibration.places import Prior, fit_places, load_echoes, places_file, read_target
