"""Write and read `patches.npz`, and find the patches that several scans have in common.

The file holds, for each patch of a scan, the features of its pixels, and the evidence from which the patch is named:
its ratio t = V / H relative to metal, with errors (`RatioEvidence`). It is the input of `polysight classify`, which
names a patch that several scans show from all of them. `match_patches` finds these patches by their places.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.kinds import PatchDispersion, RatioCase, RatioEvidence, split_complex
from polysight.materials.library import Real
from polysight.materials.result import MaterialsResult, pixel_features
from polysight.materials.segment import axis_mm
from polysight.store import open_npz
from polysight_shared.errors import DataError, ErrorCode

PATCHES_FILE = "patches.npz"
"""Name of the file in a scan's products."""
PATCHES_FORMAT = "polysight-patches-1"
"""Name of the file's format; files of other formats are refused."""
SAME_PATCH_MM = 20.0
"""Largest distance between the centres of one patch in two scans. Chosen: less than half the distance between the
centres of neighbouring plates."""
NEAR_MM = 4.0
"""Largest distance between pixels of two scans that show the same spot: about the resolution."""
# Numbers in a row of the array of dispersions, and in each of the two rows of the array of cases.
_DISPERSION_NUMBERS = 8
_CASE_NUMBERS = 7


@dataclass(frozen=True)
class ScanPatch:
    """A patch in one scan, with the n pixels of its interior. Places are (x, y), millimetres from the image centre.

    `centre_mm` is the middle of its box, `truth` its true material (None: not known). `places_mm` float64 [n, 2] are
    the places of the pixels, `features` float64 [n, 4] their features after the Gaussian filter (`pixel_features`).
    """

    label: int
    centre_mm: tuple[float, float]
    truth: str | None
    places_mm: Real
    features: Real


@dataclass(frozen=True)
class ScanPatches:
    """The patches of one scan.

    `angle_deg` is the mean incidence angle over the image. `simulated` is true if the scan was simulated. `evidence` is
    patch number to the evidence for its name; it is empty in files of earlier releases.
    """

    angle_deg: float
    simulated: bool
    patches: tuple[ScanPatch, ...]
    evidence: Mapping[int, RatioEvidence] = field(default_factory=dict)


@dataclass(frozen=True)
class MatchedPatch:
    """A patch that several scans show.

    Attributes
    ----------
    label, truth
        Number in the first scan, and true material; None if it is not known.
    features
        float64 [n, 4 * scans]: features of the spots that all scans show, those of the first scan first.
    evidence
        Evidence of each scan for the patch's name; None if a scan has none.
    """

    label: int
    truth: str | None
    features: Real
    evidence: tuple[RatioEvidence, ...] | None = None


def pack_patches(result: MaterialsResult, x_m: npt.ArrayLike, y_m: npt.ArrayLike, simulated: bool) -> bytes:
    """Return the content of `patches.npz`; `x_m`, `y_m` are the image's axes."""
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    rows = []
    places = [np.zeros((0, 2))]
    features = [np.zeros((0, 4))]
    for patch_result in result.patches:
        pixels = patch_result.patch.interior
        row, column = np.nonzero(pixels)
        places.append(np.stack([x[column], y[row]], axis=1))
        features.append(pixel_features(result.h[pixels], result.v[pixels], result.p[pixels]))
        truth = patch_result.truth.name if patch_result.truth else None
        rows.append(
            {
                "label": patch_result.patch.label,
                "centre_mm": patch_result.patch.centre_mm,
                "truth": truth,
                "pixels": int(column.size),
            }
        )
    meta = {
        "format": PATCHES_FORMAT,
        "angle_deg": float(np.degrees(np.mean(result.theta_rad))),
        "simulated": simulated,
        "patches": rows,
        # Numbers of the patches with evidence: the first axis of the arrays "evidence_...".
        "judged": list(result.evidence),
    }
    evidence = result.evidence.values()
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        meta=np.frombuffer(json.dumps(meta).encode("utf-8"), np.uint8),
        places_mm=np.concatenate(places).astype(np.float32),
        features=np.concatenate(features).astype(np.float32),
        evidence_theta_rad=np.array([e.theta_rad for e in evidence], np.float64),
        # The file's name is shorter than the field's: both are 1 / P, the ratio V / H.
        evidence_ratio=np.array([e.inverse_ratio for e in evidence], np.complex128),
        evidence_covariance=np.array([e.covariance for e in evidence], np.float64).reshape(-1, 2, 2),
        evidence_share=np.array([e.library_share for e in evidence], np.float64),
        evidence_brightness=np.reshape([[e.brightness_off, e.brightness_std] for e in evidence], (-1, 2)),
        evidence_dispersion=np.reshape([_pack_dispersion(e.dispersion) for e in evidence], (-1, _DISPERSION_NUMBERS)),
        evidence_cases=np.reshape([_pack_cases(e.cases) for e in evidence], (-1, 2, _CASE_NUMBERS)),
    )
    return buffer.getvalue()


