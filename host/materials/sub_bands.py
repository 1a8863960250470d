"""The patches' ratios in sub-bands of the sweep: what tells a thin layer from a thick one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.imaging import ChannelImages, SubBand
from polysight.host.materials.analyse import reference_spread, smooth_inside, to_metal, without_leakage
from polysight.host.materials.inputs import Optics
from polysight.host.materials.inversion import ratio_error
from polysight.host.materials.layers import Bands, Spectrum
from polysight.host.materials.permittivity import inverse_spread, median_ratio
from polysight.host.materials.result import MaterialsResult
from polysight.host.polarimetry import PlaneReference
from polysight.shared.config import Chirp
from polysight.shared.errors import DataError

Image = npt.NDArray[np.complexfloating]
AMPLITUDE_ERROR = 0.1
"""Relative standard deviation of |H| of a patch: its size, its edges and its tilt are in it, and in no ratio."""


def with_bands(
    found: MaterialsResult,
    bands: Sequence[SubBand],
    images: Sequence[ChannelImages],
    optics: Optics,
    plane: PlaneReference | None = None,
) -> MaterialsResult:
    """The same result with each patch's ratios in sub-bands; as it is where no sub-bands were imaged.

    `plane` is metal scanned on its own, imaged in the same sub-bands. Parameters and errors as :func:`band_rows`.
    """
    if not bands:
        return found
    parts = None if plane is None else plane.bands
    return replace(found, bands=band_rows(found, bands, images, found.inversion.leakage, optics.smooth_px, parts))


def band_rows(
    found: MaterialsResult,
    bands: Sequence[SubBand],
    images: Sequence[ChannelImages],
    leakage: tuple[complex, complex],
    smooth_px: float,
    references: Sequence[PlaneReference] | None = None,
) -> dict[int, list[dict[str, Any]]]:
    """Each patch's ratio in each sub-band, ready for materials.json.

    Parameters
    ----------
    found
        Patches and metal reference, from the whole sweep.
    bands, images
        Sub-bands and their image pairs, [K].
    leakage, smooth_px
        As for the whole sweep.
    references
        Metal scanned on its own, one for each sub-band; None: the metal region of the scene.

    Returns
    -------
    Patch number to K dicts: first_hz, last_hz, ratio {real, imag} or null, inverse_ratio_std, amplitude_h. Null where
    the sub-band shows nothing of the patch, or nothing of the metal: its footprint is another than the whole sweep's.

    Raises
    ------
    DataError
        when the reference was not imaged in these sub-bands.
    """
    if references is not None and len(references) != len(bands):
        raise DataError(
            f"the metal reference holds {len(references)} sub-bands, not {len(bands)}",
            "a sub-band is divided by metal in the same part of the sweep",
            f"give a reference with --bands {len(bands)}",
        )
    out: dict[int, list[dict[str, Any]]] = {r.patch.label: [] for r in found.patches}
    for k, (band, made) in enumerate(zip(bands, images, strict=True)):
        reference = references[k] if references is not None else None
        h, v, error = _relative_to_metal(found, made, leakage, smooth_px, reference)
        for r in found.patches:
            at = r.patch.interior & made.valid
            seen = _seen(h[at], v[at], error)
            if seen["ratio"] is not None:  # leakage is the same in every sub-band, and not known exactly
                inverse = 1 / complex(seen["ratio"]["real"], seen["ratio"]["imag"])
                left = float(ratio_error(found.inversion, found.prior, inverse))
                seen["inverse_ratio_std"] = math.hypot(seen["inverse_ratio_std"], left)
            out[r.patch.label].append({"first_hz": band.first_hz, "last_hz": band.last_hz, **seen})
    return out


def _relative_to_metal(
    found: MaterialsResult,
    made: ChannelImages,
    leakage: tuple[complex, complex],
    smooth_px: float,
    reference: PlaneReference | None,
) -> tuple[Image, Image, float]:
    """H and V of a sub-band, [ny, nx], relative to metal, and the reference's relative standard error.

    Not numbers where the sub-band shows no metal.
    """
    metal = replace(found.metal, mask=found.metal.mask & made.valid)  # elsewhere the images are 0, and not metal
    if not metal.mask.any():
        nothing = np.full(made.valid.shape, complex(np.nan, np.nan))
        return nothing, nothing, float("nan")
    h, v = (np.where(made.valid, c, complex(np.nan, np.nan)).astype(c.dtype) for c in (made.h, made.v))
    relative = without_leakage(to_metal(h, v, metal, reference), leakage)
    h, v = (smooth_inside(c, found.segmentation, smooth_px) for c in (relative.h, relative.v))
    return h, v, reference_spread(h, v, metal, reference)


def _seen(h: Image, v: Image, error: float) -> dict[str, Any]:
    """Ratio of a patch's pixels [n] in a sub-band, its standard deviation, and |H|; null where they do not tell."""
    ratio = median_ratio(h, v)
    std = math.hypot(inverse_spread(h, v), error / abs(ratio)) if ratio else float("nan")
    if not (math.isfinite(abs(ratio)) and math.isfinite(std)):
        return {"ratio": None, "inverse_ratio_std": None, "amplitude_h": None}
    return {
        "ratio": {"real": ratio.real, "imag": ratio.imag},
        "inverse_ratio_std": std,
        "amplitude_h": float(np.nanmedian(np.abs(h))),
    }


def bands_of_row(
    row: Mapping[str, Any], chirp: Chirp, count: int = 1, amplitude_error: float = AMPLITUDE_ERROR
) -> Bands | None:
    """What :func:`polysight.host.materials.layers.fit_layer` needs of a row of materials.json.

    Parameters
    ----------
    row
        One segment.
    chirp
        Of the scan.
    count
        Sub-bands to use: those that were recorded with it, or 1: the whole sweep.
    amplitude_error
        Relative standard deviation of |H|; 0: |H| is not used.

    Returns
    -------
    None when the segment has no usable ratio.

    Raises
    ------
    DataError
        when the segment was not processed with so many sub-bands.
    """
    parts = [row] if count == 1 else list(row.get("bands") or ())
    if len(parts) != count:
        there = f"{len(parts)} sub-bands" if parts else "no sub-bands"
        raise DataError(
            f"segment {row.get('label')} holds {there}, not {count}",
            "sub-bands are imaged from the recorded rows",
            f"process the scan again with --bands {count}",
        )
    if any(p.get("ratio") is None or not p.get("inverse_ratio_std") for p in parts):
        return None
    # The bands share what metal reference, edges and size are off by: K of them know no more of it than one.
    shared = np.sqrt(count)
    inverse = np.array([1 / complex(p["ratio"]["real"], p["ratio"]["imag"]) for p in parts])
    sigma = shared * np.array([float(p["inverse_ratio_std"]) for p in parts])
    level = [p.get("amplitude_h") for p in parts]
    if not amplitude_error or any(a is None for a in level):
        return Bands(Spectrum.of(chirp, count), inverse, sigma)
    amplitude = np.array(level, np.float64)
    return Bands(Spectrum.of(chirp, count), inverse, sigma, amplitude, shared * amplitude_error * amplitude)
