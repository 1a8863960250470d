"""`patches.npz`: the features of the pixels of all patches of a scan.

`match_patches` finds the same patches in several scans, to name them together.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.classify import features_of
from polysight.materials.result import MaterialsResult
from polysight.materials.samples import Real, SceneErrors
from polysight.materials.segment import axis_mm
from polysight.store import open_npz
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

PATCHES = "patches.npz"
FORMAT = "polysight-patches-1"
APART_MM = 20.0
"""Largest distance between the centres of one patch in two scans."""
NEAR_MM = 4.0
"""Largest distance between pixels of two scans that show the same spot: about the resolution."""
_ERROR_ARRAYS = ("own", "design", "covariance")  # of `SceneErrors`


@dataclass(frozen=True)
class ScanPatch:
    """A patch in one scan: its centre (mm from the image centre), the positions and features of its pixels.

    `places_mm` float64 [n, 2], `features` float64 [n, 4] of its interior, after the Gaussian filter.
    """

    label: int
    centre_mm: tuple[float, float]
    truth: str | None
    places_mm: Real
    features: Real


@dataclass(frozen=True)
class ScanPatches:
    """The patches of one scan; `errors` of the patches numbered `judged`, by the scan's error budget."""

    angle_deg: float
    simulated: bool
    patches: tuple[ScanPatch, ...]
    judged: tuple[int, ...] = ()
    errors: SceneErrors | None = None

    def errors_of(self, labels: Sequence[int]) -> SceneErrors | None:
        """Return the errors of these patches, in this order; None if one of them has none."""
        if self.errors is None or not set(labels) <= set(self.judged):
            return None
        return self.errors.of(np.array([self.judged.index(label) for label in labels], np.intp))


@dataclass(frozen=True)
class MatchedPatch:
    """A patch that several scans show; `features` [n, 4 * scans] of the spots that all of them show."""

    label: int
    truth: str | None
    features: Real


def pack_patches(found: MaterialsResult, x_m: npt.ArrayLike, y_m: npt.ArrayLike, simulated: bool) -> bytes:
    """Return the content of `patches.npz`."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    rows, places, features = [], [np.zeros((0, 2))], [np.zeros((0, 4))]
    for r in found.patches:
        at = r.patch.interior
        iy, ix = np.nonzero(at)
        places.append(np.stack([x[ix], y[iy]], axis=1))
        features.append(features_of(found.h[at], found.v[at], found.p[at]))
        truth = r.truth.name if r.truth else None
        rows.append({"label": r.patch.label, "centre_mm": r.patch.centre_mm, "truth": truth, "pixels": int(ix.size)})
    angle = float(np.degrees(np.mean(found.theta_rad)))
    meta = {"format": FORMAT, "angle_deg": angle, "simulated": simulated, "patches": rows}
    budget: dict[str, Any] = {}
    if found.errors is not None:
        meta["judged"], errors = found.errors
        budget = {f"errors_{name}": getattr(errors, name) for name in _ERROR_ARRAYS}
    out = io.BytesIO()
    np.savez_compressed(
        out,
        meta=np.frombuffer(json.dumps(meta).encode("utf-8"), np.uint8),
        places_mm=np.concatenate(places).astype(np.float32),
        features=np.concatenate(features).astype(np.float32),
        **budget,
    )
    return out.getvalue()


def read_patches(path: Path) -> ScanPatches:
    """Read `patches.npz` (no pickle). Raises DataError."""
    try:
        with open_npz(path) as z:
            meta = json.loads(z["meta"].tobytes().decode("utf-8"))
            places, features = z["places_mm"].astype(np.float64), z["features"].astype(np.float64)
            budget = [z[f"errors_{name}"].astype(np.float64) for name in _ERROR_ARRAYS] if "judged" in meta else []
        if meta["format"] != FORMAT:
            raise ValueError(f"its format is {meta['format']!r}, this program reads {FORMAT!r}")
        ends = np.cumsum([0, *(int(r["pixels"]) for r in meta["patches"])])
        if features.shape != (ends[-1], 4) or places.shape != (ends[-1], 2):
            raise ValueError(f"arrays {places.shape}, {features.shape} for {ends[-1]} pixels")
        patches = tuple(
            _read_patch(r, places[a:b], features[a:b]) for r, a, b in zip(meta["patches"], ends, ends[1:], strict=False)
        )
        judged = tuple(int(label) for label in meta.get("judged", ()))
        errors = SceneErrors(*budget) if budget else None
        if errors is not None and (len(errors.own), len(errors.design)) != (len(judged), len(judged)):
            raise ValueError(f"an error budget of {len(errors.own)} patches for {len(judged)}")
        return ScanPatches(float(meta["angle_deg"]), bool(meta["simulated"]), patches, judged, errors)
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: the patches cannot be read: {type(e).__name__}: {e}",
            "it is damaged, or of another version", "process the scan again", code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def _read_patch(row: Mapping[str, Any], places: Real, features: Real) -> ScanPatch:
    x, y = row["centre_mm"]
    return ScanPatch(int(str(row["label"])), (float(x), float(y)), row["truth"], places, features)


def match_patches(scans: Sequence[ScanPatches]) -> list[MatchedPatch]:
    """Return the patches that all scans show at the same place, pixel by pixel.

    Two patches match if their centres are each other's nearest. Pixels match by their position in the patch, so that
    the scans' image centres may differ by up to half a patch.
    """
    out = []
    for patch in scans[0].patches:
        partners = [p for other in scans[1:] if (p := _partner(patch, scans[0], other)) is not None]
        if len(partners) < len(scans) - 1:
            continue
        places = patch.places_mm - patch.centre_mm
        columns, kept = [patch.features], np.ones(len(places), bool)
        for partner in partners:
            theirs = partner.places_mm - partner.centre_mm
            far, at = scipy.spatial.KDTree(theirs).query(places) if len(theirs) else (np.full(len(places), np.inf), 0)
            kept &= far <= NEAR_MM
            columns.append(partner.features[np.minimum(at, len(theirs) - 1)] if len(theirs) else columns[0])
        out.append(MatchedPatch(patch.label, patch.truth, np.hstack(columns)[kept]))
    return out


def _partner(patch: ScanPatch, here: ScanPatches, there: ScanPatches) -> ScanPatch | None:
    def nearest(to: ScanPatch, among: ScanPatches) -> ScanPatch | None:
        def apart(p: ScanPatch) -> float:
            return float(np.hypot(p.centre_mm[0] - to.centre_mm[0], p.centre_mm[1] - to.centre_mm[1]))

        best = min(among.patches, key=apart, default=None)
        return best if best is not None and apart(best) <= APART_MM else None

    found = nearest(patch, there)
    return found if found is not None and nearest(found, here) is patch else None
