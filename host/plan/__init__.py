"""What a scan will take and give, before it is made: time, data, resolution, noise, aliases, and what is wrong.

`forecast` judges a rig file with `Changes`, `propose` searches for the best plans within a time. Time comes from
`timing`, the field of view from `field`; `text` prints, and takes noise and overhead from an earlier scan.
"""

from polysight.host.plan.field import FieldLimits, field_limits
from polysight.host.plan.forecast import Forecast, Noise, forecast
from polysight.host.plan.search import Changes, propose
from polysight.host.plan.text import Wanted, numbers, plan
from polysight.host.plan.timing import ScanTime, row_motion_s, scan_time, straight_move_s

__all__ = [
    "Changes",
    "FieldLimits",
    "Forecast",
    "Noise",
    "ScanTime",
    "Wanted",
    "field_limits",
    "forecast",
    "numbers",
    "plan",
    "propose",
    "row_motion_s",
    "scan_time",
    "straight_move_s",
]
