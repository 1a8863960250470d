"""How long a scan will still take, from how long its rows took: one rule for the terminal and for the live view."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

_RECENT_ROWS = 25  # enough for a steady median, few enough to follow a rig that was sped up


def usual_row_s(row_seconds: Sequence[float]) -> float:
    """How long a row takes: the median of the last 25, so that a retake or a wait among them does not count.

    Parameters
    ----------
    row_seconds
        [n >= 1] from the end of one row to the end of the next, pauses left out.
    """
    return statistics.median(row_seconds[-_RECENT_ROWS:])


def time_left(rows_left: int, row_s: float, elapsed_s: float = 0.0) -> float:
    """Seconds to the end of a scan.

    Parameters
    ----------
    rows_left
        Rows that are not committed.
    row_s
        How long a row takes.
    elapsed_s
        Since the last row ended, pauses left out; a row that is overdue counts as one that ends now.
    """
    return max(0.0, rows_left * row_s - min(max(elapsed_s, 0.0), row_s))
