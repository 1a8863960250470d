"""The published data set's labels and material files, read into library entries; material files are written too.

`labels/<scan>/{sar_h,sar_v}.npy` and `<scan>.json`: images with boxes [x0, y0, x1, y1] in pixels. Which way a box's y
counts, and whether the images are [y, x] or [x, y], is not written anywhere; one convention holds for all scans, so
that the images tell it: under the right one the boxes explain most of the images' brightness.

`materials/<name>_<angle>.pkl`: pixels of one material and of its metal reference. The pickles are read with an
unpickler that admits arrays and plain types only.
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

from polysight.host.materials.labels import METALS, is_metal, read_labels
from polysight.host.materials.library import Entry, Library
from polysight.host.materials.segment import Box
from polysight.host.polarimetry import calibrate
from polysight.shared.errors import DataError
from polysight.shared.files import read_bounded, read_json

Image = npt.NDArray[np.complexfloating]
PIXELS = 120
"""Of a box, at even intervals: the paper's "about 80 to 120" for each material."""
ORIENTATIONS = {
    "x to the right, y along the rows": lambda a: a,
    "y from the last row": lambda a: a[::-1],
    "x and y swapped": lambda a: a.T,
    "x and y swapped, y from the last row": lambda a: a.T[::-1],
}
_CLEARLY = 0.05  # how much more of the brightness another reading must explain
_ADMITTED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("builtins", "complex"),
    ("_codecs", "encode"),
    *(
        (module, name)
        for module, names in {
            "multiarray": ("_reconstruct", "scalar"),
            "numeric": ("_frombuffer",),
        }.items()
        for name in names
        for module in (f"numpy.core.{module}", f"numpy._core.{module}")
    ),
}


@dataclass(frozen=True)
class LabelledScan:
    """A pair of images and its boxes.

    Attributes
    ----------
    scan, description
        Folder name, and the file's own words.
    h, v
        complex64 [ny, nx].
    boxes
        Name to pixel corners (x0, y0, x1, y1), ends left out.
    simulated
        Whether the description says so.
    """

    scan: str
    description: str
    h: Image
    v: Image
    boxes: dict[str, Box]
    simulated: bool

    def mask(self, name: str) -> npt.NDArray[np.bool_]:
        """Pixels of a box, bool [ny, nx]. Raises DataError when there are none."""
        x0, y0, x1, y1 = (round(b) for b in self.boxes[name])
        mask = np.zeros(self.h.shape, bool)
        mask[max(min(y0, y1), 0) : max(y0, y1, 0), max(min(x0, x1), 0) : max(x0, x1, 0)] = True
        if not mask.any():
            raise DataError(
                f"{self.scan}: the box of {name}, {self.boxes[name]}, holds no pixel of the {self.h.shape} image"
            )
        return mask

    def oriented(self, how: str) -> LabelledScan:
        """The same with the images read another way, a key of `ORIENTATIONS`."""
        turn = ORIENTATIONS[how]
        return LabelledScan(self.scan, self.description, turn(self.h), turn(self.v), self.boxes, self.simulated)

    @property
    def metal(self) -> str | None:
        """Name of the largest box of metal."""
        metals = [n for n in self.boxes if is_metal(n)]
        return max(metals, key=lambda n: self.mask(n).sum(), default=None)


def read_labelled_scan(folder: Path) -> LabelledScan:
    """Read `labels/<scan>`.

    Raises
    ------
    DataError
        when a file is absent or has another form.
    """
    file = folder / f"{folder.name}.json"
    if not file.exists():
        others = sorted(folder.glob("*.json"))
        if len(others) != 1:
            raise DataError(f"{file}: no such label file", "the download is not complete", "fetch the scan again")
        file = others[0]
    boxes = dict(read_labels(file).boxes)
    description = str(read_json(file).get("description", ""))
    images = []
    for name in ("sar_h", "sar_v"):
        path = folder / f"{name}.npy"
        try:
            image = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as e:
            raise DataError(f"{path}: not an image: {e}", "the download is not complete", "fetch it again") from None
        if image.ndim != 2 or not np.iscomplexobj(image):
            raise DataError(f"{path}: {image.dtype} {image.shape}", "expected a complex image [150, 150]")
        images.append(image.astype(np.complex64))
    if images[0].shape != images[1].shape:
        raise DataError(f"{folder}: images of {images[0].shape} and {images[1].shape}", "they are not of one scan")
    return LabelledScan(folder.name, description, images[0], images[1], boxes, "simulated" in description.lower())


