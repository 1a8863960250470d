"""Maps of H, V and P as they are drawn: numbers, opacity and the limits of their colours.

Figures of reports and pictures of pages draw the same values. Amplitudes are in dB, phases in degrees. A phase or a
ratio means nothing where a channel holds only noise: there its pixels fade out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.imaging import Images
from polysight.polarimetry import ratio
from polysight.products.processed import ProcessedScan

Real = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
# Lower and upper end.
Limits = tuple[float, float]

# What maps show: a channel and a quantity of it.
CHANNELS = ("h", "v", "p")
QUANTITIES = ("amplitude", "phase")
# Amplitudes are shown down to this far below the upper end of their colours.
AMPLITUDE_RANGE_DB = 35.0
# Single bright pixels shall neither darken the rest of an amplitude nor fade a phase.
BRIGHT_PERCENTILE = 99.8
REFERENCE_PERCENTILE = 99.5
# Phases and ratios begin to show this far below the brightest pixels, and are opaque from the second level on.
FAINT_DB = -26.0
CLEAR_DB = -18.0
# |P| of an image without patches: percentiles of the opaque pixels, and what is shown if there are none.
RATIO_PERCENTILES = (5.0, 95.0)
NO_RATIOS_DB = (0.0, 20.0)
# Narrowest range of |P|: below it noise would look like a difference.
LEAST_RATIO_RANGE_DB = 6.0
# Smaller amplitudes have the level of this one, so that zero has a level.
LEAST_AMPLITUDE = 1e-12


@dataclass(frozen=True)
class MapValues:
    """Numbers and opacity (0 to 1), both [ny, nx], of a map, and the limits of its colours; amplitudes are in dB."""

    numbers: npt.NDArray[Any]
    opacity: npt.NDArray[Any]
    limits: Limits


def level_db(values: npt.NDArray[np.complexfloating]) -> Real:
    """Return 20 log10 |values|, shape of `values`; zero and non-finite values get the level of the least amplitude."""
    amplitude = np.nan_to_num(np.abs(values).astype(np.float64), nan=0.0, posinf=0.0)
    return 20 * np.log10(np.maximum(amplitude, LEAST_AMPLITUDE))


def percentile(values: Real, mask: Mask, percent: float, default: float = 0.0) -> float:
    """Return a percentile of the values under a mask of their shape; `default` if it is empty."""
    if mask.any():
        return float(np.percentile(values[mask], percent))
    return default


def level_below_brightest_db(images: Images, channel: str) -> Real:
    """Return the level relative to the brightest pixels of a channel, dB [ny, nx]; of P that of the fainter channel."""
    if channel == "p":
        return np.minimum(level_below_brightest_db(images, "h"), level_below_brightest_db(images, "v"))
    level = level_db(images.h if channel == "h" else images.v)
    return level - percentile(level, images.usable, REFERENCE_PERCENTILE)


def signal_opacity(images: Images, channel: str) -> Real:
    """Return the opacity of a channel's phase or of P, 0 to 1 [ny, nx]: pixels of only noise are transparent."""
    level = level_below_brightest_db(images, channel)
    return np.clip((level - FAINT_DB) / (CLEAR_DB - FAINT_DB), 0.0, 1.0) * images.usable


def map_images(
    images: Images, channel: str, quantity: str, top_db: float | None = None, patches_db: Sequence[float] = ()
) -> MapValues:
    """Return the values of one map of images.

    Parameters
    ----------
    images
        Images; P is their ratio, computed if they have none.
    channel, quantity
        The map: one of `CHANNELS`, one of `QUANTITIES`.
    top_db
        Upper end of |H| and |V|; None: that of the brightest pixels.
    patches_db
        |P| of patches: the range of |P| holds them and metal's 0 dB. Empty: it is that of the bright pixels.
    """
    if channel == "p":
        values = ratio(images.h, images.v) if images.p is None else images.p
    else:
        values = images.h if channel == "h" else images.v
    if quantity == "phase":
        angle_deg = np.degrees(np.angle(np.where(np.isfinite(values), values, 1)))
        return MapValues(angle_deg, signal_opacity(images, channel), (-180.0, 180.0))
    level = level_db(values)
    if channel == "p":
        opacity = signal_opacity(images, channel)
        return MapValues(level, opacity, _find_ratio_limits_db(level, opacity > 0.5, patches_db))
    if top_db is None:
        top_db = percentile(level, images.usable, BRIGHT_PERCENTILE)
    return MapValues(level, images.usable.astype(np.float64), (top_db - AMPLITUDE_RANGE_DB, top_db))


def map_scan(scan: ProcessedScan, channel: str, quantity: str) -> MapValues:
    """Return the values of one map of a processed scan. Metal has 0 dB, and |P| the range of the patches."""
    top_db = 0.0 if scan.metal_referenced else None
    levels = [patch.p_abs_db for patch in scan.segments]
    patches_db = [level for level in levels if level is not None]
    return map_images(scan.images, channel, quantity, top_db, patches_db)


def _find_ratio_limits_db(level: Real, is_opaque: Mask, patches_db: Sequence[float]) -> Limits:
    """Return the range of |P|, dB: that of the patches if there are any, else of the opaque pixels."""
    if patches_db:
        low = min(patches_db)
        high = max(patches_db)
    else:
        low, high = (
            percentile(level, is_opaque, percent, default)
            for percent, default in zip(RATIO_PERCENTILES, NO_RATIOS_DB, strict=True)
        )
    low = float(np.floor(min(low, 0.0) - 1))
    return low, max(float(np.ceil(high + 1)), low + LEAST_RATIO_RANGE_DB)
