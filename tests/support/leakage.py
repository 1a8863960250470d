"""Judge an estimated leakage."""

from __future__ import annotations

import numpy as np

from polysight.host.polarimetry import Leakage


def remaining(found: Leakage, truth: Leakage) -> tuple[float, float]:
    """Larger cross-polar amplitude and deviation of the co-polar ratio from 1, after correction by `found`."""
    left = np.linalg.solve(found.matrix(), truth.matrix())
    crosstalk = max(abs(left[0, 1] / left[0, 0]), abs(left[1, 0] / left[1, 1]))
    return float(crosstalk), float(abs(left[0, 0] / left[1, 1] - 1))