def _pack_dispersion(dispersion: PatchDispersion | None) -> Real:
    """Return three changes, their standard deviations, and the band in Hz, float64 [8]; all NaN for None."""
    if dispersion is None:
        return np.full(_DISPERSION_NUMBERS, np.nan)
    return np.concatenate([dispersion.change, dispersion.std, dispersion.band_hz])


def _unpack_dispersion(row: Real) -> PatchDispersion | None:
    """Return the dispersion of a row of :func:`_pack_dispersion`; None if a number is not finite."""
    if not np.isfinite(row).all():
        return None
    return PatchDispersion(row[:3], row[3:6], (float(row[6]), float(row[7])))


def _pack_cases(cases: Sequence[RatioCase]) -> Real:
    """Return the two cases (metal painted, metal bare), float64 [2, 7]; all NaN for no cases.

    A row holds the probability, real and imaginary part of t = V / H, and the four numbers of their covariance.
    """
    rows = [[case.probability, *split_complex(case.inverse_ratio), *case.covariance.flat] for case in cases]
    return np.array(rows) if rows else np.full((2, _CASE_NUMBERS), np.nan)


def _unpack_cases(rows: Real) -> tuple[RatioCase, ...]:
    """Return the cases of rows of :func:`_pack_cases`; none if the rows are NaN.

    Raises ValueError for rows of another shape, or probabilities that are not positive or whose sum is not 1.
    """
    known_rows = [row for row in rows.reshape(2, _CASE_NUMBERS) if np.isfinite(row).all()]
    probabilities = [row[0] for row in known_rows]
    if known_rows and not (min(probabilities) > 0 and np.isclose(sum(probabilities), 1)):
        raise ValueError("the probabilities of the cases of a patch are not positive, or their sum is not 1")
    return tuple(RatioCase(float(row[0]), complex(*row[1:3]), row[3:].reshape(2, 2)) for row in known_rows)


def read_patches(path: Path) -> ScanPatches:
    """Read `patches.npz` (no pickle). Raises DataError."""
    try:
        with open_npz(path) as z:
            meta = json.loads(z["meta"].tobytes().decode("utf-8"))
            places = z["places_mm"].astype(np.float64)
            features = z["features"].astype(np.float64)
            evidence = _read_evidence(z, meta["judged"]) if "evidence_ratio" in z else {}
        if meta["format"] != PATCHES_FORMAT:
            raise ValueError(f"its format is {meta['format']!r}, this program reads {PATCHES_FORMAT!r}")
        ends = np.cumsum([0, *(int(r["pixels"]) for r in meta["patches"])])
        if features.shape != (ends[-1], 4) or places.shape != (ends[-1], 2):
            raise ValueError(f"arrays {places.shape}, {features.shape} for {ends[-1]} pixels")
        if not np.isfinite(places).all():
            raise ValueError("positions of pixels are not finite")
        patches = tuple(
            _read_patch(r, places[a:b], features[a:b]) for r, a, b in zip(meta["patches"], ends, ends[1:], strict=False)
        )
        return ScanPatches(float(meta["angle_deg"]), bool(meta["simulated"]), patches, evidence)
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: the patches cannot be read: {type(e).__name__}: {e}",
            "it is damaged, or of another version", "process the scan again", code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def _read_evidence(arrays: Mapping[str, npt.NDArray], labels: Sequence[int]) -> dict[int, RatioEvidence]:
    """Return the evidence of the patches with these numbers. Raises ValueError if the arrays do not fit."""
    # Files of earlier releases hold neither brightness nor dispersion nor cases.
    brightness = arrays.get("evidence_brightness", np.full((len(labels), 2), np.nan))
    dispersions = arrays.get("evidence_dispersion", np.full((len(labels), _DISPERSION_NUMBERS), np.nan))
    cases = arrays.get("evidence_cases", np.full((len(labels), 2, _CASE_NUMBERS), np.nan))
    columns = [
        arrays["evidence_theta_rad"],
        arrays["evidence_ratio"],
        arrays["evidence_covariance"],
        arrays["evidence_share"],
        brightness,
        [_unpack_dispersion(numbers) for numbers in dispersions],
        [_unpack_cases(numbers) for numbers in cases],
    ]
    rows = [
        RatioEvidence(
            theta_rad=float(angle), inverse_ratio=complex(ratio), covariance=covariance, library_share=float(share),
            brightness_off=float(off), brightness_std=float(std), dispersion=dispersion, cases=both_cases,
        )
        for angle, ratio, covariance, share, (off, std), dispersion, both_cases in zip(*columns, strict=True)
    ]  # fmt: skip
    if any(row.covariance.shape != (2, 2) for row in rows):
        raise ValueError("covariances are not [patch, 2, 2]")
    return dict(zip(map(int, labels), rows, strict=True))


