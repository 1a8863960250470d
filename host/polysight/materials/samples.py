"""Labelled pixels for classifiers, and the interface of classifiers.

`Samples` holds features, material, scan and patch of each pixel. A `Model` is fitted to samples and names pixels; the
result for one scan is a `NamedScan`, whose patches are named by `majority` or by the model itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials.library import Library
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = npt.NDArray[np.float64]
WIDTH = 4
"""Columns of one angle: |H|, |V|, real and imaginary part of 1/P = V/H."""
CHANNELS = ("H", "V", "P", "H+V+P")
"""Channels that a classifier may use (Fig. 20 of the paper)."""


def feature_matrix(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Return features [n, 4] of metal-referenced pixels: |H|, |V|, real and imaginary part of V / H = 1 / P.

    V / H is used instead of P because it stays bounded where V vanishes (Brewster angle).
    """
    inverse = 1 / np.asarray(p, np.complex128)
    return np.stack([np.abs(h), np.abs(v), inverse.real, inverse.imag], axis=-1)


def usable(x: Real) -> npt.NDArray[np.bool_]:
    """Return the pixels whose features are all finite, bool [n]."""
    return np.asarray(np.isfinite(x).all(axis=1), np.bool_)


def by_angle(x: Real) -> tuple[Real, Real, npt.NDArray[np.complex128]]:
    """Return |H|, |V| and V / H of features [n, 4 * angles], each [n, angles]."""
    h, v, real, imag = np.moveaxis(x.reshape(len(x), -1, WIDTH), -1, 0)
    return h, v, real + 1j * imag


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
        which = np.full(self.names.shape, "") if self.specimens is None else self.specimens
        pairs = np.stack([np.unique(a, return_inverse=True)[1] for a in (self.names, which)], axis=1)
        return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].ravel(), np.intp)

    @property
    def independent(self) -> npt.NDArray:
        """Groups without common specimens, [n]: scans of the same labelled plate are joined.

        If that leaves a single group, the scans themselves: then the same specimens are in training and test.
        """
        if self.specimens is None or not (self.specimens != "").any():
            return self.groups
        joined = {g: g for g in np.unique(self.groups).tolist()}
        known = self.specimens != ""
        for plate in np.unique(self.plates[known]):
            seen = {joined[g] for g in np.unique(self.groups[known & (self.plates == plate)]).tolist()}
            joined = {g: min(seen) if to in seen else to for g, to in joined.items()}
        out = np.array([joined[g] for g in self.groups.tolist()])
        return out if np.unique(out).size > 1 else self.groups

    @property
    def groups_of_material(self) -> npt.NDArray[np.int64]:
        """Number of groups that have each pixel's material, [n]."""
        names, of = np.unique(self.names, return_inverse=True)
        count = [np.unique(self.groups[of == k]).size for k in range(names.size)]
        return np.array(count, np.int64)[of]

    @property
    def shared(self) -> npt.NDArray[np.bool_]:
        """True for pixels whose material is in another group too, as cross-validation requires, [n]."""
        return self.groups_of_material > 1

    @classmethod
    def of(cls, library: Library, pixels_per_patch: int | None = None) -> Samples:
        """Return the pixels of a library of one angle, grouped by scan; of each patch at most so many, at random.

        Raises DataError if no pixel is usable.
        """
        rng = np.random.default_rng(0)
        x, names, groups, patches, specimens = [], [], [], [], []
        for i, e in enumerate(library.entries):
            with np.errstate(divide="ignore", invalid="ignore"):
                features = feature_matrix(e.h, e.v, e.p)
            good = np.flatnonzero(usable(features))
            at = rng.permutation(good)[:pixels_per_patch]
            x.append(features[at])
            names += [e.name] * at.size
            groups += [e.scan] * at.size
            patches += [i] * at.size
            specimens += [e.specimen or ""] * at.size
        if not names:
            raise DataError(
                "the library has no usable pixel", "nothing was trained", "polysight train", code=ErrorCode.NO_DATA
            )
        labels = np.array(names), np.array(groups), np.array(patches), np.array(specimens)
        return cls(np.concatenate(x), *labels, library.angles_deg)

    def take(self, at: npt.NDArray) -> Samples:
        """Return some of the pixels, by index or by mask."""
        which = None if self.specimens is None else self.specimens[at]
        return Samples(self.x[at], self.names[at], self.groups[at], self.patches[at], which, self.angles_deg)

    def joined(self, other: Samples) -> Samples:
        """Join with samples of a second angle, patch by patch.

        Scans of the same name are paired; without common names, scans are paired in their order. In a pair of scans
        the patches of a material are paired in their order, and their pixels at random, because the pixels of two
        scans show different spots.

        Raises DataError if no material was seen under both angles.
        """
        rng = np.random.default_rng(0)
        ours, theirs = np.unique(self.groups), np.unique(other.groups)
        common = np.intersect1d(ours, theirs)
        pairs = zip(common, common, strict=True) if common.size else zip(ours, theirs, strict=False)
        left, right, groups, patches = [], [], [], []
        angles = self.angles_deg + other.angles_deg if self.angles_deg and other.angles_deg else ()
        for a, b in pairs:
            for name in np.unique(self.names):
                here = np.unique(self.patches[(self.groups == a) & (self.names == name)])
                there = np.unique(other.patches[(other.groups == b) & (other.names == name)])
                for p, q in zip(here, there, strict=False):
                    i, j = np.flatnonzero(self.patches == p), np.flatnonzero(other.patches == q)
                    n = min(i.size, j.size)
                    left.append(rng.permutation(i)[:n])
                    right.append(rng.permutation(j)[:n])
                    groups += [a if a == b else f"{a} + {b}"] * n
                    patches += [p] * n
        if not groups:
            raise DataError(
                "no material was seen under both angles", "the materials' names differ", "train both angles",
                code=ErrorCode.MISMATCH,
            )  # fmt: skip
        i, j = np.concatenate(left), np.concatenate(right)
        which = None if self.specimens is None else self.specimens[i]
        x = np.hstack([self.x[i], other.x[j]])
        return Samples(x, self.names[i], np.array(groups), np.array(patches), which, angles)


