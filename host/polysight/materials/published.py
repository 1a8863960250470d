"""Read the published data set's labels and material files into library entries.

`labels/<scan>/{sar_h,sar_v}.npy` and `<scan>.json`: images with boxes [x0, y0, x1, y1] in pixels. The direction of y,
and the order [y, x] or [x, y] of the images, is not documented. All scans share one convention, which is found from the
images: with the right one the boxes explain most of the brightness.

`materials/<name>_<angle>.pkl`: pixels of one material and of its metal reference. The pickles are read with an
unpickler that allows arrays and plain types only.
"""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.materials.labels import METALS, is_metal, read_labels
from polysight.materials.library import Entry, Library
from polysight.materials.segment import Box
from polysight.polarimetry import metal_gains
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import read_bounded, read_json

Image = npt.NDArray[np.complexfloating]
PIXELS = 120
"""Largest number of pixels of a box, at even intervals: the paper's "about 80 to 120" for each material."""
ORIENTATIONS = {
    "x to the right, y along the rows": lambda a: a,
    "y from the last row": lambda a: a[::-1],
    "x and y swapped": lambda a: a.T,
    "x and y swapped, y from the last row": lambda a: a.T[::-1],
}
_CLEARLY = 0.05  # how much more of the variance another orientation must explain
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
                f"{self.scan}: the box of {name}, {self.boxes[name]}, holds no pixel of the {self.h.shape} image",
                code=ErrorCode.NO_DATA,
            )
        return mask

    def oriented(self, how: str) -> LabelledScan:
        """Return the scan with its images in another orientation, a key of `ORIENTATIONS`."""
        turn = ORIENTATIONS[how]
        return LabelledScan(self.scan, self.description, turn(self.h), turn(self.v), self.boxes, self.simulated)

    @property
    def metal(self) -> str | None:
        """Name of the largest metal box; None without one."""
        metals = [n for n in self.boxes if is_metal(n)]
        return max(metals, key=lambda n: self.mask(n).sum(), default=None)


