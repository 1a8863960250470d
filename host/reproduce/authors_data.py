"""The published data set as libraries: its `materials/`, its `labels/`, and images made here from its raw data.

Each source is judged on its own. Materials carry the names of Table 2's rows, where their own names mean one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from polysight.host.materials import Entry, Library, table2
from polysight.host.materials.authors import read_material
from polysight.host.materials.authors_labels import (
    LabelledScan,
    entries_of_boxes,
    label_folders,
    read_labelled_scan,
    reading_of,
    told_angle,
)
from polysight.host.reproduce.authors_names import read_names, rows_of
from polysight.host.store.authors_settings import COLLECTION, read_settings, rig_of
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import DataError
from polysight.shared.geometry import incidence_deg

T = TypeVar("T")
SAME_ANGLE_DEG = 2.5
"""The paper's angles, 55 and 60 degrees, are further apart; a scan's own differs from them by less."""
MATERIALS, LABELS, IMAGES = "materials/", "labels/", "images made here"
_ALIKE = 0.35  # correlation of two images of one scan, at least


@dataclass(frozen=True)
class AuthorsData:
    """What was found.

    Attributes
    ----------
    folder, base
        Of the data set, and the rig file for what it does not tell.
    sources
        `materials/`, `labels/`, `images made here` to a library, names as in Table 2; only those that hold anything.
    meaning
        Their names to the rows of Table 2.
    notices
        What was left out, and what had to be assumed.
    """

    folder: Path
    base: Instrument
    sources: dict[str, Library]
    meaning: dict[str, int]
    notices: tuple[str, ...]

    @property
    def simulated(self) -> bool:
        """Whether any of it was simulated."""
        return any(library.simulated for library in self.sources.values())

    def at(self, source: str, numbers: range, angle_deg: float) -> Library:
        """Entries of a source with these rows of Table 2, seen under about this angle."""
        names = {m.name for m in table2() if m.number in numbers}
        library = self.sources[source]
        near = (e for e in library.entries if abs(e.incidence_deg - angle_deg) <= SAME_ANGLE_DEG)
        return Library(tuple(e for e in near if e.name in names), {}, library.note)


def read_authors(folder: Path, config: Path, images: Path | None = None, names: Path | None = None) -> AuthorsData:
    """Read a data set.

    Parameters
    ----------
    folder
        Holds `materials/`, `labels/`, or both; `unsynced/` or `raw/` beside them tell the labelled scans' angles.
    config
        Rig file, for what the files do not tell.
    images
        Folder with what `polysight process` made of its scans, `<scan>/image.npz`.
    names
        JSON file that says which row of Table 2 a name means.

    Raises
    ------
    DataError
        when nothing of it can be used.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder", "the path is wrong", "give the folder that holds materials/")
    base, notices, found = load_instrument(config), [], {}
    if pickles := sorted((folder / "materials").glob("*.pkl")):
        found[MATERIALS] = _readable(read_material, pickles, notices)
    scans = _readable(read_labelled_scan, label_folders(folder / "labels"), notices)
    if scans:
        how = reading_of(scans)
        notices.append(f"boxes of labels/ are read with {how}: so they explain the images' brightness best")
        turned = [s.turned(how) for s in scans]
        angles = {s.scan: _angle(folder, s, base, notices) for s in scans}
        found[LABELS] = _entries(turned, angles, notices)
        if images is not None:
            ours = [s for scan in turned if (s := _imaged_here(scan, images, notices)) is not None]
            found[IMAGES] = _entries(ours, angles, notices)
    elif images is not None:
        notices.append("images made here are left out: labels/ holds no boxes to look at them with")
    meaning, sources = _named({k: e for k, e in found.items() if e}, read_names(names) if names else {}, notices)
    if not sources:
        raise DataError(
            f"{folder}: neither materials/*.pkl nor labels/<scan> with a known material is in it",
            "; ".join(notices) or "the download is not complete, or this is another folder",
            "give the folder of the published data set; `polysight reproduce --names FILE` says what its names mean",
        )
    return AuthorsData(folder, base, sources, meaning, tuple(dict.fromkeys(notices)))


