"""Acquisition: record the rows of a plan with the Pi, the radars and the capture cards.

`run_scan` and `resume_scan` record every row that is not committed yet (`scan`). For each row (`row`): arm the radars
and start the cards' records (`capture_rig`), let the Pi run the row (`pi_client`), compare the received data with the
pulses sent, compare frames with pulses by arrival times (`pulse_times`), then commit the row or retake it.
`ready` holds the checks before a row: homing, disk space, the Pi's configuration. `control` pauses and stops a running
scan, `states` says in words how it stands; `scan` also queues committed rows for processing and reports time left.
"""

from polysight.acquisition.capture_rig import CaptureRig
from polysight.acquisition.control import (
    LAPSE_S,
    ControlFolder,
    ScanCommand,
    SignOfLife,
    StopRequest,
    ignore_hangup,
    read_life,
    read_start_ticks,
    send_command,
)
from polysight.acquisition.pi_client import PiClient, RefusedError
from polysight.acquisition.progress import OnProgress, OnRow, ScanProgress, ScanResult, time_left, typical_row_s
from polysight.acquisition.ready import list_stage_differences, make_begin_run, make_ready
from polysight.acquisition.row import FaultKind
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.acquisition.states import BADGES, STATES, Button, StateLevel
