"""Draw images as PNG: amplitude and phase of H, V and P, and the maps of a processed scan.

Row 0 of an image (the smallest y) is at the bottom of its picture; unknown pixels are transparent.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.catalogue.pixels import Pixels
from polysight.imaging import ChannelImages
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Channels = ChannelImages | Pixels
"""Both channels of an image and the illuminated pixels: `h`, `v`, `valid` [ny, nx]."""
AMPLITUDE, PHASE = "cividis", "twilight"
_RANGE_DB = 35.0
_RATIO_PERCENTILES = (5.0, 95.0)
_FAINT_DB, _CLEAR_DB = -26.0, -18.0  # relative to the brightest: between them phases fade out
_THUMBNAIL = 96  # pixels at most


@dataclass(frozen=True)
class Picture:
    """A PNG, the values at the ends of its colour map, and the name of that map."""

    png: bytes
    low: float
    high: float
    unit: str
    colours: str = AMPLITUDE


def draw(images: Channels) -> dict[str, Picture]:
    """Draw amplitude and phase of H, V and P = H / V: `h_amplitude`, `h_phase` and so on.

    P is that of the given images: during a scan it is not referenced to metal.
    """
    return {name: _picture(values) for name, values in _channels(images).items()}


class _Values(NamedTuple):
    """Numbers and opacity [ny, nx] of a picture, and the limits of its colours."""

    numbers: NDArray[Any]
    opacity: NDArray[Any]
    limits: tuple[float, float]
    colours: str = AMPLITUDE
    unit: str = ""
    digits: int = 1


def _channels(images: Channels) -> dict[str, _Values]:
    seen = images.valid & np.isfinite(images.h) & np.isfinite(images.v)
    ratio = np.divide(images.h, images.v, out=np.zeros_like(images.h), where=seen & (images.v != 0))
    strength = np.minimum(_below_top(images.h, seen), _below_top(images.v, seen))
    out: dict[str, _Values] = {}
    for name, channel in (("h", images.h), ("v", images.v)):
        level = _db(channel)
        top = float(np.percentile(level[seen], 99.8)) if seen.any() else 0.0
        out[f"{name}_amplitude"] = _Values(level, seen.astype(float), (top - _RANGE_DB, top), AMPLITUDE, "dB")
        out[f"{name}_phase"] = _phase(channel, _fade(_below_top(channel, seen)) * seen)
    clear = _fade(strength) * seen
    level = _db(ratio)
    shown = level[clear > 0.5]
    low, high = np.percentile(shown, _RATIO_PERCENTILES) if shown.size else (-10.0, 10.0)
    middle, half = (low + high) / 2, max((high - low) / 2, 3.0)
    out["p_amplitude"] = _Values(level, clear, (float(middle - half), float(middle + half)), AMPLITUDE, "dB")
    out["p_phase"] = _phase(ratio, clear)
    return out


@dataclass(frozen=True)
class Map:
    """Title, unit and colours of a picture of a processed scan."""

    title: str
    unit: str
    colours: str = AMPLITUDE


MAPS = {
    "h_amplitude": Map("|H|, s-polarised", "dB"),
    "v_amplitude": Map("|V|, p-polarised", "dB"),
    "p_amplitude": Map("|P| = |H / V|", "dB"),
    "h_phase": Map("phase of H", "°", PHASE),
    "v_phase": Map("phase of V", "°", PHASE),
    "p_phase": Map("phase of P", "°", PHASE),
    "p_sigma": Map("standard deviation of P", ""),
    "permittivity": Map("permittivity, real part", ""),
    "loss": Map("permittivity, loss", ""),
}
"""Pictures of a processed scan by name."""


def draw_products(pixels: Pixels, name: str, limits: tuple[float, float] | None = None) -> Picture:
    """Draw one of `MAPS` of a processed scan; `limits` replaces the limits of its colours.

    Raises DataError if there is no such picture, or nothing to draw.
    """
    if name not in MAPS:
        raise DataError(
            f"no picture is called {name[:40]!r}", "the name is wrong", f"one of {', '.join(MAPS)}",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    values = _channels(pixels)[name] if name.endswith(("_amplitude", "_phase")) else _derived(pixels, name)
    return _picture(values if limits is None else values._replace(limits=limits))


def _derived(pixels: Pixels, name: str) -> _Values:
    """Maps derived from P: its error, permittivity, loss."""
    if not pixels.referenced:
        raise DataError(
            "no permittivity is shown", "the images are not referenced to metal, or support no result",
            "process the scan with metal", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    eps = pixels.permittivity
    values = {"p_sigma": pixels.p_std, "permittivity": eps.real, "loss": -eps.imag}[name]
    seen = pixels.clear & np.isfinite(values)
    if name != "p_sigma":
        seen &= ~pixels.metal_like
    high = float(np.percentile(values[seen], 85)) if seen.any() else 1.0  # edges of plates have any value
    low = 1.0 if name == "permittivity" else 0.0
    return _numbers(values, seen, (low, max(1.3 * high, low + 1e-3)), AMPLITUDE)


def _numbers(values: NDArray[Any], seen: NDArray[np.bool_], limits: tuple[float, float], colours: str) -> _Values:
    return _Values(np.where(seen, values, limits[0]), seen.astype(float), limits, colours, "", 3)


def picture_of(
    values: NDArray[Any], seen: NDArray[np.bool_], limits: tuple[float, float], colours: str = AMPLITUDE
) -> Picture:
    """Draw numbers without a unit; pixels that are not `seen` are transparent."""
    return _picture(_numbers(values, seen, limits, colours))


def thumbnail(pixels: Pixels) -> Picture:
    """A small picture of the amplitude of H."""
    step = max(1, -(-max(pixels.h.shape) // _THUMBNAIL))
    seen = pixels.valid & np.isfinite(pixels.h)
    level = _db(pixels.h)
    top = float(np.percentile(level[seen], 99.8)) if seen.any() else 0.0
    part = slice(None, None, step)
    return _picture(_Values(level[part, part], seen[part, part].astype(float), (top - _RANGE_DB, top)))


def _phase(channel: NDArray[np.complex64], opacity: NDArray[Any]) -> _Values:
    return _Values(np.degrees(np.angle(channel)), opacity, (-180.0, 180.0), PHASE, "°")


def _db(channel: NDArray[np.complex64]) -> NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(channel).astype(float), nan=0.0, posinf=0.0), 1e-12))


def _below_top(channel: NDArray[np.complex64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Level relative to the brightest seen pixels, dB."""
    level = _db(channel)
    return level - (float(np.percentile(level[seen], 99.5)) if seen.any() else 0.0)


def _fade(level_db: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip((level_db - _FAINT_DB) / (_CLEAR_DB - _FAINT_DB), 0.0, 1.0)


def _picture(v: _Values) -> Picture:
    import matplotlib  # here: it loads for half a second, and lists need no picture

    scaled = np.clip((v.numbers - v.limits[0]) / (v.limits[1] - v.limits[0]), 0.0, 1.0)
    rgba = matplotlib.colormaps[v.colours](scaled)
    rgba[..., 3] = v.opacity
    low, high = (round(float(limit), v.digits) for limit in v.limits)
    return Picture(_png(rgba, "lower"), low, high, v.unit, v.colours)


def _png(rgba: NDArray[Any], origin: Literal["lower", "upper"]) -> bytes:
    from matplotlib.image import imsave

    file = io.BytesIO()
    imsave(file, rgba, origin=origin, format="png")
    return file.getvalue()


def colour_bar(colours: str) -> bytes:
    """Draw a colour map from left to right, as PNG of 256 x 1 pixels."""
    import matplotlib

    return _png(matplotlib.colormaps[colours](np.linspace(0, 1, 256))[None], "upper")
