"""Files of a processed scan: names and content of image.npz, materials.json, quality.json and scan.json.

Files are written atomically. `find_products` finds a folder of products, `ProcessedScan` reads its files, without names
and permittivities if the verdict is "no result" (`withhold`). Formats: docs/spec/products.md.
"""

from __future__ import annotations

import io
import os
import secrets
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.imaging import Images
from polysight.results import RxGain, json_text
from polysight.store import open_npz
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import named

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


def write_json(path: Path, content: Any) -> None:
    """Write a value as a JSON file, see :func:`polysight.results.plain`."""
    write_atomically(path, json_text(content).encode("utf-8"))


def rx_gains(images: Images) -> dict[str, list[RxGain]]:
    """Return gain and phase of each RX relative to its board's first, by board, as divided out of the images."""
    gains = {}
    for board, values in images.rx_gains.items():
        relative = values / values[0]
        gains[board] = [
            RxGain(gain_db=float(20 * np.log10(abs(g))), phase_deg=float(np.degrees(np.angle(g)))) for g in relative
        ]
    return gains
