"""Metal reference, leakage and smoothing of the H and V images (section 6.2 of the paper).

Model of one pixel, for a transmitter that excites s and p equally:

    H = g_h (r_s + a r_p)        V = g_v (r_p + b r_s)

r_s and r_p are the reflection coefficients of the material, g_h and g_v complex gains, a and b the cross-polar leakages
of the H and V receivers. A metal region (r_s = r_p) determines only g_h (1 + a) and g_v (1 + b): **metal at one
orientation cannot separate leakage from gain**. Leakage is therefore given, or estimated from a second known material.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Image, Images, Mask
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, PolysightError


def ratio(h: Image, v: Image) -> Image:
    """Return the polarisation ratio h / v, complex; NaN where v is zero or either is not finite."""
    ok = (v != 0) & np.isfinite(v) & np.isfinite(h)
    out = np.full(np.broadcast_shapes(h.shape, v.shape), complex(np.nan, np.nan), np.result_type(h, v))
    np.divide(h, v, out=out, where=ok)
    return out


def with_ratio(images: Images) -> Images:
    """Return the images with p = h / v."""
    return replace(images, p=ratio(images.h, images.v))


def metal_gains(h: Image, v: Image, metal_mask: Mask) -> tuple[complex, complex]:
    """Return the gains of H and V over a metal region (Eq. 8 and 9 of the paper).

    Amplitudes are RMS values over the region, and the phase of the ratio is that of sum(h conj(v)): a common phase of
    H and V (distance, tilt) has no influence, and weak pixels do not dominate, as in the mean of the pixel ratios.
    The gain of V is real: only the phase of the ratio is referenced, for the phase of H and V alone is that of the
    distance (Eq. 7).

    Parameters
    ----------
    h, v
        complex [ny, nx], the two channels.
    metal_mask
        bool [ny, nx], the inside of a metal region.

    Raises
    ------
    DataError
        if the region is empty, not finite or dark.
    """
    if metal_mask.shape != h.shape or h.shape != v.shape:
        raise DataError(
            f"metal region {metal_mask.shape} and images {h.shape}, {v.shape} differ in shape", code=ErrorCode.MISMATCH
        )
    mh, mv = h[metal_mask].astype(np.complex128), v[metal_mask].astype(np.complex128)
    good = np.isfinite(mh) & np.isfinite(mv)
    mh, mv = mh[good], mv[good]
    cross = complex(np.vdot(mv, mh)) if mh.size else 0j
    if mh.size == 0 or abs(cross) == 0:
        raise DataError(
            "the metal reference region has no signal",
            "it lies outside the image or its valid part, or nothing reflects there",
            "give a region inside the metal patch",
            code=ErrorCode.NO_DATA,
        )
    metal_v = float(np.sqrt(np.mean(np.abs(mv) ** 2)))
    metal_h = float(np.sqrt(np.mean(np.abs(mh) ** 2))) * cross / abs(cross)
    return metal_h, complex(metal_v)


def calibrate(images: Images, metal_mask: Mask) -> Images:
    """Divide both channels by their gains over a metal region, see :func:`metal_gains`; adds the ratio p."""
    return divide_by_metal(images, *metal_gains(images.h, images.v, metal_mask))


def divide_by_metal(images: Images, metal_h: complex | Image, metal_v: complex | Image) -> Images:
    """Divide both channels by metal: numbers, or images of a metal plate [ny, nx]; adds the ratio p."""
    kind = np.result_type(images.h, np.complex64)
    h = ratio(images.h, np.asarray(metal_h, kind))
    v = ratio(images.v, np.asarray(metal_v, kind))
    return with_ratio(replace(images, h=h, v=v, metal_h=metal_h, metal_v=metal_v))


def remove_leakage(images: Images, leakage: tuple[complex, complex]) -> Images:
    """Remove known leakage (p in H, s in V) from metal-referenced images, see :func:`correct_leakage`."""
    h, v = correct_leakage(images.h, images.v, *leakage)
    return with_ratio(replace(images, h=h, v=v))


def correct_leakage(h: Image, v: Image, leak_hv: complex, leak_vh: complex) -> tuple[Image, Image]:
    """Remove known cross-polar leakage from metal-referenced channels.

    H received r_s + leak_hv r_p and V received r_p + leak_vh r_s, each divided by its value on metal. The solution
    that keeps metal at 1 is

        h' = ((1 + a) h - a (1 + b) v) / (1 - a b)        v' = ((1 + b) v - b (1 + a) h) / (1 - a b)

    Parameters
    ----------
    h, v
        complex, metal-referenced (:func:`calibrate`); their phases must refer to the same distance.
    leak_hv, leak_vh
        Amplitude of p in H and of s in V, complex or real; the published rig has about 0.05 to 0.1.
        `leak_hv = leak_vh = axial ratio` is the one-parameter correction of the paper's authors.

    Raises
    ------
    PolysightError
        if |leakage| is not below 1.
    """
    a, b = leak_hv, leak_vh
    if not (abs(a) < 1 and abs(b) < 1):
        raise PolysightError(
            f"leakage {a}, {b}: amplitudes must be below 1",
            "leakage is a ratio, not decibels",
            code=ErrorCode.VALUE_INVALID,
        )
    kind = np.result_type(h, np.complex64)
    s, p = h * kind.type(1 + a), v * kind.type(1 + b)
    scale = kind.type(1 / (1 - a * b))
    return (s - kind.type(a) * p) * scale, (p - kind.type(b) * s) * scale


def smooth(image: npt.NDArray[Any], sigma_px: float) -> npt.NDArray[Any]:
    """Filter a complex or real image [ny, nx] with a 2-D Gaussian against speckle (section 9.1 of the paper).

    Pixels that are not finite do not spread and stay so: the filter is normalised by the weight of the finite pixels.
    `sigma_px` in pixels; zero or less returns the image itself. Smooth H and V only after the phase of the distance was
    removed (divided by the footprint).
    """
    if sigma_px <= 0:
        return image
    good = np.isfinite(image)
    filled = np.where(good, image, 0)
    out = np.asarray(scipy.ndimage.gaussian_filter(filled, sigma_px, mode="nearest"))
    if not good.all():
        weight = scipy.ndimage.gaussian_filter(good.astype(np.float64), sigma_px, mode="nearest")
        out = np.where(good, out / np.where(good, weight, 1.0), image)
    return out.astype(image.dtype)
