"""The files of a processed scan, written and read back: the one place that knows their names and content.

image.npz, materials.json, quality.json and scan.json are written here, each whole or not at all. `SavedProducts` reads
a folder of them; `find_products` finds the folder.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.imaging import ChannelImages
from polysight.host.materials import PATCHES, ScanPatches, read_patches
from polysight.host.products.withhold import withhold
from polysight.host.store import Scan, open_npz, versions
from polysight.host.verdict import Verdict, read_verdict
from polysight.shared.config import Chirp, Instrument
from polysight.shared.errors import ConfigError, DataError, no_such
from polysight.shared.files import named, open_to_write, read_json
from polysight.shared.tables import decode, to_builtins

SCAN = "scan.json"
IMAGE, QUALITY, MATERIALS, LABELS = "image.npz", "quality.json", "materials.json", "labels.json"
FINISHED = ".finished.json"  # says what the products were made with, when several scans are processed
_OPTIONAL = ("p_sigma",)  # arrays of image.npz that earlier releases did not write
_PRODUCTS = "products"  # of a scan folder


def fresh_part(path: Path) -> Path:
    """The temporary name beside a file or folder to be made; whatever an ended program, or a link, left there is gone.

    Raises OSError.
    """
    part = path.with_name(f".{path.name}.part")
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)
    return part


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name beside it, flush it to disk, then take its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with named(path), open_to_write(part) as f:
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
    p_sigma: npt.NDArray[np.floating] | None = None,
) -> None:
    """Write image.npz: h, v, p complex64 [ny, nx], x_m, y_m float64, valid bool; row 0 is the smallest y.

    `p_sigma` float32 [ny, nx] is the standard deviation of the complex p, not a number where it is not known; without,
    the file does not hold it.

    Raises
    ------
    DataError
        when shapes do not fit each other.
    """
    shape = (np.size(y_m), np.size(x_m))
    more: dict[str, Any] = {} if p_sigma is None else {"p_sigma": p_sigma.astype(np.float32)}
    for name, array in (("h", h), ("v", v), ("p", p), ("valid", valid), *more.items()):
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
        **more,
    )
    write_atomically(path, buffer.getvalue())


def read_image(path: Path) -> dict[str, npt.NDArray]:
    """Read image.npz (no pickle); `p_sigma` only where the file holds it. Raises DataError."""
    names = ("h", "v", "p", "x_m", "y_m", "valid")
    try:
        with open_npz(path) as z:
            image = {k: z[k] for k in (*names, *(k for k in _OPTIONAL if k in z))}
        _check_image(image)
        return image
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(f"{path}: not an image product: {e}", "made by polysight process or image") from None


def _check_image(image: dict[str, npt.NDArray]) -> None:
    """Refuse arrays that do not belong together. Raises ValueError."""
    shape = image["y_m"].size, image["x_m"].size
    if min(shape) < 2:
        raise ValueError(f"an image has two pixels at least each way, not {shape[1]} x {shape[0]}")
    for name, array in image.items():
        if array.dtype.kind not in "cfb":
            raise ValueError(f"{name} holds {array.dtype}, not numbers")
        if name not in ("x_m", "y_m") and array.shape != shape:
            raise ValueError(f"{name} is {' x '.join(map(str, array.shape))}, x_m and y_m say {shape[0]} x {shape[1]}")


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


def rx_gains(images: ChannelImages) -> dict[str, list[dict[str, float]]]:
    """Gain and phase of each RX against its board's first one, by board: from the direct path, divided out."""
    out = {}
    for board, gains in images.rx_calibration.items():
        relative = gains / gains[0]
        out[board] = [
            {"gain_db": float(20 * np.log10(abs(g))), "phase_deg": float(np.degrees(np.angle(g)))} for g in relative
        ]
    return out


def scan_facts(source: Scan, rig: Instrument, images: ChannelImages) -> dict[str, Any]:
    """Content of scan.json. `rig` is the one the images were made with."""
    return {
        "scan_id": source.scan_id,
        "simulated": source.simulated,
        "processed_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "rx_gains": rx_gains(images),
        "instrument": to_builtins(rig),
    }


def write_scan_facts(out: Path, source: Scan, rig: Instrument, images: ChannelImages) -> dict[str, Any]:
    """Write scan.json, and return its content, see :func:`scan_facts`."""
    facts = scan_facts(source, rig, images)
    write_json(out / SCAN, facts)
    return facts


