"""Metal reference, cross-polar leakage and smoothing of the H and V images (section 6.2 of the POLySIGHT paper).

Model of one pixel, for a transmitter that excites s and p equally:

    H = g_h (r_s + a r_p)        V = g_v (r_p + b r_s)

r_s and r_p are the reflection coefficients of the material, g_h and g_v complex gains, a and b the cross-polar leakages
of the H and V receivers. A metal region (r_s = r_p) determines only g_h (1 + a) and g_v (1 + b): **metal at one
orientation cannot separate leakage from gain**. Leakage is therefore given, or estimated from a second known material.

A metal patch in the scene gives one number per channel (`calibrate`). A plate over the plane, scanned separately, gives
one per pixel (`PlaneReference`), which also removes differences between H and V that vary over the plane (antenna
patterns, illumination). Samples are relative to the direct path, so that this reference remains valid after a power
cycle; geometry and boards must be the same, see :meth:`PlaneReference.check_rig`.

Leakage is estimated from metal at two orientations (`estimate_leakage_from_images`). Metal strips with a pitch well
below a wavelength reflect only the field along them. Strips rotated by psi from the vertical (s), flat on the plane at
incidence theta, project the wave on w = (cos psi, sin psi cos theta): the current along them cancels the field along
them and radiates both polarisations. TX sends s and p equally, so the reflected wave is proportional to w. Vertical
strips reflect s alone, so V receives only leakage; horizontal strips reflect p alone, so H receives only leakage.

Thin free wires are a good approximation. Wires with a diameter of a tenth of their pitch d reflect about 0.025 d /
wavelength of the field across them (Marcuvitz, Waveguide Handbook, section 5.18: 0.003 at 0.5 mm). They reflect the
field along them less than a plate does, by a common factor without influence. A printed board is unsuitable, because
its substrate reflects both polarisations.

A *standard* is the plate, or strips at one orientation. Of each standard the reflected wave e = (s, p) is known and the
pair m = (H, V) is measured, both but for a factor (distance and size):

    m ~ M e,     M = [[g_h, g_h a], [g_v b, g_v]]

m has the direction of M e, which is one linear equation for the entries of M. Three standards with different waves
determine M but for a factor. More give a least-squares solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import UNSET

from polysight.imaging import Dispersion, Image, ImagedWith, Images, Mask, Rise
from polysight.results import MetalPlate
from polysight_shared.errors import DataError, ErrorCode, PolysightError


def ratio(h: Image, v: Image) -> Image:
    """Return the polarisation ratio h / v, complex, broadcast; NaN where h, v or the ratio is not finite."""
    is_usable = (v != 0) & np.isfinite(v) & np.isfinite(h)
    quotient = np.full(np.broadcast_shapes(h.shape, v.shape), complex(np.nan, np.nan), np.result_type(h, v))
    # Outside the footprint v may be so small that the ratio overflows: it then becomes NaN.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        np.divide(h, v, out=quotient, where=is_usable)
    quotient[~np.isfinite(quotient)] = complex(np.nan, np.nan)
    return quotient


def inverse_spread(h: Image, v: Image) -> float:
    """Return the standard deviation of V / H over pixels: that of the real and imaginary parts together (1.48 MAD)."""
    is_usable = np.isfinite(h) & np.isfinite(v) & (h != 0)
    if not is_usable.any():
        return float("nan")
    inverse = v[is_usable].astype(np.complex128) / h[is_usable]
    parts = np.concatenate([inverse.real - np.median(inverse.real), inverse.imag - np.median(inverse.imag)])
    return float(1.4826 * np.median(np.abs(parts)))


def with_ratio(images: Images) -> Images:
    """Return the images with p = h / v, the polarisation ratio."""
    return replace(images, p=ratio(images.h, images.v))


def measure_metal_gains(h: Image, v: Image, metal_mask: Mask) -> tuple[complex, complex]:
    """Return the gains of H and V over a metal region (Eq. 8 and 9 of the paper).

    Amplitudes are RMS values over the region, and the phase of the ratio is that of sum(h conj(v)). So a common phase
    of H and V (distance, tilt) has no influence, and weak pixels do not dominate, as they would in the mean of the
    pixels' ratios. The gain of V is real: only the phase of the ratio is removed, because the phase of each channel
    alone is that of the distance (Eq. 7).

    `metal_mask` bool [ny, nx] is the inside of a metal region. Raises DataError if it is empty, not finite or dark, or
    has another shape than the images.
    """
    if metal_mask.shape != h.shape or h.shape != v.shape:
        raise DataError(
            f"metal region {metal_mask.shape} and images {h.shape}, {v.shape} differ in shape",
            "they are not of one scan", "give arrays of one scan", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    mh = h[metal_mask].astype(np.complex128)
    mv = v[metal_mask].astype(np.complex128)
    is_finite = np.isfinite(mh) & np.isfinite(mv)
    mh = mh[is_finite]
    mv = mv[is_finite]
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
    """Divide both channels by their gains over a metal region, see :func:`measure_metal_gains`; adds the ratio p."""
    return divide_by_metal(images, *measure_metal_gains(images.h, images.v, metal_mask))


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

    Raises PolysightError if |leakage| is not below 1.
    """
    a = leak_hv
    b = leak_vh
    if not (abs(a) < 1 and abs(b) < 1):
        raise PolysightError(
            f"leakage {a}, {b}: amplitudes must be below 1",
            "leakage is a ratio, not decibels",
            code=ErrorCode.VALUE_INVALID,
        )
    kind = np.result_type(h, np.complex64)
    s = h * kind.type(1 + a)
    p = v * kind.type(1 + b)
    scale = kind.type(1 / (1 - a * b))
    return (s - kind.type(a) * p) * scale, (p - kind.type(b) * s) * scale