def read_labelled_scan(folder: Path) -> LabelledScan:
    """Read `labels/<scan>`.

    Raises DataError if a file is missing or invalid.
    """
    file = folder / f"{folder.name}.json"
    if not file.exists():
        others = sorted(folder.glob("*.json"))
        if len(others) != 1:
            raise DataError(
                f"{file}: no such label file", "the download is not complete", "fetch the scan again",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        file = others[0]
    boxes = dict(read_labels(file).boxes)
    description = str(read_json(file).get("description", ""))
    images = []
    for name in ("sar_h", "sar_v"):
        path = folder / f"{name}.npy"
        try:
            image = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as e:
            raise DataError(
                f"{path}: not an image: {e}", "the download is not complete", "fetch it again",
                code=ErrorCode.FILE_UNREADABLE,
            ) from None  # fmt: skip
        if image.ndim != 2 or not np.iscomplexobj(image):
            raise DataError(
                f"{path}: {image.dtype} {image.shape}", "expected a complex image [150, 150]", code=ErrorCode.TYPE_WRONG
            )
        images.append(image.astype(np.complex64))
    if images[0].shape != images[1].shape:
        raise DataError(
            f"{folder}: images of {images[0].shape} and {images[1].shape}", "they are not of one scan",
            code=ErrorCode.MISMATCH,
        )  # fmt: skip
    return LabelledScan(folder.name, description, images[0], images[1], boxes, "simulated" in description.lower())


def explained_variance(scan: LabelledScan) -> float:
    """Return the share of the variance of the pixels' brightness (dB) that the boxes explain, 0 to 1."""
    level = np.log(np.maximum(np.abs(scan.h) * np.abs(scan.v), 1e-30)).astype(np.float64)
    label = np.zeros(level.shape, int)
    for i, name in enumerate(scan.boxes, 1):
        label[scan.mask(name)] = i
    within = sum(float(((level[label == k] - level[label == k].mean()) ** 2).sum()) for k in np.unique(label))
    return 1 - within / max(float(((level - level.mean()) ** 2).sum()), 1e-30)


def image_orientation(scans: Sequence[LabelledScan]) -> str:
    """Return the orientation of a data set's images: the first of `ORIENTATIONS`, unless another explains more."""
    shares = {}
    for how in ORIENTATIONS:
        try:
            shares[how] = float(np.mean([explained_variance(s.oriented(how)) for s in scans]))
        except DataError:  # a box outside the image
            shares[how] = -1.0
    first, best = next(iter(ORIENTATIONS)), max(shares, key=lambda h: shares[h])
    return best if shares[best] > shares[first] + _CLEARLY else first


def entries_of_boxes(scan: LabelledScan, angle_deg: float) -> list[Entry]:
    """Return library entries of a labelled scan, each box relative to the scan's metal; leakage is not removed.

    The scan is in the right orientation.

    Raises DataError if no box is of metal, or a box holds no pixel.
    """
    if scan.metal is None:
        raise DataError(
            f"{scan.scan}: none of its boxes is of metal: {', '.join(scan.boxes)}",
            "everything is measured relative to metal",
            f"a metal box has one of these words in its name: {', '.join(METALS)}",
            code=ErrorCode.NO_DATA,
        )
    metal_h, metal_v = metal_gains(scan.h, scan.v, scan.mask(scan.metal) & (scan.h != 0) & (scan.v != 0))
    h = scan.h / np.asarray(metal_h, scan.h.dtype)
    v = scan.v / np.asarray(metal_v, scan.v.dtype)
    out = []
    for name in scan.boxes:
        hs, vs = h[scan.mask(name)], v[scan.mask(name)]
        good = np.flatnonzero(np.isfinite(hs) & np.isfinite(vs) & (hs != 0) & (vs != 0))
        if good.size == 0:
            continue
        at = good[np.unique(np.linspace(0, good.size - 1, min(PIXELS, good.size)).round().astype(int))]
        out.append(
            Entry(
                name=name,
                scan=scan.scan,
                h=np.abs(hs[at]).astype(np.float32),
                v=np.abs(vs[at]).astype(np.float32),
                p=(hs[at] / vs[at]).astype(np.complex64),
                incidence_deg=angle_deg,
                simulated=scan.simulated,
                reference=scan.metal,
            )
        )
    return out


def label_folders(folder: Path) -> list[Path]:
    """Return the folders of scans in a `labels/` folder."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and any(p.glob("*.json"))) if folder.is_dir() else []


def angle_in_text(texts: Iterable[str]) -> float | None:
    """Return the incidence angle in texts such as "60 deg" or "scan_55degrees", degrees; None without one."""
    for text in texts:
        found = re.search(r"(\d{2}(?:\.\d+)?)\s*(?:°|deg)", text.lower())
        if found:
            return float(found[1])
    return None


_MAX_BYTES = 1 << 30


class _Restricted(pickle.Unpickler):
    """An unpickler for arrays and plain types."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the named constructor if it is one of numpy's arrays. Raises UnpicklingError."""
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it wants to call {module}.{name}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Read a pickle of arrays and plain types.

    Raises DataError if the file is missing, damaged, or would call anything but numpy's array constructors.
    """
    try:
        return _Restricted(io.BytesIO(read_bounded(path, _MAX_BYTES))).load()
    except DataError:
        raise
    except OSError as e:
        raise DataError(
            f"{path}: cannot be read: {e.strerror}", "the path is wrong, or you may not read it",
            code=ErrorCode.FILE_UNREADABLE,
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
            code=ErrorCode.FILE_DAMAGED,
        ) from None  # fmt: skip


def read_material(path: Path) -> Entry:
    """Read a material file as a library entry, divided by its reference.

    `values` and `ref_values` are [P, H, V]; P is divided by the reference's mean P, H and V by the root mean square
    of its amplitudes (Eq. 8 and 9 of the paper).

    Raises DataError as :func:`read_pickle`, or if keys are missing or arrays are invalid.
    """
    raw, most = read_pickle(path), path.stat().st_size
    try:
        p, h, v = (_pixels(x, most) for x in raw["values"])
        ref_p, ref_h, ref_v = (_pixels(x, most) for x in raw["ref_values"])
        name, angle = str(raw["name"]), float(raw["incident_angle"])
        scan, reference = str(raw["collection_name"]), str(raw["ref_name"])
        thickness = _number(raw.get("thickness"))
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise DataError(
            f"{path}: not a material file: {type(e).__name__}: {e}",
            "expected a dict with name, collection_name, incident_angle, ref_name, values [P, H, V], ref_values",
            code=ErrorCode.FILE_FOREIGN,
        ) from None
    if not p.size == h.size == v.size > 0 or not ref_p.size == ref_h.size == ref_v.size > 0:
        raise DataError(
            f"{path}: P, H and V have {p.size}, {h.size}, {v.size} pixels", "they belong to one box",
            code=ErrorCode.MISMATCH,
        )  # fmt: skip
    level_h, level_v, level_p = np.sqrt(np.mean(abs(ref_h) ** 2)), np.sqrt(np.mean(abs(ref_v) ** 2)), np.mean(ref_p)
    if not (np.isfinite([level_h, level_v, abs(level_p)]).all() and min(level_h, level_v, abs(level_p)) > 0):
        raise DataError(
            f"{path}: the reference {reference} has no signal", "ref_values are zero or not finite",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return Entry(
        name=name,
        scan=scan,
        h=(abs(h) / level_h).astype(np.float32),
        v=(abs(v) / level_v).astype(np.float32),
        p=(p / level_p).astype(np.complex64),
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


def _pixels(values: Any, most: int) -> npt.NDArray[np.complex128]:
    """Return the numbers of a file of `most` bytes. Raises ValueError: nested references can expand to any size."""
    plain = isinstance(values, list | tuple) and all(isinstance(v, int | float | complex) for v in values)
    size = values.nbytes if isinstance(values, np.ndarray) else len(values) if plain else most + 1
    if size > most:
        raise ValueError("pixels are not an array or list of numbers, or of more numbers than the file has bytes")
    return np.asarray(values, np.complex128).ravel()


def _number(value: Any) -> float | None:
    if isinstance(value, str):  # "3 mm"
        value = value.lower().removesuffix("mm").strip()
    return None if value is None or value == "" else float(value)
