"""`polysight export`: products for other programs."""

from __future__ import annotations

import sys
from pathlib import Path

from polysight.host.export.hdf5 import write_hdf5
from polysight.host.export.matlab import write_mat
from polysight.host.export.pictures import write_pngs
from polysight.host.export.table import write_csv
from polysight.host.report.read import read_products
from polysight.shared.errors import ConfigError, DataError

FORMATS = ("hdf5", "mat", "png", "csv")
_FOLDER = "export"


def export(folder: Path, formats: list[str], out: Path | None) -> int:
    """Write the formats asked for; prints each file.

    Raises
    ------
    PolysightError
        when no format was asked for, the products cannot be read, or a package is missing.
    """
    if not formats:
        raise ConfigError(
            "nothing to export", "no format was named", "add --hdf5, --mat, --png or --csv, or several of them"
        )
    products = read_products(folder)
    if "csv" in formats and not products.materials:
        raise DataError(
            f"{products.folder}: no materials.json",
            "only images were made of this scan",
            "polysight process names them",
        )
    out = out or products.folder.parent / f"{products.folder.name}-{_FOLDER}"
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for kind in formats:
        if kind == "png":
            written += write_pngs(out, products)
            continue
        writer, name = {
            "hdf5": (write_hdf5, "image.h5"),
            "mat": (write_mat, "image.mat"),
            "csv": (write_csv, "materials.csv"),
        }[kind]
        writer(out / name, products)
        written.append(out / name)
    sys.stdout.write("".join(f"{path}\n" for path in written))
    return 0