@dataclass(frozen=True)
class SavedProducts:
    """A folder of products. Each file is read when it is first asked for, and raises DataError when it cannot be.

    Attributes
    ----------
    folder
        The products' folder, also when a scan folder was given.
    """

    folder: Path

    @cached_property
    def image(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays of image.npz, see :func:`polysight.host.report.write_image`."""
        return read_image(self.folder / IMAGE)

    @property
    def h(self) -> npt.NDArray[np.complex64]:
        """H, complex64 [ny, nx]."""
        return self.image["h"]

    @property
    def v(self) -> npt.NDArray[np.complex64]:
        """V, complex64 [ny, nx]."""
        return self.image["v"]

    @property
    def p(self) -> npt.NDArray[np.complex64]:
        """P = H / V, complex64 [ny, nx]."""
        return self.image["p"]

    @property
    def x_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [nx], rig frame."""
        return self.image["x_m"]

    @property
    def y_m(self) -> npt.NDArray[np.float64]:
        """Pixel centres, float64 [ny], rig frame."""
        return self.image["y_m"]

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Pixels that the scan illuminates, bool [ny, nx]."""
        return self.image["valid"]

    @cached_property
    def materials(self) -> dict[str, Any]:
        """Content of materials.json as it may be shown (:func:`withhold`); empty when no material was looked for."""
        return withhold(_json(self.folder / MATERIALS))

    @cached_property
    def quality(self) -> dict[str, Any]:
        """Content of quality.json; empty when there is none."""
        return _json(self.folder / QUALITY)

    @cached_property
    def scan(self) -> dict[str, Any]:
        """Content of scan.json: scan_id, simulated, versions, instrument, rx_gains; empty when there is none."""
        return _json(self.folder / SCAN)

    @cached_property
    def patches(self) -> ScanPatches:
        """Pixels of the patches, of patches.npz."""
        return read_patches(self.folder / PATCHES)

    @property
    def segments(self) -> list[dict[str, Any]]:
        """Patches as materials.json has them; none when no material was looked for."""
        found = self.materials.get("segments", [])
        if not isinstance(found, list):
            raise _damaged(self.folder / MATERIALS, "its segments are no list")
        return list(found)

    @property
    def verdict(self) -> Verdict | None:
        """How far the result may be trusted; None in products of earlier releases."""
        return read_verdict(self.materials) or read_verdict(self.quality)

    @property
    def p_sigma(self) -> npt.NDArray[np.float32] | None:
        """Standard deviation of the complex P, float32 [ny, nx]; None in products of earlier releases."""
        return self.image.get("p_sigma")

    @property
    def simulated(self) -> bool | None:
        """Whether the data was simulated; None when nothing says."""
        return self.scan.get("simulated", self.materials.get("simulated"))

    @property
    def scan_id(self) -> str:
        """The scan's name; "" when nothing says."""
        return str(self.scan.get("scan_id", self.materials.get("scan_id", "")))

    @property
    def chirp(self) -> Chirp | None:
        """The chirp the products were made with, of the rig file in scan.json; None when nothing says."""
        rig = self.scan.get("instrument")
        if rig is None:
            return None
        path = self.folder / SCAN
        try:
            return decode(rig["chirp"], Chirp, f"{path}: instrument.chirp")
        except (ConfigError, KeyError, TypeError) as e:
            raise _damaged(path, e.what if isinstance(e, ConfigError) else "it holds no chirp") from None


def find_products(folder: Path, needs: str = IMAGE) -> SavedProducts | None:
    """A folder that `polysight process` or `image` wrote, or the scan folder that has it as `products`.

    None when neither holds the product `needs`.
    """
    for found in (folder, folder / _PRODUCTS):
        if (found / needs).exists():
            return SavedProducts(found)
    return None


def read_products(folder: Path, needs: str = IMAGE) -> SavedProducts:
    """What :func:`find_products` finds. Raises DataError when that is nothing."""
    if found := find_products(folder, needs):
        return found
    if not folder.exists():
        raise no_such(folder)
    raise DataError(
        f"{folder}: no {needs}",
        "the folder is wrong, the scan was not processed" + ("" if needs == IMAGE else ", or only to images"),
        "give a folder that polysight process" + (" or polysight image wrote" if needs == IMAGE else " wrote"),
    )


def _json(path: Path) -> dict[str, Any]:
    """Content of a JSON file; empty when it is absent."""
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
    return DataError(f"{path}: cannot be read: {what}", "it was changed or damaged", "process the scan again")
