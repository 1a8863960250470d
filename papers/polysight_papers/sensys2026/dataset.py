"""The POLySIGHT paper's data set as libraries: its `materials/`, `labels/`, and our own images of its raw data.

Each source is judged separately. Materials get the names of Table 2's rows, if `find_row` finds a row for their names.
`train_authors` makes one library of the first two sources for `polysight train`.
"""

import re
import sys
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from polysight import materials
from polysight.jobs.output import print_lines
from polysight.polarimetry import correct_leakage
from polysight.store import COLLECTION, build_rig, open_npz, read_settings
from polysight_papers.sensys2026.item import Published, table2
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import read_json
from polysight_shared.geometry import incidence_deg

T = TypeVar("T")
SAME_ANGLE_DEG = 2.5
"""Largest difference of a scan's incidence angle from the paper's angles, 55 and 60 degrees."""
MATERIALS = "materials/"
LABELS = "labels/"
IMAGES = "images made here"
# Least correlation of two images of one scan; chosen.
_ALIKE = 0.35

# Words that do not distinguish materials.
_FILLING = {"with", "w", "in", "on", "mm", "percent", "sample", "sheet", "plate", "the", "of", "box", "container"}
# Other spellings and words, in the data set's names and in Table 2's, to the one that is compared.
_ALIASES = {"fibre": "fiber", "fiberglass": "fiber glass", "plywood": "wood", "soya": "soy", "salts": "salt"}
# A row's name may hold the container of a liquid, which their name need not have.
_CONTAINERS = {"glass", "plastic"}
# Least share of common words of two names of one material; chosen.
_ENOUGH = 0.5

PIXELS = 16
"""Largest number of pixels of a patch, at even intervals, as in our own libraries."""


@dataclass(frozen=True)
class AuthorsData:
    """The data set that was read.

    Attributes
    ----------
    folder, base
        Folder of the data set, and the rig file for values that it lacks.
    sources
        `materials/`, `labels/`, `images made here` to a library with the names of Table 2; without empty ones.
    meaning
        Their names, with the thickness where it is known, to the rows of Table 2.
    notices
        Skipped files and names, and assumptions.
    """

    folder: Path
    base: Instrument
    sources: dict[str, materials.Library]
    meaning: dict[str, int]
    notices: tuple[str, ...]

    @property
    def simulated(self) -> bool:
        """True if any of it was simulated."""
        return any(library.simulated for library in self.sources.values())

    def select(self, source: str, numbers: range, angle_deg: float) -> materials.Library:
        """Return the entries of a source for these rows of Table 2, under about this angle."""
        names = {m.name for m in table2() if m.number in numbers}
        library = self.sources[source]
        near = (e for e in library.entries if abs(e.incidence_deg - angle_deg) <= SAME_ANGLE_DEG)
        return materials.Library(tuple(e for e in near if e.name in names), fit={}, note=library.note)


