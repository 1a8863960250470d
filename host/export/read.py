"""Products of a processed scan, read back."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.report import read_image
from host.report.scan_facts import SCAN
from shared.errors import DataError

_PRODUCTS = "products"  # of a scan folder


@dataclass(frozen=True)
class Exported:
    """What a folder of products holds.

    Attributes
    ----------
    folder
        The products' folder.
    h, v, p
        complex64 [ny, nx].
    x_m, y_m
        float64, pixel centres in the rig frame.
    valid
        bool [ny, nx].
    materials
        Content of materials.json; empty when no material was looked for.
    quality
        Content of quality.json.
    scan
        Content of scan.json: scan_id, simulated, versions, instrument, rx_gains; empty for products of releases that
        did not write it.
    """

    folder: Path
    h: npt.NDArray[np.complex64]
    v: npt.NDArray[np.complex64]
    p: npt.NDArray[np.complex64]
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]
    valid: npt.NDArray[np.bool_]
    materials: dict[str, Any] = field(default_factory=dict)
    quality: dict[str, Any] = field(default_factory=dict)
    scan: dict[str, Any] = field(default_factory=dict)

    @property
    def segments(self) -> list[dict[str, Any]]:
        """Patches as materials.json has them."""
        return list(self.materials.get("segments", []))

    @property
    def simulated(self) -> bool | None:
        """Whether the data was simulated; None when nothing says."""
        return self.scan.get("simulated", self.materials.get("simulated"))

    @property
    def scan_id(self) -> str:
        """The scan's name; "" when nothing says."""
        return str(self.scan.get("scan_id", self.materials.get("scan_id", "")))


def read_products(folder: Path) -> Exported:
    """Read a folder that `polysight process` or `image` wrote, or the scan folder that has it as `products`.

    Raises
    ------
    DataError
        when it holds no image, or a file of it cannot be read.
    """
    if not (folder / "image.npz").exists() and (folder / _PRODUCTS / "image.npz").exists():
        folder = folder / _PRODUCTS
    if not (folder / "image.npz").exists():
        raise DataError(
            f"{folder}: no image.npz",
            "the folder is wrong, or the scan was not processed",
            "give a folder that polysight process or polysight image wrote",
        )
    image = read_image(folder / "image.npz")
    return Exported(
        folder,
        image["h"],
        image["v"],
        image["p"],
        image["x_m"],
        image["y_m"],
        image["valid"],
        materials=_json(folder / "materials.json"),
        quality=_json(folder / "quality.json"),
        scan=_json(folder / SCAN),
    )


def _json(path: Path) -> dict[str, Any]:
    """Content of a JSON file; empty when it is absent."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as e:
        raise DataError(f"{path}: cannot be read: {e}", "it was changed or damaged", "process the scan again") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: not a JSON object", "it was changed", "process the scan again")
    return content
