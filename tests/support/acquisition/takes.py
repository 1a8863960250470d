"""A take of a row of three positions without faults: the Pi's report of its end, and what each board has received.

A test replaces one field at a time.
"""

from typing import Any

from polysight.capture import RowCapture
from polysight.capture.placement import Losses, PacketCounts
from polysight_shared.messages import RowFinished
from polysight_shared.raster import Row

ROW = Row(index=0, y_mm=0.0, x_start_mm=0.0, step_mm=2.0, points=3)
PULSES = 2
BYTES = 480


def make_end(**fields: Any) -> RowFinished:
    """The Pi's report of a row that ended as planned, with other `fields`."""
    planned = {"status": "done", "points": 3, "edges": 3, "bursts": 3, "pulses": 3 * PULSES}
    return RowFinished(scan_id="s", seq=1, t_mono_ns=1, row_index=0, take=1, **planned | fields)


def make_capture(**fields: Any) -> RowCapture:
    """A board's whole row, with other `fields`."""
    whole = {
        "row": 0, "take": 1, "expected": BYTES, "bytes": BYTES, "missing": [], "located": True, "reason": "",
        "counts": PacketCounts(placed=4), "losses": Losses(), "strangers": 0, "stale": 0, "kernel_drops": 0,
        "first_arrival_ns": 1, "last_arrival_ns": 2, "crc32": 1, "index_crc32": 1,
    }  # fmt: skip
    return RowCapture(**whole | fields)
