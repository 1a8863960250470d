"""Plane waves at the pixels: reflection, permittivity from a ratio, layered media, and the incidence angle.

Time convention `exp(+j omega t)`: a passive medium has permittivity `eps' - j eps''` with `eps'' >= 0`, and waves in it
decay. Signs of Eq. 2 of the POLySIGHT paper: metal has r_s = r_p = -1, so that P = r_s / r_p = +1 at every angle.

The incidence angle of a pixel: a plane parallel to the stage reflects like a mirror. At every stage offset the
reflection comes from the specular point, under the same angle, so that all pixels have the incidence angle of the
specular midpoint.

The image of a pixel also contains stage offsets within about one Fresnel zone of the specular one, with slightly
different angles; near the border of the aperture only part of that zone was scanned. :func:`effective_incidence_map`
averages the bistatic angle over the scanned part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.results import IncidenceAngles
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode, PolysightError
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Complex = npt.NDArray[np.complex128]
Real = npt.NDArray[np.float64]
_AIR = np.asarray(1.0 + 0j)
_NAN = complex(np.nan, np.nan)
# Replaces an infinite permittivity in stacks: its reflection is -1 within 1e-12.
_CONDUCTOR = 1 - 1e24j

Incidence = Literal["one", "pixel"]
"""One angle for the image (specular), or one per pixel (:func:`effective_incidence_map`)."""


def _compute_normal_wavenumber(eps: Complex, sine: Real) -> Complex:
    """Return index times cosine in the medium, sqrt(eps - sin^2 theta_i), the root that decays (Im <= 0)."""
    q: Complex = np.sqrt(eps - sine**2)
    # NumPy's root has a positive real part, and so Im <= 0 for a lossy medium. Only in total reflection the real part
    # is 0; the sign of the imaginary part then comes from a rounding error or from the sign of a zero.
    return np.where((q.real == 0) & (q.imag > 0), -q, q)


def _broadcast_media(
    eps: npt.ArrayLike, theta_rad: npt.ArrayLike
) -> tuple[Complex, Real, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Broadcast permittivity and angle; return them with finite placeholders, and masks of metal (infinite) and NaN."""
    eps, theta = np.broadcast_arrays(np.asarray(eps, np.complex128), np.asarray(theta_rad, np.float64))
    # `isnan` of a complex number is true if either part is.
    unknown = np.isnan(eps) | ~np.isfinite(theta)
    metal = np.isinf(eps) & ~unknown
    return np.where(metal | unknown, 1.0, eps), np.where(unknown, 0.5, theta), metal, unknown


def fresnel(eps: npt.ArrayLike, theta_rad: npt.ArrayLike) -> tuple[Complex, Complex]:
    """Return the reflection coefficients of a half space in air (Eq. 2 of the paper).

    Parameters
    ----------
    eps
        Relative permittivity `eps' - j eps''`, any shape; infinite means a perfect conductor.
    theta_rad
        Incidence angle in radians, broadcast against `eps`.

    Returns
    -------
    r_s, r_p
        complex128, broadcast shape: s (perpendicular to the plane of incidence) and p (parallel to it). NaN where
        `eps` or the angle is NaN.
    """
    eps, theta, metal, unknown = _broadcast_media(eps, theta_rad)
    c = np.cos(theta)
    s = np.sin(theta)
    q = _compute_normal_wavenumber(eps, s)
    r_s = np.where(metal, -1.0, (c - q) / (c + q))
    # cos(theta_t) = q / n, so that n_i cos(theta_t) -+ n_t cos(theta_i) is (q -+ eps c) / n: the n cancels.
    r_p = np.where(metal, -1.0, (q - eps * c) / (q + eps * c))
    return np.where(unknown, _NAN, r_s)[()], np.where(unknown, _NAN, r_p)[()]


