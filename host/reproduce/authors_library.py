"""`polysight train --authors`: the published data set as a library that scans can be classified with."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.materials import Entry, Library, fit_library
from polysight.host.polarimetry import correct_leakage
from polysight.host.reproduce.authors_data import IMAGES, AuthorsData, read_authors
from polysight.shared.errors import DataError

PIXELS = 16
"""Of a patch, at even intervals: as in a library that is trained here."""


def train_authors(folder: Path, config: Path, out: Path) -> int:
    """Make a library from `materials/` and `labels/`, fitted for each incidence angle; returns the exit status.

    Raises
    ------
    DataError
        when nothing can be used, or no angle has scans enough to choose a model with.
    """
    data = read_authors(folder, config)
    for notice in data.notices:
        sys.stderr.write(f"note: {notice}\n")
    library = authors_library(data)
    fits: dict[str, Any] = {}
    fitted: list[Entry] = []
    for angle in library.angles_deg:
        own = library.at(angle)
        try:
            fits |= fit_library(own).fit["angles"]
            fitted += own.entries
        except DataError as e:
            sys.stderr.write(f"note: {angle:g} degrees left out: {e.what}\n")
    if not fitted:
        raise DataError(
            f"{folder}: no angle has scans enough", "models are chosen with whole scans left out", "add more scans"
        )
    library = Library(tuple(fitted), {"angles": fits}, library.note)
    library.save(out)
    told = {a: {k: f[k] for k in ("model", "pixel_accuracy", "patch_accuracy")} for a, f in fits.items()}
    sys.stdout.write(
        f"{out}: {len(library.entries)} patches of {len(library.names)} materials from {len(library.scans)} scans\n"
        f"{json.dumps(told, indent=1)}\n"
    )
    return 0


def authors_library(data: AuthorsData) -> Library:
    """Patches of all sources but images made here, without leakage; one that two sources hold counts once."""
    a, b = complex(*data.base.polarimetry.leakage_h), complex(*data.base.polarimetry.leakage_v)
    kept: dict[tuple[str, str, int], list[Entry]] = {}
    for source, library in data.sources.items():
        if source == IMAGES:
            continue
        found: dict[tuple[str, str, int], list[Entry]] = {}
        for e in library.entries:
            found.setdefault((e.name, e.scan, round(e.incidence_deg)), []).append(_without_leakage(e, a, b))
        kept = {**kept, **found}
    entries = tuple(e for group in kept.values() for e in group)
    return Library(entries, {}, f"{'simulated files' if data.simulated else 'files'} of {data.folder.name}")


def _without_leakage(entry: Entry, leak_hv: complex, leak_vh: complex) -> Entry:
    """An entry's pixels without cross-polar leakage, at most `PIXELS` of them."""
    at = np.unique(np.linspace(0, entry.p.size - 1, min(PIXELS, entry.p.size)).round().astype(int))
    v = entry.v[at].astype(np.complex128)  # the phase that H and V have in common does not matter
    h, v = correct_leakage(entry.p[at] * v, v, leak_hv, leak_vh)
    return replace(
        entry,
        h=np.abs(h).astype(np.float32),
        v=np.abs(v).astype(np.float32),
        p=(h / v).astype(np.complex64),
    )
