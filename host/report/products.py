"""Products of a processed scan, each written whole or not at all."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.shared.errors import DataError


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name beside it, flush it to disk, then take its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as f:
        f.write(data)
        f.flush()
        os.fsync(f.fileno())
    part.replace(path)


def write_image(
    path: Path,
    h: npt.NDArray[np.complexfloating],
    v: npt.NDArray[np.complexfloating],
    p: npt.NDArray[np.complexfloating],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    valid: npt.NDArray[np.bool_],
) -> None:
    """Write image.npz: h, v, p complex64 [ny, nx], x_m, y_m float64, valid bool; row 0 is the smallest y.

    Raises
    ------
    DataError
        when shapes do not fit each other.
    """
    shape = (np.size(y_m), np.size(x_m))
    for name, array in (("h", h), ("v", v), ("p", p), ("valid", valid)):
        if array.shape != shape:
            raise DataError(f"image {name} has shape {array.shape}, axes say {shape}")
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        h=h.astype(np.complex64),
        v=v.astype(np.complex64),
        p=p.astype(np.complex64),
        x_m=np.asarray(x_m, np.float64),
        y_m=np.asarray(y_m, np.float64),
        valid=valid.astype(np.bool_),
    )
    write_atomically(path, buffer.getvalue())


def read_image(path: Path) -> dict[str, npt.NDArray]:
    """Read image.npz (no pickle). Raises DataError."""
    try:
        with path.open("rb") as f, np.load(f, allow_pickle=False) as z:
            return {k: z[k] for k in ("h", "v", "p", "x_m", "y_m", "valid")}
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(f"{path}: not an image product: {e}", "made by polysight process or image") from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write materials.json or quality.json: strict JSON, so infinities and not-a-numbers become null."""
    text = json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, (text + "\n").encode("utf-8"))


def plain(value: Any) -> Any:
    """A value as strict JSON types: numpy scalars and arrays unpacked, complex as {real, imag}, not finite as None."""
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
