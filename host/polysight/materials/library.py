"""Labelled pixels: the reference library and its file, samples for classifiers, and the interface of classifiers.

A library's file is an .npz with plain arrays and a JSON text; it is read with `allow_pickle=False`, so that a library
of unknown origin cannot run code. `Samples` holds features, material, scan and patch of each pixel;
`compute_channel_distances` returns the POLySIGHT paper's distances of pixels. A `Model` is fitted to samples and names
pixels; the result for one scan is a `NamedScan`, whose patches are named by `name_by_majority` or by the model itself.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from polysight.store import open_npz
from polysight_shared.errors import DataError, ErrorCode, quote
from polysight_shared.files import write_atomically

FORMAT = "polysight-library-1"
"""Name of the file's format; files of other formats are refused."""
SAME_ANGLE_DEG = 1.0
"""Largest difference of two incidence angles that count as one. |P| changes by some 10 % in a degree."""
SIMULATED_LIBRARY = Path(__file__).with_name("simulated-library.npz")
"""The default library: simulated scans of examples/library."""


@dataclass(frozen=True)
class Entry:
    """One labelled patch.

    Attributes
    ----------
    name
        Material.
    scan
        Scan of the patch: training and test data are split by scan.
    h, v
        float32 [n], |H| and |V| of its pixels relative to metal.
    p
        complex64 [n], metal-referenced ratio H / V.
    incidence_deg
        Angle of incidence.
    simulated
        True if the scan was simulated.
    thickness_mm, permittivity
        Thickness of the sample, true [eps', eps'']; None if not known.
    versions
        Versions of the programs that made it.
    reference
        Name of its reference, if that was not the metal of its own scan.
    specimen
        Name of the physical piece of the material; None if not known.
    """

    name: str
    scan: str
    h: npt.NDArray[np.float32]
    v: npt.NDArray[np.float32]
    p: npt.NDArray[np.complex64]
    incidence_deg: float
    simulated: bool
    thickness_mm: float | None = None
    permittivity: tuple[float, float] | None = None
    versions: dict[str, str] = field(default_factory=dict)
    reference: str | None = None
    specimen: str | None = None


