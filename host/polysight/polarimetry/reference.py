"""Metal reference from a separate scan of a metal plate that covers the plane (Eq. 8 and 9 for each pixel).

A metal patch in the scene gives one number per channel. A plate over the plane gives one per pixel, which also removes
differences between H and V that vary over the plane (antenna patterns, illumination). Samples are referenced to the
direct path, so the reference stays valid after a power cycle; geometry and boards must be the same, see
:meth:`PlaneReference.check_rig`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Image, ImagedWith, Images, Mask
from polysight.polarimetry.calibrate import divide_by_metal, ratio, smooth
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

SMOOTH_MM = 8.0
FLOOR_DB = -10.0
MIN_PIXELS = 100


@dataclass(frozen=True)
class PlaneReference:
    """Metal reference of both channels at every pixel.

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

    def apply(self, images: Images) -> Images:
        """Divide both channels of another scan by the reference; NaN where it is not valid."""
        return divide_by_metal(images, self.h, self.v)

    def check_axes(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> None:
        """Raise DataError if a scan has other pixels."""
        same = all(
            np.shape(own) == np.shape(other) and np.allclose(own, other, rtol=0, atol=1e-5)
            for own, other in ((self.x_m, x_m), (self.y_m, y_m))
        )
        if not same:
            raise DataError(
                "the images of the metal reference and of this scan have different pixels",
                "the reference was scanned with another [image], another geometry or another chirp",
                "scan the metal plate with the same rig file; only [grid] may differ",
                code=ErrorCode.MISMATCH,
            )

    def valid_on(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return `valid` for a scan with these pixels. Raises DataError if its pixels differ."""
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
        if found := self.made_with.differences(now):
            raise DataError(
                f"{name} is of another rig: {'; '.join(found)}",
                "the rig or its file was changed after the scan of the metal plate, which changes the gains",
                "empty calibration.metal, scan the metal plate again with the present rig, and calibrate with it; or"
                " restore the rig file",
                code=ErrorCode.MISMATCH,
            )

    def check_bands(self, count: int, name: str = "the metal reference") -> None:
        """Raise DataError if the reference does not have `count` sub-bands; one band is always there."""
        if count > 1 and len(self.bands) != count:
            held = f"{len(self.bands)} sub-bands" if self.bands else "no sub-bands"
            instead = f"--bands {len(self.bands)} uses those it has" if self.bands else "leave --bands out"
            raise DataError(
                f"{name} holds {held}, not {count}",
                "each sub-band needs a metal reference in the same part of the sweep",
                f"`polysight calibrate metal SCAN --bands {count}` adds them; or {instead}; or --reference SCAN",
                code=ErrorCode.MISMATCH,
            )

    def facts(self) -> dict[str, Any]:
        """Return the variation of the gains over the plane, for quality.json."""
        at = self.valid
        h, v = self.h[at], self.v[at]
        out: dict[str, Any] = {"how": self.how, "share_of_plane": round(float(at.mean()), 4)}
        for name, z in (("h", h), ("v", v), ("ratio", h / v)):
            level = 20 * np.log10(np.abs(z))
            out[f"{name}_variation_db"] = round(float(np.std(level)), 4)
        turned = np.angle(h / v * np.conj(np.mean(h / v)))
        out["ratio_variation_deg"] = round(float(np.degrees(np.std(turned))), 4)
        out["spread"] = round(self.spread, 5)
        if self.bands:
            out["sub_bands"] = len(self.bands)
        return out


def plane_reference(
    images: Images, smooth_mm: float = SMOOTH_MM, floor_db: float = FLOOR_DB, name: str = ""
) -> PlaneReference:
    """Make a reference from the images of a metal plate over the plane.

    Amplitudes and H conj(V) are averaged over a Gaussian window, so a common phase of both channels (distance and tilt
    of the plate) has no influence. A pixel is valid if both channels exceed `floor_db` within two widths of the window.

    Parameters
    ----------
    images
        Both channels, flattened by the footprint.
    smooth_mm
        Width (standard deviation) of the window, millimetres; the gains vary slowly, speckle does not.
    floor_db
        Lowest level relative to the plate's 90th percentile, in each channel.
    name
        Name of the scan, for the report.

    Raises
    ------
    DataError
        if the image shows no metal.
    """
    h, v, usable = images.h, images.v, images.usable
    smooth_px = smooth_mm / 1e3 / abs(float(images.x_m[1] - images.x_m[0]))
    power_h, power_v = (smooth(np.where(usable, np.abs(z) ** 2, 0.0).astype(np.float64), smooth_px) for z in (h, v))
    strong = usable.copy()
    for power in (power_h, power_v):
        top = float(np.percentile(power[usable], 90)) if usable.any() else 0.0
        strong &= power >= max(top * 10 ** (floor_db / 10), np.finfo(np.float32).tiny)
    # The border of the image does not count as an edge of the plate.
    inside = np.asarray(scipy.ndimage.binary_erosion(strong, _disk(round(2 * smooth_px)), border_value=1), bool)
    if int(inside.sum()) < MIN_PIXELS:
        raise DataError(
            "the reference scan shows no metal plate",
            "no area wider than the smoothing window is bright in both channels",
            "scan a flat metal plate that covers the plane, larger than the grid on every side",
            code=ErrorCode.NO_DATA,
        )
    cut_h, cut_v = (np.where(strong, z, complex(np.nan, np.nan)) for z in (h, v))
    level_h, level_v = (np.sqrt(np.abs(smooth(np.abs(z) ** 2, smooth_px))) for z in (cut_h, cut_v))
    cross = smooth(cut_h * np.conj(cut_v), smooth_px)
    metal_h = np.where(inside, level_h * np.exp(1j * np.angle(cross)), np.nan).astype(np.result_type(h, np.complex64))
    metal_v = np.where(inside, level_v, np.nan).astype(metal_h.dtype)
    spread = _spread(h[inside] / metal_h[inside], v[inside] / metal_v[inside])
    share = 100 * float(inside.mean())
    how = f"a metal plate scanned on its own{f' ({name})' if name else ''}, by position on {share:.0f} % of the image"
    return PlaneReference(metal_h, metal_v, inside, images.x_m, images.y_m, spread, how)


def _spread(h: Image, v: Image) -> float:
    """Return the standard deviation of the real and the imaginary part of V / H (median absolute deviation)."""
    q = ratio(v, h)
    q = q[np.isfinite(q)]
    parts = np.concatenate([q.real - np.median(q.real), q.imag - np.median(q.imag)])
    return 1.4826 * float(np.median(np.abs(parts - np.median(parts))))


def _disk(radius: int) -> npt.NDArray[np.bool_]:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return x**2 + y**2 <= radius**2
