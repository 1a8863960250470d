"""Products of a processed scan, read back: the one place that knows how a folder of them is laid out and found."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.patch_files import PATCHES, SeenPatches, read_patches
from polysight.host.report.products import read_image
from polysight.host.report.scan_facts import SCAN
from polysight.shared.config import Chirp
from polysight.shared.errors import ConfigError, DataError
from polysight.shared.tables import decode

IMAGE, QUALITY, MATERIALS, LABELS = "image.npz", "quality.json", "materials.json", "labels.json"
FINISHED = ".finished.json"  # says what the products were made with, when several scans are processed
_PRODUCTS = "products"  # of a scan folder


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
        """Content of materials.json; empty when no material was looked for."""
        return _json(self.folder / MATERIALS)

    @cached_property
    def quality(self) -> dict[str, Any]:
        """Content of quality.json; empty when there is none."""
        return _json(self.folder / QUALITY)

    @cached_property
    def scan(self) -> dict[str, Any]:
        """Content of scan.json: scan_id, simulated, versions, instrument, rx_gains; empty when there is none."""
        return _json(self.folder / SCAN)

    @cached_property
    def patches(self) -> SeenPatches:
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
    raise DataError(
        f"{folder}: no {needs}",
        "the folder is wrong, the scan was not processed" + ("" if needs == IMAGE else ", or only to images"),
        "give a folder that polysight process" + (" or polysight image wrote" if needs == IMAGE else " wrote"),
    )


def _json(path: Path) -> dict[str, Any]:
    """Content of a JSON file; empty when it is absent."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as e:
        raise _damaged(path, str(e)) from None
    if not isinstance(content, dict):
        raise _damaged(path, "not a JSON object")
    return content


def _damaged(path: Path, what: str) -> DataError:
    return DataError(f"{path}: cannot be read: {what}", "it was changed or damaged", "process the scan again")