@dataclass(frozen=True)
class Library:
    """Labelled patches, and what was fitted to them.

    Attributes
    ----------
    entries
        The patches.
    fit
        {"angles": {"55": fit of that angle, "55+60": fit of both together}}, each a result of `train.fit_samples`. In
        the library of one angle (`at_angle`) it is the fit itself. Empty if none was fitted.
    note
        A sentence on its origin, for reports; may be empty.
    """

    entries: tuple[Entry, ...]
    fit: dict[str, Any] = field(default_factory=dict)
    note: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Materials, sorted."""
        return tuple(sorted({e.name for e in self.entries}))

    @property
    def scans(self) -> tuple[str, ...]:
        """Scans, sorted."""
        return tuple(sorted({e.scan for e in self.entries}))

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """Incidence angles, rounded to a tenth of a degree; entries within `SAME_ANGLE_DEG` count as one angle."""
        out: list[list[float]] = []
        for angle in sorted(e.incidence_deg for e in self.entries):
            if out and angle - out[-1][0] <= SAME_ANGLE_DEG:
                out[-1].append(angle)
            else:
                out.append([angle])
        return tuple(round(sum(a) / len(a), 1) for a in out)

    def __repr__(self) -> str:
        """Return a short description: the arrays would fill a notebook."""
        angles = ", ".join(f"{angle:g}" for angle in self.angles_deg)
        return f"<Library: {', '.join(self.names)}; {len(self.scans)} scans, {angles} degrees of incidence>"

    def at_angle(self, angle_deg: float) -> Library:
        """Return the entries under an incidence angle, with their fit.

        Raises DataError if there are none: |P| changes by 10 % in a degree, so other angles cannot be used.
        """
        near_angles_deg = [a for a in self.angles_deg if abs(a - angle_deg) <= SAME_ANGLE_DEG]
        if not near_angles_deg:
            raise DataError(
                f"the library has no patch at {angle_deg:.1f} degrees of incidence",
                f"its incidence angles are {', '.join(f'{a:g}' for a in self.angles_deg)} degrees",
                "train a library at this angle, or process without naming: --model none",
                code=ErrorCode.MISMATCH,
            )
        angle = min(near_angles_deg, key=lambda a: abs(a - angle_deg))
        entries_of_angle = tuple(e for e in self.entries if abs(e.incidence_deg - angle) <= SAME_ANGLE_DEG)
        return Library(entries_of_angle, self.fit_for([angle]), self.note)

    def columns(self) -> tuple[Real, npt.NDArray[np.str_], npt.NDArray[np.str_]]:
        """Return X [n, 4] (|H|, |V|, Re P, Im P), the material y [n] and the scan [n] of each pixel."""
        count = [entry.p.size for entry in self.entries]
        parts = [np.stack([e.h, e.v, e.p.real, e.p.imag], axis=1) for e in self.entries]
        names = np.repeat([entry.name for entry in self.entries], count)
        scans = np.repeat([entry.scan for entry in self.entries], count)
        x = np.concatenate(parts).astype(np.float64)
        usable_rows = find_usable_pixels(x)
        return x[usable_rows], names[usable_rows], scans[usable_rows]

    def fit_for(self, angles_deg: Sequence[float]) -> dict[str, Any]:
        """Return the fit (`train.fit_samples`) for an angle, or for several together; empty if there is none."""
        angles = self.fit.get("angles")
        if angles is None:
            return self.fit if len(angles_deg) == 1 else {}
        return dict(angles.get("+".join(f"{a:g}" for a in sorted(angles_deg)), {}))

    @property
    def simulated(self) -> bool:
        """True if any entry was simulated."""
        return any(e.simulated for e in self.entries)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the library; an existing file is replaced once the new one is complete."""
        entries = [
            {k: v for k, v in vars(e).items() if k not in ("h", "v", "p")} | {"pixels": int(e.h.size)}
            for e in self.entries
        ]
        meta = {"format": FORMAT, "note": self.note, "fit": self.fit, "entries": entries}
        text = np.frombuffer(json.dumps(meta, sort_keys=True).encode("utf-8"), np.uint8)
        # A library without entries has arrays, too.
        empty_real = np.zeros(0, np.float32)
        empty_complex = np.zeros(0, np.complex64)
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            h=np.concatenate([empty_real, *(e.h for e in self.entries)]),
            v=np.concatenate([empty_real, *(e.v for e in self.entries)]),
            p=np.concatenate([empty_complex, *(e.p for e in self.entries)]),
            meta=text,
        )
        write_atomically(Path(path), buffer.getvalue())

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Library:
        """Read a library.

        Raises DataError if the file is missing, no library, of another format version, damaged, or has pickled objects.
        """
        path = Path(path)
        problem = f"{path}: not a material library"
        try:
            with open_npz(path) as z:
                meta = json.loads(z["meta"].tobytes().decode("utf-8"))
                h = z["h"]
                v = z["v"]
                p = z["p"]
        except FileNotFoundError:
            raise DataError(
                f"{path}: no such library",
                "none was trained yet, or the path is wrong",
                f"polysight train SCAN... --out {quote(path)}",
                code=ErrorCode.FILE_MISSING,
            ) from None
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
            cause = str(e) if isinstance(e, ValueError) else f"{type(e).__name__}: {e}"
            raise DataError(
                problem,
                cause,
                "give a library of polysight train, or a folder of products",
                code=ErrorCode.FILE_UNREADABLE,
            ) from None
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            file_format = meta.get("format") if isinstance(meta, dict) else None
            raise DataError(
                problem, f"its format is {file_format!r}, this program reads {FORMAT!r}", "train it again",
                code=ErrorCode.VERSION_UNSUPPORTED,
            )  # fmt: skip
        try:
            return Library(_read_entries(meta["entries"], h, v, p), dict(meta["fit"]), str(meta["note"]))
        except (KeyError, TypeError, ValueError) as e:
            raise DataError(
                problem, f"its description does not fit its arrays: {e}", "train it again", code=ErrorCode.FILE_DAMAGED
            ) from None