def ratio_from_permittivity(eps: npt.ArrayLike, theta_rad: npt.ArrayLike) -> Complex:
    """Return the polarisation ratio P = r_s / r_p of a half space (Eq. 2 of the paper), complex128.

    Evaluated as (q cos + sin^2) / (q cos - sin^2) with q = sqrt(eps - sin^2), which has no 0/0 at eps = 1. Infinite
    permittivity gives 1 (metal), the Brewster angle of a lossless medium infinity. Parameters as :func:`fresnel`.
    """
    eps, theta, metal, unknown = _broadcast_media(eps, theta_rad)
    s = np.sin(theta)
    a = _compute_normal_wavenumber(eps, s) * np.cos(theta)
    pole = a == s**2
    ratio = (a + s**2) / np.where(pole, 1.0, a - s**2)
    ratio = np.where(metal, 1.0, np.where(pole, complex(np.inf, 0.0), ratio))
    return np.where(unknown, _NAN, ratio)[()]


def permittivity_from_ratio(p: npt.ArrayLike, theta_rad: npt.ArrayLike) -> Complex:
    """Return the permittivity of a half space from its polarisation ratio (Eq. 3 of the paper).

    Eq. 3 is evaluated as sin^2 (1 + tan^2 ((1 + P) / (1 - P))^2), the same expression without cancellation. P and 1/P
    give the same result.

    P = 1 (a perfect conductor, at any angle) returns `inf + 0j`. Near it the permittivity grows as
    4 sin^2 tan^2 / |P - 1|^2, and errors of P with it: a metal-like material has no determinable permittivity.

    Parameters
    ----------
    p
        Complex ratio H / V, metal-referenced, any shape; infinite at the Brewster angle.
    theta_rad
        Incidence angle in radians, broadcast against `p`.

    Returns
    -------
    eps
        complex128; NaN where `p` is NaN.
    """
    p, theta = np.broadcast_arrays(np.asarray(p, np.complex128), np.asarray(theta_rad, np.float64))
    # P or 1/P is used, whichever has a magnitude <= 1: no overflow near the Brewster angle.
    is_large = np.abs(p) > 1
    with np.errstate(invalid="ignore"):
        inverse = 1.0 / np.where(is_large, p, 1.0)
        small = np.where(is_large, inverse, p)
        # The inverse of a complex infinity is NaN.
        small = np.where(np.isinf(p), 0.0, small)
        pole = small == 1
        u = (1 + small) / np.where(pole, 1.0, 1 - small)
        eps = np.sin(theta) ** 2 * (1 + np.tan(theta) ** 2 * u**2)
    return np.where(pole, complex(np.inf, 0.0), eps)[()]


def brewster_angle_rad(eps: npt.ArrayLike) -> Real:
    """Return the angle of smallest |r_p| of half spaces, radians: arctan(sqrt|eps|), any shape, exact if lossless.

    The paper calls it the angle of lowest *s* reflectance; it is the p-polarised wave that vanishes there.
    """
    return np.arctan(np.sqrt(np.abs(np.asarray(eps, np.complex128))))[()]


def _list_entries(value: Sequence[npt.ArrayLike] | npt.ArrayLike) -> list[Any]:
    """Return the entries of a list, tuple or array; a number becomes a list of one."""
    if isinstance(value, list | tuple):
        return list(value)
    array = np.asarray(value)
    return [array] if array.ndim == 0 else list(array)


def _stack(
    eps: Sequence[npt.ArrayLike] | npt.ArrayLike, thickness_m: Sequence[npt.ArrayLike] | npt.ArrayLike
) -> tuple[list[Complex], list[Real]]:
    """Return the permittivities of air and all media, and the thicknesses of the layers between, metres.

    Raises PolysightError as :func:`multilayer`.
    """
    media: list[Complex] = [np.asarray(e, np.complex128) for e in _list_entries(eps)]
    media = [np.where(np.isinf(e), _CONDUCTOR, e) for e in media]
    layers = [np.asarray(d, np.float64) for d in _list_entries(thickness_m)]
    if not media or len(layers) not in (len(media) - 1, len(media)):
        raise PolysightError(
            f"multilayer: {len(media)} permittivities with {len(layers)} thicknesses",
            "each medium needs a thickness; only that of the last one may be left out (half space)",
            "to sweep the thickness of one medium, put the array into a list: thickness_m=[thicknesses]",
            code=ErrorCode.MISMATCH,
        )
    if len(layers) == len(media):
        if np.all(np.isinf(layers[-1])):
            layers.pop()
        else:
            media.append(_AIR)
    if any(np.any(~np.isfinite(d)) or np.any(d < 0) for d in layers):
        raise PolysightError(
            "multilayer: a thickness is negative or not finite",
            "only the last medium may be infinitely thick",
            code=ErrorCode.VALUE_INVALID,
        )
    return [_AIR, *media], layers


