"""Estimate cross-polar leakage and gain imbalance from metal at two orientations.

A metal plate reflects s and p equally in every orientation: it determines only g_h (1 + a) / (g_v (1 + b)). Metal
strips with a pitch well below a wavelength reflect only the field along them. Strips rotated by psi from the vertical
(s), flat on the plane at incidence theta, project the wave on w = (cos psi, sin psi cos theta): the current along them
cancels the field along them and radiates both polarisations. TX sends s and p equally, so the reflected wave is
proportional to w. Vertical strips reflect s alone, so V receives only leakage; horizontal strips reflect p alone, so H
receives only leakage.

Thin free wires are a good approximation. Wires with a diameter of a tenth of their pitch d reflect about
0.025 d / wavelength of the field across them (Marcuvitz, Waveguide Handbook, section 5.18: 0.003 at 0.5 mm). They
reflect the field along them less than a plate, a common factor without influence. A printed board is unsuitable, for
its substrate reflects both polarisations.

With the wave e of each standard known up to a factor (distance and size), and the measured pair m = (H, V),

    m ~ [[g_h, g_h a], [g_v b, g_v]] e

is a homography of the projective line. Three different waves (the plate, and strips at two orientations) determine it
up to one factor, by linear equations. More waves give a least-squares solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.imaging import Image, Mask
from polysight.polarimetry.calibrate import ratio
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, PolysightError

PLATE = (1.0, 1.0)
"""The s and p reflected by a metal plate."""
MIN_CONDITION = 0.02
"""Smallest ratio of third to first singular value: below it the waves do not determine three unknowns."""
Wave = tuple[complex, complex]


@dataclass(frozen=True)
class Standard:
    """Measurement of a metal standard.

    Attributes
    ----------
    measured
        H and V, up to a common factor (:func:`common_direction`).
    wave
        Reflected s and p, up to a factor: :data:`PLATE` or :func:`strips_wave`.
    """

    measured: Wave
    wave: Wave


@dataclass(frozen=True)
class Leakage:
    """Leakage and imbalance: H = g_h (r_s + h r_p), V = g_v (r_p + v r_s).

    Attributes
    ----------
    h, v
        Leakage of p into H and of s into V: `leakage_h` and `leakage_v` of the rig file.
    imbalance
        g_h / g_v, complex.
    residual
        RMS misfit of the standards, as an angle in radians; zero if there are only as many as unknowns.
    """

    h: complex
    v: complex
    imbalance: complex
    residual: float

    def matrix(self) -> npt.NDArray[np.complex128]:
        """Return the 2 x 2 matrix from (s, p) to (H, V), with g_v = 1."""
        g = self.imbalance
        return np.array([[g, g * self.h], [self.v, 1.0]], np.complex128)


def strips_wave(psi_rad: float, theta_rad: float) -> Wave:
    """Return the s and p reflected by ideal metal strips rotated by psi from the vertical; TX sends both equally.

    With the signs of Eq. 2: -w (w_s + w_p) / |w|^2 with w = (cos psi, sin psi cos theta), so that strips along the
    field reflect like a plate.

    Raises
    ------
    PolysightError
        if TX's field is across the strips (w_s = -w_p), which then reflect nothing.
    """
    w = np.array([np.cos(psi_rad), np.sin(psi_rad) * np.cos(theta_rad)])
    total = float(w.sum())
    if abs(total) < 0.1:
        raise PolysightError(
            f"strips at {np.degrees(psi_rad):.0f} degrees reflect almost nothing",
            "the transmitter's field is across them",
            "rotate them to 0 and 90 degrees",
            code=ErrorCode.VALUE_INVALID,
        )
    s, p = -w * total / float(w @ w)
    return complex(s), complex(p)


def common_direction(h: Image, v: Image, mask: Mask | None = None) -> Wave:
    """Return the common pair (H, V) of pixels, up to a factor: the first eigenvector of their 2 x 2 covariance.

    A common phase or amplitude of both channels may vary from pixel to pixel.

    Raises
    ------
    DataError
        if there is no signal.
    """
    at = np.isfinite(h) & np.isfinite(v) & (True if mask is None else mask)
    m = np.stack([h[at], v[at]]).astype(np.complex128)
    if m.size == 0 or not np.any(m):
        raise DataError(
            "a metal standard has no signal",
            "its region lies outside the image",
            "correct the region",
            code=ErrorCode.NO_DATA,
        )
    values, vectors = np.linalg.eigh(m @ m.conj().T)
    pair = vectors[:, int(np.argmax(values))]
    return complex(pair[0]), complex(pair[1])


def estimate_leakage(standards: Sequence[Standard]) -> Leakage:
    """Estimate leakage of both boards and gain imbalance from three or more metal standards.

    Raises
    ------
    DataError
        if there are fewer than three, or their waves are too similar.
    """
    if len(standards) < 3:
        raise DataError(
            f"{len(standards)} metal standards for three unknowns",
            "leakage of H, leakage of V and gain imbalance need three different waves",
            "scan the plate, and strips at two orientations; or use the one-parameter axial ratio",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    m = np.array([s.measured for s in standards], np.complex128)
    scale = np.sqrt(np.mean(np.abs(m / np.linalg.norm(m, axis=1, keepdims=True)) ** 2, axis=0))
    m = m / scale
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    e = np.array([s.wave for s in standards], np.complex128)
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    # m x (M e) = 0: one equation per standard for the entries g_h, g_h a, g_v b, g_v of M.
    rows = np.stack([m[:, 1] * e[:, 0], m[:, 1] * e[:, 1], -m[:, 0] * e[:, 0], -m[:, 0] * e[:, 1]], axis=1)
    _, sizes, vh = np.linalg.svd(rows)
    if sizes[2] < MIN_CONDITION * sizes[0]:
        raise DataError(
            "the metal standards do not separate leakage from gain",
            "their waves are too similar: a plate reflects the same in every orientation, strips must be rotated",
            "scan the plate, and strips at 0 and at 90 degrees",
            code=ErrorCode.VALUES_CONFLICT,
        )
    g_h, g_ha, g_vb, g_v = vh[3].conj() * np.array([scale[0], scale[0], scale[1], scale[1]])
    fitted = (np.array([[g_h, g_ha], [g_vb, g_v]]) / scale[:, None] @ e.T).T
    sine = np.abs(m[:, 1] * fitted[:, 0] - m[:, 0] * fitted[:, 1]) / np.linalg.norm(fitted, axis=1)
    residual = float(np.sqrt(np.mean(np.minimum(sine, 1.0) ** 2))) if len(standards) > 3 else 0.0
    return Leakage(complex(g_ha / g_h), complex(g_vb / g_v), complex(g_h / g_v), residual)


def estimate_axial_ratio(plate: Standard, strips: Standard) -> Leakage:
    """Estimate equal leakage of both boards (the authors' axial ratio) from the plate and strips in one orientation."""
    # Relative to the plate (H, V) ~ (s + a p, p + a s).
    h, v = (m / whole for m, whole in zip(strips.measured, plate.measured, strict=True))
    s, p = strips.wave
    size = float(np.hypot(abs(s), abs(p)) * np.hypot(abs(h), abs(v)))
    if abs(s - p) * np.hypot(abs(h), abs(v)) < 0.1 * size or abs(v * p - h * s) < 1e-9 * size:
        raise DataError(
            "leakage cannot be estimated from these strips",
            "they reflect s and p equally, like a plate",
            "rotate them to 0 or to 90 degrees",
            code=ErrorCode.VALUES_CONFLICT,
        )
    a = (h * p - v * s) / (v * p - h * s)
    return Leakage(a, a, plate.measured[0] / plate.measured[1], 0.0)


def leakage_from_images(
    plate: tuple[Image, Image], strips: Sequence[tuple[float, Image, Image]], mask: Mask, theta_rad: float
) -> Leakage:
    """Estimate leakage from images of a plate and of strips that cover the same plane.

    The strips are divided by the plate pixel by pixel, which removes uneven illumination.

    Parameters
    ----------
    plate
        H and V of the plate, complex [ny, nx] (smoothed: h and v of a `PlaneReference`).
    strips
        (psi in radians from the vertical, H, V) of each orientation; one gives the axial ratio only.
    mask
        bool [ny, nx]: pixels where both are metal, without edges.
    theta_rad
        Incidence angle.

    Returns
    -------
    Leakage
        The imbalance is that of the plate's mean.

    Raises
    ------
    DataError
        as :func:`estimate_leakage`.
    """
    gain_h, gain_v = plate
    relative = [
        Standard(common_direction(ratio(h, gain_h), ratio(v, gain_v), mask), strips_wave(psi, theta_rad))
        for psi, h, v in strips
    ]
    whole = Standard(PLATE, PLATE)
    found = estimate_axial_ratio(whole, relative[0]) if len(relative) == 1 else estimate_leakage([whole, *relative])
    mean = common_direction(gain_h, gain_v, mask)
    # Relative to the plate g is (1 + b) / (1 + a); the plate itself is g_h (1 + a) / (g_v (1 + b)).
    return Leakage(found.h, found.v, found.imbalance * mean[0] / mean[1], found.residual)