def _readable(read: Callable[[Path], T], paths: Sequence[Path], notices: list[str]) -> list[T]:
    """What can be read of the paths; a file that is damaged or refused is named, and stops no other."""
    out = []
    for path in paths:
        try:
            out.append(read(path))
        except DataError as e:
            notices.append(f"left out: {e.what} ({e.why})" if e.why else f"left out: {e.what}")
    return out


def _entries(scans: list[LabelledScan], angles: Mapping[str, float], notices: list[str]) -> list[Entry]:
    entries = []
    for scan in scans:
        try:
            entries += entries_of_boxes(scan, angles[scan.scan])
        except DataError as e:
            notices.append(f"left out: {e.what}")
    return entries


def _angle(folder: Path, scan: LabelledScan, base: Instrument, notices: list[str]) -> float:
    """Incidence angle of a labelled scan: by the geometry of its raw data, else as its text tells, else the rig's."""
    for form in ("unsynced", "raw"):
        path = folder / form / scan.scan
        if (path / COLLECTION).exists():
            rig, told = rig_of(read_settings(path), base, path)
            notices += told
            return incidence_deg(rig, rig.receivers[0])
    told_here = told_angle([scan.description, scan.scan])
    if told_here is not None:
        return told_here
    angle = incidence_deg(base, base.receivers[0])
    notices.append(f"{scan.scan}: no file tells its incidence angle; the rig file's is taken, {angle:.1f} degrees")
    return angle


def _imaged_here(scan: LabelledScan, images: Path, notices: list[str]) -> LabelledScan | None:
    """The scan's boxes with the images made here, turned so that they lie as the authors' own images do."""
    file = images / scan.scan / "image.npz"
    try:
        with np.load(file, allow_pickle=False) as z:
            h, v, valid = z["h"], z["v"], z["valid"]
    except (OSError, ValueError, KeyError) as e:
        notices.append(f"{scan.scan}: no image made here: {e}")
        return None
    seen = valid & np.isfinite(h) & np.isfinite(v)
    h, v = (np.where(seen, x, 0) for x in (h, v))
    theirs = np.abs(scan.h)
    ways = [(k, flip) for k in range(4) for flip in (False, True)]

    def turn(image: np.ndarray, way: tuple[int, bool]) -> np.ndarray:
        return np.rot90(image[::-1] if way[1] else image, way[0])

    alike = {w: _correlation(np.abs(turn(h, w)), theirs) for w in ways if turn(h, w).shape == theirs.shape}
    best = max(alike, key=lambda w: alike[w], default=None)
    if best is None or not alike[best] >= _ALIKE:
        notices.append(f"{scan.scan}: the image made here does not show what sar_h.npy shows; left out")
        return None
    return replace(scan, h=turn(h, best), v=turn(v, best))


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(float(np.sqrt((a**2).sum() * (b**2).sum())), 1e-30))


def _named(
    found: Mapping[str, list[Entry]], given: Mapping[str, int], notices: list[str]
) -> tuple[dict[str, int], dict[str, Library]]:
    """The entries under Table 2's names; those whose names mean no row are left out and named."""
    rows = rows_of(((e.name, e.thickness_mm) for entries in found.values() for e in entries), given)
    titles = {m.number: m.name for m in table2()}
    sources, unknown = {}, set()
    for source, entries in found.items():
        kept = []
        for e in entries:
            number = rows.get((e.name, e.thickness_mm))
            if number is None:
                unknown.add(e.name)
            else:
                kept.append(replace(e, name=titles[number]))
        if kept:
            sources[source] = Library(tuple(kept), {}, source)
    if unknown:
        told = ", ".join(sorted(unknown))
        notices.append(
            f"not judged, as their names mean no row of Table 2: {told}; `polysight reproduce --names FILE` says what"
            " they mean"
        )
    meaning = {f"{n}, {t:g} mm" if t else n: number for (n, t), number in rows.items()}
    return dict(sorted(meaning.items())), sources
