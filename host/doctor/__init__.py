"""`polysight doctor`: the rig hop by hop, from the rig file to the direct path.

`doctor` walks the checks in their order (`walk.CHECKS`); a hop behind one that failed is not tried. A check is a
function of a `Bench`, which holds what checks share, and returns a `Finding`: what was seen, why, what to do. The
checks lie in `check_host`, `check_pi` and `check_capture`.
"""

from polysight.host.doctor.bench import Wanted
from polysight.host.doctor.walk import doctor

__all__ = [
    "Wanted",
    "doctor",
]
