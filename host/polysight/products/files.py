"""Files of a processed scan: names and content of image.npz, materials.json, quality.json and scan.json.

Files are written atomically. `find_products` finds a folder of products, `SavedProducts` reads its files, without names
and permittivities if the verdict is "no result" (`withhold`). Formats: docs/spec/products.md.
"""

from __future__ import annotations

import io
import json
import math
import os
import secrets
import shutil
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.imaging import Images
from polysight.materials import PATCHES, ScanPatches, read_patches
from polysight.results import Verdict, read_verdict
from polysight.store import Scan, open_npz, versions
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, no_such
from polysight_shared.files import named, read_json
from polysight_shared.tables import decode, to_builtins

SCAN = "scan.json"
IMAGE, QUALITY, MATERIALS, LABELS = "image.npz", "quality.json", "materials.json", "labels.json"
REPORT = "report.html"
FINISHED = ".finished.json"  # settings of the products, written by batch processing
_ARRAYS = {
    "h": np.complex64,
    "v": np.complex64,
    "p": np.complex64,
    "x_m": np.float64,
    "y_m": np.float64,
    "valid": np.bool_,
    "p_sigma": np.float32,
}
_OPTIONAL = ("p_sigma",)  # arrays of image.npz that earlier releases did not write
_PRODUCTS = "products"  # in a scan folder
_NOTHING: dict[str, Any] = {
    "name": None,
    "confidence": None,
    "permittivity": None,
    "ratio": None,
    "votes": {},
    "probabilities": {},
    "why": "",
}


def temporary_path(path: Path) -> Path:
    """Return a temporary path beside a file or folder to be written; delete leftovers there. Raises OSError."""
    part = path.with_name(f".{path.name}.part")
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)
    return part


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name of its own, flush it to disk, and rename it. Raises OSError."""
    with named(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")  # two may write the same file at once
        try:
            with part.open("xb") as f:
                f.write(data)
                f.flush()
                os.fsync(f.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def write_image(path: Path, images: Images) -> None:
    """Write image.npz: h, v, p complex64 [ny, nx], x_m, y_m float64, valid bool; row 0 is the smallest y.

    `p_sigma` float32 [ny, nx] is left out if it is None.

    Raises
    ------
    DataError
        if the shapes do not agree, or there is no ratio p.
    """
    arrays = {name: getattr(images, name) for name in _ARRAYS if getattr(images, name) is not None}
    try:
        _check_image(arrays)
    except (KeyError, ValueError) as e:
        raise DataError(f"{path}: no image: {e}", code=ErrorCode.MISMATCH) from None
    buffer = io.BytesIO()
    stored: dict[str, Any] = {name: np.asarray(array, _ARRAYS[name]) for name, array in arrays.items()}
    np.savez_compressed(buffer, **stored)
    write_atomically(path, buffer.getvalue())


def read_image(path: Path) -> Images:
    """Read image.npz (no pickle), with `p_sigma` if the file has it. Raises DataError."""
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
            code=ErrorCode.FILE_DAMAGED,
        ) from None


def _check_image(arrays: dict[str, npt.NDArray]) -> None:
    """Raise ValueError or KeyError if types or shapes of the arrays are wrong, or the ratio is missing."""
    shape = arrays["y_m"].size, arrays["x_m"].size
    if "p" not in arrays:
        raise KeyError("p")
    for name, array in arrays.items():
        if array.dtype.kind not in "cfb":
            raise ValueError(f"{name} holds {array.dtype}, not numbers")
        if name not in ("x_m", "y_m") and array.shape != shape:
            raise ValueError(f"{name} is {' x '.join(map(str, array.shape))}, x_m and y_m are {shape[0]} x {shape[1]}")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; infinite values and NaN become null."""
    text = json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, (text + "\n").encode("utf-8"))


def plain(value: Any) -> Any:
    """Convert a value to strict JSON types: numpy to Python, complex to {real, imag}, not finite to None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, complex):
        return {"real": plain(value.real), "imag": plain(value.imag)}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def rx_gains(images: Images) -> dict[str, list[dict[str, float]]]:
    """Return gain and phase of each RX relative to its board's first, by board, as divided out of the images."""
    out = {}
    for board, gains in images.rx_gains.items():
        relative = gains / gains[0]
        out[board] = [
            {"gain_db": float(20 * np.log10(abs(g))), "phase_deg": float(np.degrees(np.angle(g)))} for g in relative
        ]
    return out


def scan_facts(source: Scan, rig: Instrument, images: Images) -> dict[str, Any]:
    """Return the content of scan.json; `rig` is the rig that the images were formed with."""
    return {
        "scan_id": source.scan_id,
        "simulated": source.simulated,
        "processed_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "rx_gains": rx_gains(images),
        "instrument": to_builtins(rig),
    }


def write_scan_facts(out: Path, source: Scan, rig: Instrument, images: Images) -> dict[str, Any]:
    """Write scan.json and return its content, see :func:`scan_facts`."""
    facts = scan_facts(source, rig, images)
    write_json(out / SCAN, facts)
    return facts


