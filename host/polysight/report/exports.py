"""Export saved products for other programs (`polysight export`): HDF5, NetCDF, Zarr, MATLAB, PNG, CSV."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from polysight.products import (
    CONVENTION,
    ProcessedScan,
    SavedProducts,
    full_dataset,
    material_columns,
    read_products,
    temporary_path,
    verdict_attributes,
    write_atomically,
    write_netcdf,
    write_zarr,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError


def write_csv(path: Path, products: SavedProducts) -> None:
    """Write the table of materials as CSV: comma, UTF-8, a header line; unknown values are empty, digits are kept.

    The last columns, `verdict` and `verdict_reasons` (JSON), are the same in every line; products without a verdict
    have none.
    """
    columns = material_columns(products)
    count = len(columns["patch"])
    columns |= {name: [value] * count for name, value in verdict_attributes(products.verdict).items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_atomically(path, text.getvalue().encode("utf-8"))


_PLANES = {
    "h": "s-polarised channel",
    "v": "p-polarised channel",
    "p": "polarisation ratio H / V",
    "p_sigma": "standard deviation of p: root of the mean variance of its real and imaginary part",
    "valid": "true if the scan illuminates the pixel",
}
_TEXT = ("name", "true_name", "dominated_by", "refused", "drawn_as")
_UNITS = {"mm": "mm", "deg": "degree", "db": "dB", "m": "m"}


def _h5py() -> Any:
    try:
        return import_module("h5py")
    except ImportError:
        raise ConfigError(
            "HDF5 needs the package h5py, which is not installed",
            "only this export uses it, so it is an extra",
            "pip install 'polysight[export]', or pip install h5py",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None


def write_hdf5(path: Path, products: SavedProducts) -> None:
    """Write an HDF5 file of the products.

    /h, /v, /p complex64 [y, x], /valid bool [y, x], if known /p_sigma float32 [y, x]; /x, /y float64 in metres, their
    dimension scales; group /materials with a column for each of
    :func:`polysight.products.material_columns`; attributes scan_id, simulated, convention, verdict, and as JSON
    verdict_reasons, config, versions; the JSON files under /documents; /entry links the images by NeXus classes.

    Raises
    ------
    ConfigError
        if h5py is not installed.
    """
    h5py = _h5py()
    part = temporary_path(path)
    with h5py.File(part, "w") as f:
        axes = {"y": products.y_m, "x": products.x_m}
        for name, values in axes.items():
            f[name] = values
            f[name].attrs["units"] = "m"
            f[name].attrs["long_name"] = f"pixel centre, {name} of the rig frame"
            f[name].make_scale(name)
        for name in (n for n in _PLANES if getattr(products.image, n) is not None):
            data = f.create_dataset(name, data=getattr(products.image, name), compression="gzip", shuffle=True)
            data.attrs["units"], data.attrs["long_name"] = "1", _PLANES[name]
            for i, axis in enumerate(axes):
                data.dims[i].attach_scale(f[axis])
                data.dims[i].label = axis
        _write_materials(h5py, f.create_group("materials"), material_columns(products))
        f.attrs["scan_id"], f.attrs["convention"] = products.scan_id, CONVENTION
        if products.simulated is not None:
            f.attrs["simulated"] = products.simulated
        for name, content in _documents(products).items():
            # Attributes above 64 kB do not fit the file's header; a dataset of text takes any length.
            f.create_dataset(f"documents/{name}", data=json.dumps(content), dtype=h5py.string_dtype())
        for name, value in verdict_attributes(products.verdict).items():
            f.attrs[name] = value
        f.attrs["versions"] = json.dumps(products.scan.get("versions", {}))
        f.attrs["config"] = json.dumps(products.scan.get("instrument", {}))
        _add_nexus(h5py, f, products)
    part.replace(path)


def _add_nexus(h5py: Any, f: Any, products: SavedProducts) -> None:
    """Add NXentry with NXdata and NXinstrument, with links to the arrays."""

    def group(parent: Any, name: str, kind: str, **attributes: Any) -> Any:
        made = parent.create_group(name)
        made.attrs.update({"NX_class": kind, **attributes})
        return made

    f.attrs["NX_class"], f.attrs["default"] = "NXroot", "entry"
    entry = group(f, "entry", "NXentry", default="image")
    entry["title"], entry["entry_identifier"], entry["program_name"] = "polysight", products.scan_id, "polysight"
    entry["program_name"].attrs["version"] = str(products.scan.get("versions", {}).get("polysight", ""))
    if started := products.scan.get("started_utc"):
        entry["start_time"] = str(started)
    image = group(entry, "image", "NXdata", signal="p", auxiliary_signals=["h", "v"], axes=["y", "x"])
    for name in (*_PLANES, "y", "x"):
        if name in f:
            image[name] = h5py.SoftLink(f"/{name}")
    instrument = group(entry, "instrument", "NXinstrument")
    instrument["name"] = "POLySIGHT, three AWR2243 radars on a stage"


def _documents(products: SavedProducts) -> dict[str, dict[str, Any]]:
    return {"quality": products.quality, "materials": products.materials, "scan": products.scan}


def _write_materials(h5py: Any, group: Any, columns: dict[str, list[Any]]) -> None:
    """Write one dataset for each column: text, bool, int32 or float64; NaN for unknown values."""
    for name, values in columns.items():
        if name in _TEXT:
            group.create_dataset(name, data=[v or "" for v in values], dtype=h5py.string_dtype())
        elif name in ("metal_reference", "metal_like"):
            group[name] = np.array(values, np.bool_)
        elif name == "patch":
            group[name] = np.array(values, np.int32)
        else:
            group[name] = np.array([np.nan if v is None else v for v in values], np.float64)
        unit = _UNITS.get(name.rpartition("_")[2])
        if unit or name.startswith(("permittivity", "true_permittivity", "p_", "inverse", "confidence")):
            group[name].attrs["units"] = unit or "1"


_LONGEST_NAME = 63


def write_mat(path: Path, products: SavedProducts) -> None:
    """Write a MATLAB file: `h`, `v`, `p`, `valid` [y, x], `x_m`, `y_m`, structs `materials`, `config`, `versions`.

    If known also `p_sigma` [y, x], `verdict` and `verdict_reasons` (JSON). `quality_json` and `materials_json` are the
    files as text, for jsondecode.
    """
    content = {
        "h": products.h,
        "v": products.v,
        "p": products.p,
        "valid": products.valid,
        "x_m": products.x_m[None, :],
        "y_m": products.y_m[:, None],
        "materials": {name: _column(values, name in _TEXT) for name, values in material_columns(products).items()},
        "config": _struct(products.scan.get("instrument", {})),
        "versions": _struct(products.scan.get("versions", {})),
        "scan_id": products.scan_id,
        "simulated": np.nan if products.simulated is None else products.simulated,
        "convention": CONVENTION,
        "quality_json": json.dumps(products.quality),
        "materials_json": json.dumps(products.materials),
        **verdict_attributes(products.verdict),
    }
    if products.p_sigma is not None:
        content["p_sigma"] = products.p_sigma
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, long_field_names=True, do_compression=True, oned_as="column")
    write_atomically(path, buffer.getvalue())


def _column(values: list[Any], text: bool) -> Any:
    """Return a column of numbers (NaN if unknown) or of bools, or a cell array of text."""
    if text:
        return np.array([v or "" for v in values], dtype=object)[:, None]
    if values and all(isinstance(v, bool) for v in values):
        return np.array(values)[:, None]
    return np.array([np.nan if v is None else v for v in values], np.float64)[:, None]


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
            "add one or more of --hdf5, --netcdf, --zarr, --mat, --csv, --cphd",
            code=ErrorCode.KEY_MISSING,
        )
    products = read_products(folder)
    if "csv" in formats and not products.materials:
        raise DataError(
            f"{products.folder}: no materials.json",
            "this scan has images only",
            "polysight process finds the materials",
            code=ErrorCode.FILE_MISSING,
        )
    out = export_folder(products.folder, out)
    for kind in formats:
        sys.stderr.write(f"writing {kind} ...\n")
        sys.stderr.flush()
        writer, name = {
            "hdf5": (write_hdf5, "image.h5"),
            "netcdf": (lambda path, saved: write_netcdf(path, full_dataset(ProcessedScan(saved.folder))), "image.nc"),
            "zarr": (lambda path, saved: write_zarr(path, full_dataset(ProcessedScan(saved.folder))), "image.zarr"),
            "mat": (write_mat, "image.mat"),
            "csv": (write_csv, "materials.csv"),
        }[kind]
        writer(out / name, products)
        sys.stdout.write(f"{out / name}\n")
        sys.stdout.flush()
    return 0
