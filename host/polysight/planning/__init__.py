"""`polysight plan`: predict a scan before it is made: time, data, resolution, noise, aliases, warnings.

`forecast` predicts the scan of a rig file to which `Changes` were applied; `propose` searches for the plans with the
least noise within a time. `scan_time` estimates the duration. `run_plan` is the command; it can take noise and
standstill from an earlier scan. `warn_of_scene` checks the plates of a scene, `find_scene_warnings` those of a scene
file.
"""

from polysight.planning.forecast import (
    Forecast,
    Noise,
    forecast,
    row_motion_s,
    scan_time,
    straight_move_s,
)
from polysight.planning.plan_command import (
    Changes,
    PlanOptions,
    describe,
    forecast_scene,
    forecast_values,
    propose,
    run_plan,
)
from polysight.planning.scene_warnings import find_scene_warnings, read_scene, warn_of_scene

__all__ = [
    "Changes",
    "Forecast",
    "Noise",
    "PlanOptions",
    "describe",
    "find_scene_warnings",
    "forecast",
    "forecast_scene",
    "forecast_values",
    "propose",
    "read_scene",
    "row_motion_s",
    "run_plan",
    "scan_time",
    "straight_move_s",
    "warn_of_scene",
]