def multilayer(
    eps: Sequence[npt.ArrayLike] | npt.ArrayLike,
    thickness_m: Sequence[npt.ArrayLike] | npt.ArrayLike,
    frequency_hz: npt.ArrayLike,
    theta_rad: npt.ArrayLike,
) -> tuple[Complex, Complex]:
    """Return the reflection coefficients of a stack of flat layers in air.

    Transfer-matrix solution in recursive form (Rouard; Born & Wolf, section 1.6), from the last interface to the first:
    r = (r_front + r_behind z) / (1 + r_front r_behind z) with z = exp(-2 j k0 d q). All exponentials decay, so thick
    lossy layers do not overflow.

    Parameters
    ----------
    eps
        Relative permittivity of each medium from the front; each entry a number or an array that broadcasts against
        frequency and angle. A single number is one medium. Infinite: a perfect conductor.
    thickness_m
        Thickness of each medium, metres. The last medium is a half space if its thickness is infinite or left out;
        otherwise air follows. `multilayer(eps, inf, f, theta)` is :func:`fresnel`, `multilayer(eps, d, f, theta)` a
        sheet in air.
    frequency_hz
        Frequency, number or array.
    theta_rad
        Incidence angle in air, radians, number or array.

    Returns
    -------
    r_s, r_p
        complex128, broadcast shape, phase referred to the front surface, signs of Eq. 2.

    Raises PolysightError if the numbers of permittivities and thicknesses do not fit, or a thickness is negative, or
    infinite before the last medium.
    """
    media, layers = _stack(eps, thickness_m)
    theta = np.asarray(theta_rad, np.float64)
    s = np.sin(theta)
    k0 = 2 * np.pi * np.asarray(frequency_hz, np.float64) / SPEED_OF_LIGHT_M_S
    # In each medium, q is the normal wavenumber over k0: the admittance of an s-polarised wave. y = q / eps is the
    # impedance of a p-polarised wave. An interface reflects (q1 - q2) / (q1 + q2) of s and, with the sign of Eq. 2,
    # (y2 - y1) / (y2 + y1) of p.
    q = [np.cos(theta).astype(np.complex128), *(_compute_normal_wavenumber(e, s) for e in media[1:])]
    y = [qi / ei for qi, ei in zip(q, media, strict=True)]
    r_s: Complex = (q[-2] - q[-1]) / (q[-2] + q[-1])
    r_p: Complex = (y[-1] - y[-2]) / (y[-1] + y[-2])
    for i in range(len(layers) - 1, -1, -1):
        z = np.exp(-2j * k0 * layers[i] * q[i + 1])
        front_s = (q[i] - q[i + 1]) / (q[i] + q[i + 1])
        front_p = (y[i + 1] - y[i]) / (y[i + 1] + y[i])
        r_s = (front_s + r_s * z) / (1 + front_s * r_s * z)
        r_p = (front_p + r_p * z) / (1 + front_p * r_p * z)
    # Without a layer the frequency has no effect, but it still gives its shape to the result.
    shape = np.broadcast_shapes(r_s.shape, k0.shape)
    return np.broadcast_to(r_s, shape)[()], np.broadcast_to(r_p, shape)[()]


