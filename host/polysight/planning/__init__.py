"""`polysight plan`: predict a scan before it is made: time, data, resolution, noise, aliases, warnings.

`forecast` predicts the scan of a rig file to which `PlanChanges` were applied; `propose` searches for the plans with
the least noise within a time. `scan_time` estimates the duration. `run_plan` is the command; it can take noise and
standstill from an earlier scan. `warn_of_scene` checks the plates of a scene, `find_scene_warnings` those of a scene
file.
"""

from polysight.planning.forecast import (
    Forecast as Forecast,
    Noise as Noise,
    forecast as forecast,
    row_motion_s as row_motion_s,
    scan_time as scan_time,
    straight_move_s as straight_move_s,
)
from polysight.planning.plan_command import (
    PlanChanges as PlanChanges,
    PlanOptions as PlanOptions,
    describe as describe,
    forecast_scene as forecast_scene,
    forecast_values as forecast_values,
    propose as propose,
    run_plan as run_plan,
)
from polysight.planning.scene_warnings import (
    find_scene_warnings as find_scene_warnings,
    read_scene as read_scene,
    warn_of_scene as warn_of_scene,
)