@dataclass(frozen=True)
class NamedScan:
    """Names of the pixels and patches of a scan.

    Attributes
    ----------
    pixel_names, pixel_distance
        Likeliest material of each pixel, [n], and its distance over the threshold: above 1 is unknown.
    pixel_confidence
        Probability of that material, [n]; None for models without probabilities.
    patches
        Patch numbers, sorted, [patches].
    names, confidence, distance
        The same of each patch, [patches], and its confidence: a probability, or the share of its pixels.
    distances
        Distance of each patch to each material over the threshold, [patches, materials]; None: not known.
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
    pixel_confidence: Real | None = None


@dataclass(frozen=True)
class SceneErrors:
    """Errors of a scan's patches in ln|H|, ln|V| and arg P, by its error budget.

    Attributes
    ----------
    own
        float64 [patch, d, d]: covariance of each patch's own error.
    design
        float64 [patch, d, q]: effect of the q errors common to all patches (leakage, reference, angle) on each.
    covariance
        float64 [q, q] of the common errors.
    """

    own: Real
    design: Real
    covariance: Real

    def of(self, at: npt.NDArray) -> SceneErrors:
        """Return the errors of some of the patches."""
        return SceneErrors(self.own[at], self.design[at], self.covariance)


class Model(ABC):
    """A classifier of metal-referenced pixels, features [n, 4 * angles] as in `polysight.materials.samples`."""

    knows_scans = False
    """True if `by_scan` uses errors common to the patches of a scan."""
    distributions: Any
    """The materials' distributions (`discriminant.py`), used by every model to recognise unknown patches."""

    @abstractmethod
    def fit(self, samples: Samples) -> Model:
        """Fit the model to labelled pixels."""

    @abstractmethod
    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Classify each pixel independently: return name [n] and distance over the threshold [n]."""

    def by_scan(
        self, x: Real, patches: npt.NDArray, errors: SceneErrors | None = None, others: float | None = None
    ) -> NamedScan:
        """Name the pixels and patches of one scan; `patches` [n] is the patch number of each pixel.

        By default a patch gets the name of most of its pixels. `errors` of the patches, in the order of their numbers,
        for models that use them. `others`: share of a patch's pixels that may be of another material than the patch;
        None: pixels are classified independently.
        """
        del errors, others
        return majority(*self.by_pixel(x), patches)


def majority(found: npt.NDArray, distance: Real, patches: npt.NDArray) -> NamedScan:
    """Name each patch as most of its pixels; confidence is their share, distance the median over all pixels."""
    ids, rows = np.unique(patches), []
    for i in ids:
        at = patches == i
        names, count = np.unique(found[at], return_counts=True)
        rows.append((names[count.argmax()], count.max() / at.sum(), float(np.median(distance[at]))))
    names, share, far = zip(*rows, strict=True)
    return NamedScan(found, distance, ids, np.array(names), np.array(share), np.array(far))
