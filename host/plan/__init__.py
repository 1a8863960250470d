"""What a scan will take and give, before it is made: time, data, resolution, noise, aliases, and what is wrong."""

from polysight.host.plan.field import FieldLimits, field_limits
from polysight.host.plan.forecast import Forecast, Noise, forecast
from polysight.host.plan.search import Changes, propose
from polysight.host.plan.timing import ScanTime, row_motion_s, scan_time, straight_move_s

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
