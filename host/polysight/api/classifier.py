"""Train libraries and classifiers on labelled scans of your own, with scikit-learn's conventions.

A row of X is a pixel. Its columns are |H|, |V|, and the real and imaginary part of P = H / V, for each incidence angle;
H and V are the reflectivities of both channels relative to metal.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, cast

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from polysight.api.scan import find_rig_file
from polysight.jobs.train import train_from_scans
from polysight.materials import (
    MODEL_OF_OPTION,
    ErrorDiscriminant,
    Library,
    PaperKNeighborsClassifier,
    Samples,
    Score,
    invert_ratios,
    score,
)

if TYPE_CHECKING:
    from polysight.api.scan import Scan

# Number of nearest pixels that vote on a name, the same as in library files (polysight.materials.classify.Weights).
NEIGHBOURS = 15
# |H|, |V|, real and imaginary part of P.
CHANNELS = 4
# scikit-learn's type hints declare X as text.
_validate = cast(Any, validate_data)
Columns = npt.NDArray[np.float64]
Names = npt.NDArray[np.str_]


def train(
    scans: Sequence[str | os.PathLike[str] | Scan], *, rig: str | os.PathLike[str] | None = None, note: str = ""
) -> Library:
    """Make a library of labelled scans, as `polysight train`.

    Parameters
    ----------
    scans
        Scans, scan folders or folders of products; labelled by :meth:`Scan.label`, or simulated with their truth. Two
        at least: the library is judged on scans left out.
    rig
        Rig file of published data; `instrument.toml` here or the packaged one if not given.
    note
        Text that goes with the library.

    Returns
    -------
    Library
        `names`, `scans`, `columns()`; `save(path)` writes it, `Library.load(path)` reads it. `library.fit` holds its
        scores on scans left out.

    Raises
    ------
    DataError
        if a scan has no labels, or fewer than two scans were given.
    """
    if isinstance(scans, str | os.PathLike):
        scans = [scans]
    folders = [scan if isinstance(scan, str | os.PathLike) else scan.folder for scan in scans]
    return train_from_scans([Path(folder) for folder in folders], find_rig_file(rig), note)


class Classifier(ClassifierMixin, BaseEstimator):
    """Name pixels by their material.

    Parameters
    ----------
    model
        "knn": nearest neighbours as in the POLySIGHT paper, a :class:`PaperKNeighborsClassifier`. "discriminant": the
        discriminant of error sources. It takes into account that pixels of one patch, and patches of one scan, share
        a part of their errors.

    Attributes
    ----------
    classes_
        Materials, sorted; there after `fit`.
    """

    classes_: Names

    def __init__(self, model: Literal["knn", "discriminant"] = "discriminant") -> None:
        self.model = model

    def fit(self, X: npt.ArrayLike, y: npt.ArrayLike, groups: npt.ArrayLike | None = None) -> Self:
        """Fit to pixels X [n, 4 * angles] of materials y [n].

        `groups` [n] is the scan of each pixel. An error that all pixels of a scan share, such as that of its metal
        reference, is then not taken for a property of their materials. Without `groups` all pixels are of one scan.

        Raises
        ------
        ValueError
            for another model, other numbers of columns, fewer than two pixels, a `y` that holds no classes, or `groups`
            of another length.
        """
        pixels, names = _validate(self, X, y, ensure_min_samples=2)
        # Its keys are the names of models in options, its values those in library files.
        if self.model not in MODEL_OF_OPTION:
            raise ValueError(f"model is {self.model!r}: one of {', '.join(MODEL_OF_OPTION)}")
        check_classification_targets(names)
        self.classes_ = np.unique(names)
        if self.model == "knn":
            count = min(NEIGHBOURS, len(pixels))
            self._model: Any = PaperKNeighborsClassifier(count).fit(pixels, names)
        else:
            self._model = ErrorDiscriminant().fit(_collect_samples(pixels, names, groups))
        return self

    def predict_proba(self, X: npt.ArrayLike) -> Columns:
        """Return the probability of each material, [n, materials] in the order of `classes_`."""
        check_is_fitted(self)
        pixels: Columns = _validate(self, X, reset=False)
        if self.model == "knn":
            return np.asarray(self._model.predict_proba(pixels))
        return self._model.pixel_probabilities(_to_features(pixels))

    def predict(self, X: npt.ArrayLike) -> Names:
        """Return the likeliest material of each pixel, [n]."""
        check_is_fitted(self)
        return self.classes_[self.predict_proba(X).argmax(axis=1)]

    def score_by_scans(self, library: Library) -> Score:
        """Judge this model on scans left out of a library of one incidence angle.

        Returns
        -------
        Score
            `pixels` and `patches` are the shares that were named right, averaged over materials; `unknown` is the share
            of patches that were called unknown, `calibration` the expected calibration error of the others.
            `confusion` has its rows and columns in the order of `names`. `not_judged` are the materials that only one
            scan contains.

        Raises
        ------
        DataError
            if no material is in two scans.
        """
        return score(Samples.from_library(library), MODEL_OF_OPTION[self.model])


def _collect_samples(X: Columns, y: Names, groups: npt.ArrayLike | None) -> Samples:
    """Return labelled pixels; those of one material in one scan are a patch. Raises ValueError for a wrong shape."""
    scans = np.zeros(len(X), np.intp) if groups is None else np.asarray(groups)
    if scans.shape != (len(X),):
        raise ValueError(f"groups has the shape {scans.shape}, X has {len(X)} rows")
    material = np.unique(y, return_inverse=True)[1]
    scan = np.unique(scans, return_inverse=True)[1]
    patches = scan * (material.max() + 1) + material
    return Samples(_to_features(X), np.asarray(y), scan, patches)


def _to_features(X: Columns) -> Columns:
    """Return the features |H|, |V|, real and imaginary part of 1 / P = V / H of pixels, as the discriminant needs them.

    Raises ValueError for other numbers of columns.
    """
    if X.shape[1] % CHANNELS:
        raise ValueError(
            f"X has {X.shape[1]} feature(s): {CHANNELS} for each incidence angle, |H|, |V|, real and imaginary P"
        )
    return invert_ratios(X)