def smooth(image: npt.NDArray[Any], sigma_px: float) -> npt.NDArray[Any]:
    """Filter a complex or real image [ny, nx] with a 2-D Gaussian against speckle (section 9.1 of the paper).

    Pixels that are not finite are not changed and do not affect others: the filter is normalised by the weight of the
    finite pixels. `sigma_px` is the standard deviation in pixels; zero or less returns the image itself. Smooth H and V
    only after the phase of the distance was removed by the division by the footprint, the image of a mirror.
    """
    if sigma_px <= 0:
        return image
    is_finite = np.isfinite(image)
    filled = np.where(is_finite, image, 0)
    smoothed = np.asarray(scipy.ndimage.gaussian_filter(filled, sigma_px, mode="nearest"))
    if not is_finite.all():
        weight = scipy.ndimage.gaussian_filter(is_finite.astype(np.float64), sigma_px, mode="nearest")
        smoothed = np.where(is_finite, smoothed / np.where(is_finite, weight, 1.0), image)
    return smoothed.astype(image.dtype)


# Default width (standard deviation) of the Gaussian window of `plane_reference`; chosen.
SMOOTH_MM = 8.0
# Lowest level of metal in each channel, relative to the 90th percentile of the plate; chosen.
FLOOR_DB = -10.0
# A smaller area of metal is not a plate that covers the plane; chosen.
MIN_PIXELS = 100
# Pixels with a lower V / H, relative to the brightest ones, are not metal. Dielectrics of up to eps = 9 have -7.4 dB or
# less. On metal plates gains differ by up to 5 dB (simulated).
OTHER_MATERIAL_DB = -7.0
# Largest share of such pixels, of those that are bright in H, in a scan of metal alone. Scenes of copper and other
# plates have 8 to 40 % (simulated).
OTHER_MATERIAL_SHARE = 0.03


