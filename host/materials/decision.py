"""What a classifier says of one scan, and how a patch is named by a classifier that knows pixels only."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.host.materials.samples import Real, Samples


@dataclass(frozen=True)
class NamedScan:
    """What the pixels and patches of a scan were named.

    Attributes
    ----------
    pixel_names, pixel_distance
        Likeliest material of each pixel, [n], and its distance over the threshold: above 1 is unknown.
    patches
        Patch numbers, sorted, [patches].
    names, confidence, distance
        The same of each patch, [patches], and how sure: a probability, or the share of its pixels.
    """

    pixel_names: npt.NDArray
    pixel_distance: Real
    patches: npt.NDArray
    names: npt.NDArray
    confidence: Real
    distance: Real


class Model(ABC):
    """A classifier of metal-referenced pixels, features [n, 4 * angles] as in `polysight.host.materials.samples`."""

    knows_scans = False
    """Whether `by_scan` makes use of what the patches of a scan have in common."""

    @abstractmethod
    def fit(self, samples: Samples) -> Model:
        """Learn from labelled pixels."""

    @abstractmethod
    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name of each pixel by nothing but itself, [n], and its distance over the threshold."""

    def by_scan(self, x: Real, patches: npt.NDArray) -> NamedScan:
        """Names in one scan, whose pixels lie in `patches` [n]; a patch is what most of its pixels are called."""
        return majority(*self.by_pixel(x), patches)


def majority(found: npt.NDArray, distance: Real, patches: npt.NDArray) -> NamedScan:
    """Patches named as most of their pixels are, as sure as those are many, as far as the median of them."""
    ids, rows = np.unique(patches), []
    for i in ids:
        at = patches == i
        names, count = np.unique(found[at], return_counts=True)
        rows.append((names[count.argmax()], count.max() / at.sum(), float(np.median(distance[at]))))
    names, share, far = zip(*rows, strict=True)
    return NamedScan(found, distance, ids, np.array(names), np.array(share), np.array(far))