def _read_entries(rows: list[dict[str, Any]], h: npt.NDArray, v: npt.NDArray, p: npt.NDArray) -> tuple[Entry, ...]:
    """Cut the arrays of all pixels, which are sorted by entry, into entries; `rows` are the other fields of the
    entries.

    Raises KeyError, TypeError or ValueError if arrays and fields do not fit.
    """
    if not h.shape == v.shape == p.shape or h.ndim != 1 or sum(r["pixels"] for r in rows) != h.size:
        raise ValueError(f"arrays {h.shape}, {v.shape}, {p.shape}")
    out = []
    start = 0
    for row in rows:
        stop = start + row["pixels"]
        # Entries of earlier releases have a `seed`, which says nothing.
        fields = {k: value for k, value in row.items() if k not in ("pixels", "seed")}
        if fields.get("permittivity") is not None:
            fields["permittivity"] = tuple(fields["permittivity"])
        out.append(
            Entry(
                h=h[start:stop].astype(np.float32),
                v=v[start:stop].astype(np.float32),
                p=p[start:stop].astype(np.complex64),
                **fields,
            )
        )
        start = stop
    return tuple(out)


Real = npt.NDArray[np.float64]
COLUMNS_PER_ANGLE = 4
"""Columns of one angle: |H|, |V|, real and imaginary part of 1/P = V/H."""
CHANNELS = ("H", "V", "P", "H+V+P")
"""Channels that a classifier may use (Fig. 20 of the paper)."""