def read_authors(folder: Path, config: Path, images: Path | None = None, names: Path | None = None) -> AuthorsData:
    """Read a data set.

    Parameters
    ----------
    folder
        Holds `materials/`, `labels/`, or both; `unsynced/` or `raw/` in the same folder give the labelled scans'
        angles.
    config
        Rig file, for what the files do not contain.
    images
        Folder with what `polysight process` made of its scans, `<scan>/image.npz`.
    names
        JSON file that says which row of Table 2 a name means.

    Raises
    ------
    DataError
        when the folder is missing, the file of names is not valid, or nothing can be used.
    """
    if not folder.is_dir():
        raise DataError(
            f"{folder}: no such folder",
            "the path is wrong",
            "give the folder with materials/",
            code=ErrorCode.FILE_MISSING,
        )
    base = load_instrument(config)
    notices = []
    entries_by_source = {}
    if pickles := sorted((folder / "materials").glob("*.pkl")):
        entries_by_source[MATERIALS] = _read_all(materials.read_material, pickles, notices)
    scans = _read_all(materials.read_labelled_scan, materials.label_folders(folder / "labels"), notices)
    if scans:
        orientation = materials.image_orientation(scans)
        notices.append(
            f"boxes of labels/ are read with {orientation}: with this orientation they explain the "
            "images' brightness best"
        )
        turned = [s.orient(orientation) for s in scans]
        angles = {s.scan: _find_angle(folder, s, base, notices) for s in scans}
        entries_by_source[LABELS] = _make_entries(turned, angles, notices)
        if images is not None:
            ours = [s for scan in turned if (s := _image_here(scan, images, notices)) is not None]
            entries_by_source[IMAGES] = _make_entries(ours, angles, notices)
    elif images is not None:
        notices.append("images made here are left out: labels/ holds no boxes to look at them with")
    renames = {}
    if names:
        renames = read_names(names)
    filled_sources = {source: entries for source, entries in entries_by_source.items() if entries}
    meaning, sources = _rename_entries(filled_sources, renames, notices)
    if not sources:
        raise DataError(
            f"{folder}: neither materials/*.pkl nor labels/<scan> with a known material is in it",
            "; ".join(notices) or "the download is not complete, or this is another folder",
            "give the folder of the published data set; `polysight reproduce --out DIR --authors DATA --names FILE`"
            " says what its names mean",
        )
    return AuthorsData(folder, base, sources, meaning, tuple(dict.fromkeys(notices)))


def _read_all(read: Callable[[Path], T], paths: Sequence[Path], notices: list[str]) -> list[T]:
    """Read the files at these paths; damaged or refused files are listed in the notices and skipped."""
    out = []
    for path in paths:
        try:
            out.append(read(path))
        except DataError as e:
            notice = f"left out: {e.what}"
            if e.why:
                notice += f" ({e.why})"
            notices.append(notice)
    return out


def _make_entries(
    scans: list[materials.LabelledScan], angles: Mapping[str, float], notices: list[str]
) -> list[materials.Entry]:
    """Return the library entries of the labelled boxes; scans that are refused are listed in the notices.

    `angles` has the incidence angle of each scan by its name.
    """
    entries = []
    for scan in scans:
        try:
            entries += materials.make_entries_of_boxes(scan, angles[scan.scan])
        except DataError as e:
            notices.append(f"left out: {e.what}")
    return entries


def _find_angle(folder: Path, scan: materials.LabelledScan, base: Instrument, notices: list[str]) -> float:
    """Return the incidence angle of a labelled scan: from its raw data, else from its text, else the rig's."""
    for form in ("unsynced", "raw"):
        path = folder / form / scan.scan
        if (path / COLLECTION).exists():
            rig, notices_of_rig = build_rig(read_settings(path), base, path)
            notices += notices_of_rig
            return incidence_deg(rig, rig.receivers[0])
    if (angle := materials.find_angle_in_text([scan.description, scan.scan])) is not None:
        return angle
    angle = incidence_deg(base, base.receivers[0])
    notices.append(f"{scan.scan}: no file has its incidence angle; that of the rig file is used, {angle:.1f} degrees")
    return angle


def _image_here(scan: materials.LabelledScan, images: Path, notices: list[str]) -> materials.LabelledScan | None:
    """Return the scan's boxes with our own images, in the orientation of the authors' images.

    None, with a notice, if there are no images, or none that show the same.
    """
    file = images / scan.scan / "image.npz"
    try:
        with open_npz(file) as z:
            h = z["h"]
            v = z["v"]
            valid = z["valid"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, DataError) as e:
        notices.append(f"{scan.scan}: no image made here: {e}")
        return None
    imaged_mask = valid & np.isfinite(h) & np.isfinite(v)
    h = np.where(imaged_mask, h, 0)
    v = np.where(imaged_mask, v, 0)
    theirs = np.abs(scan.h)
    # Rotations by k x 90 degrees, each also after a flip along y.
    ways = [(k, flip) for k in range(4) for flip in (False, True)]

    def turn(image: np.ndarray, way: tuple[int, bool]) -> np.ndarray:
        return np.rot90(image[::-1] if way[1] else image, way[0])

    correlations = {w: _correlate(np.abs(turn(h, w)), theirs) for w in ways if turn(h, w).shape == theirs.shape}
    best = max(correlations, key=lambda w: correlations[w], default=None)
    # So written, NaN is refused, too.
    if best is None or not correlations[best] >= _ALIKE:
        notices.append(f"{scan.scan}: the image made here does not show what sar_h.npy shows; left out")
        return None
    return replace(scan, h=turn(h, best), v=turn(v, best))


