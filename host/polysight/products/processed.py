"""One processed scan: images, patches, quality, verdict and provenance, just computed or read from its folder.

The files are image.npz, materials.json, quality.json and scan.json, which are written atomically; docs/spec/products.md
has their formats. `find_products` finds a folder of products, and `ProcessedScan` reads its files. If the verdict is
"no result", it leaves out names and permittivities (`ScanMaterials`).
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Required, Self, TypedDict, Unpack

import numpy as np
import numpy.typing as npt
import skimage
from msgspec import UNSET

from polysight.imaging import Image, Images
from polysight.materials import (
    PATCHES_FILE,
    UNKNOWN,
    MaterialsResult,
    ScanPatches,
    TruthPlate,
    axis_mm,
    box_mask,
    image_extent_mm,
    predict_pixel_accuracy,
    read_patches,
)
from polysight.results import (
    PatchFigures,
    RawDropped,
    RxGain,
    ScanFacts,
    ScanMaterials,
    ScanQuality,
    Verdict,
    damage_error,
    encode_json,
)
from polysight.store import open_npz
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode, make_missing_path_error
from polysight_shared.files import write_atomically
from polysight_shared.raster import RasterPlan, plan_raster
from polysight_shared.tables import decode

# Names of the products in their folder.
SCAN = "scan.json"
IMAGE = "image.npz"
QUALITY = "quality.json"
MATERIALS = "materials.json"
LABELS = "labels.json"
REPORT = "report.html"
# File with the settings of the products, which batch processing writes.
FINISHED = ".finished.json"
# Arrays of image.npz and their types.
_ARRAYS = {
    "h": np.complex64,
    "v": np.complex64,
    "p": np.complex64,
    "x_m": np.float64,
    "y_m": np.float64,
    "valid": np.bool_,
    "p_sigma": np.float32,
    "raised_m": np.float32,
}
# Arrays of image.npz that not every scan has, or that earlier releases did not write.
_OPTIONAL = ("p_sigma", "raised_m")


class PlatesNamed(NamedTuple):
    """Result of naming the plates of a scene: `right` of `plates` plates were named right.

    `strange` further plates are of materials that the library does not contain, and were rightly called unknown.
    """

    right: int
    plates: int
    strange: int


Labels = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
# Patch number to the names of its interior's pixels in image order, and that interior.
PixelNames = Mapping[int, tuple[npt.NDArray[np.str_], Mask]]
# Folder of the products in a scan folder.
_PRODUCTS = "products"


def write_image(path: Path, images: Images, simulated: bool = False) -> None:
    """Write image.npz: h, v, p complex64 [ny, nx], x_m, y_m float64, valid bool; row 0 is the smallest y.

    `p_sigma` and `raised_m` float32 [ny, nx] are left out if they are None, and `simulated` if it is false.

    Raises
    ------
    DataError
        if the shapes do not agree, or there is no ratio p.
    """
    arrays = {name: getattr(images, name) for name in _ARRAYS if getattr(images, name) is not None}
    try:
        _check_image(arrays)
    except (KeyError, ValueError) as e:
        raise DataError(
            f"{path}: no image: {e}", "arrays are missing or differ in shape", "process the scan again",
            code=ErrorCode.MISMATCH,
        ) from None  # fmt: skip
    buffer = io.BytesIO()
    arrays_to_store: dict[str, Any] = {name: np.asarray(array, _ARRAYS[name]) for name, array in arrays.items()}
    if simulated:
        # Without this mark the images would count as measured, if a user gives this file as images of another program.
        arrays_to_store["simulated"] = np.bool_(True)
    np.savez_compressed(buffer, **arrays_to_store)
    write_atomically(path, buffer.getvalue())


def read_image(path: Path) -> Images:
    """Read image.npz (no pickle), with `p_sigma` and `raised_m` if the file has them. Raises DataError."""
    try:
        with open_npz(path) as z:
            arrays = {name: z[name] for name in _ARRAYS if name in z or name not in _OPTIONAL}
        _check_image(arrays)
        rows, columns = arrays["valid"].shape
        if min(rows, columns) < 2:
            raise ValueError(f"an image has at least 2 x 2 pixels, not {columns} x {rows}")
        return Images(**arrays)
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: not an image product: {e}",
            "it was not written by polysight process or image",
            "process the scan again",
            code=ErrorCode.FILE_DAMAGED,
        ) from None


def _check_image(arrays: dict[str, npt.NDArray]) -> None:
    """Raise ValueError or KeyError if types or shapes of the arrays are wrong, or the ratio is missing."""
    shape = arrays["y_m"].size, arrays["x_m"].size
    if "p" not in arrays:
        raise KeyError("p")
    for name, array in arrays.items():
        if array.dtype.kind not in "cfb":
            raise ValueError(f"{name} contains {array.dtype}, not numbers")
        if name not in ("x_m", "y_m") and array.shape != shape:
            raise ValueError(f"{name} is {' x '.join(map(str, array.shape))}, x_m and y_m are {shape[0]} x {shape[1]}")


def write_json(path: Path, content: Any) -> None:
    """Write a value as a JSON file, see :func:`polysight.results.to_plain`."""
    write_atomically(path, encode_json(content).encode("utf-8"))


def rx_gains(images: Images) -> dict[str, list[RxGain]]:
    """Return gain and phase of each RX relative to its board's first, by board, as divided out of the images.

    The value is None for a dead RX. If the first RX is dead, the first one with a signal replaces it.
    """
    gains = {}
    for board, values in images.rx_gains.items():
        has_gain = np.isfinite(values)
        relative = values / values[np.argmax(has_gain)]
        gains[board] = [
            RxGain(gain_db=float(20 * np.log10(abs(g))), phase_deg=float(np.degrees(np.angle(g))))
            if has
            else RxGain(None, None)
            for g, has in zip(relative, has_gain, strict=True)
        ]
    return gains


@dataclass(frozen=True)
class Rows:
    """Rows of a scan, counted from 0: number of rows in the plan, and the indices of those with data, ascending."""

    planned: int
    committed: tuple[int, ...]

    @property
    def indices(self) -> range:
        """Indices of all planned rows."""
        return range(self.planned)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the planned rows without data."""
        return tuple(sorted(set(self.indices) - set(self.committed)))


