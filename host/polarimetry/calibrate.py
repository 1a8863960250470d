"""Metal reference, leakage and smoothing of the H and V images (section 6.2 of the paper).

Model of one pixel, with r_s and r_p of the material and a transmitter that excites s and p equally:

    H = g_h (r_s + a r_p)        V = g_v (r_p + b r_s)

g_h and g_v are complex (RX gain, a constant phase of the measured geometry), a and b are the cross-polar leakages of
the H and V receivers. A metal region (r_s = r_p) fixes g_h (1 + a) and g_v (1 + b) and nothing else: **metal at one
orientation cannot tell leakage from gain**. Leakage therefore is given, or found from a second, known material.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.shared.errors import DataError, PolysightError

Image = npt.NDArray[np.complexfloating]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Calibrated:
    """Metal-referenced channels.

    Attributes
    ----------
    h, v
        complex [ny, nx], relative to metal: |h| = |v| = 1 on metal, and their phase difference is zero there.
    p
        h / v, complex [ny, nx]; not a number where v is exactly zero.
    metal_h, metal_v
        What the channels were divided by: complex numbers, or images [ny, nx] of a reference over the whole plane.
        metal_v is real when it comes from a region: only the phase of the ratio is referenced, because the phase of
        H and V alone belongs to the distance (Eq. 7).
    """

    h: Image
    v: Image
    p: Image
    metal_h: complex | Image
    metal_v: complex | Image


def ratio(h: Image, v: Image) -> Image:
    """Polarisation ratio h / v, complex; not a number where v is exactly zero or either is not finite."""
    ok = (v != 0) & np.isfinite(v) & np.isfinite(h)
    out = np.full(np.broadcast_shapes(h.shape, v.shape), complex(np.nan, np.nan), np.result_type(h, v))
    np.divide(h, v, out=out, where=ok)
    return out


def calibrate(h: Image, v: Image, metal_mask: Mask) -> Calibrated:
    """Divide both channels by their value over a metal region (Eq. 8 and 9 of the paper).

    Amplitudes are root mean squares over the region and the phase of the ratio is that of sum(h conj(v)): both
    channels are treated alike, a common phase of H and V (distance, tilt) has no influence, and pixels of low
    amplitude do not count more than others, as they would in the mean of the pixel ratios.

    Parameters
    ----------
    h, v
        complex [ny, nx], the two channels.
    metal_mask
        bool [ny, nx], the inside of a metal region.

    Raises
    ------
    DataError
        when the region is empty, not finite or dark.
    """
    if metal_mask.shape != h.shape or h.shape != v.shape:
        raise DataError(f"metal region {metal_mask.shape} and images {h.shape}, {v.shape} differ in shape")
    mh, mv = h[metal_mask].astype(np.complex128), v[metal_mask].astype(np.complex128)
    good = np.isfinite(mh) & np.isfinite(mv)
    mh, mv = mh[good], mv[good]
    cross = complex(np.vdot(mv, mh)) if mh.size else 0j
    if mh.size == 0 or abs(cross) == 0:
        raise DataError(
            "the metal reference region holds no signal",
            "it lies outside the image, outside the valid part, or where nothing reflects",
            "give a region inside the metal patch",
        )
    metal_v = float(np.sqrt(np.mean(np.abs(mv) ** 2)))
    metal_h = float(np.sqrt(np.mean(np.abs(mh) ** 2))) * cross / abs(cross)
    return calibrate_by_reference(h, v, metal_h, complex(metal_v))


def calibrate_by_reference(h: Image, v: Image, metal_h: complex | Image, metal_v: complex | Image) -> Calibrated:
    """Divide both channels by a metal reference that is already known: numbers, or images of a metal plane [ny, nx].

    A reference over the whole plane also removes what differs from place to place (illumination of H against V).
    """
    kind = np.result_type(h, np.complex64)
    ch, cv = ratio(h, np.asarray(metal_h, kind)), ratio(v, np.asarray(metal_v, kind))
    return Calibrated(ch, cv, ratio(ch, cv), metal_h, metal_v)


def correct_leakage(h: Image, v: Image, leak_hv: complex, leak_vh: complex) -> tuple[Image, Image]:
    """Remove known cross-polar leakage from metal-referenced channels.

    H received r_s + leak_hv r_p and V received r_p + leak_vh r_s, each then divided by its value on metal. Solving the
    two equations with the metal reference kept at 1:

        h' = ((1 + a) h - a (1 + b) v) / (1 - a b)        v' = ((1 + b) v - b (1 + a) h) / (1 - a b)

    Parameters
    ----------
    h, v
        complex, metal-referenced (:func:`calibrate`): their phases must refer to the same distance.
    leak_hv, leak_vh
        Amplitude of p in H and of s in V, complex or real. The published rig has about 0.05 to 0.1; zero changes
        nothing. `leak_hv = leak_vh = axial ratio` is the one-parameter correction of the paper's authors.

    Raises
    ------
    PolysightError
        when |leakage| is not below 1.
    """
    a, b = leak_hv, leak_vh
    if not (abs(a) < 1 and abs(b) < 1):
        raise PolysightError(f"leakage {a}, {b}: amplitudes must be below 1", "leakage is a ratio, not decibels")
    kind = np.result_type(h, np.complex64)
    s, p = h * kind.type(1 + a), v * kind.type(1 + b)
    scale = kind.type(1 / (1 - a * b))
    return (s - kind.type(a) * p) * scale, (p - kind.type(b) * s) * scale


def axial_ratio_from_known(measured_p: complex, true_p: complex) -> complex:
    """Leakage of both channels, taken as equal, from one material of known ratio beside the metal.

    From P = ((t + a) / (1 + a)) / ((1 + a t) / (1 + a)): a = (P - t) / (1 - P t).

    Raises
    ------
    PolysightError
        when the known material is as good as metal, which says nothing about leakage.
    """
    if abs(true_p - 1) < 0.1 or abs(1 - measured_p * true_p) < 1e-12:
        raise PolysightError(
            f"a material of ratio {true_p:.3g} cannot reveal leakage",
            "it reflects s and p alike, as metal does",
            "use a dielectric of known permittivity",
        )
    return (measured_p - true_p) / (1 - measured_p * true_p)


def smooth(image: npt.NDArray[Any], sigma_px: float) -> npt.NDArray[Any]:
    """2-D Gaussian filter of a complex or real image [ny, nx] against speckle (section 9.1 of the paper).

    Pixels that are not finite do not spread: the filter is normalised by the weight of the finite ones, and they stay
    not finite. `sigma_px` in pixels; zero or less returns the image itself. Smooth H and V only after the phase of the
    distance was taken out (flattened by the footprint), or use :func:`multilook_ratio`.
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


def multilook_ratio(h: Image, v: Image, sigma_px: float) -> Image:
    """H / V averaged over neighbouring pixels: 1 / (G[v conj(h)] / G[|h|^2]) with a Gaussian window G.

    A phase common to both channels cancels before the averaging, and the strong channel H is in the denominator, so
    that noise does not bias the ratio where V nearly vanishes (Brewster angle). Complex [ny, nx].
    """
    cross, power = smooth(v * np.conj(h), sigma_px), smooth(np.abs(h) ** 2, sigma_px)
    return ratio(power.astype(cross.dtype), cross)
