"""A metal plate over the whole plane, scanned on its own, as the reference of other scans (Eq. 8 and 9 by position).

One metal patch in the scene gives one number for each channel. A plate over the plane gives one for each pixel: what
differs from place to place, antenna patterns and illumination of H against V, is divided out with the gains. Samples
are referenced to the direct path, so the gains of another power cycle do not matter; the geometry and the boards must
be the same: :meth:`PlaneReference.check_rig`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.host.imaging import ImagedWith
from polysight.host.polarimetry.calibrate import Calibrated, Image, Mask, calibrate_by_reference, ratio, smooth
from polysight.shared.errors import DataError

SMOOTH_MM = 8.0
FLOOR_DB = -10.0
LEAST_PIXELS = 100


@dataclass(frozen=True)
class PlaneReference:
    """What both channels are divided by.

    Attributes
    ----------
    h, v
        complex [ny, nx]: metal's amplitudes, with the phase of H / V in h and v real; not a number where not valid.
    valid
        bool [ny, nx]: where metal was seen strongly enough.
    x_m, y_m
        Pixel centres, rig frame, metres.
    spread
        How far pixels of the plate lie from it, one standard deviation of each part of V / H: noise and speckle, and
        for :meth:`mean` the variation over the plane.
    how
        One sentence for the report.
    bands
        The same plate in sub-bands of the sweep, where those were imaged.
    made_with
        The rig that it was imaged with; None where that is not known.
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

    def mean(self) -> PlaneReference:
        """The same plate as one number a channel (Eq. 9), usable at every pixel."""
        at = self.valid
        cross = complex(np.mean(self.h[at] * np.conj(self.v[at])))
        metal_v = float(np.sqrt(np.mean(np.abs(self.v[at]) ** 2)))
        metal_h = float(np.sqrt(np.mean(np.abs(self.h[at]) ** 2))) * cross / abs(cross)
        apart = _spread(self.h[at] / metal_h, self.v[at] / metal_v)
        return replace(
            self,
            h=np.full(self.h.shape, metal_h, self.h.dtype),
            v=np.full(self.v.shape, metal_v, self.v.dtype),
            valid=np.ones_like(self.valid),
            spread=float(np.hypot(self.spread, apart)),
            how=self.how.replace("by position", "as one number a channel"),
            bands=tuple(band.mean() for band in self.bands),
        )

    def apply(self, h: Image, v: Image) -> Calibrated:
        """Divide both channels of another scan; not a number where this reference is not valid."""
        return calibrate_by_reference(h, v, self.h, self.v)

    def check_axes(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> None:
        """Refuse a scan with other pixels. Raises DataError."""
        same = all(
            np.shape(own) == np.shape(other) and np.allclose(own, other, rtol=0, atol=1e-5)
            for own, other in ((self.x_m, x_m), (self.y_m, y_m))
        )
        if not same:
            raise DataError(
                "the metal reference's image and this scan's have different pixels",
                "the reference was scanned with another [image], another geometry or another chirp",
                "scan the metal plate with the same rig file; only [grid] may differ",
            )

    def valid_on(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Where the reference is strong enough, on a scan's pixels, bool [ny, nx]. Raises DataError."""
        self.check_axes(x_m, y_m)
        return self.valid

    def check_rig(self, now: ImagedWith, name: str = "the metal reference") -> None:
        """Refuse images of another rig: the gains would not be theirs. `name` is for the message. Raises DataError."""
        if self.made_with is None:
            raise DataError(
                f"{name} does not say which rig it was scanned with",
                "an older release wrote it, which could not tell when a board was moved afterwards",
                "make it again from the same scan: `polysight calibrate metal SCAN`; one scan can be processed with"
                " --reference SCAN instead",
            )
        if found := self.made_with.differences(now):
            raise DataError(
                f"{name} is of another rig: {'; '.join(found)}",
                "the rig or its file was changed after the metal plate was scanned, and the gains with it",
                "empty calibration.metal, scan the metal plate again with the rig as it is, and calibrate with it; or"
                " put the rig file back",
            )

    def check_bands(self, count: int, name: str = "the metal reference") -> None:
        """Refuse to divide so many sub-bands by a reference that has others, or none. Raises DataError."""
        if count > 1 and len(self.bands) != count:
            held = f"{len(self.bands)} sub-bands" if self.bands else "no sub-bands"
            instead = f"--bands {len(self.bands)} uses those it has" if self.bands else "leave --bands out"
            raise DataError(
                f"{name} holds {held}, not {count}",
                "a sub-band is divided by metal in the same part of the sweep",
                f"`polysight calibrate metal SCAN --bands {count}` keeps so many; or {instead}; or --reference SCAN",
            )

    def facts(self) -> dict[str, Any]:
        """How much the gains vary over the plane, for quality.json; plain numbers."""
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
    h: Image,
    v: Image,
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    valid: Mask | None = None,
    smooth_mm: float = SMOOTH_MM,
    floor_db: float = FLOOR_DB,
    name: str = "",
) -> PlaneReference:
    """The reference from the images of a metal plate over the plane.

    Amplitudes and H conj(V) are averaged over a Gaussian window: a phase common to both channels, the plate's distance
    and tilt, has no influence. Pixels count where both channels lie above `floor_db`, and not within two widths of the
    window of ones that do not.

    Parameters
    ----------
    h, v
        complex [ny, nx], flattened by the footprint.
    x_m, y_m, valid
        Pixel centres, metres; bool [ny, nx], pixels to look at.
    smooth_mm
        Width (standard deviation) of the window, millimetres: gains vary slowly, speckle does not.
    floor_db
        Weakest level relative to the plate's own 90th percentile, in each channel.
    name
        Of the scan, for the report.

    Raises
    ------
    DataError
        when no metal is seen.
    """
    smooth_px = smooth_mm / 1e3 / abs(float(x_m[1] - x_m[0]))
    usable = np.isfinite(h) & np.isfinite(v) & (True if valid is None else valid)
    power_h, power_v = (smooth(np.where(usable, np.abs(z) ** 2, 0.0).astype(np.float64), smooth_px) for z in (h, v))
    strong = usable.copy()
    for power in (power_h, power_v):
        top = float(np.percentile(power[usable], 90)) if usable.any() else 0.0
        strong &= power >= max(top * 10 ** (floor_db / 10), np.finfo(np.float32).tiny)
    # The image's own border is no edge of the plate.
    inside = np.asarray(scipy.ndimage.binary_erosion(strong, _disk(round(2 * smooth_px)), border_value=1), bool)
    if int(inside.sum()) < LEAST_PIXELS:
        raise DataError(
            "the reference scan shows no metal plate",
            "nowhere are both channels strong over an area wider than the smoothing",
            "scan a flat metal plate that covers the plane, larger than the grid on every side",
        )
    cut_h, cut_v = (np.where(strong, z, complex(np.nan, np.nan)) for z in (h, v))
    level_h, level_v = (np.sqrt(np.abs(smooth(np.abs(z) ** 2, smooth_px))) for z in (cut_h, cut_v))
    cross = smooth(cut_h * np.conj(cut_v), smooth_px)
    metal_h = np.where(inside, level_h * np.exp(1j * np.angle(cross)), np.nan).astype(np.result_type(h, np.complex64))
    metal_v = np.where(inside, level_v, np.nan).astype(metal_h.dtype)
    spread = _spread(h[inside] / metal_h[inside], v[inside] / metal_v[inside])
    share = 100 * float(inside.mean())
    how = f"a metal plate scanned on its own{f' ({name})' if name else ''}, by position on {share:.0f} % of the image"
    return PlaneReference(metal_h, metal_v, inside, x_m, y_m, spread, how)


def _spread(h: Image, v: Image) -> float:
    """Standard deviation of the real and of the imaginary part of V / H, from the median absolute deviation."""
    q = ratio(v, h)
    q = q[np.isfinite(q)]
    parts = np.concatenate([q.real - np.median(q.real), q.imag - np.median(q.imag)])
    return 1.4826 * float(np.median(np.abs(parts - np.median(parts))))


def _disk(radius: int) -> npt.NDArray[np.bool_]:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return x**2 + y**2 <= radius**2
