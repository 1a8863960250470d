"""Constants and unit conversions. Computations use SI units; other variables have the unit in their name."""

from __future__ import annotations

SPEED_OF_LIGHT_M_S = 299_792_458.0
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def us_to_ns(us: float) -> int:
    """Convert microseconds to whole nanoseconds, rounded."""
    return round(us * NS_PER_US)
