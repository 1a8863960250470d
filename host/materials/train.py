"""Making a reference library from processed scans whose plates are known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from polysight.host.materials.analyse import MaterialsResult
from polysight.host.materials.fit import fit_library
from polysight.host.materials.library import Entry, Library
from polysight.shared.errors import DataError


@dataclass(frozen=True)
class TrainingScan:
    """One processed scan for the library.

    Attributes
    ----------
    scan
        Its name: pixels of one scan never test what they trained.
    result
        Output of :func:`polysight.host.materials.analyse`, made with the truth's plates.
    simulated
        Whether it was simulated.
    seed
        Of the simulated placement, where it has one.
    versions
        Versions of what made it.
    names
        Names of patches by label, when drawn by hand instead of matched to a truth.
    """

    scan: str
    result: MaterialsResult
    simulated: bool
    seed: int | None = None
    versions: Mapping[str, str] | None = None
    names: Mapping[int, str] | None = None


def entries_of(scan: TrainingScan, pixels_per_patch: int = 16) -> list[Entry]:
    """Library entries of one scan: each patch whose material is known, with up to so many pixels of its interior.

    Pixels are taken at even intervals over the interior, so that the same scan always gives the same entries.
    """
    out = []
    r = scan.result
    for patch in r.patches:
        name = (scan.names or {}).get(patch.patch.label) or (patch.truth.name if patch.truth else None)
        rows, cols = np.nonzero(patch.patch.interior & np.isfinite(r.p) & (r.p != 0))
        if name is None or rows.size == 0:
            continue
        pick = np.unique(np.linspace(0, rows.size - 1, min(pixels_per_patch, rows.size)).round().astype(int))
        at = (rows[pick], cols[pick])
        eps = patch.truth.permittivity if patch.truth else None
        theta = r.theta_rad[at] if r.theta_rad.ndim else r.theta_rad
        out.append(
            Entry(
                name=name,
                scan=scan.scan,
                h=np.abs(r.h[at]).astype(np.float32),
                v=np.abs(r.v[at]).astype(np.float32),
                p=r.p[at].astype(np.complex64),
                incidence_deg=float(np.degrees(np.mean(theta))),
                simulated=scan.simulated,
                seed=scan.seed,
                thickness_mm=patch.truth.thickness_mm if patch.truth else None,
                permittivity=None if eps is None else (eps.real, -eps.imag),
                versions=dict(scan.versions or {}),
            )
        )
    return out


def make_library(scans: Iterable[TrainingScan], note: str = "", pixels_per_patch: int = 16) -> Library:
    """A library of several scans, with the classifier's weights fitted on it (whole scans left out).

    Raises
    ------
    DataError
        when no scan holds a patch of known material, or fewer than two scans do.
    """
    entries = [e for scan in scans for e in entries_of(scan, pixels_per_patch)]
    if not entries:
        raise DataError(
            "no patch of known material in these scans",
            "they have no truth.json or labels, or no patch matches them by position",
            "give scans with truth.json, or label files",
        )
    return fit_library(Library(tuple(entries), {}, note))
