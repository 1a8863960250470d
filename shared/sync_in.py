"""What an AWR2243 takes at SYNC_IN (TI mmWave Radar Interface Control, frame configuration; data sheet)."""

from __future__ import annotations

from polysight.shared.units import us_to_ns

MIN_PERIOD_US = 300.0  # from one rising edge to the next: an earlier one is a fatal fault of the RF core
WIDTH_US = (0.025, 4.0)
WIDTH_TEXT = f"{WIDTH_US[0]:g}..{WIDTH_US[1]:g} us"
MIN_PERIOD_NS = us_to_ns(MIN_PERIOD_US)
MIN_WIDTH_NS, MAX_WIDTH_NS = map(us_to_ns, WIDTH_US)
