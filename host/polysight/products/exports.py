"""Export saved products for other programs (`polysight export`): NetCDF, MATLAB, CSV."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from polysight.products.datasets import CONVENTION, full_dataset, verdict_attributes, write_netcdf
from polysight.products.files import write_atomically
from polysight.products.processed import ProcessedScan, read_products
from polysight.results import Figure, PatchFigures, figures_of, plain
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError


def table_figures(scan: ProcessedScan) -> list[Figure]:
    """Return the declared figures that are columns of the exported tables."""
    kind = type(scan.segments[0]) if scan.segments else PatchFigures
    return [figure for figure in figures_of(kind) if figure.column.name]


def write_csv(path: Path, scan: ProcessedScan) -> None:
    """Write the table of materials as CSV: comma, UTF-8, a header line; unknown values are empty, digits are kept.

    The last columns, `verdict` and `verdict_reasons` (JSON), are the same in every line; products without a verdict
    have none.
    """
    columns = {figure.column.name: figure.values(scan.segments) for figure in table_figures(scan)}
    count = len(scan.segments)
    columns |= {name: [value] * count for name, value in verdict_attributes(scan.verdict).items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_atomically(path, text.getvalue().encode("utf-8"))


_LONGEST_NAME = 63


def write_mat(path: Path, scan: ProcessedScan) -> None:
    """Write a MATLAB file: `h`, `v`, `p`, `valid` [y, x], `x_m`, `y_m`, structs `materials`, `config`, `versions`.

    If known also `p_sigma` [y, x], `verdict` and `verdict_reasons` (JSON). `quality_json` and `materials_json` are the
    files as text, for jsondecode.
    """
    images = scan.images
    content = {
        "h": images.h,
        "v": images.v,
        "p": images.p,
        "valid": images.valid,
        "x_m": images.x_m[None, :],
        "y_m": images.y_m[:, None],
        "materials": {figure.column.name: _column(figure, scan) for figure in table_figures(scan)},
        "config": _struct(scan.facts.instrument or {}),
        "versions": _struct(scan.facts.versions or {}),
        "scan_id": scan.scan_id,
        "simulated": np.nan if scan.simulated is None else scan.simulated,
        "convention": CONVENTION,
        "quality_json": json.dumps(plain(scan.quality)),
        "materials_json": json.dumps(plain(scan.materials) or {}),
        **verdict_attributes(scan.verdict),
    }
    if images.p_sigma is not None:
        content["p_sigma"] = images.p_sigma
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, long_field_names=True, do_compression=True, oned_as="column")
    write_atomically(path, buffer.getvalue())


def _column(figure: Figure, scan: ProcessedScan) -> Any:
    """Return a column of numbers (NaN if unknown) or of bools, or a cell array of text."""
    column = figure.array(scan.segments)
    return (column.astype(object) if figure.kind is str else column)[:, None]


def _struct(node: Any) -> Any:
    """Convert nested dicts to structs with MATLAB's names; lists other than of numbers become cell arrays."""
    if isinstance(node, dict):
        return {_name(k): _struct(v) for k, v in node.items() if v is not None} or np.zeros((0, 0))
    if isinstance(node, list | tuple):
        if node and all(isinstance(v, int | float) and not isinstance(v, bool) for v in node):
            return np.array(node, np.float64)[None, :]
        cells = np.empty((1, len(node)), dtype=object)
        for i, v in enumerate(node):
            cells[0, i] = _struct(v)
        return cells
    return float(node) if isinstance(node, int) and not isinstance(node, bool) else node


def _name(key: str) -> str:
    name = re.sub(r"\W", "_", key)
    return (name if name[:1].isalpha() else f"x{name}")[:_LONGEST_NAME]


_FOLDER = "export"


def export_folder(folder: Path, out: Path | None) -> Path:
    """Create and return the folder for exports: `out`, or one beside `folder`. Raises ConfigError if that is a link."""
    if out is None:
        out = folder.parent / f"{folder.name}-{_FOLDER}"
        if out.is_symlink():
            raise ConfigError(
                f"{out} is a link", "files elsewhere would be overwritten", "give --out, or remove the link",
                code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    return out


def export(folder: Path, formats: list[str], out: Path | None) -> int:
    """Write the requested formats; print each format to stderr before, each file to stdout after writing it.

    Raises
    ------
    PolysightError
        if no format is requested, the products cannot be read, or a package is missing.
    """
    if not formats:
        raise ConfigError(
            "nothing to export",
            "no format was given",
            "add one or more of --netcdf, --mat, --csv",
            code=ErrorCode.KEY_MISSING,
        )
    scan = read_products(folder)
    if "csv" in formats and scan.materials is None:
        raise DataError(
            f"{scan.folder}: no materials.json",
            "this scan has images only",
            "polysight process finds the materials",
            code=ErrorCode.FILE_MISSING,
        )
    out = export_folder(scan.folder, out)
    for kind in formats:
        sys.stderr.write(f"writing {kind} ...\n")
        sys.stderr.flush()
        if kind == "netcdf":
            path = out / "image.nc"
            write_netcdf(path, full_dataset(scan))
        elif kind == "mat":
            path = out / "image.mat"
            write_mat(path, scan)
        else:
            path = out / "materials.csv"
            write_csv(path, scan)
        sys.stdout.write(f"{path}\n")
        sys.stdout.flush()
    return 0
