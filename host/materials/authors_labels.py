"""The published data set's label folders: SAR pairs with boxes drawn by hand, read into library entries.

`labels/<scan>/{sar_h,sar_v}.npy` and `<scan>.json`. A box is [x0, y0, x1, y1] in pixels. Which way its y counts, and
whether the images are [y, x] or [x, y], is not written anywhere; one convention holds for all scans, so that the images
tell it: under the right one the boxes explain most of the images' brightness.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from polysight.host.materials.labels import read_labels
from polysight.host.materials.library import Entry
from polysight.host.materials.segment import Box
from polysight.host.polarimetry import calibrate
from polysight.shared.errors import DataError

Image = npt.NDArray[np.complexfloating]
METALS = ("metal", "copper", "aluminium", "aluminum", "steel", "brass", "iron")
PIXELS = 120
"""Of a box, at even intervals: the paper's "about 80 to 120" for each material."""
TURNS = {
    "x to the right, y along the rows": lambda a: a,
    "y from the last row": lambda a: a[::-1],
    "x and y swapped": lambda a: a.T,
    "x and y swapped, y from the last row": lambda a: a.T[::-1],
}
_CLEARLY = 0.05  # how much more of the brightness another reading must explain


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

    def turned(self, how: str) -> LabelledScan:
        """The same with the images read another way, a key of `TURNS`."""
        turn = TURNS[how]
        return LabelledScan(self.scan, self.description, turn(self.h), turn(self.v), self.boxes, self.simulated)

    @property
    def metal(self) -> str | None:
        """Name of the largest box of metal."""
        metals = [n for n in self.boxes if is_metal(n)]
        return max(metals, key=lambda n: self.mask(n).sum(), default=None)


def is_metal(name: str) -> bool:
    """Whether a material's name is that of a metal."""
    return any(word in METALS for word in re.findall(r"[a-z]+", name.lower()))


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
    boxes = read_labels(file)
    description = str(json.loads(file.read_text(encoding="utf-8")).get("description", ""))
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


def explained(scan: LabelledScan) -> float:
    """Share of the brightness' variance (in dB) between pixels that is explained by the box they lie in, 0 to 1."""
    level = np.log(np.maximum(np.abs(scan.h) * np.abs(scan.v), 1e-30)).astype(np.float64)
    label = np.zeros(level.shape, int)
    for i, name in enumerate(scan.boxes, 1):
        label[scan.mask(name)] = i
    within = sum(float(((level[label == k] - level[label == k].mean()) ** 2).sum()) for k in np.unique(label))
    return 1 - within / max(float(((level - level.mean()) ** 2).sum()), 1e-30)


def reading_of(scans: Sequence[LabelledScan]) -> str:
    """How a data set's images are to be read, a key of `TURNS`: the first, unless another explains clearly more."""
    shares = {}
    for how in TURNS:
        try:
            shares[how] = float(np.mean([explained(s.turned(how)) for s in scans]))
        except DataError:  # a box outside the image
            shares[how] = -1.0
    first, best = next(iter(TURNS)), max(shares, key=lambda h: shares[h])
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


def told_angle(texts: Iterable[str]) -> float | None:
    """An incidence angle told in words, as in "60 deg" or "scan_55degrees"; None when there is none."""
    for text in texts:
        found = re.search(r"(\d{2}(?:\.\d+)?)\s*(?:°|deg)", text.lower())
        if found:
            return float(found[1])
    return None
