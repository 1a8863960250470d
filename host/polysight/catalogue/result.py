"""Results of a processed scan as plain data for a page: verdict, pictures, patches, quality and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from polysight.catalogue.pictures import MAPS, NEED_METAL, Pixels
from polysight.materials import PATCHES
from polysight.products import (
    IMAGE,
    MATERIALS,
    QUALITY,
    REPORT,
    SCAN,
    SavedProducts,
    find_labels,
    label_folder,
    read_products,
)
from polysight_shared.errors import PolysightError

EXPORT = "export"
"""Folder of a scan that a page has exports written into."""
FILES = (REPORT, IMAGE, MATERIALS, QUALITY, SCAN, PATCHES)
EXPORTS = (".mat", ".csv", ".nc")
_KEYS = (
    "label", "name", "confidence", "probabilities", "why", "metal_reference", "metal_like", "box_mm", "outline_mm",
    "pixels", "incidence_deg", "ratio", "permittivity", "refused", "box", "truth", "bands", "tilt_across_deg",
)  # fmt: skip


def result_of(folder: Path) -> dict[str, Any]:
    """Collect the products of a scan folder, or of a folder of products.

    Raises
    ------
    DataError
        if there are none, or one is damaged.
    """
    products = Pixels(read_products(folder).folder)
    verdict = products.verdict
    left, right, low, high = products.extent_mm
    names = [n for n in MAPS if products.referenced or n not in NEED_METAL]
    return {
        "folder": str(products.folder),
        "scan_id": products.scan_id,
        "simulated": products.simulated,
        "processed_utc": products.scan.get("processed_utc", ""),
        "extent_mm": [left, right, low, high],
        "shape": list(products.valid.shape),
        "pictures": [{"name": n, "title": MAPS[n].title, "colours": MAPS[n].colours} for n in names],
        "referenced": products.referenced,
        "metal_reference": products.materials.get("metal_reference", {}),
        "library": products.materials.get("library", ""),
        "budget": products.materials.get("error_budget") or {},
        "verdict": None if verdict is None else {**verdict.to_dict(), "text": verdict.text},
        "patches": [{key: s[key] for key in _KEYS if key in s} for s in products.segments],
        "coverage": products.quality.get("coverage", {}),
        "labels": labels_of(folder, products),
        "files": files_of(folder),
    }


def labels_of(folder: Path, products: SavedProducts) -> dict[str, Any] | None:
    """Boxes drawn by hand, in millimetres, or the `problem` of their file; None if there are none."""
    try:
        found = find_labels(folder)
        if found is None:
            return None
        path, labels = found
        labels = labels.in_mm(products.x_m, products.y_m)
    except PolysightError as e:
        return {"boxes": {}, "metal": None, "specimens": {}, "file": str(label_folder(folder)), "problem": e.what}
    boxes = {name: list(box) for name, box in labels.boxes.items()}
    return {
        "boxes": boxes,
        "metal": labels.metal,
        "specimens": dict(labels.specimens),
        "file": str(path),
        "problem": "",
    }


class File(msgspec.Struct, frozen=True):
    """A file that may be downloaded: its folder (`products` or `export`), name and size."""

    of: str
    name: str
    bytes: int


def files_of(folder: Path) -> list[File]:
    """Downloadable files of a scan's products and exports."""
    products = read_products(folder).folder
    files = []
    for of, place in (("products", products), (EXPORT, folder / EXPORT)):
        if place.is_symlink() or not place.is_dir():
            continue
        for path in sorted(place.iterdir()):
            is_listed = path.name in FILES or path.suffix in EXPORTS
            if is_listed and path.is_file() and not path.is_symlink():
                files.append(File(of, path.name, path.stat().st_size))
    return files