def withhold(materials: dict[str, Any]) -> dict[str, Any]:
    """Return the content of materials.json without results that the verdict does not support.

    If the verdict is `none`, each patch keeps only its position and size: name, measured values and truth become null;
    sub-bands and pixel accuracy are removed. Otherwise the content is returned unchanged. Processing writes the files
    this way; readers apply it again, in case another program wrote them.
    """
    verdict = read_verdict(materials)
    segments = materials.get("segments")
    if verdict is None or verdict.usable or not isinstance(segments, list):
        return materials
    return {**materials, "pixel_accuracy": None, "segments": [_bare(s) for s in segments]}


def _bare(segment: dict[str, Any]) -> dict[str, Any]:
    hidden = _NOTHING | {key: None for key in ("truth", "inverse_ratio_std", "metal_like") if key in segment}
    return {key: value for key, value in segment.items() if key != "bands"} | hidden


@dataclass(frozen=True)
class SavedProducts:
    """A folder of products. Each file is read at first use; reading raises DataError if it is damaged.

    Attributes
    ----------
    folder
        Folder of the products, also if a scan folder was given.
    """

    folder: Path

    @cached_property
    def image(self) -> Images:
        """Content of image.npz, see :func:`write_image`."""
        return read_image(self.folder / IMAGE)

    @property
    def h(self) -> npt.NDArray[np.complex64]:
        """H, complex64 [ny, nx]."""
        return self.image.h

    @property
    def v(self) -> npt.NDArray[np.complex64]:
        """V, complex64 [ny, nx]."""
        return self.image.v

    @property
    def p(self) -> npt.NDArray[np.complex64]:
        """P = H / V, complex64 [ny, nx]."""
        return np.asarray(self.image.p)

    @property
    def x_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [nx], rig frame."""
        return self.image.x_m

    @property
    def y_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [ny], rig frame."""
        return self.image.y_m

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Pixels illuminated by the scan, bool [ny, nx]."""
        return self.image.valid

    @cached_property
    def materials(self) -> dict[str, Any]:
        """Content of materials.json, see :func:`withhold`; empty if only images were made."""
        return withhold(_json(self.folder / MATERIALS))

    @cached_property
    def quality(self) -> dict[str, Any]:
        """Content of quality.json; empty without the file."""
        return _json(self.folder / QUALITY)

    @cached_property
    def scan(self) -> dict[str, Any]:
        """Content of scan.json: scan_id, simulated, versions, instrument, rx_gains; empty without the file."""
        return _json(self.folder / SCAN)

    @cached_property
    def patches(self) -> ScanPatches:
        """Pixels of the patches, from patches.npz."""
        return read_patches(self.folder / PATCHES)

    @property
    def segments(self) -> list[dict[str, Any]]:
        """Patches in materials.json; empty if only images were made."""
        found = self.materials.get("segments", [])
        if not isinstance(found, list):
            raise _damaged(self.folder / MATERIALS, "its segments are not a list")
        return list(found)

    @property
    def metal_referenced(self) -> bool:
        """True if h, v and p are relative to metal."""
        return bool(self.materials)

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the results; None in products of earlier releases."""
        return read_verdict(self.materials) or read_verdict(self.quality)

    @property
    def p_sigma(self) -> npt.NDArray[np.float32] | None:
        """Standard deviation of the complex P, float32 [ny, nx]; None in products of earlier releases."""
        return self.image.p_sigma

    @property
    def simulated(self) -> bool | None:
        """True if the data was simulated; None if unknown."""
        return self.scan.get("simulated", self.materials.get("simulated"))

    @property
    def scan_id(self) -> str:
        """Name of the scan; "" if unknown."""
        return str(self.scan.get("scan_id", self.materials.get("scan_id", "")))

    @cached_property
    def rig(self) -> Instrument | None:
        """Rig of the images, from scan.json; None if unknown."""
        raw, path = self.scan.get("instrument"), self.folder / SCAN
        try:
            return None if raw is None else decode(raw, Instrument, f"{path}: instrument")
        except ConfigError as e:
            raise _damaged(path, e.what) from None


def find_products(folder: Path, needs: str = IMAGE) -> SavedProducts | None:
    """Find products in a folder, or in `products` of a scan folder; None if the file `needs` is in neither."""
    for found in (folder, folder / _PRODUCTS):
        if (found / needs).exists():
            return SavedProducts(found)
    return None


def read_products(folder: Path, needs: str = IMAGE) -> SavedProducts:
    """Return the products that :func:`find_products` finds. Raises DataError if there are none."""
    if found := find_products(folder, needs):
        return found
    if not folder.exists():
        raise no_such(folder)
    raise DataError(
        f"{folder}: no {needs}",
        "the folder is wrong, the scan was not processed" + ("" if needs == IMAGE else ", or only to images"),
        "give a folder that polysight process" + (" or polysight image wrote" if needs == IMAGE else " wrote"),
        code=ErrorCode.FILE_MISSING,
    )


def _json(path: Path) -> dict[str, Any]:
    """Read a JSON file; empty if it is missing."""
    try:
        content = read_json(path)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as e:
        raise _damaged(path, str(e)) from None
    if not isinstance(content, dict):
        raise _damaged(path, "not a JSON object")
    return content


def _damaged(path: Path, what: str) -> DataError:
    return DataError(
        f"{path}: cannot be read: {what}",
        "it was changed or damaged",
        "process the scan again",
        code=ErrorCode.FILE_DAMAGED,
    )