def make_features(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Return features [n, 4] of metal-referenced pixels: |H|, |V|, real and imaginary part of V / H = 1 / P.

    V / H is used instead of P because it stays bounded where V vanishes (Brewster angle).
    """
    inverse = 1 / np.asarray(p, np.complex128)
    return np.stack([np.abs(h), np.abs(v), inverse.real, inverse.imag], axis=-1)


def find_usable_pixels(x: Real) -> npt.NDArray[np.bool_]:
    """Return the pixels whose features are all finite, bool [n]."""
    return np.asarray(np.isfinite(x).all(axis=1), np.bool_)


def split_by_angle(x: Real) -> tuple[Real, Real, npt.NDArray[np.complex128]]:
    """Return |H|, |V| and V / H of features [n, 4 * angles], each [n, angles]."""
    h, v, real, imag = np.moveaxis(x.reshape(len(x), x.shape[1] // COLUMNS_PER_ANGLE, COLUMNS_PER_ANGLE), -1, 0)
    return h, v, real + 1j * imag


# Distances of pixels as the paper measures them (section 6.3): lambda_H |d|H|| + lambda_V |d|V|| + lambda_P d_P, summed
# over the incidence angles. The paper uses |dP| for d_P. There are two other measures, because errors of a ratio are
# not additive. "inverse", |d(1/P)|: 1/P stays below 1 for every dielectric, while P and its noise grow without bound
# near the Brewster angle. "log", |d ln P|: a gain error is the same distance for every material; materials of nearly
# the same permittivity differ by 4 to 10 % in P.
Measure = Literal["paper", "inverse", "log"]
MEASURES: tuple[Measure, ...] = get_args(Measure)
Distances = tuple[Real, Real, Real]
# Value that replaces an infinite P, which occurs at the Brewster angle.
_LARGEST_RATIO = 1e12


def invert_ratios(features: Real) -> Real:
    """Return columns |H|, |V|, Re P, Im P [n, 4] of features |H|, |V|, Re 1/P, Im 1/P; or the features of columns.

    Several angles follow each other, four columns each.
    """
    table = features.reshape(len(features), -1, COLUMNS_PER_ANGLE).copy()
    inverse = table[..., 2] + 1j * table[..., 3]
    inverse = np.where(np.abs(inverse) < 1 / _LARGEST_RATIO, 1 / _LARGEST_RATIO, inverse)
    table[..., 2] = (1 / inverse).real
    table[..., 3] = (1 / inverse).imag
    return table.reshape(features.shape)


def compute_ratio_distance(a: npt.NDArray[np.complex128], b: npt.NDArray[np.complex128], measure: Measure) -> Real:
    """Return the distance of ratios P, float64, broadcast; the measures are described above."""
    if measure == "paper":
        return np.abs(a - b)
    if measure == "inverse":
        return np.abs(1 / a - 1 / b)
    quotient = a / b
    return np.hypot(np.log(np.abs(quotient)), np.angle(quotient))


def compute_channel_distances(a: Real, b: Real, measure: Measure | None) -> Distances:
    """Return the distances of features a [n, 4 * angles] to b [m, 4 * angles] in |H|, |V| and P, [n, m] each.

    They are summed over the angles. Without a measure those of P are zero.
    """
    a_h, a_v, a_inverse = split_by_angle(a)
    b_h, b_v, b_inverse = split_by_angle(b)
    h_distance = np.zeros((len(a), len(b)))
    v_distance = np.zeros_like(h_distance)
    p_distance = np.zeros_like(h_distance)
    for angle in range(a_h.shape[1]):
        h_distance += np.abs(a_h[:, None, angle] - b_h[None, :, angle])
        v_distance += np.abs(a_v[:, None, angle] - b_v[None, :, angle])
        if measure is not None:
            p_distance += compute_ratio_distance(1 / a_inverse[:, None, angle], 1 / b_inverse[None, :, angle], measure)
    return h_distance, v_distance, p_distance


def find_neighbours(distance: Real, count: int) -> npt.NDArray[np.intp]:
    """Return the columns of the `count` smallest values of each row, nearest first, [rows, count]."""
    nearest_indices = np.argpartition(distance, count - 1, axis=1)[:, :count]
    order = np.argsort(np.take_along_axis(distance, nearest_indices, axis=1), axis=1, kind="stable")
    return np.take_along_axis(nearest_indices, order, axis=1)


def count_votes(neighbour_classes: npt.NDArray[np.intp], classes: int) -> npt.NDArray[np.intp]:
    """Return how many neighbours of each row are of each class, [rows, classes].

    `neighbour_classes` [rows, neighbours] are numbers from 0 to `classes` - 1.
    """
    rows = len(neighbour_classes)
    # The cells of the table are numbered row after row, so that one call of `bincount` counts all votes.
    cell = neighbour_classes + classes * np.arange(rows)[:, None]
    return np.bincount(cell.ravel(), minlength=rows * classes).reshape(rows, classes)


@dataclass(frozen=True)
class Samples:
    """Labelled pixels.

    Attributes
    ----------
    x
        float64 [n, 4 * angles].
    names, groups, patches
        Material, group for cross-validation (a scan, or a physical sample) and patch number of each pixel, [n].
    specimens
        Specimen of the material that each pixel shows, str [n]; empty if not known: then one specimen of each material
        is assumed in all scans. None: not known for all pixels.
    angles_deg
        Incidence angles; empty if not known.
    """

    x: Real
    names: npt.NDArray
    groups: npt.NDArray
    patches: npt.NDArray
    specimens: npt.NDArray | None = None
    angles_deg: tuple[float, ...] = ()

    @property
    def plates(self) -> npt.NDArray[np.intp]:
        """Number of each pixel's plate (material and specimen), [n]."""
        specimens = np.full(self.names.shape, "") if self.specimens is None else self.specimens
        pairs = np.stack([np.unique(a, return_inverse=True)[1] for a in (self.names, specimens)], axis=1)
        return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].ravel(), np.intp)

    @property
    def independent(self) -> npt.NDArray:
        """Groups without common specimens, [n]: scans that show the same labelled plate are joined to one group.

        If then no material is in two groups, the result is `groups`, although training and test data share specimens.
        """
        if self.specimens is None or not (self.specimens != "").any():
            return self.groups
        # Each group has the name of the first group that it is joined to; a plate joins all groups that show it.
        joined = {g: g for g in np.unique(self.groups).tolist()}
        has_specimen = self.specimens != ""
        plates = self.plates[has_specimen]
        groups = self.groups[has_specimen]
        for plate in np.unique(plates):
            joined_groups = {joined[g] for g in np.unique(groups[plates == plate]).tolist()}
            for group, first_group in joined.items():
                if first_group in joined_groups:
                    joined[group] = min(joined_groups)
        out = np.array([joined[g] for g in self.groups.tolist()])
        return out if replace(self, groups=out).shared.any() else self.groups

    @property
    def groups_of_material(self) -> npt.NDArray[np.int64]:
        """Number of groups that have each pixel's material, [n]."""
        names, material_index = np.unique(self.names, return_inverse=True)
        count = [np.unique(self.groups[material_index == k]).size for k in range(names.size)]
        return np.array(count, np.int64)[material_index]

    @property
    def shared(self) -> npt.NDArray[np.bool_]:
        """True for pixels whose material is in another group too, as cross-validation requires, [n]."""
        return self.groups_of_material > 1

    @classmethod
    def from_library(cls, library: Library, pixels_per_patch: int | None = None) -> Samples:
        """Return the pixels of a library of one angle, grouped by scan.

        Of each patch at most `pixels_per_patch` pixels are taken at random; None: all.

        Raises DataError if no pixel is usable.
        """
        rng = np.random.default_rng(0)
        x = []
        names = []
        groups = []
        patches = []
        specimens = []
        for i, entry in enumerate(library.entries):
            with np.errstate(divide="ignore", invalid="ignore"):
                features = make_features(entry.h, entry.v, entry.p)
            usable_pixels = np.flatnonzero(find_usable_pixels(features))
            pixels = rng.permutation(usable_pixels)[:pixels_per_patch]
            x.append(features[pixels])
            names += [entry.name] * pixels.size
            groups += [entry.scan] * pixels.size
            patches += [i] * pixels.size
            specimens += [entry.specimen or ""] * pixels.size
        if not names:
            raise DataError(
                "the library has no usable pixel",
                "nothing was trained",
                "polysight train SCAN... --out FILE",
                code=ErrorCode.NO_DATA,
            )
        labels = np.array(names), np.array(groups), np.array(patches), np.array(specimens)
        return cls(np.concatenate(x), *labels, library.angles_deg)

    def take(self, indices: npt.NDArray) -> Samples:
        """Return some of the pixels, by index [k] or by bool mask [n]."""
        specimens = None if self.specimens is None else self.specimens[indices]
        return Samples(
            self.x[indices],
            self.names[indices],
            self.groups[indices],
            self.patches[indices],
            specimens,
            self.angles_deg,
        )

    def join(self, other: Samples) -> Samples:
        """Return samples whose features are those of both angles side by side, patch by patch.

        Scans of the same name are paired; without common names, scans are paired in their order. In a pair of scans
        the patches of a material are paired in their order, and their pixels at random, because the pixels of two
        scans show different spots.

        Raises DataError if no material was seen under both angles.
        """
        rng = np.random.default_rng(0)
        own_groups = np.unique(self.groups)
        other_groups = np.unique(other.groups)
        common = np.intersect1d(own_groups, other_groups)
        if common.size:
            pairs = zip(common, common, strict=True)
        else:
            pairs = zip(own_groups, other_groups, strict=False)
        our_rows = []
        their_rows = []
        groups = []
        patches = []
        # The angles of the result are known only if those of both parts are.
        angles: tuple[float, ...] = ()
        if self.angles_deg and other.angles_deg:
            angles = self.angles_deg + other.angles_deg
        for a, b in pairs:
            for name in np.unique(self.names):
                our_patches = np.unique(self.patches[(self.groups == a) & (self.names == name)])
                their_patches = np.unique(other.patches[(other.groups == b) & (other.names == name)])
                for our_patch, their_patch in zip(our_patches, their_patches, strict=False):
                    i = np.flatnonzero(self.patches == our_patch)
                    j = np.flatnonzero(other.patches == their_patch)
                    n = min(i.size, j.size)
                    our_rows.append(rng.permutation(i)[:n])
                    their_rows.append(rng.permutation(j)[:n])
                    groups += [a if a == b else f"{a} + {b}"] * n
                    patches += [our_patch] * n
        if not groups:
            raise DataError(
                "no material was seen under both angles", "the materials' names differ", "train both angles",
                code=ErrorCode.MISMATCH,
            )  # fmt: skip
        i = np.concatenate(our_rows)
        j = np.concatenate(their_rows)
        specimens = None if self.specimens is None else self.specimens[i]
        x = np.hstack([self.x[i], other.x[j]])
        return Samples(x, self.names[i], np.array(groups), np.array(patches), specimens, angles)