def _read_patch(row: Mapping[str, Any], places: Real, features: Real) -> ScanPatch:
    """Return a patch of the file. Raises KeyError, TypeError or ValueError if its row is damaged."""
    x, y = row["centre_mm"]
    # The number is converted from its text, so that one with a fraction raises ValueError: int(1.5) would be 1.
    label = int(str(row["label"]))
    return ScanPatch(label, (float(x), float(y)), row["truth"], places, features)


def match_patches(scans: Sequence[ScanPatches]) -> list[MatchedPatch]:
    """Return the patches that all scans show at the same place, pixel by pixel.

    Two patches match if their centres are each other's nearest and at most `SAME_PATCH_MM` apart. Pixels are matched by
    their places relative to the centre of their patch, so that the images of two scans may be displaced.
    """
    matched = []
    for patch in scans[0].patches:
        partners = [p for other_scan in scans[1:] if (p := _find_partner(patch, scans[0], other_scan)) is not None]
        if len(partners) < len(scans) - 1:
            continue
        pairs = zip(scans, (patch, *partners), strict=True)
        evidence = tuple(scan.evidence[p.label] for scan, p in pairs if p.label in scan.evidence)
        places = patch.places_mm - patch.centre_mm
        # Features of the first patch's pixels, and of the nearest pixel of each partner, [n, 4] each.
        columns = [patch.features]
        near_enough = np.ones(len(places), bool)
        for partner in partners:
            partner_places = partner.places_mm - partner.centre_mm
            if not len(partner_places):
                # No pixel is in all scans. The features that stand here do not matter, because none of them is kept.
                near_enough[:] = False
                columns.append(patch.features)
                continue
            distance_mm, nearest_index = scipy.spatial.KDTree(partner_places).query(places)
            near_enough &= distance_mm <= NEAR_MM
            # A pixel at no finite distance, which is not near enough, gets an index beyond the last one.
            columns.append(partner.features[np.minimum(nearest_index, len(partner_places) - 1)])
        complete = evidence if len(evidence) == len(scans) else None
        matched.append(MatchedPatch(patch.label, patch.truth, np.hstack(columns)[near_enough], complete))
    return matched


def _find_partner(patch: ScanPatch, own_scan: ScanPatches, other_scan: ScanPatches) -> ScanPatch | None:
    """Return the other scan's patch nearest to this one, if this one is also the nearest to it."""

    def nearest(patch: ScanPatch, among: ScanPatches) -> ScanPatch | None:
        def distance_mm(candidate: ScanPatch) -> float:
            return float(
                np.hypot(candidate.centre_mm[0] - patch.centre_mm[0], candidate.centre_mm[1] - patch.centre_mm[1])
            )

        best = min(among.patches, key=distance_mm, default=None)
        return best if best is not None and distance_mm(best) <= SAME_PATCH_MM else None

    partner = nearest(patch, other_scan)
    if partner is not None and nearest(partner, own_scan) is patch:
        return partner
    return None