def explained_variance(scan: LabelledScan) -> float:
    """Share of the brightness' variance (in dB) between pixels that is explained by the box they lie in, 0 to 1."""
    level = np.log(np.maximum(np.abs(scan.h) * np.abs(scan.v), 1e-30)).astype(np.float64)
    label = np.zeros(level.shape, int)
    for i, name in enumerate(scan.boxes, 1):
        label[scan.mask(name)] = i
    within = sum(float(((level[label == k] - level[label == k].mean()) ** 2).sum()) for k in np.unique(label))
    return 1 - within / max(float(((level - level.mean()) ** 2).sum()), 1e-30)


def image_orientation(scans: Sequence[LabelledScan]) -> str:
    """How a data set's images are to be read, a key of `ORIENTATIONS`: the first, unless another explains clearly more."""
    shares = {}
    for how in ORIENTATIONS:
        try:
            shares[how] = float(np.mean([explained_variance(s.oriented(how)) for s in scans]))
        except DataError:  # a box outside the image
            shares[how] = -1.0
    first, best = next(iter(ORIENTATIONS)), max(shares, key=lambda h: shares[h])
    return best if shares[best] > shares[first] + _CLEARLY else first


def entries_of_boxes(scan: LabelledScan, angle_deg: float, pixels: int = PIXELS) -> list[Entry]:
    """Library entries of a labelled scan, each box relative to the scan's metal; leakage is left in.

    Parameters
    ----------
    scan
        Read the right way.
    angle_deg
        Incidence angle.
    pixels
        At most so many of a box.

    Raises
    ------
    DataError
        when no box is of metal, or a box holds no pixel.
    """
    if scan.metal is None:
        raise DataError(
            f"{scan.scan}: none of its boxes is of metal: {', '.join(scan.boxes)}",
            "everything is measured relative to metal",
            f"a metal box has one of these words in its name: {', '.join(METALS)}",
        )
    relative = calibrate(scan.h, scan.v, scan.mask(scan.metal) & (scan.h != 0) & (scan.v != 0))
    h, v = relative.h, relative.v
    out = []
    for name in scan.boxes:
        hs, vs = h[scan.mask(name)], v[scan.mask(name)]
        good = np.flatnonzero(np.isfinite(hs) & np.isfinite(vs) & (hs != 0) & (vs != 0))
        if good.size == 0:
            continue
        at = good[np.unique(np.linspace(0, good.size - 1, min(pixels, good.size)).round().astype(int))]
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
    """The scans of a `labels/` folder."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and any(p.glob("*.json"))) if folder.is_dir() else []


def angle_in_text(texts: Iterable[str]) -> float | None:
    """An incidence angle told in words, as in "60 deg" or "scan_55degrees"; None when there is none."""
    for text in texts:
        found = re.search(r"(\d{2}(?:\.\d+)?)\s*(?:°|deg)", text.lower())
        if found:
            return float(found[1])
    return None


_MOST_BYTES = 1 << 30


class _Restricted(pickle.Unpickler):
    """An unpickler for arrays and plain types."""

    def find_class(self, module: str, name: str) -> Any:
        """The named constructor, if it is one of numpy's arrays. Raises UnpicklingError."""
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"it wants to call {module}.{name}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Content of a pickle of arrays and plain types.

    Raises
    ------
    DataError
        when the file is absent, damaged, or would call anything but numpy's array constructors.
    """
    try:
        return _Restricted(io.BytesIO(read_bounded(path, _MOST_BYTES))).load()
    except DataError:
        raise
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror}", "the path is wrong, or you may not read it") from None
    except pickle.UnpicklingError as e:
        raise DataError(
            f"{path}: refused: {e}",
            "a pickle can run any program; here only numpy arrays and plain types are read",
            "do not open it with pickle.load unless you trust its maker",
        ) from None
    except Exception as e:  # noqa: BLE001 - a damaged pickle raises anything
        raise DataError(f"{path}: not a pickle: {type(e).__name__}: {e}", "it is cut short or another file") from None


def read_material(path: Path) -> Entry:
    """One material file as an entry of the library, divided by its reference.

    `values` and `ref_values` are [P, H, V]; P is divided by the reference's mean P, H and V by the root mean square
    of its amplitudes (Eq. 8 and 9 of the paper).

    Raises
    ------
    DataError
        as :func:`read_pickle`, or when keys are missing or arrays have another form.
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
        ) from None
    if not p.size == h.size == v.size > 0 or not ref_p.size == ref_h.size == ref_v.size > 0:
        raise DataError(f"{path}: P, H and V have {p.size}, {h.size}, {v.size} pixels", "they belong to one box")
    level_h, level_v, level_p = np.sqrt(np.mean(abs(ref_h) ** 2)), np.sqrt(np.mean(abs(ref_v) ** 2)), np.mean(ref_p)
    if not (np.isfinite([level_h, level_v, abs(level_p)]).all() and min(level_h, level_v, abs(level_p)) > 0):
        raise DataError(f"{path}: the reference {reference} holds no signal", "ref_values are zero or not finite")
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
    """All material files of a folder as a library, not yet fitted. Raises DataError, also when there is none."""
    files = sorted(folder.glob("*.pkl"))
    if not files:
        raise DataError(f"{folder}: no material files", "expected <name>_<angle>.pkl", "give the materials/ folder")
    return Library(tuple(read_material(f) for f in files), {}, f"{len(files)} material files of {folder.name}")


