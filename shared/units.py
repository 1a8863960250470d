"""Constants and conversions used on both halves. SI inside the maths; elsewhere the unit is in the name."""

from __future__ import annotations

SPEED_OF_LIGHT_M_S = 299_792_458.0
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def us_to_ns(us: float) -> int:
    """Microseconds to whole nanoseconds, rounded."""
    return round(us * NS_PER_US)


def ms_to_ns(ms: float) -> int:
    """Milliseconds to whole nanoseconds, rounded."""
    return round(ms * NS_PER_MS)


def s_to_ns(s: float) -> int:
    """Seconds to whole nanoseconds, rounded."""
    return round(s * NS_PER_S)
