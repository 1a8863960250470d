"""Datasets as NetCDF files and Zarr stores.

NetCDF has no complex numbers: a complex variable `h` is stored as `h_real` and `h_imag`, each with the attribute
`complex_part`, from which :func:`read_netcdf` makes `h` again. Zarr stores complex numbers as they are.
"""

from __future__ import annotations

import shutil
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polysight.host.products.files import fresh_part
from polysight.host.store import MOST_BYTES
from polysight.shared.errors import ConfigError, DataError

if TYPE_CHECKING:
    import xarray

_PART = "complex_part"
_ZARR_FORMAT = 2  # every reader knows it, and its text columns need no extension


def split_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    """Copy of a dataset with each complex variable `h` replaced by real variables `h_real` and `h_imag`."""
    made: dict[str, Any] = {}
    for name, variable in dataset.data_vars.items():
        if variable.dtype.kind != "c":
            made[str(name)] = variable
            continue
        about = variable.attrs.get("long_name", str(name))
        for suffix, part in (("real", "real"), ("imag", "imaginary")):
            values = variable.real if suffix == "real" else variable.imag
            attrs = {**variable.attrs, "long_name": f"{about}, {part} part", _PART: suffix}
            made[f"{name}_{suffix}"] = values.copy().assign_attrs(attrs)
    return dataset.drop_vars(list(dataset.data_vars)).assign(made)


def join_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    """Undo :func:`split_complex`: variables that say which part they are become complex ones again."""
    made: dict[str, Any] = {}
    for full_name, variable in dataset.data_vars.items():
        name, _, suffix = str(full_name).rpartition("_")
        if variable.attrs.get(_PART) == "real" and f"{name}_imag" in dataset:
            both = np.empty(variable.shape, np.complex64 if variable.dtype == np.float32 else np.complex128)
            both.real, both.imag = variable.values, dataset[f"{name}_imag"].values
            attrs = {key: text for key, text in variable.attrs.items() if key != _PART}
            attrs["long_name"] = str(attrs.get("long_name", name)).removesuffix(", real part")
            made[name] = (variable.dims, both, attrs)
        elif variable.attrs.get(_PART) != suffix or suffix != "imag":
            made[str(full_name)] = variable
    return dataset.drop_vars(list(dataset.data_vars)).assign(made)


def _require(package: str, kind: str) -> None:
    try:
        import_module(package)
    except ImportError:
        raise ConfigError(
            f"{kind} needs the package {package}, which is not installed",
            "only this export uses it, so it is an extra",
            f"pip install 'polysight[export]', or pip install {package}",
        ) from None


def write_netcdf(path: Path, dataset: xarray.Dataset) -> None:
    """Write a NetCDF 4 file; complex variables as two real ones, True and False in attributes as 1 and 0.

    Raises
    ------
    ConfigError
        when h5netcdf is not installed.
    """
    _require("h5netcdf", "NetCDF")
    split = split_complex(dataset)
    split.attrs = {key: int(value) if isinstance(value, bool) else value for key, value in split.attrs.items()}
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {name: packed for name, v in split.data_vars.items() if v.ndim == 2 and v.dtype.kind in "biuf"}
    part = fresh_part(path)
    split.to_netcdf(part, engine="h5netcdf", encoding=encoding)
    part.replace(path)


def read_netcdf(path: Path) -> xarray.Dataset:
    """Read a file that :func:`write_netcdf` wrote, whole, with its complex variables.

    Raises
    ------
    ConfigError
        when h5netcdf is not installed.
    DataError
        when the file cannot be read.
    """
    import xarray

    _require("h5netcdf", "NetCDF")
    try:
        _check_hdf5(path)
        dataset = xarray.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: not a NetCDF file: {e}", "the path is wrong, or the file is damaged") from None
    if "simulated" in dataset.attrs and dataset.attrs["simulated"] != "unknown":
        dataset.attrs["simulated"] = bool(dataset.attrs["simulated"])
    return join_complex(dataset)


def _check_hdf5(path: Path) -> None:
    """Refuse a file whose arrays lie in other files, or take more than is read, before any of it is.

    Raises
    ------
    DataError, OSError
        naming what.
    """
    import h5py

    sizes: list[int] = []
    elsewhere: list[str] = []
    with h5py.File(path, "r") as file:

        def look(name: str) -> None:  # must not raise: HDF5 calls it
            outside = isinstance(file.get(name, getlink=True), h5py.ExternalLink)
            found = None if outside else file.get(name)
            if isinstance(found, h5py.Dataset):
                outside = bool(found.external) or found.is_virtual
                sizes.append((found.size or 0) * found.dtype.itemsize)
            if outside:
                elsewhere.append(name)

        file.visit_links(look)
    if elsewhere:
        raise DataError(f"{path}: {elsewhere[0]} lies in another file", "it was not made by this program")
    if sum(sizes) > MOST_BYTES:
        raise DataError(
            f"{path}: its arrays take {sum(sizes)} bytes, more than the {MOST_BYTES} bytes that are read",
            "it was not made by this program, or is damaged",
            "export the products again",
        )


def write_zarr(path: Path, dataset: xarray.Dataset) -> None:
    """Write a Zarr store (a folder, Zarr format 2); an earlier store at `path` is replaced.

    Raises
    ------
    ConfigError
        when zarr is not installed, or `path` holds something else.
    """
    _require("zarr", "Zarr")
    if path.exists() and not (path / ".zgroup").exists():
        raise ConfigError(f"{path} is not a Zarr store", "something else has that name", "give another folder")
    part = fresh_part(path)
    dataset.to_zarr(part, mode="w", zarr_format=_ZARR_FORMAT, consolidated=True)
    if path.exists():
        shutil.rmtree(path)
    part.rename(path)
