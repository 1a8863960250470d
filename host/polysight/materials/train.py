"""Make reference libraries from scans and from the published data set, and judge models by cross-validation.

`make_library` collects the patches of known material from processed scans; `fit_library` judges the models on them, for
each incidence angle and for all together. The default model is always the discriminant, the only one with probabilities
and a test for unknown materials; other models are judged for comparison. No model is selected by its score, so that the
scores are unbiased.

To judge a model (`score`), whole groups are left out (scans, or physical samples): pixels of one patch share speckle,
placement and metal reference, so that a split by pixel compares a patch with itself. That score is given too, because
the POLySIGHT paper seems to use it; it is labelled optimistic. A material of a single scan cannot be judged: it stays
among the candidates, counts neither as right nor as wrong, and is listed.

Two parts of the published data set are read:

`labels/<scan>/{sar_h,sar_v}.npy` and `<scan>.json`: images with boxes [x0, y0, x1, y1] in pixels. The direction of y,
and the order [y, x] or [x, y] of the images, is not documented. All scans share one convention, which is found from the
images: with the right one the boxes explain most of the variance of the brightness.

`materials/<name>_<angle>.pkl`: pixels of one material and of its metal reference. The pickles are read with an
unpickler that allows arrays and plain types only.
"""

from __future__ import annotations

import io
import pickle
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials.classify import DISCRIMINANT_MODEL, MODELS, PAPER_MODEL, fit_weights
from polysight.materials.labels import METAL_WORDS, clean_line, find_label_file, is_metal, read_labels
from polysight.materials.library import Entry, Library, Real, Samples, name_by_majority
from polysight.materials.result import MaterialsResult
from polysight.materials.segment import Box
from polysight.materials.training_advice import count_specimen_freedom, find_alike_pairs
from polysight.polarimetry import measure_metal_gains
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import read_bounded, read_json

Image = npt.NDArray[np.complexfloating]
PUBLISHED_PIXELS = 120
"""Largest number of pixels of a box, at even intervals: the paper's "about 80 to 120" for each material."""
ORIENTATIONS = {
    "x to the right, y along the rows": lambda a: a,
    "y from the last row": lambda a: a[::-1],
    "x and y swapped": lambda a: a.T,
    "x and y swapped, y from the last row": lambda a: a.T[::-1],
}
"""Name to a function that turns an image so that rows are y and columns x."""
# Share of the variance that another orientation must explain in addition; chosen: chance must not turn images.
_CLEAR_DIFFERENCE = 0.05
# Module and name of what the published pickles may call: arrays and plain numbers, of old and new releases of numpy.
_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("builtins", "complex"),
    ("_codecs", "encode"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
}
# Usual number of parts of the cross-validation; one part is left out at a time; chosen.
FOLDS = 8
# The split of a score whose training and test pixels are of the same patches.
OPTIMISTIC_SPLIT = "by pixel (optimistic)"
PATCH_PIXELS = 16
"""Pixels of each patch, in a library and to judge models; chosen."""


@dataclass(frozen=True)
class LabelledScan:
    """A pair of images with labelled boxes.

    Attributes
    ----------
    scan, description
        Folder name, and the description in the file.
    h, v
        complex64 [ny, nx].
    boxes
        Name to pixel corners (x0, y0, x1, y1), ends left out.
    simulated
        True if the description contains "simulated".
    """

    scan: str
    description: str
    h: Image
    v: Image
    boxes: dict[str, Box]
    simulated: bool

    def mask(self, name: str) -> npt.NDArray[np.bool_]:
        """Return the pixels of a box, bool [ny, nx]. Raises DataError if there are none."""
        x0, y0, x1, y1 = (round(b) for b in self.boxes[name])
        mask = np.zeros(self.h.shape, bool)
        mask[max(min(y0, y1), 0) : max(y0, y1, 0), max(min(x0, x1), 0) : max(x0, x1, 0)] = True
        if not mask.any():
            raise DataError(
                f"{self.scan}: the box of {name}, {self.boxes[name]}, contains no pixel of the {self.h.shape} image",
                "the label file is of another scan", "correct the box, or leave the scan out", code=ErrorCode.NO_DATA,
            )  # fmt: skip
        return mask

    def orient(self, how: str) -> LabelledScan:
        """Return the scan with its images in another orientation, a key of `ORIENTATIONS`."""
        turn = ORIENTATIONS[how]
        return LabelledScan(self.scan, self.description, turn(self.h), turn(self.v), self.boxes, self.simulated)

    @property
    def metal(self) -> str | None:
        """Name of the largest metal box; None without one."""
        metals = [n for n in self.boxes if is_metal(n)]
        return max(metals, key=lambda n: self.mask(n).sum(), default=None)