def write_material(path: Path, entry: Entry) -> None:
    """Write an entry as a material file of the published form; its reference is an ideal metal.

    One key more than the published files have: `simulated`, so that what was simulated is called so when it is read.
    """
    one = np.ones(1, np.complex64)
    content = {
        "name": entry.name,
        "thickness": entry.thickness_mm,
        "collection_name": entry.scan,
        "incident_angle": entry.incidence_deg,
        "ref_name": entry.reference or "metal",
        "ref_thickness": None,
        "values": [entry.p, entry.h.astype(np.complex64), entry.v.astype(np.complex64)],
        "ref_values": [one, one, one],
        "simulated": entry.simulated,
    }
    path.write_bytes(pickle.dumps(content))


def write_materials(folder: Path, entries: Iterable[Entry]) -> None:
    """Write entries as `<name>_<angle>.pkl`; entries of one name and angle from several scans are numbered."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, entry in enumerate(entries):
        safe = "".join(c if c.isalnum() or c in "-." else "-" for c in entry.name).strip("-")
        path = folder / f"{safe}_{entry.incidence_deg:.0f}.pkl"
        write_material(path if not path.exists() else path.with_stem(f"{path.stem}_{i}"), entry)


def _pixels(values: Any, most: int) -> npt.NDArray[np.complex128]:
    """Numbers of a file of `most` bytes. Raises ValueError: lists of lists that are one list can be of any size."""
    plain = isinstance(values, list | tuple) and all(isinstance(v, int | float | complex) for v in values)
    size = values.nbytes if isinstance(values, np.ndarray) else len(values) if plain else most + 1
    if size > most:
        raise ValueError("pixels are not an array or list of numbers, or of more numbers than the file has bytes")
    return np.asarray(values, np.complex128).ravel()


def _number(value: Any) -> float | None:
    if isinstance(value, str):  # "3 mm"
        value = value.lower().removesuffix("mm").strip()
    return None if value is None or value == "" else float(value)