def _compute_half_bistatic(rig: Instrument, board_index: int, points_m: Real) -> tuple[Real, Real]:
    """Return half the angle TX-point-RX1 (radians) and the path TX-point-RX1 (metres) for points [..., 3]."""
    a = np.asarray(tx_position_m(rig)) - points_m
    b = np.asarray(rx_positions_m(rig, rig.receivers[board_index])[0]) - points_m
    na = np.linalg.norm(a, axis=-1)
    nb = np.linalg.norm(b, axis=-1)
    cosine = np.sum(a * b, axis=-1) / (na * nb)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) / 2, na + nb


def specular_incidence_rad(rig: Instrument) -> float:
    """Return the incidence angle at the specular midpoint, radians: the mean of H and V.

    They differ by 0.02 degrees in the default rig (for RX1; for the middle of all RX by 0.1).
    """
    angles = []
    for i, board in enumerate(rig.receivers):
        angle, _ = _compute_half_bistatic(rig, i, np.asarray(specular_midpoint_m(rig, board)))
        angles.append(float(angle))
    return float(np.mean(angles))


def effective_incidence_map(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Real:
    """Return the incidence angle of each pixel, averaged over the scanned stage offsets; radians, float64 [ny, nx].

    The weight of the offset u for a pixel is exp(-(k D)^2 / 8), with k D the phase of the path at u minus that of the
    specular path: a Gaussian with the standard deviation 2 rad (chosen). It is 1 at the specular offset, and about 0.3
    at the edge of the first Fresnel zone (k D = pi). H and V are averaged. Pixels with less than a thousandth of the
    full weight get the specular angle.

    Parameters
    ----------
    rig
        Geometry and grid.
    x_m, y_m
        Pixel centres, rig frame, metres; [nx] and [ny].
    """
    x = np.asarray(x_m, np.float64)
    y = np.asarray(y_m, np.float64)
    step = np.array([rig.grid.step_x_mm, rig.grid.step_y_mm]) / 1e3
    count = np.array([rig.grid.columns, rig.grid.rows])
    wavelength = SPEED_OF_LIGHT_M_S / (rig.chirp.first_sample_hz + rig.chirp.swept_hz / 2)
    # The weights of a pixel's scanned offsets are summed by a convolution of the grid of offsets with the weight around
    # a point, up to twice the first Fresnel zone. That is longest along x, the plane of incidence: over both legs, of
    # the length z / cos, a shift by u changes the path by u^2 cos^3 / z, which is half a wavelength at
    # u = sqrt(lambda z / (2 cos^3)).
    distance_m = rig.geometry.object_distance_mm / 1e3
    zone = np.sqrt(wavelength * distance_m / 2 / np.cos(specular_incidence_rad(rig)) ** 3)
    reach = np.ceil(2 * zone / step).astype(int)
    dx, dy = (np.arange(-n, n + 1) * s for n, s in zip(reach, step, strict=True))
    visited = np.ones((count[1], count[0]))
    total = np.zeros((y.size, x.size))
    for i, board in enumerate(rig.receivers):
        middle = np.asarray(specular_midpoint_m(rig, board))
        points = np.empty((dy.size, dx.size, 3))
        points[..., 0] = middle[0] + dx[None, :]
        points[..., 1] = middle[1] + dy[:, None]
        points[..., 2] = middle[2]
        angle, path = _compute_half_bistatic(rig, i, points)
        specular, shortest = _compute_half_bistatic(rig, i, middle)
        weight = np.exp(-((2 * np.pi / wavelength * (path - shortest)) ** 2) / 8)
        deviation_sum = _convolve(visited, weight * (angle - specular))
        weight_sum = _convolve(visited, weight)
        # In a full convolution, an index is the sum of the indices in both arrays. A pixel is at a stage offset plus a
        # displacement from the midpoint: the offset 0 has the index (count - 1) / 2 in the grid, the displacement 0 has
        # the index `reach` among the weights.
        column = (x - middle[0]) / step[0] + (count[0] - 1) / 2 + reach[0]
        row = (y - middle[1]) / step[1] + (count[1] - 1) / 2 + reach[1]
        grid = np.meshgrid(row, column, indexing="ij")
        pixel_deviation = scipy.ndimage.map_coordinates(deviation_sum, grid, order=1, mode="constant")
        pixel_weight = scipy.ndimage.map_coordinates(weight_sum, grid, order=1, mode="constant")
        is_lit = pixel_weight > 1e-3 * float(weight.sum())
        total += float(specular) + np.where(is_lit, pixel_deviation / np.where(is_lit, pixel_weight, 1.0), 0.0)
    return total / len(rig.receivers)


def _convolve(a: Real, b: Real) -> Real:
    """Return the full linear convolution of two images; scipy.signal would load scipy.stats, which takes a second."""
    shape = [m + n - 1 for m, n in zip(a.shape, b.shape, strict=True)]
    fast = [scipy.fft.next_fast_len(n, real=True) for n in shape]
    product = scipy.fft.rfft2(a, fast) * scipy.fft.rfft2(b, fast)
    return np.asarray(scipy.fft.irfft2(product, fast), np.float64)[: shape[0], : shape[1]]


@dataclass(frozen=True)
class IncidenceChoice:
    """Both kinds of incidence angle of every pixel, float64 [ny, nx] radians, and the one to use.

    `choice`: "one" uses `one_rad`, the specular angle, equal in all pixels; "pixel" uses `pixel_rad`, the effective
    one.
    """

    choice: Incidence
    one_rad: Real
    pixel_rad: Real

    @property
    def used_rad(self) -> Real:
        """The chosen angles, radians [ny, nx]."""
        return self.one_rad if self.choice == "one" else self.pixel_rad

    @property
    def other_rad(self) -> Real:
        """The angles of the other kind, radians [ny, nx]."""
        return self.pixel_rad if self.choice == "one" else self.one_rad

    def facts(self, valid: npt.NDArray[np.bool_]) -> IncidenceAngles:
        """Return both angles and their largest difference over `valid`, bool [ny, nx], for quality.json; degrees.

        `pixel_deg` is least, median and largest. Without a valid pixel all pixels count.
        """
        if valid.any():
            pixel = np.degrees(self.pixel_rad[valid])
        else:
            pixel = np.degrees(self.pixel_rad).ravel()
        single_angle = float(np.degrees(np.median(self.one_rad)))
        return IncidenceAngles(
            used="one number for the image" if self.choice == "one" else "by pixel",
            one_deg=round(single_angle, 4),
            pixel_deg=tuple(round(float(q), 4) for q in (pixel.min(), np.median(pixel), pixel.max())),
            largest_difference_deg=round(float(np.abs(pixel - single_angle).max()), 4),
        )


def incidence_choice(
    rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike, choice: Incidence, raised_m: Real | None = None
) -> IncidenceChoice:
    """Compute both kinds of incidence angles; `choice` is the one to use.

    `raised_m` as of :func:`incidence_on_planes`.
    """
    pixel_rad = effective_incidence_map(rig, x_m, y_m)
    one_rad = np.full(pixel_rad.shape, specular_incidence_rad(rig))
    angles_on_planes = (incidence_on_planes(angle_rad, raised_m, rig) for angle_rad in (one_rad, pixel_rad))
    return IncidenceChoice(choice, *angles_on_planes)


def incidence_on_planes(angle_rad: Real, raised_m: Real | None, rig: Instrument) -> Real:
    """Return the angles [ny, nx] on planes that lie `raised_m` [ny, nx] behind the rig's object plane; None: on it.

    Positive values are farther from the antennas. With the distance z of the plane, the antennas see a place at the
    lateral distance z tan(angle). The lateral distance on a plane behind is the same: angle' = arctan(z tan(angle) /
    (z + raised)). z is the rig's `object_distance_mm`, nearly the distance of each antenna.
    """
    if raised_m is None:
        return angle_rad
    distance_m = rig.geometry.object_distance_mm / 1e3
    return np.asarray(np.arctan(distance_m / (distance_m + raised_m) * np.tan(angle_rad)), np.float64)