def restore_phase_sign(published: npt.NDArray[np.complexfloating]) -> npt.NDArray[np.complexfloating]:
    """Return published images or pixels (any shape) with our sign of phase, where losses are -j eps'': the conjugate.

    The published imaging code multiplies the samples by exp(-j k R) and adds them up. A wave that is delayed by R has
    exp(-j k R) in our sign: samples that add up are its conjugate, and the images are, too. No document says so; a
    plate of the published picture would amplify otherwise, by three standard deviations.
    """
    return np.conj(published)


def read_labelled_scan(folder: Path) -> LabelledScan:
    """Read `labels/<scan>`; its images get our sign of phase. Raises DataError if a file is missing or invalid."""
    file = find_label_file(folder)
    boxes = dict(read_labels(file).boxes)
    description = str(read_json(file).get("description", ""))
    images = []
    for name in ("sar_h", "sar_v"):
        path = folder / f"{name}.npy"
        try:
            image = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as e:
            reason = getattr(e, "strerror", None) or e
            raise DataError(
                f"{path}: not an image: {reason}", "the download is not complete", "fetch it again",
                code=ErrorCode.FILE_UNREADABLE,
            ) from None  # fmt: skip
        if image.ndim != 2 or not np.iscomplexobj(image):
            raise DataError(
                f"{path}: {image.dtype} {image.shape}", "expected a complex image [150, 150]",
                "give a folder labels/<scan> of the published data", code=ErrorCode.TYPE_WRONG,
            )  # fmt: skip
        images.append(restore_phase_sign(image).astype(np.complex64))
    if images[0].shape != images[1].shape:
        raise DataError(
            f"{folder}: images of {images[0].shape} and {images[1].shape}", "they are not of one scan",
            "copy the folder again", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    return LabelledScan(folder.name, description, images[0], images[1], boxes, "simulated" in description.lower())


def compute_explained_variance(scan: LabelledScan) -> float:
    """Return the share of the variance of ln |H||V| over the pixels that the boxes explain, 0 to 1."""
    # In double precision and relative to the brightest pixel: the images are in arbitrary units.
    product = np.abs(scan.h).astype(np.float64) * np.abs(scan.v).astype(np.float64)
    level = np.log(np.maximum(product / max(float(product.max(initial=0.0)), 1e-300), 1e-30))
    label = np.zeros(level.shape, int)
    for i, name in enumerate(scan.boxes, 1):
        label[scan.mask(name)] = i
    variance_within = sum(float(((level[label == k] - level[label == k].mean()) ** 2).sum()) for k in np.unique(label))
    return 1 - variance_within / max(float(((level - level.mean()) ** 2).sum()), 1e-30)


def image_orientation(scans: Sequence[LabelledScan]) -> str:
    """Return the orientation of a data set's images: the first of `ORIENTATIONS`, unless one explains clearly more."""
    shares = {}
    for orientation in ORIENTATIONS:
        try:
            shares[orientation] = float(np.mean([compute_explained_variance(s.orient(orientation)) for s in scans]))
        except DataError:
            # The box lies outside the image in this orientation.
            shares[orientation] = -1.0
    first = next(iter(ORIENTATIONS))
    best = max(shares, key=lambda h: shares[h])
    return best if shares[best] > shares[first] + _CLEAR_DIFFERENCE else first


def make_entries_of_boxes(scan: LabelledScan, angle_deg: float) -> list[Entry]:
    """Return library entries of a labelled scan, each box relative to the scan's metal; leakage is not removed.

    The scan is in the right orientation.

    Raises DataError if no box is of metal, the metal has no signal, or a box holds no pixel.
    """
    if scan.metal is None:
        raise DataError(
            f"{scan.scan}: none of its boxes is of metal: {', '.join(scan.boxes)}",
            "everything is measured relative to metal",
            f"a metal box has one of these words in its name: {', '.join(METAL_WORDS)}", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    metal_h, metal_v = measure_metal_gains(scan.h, scan.v, scan.mask(scan.metal) & (scan.h != 0) & (scan.v != 0))
    h = scan.h / np.asarray(metal_h, scan.h.dtype)
    v = scan.v / np.asarray(metal_v, scan.v.dtype)
    entries = []
    for name in scan.boxes:
        hs = h[scan.mask(name)]
        vs = v[scan.mask(name)]
        usable = np.flatnonzero(np.isfinite(hs) & np.isfinite(vs) & (hs != 0) & (vs != 0))
        if usable.size == 0:
            continue
        spaced = np.linspace(0, usable.size - 1, min(PUBLISHED_PIXELS, usable.size)).round().astype(int)
        picked = usable[np.unique(spaced)]
        entries.append(
            Entry(
                name=name,
                scan=scan.scan,
                h=np.abs(hs[picked]).astype(np.float32),
                v=np.abs(vs[picked]).astype(np.float32),
                p=(hs[picked] / vs[picked]).astype(np.complex64),
                incidence_deg=angle_deg,
                simulated=scan.simulated,
                reference=scan.metal,
            )
        )
    return entries


def label_folders(folder: Path) -> list[Path]:
    """Return the folders of scans in a `labels/` folder."""
    if folder.is_dir():
        return sorted(p for p in folder.iterdir() if p.is_dir() and any(p.glob("*.json")))
    return []


def find_angle_in_text(texts: Iterable[str]) -> float | None:
    """Return the incidence angle in texts such as "60 deg" or "scan_55degrees", degrees; None without one."""
    for text in texts:
        match = re.search(r"(\d{2}(?:\.\d+)?)\s*(?:°|deg)", text.lower())
        if match:
            return float(match[1])
    return None


# Largest pickle that is read: a damaged or foreign file must not fill the memory.
_MAX_BYTES = 1 << 30


class _RestrictedUnpickler(pickle.Unpickler):
    """An unpickler for arrays and plain types."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the named constructor if `_ALLOWED` has it: those of arrays. Raises UnpicklingError."""
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it would call {module}.{name}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Read a pickle of arrays and plain types.

    Raises DataError if the file is missing, damaged, or would call anything but numpy's array constructors.
    """
    try:
        return _RestrictedUnpickler(io.BytesIO(read_bounded(path, _MAX_BYTES))).load()
    except DataError:
        raise
    except OSError as e:
        raise DataError(
            f"{path}: cannot be read: {e.strerror}", "the path is wrong, or you may not read it",
            "check the path and its permissions", code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip
    except pickle.UnpicklingError as e:
        raise DataError(
            f"{path}: refused: {e}",
            "a pickle can run any program; only numpy arrays and plain types are read",
            "open it with pickle.load only if you trust its author",
            code=ErrorCode.FILE_FOREIGN,
        ) from None
    except Exception as e:  # noqa: BLE001 - a damaged pickle raises anything
        raise DataError(
            f"{path}: not a pickle: {type(e).__name__}: {e}", "it is truncated or another file",
            "download it again, or leave it out", code=ErrorCode.FILE_DAMAGED,
        ) from None  # fmt: skip


def read_material(path: Path) -> Entry:
    """Read a material file as a library entry, divided by its reference.

    `values` and `ref_values` are [P, H, V]; P is divided by the reference's mean P (Eq. 9 of the paper), H and V by the
    root mean square of its amplitudes: of these only amplitudes are used.

    Raises DataError as :func:`read_pickle`, or if keys are missing or arrays are invalid.
    """
    raw = read_pickle(path)
    file_bytes = path.stat().st_size
    try:
        p, h, v = (_read_pixels(x, file_bytes) for x in raw["values"])
        ref_p, ref_h, ref_v = (_read_pixels(x, file_bytes) for x in raw["ref_values"])
        name = clean_line(raw["name"])
        angle = float(raw["incident_angle"])
        scan = clean_line(raw["collection_name"])
        reference = clean_line(raw["ref_name"])
        thickness = _parse_thickness(raw.get("thickness"))
        if not 0 < angle < 90:
            raise ValueError(f"incident_angle {angle:g}: expected degrees, above 0 and below 90")
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as e:
        raise DataError(
            f"{path}: not a material file: {type(e).__name__}: {e}",
            "expected a dict with name, collection_name, incident_angle, ref_name, values [P, H, V], ref_values",
            "leave the file out",
            code=ErrorCode.FILE_FOREIGN,
        ) from None
    if not p.size == h.size == v.size > 0 or not ref_p.size == ref_h.size == ref_v.size > 0:
        raise DataError(
            f"{path}: P, H and V have {p.size}, {h.size}, {v.size} pixels", "they belong to one box",
            "leave the file out", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    level_h = np.sqrt(np.mean(abs(ref_h) ** 2))
    level_v = np.sqrt(np.mean(abs(ref_v) ** 2))
    level_p = np.mean(ref_p)
    if not (np.isfinite([level_h, level_v, abs(level_p)]).all() and min(level_h, level_v, abs(level_p)) > 0):
        raise DataError(
            f"{path}: the reference {reference} has no signal", "ref_values are zero or not finite",
            "leave the file out", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return Entry(
        name=name,
        scan=scan,
        h=(abs(h) / level_h).astype(np.float32),
        v=(abs(v) / level_v).astype(np.float32),
        p=restore_phase_sign(p / level_p).astype(np.complex64),
        incidence_deg=angle,
        simulated=bool(raw.get("simulated", False)),
        thickness_mm=thickness,
        reference=reference,
    )


def read_materials(folder: Path) -> Library:
    """Read all material files of a folder as a library without a fit. Raises DataError, also without any file."""
    files = sorted(folder.glob("*.pkl"))
    if not files:
        raise DataError(
            f"{folder}: no material files", "expected <name>_<angle>.pkl", "give the materials/ folder",
            code=ErrorCode.FILE_MISSING,
        )  # fmt: skip
    return Library(tuple(read_material(f) for f in files), {}, f"{len(files)} material files of {folder.name}")


def _read_pixels(values: Any, file_bytes: int) -> npt.NDArray[np.complex128]:
    """Return the numbers of a file of that size. Raises ValueError if nested references expand to more."""
    is_plain = isinstance(values, list | tuple) and all(isinstance(v, int | float | complex) for v in values)
    if isinstance(values, np.ndarray):
        size = values.nbytes
    elif is_plain:
        size = len(values)
    else:
        size = file_bytes + 1
    if size > file_bytes:
        raise ValueError("pixels are not an array or list of numbers, or of more numbers than the file has bytes")
    return np.asarray(values, np.complex128).ravel()


def _parse_thickness(value: Any) -> float | None:
    """Return a thickness in mm, a number or a text such as "3 mm"; None if it is not given, or a text without one."""
    if isinstance(value, str):
        number = re.match(r"\s*(\d*\.?\d+)", value)
        value = number and number[1]
    return None if value is None else float(value)


@dataclass(frozen=True)
class Score:
    """Scores of a model.

    Attributes
    ----------
    model, channels, split
        Name, channels, and split of training and test data.
    pixels
        Share of pixels named right, classified independently: mean over materials.
    in_scan
        The same with the pixels of a scan named together.
    by_patch
        Share of pixels whose patch was named right, with the patches of a scan named together: mean over materials.
    patches
        Share of patches named right.
    unknown
        Share of the patches (all of known materials) that were called unknown.
    confusion
        float64 [material, material] of independent pixels: rows are the truth in the order of `names` and add to 1; 0
        in the rows of materials that were not judged.
    patch_confusion
        The same with each pixel named as its patch.
    names
        Materials, sorted.
    not_judged
        Materials without training pixels in other groups; the shares above are of the others.
    calibration
        Expected calibration error of the patches that were named (:func:`calibration_error`).
    named, said, right
        Number of patches that were named, their mean confidence, and the share of them that is right.
    """

    model: str
    channels: str
    split: str
    pixels: float
    in_scan: float
    by_patch: float
    patches: float
    unknown: float
    confusion: Real
    patch_confusion: Real
    names: tuple[str, ...]
    not_judged: tuple[str, ...] = ()
    calibration: float = float("nan")
    named: int = 0
    said: float = float("nan")
    right: float = float("nan")


def calibration_error(confidence: npt.NDArray, right: npt.NDArray) -> float:
    """Return the expected calibration error: |mean confidence - share right| in ten bins, weighted by their size.

    Both arrays are [patch]. Guo et al., On Calibration of Modern Neural Networks, ICML 2017. NaN without data.
    """
    if not len(confidence):
        return float("nan")
    bin_index = np.clip((np.asarray(confidence) * 10).astype(int), 0, 9)
    count = np.bincount(bin_index)
    difference = np.bincount(bin_index, confidence) - np.bincount(bin_index, right)
    return float(np.abs(difference).sum() / count.sum())


def split(samples: Samples, by_pixel: bool = False, folds: int = FOLDS) -> Iterator[tuple[npt.NDArray, npt.NDArray]]:
    """Yield indices [k] of the training and test pixels of each fold: whole groups, or single pixels.

    Every group is a fold of its own if `folds` could put all groups of a material into one fold.

    Raises DataError with fewer than two groups, or without a material in two groups; by pixel, in two pixels.
    """
    from sklearn.model_selection import GroupKFold, StratifiedKFold

    if by_pixel:
        sizes = np.unique(samples.names, return_counts=True)[1]
        if sizes.max() < 2:
            raise DataError(
                "no material has two pixels", "one is left out, and none would remain for training",
                "larger boxes, or more scans", code=ErrorCode.NOT_ENOUGH_DATA,
            )  # fmt: skip
        smallest = int(sizes.min())
        folds_kept = StratifiedKFold(max(2, min(folds, smallest)), shuffle=True, random_state=0)
        with warnings.catch_warnings():
            # A material of one pixel is not judged.
            warnings.filterwarnings("ignore", "The least populated class")
            pairs = list(folds_kept.split(samples.x, samples.names))
        yield from pairs
        return
    # Scans; those that show the same labelled specimen are one group.
    independent = samples.independent
    groups = np.unique(independent)
    if groups.size < 2:
        raise DataError(
            f"{groups.size} scan to judge a classifier on",
            "whole scans are left out, and none would remain for training",
            "give two scans or more, of each incidence angle", code=ErrorCode.NOT_ENOUGH_DATA,
        )  # fmt: skip
    if not samples.shared.any():
        raise DataError(
            f"no material is in two of the {groups.size} scans",
            "a scan left out has no material of the training scans",
            "process a second scan with the same materials",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    joined = replace(samples, groups=independent)
    group_counts = joined.groups_of_material[joined.shared]
    # The rarest material that can be judged has no more groups than one fold may have.
    if group_counts.size and group_counts.min() <= -(-groups.size // folds):
        folds = groups.size
    yield from GroupKFold(min(folds, groups.size)).split(samples.x, samples.names, independent)


def score(samples: Samples, model: str, channels: str = "H+V+P", by_pixel: bool = False, folds: int = FOLDS) -> Score:
    """Judge a model by cross-validation.

    `model` is a key of `MODELS`, `channels` one of `CHANNELS`. With `by_pixel` the split is by pixel instead of by
    group: optimistic, see the module's docstring. `folds` is the largest number of folds. Raises DataError with fewer
    than two groups, or without a material in two groups.
    """
    pixel_name = np.empty_like(samples.names)
    name_in_scan = np.empty_like(samples.names)
    patch_name = np.empty_like(samples.names)
    unknown, learnt = np.zeros((2, samples.names.size), bool)
    confidence = np.zeros(samples.names.size)
    for train, test in split(samples, by_pixel, folds):
        learnt[test] = np.isin(samples.names[test], samples.names[train])
        model_of_fold = MODELS[model](channels)
        model_of_fold.fit(samples.take(train))
        pixel_name[test], distance = model_of_fold.classify_pixels(samples.x[test])
        test_sets = [test]
        if model_of_fold.knows_scans:
            test_sets = [test[samples.groups[test] == group] for group in np.unique(samples.groups[test])]
        for test_set in test_sets:
            if model_of_fold.knows_scans:
                predicted = model_of_fold.by_scan(samples.x[test_set], samples.patches[test_set])
            else:
                predicted = name_by_majority(pixel_name[test_set], distance, samples.patches[test_set])
            row = np.searchsorted(predicted.patches, samples.patches[test_set])
            name_in_scan[test_set] = predicted.pixel_names
            patch_name[test_set] = predicted.names[row]
            # Distances are in units of the limit up to which a patch gets a name.
            unknown[test_set] = (predicted.distance > 1)[row]
            confidence[test_set] = predicted.confidence[row]
    names = np.unique(samples.names)
    tables = [_confusions(samples.names[learnt], p[learnt], names) for p in (pixel_name, name_in_scan, patch_name)]
    judged = np.isin(names, samples.names[learnt])
    # Each patch is represented by one pixel: patches of learnt materials, and those of them that were named.
    first = np.unique(samples.patches, return_index=True)[1]
    first = first[learnt[first]]
    named = first[~unknown[first]]
    right = (patch_name == samples.names)[named]
    pixels_right, in_scan_right, by_patch_right = (float(np.mean(np.diag(t)[judged])) for t in tables)
    scans = np.unique(samples.independent).size
    fold_kind = OPTIMISTIC_SPLIT if by_pixel else f"whole scans left out, {scans} scans"
    return Score(
        model=model, channels=channels, split=fold_kind,
        pixels=pixels_right, in_scan=in_scan_right, by_patch=by_patch_right,
        patches=float(np.mean((patch_name == samples.names)[first])), unknown=float(np.mean(unknown[first])),
        confusion=tables[0], patch_confusion=tables[2],
        names=tuple(str(n) for n in names), not_judged=tuple(str(n) for n in names[~judged]),
        calibration=calibration_error(confidence[named], right), named=int(named.size),
        said=float(confidence[named].mean()) if named.size else float("nan"),
        right=float(right.mean()) if named.size else float("nan"),
    )  # fmt: skip


def _confusions(true_names: npt.NDArray, predicted: npt.NDArray, names: npt.NDArray) -> Real:
    """Return the table of `Score.confusion` for pixels [n] of these true and predicted names."""
    table = np.zeros((names.size, names.size))
    np.add.at(table, (np.searchsorted(names, true_names), np.searchsorted(names, predicted)), 1)
    return table / np.maximum(table.sum(axis=1, keepdims=True), 1)


def score_unseen_materials(samples: Samples, model: str) -> dict[str, float]:
    """Return the share of each material's patches that are called unknown if it is left out of the training data.

    The other materials are learnt from other scans than the judged one, as always.
    """
    scores = {}
    for name in np.unique(samples.names):
        called_unknown = []
        for train, test in split(samples):
            other_samples = train[samples.names[train] != name]
            fitted = MODELS[model]("H+V+P")
            fitted.fit(samples.take(other_samples))
            for group in np.unique(samples.groups[test]):
                test_set = test[samples.groups[test] == group]
                naming = fitted.by_scan(samples.x[test_set], samples.patches[test_set])
                own_patches = np.unique(samples.patches[test_set][samples.names[test_set] == name])
                called_unknown += list(naming.distance[np.searchsorted(naming.patches, own_patches)] > 1)
        scores[str(name)] = float(np.mean(called_unknown))
    return scores


def fit_library(library: Library) -> Library:
    """Return the library with its fit, for each incidence angle and for all together.

    Raises DataError with fewer than two scans of an angle, or without a material in two of them: a split by pixel would
    be too optimistic.
    """
    entries = {f"{angle:g}": library.at_angle(angle) for angle in library.angles_deg}
    samples = {angle: Samples.from_library(part, PATCH_PIXELS) for angle, part in entries.items()}
    fits = {angle: fit_samples(angle_samples) for angle, angle_samples in samples.items()}
    if len(samples) > 1:
        fits["+".join(samples)] = fit_samples(reduce(Samples.join, samples.values()))
    return Library(library.entries, {"angles": fits}, library.note)


def fit_samples(samples: Samples) -> dict[str, Any]:
    """Return model and scores on labelled pixels, as plain values for a library's file.

    The scores are of materials in two or more scans; `not_judged` lists the others. `pixel_accuracy`, `patch_accuracy`
    and `named` are None, and `judged` is empty, if no material but metal is in two scans. `weights`, `thresholds` and
    `by_channel` are for the paper's KNN (`fit_weights`).
    """
    scores = {model: score(samples, model) for model in MODELS}
    weighted = fit_weights(samples)
    own_score = scores[DISCRIMINANT_MODEL]
    judged = {s.model: {"pixels": s.pixels, "patches": s.patches} for s in scores.values()}
    for name in (DISCRIMINANT_MODEL, PAPER_MODEL):
        judged[name]["pixels_split_by_pixel"] = score(samples, name, by_pixel=True).pixels
    if all(is_metal(name) for name in set(own_score.names) - set(own_score.not_judged)):
        # All is relative to metal: that it is named right says nothing about names.
        judged = {}
    return {
        "model": DISCRIMINANT_MODEL,
        "weights": weighted.weights.to_dict(),
        "thresholds": weighted.thresholds,
        "by_channel": weighted.by_channel,
        "split": own_score.split,
        "pixel_accuracy": own_score.pixels if judged else None,
        "patch_accuracy": own_score.patches if judged else None,
        "known_called_unknown": own_score.unknown,
        "pixel_accuracy_in_scan": own_score.in_scan,
        "calibration_error": own_score.calibration,
        "named": own_score.named if judged else None,
        "said": own_score.said,
        "right": own_score.right,
        "scans": int(np.unique(samples.groups).size),
        "specimen_freedom": count_specimen_freedom(samples),
        "alike": find_alike_pairs(samples),
        "judged": judged,
        "materials": len(own_score.names),
        "not_judged": list(own_score.not_judged),
    }


@dataclass(frozen=True)
class TrainingScan:
    """One processed scan for training.

    Attributes
    ----------
    scan
        Its name; training and test data are split by it.
    result
        Result of :func:`polysight.materials.analyse`, made with the truth's plates.
    simulated
        True if it was simulated.
    versions
        Versions of the programs that made it.
    names
        Patch number to name, if drawn by hand instead of matched to a truth.
    specimens
        Patch number to physical piece, if known.
    """

    scan: str
    result: MaterialsResult
    simulated: bool
    versions: Mapping[str, str] | None = None
    names: Mapping[int, str] | None = None
    specimens: Mapping[int, str] | None = None


def make_entries(scan: TrainingScan) -> list[Entry]:
    """Return the library entries of one scan: each patch of known material, with up to `PATCH_PIXELS` pixels.

    Pixels are taken at even intervals, so that the same scan always gives the same entries.
    """
    entries = []
    result = scan.result
    for patch in result.patches:
        name = (scan.names or {}).get(patch.patch.label) or (patch.truth.name if patch.truth else None)
        rows, cols = np.nonzero(result.usable_pixels(patch.patch))
        if name is None or rows.size == 0:
            continue
        pick = np.unique(np.linspace(0, rows.size - 1, min(PATCH_PIXELS, rows.size)).round().astype(int))
        picked = (rows[pick], cols[pick])
        eps = patch.truth.permittivity if patch.truth else None
        theta = result.theta_rad[picked] if result.theta_rad.ndim else result.theta_rad
        entries.append(
            Entry(
                name=name,
                scan=scan.scan,
                h=np.abs(result.h[picked]).astype(np.float32),
                v=np.abs(result.v[picked]).astype(np.float32),
                p=result.p[picked].astype(np.complex64),
                incidence_deg=float(np.degrees(np.mean(theta))),
                simulated=scan.simulated,
                thickness_mm=patch.truth.thickness_mm if patch.truth else None,
                permittivity=None if eps is None else (eps.real, -eps.imag),
                versions=dict(scan.versions or {}),
                specimen=(scan.specimens or {}).get(patch.patch.label),
            )
        )
    return entries


def make_library(scans: Iterable[TrainingScan], note: str = "") -> Library:
    """Make a library of several scans, with its fit.

    Raises DataError with no patch of known material, or as :func:`fit_library`.
    """
    entries = [e for scan in scans for e in make_entries(scan)]
    if not entries:
        raise DataError(
            "no patch of known material in these scans",
            "they have no truth.json or labels, or no patch matches them by position",
            "label the patches: polysight label SCAN",
            code=ErrorCode.NO_DATA,
        )
    return fit_library(Library(tuple(entries), {}, note))