class ComputedContent(TypedDict, total=False):
    """Content of a result that was just computed, see the properties of :class:`ProcessedScan`."""

    images: Required[Images]
    quality: Required[ScanQuality]
    facts: Required[ScanFacts]
    materials: ScanMaterials | None
    analysis: MaterialsResult | None
    plates: tuple[TruthPlate, ...]
    plan: RasterPlan | None
    labels: Labels
    pixel_names: PixelNames
    expected_accuracy: float | None


@dataclass(frozen=True)
class ProcessedScan:
    """The result of processing one scan. Values that were not given to `from_results` are read from the folder.

    Reading raises DataError if a file is damaged. Names and permittivities are withheld where the verdict is "no
    result", see :class:`polysight.results.ScanMaterials`.

    Attributes
    ----------
    folder
        Folder of the products, also if a scan folder was given.
    """

    folder: Path

    @classmethod
    def from_results(cls, folder: Path, **content: Unpack[ComputedContent]) -> Self:
        """Return a result that was just computed; `folder` is where its data were read.

        What is not given in `content` has the value of a scan of which only images were made, or is read from the
        folder.
        """
        scan = cls(folder)
        # A cached property whose value is in the `__dict__` is not computed.
        vars(scan).update({"materials": None, **content})
        if not scan.judged:
            vars(scan).update(plates=(), pixel_names={}, expected_accuracy=None)
        return scan

    @cached_property
    def images(self) -> Images:
        """Images of image.npz: h, v, p, valid and, if the products have them, p_sigma and raised_m."""
        return read_image(self.folder / IMAGE)

    @property
    def h(self) -> Image:
        """H, complex [ny, nx]."""
        return self.images.h

    @property
    def v(self) -> Image:
        """V, complex [ny, nx]."""
        return self.images.v

    @property
    def p(self) -> Image:
        """P = H / V, complex [ny, nx]."""
        return np.asarray(self.images.p)

    @property
    def x_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [nx], rig frame."""
        return self.images.x_m

    @property
    def y_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [ny], rig frame."""
        return self.images.y_m

    @property
    def x_mm(self) -> npt.NDArray[np.float64]:
        """Pixel centres from the middle of the image, float64 [nx]."""
        return axis_mm(self.x_m)

    @property
    def y_mm(self) -> npt.NDArray[np.float64]:
        """Pixel centres from the middle of the image, float64 [ny]."""
        return axis_mm(self.y_m)

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper edge of the image, from its middle."""
        left, lower, right, upper = image_extent_mm(self.x_m, self.y_m)
        return left, right, lower, upper

    @property
    def valid(self) -> Mask:
        """Pixels illuminated by the scan, bool [ny, nx]."""
        return self.images.valid

    @cached_property
    def materials(self) -> ScanMaterials | None:
        """Content of materials.json; None if only images were made."""
        return ScanMaterials.read(self.folder / MATERIALS)

    @cached_property
    def quality(self) -> ScanQuality:
        """Content of quality.json."""
        return ScanQuality.read(self.folder / QUALITY)

    @cached_property
    def facts(self) -> ScanFacts:
        """Content of scan.json."""
        return ScanFacts.read(self.folder / SCAN)

    @cached_property
    def patches(self) -> ScanPatches:
        """Pixels of the patches, from patches.npz. Raises DataError without the file."""
        return read_patches(self.folder / PATCHES_FILE)

    @cached_property
    def analysis(self) -> MaterialsResult | None:
        """Result of the analysis behind the figures of the patches; None for saved products."""
        return None

    @cached_property
    def plates(self) -> tuple[TruthPlate, ...]:
        """True plates of a simulated scene; empty for saved products."""
        return ()

    @cached_property
    def pixel_names(self) -> PixelNames:
        """Patch to the names of its interior's pixels in image order, and that interior; empty for saved products."""
        if self.analysis is None:
            return {}
        return {
            r.patch.label: (r.pixel_names, r.patch.interior) for r in self.analysis.patches if r.pixel_names is not None
        }

    @cached_property
    def expected_accuracy(self) -> float | None:
        """Share of pixels that the best classifier should name right; None for saved products or without truth."""
        if self.analysis is None:
            return None
        return predict_pixel_accuracy(self.analysis)

    @property
    def named_plates(self) -> PlatesNamed | None:
        """Count the plates of the scene by their names, also those that were not found; None without truth or names.

        Only plates with a permittivity are counted: metal is the reference and not a result, and strips and stacks of
        layers have no permittivity. A scene without such plates has no count. A plate whose material is not in the
        library, and which was called unknown, is neither right nor wrong.
        """
        plates = sum(plate.permittivity is not None for plate in self.plates)
        if not plates or not any(patch.name for patch in self.segments):
            return None
        non_metal_patches = [patch for patch in self.segments if not patch.metal_reference]
        judged = [(patch.name, patch.truth) for patch in non_metal_patches if patch.truth and patch.truth.permittivity]
        right = sum(name == truth.name for name, truth in judged)
        unknown_strangers = sum(name == UNKNOWN and not truth.in_library for name, truth in judged)
        return PlatesNamed(right, plates - unknown_strangers, unknown_strangers)

    @property
    def segments(self) -> list[PatchFigures]:
        """Figures of the patches (their pixels: `patches`), from materials.json; empty if only images were made."""
        if self.materials is None:
            return []
        return self.materials.segments

    @property
    def metal_referenced(self) -> bool:
        """True if h, v and p are relative to metal."""
        return self.materials is not None

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the results; None in products of earlier releases."""
        return (self.materials and self.materials.verdict) or self.quality.verdict or None

    @property
    def judged(self) -> bool:
        """False if the verdict is "no result": then there are no names and permittivities."""
        return self.verdict is None or self.verdict.usable

    @property
    def simulated(self) -> bool | None:
        """True if the data was simulated; None if unknown."""
        if self.facts.simulated is not UNSET:
            return self.facts.simulated
        if self.materials is None or self.materials.simulated is UNSET:
            return None
        return self.materials.simulated

    @property
    def stamped(self) -> bool:
        """True if pictures and pages get the stamp SIMULATED: unless the data is known to be measured."""
        return self.simulated is not False

    @property
    def scan_id(self) -> str:
        """Name of the scan; "" if unknown."""
        return self.facts.scan_id or (self.materials and self.materials.scan_id) or ""

    @cached_property
    def rig(self) -> Instrument | None:
        """Rig of the images; None if unknown. Raises DataError if scan.json holds no valid one."""
        path = self.folder / SCAN
        try:
            if self.facts.instrument:
                return decode(self.facts.instrument, Instrument, f"{path}: instrument")
            return None
        except ConfigError as e:
            raise damage_error(path, e.what) from None

    @property
    def rows(self) -> Rows | None:
        """Planned rows and rows in the images; None if unknown."""
        recorded = [board.rows_recorded for board in self.quality.boards.values()]
        indices = [set(rows) for rows in recorded if rows is not UNSET]
        if self.rig is None or not recorded or len(indices) < len(recorded):
            return None
        if self.by_columns:
            planned_columns = self.rig.grid.columns
        else:
            planned_columns = self.rig.grid.rows
        return Rows(planned_columns, tuple(sorted(set.intersection(*indices))))

    @property
    def by_columns(self) -> bool:
        """True if published data were recorded column by column."""
        return bool(self.quality.recording) and self.quality.recording.direction == "col"

    @cached_property
    def plan(self) -> RasterPlan | None:
        """Raster of the scan; None if unknown."""
        if self.rig is None or self.by_columns:
            return None
        return plan_raster(self.rig.grid)

    @cached_property
    def labels(self) -> Labels:
        """Patch number of each pixel, 0 for none, int32 [ny, nx]; saved outlines are accurate to half a pixel."""
        if self.analysis is not None:
            return self.analysis.segmentation.labels
        x_m = self.images.x_m
        y_m = self.images.y_m
        labels = np.zeros((y_m.size, x_m.size), np.int32)
        points = np.stack(np.meshgrid(axis_mm(x_m), axis_mm(y_m)), axis=-1).reshape(-1, 2)
        for patch in self.segments:
            if patch.outline_mm:
                is_inside = skimage.measure.points_in_poly(points, patch.outline_mm).reshape(labels.shape)
            else:
                is_inside = box_mask(patch.box_mm, x_m, y_m)
            labels[is_inside] = patch.label
        if self._has_pixels:
            for pixels in self.patches.patches:
                labels[self._find_pixels(pixels.places_mm)] = pixels.label
        return labels

    @cached_property
    def interior(self) -> Mask | None:
        """Pixels used for the patches' statistics, bool [ny, nx]; None if unknown."""
        interior = np.zeros(self.images.valid.shape, bool)
        if self.analysis is not None:
            for patch in self.analysis.segmentation.patches:
                interior |= patch.interior
        elif self._has_pixels:
            for pixels in self.patches.patches:
                interior[self._find_pixels(pixels.places_mm)] = True
        else:
            return None
        return interior

    @property
    def _has_pixels(self) -> bool:
        """True if the products hold the pixels of the patches (patches.npz)."""
        return self.materials is not None and (self.folder / PATCHES_FILE).exists()

    def _find_pixels(self, places_mm: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Return rows and columns of the pixels at places x, y [n, 2]."""
        rows = _find_nearest(axis_mm(self.images.y_m), places_mm[:, 1])
        return rows, _find_nearest(axis_mm(self.images.x_m), places_mm[:, 0])


def _find_nearest(axis: npt.NDArray[np.float64], places: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Return the indices [place] of the values of an evenly spaced axis that are nearest to places [place]."""
    return np.rint((places - axis[0]) / (axis[1] - axis[0])).astype(np.intp)


def find_products(folder: Path, needs: str = IMAGE) -> ProcessedScan | None:
    """Find products in a folder, or in `products` of a scan folder; None if the file `needs` is in neither."""
    for candidate in (folder, folder / _PRODUCTS):
        if (candidate / needs).exists():
            return ProcessedScan(candidate)
    return None


def read_products(folder: Path, needs: str = IMAGE) -> ProcessedScan:
    """Return the products that :func:`find_products` finds. Raises DataError if there are none."""
    if products := find_products(folder, needs):
        return products
    if not folder.exists():
        raise make_missing_path_error(folder)
    cause = "the folder is wrong, the scan was not processed, or only to images"
    remedy = "give a folder that polysight process wrote"
    if needs == IMAGE:
        cause = "the folder is wrong, or the scan was not processed"
        remedy = "give a folder that polysight process or polysight image wrote"
    raise DataError(f"{folder}: no {needs}", cause, remedy, code=ErrorCode.FILE_MISSING)


def raw_dropped(folder: Path) -> RawDropped | None:
    """Return what products say about their scan's dropped raw data; None without it, or if they cannot be read."""
    try:
        return ProcessedScan(folder).quality.raw_dropped or None
    except DataError:
        return None
