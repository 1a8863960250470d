"""Cross-polar leakage and the gains' imbalance from metal at two orientations.

A whole metal plate returns s and p alike, however it is turned in its plane: it fixes g_h (1 + a) / (g_v (1 + b)) and
nothing else. Metal in strips much closer than a wave returns only the field along them, so that its orientation
matters. Strips turned by psi from the vertical (s), flat on the plane at incidence theta, project the wave on
w = (cos psi, sin psi cos theta): a current along them cancels the field along them and radiates both polarisations. TX
sends s and p alike, so what returns is proportional to w itself. Vertical strips return s alone: V then sees leakage
and nothing else. Horizontal ones return p alone, and H sees its leakage.

Free thin wires come close to it. Across wires of a tenth of their pitch d the field is returned with about
0.025 d / wavelength (Marcuvitz, Waveguide Handbook, section 5.18: 0.003 at 0.5 mm); that along them is returned weaker
than by a plate, which is a common factor and does no harm. A board's substrate would return both by itself.

With each standard's wave e known up to a factor (its distance and size), and the measured pair m = (H, V),

    m ~ [[g_h, g_h a], [g_v b, g_v]] e

is a homography of the projective line: three different waves fix it up to one factor, linearly and without a start
value. The plate and strips at two orientations are three waves. More make it least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.host.polarimetry.calibrate import Image, Mask, ratio
from polysight.shared.errors import DataError, PolysightError

PLATE = (1.0, 1.0)
"""What a whole metal plate returns of s and p."""
LEAST_CONDITION = 0.02
"""Smallest third singular value beside the first: below it the waves are too alike to tell three unknowns apart."""
Wave = tuple[complex, complex]


@dataclass(frozen=True)
class Standard:
    """One piece of metal as it was measured.

    Attributes
    ----------
    measured
        H and V, up to a common factor (:func:`common_direction`).
    wave
        s and p that it returns, up to a factor: :data:`PLATE` or :func:`strips_wave`.
    """

    measured: Wave
    wave: Wave


@dataclass(frozen=True)
class Leakage:
    """What was found: H = g_h (r_s + h r_p), V = g_v (r_p + v r_s).

    Attributes
    ----------
    h, v
        Leakage of p into H and of s into V: `leakage_h` and `leakage_v` of the rig file.
    imbalance
        g_h / g_v, complex.
    residual
        Root mean square misfit of the standards, as an angle in radians; zero where there are as many as unknowns.
    """

    h: complex
    v: complex
    imbalance: complex
    residual: float

    def matrix(self) -> npt.NDArray[np.complex128]:
        """(s, p) to (H, V), 2 x 2, with g_v = 1."""
        g = self.imbalance
        return np.array([[g, g * self.h], [self.v, 1.0]], np.complex128)

    def remaining(self, truth: Leakage) -> tuple[float, float]:
        """Crosstalk and imbalance that are left when a rig that is `truth` is corrected by this.

        Returns
        -------
        crosstalk : larger of the two cross-polar amplitudes
        imbalance : how far the ratio of the co-polar amplitudes is from 1
        """
        left = np.linalg.solve(self.matrix(), truth.matrix())
        return (
            float(max(abs(left[0, 1] / left[0, 0]), abs(left[1, 0] / left[1, 1]))),
            float(abs(left[0, 0] / left[1, 1] - 1)),
        )


def strips_wave(psi_rad: float, theta_rad: float) -> Wave:
    """The s and p returned by ideal metal strips turned by psi from the vertical; TX sends both alike.

    Signs of Eq. 2: -w (w_s + w_p) / |w|^2 with w = (cos psi, sin psi cos theta), so that strips along the field return
    it as a whole plate does.

    Raises
    ------
    PolysightError
        where the strips return nothing because TX's field is across them (w_s = -w_p).
    """
    w = np.array([np.cos(psi_rad), np.sin(psi_rad) * np.cos(theta_rad)])
    total = float(w.sum())
    if abs(total) < 0.1:
        raise PolysightError(
            f"strips at {np.degrees(psi_rad):.0f} degrees return almost nothing",
            "the transmitter's field is across them",
            "turn them to 0 and 90 degrees",
        )
    s, p = -w * total / float(w @ w)
    return complex(s), complex(p)


def common_direction(h: Image, v: Image, mask: Mask | None = None) -> Wave:
    """The pair (H, V) that pixels have in common, up to a factor: the first eigenvector of their 2 x 2 covariance.

    A phase or amplitude common to both channels may differ from pixel to pixel.

    Raises
    ------
    DataError
        when there is no signal.
    """
    at = np.isfinite(h) & np.isfinite(v) & (True if mask is None else mask)
    m = np.stack([h[at], v[at]]).astype(np.complex128)
    if m.size == 0 or not np.any(m):
        raise DataError("a metal standard holds no signal", "its region lies outside the image", "correct the region")
    values, vectors = np.linalg.eigh(m @ m.conj().T)
    pair = vectors[:, int(np.argmax(values))]
    return complex(pair[0]), complex(pair[1])


def estimate_leakage(standards: Sequence[Standard]) -> Leakage:
    """Leakage of both boards and the gains' imbalance from three metal standards or more.

    Raises
    ------
    DataError
        when there are fewer than three, or their waves are too alike.
    """
    if len(standards) < 3:
        raise DataError(
            f"{len(standards)} metal standards for three unknowns",
            "leakage of H, leakage of V and their imbalance need three different waves",
            "scan the plate, and strips at two orientations; or use the one-parameter axial ratio",
        )
    m = np.array([s.measured for s in standards], np.complex128)
    scale = np.sqrt(np.mean(np.abs(m / np.linalg.norm(m, axis=1, keepdims=True)) ** 2, axis=0))
    m = m / scale
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    e = np.array([s.wave for s in standards], np.complex128)
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    # m x (M e) = 0: one equation a standard for the entries g_h, g_h a, g_v b, g_v of M.
    rows = np.stack([m[:, 1] * e[:, 0], m[:, 1] * e[:, 1], -m[:, 0] * e[:, 0], -m[:, 0] * e[:, 1]], axis=1)
    _, sizes, vh = np.linalg.svd(rows)
    if sizes[2] < LEAST_CONDITION * sizes[0]:
        raise DataError(
            "the metal standards cannot tell leakage from gain",
            "their waves are too alike: a plate is the same at every orientation, strips must be turned",
            "scan the plate, and strips at 0 and at 90 degrees",
        )
    g_h, g_ha, g_vb, g_v = vh[3].conj() * np.array([scale[0], scale[0], scale[1], scale[1]])
    fitted = (np.array([[g_h, g_ha], [g_vb, g_v]]) / scale[:, None] @ e.T).T
    sine = np.abs(m[:, 1] * fitted[:, 0] - m[:, 0] * fitted[:, 1]) / np.linalg.norm(fitted, axis=1)
    residual = float(np.sqrt(np.mean(np.minimum(sine, 1.0) ** 2))) if len(standards) > 3 else 0.0
    return Leakage(complex(g_ha / g_h), complex(g_vb / g_v), complex(g_h / g_v), residual)


def estimate_axial_ratio(plate: Standard, strips: Standard) -> Leakage:
    """The one-parameter case of the paper's authors, leakage alike in both boards: the plate and one orientation."""
    # Relative to the plate (H, V) ~ (s + a p, p + a s): `axial_ratio_from_known` without a ratio, s or p may be zero.
    h, v = (m / whole for m, whole in zip(strips.measured, plate.measured, strict=True))
    s, p = strips.wave
    size = float(np.hypot(abs(s), abs(p)) * np.hypot(abs(h), abs(v)))
    if abs(s - p) * np.hypot(abs(h), abs(v)) < 0.1 * size or abs(v * p - h * s) < 1e-9 * size:
        raise DataError(
            "these strips cannot reveal leakage",
            "they return s and p alike, as a plate does",
            "turn them to 0 or to 90 degrees",
        )
    a = (h * p - v * s) / (v * p - h * s)
    return Leakage(a, a, plate.measured[0] / plate.measured[1], 0.0)


def leakage_from_images(
    plate: tuple[Image, Image], strips: Sequence[tuple[float, Image, Image]], mask: Mask, theta_rad: float
) -> Leakage:
    """Leakage from images of a plate and of strips, all over the same plane: three scans of the whole plane.

    The strips are divided by the plate pixel by pixel first, so illumination that differs over the plane does no harm.

    Parameters
    ----------
    plate
        H and V of the whole plate, complex [ny, nx] (smoothed: h and v of
        :class:`polysight.host.polarimetry.PlaneReference`).
    strips
        (psi in radians from the vertical, H, V) of each orientation; one is enough for the axial ratio alone.
    mask
        bool [ny, nx]: where both are metal, without edges.
    theta_rad
        Incidence angle.

    Returns
    -------
    Leakage
        imbalance is that of the plate's mean.

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
