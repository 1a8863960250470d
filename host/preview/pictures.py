"""The images so far as PNG: amplitude in cividis, phase in twilight (cyclic); both suit colour-blind eyes.

The same maps as in the report (host/report/figures.py). Pixels that no row has lit yet are transparent.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray

from polysight.host.imaging import ChannelImages

AMPLITUDE, PHASE = "cividis", "twilight"
_RANGE_DB = 35.0
_RATIO_PERCENTILES = (5.0, 95.0)
_FAINT_DB, _CLEAR_DB = -26.0, -18.0  # below the brightest: what is fainter holds no phase, and fades out


@dataclass(frozen=True)
class Picture:
    """One image: its PNG, and what the ends of its colour map mean."""

    png: bytes
    low: float
    high: float
    unit: str


def draw(images: ChannelImages) -> dict[str, Picture]:
    """Amplitude and phase of H, V and P = H / V: `h_amplitude`, `h_phase` and so on.

    Row 0 of the images (the smallest y) is at the bottom of the pictures. P is not referenced to metal, which is
    looked for when the scan has ended.
    """
    seen = images.valid & np.isfinite(images.h) & np.isfinite(images.v)
    ratio = np.divide(images.h, images.v, out=np.zeros_like(images.h), where=seen & (images.v != 0))
    strength = np.minimum(_below_top(images.h, seen), _below_top(images.v, seen))
    out: dict[str, Picture] = {}
    for name, channel in (("h", images.h), ("v", images.v)):
        level = _db(channel)
        top = float(np.percentile(level[seen], 99.8)) if seen.any() else 0.0
        out[f"{name}_amplitude"] = _picture(level, seen.astype(float), (top - _RANGE_DB, top), AMPLITUDE, "dB")
        out[f"{name}_phase"] = _phase(channel, _fade(_below_top(channel, seen)) * seen)
    clear = _fade(strength) * seen
    level = _db(ratio)
    told = level[clear > 0.5]
    low, high = np.percentile(told, _RATIO_PERCENTILES) if told.size else (-10.0, 10.0)
    middle, half = (low + high) / 2, max((high - low) / 2, 3.0)
    out["p_amplitude"] = _picture(level, clear, (float(middle - half), float(middle + half)), AMPLITUDE, "dB")
    out["p_phase"] = _phase(ratio, clear)
    return out


def _phase(channel: NDArray[np.complex64], opacity: NDArray[Any]) -> Picture:
    return _picture(np.degrees(np.angle(channel)), opacity, (-180.0, 180.0), PHASE, "°")


def _db(channel: NDArray[np.complex64]) -> NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(channel).astype(float), nan=0.0, posinf=0.0), 1e-12))


def _below_top(channel: NDArray[np.complex64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Level relative to the brightest seen pixels, dB."""
    level = _db(channel)
    return level - (float(np.percentile(level[seen], 99.5)) if seen.any() else 0.0)


def _fade(level_db: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip((level_db - _FAINT_DB) / (_CLEAR_DB - _FAINT_DB), 0.0, 1.0)


def _picture(
    values: NDArray[np.float64], opacity: NDArray[Any], limits: tuple[float, float], colours: str, unit: str
) -> Picture:
    scaled = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
    rgba = matplotlib.colormaps[colours](scaled)
    rgba[..., 3] = opacity
    file = io.BytesIO()
    imsave(file, rgba, origin="lower", format="png")
    return Picture(file.getvalue(), round(limits[0], 1), round(limits[1], 1), unit)


def colour_bar(colours: str) -> bytes:
    """A map's colours from left to right, PNG of 256 x 1 pixels."""
    file = io.BytesIO()
    imsave(file, matplotlib.colormaps[colours](np.linspace(0, 1, 256))[None], format="png")
    return file.getvalue()