@dataclass(frozen=True)
class PlaneReference:
    """Metal reference of both channels at every pixel: the gains that images are divided by.

    Attributes
    ----------
    h, v
        complex [ny, nx]: amplitudes of metal, with the phase of H / V in h, and v real; NaN where not valid.
    valid
        bool [ny, nx]: pixels where metal is strong enough in both channels.
    x_m, y_m
        Pixel centres, rig frame, metres.
    spread
        Standard deviation of the real and the imaginary part of V / H over the plate: noise and speckle.
    how
        One sentence for the report.
    bands
        References of the imaged sub-bands.
    made_with
        Settings that the gains depend on; None if unknown.
    dispersion
        Median change of ln h and ln v of the plate over the sweep; None if unknown.
    rise
        Rise of the plate along the plane of incidence and across it, radians, as it was scanned; 0 if unknown.
    """

    h: Image
    v: Image
    valid: Mask
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]
    spread: float
    how: str
    bands: tuple[PlaneReference, ...] = ()
    made_with: ImagedWith | None = None
    dispersion: tuple[complex, complex] | None = None
    rise: Rise = (0.0, 0.0)

    def add_dispersion(self, dispersion: Dispersion) -> PlaneReference:
        """Return the reference with the plate's change over the sweep, from the same scan, if it is known."""
        is_known = self.valid & np.isfinite(dispersion.h) & np.isfinite(dispersion.v)
        if not is_known.any():
            return self
        h = complex(np.median(dispersion.h[is_known].real), np.median(dispersion.h[is_known].imag))
        v = complex(np.median(dispersion.v[is_known].real), np.median(dispersion.v[is_known].imag))
        return replace(self, dispersion=(h, v))

    def apply(self, images: Images) -> Images:
        """Divide both channels of another scan by the reference; NaN where it is not valid."""
        return divide_by_metal(images, self.h, self.v)

    def check_axes(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> None:
        """Raise DataError if a scan has other pixels."""
        is_same = all(
            np.shape(own_axis) == np.shape(other_axis) and np.allclose(own_axis, other_axis, rtol=0, atol=1e-5)
            for own_axis, other_axis in ((self.x_m, x_m), (self.y_m, y_m))
        )
        if not is_same:
            raise DataError(
                "the images of the metal reference and of this scan have different pixels",
                "the reference was scanned with another [image], another geometry or another chirp",
                "scan the metal plate with the same rig file; only [grid] may differ",
                code=ErrorCode.MISMATCH,
            )

    def valid_on(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return `valid`, bool [ny, nx], for a scan with pixels at `x_m`, `y_m`. Raises DataError if they differ."""
        self.check_axes(x_m, y_m)
        return self.valid

    def check_rig(self, now: ImagedWith, name: str = "the metal reference") -> None:
        """Raise DataError if the gains do not apply to images made with `now`; `name` is for the message."""
        if self.made_with is None:
            raise DataError(
                f"{name} does not contain the rig that it was scanned with",
                "an older release wrote it, so later changes of the rig cannot be detected",
                "make it again from the same scan: `polysight calibrate metal SCAN`; one scan can be processed with"
                " --reference SCAN instead",
                code=ErrorCode.KEY_MISSING,
            )
        if differences := self.made_with.differences(now):
            raise DataError(
                f"{name} is of another rig: {'; '.join(differences)}",
                "the rig or its file was changed after the scan of the metal plate, which changes the gains",
                "empty calibration.metal, scan the metal plate again with the present rig, and calibrate with it; or"
                " restore the rig file",
                code=ErrorCode.MISMATCH,
            )

    def check_bands(self, count: int, name: str = "the metal reference") -> None:
        """Raise DataError if the reference does not have `count` sub-bands; one band is always there."""
        if count > 1 and len(self.bands) != count:
            band_text = f"{len(self.bands)} sub-bands" if self.bands else "no sub-bands"
            if self.bands:
                instead = f"--bands {len(self.bands)} uses those it has"
            else:
                instead = "leave --bands out"
            raise DataError(
                f"{name} holds {band_text}, not {count}",
                "each sub-band needs a metal reference in the same part of the sweep",
                f"`polysight calibrate metal SCAN --bands {count}` adds them; or {instead}; or --reference SCAN",
                code=ErrorCode.MISMATCH,
            )

    def facts(self) -> MetalPlate:
        """Return the variation of the gains over the plane, for quality.json."""
        pixels = self.valid
        h = self.h[pixels]
        v = self.v[pixels]
        phase_from_mean = np.angle(h / v * np.conj(np.mean(h / v)))
        return MetalPlate(
            how=self.how,
            share_of_plane=round(float(pixels.mean()), 4),
            h_variation_db=_measure_variation_db(h),
            v_variation_db=_measure_variation_db(v),
            ratio_variation_db=_measure_variation_db(h / v),
            ratio_variation_deg=round(float(np.degrees(np.std(phase_from_mean))), 4),
            spread=round(self.spread, 5),
            tilt_deg=(round(float(np.degrees(self.rise[0])), 3), round(float(np.degrees(self.rise[1])), 3)),
            sub_bands=len(self.bands) or UNSET,
        )


def _measure_variation_db(gain: Image) -> float:
    """Return the standard deviation of the level of a gain over its pixels, dB."""
    return round(float(np.std(20 * np.log10(np.abs(gain)))), 4)


def plane_reference(images: Images, smooth_mm: float = SMOOTH_MM, name: str = "") -> PlaneReference:
    """Make a reference from the images of a metal plate over the plane.

    Powers and H conj(V) are averaged over a Gaussian window, so that a common phase of both channels (distance and tilt
    of the plate) has no influence. A pixel is valid if both channels exceed `FLOOR_DB` everywhere within two widths of
    the window.

    The window has the width (standard deviation) `smooth_mm`: the gains vary slowly, speckle does not.
    `name` is the scan, for the report.

    Raises DataError if the image shows no metal, or other materials in addition to it.
    """
    h = images.h
    v = images.v
    usable = images.usable
    smooth_px = smooth_mm / 1e3 / abs(float(images.x_m[1] - images.x_m[0]))
    power_h = smooth(np.where(usable, np.abs(h) ** 2, 0.0).astype(np.float64), smooth_px)
    power_v = smooth(np.where(usable, np.abs(v) ** 2, 0.0).astype(np.float64), smooth_px)
    strong = usable.copy()
    level_db = []
    for power in (power_h, power_v):
        top = float(np.percentile(power[usable], 90)) if usable.any() else 0.0
        least_amplitude = float(np.finfo(np.float32).tiny)
        level_db.append(10 * np.log10(np.maximum(power, least_amplitude) / max(top, least_amplitude)))
        strong &= power >= max(top * 10 ** (FLOOR_DB / 10), least_amplitude)
    _check_is_alone(level_db[0][usable], level_db[1][usable])
    # The border of the image does not count as an edge of the plate.
    is_plate = np.asarray(scipy.ndimage.binary_erosion(strong, _make_disk(round(2 * smooth_px)), border_value=1), bool)
    if int(is_plate.sum()) < MIN_PIXELS:
        raise DataError(
            "the reference scan shows no metal plate",
            "no area wider than the smoothing window is bright in both channels",
            "scan a flat metal plate that covers the plane, larger than the grid on every side",
            code=ErrorCode.NO_DATA,
        )
    cut_h = np.where(strong, h, complex(np.nan, np.nan))
    cut_v = np.where(strong, v, complex(np.nan, np.nan))
    level_h = np.sqrt(np.abs(smooth(np.abs(cut_h) ** 2, smooth_px)))
    level_v = np.sqrt(np.abs(smooth(np.abs(cut_v) ** 2, smooth_px)))
    cross = smooth(cut_h * np.conj(cut_v), smooth_px)
    metal_h = np.where(is_plate, level_h * np.exp(1j * np.angle(cross)), np.nan).astype(np.result_type(h, np.complex64))
    metal_v = np.where(is_plate, level_v, np.nan).astype(metal_h.dtype)
    relative_std = inverse_spread(h[is_plate] / metal_h[is_plate], v[is_plate] / metal_v[is_plate])
    share = 100 * float(is_plate.mean())
    scan = f" ({name})" if name else ""
    description = f"a metal plate scanned on its own{scan}, by position on {share:.0f} % of the image"
    return PlaneReference(
        h=metal_h, v=metal_v, valid=is_plate, x_m=images.x_m, y_m=images.y_m, spread=relative_std, how=description
    )


def _check_is_alone(h_db: npt.NDArray[np.float64], v_db: npt.NDArray[np.float64]) -> None:
    """Raise DataError if pixels that are bright in H are not metal: levels [pixel], relative to each channel's top."""
    is_bright = h_db >= FLOOR_DB
    share = np.count_nonzero(is_bright & (v_db - h_db < OTHER_MATERIAL_DB)) / max(1, np.count_nonzero(is_bright))
    if share > OTHER_MATERIAL_SHARE:
        raise DataError(
            "the reference scan shows other materials besides metal",
            f"on {100 * share:.0f} % of its bright area V is {-OTHER_MATERIAL_DB:.0f} dB or more weaker relative to H"
            " than where it is brightest: plastics, wood, glass and water reflect in this way",
            "scan a flat metal plate alone; a scene with metal in it is processed without a reference (--metal)",
            code=ErrorCode.MISMATCH,
        )


def _make_disk(radius: int) -> npt.NDArray[np.bool_]:
    """Return a disk of this radius in pixels as a square mask, for morphology."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return x**2 + y**2 <= radius**2


PLATE = (1.0, 1.0)
"""The s and p reflected by a metal plate."""
MIN_CONDITION = 0.02
"""Smallest ratio of the third to the first singular value. Below it the waves are too similar; chosen."""
# s and p, or H and V.
Wave = tuple[complex, complex]


@dataclass(frozen=True)
class MetalStandard:
    """Measurement of a metal standard.

    Attributes
    ----------
    measured
        H and V but for a common complex factor (:func:`common_direction`).
    wave
        Reflected s and p but for a factor: :data:`PLATE` or :func:`strips_wave`.
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
        RMS misfit of the standards, as an angle in radians; zero for three standards, as many as unknowns.
    """

    h: complex
    v: complex
    imbalance: complex
    residual: float

    def matrix(self) -> npt.NDArray[np.complex128]:
        """Return the matrix from (s, p) to (H, V), complex128 [2, 2], with g_v = 1."""
        g = self.imbalance
        return np.array([[g, g * self.h], [self.v, 1.0]], np.complex128)


def strips_wave(psi_rad: float, theta_rad: float) -> Wave:
    """Return the s and p reflected by ideal metal strips rotated by psi from the vertical; TX sends both equally.

    With the signs of Eq. 2: -w (w_s + w_p) / |w|^2 with w = (cos psi, sin psi cos theta), so that strips along the
    field reflect like a plate.

    Raises PolysightError if TX's field is across the strips (w_s = -w_p), which then reflect nothing.
    """
    w = np.array([np.cos(psi_rad), np.sin(psi_rad) * np.cos(theta_rad)])
    total = float(w.sum())
    # Chosen; the sum is at most 1.4.
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
    """Return the common pair (H, V) of pixels but for a factor: the first eigenvector of their 2 x 2 covariance.

    A common phase or amplitude of both channels may vary from pixel to pixel.

    Raises DataError if there is no signal.
    """
    pixels = np.isfinite(h) & np.isfinite(v)
    if mask is not None:
        pixels &= mask
    m = np.stack([h[pixels], v[pixels]]).astype(np.complex128)
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


def estimate_leakage(standards: Sequence[MetalStandard]) -> Leakage:
    """Estimate leakage of both boards and gain imbalance from three or more metal standards.

    Raises DataError if there are fewer than three, or their waves are too similar.
    """
    if len(standards) < 3:
        raise DataError(
            f"{len(standards)} metal standards for three unknowns",
            "leakage of H, leakage of V and gain imbalance need three different waves",
            "scan the plate, and strips at two orientations; or use the one-parameter axial ratio",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    # Both channels are scaled to the same size, so that the equations are well conditioned; the solution is scaled
    # back.
    measured = np.array([s.measured for s in standards], np.complex128)
    scale = np.sqrt(np.mean(np.abs(measured / np.linalg.norm(measured, axis=1, keepdims=True)) ** 2, axis=0))
    measured = measured / scale
    measured /= np.linalg.norm(measured, axis=1, keepdims=True)
    waves = np.array([s.wave for s in standards], np.complex128)
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    # m x (M e) = 0: one equation per standard for the entries g_h, g_h a, g_v b, g_v of M.
    rows = np.stack(
        [
            measured[:, 1] * waves[:, 0],
            measured[:, 1] * waves[:, 1],
            -measured[:, 0] * waves[:, 0],
            -measured[:, 0] * waves[:, 1],
        ],
        axis=1,
    )
    # The entries, but for a factor, are the singular vector of the smallest, fourth singular value.
    _, sizes, vh = np.linalg.svd(rows)
    if sizes[2] < MIN_CONDITION * sizes[0]:
        raise DataError(
            "the metal standards do not separate leakage from gain",
            "their waves are too similar: a plate reflects the same in every orientation, strips must be rotated",
            "scan the plate, and strips at 0 and at 90 degrees",
            code=ErrorCode.VALUES_CONFLICT,
        )
    g_h, g_ha, g_vb, g_v = vh[3].conj() * np.array([scale[0], scale[0], scale[1], scale[1]])
    # (H, V) that the estimate predicts, [standard, 2], scaled like `measured`.
    predicted = (np.array([[g_h, g_ha], [g_vb, g_v]]) / scale[:, None] @ waves.T).T
    # Sine of the angle between the measured and the predicted pair, [standard].
    sine = np.abs(measured[:, 1] * predicted[:, 0] - measured[:, 0] * predicted[:, 1]) / np.linalg.norm(
        predicted, axis=1
    )
    if len(standards) > 3:
        residual = float(np.sqrt(np.mean(np.minimum(sine, 1.0) ** 2)))
    else:
        residual = 0.0
    return Leakage(complex(g_ha / g_h), complex(g_vb / g_v), complex(g_h / g_v), residual)


def estimate_axial_ratio(plate: MetalStandard, strips: MetalStandard) -> Leakage:
    """Estimate equal leakage of both boards (the authors' axial ratio) from the plate and strips in one orientation.

    Raises DataError if the strips reflect s and p equally.
    """
    # The pair relative to the plate is (H, V) ~ (s + a p, p + a s).
    h, v = (m / plate_value for m, plate_value in zip(strips.measured, plate.measured, strict=True))
    s, p = strips.wave
    # Strips must reflect s and p that differ by a tenth of their size (chosen), and the divisor must not vanish.
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


def estimate_leakage_from_images(
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

    Raises DataError as :func:`estimate_leakage`, :func:`estimate_axial_ratio` and :func:`common_direction`,
    PolysightError as :func:`strips_wave`.
    """
    gain_h, gain_v = plate
    relative = [
        MetalStandard(common_direction(ratio(h, gain_h), ratio(v, gain_v), mask), strips_wave(psi, theta_rad))
        for psi, h, v in strips
    ]
    full_standard = MetalStandard(PLATE, PLATE)
    if len(relative) == 1:
        estimate = estimate_axial_ratio(full_standard, relative[0])
    else:
        estimate = estimate_leakage([full_standard, *relative])
    mean = common_direction(gain_h, gain_v, mask)
    # Relative to the plate g is (1 + b) / (1 + a); the plate itself is g_h (1 + a) / (g_v (1 + b)).
    return Leakage(estimate.h, estimate.v, estimate.imbalance * mean[0] / mean[1], estimate.residual)