@dataclass(frozen=True)
class NamedScan:
    """Names of the pixels and patches of a scan.

    Attributes
    ----------
    pixel_names, pixel_distance
        Likeliest material of each pixel, [n], and distance to it in units of its threshold: above 1 the pixel is
        unknown.
    patches
        Patch numbers, sorted, [patches].
    names, confidence, distance
        Material and distance of each patch in the same way, [patches], and its confidence: a probability, or the share
        of its pixels that have this name.
    distances
        Distance of each patch to each material in units of its threshold, [patches, materials]; None: not known.
    probabilities, materials
        Probability of each material and, last, of none of them, [patches, materials + 1]; the materials' names. None
        for models without probabilities.
    """

    pixel_names: npt.NDArray
    pixel_distance: Real
    patches: npt.NDArray
    names: npt.NDArray
    confidence: Real
    distance: Real
    distances: Real | None = None
    probabilities: Real | None = None
    materials: npt.NDArray | None = None


class Model(ABC):
    """A classifier of metal-referenced pixels, features [n, 4 * angles] as in `polysight.materials.library`."""

    knows_scans = False
    """True if `by_scan` uses errors common to the patches of a scan."""

    @property
    @abstractmethod
    def distributions(self) -> Any:
        """The materials' distributions (`discriminant.py`), used by every model to recognise unknown patches."""

    @abstractmethod
    def fit(self, samples: Samples) -> Model:
        """Fit the model to labelled pixels."""

    @abstractmethod
    def classify_pixels(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Classify each pixel independently: return its name [n] and its distance in units of the threshold [n]."""

    def by_scan(self, x: Real, patches: npt.NDArray) -> NamedScan:
        """Name the pixels and patches of one scan; `patches` [n] is the patch number of each pixel.

        By default a patch gets the name of most of its pixels.
        """
        return name_by_majority(*self.classify_pixels(x), patches)


def name_by_majority(pixel_names: npt.NDArray, distance: Real, patches: npt.NDArray) -> NamedScan:
    """Give each patch the name of most of its pixels; name, distance and patch number of each pixel are given, [n].

    The confidence of a patch is the share of its pixels with this name, its distance the median over all its pixels.
    """
    ids, patch, count = np.unique(patches, return_inverse=True, return_counts=True)
    names, name_of_pixel = np.unique(pixel_names, return_inverse=True)
    votes = np.bincount(patch * names.size + name_of_pixel, minlength=ids.size * names.size).reshape(ids.size, -1)
    share = votes.max(axis=1) / count
    return NamedScan(
        pixel_names, distance, ids, names[votes.argmax(axis=1)], share, compute_patch_medians(distance, patch)
    )


def compute_patch_medians(values: Real, patch: npt.NDArray[np.intp]) -> Real:
    """Return the median of the values [n] of each patch, [patches]; `patch` [n] are numbers from 0, all of them in use.

    All patches are computed together: `numpy.median` takes 30 us a call, and scores need it for thousands of patches.
    """
    count = np.bincount(patch)
    sorted_values = values[np.lexsort((values, patch))]
    first = np.cumsum(count) - count
    middle = (sorted_values[first + (count - 1) // 2] + sorted_values[first + count // 2]) / 2
    # Values that are not numbers are sorted to the end.
    return np.where(np.isnan(sorted_values[first + count - 1]), np.nan, middle)
