"""Images of scans as pictures: pixels of a processed scan with permittivity and errors, maps of them as PNG.

Row 0 of an image (the smallest y) is at the bottom of its picture; unknown pixels are transparent.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight import products
from polysight.imaging import Images
from polysight.polarimetry import specular_incidence_rad
from polysight_shared.errors import DataError, ErrorCode

Real = NDArray[np.float64]
# Colour maps of matplotlib: one that colour-blind people read, and a cyclic one.
AMPLITUDE_COLOURS = "cividis"
PHASE_COLOURS = "twilight"
UNITS = {"amplitude": "dB", "phase": "°"}
COLOURS = {"amplitude": AMPLITUDE_COLOURS, "phase": PHASE_COLOURS}
# Largest side of a thumbnail; chosen.
THUMBNAIL_PIXELS = 96


# --- pixels ---


@dataclass(frozen=True)
class Pixels(products.ProcessedScan):
    """Saved products with permittivity and errors of each pixel. Arrays are [ny, nx], row 0 the smallest y."""

    @classmethod
    def from_scan(cls, scan: products.ProcessedScan) -> Self:
        """Return the pixels of a result, saved or just computed."""
        pixels = cls(scan.folder)
        # Everything read or computed for the scan is in its `__dict__` (cached properties).
        vars(pixels).update(vars(scan))
        return pixels

    @property
    def referenced(self) -> bool:
        """True if the images are relative to metal and the verdict allows a result."""
        return self.metal_referenced and self.judged

    @cached_property
    def clear(self) -> NDArray[np.bool_]:
        """Pixels bright enough in both channels for a meaningful ratio, bool [ny, nx]."""
        return products.signal_opacity(self.images, "p") > 0

    @cached_property
    def p_std(self) -> Real:
        """Standard deviation of each part of P, float64 [ny, nx]; NaN where unknown."""
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
    def permittivity(self) -> products.PermittivityMap:
        """Permittivity and its errors; masked where it is not known, and where the image is too dark."""
        permittivity_map = products.map_permittivity(self)
        return replace(permittivity_map, mask=permittivity_map.mask & self.clear)

    def nearest(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        """Return the row and column of the pixel at a place. Raises DataError outside the image."""
        left, right, low, high = self.extent_mm
        if not (left <= x_mm <= right and low <= y_mm <= high):
            raise DataError(
                f"x = {x_mm:.6g} mm, y = {y_mm:.6g} mm lies outside the image",
                f"it reaches from x {left:.1f} to {right:.1f} mm, and from y {low:.1f} to {high:.1f} mm",
                "give a position in it, in mm from its centre", code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        return int(np.abs(self.y_mm - y_mm).argmin()), int(np.abs(self.x_mm - x_mm).argmin())


# --- pictures ---


@dataclass(frozen=True)
class Picture:
    """A PNG, the values at the ends of its colour map in `unit`, and the name of that map."""

    png: bytes
    low: float
    high: float
    unit: str
    colours: str = AMPLITUDE_COLOURS


class Map(msgspec.Struct, frozen=True):
    """A picture of a processed scan; with `needs_metal` it exists only for images relative to metal."""

    name: str
    title: str
    colours: str = AMPLITUDE_COLOURS
    needs_metal: bool = False


MAPS = {
    drawn.name: drawn
    for drawn in (
        Map("h_amplitude", "|H|, s-polarised"),
        Map("v_amplitude", "|V|, p-polarised"),
        Map("p_amplitude", "|P| = |H / V|"),
        Map("h_phase", "phase of H", PHASE_COLOURS),
        Map("v_phase", "phase of V", PHASE_COLOURS),
        Map("p_phase", "phase of P", PHASE_COLOURS),
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
    pictures = {}
    for channel in products.CHANNELS:
        for quantity in products.QUANTITIES:
            values = products.map_images(images, channel, quantity)
            pictures[f"{channel}_{quantity}"] = draw_values(values, UNITS[quantity], COLOURS[quantity])
    return pictures


def draw_products(pixels: Pixels, name: str, limits: products.Limits | None = None) -> Picture:
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
        unit = ""
    else:
        channel, _, quantity = name.partition("_")
        values = products.map_scan(pixels, channel, quantity)
        unit = UNITS[quantity]
    if limits is not None:
        values = replace(values, limits=limits)
    return draw_values(values, unit, MAPS[name].colours)


def thumbnail(pixels: Pixels) -> Picture:
    """Return a small picture of the amplitude of H."""
    # Take one pixel out of `step` along each axis.
    step = max(1, math.ceil(max(pixels.h.shape) / THUMBNAIL_PIXELS))
    values = products.map_scan(pixels, "h", "amplitude")
    smaller = replace(values, numbers=values.numbers[::step, ::step], opacity=values.opacity[::step, ::step])
    return draw_values(smaller, UNITS["amplitude"])


def _derive_values(pixels: Pixels, name: str) -> products.MapValues:
    """Return the values of one of the maps derived from P: its error, permittivity, loss."""
    if not pixels.referenced:
        raise DataError(
            "no permittivity is shown", "the images are not referenced to metal, or support no result",
            "process the scan with metal", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    if name == "p_sigma":
        values = pixels.p_std
        is_visible = pixels.clear & np.isfinite(values)
    else:
        eps = pixels.permittivity
        values = eps.value.real if name == "permittivity" else -eps.value.imag
        is_visible = eps.mask
    # At the edges of plates the values are arbitrary and may be very large: the colours end at 1.3 times the 85th
    # percentile (chosen).
    high = products.percentile(values, is_visible, 85, 1.0)
    low = 1.0 if name == "permittivity" else 0.0
    return products.MapValues(values, is_visible, (low, max(1.3 * high, low + 1e-3)))


def draw_values(values: products.MapValues, unit: str = "", colours: str = AMPLITUDE_COLOURS) -> Picture:
    """Draw numbers as a PNG with one pixel each; pixels without a number must be transparent."""
    # Imported here: it loads for half a second, and lists need no picture.
    import matplotlib

    low, high = values.limits
    numbers = np.where(values.opacity > 0, values.numbers, low)
    rgba = matplotlib.colormaps[colours](np.clip((numbers - low) / (high - low), 0.0, 1.0))
    rgba[..., 3] = values.opacity
    digits = 1 if unit else 3
    return Picture(_encode_png(rgba, "lower"), round(float(low), digits), round(float(high), digits), unit, colours)


def colour_bar(colours: str) -> bytes:
    """Draw a colour map from left to right, as PNG of 256 x 1 pixels."""
    import matplotlib

    return _encode_png(matplotlib.colormaps[colours](np.linspace(0, 1, 256))[None], "upper")


def _encode_png(rgba: NDArray[Any], origin: Literal["lower", "upper"]) -> bytes:
    """Return colours [ny, nx, 4], 0 to 1, as PNG; with `lower` row 0 is at the bottom."""
    from matplotlib.image import imsave

    file = io.BytesIO()
    imsave(file, rgba, origin=origin, format="png")
    return file.getvalue()
