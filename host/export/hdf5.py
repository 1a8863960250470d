"""HDF5: arrays with their axes as dimension scales, units on everything, the rest as attributes."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.export.table import material_columns
from polysight.host.report.read import SavedProducts
from polysight.shared.errors import ConfigError

CONVENTION = (
    "H: s-polarised, V: p-polarised, P = H / V, relative to metal where a reference was found; row 0 is the smallest y,"
    " column 0 the smallest x; rig frame; permittivity is real - j loss"
)
_UNITS = {"mm": "mm", "deg": "degree", "db": "dB", "m": "m"}


def _h5py() -> Any:
    try:
        return import_module("h5py")
    except ImportError:
        raise ConfigError(
            "HDF5 needs the package h5py, which is not installed",
            "only this export uses it, so it is an extra",
            "pip install 'polysight[export]', or pip install h5py",
        ) from None


def write_hdf5(path: Path, products: SavedProducts) -> None:
    """Write a file of these products.

    /h, /v, /p complex64 [y, x], /valid bool [y, x]; /x, /y float64 in metres, the dimension scales of all four; group
    /materials with a column for each of :func:`polysight.host.export.table.material_columns`; attributes scan_id, simulated,
    convention, and as JSON instrument, versions, quality, materials.

    Raises
    ------
    ConfigError
        when h5py is not installed.
    """
    h5py = _h5py()
    part = path.with_name(f".{path.name}.part")
    with h5py.File(part, "w") as f:
        axes = {"y": products.y_m, "x": products.x_m}
        for name, values in axes.items():
            f[name] = values
            f[name].attrs["units"] = "m"
            f[name].attrs["long_name"] = f"pixel centre, {name} of the rig frame"
            f[name].make_scale(name)
        about = {"h": "s-polarised channel", "v": "p-polarised channel", "p": "polarisation ratio H / V"}
        for name, long_name in {**about, "valid": "whether the scan illuminates the pixel"}.items():
            data = f.create_dataset(name, data=getattr(products, name), compression="gzip", shuffle=True)
            data.attrs["units"], data.attrs["long_name"] = "1", long_name
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
        f.attrs["versions"] = json.dumps(products.scan.get("versions", {}))
        f.attrs["config"] = json.dumps(products.scan.get("instrument", {}))
    part.replace(path)


def _documents(products: SavedProducts) -> dict[str, dict[str, Any]]:
    return {"quality": products.quality, "materials": products.materials, "scan": products.scan}


def _write_materials(h5py: Any, group: Any, columns: dict[str, list[Any]]) -> None:
    """One dataset a column: text, bool or float64, not a number where a value is not known."""
    for name, values in columns.items():
        if name in ("name", "true_name"):
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