def _correlate(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation coefficient of two images of one shape; 0 if one of them is constant."""
    a = a - a.mean()
    b = b - b.mean()
    return float((a * b).sum() / max(float(np.sqrt((a**2).sum() * (b**2).sum())), 1e-30))


def _rename_entries(
    entries_by_source: Mapping[str, list[materials.Entry]], given: Mapping[str, int], notices: list[str]
) -> tuple[dict[str, int], dict[str, materials.Library]]:
    """Rename the entries as in Table 2; entries of unknown names are skipped and listed in the notices.

    Returns the row of each name (`AuthorsData.meaning`), and a library of the renamed entries for each source.
    """
    rows = find_rows(((e.name, e.thickness_mm) for entries in entries_by_source.values() for e in entries), given)
    titles = {m.number: m.name for m in table2()}
    sources = {}
    unknown = set()
    for source, entries in entries_by_source.items():
        renamed_entries = []
        for e in entries:
            number = rows.get((e.name, e.thickness_mm))
            if number is None:
                unknown.add(e.name)
            else:
                renamed_entries.append(replace(e, name=titles[number]))
        if renamed_entries:
            sources[source] = materials.Library(tuple(renamed_entries), fit={}, note=source)
    if unknown:
        skipped = ", ".join(sorted(unknown))
        notices.append(
            f"not judged, names without a row of Table 2: {skipped}; `polysight reproduce --out DIR --authors DATA"
            " --names FILE` says what they mean"
        )
    meaning = {f"{n}, {t:g} mm" if t else n: number for (n, t), number in rows.items()}
    return dict(sorted(meaning.items())), sources


def words(name: str) -> frozenset[str]:
    """Return words and numbers of a name, in lower case; "metal" for metals."""
    # "w/ ", "\w/ " and "w " mean "with".
    text = re.sub(r"\\?\bw/?\s", " with ", name.lower().replace("_", " "))
    out: list[str] = []
    for word in re.findall(r"[a-z]+|\d+(?:\.\d+)?", text):
        if word in _FILLING:
            continue
        if word[0].isdigit():
            # "pet_05mm" is 0.5 mm thick.
            if re.fullmatch(r"0\d+", word):
                number = f"0.{word[1:]}"
            else:
                number = word
            out.append(f"{float(number):g}")
        else:
            if word in materials.METAL_WORDS:
                out += ["metal"]
            else:
                out += str(_ALIASES.get(word, word)).split()
    return frozenset(out)


def _share_of_common_words(theirs: frozenset[str], row: Published) -> float:
    """Return the share of common words and numbers; the container of a row is optional."""
    ours = words(row.name)
    if " with " in row.name or "(with" in row.name:
        optional = ours & _CONTAINERS
    else:
        optional = frozenset()
    union = (ours | theirs) - (optional - theirs)
    if not union:
        return 0.0
    return len(ours & theirs) / len(union)


def find_row(name: str, thickness_mm: float | None = None) -> int | None:
    """Return the number of the row of Table 2 for a name (1 for metals); None if none fits, or two fit equally well."""
    theirs = words(name)
    if "metal" in theirs:
        return 1
    tries = [theirs]
    if thickness_mm is not None:
        tries.insert(0, theirs | {f"{thickness_mm:g}"})
    ranked = sorted(
        ((max(_share_of_common_words(t, row) for t in tries), row.number) for row in table2()), key=lambda r: -r[0]
    )
    (best, number), (second_best, _) = ranked[:2]
    if best >= _ENOUGH and best > second_best:
        return number
    return None


def read_names(path: Path) -> dict[str, int]:
    """Read a file of names: JSON, {name: row of Table 2}. Raises DataError."""
    try:
        content = read_json(path)
        numbers = {str(name): int(number) for name, number in content.items()}
    except (OSError, ValueError, AttributeError, TypeError) as e:
        raise DataError(
            f"{path}: not a list of names: {e}",
            'expected JSON, {"their name": row of Table 2}',
            "correct the file",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None
    wrong = [n for n in numbers.values() if not 1 <= n <= len(table2())]
    if wrong:
        raise DataError(
            f"{path}: Table 2 has no row {wrong[0]}", f"its rows are 1 to {len(table2())}", "correct the number",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return numbers


def find_rows(
    names: Iterable[tuple[str, float | None]], given: Mapping[str, int] | None = None
) -> dict[tuple[str, float | None], int]:
    """Return the rows of names with their thicknesses; names without a row are skipped."""
    rows = {(n, t): (given or {}).get(n) or find_row(n, t) for n, t in set(names)}
    return {key: number for key, number in rows.items() if number is not None}


def train_authors(folder: Path, config: Path, out: Path) -> int:
    """Make a library from `materials/` and `labels/`, fitted for each incidence angle; returns the exit status.

    Raises
    ------
    DataError
        when nothing can be used, or no angle has scans enough to judge a model on.
    """
    data = read_authors(folder, config)
    for notice in data.notices:
        sys.stderr.write(f"note: {notice}\n")
    library = authors_library(data)
    fits: dict[str, Any] = {}
    fitted: list[materials.Entry] = []
    for angle in library.angles_deg:
        library_at_angle = library.at_angle(angle)
        try:
            fits |= materials.fit_library(library_at_angle).fit["angles"]
            fitted += library_at_angle.entries
        except DataError as e:
            sys.stderr.write(f"note: {angle:g} degrees left out: {e.what}\n")
    if not fitted:
        raise DataError(
            f"{folder}: no angle has scans enough", "a library is judged with whole scans left out", "add more scans"
        )
    library = materials.Library(tuple(fitted), {"angles": fits}, library.note)
    library.save(out)
    head = f"{out}: {len(library.entries)} patches of {len(library.names)} materials from {len(library.scans)} scans"
    print_lines([head, *materials.describe_accuracy(library)])
    return 0


def authors_library(data: AuthorsData) -> materials.Library:
    """Return the patches of all sources except our own images, without leakage and without duplicates."""
    # From V into H, and from H into V.
    leak_hv = complex(*data.base.polarimetry.leakage_h)
    leak_vh = complex(*data.base.polarimetry.leakage_v)
    merged: dict[tuple[str, str, int], list[materials.Entry]] = {}
    for source, library in data.sources.items():
        if source == IMAGES:
            continue
        entries_of_source: dict[tuple[str, str, int], list[materials.Entry]] = {}
        for e in library.entries:
            entries_of_source.setdefault((e.name, e.scan, round(e.incidence_deg)), []).append(
                _remove_leakage(e, leak_hv, leak_vh)
            )
        # The same patches may be in both folders: those of the later source count.
        merged = {**merged, **entries_of_source}
    entries = tuple(e for group in merged.values() for e in group)
    kind = "files"
    if data.simulated:
        kind = "simulated files"
    return materials.Library(entries, fit={}, note=f"{kind} of {data.folder.name}")


def _remove_leakage(entry: materials.Entry, leak_hv: complex, leak_vh: complex) -> materials.Entry:
    """Return an entry with at most `PIXELS` pixels, with the cross-polar leakage removed."""
    picked = np.unique(np.linspace(0, entry.p.size - 1, min(PIXELS, entry.p.size)).round().astype(int))
    # Entries hold |H|, |V| and P = H / V: the phase that H and V have in common is lost, and has no effect.
    v = entry.v[picked].astype(np.complex128)
    h, v = correct_leakage(entry.p[picked] * v, v, leak_hv, leak_vh)
    return replace(
        entry,
        h=np.abs(h).astype(np.float32),
        v=np.abs(v).astype(np.float32),
        p=(h / v).astype(np.complex64),
    )
