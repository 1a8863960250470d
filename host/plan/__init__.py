"""What a scan will take and give, before it is made: time, data, resolution, noise, aliases, and what is wrong."""

from host.plan.changes import Changes
from host.plan.field import FieldLimits, field_limits
from host.plan.forecast import Forecast, Noise, forecast
from host.plan.search import propose
from host.plan.timing import ScanTime, row_motion_s, scan_time, straight_move_s

__all__ = [
    "Changes",
    "FieldLimits",
    "Forecast",
    "Noise",
    "ScanTime",
    "field_limits",
    "forecast",
    "propose",
    "row_motion_s",
    "scan_time",
    "straight_move_s",
]
