"""`polysight doctor`: check the rig hop by hop, from the rig file to the direct path.

`run_doctor` runs the checks of `checks.CHECKS` in order and prints a finding for each: the verdict, the observation,
its likely cause and the remedy. A check whose prerequisite failed is skipped. A check is a function of a
`CheckContext` (options, rig file, connection to the Pi, captured frames, measurements of this machine); the functions
are in `rig_checks`. `write_bundle` (`bundle.py`) collects findings, versions and logs for a person who helps remotely.
"""

from polysight.doctor.checks import run_doctor
from polysight.doctor.context import DoctorOptions
