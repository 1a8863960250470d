"""Pixels of a processed scan: images, places in millimetres, permittivity, and errors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from polysight.materials import axis_mm
from polysight.polarimetry import permittivity_from_ratio, specular_incidence_rad
from polysight.products import SavedProducts
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = NDArray[np.float64]
_FAINT_DB = -26.0  # relative to the brightest; fainter pixels are noise
_STEP = 1e-5


@dataclass(frozen=True)
class Pixels(SavedProducts):
    """Saved products with permittivity and errors of each pixel. Arrays are [ny, nx], row 0 the smallest y."""

    @property
    def referenced(self) -> bool:
        """True if the images are relative to metal and the verdict allows a result."""
        return self.metal_referenced and (self.verdict is None or self.verdict.usable)

    @cached_property
    def clear(self) -> NDArray[np.bool_]:
        """Pixels bright enough in both channels for a meaningful ratio."""
        out = self.valid & np.isfinite(self.h) & np.isfinite(self.v)
        for channel in (np.abs(self.h), np.abs(self.v)):
            top = float(np.percentile(channel[out], 99.5)) if out.any() else 0.0
            out = out & (channel > top * 10 ** (_FAINT_DB / 20))
        return out

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
        x, y = self.x_mm, self.y_mm
        hx, hy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
        return float(x[0] - hx), float(x[-1] + hx), float(y[0] - hy), float(y[-1] + hy)

    @cached_property
    def p_std(self) -> Real:
        """Standard deviation of each part of P; nan where unknown."""
        sigma = self.p_sigma
        return np.full(self.valid.shape, np.nan) if sigma is None else np.asarray(sigma, np.float64)

    @cached_property
    def theta_rad(self) -> float:
        """Incidence angle, from the error budget or the rig. Raises DataError."""
        budget = self.materials.get("error_budget") or {}
        try:
            return float(np.radians(budget["incidence"]["deg"]))
        except (KeyError, TypeError):
            pass
        if self.rig is None:
            raise DataError(
                f"{self.folder}: the incidence angle is not known", "an earlier release made these products",
                "process the scan again", code=ErrorCode.KEY_MISSING,
            )  # fmt: skip
        return specular_incidence_rad(self.rig)

    @cached_property
    def permittivity(self) -> NDArray[np.complex128]:
        """Permittivity eps' - j eps'' as a half space; nan where P is too close to metal or too dark."""
        p = np.where(self.clear & np.isfinite(self.p), self.p, np.nan).astype(np.complex128)
        eps = permittivity_from_ratio(p, self.theta_rad)
        return np.where(np.isfinite(eps), eps, complex(np.nan, np.nan))

    @cached_property
    def permittivity_sigma(self) -> Real:
        """Standard deviation of each part of the permittivity: that of P times the slope (the map is analytic)."""
        p = np.asarray(self.p, np.complex128)
        with np.errstate(invalid="ignore", over="ignore"):
            near = permittivity_from_ratio(p + _STEP, self.theta_rad)
            slope = np.abs((near - permittivity_from_ratio(p, self.theta_rad)) / _STEP)
            return np.where(np.isfinite(slope), slope, np.nan) * self.p_std

    @cached_property
    def metal_like(self) -> NDArray[np.bool_]:
        """Pixels so close to metal that their permittivity is only known to be large."""
        size = np.abs(self.permittivity)
        with np.errstate(invalid="ignore"):
            unsure = np.isfinite(self.p_std) & (self.permittivity_sigma > 0.5 * size)
            return unsure | (np.abs(self.p - 1) < 0.2) | ~np.isfinite(size)

    def nearest(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        """Row and column of the pixel at a place. Raises DataError outside the image."""
        left, right, low, high = self.extent_mm
        if not (left <= x_mm <= right and low <= y_mm <= high):
            raise DataError(
                f"x = {x_mm:.1f} mm, y = {y_mm:.1f} mm lies outside the image",
                f"it reaches from x {left:.1f} to {right:.1f} mm, and from y {low:.1f} to {high:.1f} mm",
                "give a place in it, in mm from its centre",
                code=ErrorCode.VALUE_INVALID,
            )
        return int(np.abs(self.y_mm - y_mm).argmin()), int(np.abs(self.x_mm - x_mm).argmin())
