"""A scan as row transactions between the host, the Pi and the capture cards.

`run_scan` and `resume_scan` take the rows of a plan that are not committed yet: radars armed and cards recording
(`capture_rig`), the Pi asked for the row (`pi_client`, `row`), what came counted (`take`), pulses that a board missed
found by arrival times (`missed_pulses`, `slipped_row`), the row committed or taken again. A scan is asked to pause or
stop through `control`; committed rows go on to processing through `progress`.
"""

from polysight.host.acquisition.capture_rig import CaptureRig
from polysight.host.acquisition.control import ControlDesk, StopRequest, Wish, ask, hangups_pass, last_sign_of_life
from polysight.host.acquisition.pi_client import PiClient, RefusedError
from polysight.host.acquisition.progress import OnProgress, OnRow, ScanProgress, ScanResult, time_left, usual_row_s
from polysight.host.acquisition.ready import differences, make_ready
from polysight.host.acquisition.scan import resume_scan, run_scan
from polysight.host.acquisition.take import FaultKind

__all__ = [
    "CaptureRig",
    "ControlDesk",
    "FaultKind",
    "OnProgress",
    "OnRow",
    "PiClient",
    "RefusedError",
    "ScanProgress",
    "ScanResult",
    "StopRequest",
    "Wish",
    "ask",
    "differences",
    "hangups_pass",
    "last_sign_of_life",
    "make_ready",
    "resume_scan",
    "run_scan",
    "time_left",
    "usual_row_s",
]
