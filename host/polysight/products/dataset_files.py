"""Write and read datasets as NetCDF files and Zarr stores.

NetCDF has no complex numbers: a complex variable `h` is stored as `h_real` and `h_imag`, each with the attribute
`complex_part`; :func:`read_netcdf` joins them again. Zarr stores complex numbers directly.
"""

from __future__ import annotations

import shutil
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polysight.products.files import temporary_path
from polysight.store import MAX_BYTES
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError

if TYPE_CHECKING:
    import xarray

_PART = "complex_part"
_ZARR_FORMAT = 2  # all readers support it, and text columns need no extension


def split_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return a dataset with each complex variable `h` replaced by real variables `h_real` and `h_imag`."""
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
    """Undo :func:`split_complex`: join the variables with the attribute `complex_part`."""
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
            "only this export uses it, so it is optional",
            f"pip install 'polysight[export]', or pip install {package}",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None


def write_netcdf(path: Path, dataset: xarray.Dataset) -> None:
    """Write a NetCDF 4 file; complex variables become two real ones, True and False in attributes 1 and 0.

    Raises
    ------
    ConfigError
        if h5netcdf is not installed.
    """
    _require("h5netcdf", "NetCDF")
    split = split_complex(dataset)
    split.attrs = {key: int(value) if isinstance(value, bool) else value for key, value in split.attrs.items()}
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {name: packed for name, v in split.data_vars.items() if v.ndim == 2 and v.dtype.kind in "biuf"}
    part = temporary_path(path)
    split.to_netcdf(part, engine="h5netcdf", encoding=encoding)
    part.replace(path)


def read_netcdf(path: Path) -> xarray.Dataset:
    """Load a file of :func:`write_netcdf` into memory, with complex variables.

    Raises
    ------
    ConfigError
        if h5netcdf is not installed.
    DataError
        if the file cannot be read.
    """
    import xarray

    _require("h5netcdf", "NetCDF")
    try:
        _check_hdf5(path)
        dataset = xarray.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError) as e:
        raise DataError(
            f"{path}: not a NetCDF file: {e}",
            "the path is wrong, or the file is damaged",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None
    if "simulated" in dataset.attrs and dataset.attrs["simulated"] != "unknown":
        dataset.attrs["simulated"] = bool(dataset.attrs["simulated"])
    return join_complex(dataset)


def _check_hdf5(path: Path) -> None:
    """Raise DataError if arrays lie in other files or are too large, before anything is read. Raises OSError."""
    import h5py

    sizes: list[int] = []
    external: list[str] = []
    with h5py.File(path, "r") as file:

        def check(name: str) -> None:  # called by HDF5, must not raise
            outside = isinstance(file.get(name, getlink=True), h5py.ExternalLink)
            found = None if outside else file.get(name)
            if isinstance(found, h5py.Dataset):
                outside = bool(found.external) or found.is_virtual
                sizes.append((found.size or 0) * found.dtype.itemsize)
            if outside:
                external.append(name)

        file.visit_links(check)
    if external:
        raise DataError(
            f"{path}: {external[0]} lies in another file",
            "it was not written by this program",
            code=ErrorCode.PATH_OUTSIDE,
        )
    if sum(sizes) > MAX_BYTES:
        raise DataError(
            f"{path}: its arrays take {sum(sizes)} bytes, more than the limit of {MAX_BYTES} bytes",
            "it was not written by this program, or is damaged",
            "export the products again",
            code=ErrorCode.FILE_TOO_LARGE,
        )


def write_zarr(path: Path, dataset: xarray.Dataset) -> None:
    """Write a Zarr store (a folder, Zarr format 2); an existing store at `path` is overwritten.

    Raises
    ------
    ConfigError
        if zarr is not installed, or `path` is something else.
    """
    _require("zarr", "Zarr")
    if path.exists() and not (path / ".zgroup").exists():
        raise ConfigError(
            f"{path} is not a Zarr store", "it was not exported", "give another folder", code=ErrorCode.FILE_FOREIGN
        )
    part = temporary_path(path)
    dataset.to_zarr(part, mode="w", zarr_format=_ZARR_FORMAT, consolidated=True)
    if path.exists():
        shutil.rmtree(path)
    part.rename(path)
