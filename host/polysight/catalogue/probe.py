"""Results at one place of a processed scan: channels, ratio, permittivity, range profile, nearest materials."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import skimage

from polysight.catalogue.pictures import Pixels
from polysight.materials import SIMULATED_LIBRARY, Library, is_metal
from polysight.pipeline import Pipeline
from polysight.polarimetry import permittivity_from_ratio
from polysight.products import read_products, scan_folder_of
from polysight.store import MANIFEST, ScanFolder
from polysight_shared.errors import PolysightError

NEAREST = 5
_REACH_M, _POINTS = 0.3, 121  # of the range profile, to either side
_FLOOR_DB = -50.0


def probe(folder: Path, x_mm: float, y_mm: float, library: Path | None = None) -> dict[str, Any]:
    """Read all results of a processed scan at one place, in mm from the middle of the image.

    `library` names materials (None: the simulated one).

    Returns
    -------
    dict
        Plain data: `place_mm`; `h_db`, `v_db`; `p` and `p_sigma`; `permittivity` and `permittivity_sigma`, or `why`
        it is unknown; `patch`, the segment of materials.json with this place; `nearest` materials; `profile`, the
        focused range profile, or `profile_why` there is none.

    Raises
    ------
    DataError
        if there are no products, or the place lies outside the image.
    """
    pixels = Pixels(read_products(folder).folder)
    row, column = pixels.nearest(x_mm, y_mm)
    place = (float(pixels.x_mm[column]), float(pixels.y_mm[row]))
    h, v, p = (complex(a[row, column]) for a in (pixels.h, pixels.v, pixels.p))
    found: dict[str, Any] = {
        "place_mm": [round(m, 2) for m in place],
        "lit": bool(pixels.valid[row, column]),
        "h_db": _db(h),
        "v_db": _db(v),
        "p": _parts(p),
        "p_sigma": _number(pixels.p_std[row, column]),
        "referenced": pixels.referenced,
        **_permittivity(pixels, row, column),
        "patch": _patch(pixels.segments, *place) if pixels.referenced else None,
    }
    found["nearest"] = _nearest(pixels, row, column, library) if found["permittivity"] else []
    return found | _profile(folder, float(pixels.x_m[column]), float(pixels.y_m[row]))


def _permittivity(pixels: Pixels, row: int, column: int) -> dict[str, Any]:
    """The permittivity of a pixel as a half space, or why it has none."""
    why = ""
    if not pixels.referenced:
        why = "the images are not referenced to metal, or support no result"
    elif not pixels.clear[row, column]:
        why = "too dark: only noise"
    else:
        eps, sigma = complex(pixels.permittivity[row, column]), float(pixels.permittivity_sigma[row, column])
        if not pixels.metal_like[row, column]:
            return {"permittivity": _parts(eps), "permittivity_sigma": _number(sigma), "why": ""}
        why = "too close to metal: any large permittivity looks like this"
    return {"permittivity": None, "permittivity_sigma": None, "why": why}


def _patch(segments: list[dict[str, Any]], x_mm: float, y_mm: float) -> dict[str, Any] | None:
    """The segment whose outline holds a place."""
    for segment in segments:
        outline = segment.get("outline_mm") or []
        if len(outline) > 2 and skimage.measure.points_in_poly([(x_mm, y_mm)], outline)[0]:
            return segment
    return None


@lru_cache(maxsize=4)
def _library(path: Path, changed_ns: int, angle_deg: float) -> dict[str, tuple[complex, float]]:
    """Mean of V / H and spread of its patches (of each part), by material."""
    del changed_ns  # time of the file: a changed one is read again
    entries = Library.load(path).at(angle_deg).entries
    out = {}
    for name in dict.fromkeys(e.name for e in entries):
        means = np.array(
            [np.median((1 / e.p).real) + 1j * np.median((1 / e.p).imag) for e in entries if e.name == name]
        )
        spread = float(np.sqrt(np.mean(np.abs(means - means.mean()) ** 2) / 2)) if len(means) > 1 else 0.0
        out[name] = (complex(means.mean()), spread)
    return out


def _nearest(pixels: Pixels, row: int, column: int, library: Path | None) -> list[dict[str, Any]]:
    """Materials of the library by the distance of their ratio, in standard deviations of pixel and material."""
    path = library or SIMULATED_LIBRARY
    try:
        known = _library(path, path.stat().st_mtime_ns, float(np.degrees(pixels.theta_rad)))
    except (PolysightError, OSError):  # a library of another angle
        return []
    p, sigma = complex(pixels.p[row, column]), float(pixels.p_std[row, column])
    own = sigma / max(abs(p) ** 2, 1e-9) if np.isfinite(sigma) else 0.0
    out = []
    for name, (mean, spread) in known.items():
        error = float(np.hypot(own, max(spread, 5e-3)))
        eps = _half_space(mean, pixels.theta_rad) if not is_metal(name) else None
        out.append({"name": name, "sigmas": round(abs(1 / p - mean) / error, 1) if p else None, "permittivity": eps})
    return sorted(out, key=lambda n: n["sigmas"] if n["sigmas"] is not None else np.inf)[:NEAREST]


def _half_space(inverse: complex, theta_rad: float) -> dict[str, float | None] | None:
    eps = complex(permittivity_from_ratio(1 / inverse, theta_rad)) if inverse else complex(np.nan)
    return _parts(eps) if np.isfinite(eps) else None


def _profile(folder: Path, x_m: float, y_m: float) -> dict[str, Any]:
    """Focused range profile through a place, from the scan's kept samples."""
    scan = scan_folder_of(folder)
    if scan is None or not (scan / MANIFEST).exists():
        return {"profile": None, "profile_why": "the rows are not in this folder"}
    try:
        kept = scan / "samples" / "rows.jsonl"
        pipeline = _imaged(scan, kept.stat().st_mtime_ns) if kept.exists() else None
    except (PolysightError, OSError) as e:
        return {"profile": None, "profile_why": str(e).splitlines()[0]}
    if pipeline is None:
        return {"profile": None, "profile_why": "no samples were kept of this scan: `polysight process` makes them"}
    shifts = np.linspace(-_REACH_M, _REACH_M, _POINTS)
    point = np.array([x_m, y_m, float(np.mean(pipeline.images.grid.z_m))])
    levels = {name: np.abs(board.range_profile(point, shifts)) for name, board in pipeline.images.boards.items()}
    top = max(float(level.max()) for level in levels.values()) or 1.0
    boards = {
        n: np.maximum(20 * np.log10(np.maximum(a / top, 1e-9)), _FLOOR_DB).round(1).tolist() for n, a in levels.items()
    }
    return {"profile": {"path_m": shifts.round(4).tolist(), "boards": boards}, "profile_why": ""}


@lru_cache(maxsize=2)
def _imaged(scan: Path, changed_ns: int) -> Pipeline | None:
    """A pipeline that holds the kept samples of every row; None where some are not kept."""
    del changed_ns
    pipeline = Pipeline(ScanFolder.load(scan), samples="read")
    rows = list(pipeline.source.rows())
    return pipeline if rows and all(map(pipeline.samples.restore, rows)) else None


def _db(value: complex) -> float | None:
    return round(float(20 * np.log10(abs(value))), 2) if value and np.isfinite(value) else None


def _number(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None


def _parts(value: complex) -> dict[str, float | None]:
    return {"real": _number(value.real), "imag": _number(value.imag)}
