"""Images of scans as pictures: pixels of a processed scan with permittivity and errors, maps of them as PNG.

Row 0 of an image (the smallest y) is at the bottom of its picture; unknown pixels are transparent.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.imaging import Images
from polysight.materials import axis_mm
from polysight.polarimetry import specular_incidence_rad
from polysight.products import PermittivityMap, ProcessedScan, map_permittivity
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = NDArray[np.float64]
Limits = tuple[float, float]
AMPLITUDE = "cividis"
PHASE = "twilight"
RANGE_DB = 35.0
# Relative to the brightest: fainter pixels are noise; up to the second level phases fade out.
FAINT_DB = -26.0
CLEAR_DB = -18.0
THUMBNAIL_PIXELS = 96


# --- pixels ---


@dataclass(frozen=True)
class Pixels(ProcessedScan):
    """Saved products with permittivity and errors of each pixel. Arrays are [ny, nx], row 0 the smallest y."""

    @classmethod
    def from_scan(cls, scan: ProcessedScan) -> Self:
        """Return the pixels of a result, saved or just computed."""
        pixels = cls(scan.folder)
        vars(pixels).update(vars(scan))
        return pixels

    @property
    def referenced(self) -> bool:
        """True if the images are relative to metal and the verdict allows a result."""
        return self.metal_referenced and self.judged

    @cached_property
    def clear(self) -> NDArray[np.bool_]:
        """Pixels bright enough in both channels for a meaningful ratio."""
        clear = self.valid & np.isfinite(self.h) & np.isfinite(self.v)
        for channel in (self.h, self.v):
            amplitude = np.abs(channel)
            clear = clear & (amplitude > percentile(amplitude, clear, 99.5) * 10 ** (FAINT_DB / 20))
        return clear

    @cached_property
    def x_mm(self) -> Real:
        """Pixel centres from the middle of the image, [nx]."""
        return axis_mm(self.x_m)

    @cached_property
    def y_mm(self) -> Real:
        """The same, [ny]."""
        return axis_mm(self.y_m)

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper edge of the image."""
        x = self.x_mm
        y = self.y_mm
        half_x = (x[1] - x[0]) / 2
        half_y = (y[1] - y[0]) / 2
        return float(x[0] - half_x), float(x[-1] + half_x), float(y[0] - half_y), float(y[-1] + half_y)

    @cached_property
    def p_std(self) -> Real:
        """Standard deviation of each part of P; nan where unknown."""
        if self.images.p_sigma is None:
            return np.full(self.valid.shape, np.nan)
        return np.asarray(self.images.p_sigma, np.float64)

    @cached_property
    def theta_rad(self) -> float:
        """Incidence angle, from the error budget or the rig. Raises DataError."""
        budget = None
        if self.materials is not None:
            budget = self.materials.error_budget
        if budget and budget.incidence is not None and budget.incidence.deg is not None:
            return float(np.radians(budget.incidence.deg))
        if self.rig is None:
            raise DataError(
                f"{self.folder}: the incidence angle is not known", "an earlier release made these products",
                "process the scan again", code=ErrorCode.KEY_MISSING,
            )  # fmt: skip
        return specular_incidence_rad(self.rig)

    @cached_property
    def permittivity(self) -> PermittivityMap:
        """Permittivity and its errors; masked where it is not known, and where the image is too dark."""
        known = map_permittivity(self)
        return replace(known, mask=known.mask & self.clear)

    def nearest(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        """Row and column of the pixel at a place. Raises DataError outside the image."""
        x_min, right, low, high = self.extent_mm
        if not (x_min <= x_mm <= right and low <= y_mm <= high):
            raise DataError(
                f"x = {x_mm:.6g} mm, y = {y_mm:.6g} mm lies outside the image",
                f"it reaches from x {x_min:.1f} to {right:.1f} mm, and from y {low:.1f} to {high:.1f} mm",
                "give a place in it, in mm from its centre", code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        return int(np.abs(self.y_mm - y_mm).argmin()), int(np.abs(self.x_mm - x_mm).argmin())


# --- pictures ---


@dataclass(frozen=True)
class Picture:
    """A PNG, the values at the ends of its colour map, and the name of that map."""

    png: bytes
    low: float
    high: float
    unit: str
    colours: str = AMPLITUDE


@dataclass(frozen=True)
class Values:
    """Numbers and opacity [ny, nx] of a picture, and the limits of its colours."""

    numbers: NDArray[Any]
    opacity: NDArray[Any]
    limits: Limits
    unit: str = ""
    colours: str = AMPLITUDE


class Map(msgspec.Struct, frozen=True):
    """A picture of a processed scan; some need a reference of metal."""

    name: str
    title: str
    colours: str = AMPLITUDE
    needs_metal: bool = False


MAPS = {
    drawn.name: drawn
    for drawn in (
        Map("h_amplitude", "|H|, s-polarised"),
        Map("v_amplitude", "|V|, p-polarised"),
        Map("p_amplitude", "|P| = |H / V|"),
        Map("h_phase", "phase of H", PHASE),
        Map("v_phase", "phase of V", PHASE),
        Map("p_phase", "phase of P", PHASE),
        Map("p_sigma", "standard deviation of P", needs_metal=True),
        Map("permittivity", "permittivity, real part", needs_metal=True),
        Map("loss", "permittivity, loss", needs_metal=True),
    )
}
"""Pictures of a processed scan by name."""


def draw(images: Images) -> dict[str, Picture]:
    """Draw amplitude and phase of H, V and P = H / V: `h_amplitude`, `h_phase` and so on.

    P is that of the given images: during a scan it is not referenced to metal.
    """
    return {name: draw_values(values) for name, values in _channel_values(images).items()}


def draw_products(pixels: Pixels, name: str, limits: Limits | None = None) -> Picture:
    """Draw one of `MAPS` of a processed scan; `limits` replaces the limits of its colours.

    Raises DataError if there is no such picture, or nothing to draw.
    """
    if name not in MAPS:
        raise DataError(
            f"no picture is called {name[:40]!r}", "the name is wrong", f"one of {', '.join(MAPS)}",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    if MAPS[name].needs_metal:
        values = _derive_values(pixels, name)
    else:
        values = _channel_values(pixels)[name]
    if limits is not None:
        values = replace(values, limits=limits)
    return draw_values(values)


def thumbnail(pixels: Pixels) -> Picture:
    """A small picture of the amplitude of H."""
    step = max(1, -(-max(pixels.h.shape) // THUMBNAIL_PIXELS))
    values = _amplitude(pixels.h, pixels.valid & np.isfinite(pixels.h))
    small = (slice(None, None, step), slice(None, None, step))
    return draw_values(replace(values, numbers=values.numbers[small], opacity=values.opacity[small]))


def _channel_values(images: Images | Pixels) -> dict[str, Values]:
    visible = images.valid & np.isfinite(images.h) & np.isfinite(images.v)
    values = {}
    for name, channel in (("h", images.h), ("v", images.v)):
        values[f"{name}_amplitude"] = _amplitude(channel, visible)
        values[f"{name}_phase"] = _phase(channel, _fade(_below_brightest(channel, visible)) * visible)
    ratio = np.divide(images.h, images.v, out=np.zeros_like(images.h), where=visible & (images.v != 0))
    fainter = np.minimum(_below_brightest(images.h, visible), _below_brightest(images.v, visible))
    opacity = _fade(fainter) * visible
    level = _db(ratio)
    low = percentile(level, opacity > 0.5, 5, -10.0)
    high = percentile(level, opacity > 0.5, 95, 10.0)
    middle = (low + high) / 2
    half = max((high - low) / 2, 3.0)
    values["p_amplitude"] = Values(level, opacity, (middle - half, middle + half), "dB")
    values["p_phase"] = _phase(ratio, opacity)
    return values


def _derive_values(pixels: Pixels, name: str) -> Values:
    """Maps derived from P: its error, permittivity, loss."""
    if not pixels.referenced:
        raise DataError(
            "no permittivity is shown", "the images are not referenced to metal, or support no result",
            "process the scan with metal", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    if name == "p_sigma":
        values = pixels.p_std
        visible = pixels.clear & np.isfinite(values)
    else:
        eps = pixels.permittivity
        values = eps.value.real if name == "permittivity" else -eps.value.imag
        visible = eps.mask
    # Edges of plates have any value.
    high = percentile(values, visible, 85, 1.0)
    low = 1.0 if name == "permittivity" else 0.0
    return mask_values(values, visible, (low, max(1.3 * high, low + 1e-3)))


def mask_values(values: NDArray[Any], visible: NDArray[np.bool_], limits: Limits, colours: str = AMPLITUDE) -> Values:
    """Numbers without a unit, to be drawn; pixels that are not `visible` are transparent."""
    return Values(np.where(visible, values, limits[0]), visible.astype(float), limits, colours=colours)


def _amplitude(channel: NDArray[np.complex64], visible: NDArray[np.bool_]) -> Values:
    level = _db(channel)
    brightest = percentile(level, visible, 99.8)
    return Values(level, visible.astype(float), (brightest - RANGE_DB, brightest), "dB")


def _phase(channel: NDArray[np.complex64], opacity: NDArray[Any]) -> Values:
    return Values(np.degrees(np.angle(channel)), opacity, (-180.0, 180.0), "°", PHASE)


def _db(channel: NDArray[np.complex64]) -> Real:
    amplitude = np.nan_to_num(np.abs(channel).astype(float), nan=0.0, posinf=0.0)
    return 20 * np.log10(np.maximum(amplitude, 1e-12))


def _below_brightest(channel: NDArray[np.complex64], visible: NDArray[np.bool_]) -> Real:
    """Level relative to the brightest visible pixels, dB."""
    level = _db(channel)
    return level - percentile(level, visible, 99.5)


def percentile(values: Real, mask: NDArray[np.bool_], percent: float, default: float = 0.0) -> float:
    """A percentile of the values under a mask; `default` if it is empty."""
    if mask.any():
        return float(np.percentile(values[mask], percent))
    return default


def _fade(level_db: Real) -> Real:
    return np.clip((level_db - FAINT_DB) / (CLEAR_DB - FAINT_DB), 0.0, 1.0)


def draw_values(values: Values) -> Picture:
    """Draw numbers as a PNG with one pixel each."""
    # Imported here: it loads for half a second, and lists need no picture.
    import matplotlib

    low, high = values.limits
    rgba = matplotlib.colormaps[values.colours](np.clip((values.numbers - low) / (high - low), 0.0, 1.0))
    rgba[..., 3] = values.opacity
    digits = 1 if values.unit else 3
    return Picture(
        _png(rgba, "lower"), round(float(low), digits), round(float(high), digits), values.unit, values.colours
    )


def colour_bar(colours: str) -> bytes:
    """Draw a colour map from left to right, as PNG of 256 x 1 pixels."""
    import matplotlib

    return _png(matplotlib.colormaps[colours](np.linspace(0, 1, 256))[None], "upper")


def _png(rgba: NDArray[Any], origin: Literal["lower", "upper"]) -> bytes:
    from matplotlib.image import imsave

    file = io.BytesIO()
    imsave(file, rgba, origin=origin, format="png")
    return file.getvalue()
