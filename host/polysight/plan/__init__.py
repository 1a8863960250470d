"""`polysight plan`: predict a scan before it is made: time, data, resolution, noise, aliases, warnings.

`forecast` predicts the scan of a rig file to which `Changes` were applied; `propose` searches for the plans with the
least noise within a time. `scan_time` estimates the duration. `run_plan`
is the command; it can take noise and standstill from an earlier scan.
"""

from polysight.plan.forecast import (
    Noise,
    forecast,
    row_motion_s,
    scan_time,
    straight_move_s,
)
from polysight.plan.plan_command import Changes, PlanOptions, forecast_values, propose, run_plan

__all__ = [
    "Changes",
    "Noise",
    "PlanOptions",
    "forecast",
    "forecast_values",
    "propose",
    "row_motion_s",
    "run_plan",
    "scan_time",
    "straight_move_s",
]
