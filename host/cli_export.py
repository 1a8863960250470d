"""The options of `polysight export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli_materials import Add

_FORMATS = {
    "hdf5": "image.h5: arrays with axes as dimension scales, units, config, versions (needs h5py)",
    "netcdf": "image.nc: an xarray dataset; complex variables as h_real, h_imag (needs h5netcdf)",
    "zarr": "image.zarr: the same dataset as a Zarr store (needs zarr)",
    "mat": "image.mat: the same for MATLAB and Octave",
    "png": "amplitude (dB) and phase (degrees) of H, V and P, and the materials",
    "csv": "materials.csv: a line a patch, permittivity with standard errors",
}


def _export(args: argparse.Namespace) -> int:
    from polysight.host.report.export import export

    return export(args.products, [name for name in _FORMATS if getattr(args, name)], args.out)


def add_export_command(add: Add) -> None:
    """`polysight export`."""
    sub = add(
        "export",
        _export,
        "write the products of a processed scan for other programs: HDF5, NetCDF, Zarr, MATLAB, PNG, CSV",
        "polysight export out/one --hdf5 --csv",
    )
    sub.add_argument("products", type=Path, metavar="DIR", help="folder that polysight process wrote, or a scan folder")
    for name, text in _FORMATS.items():
        sub.add_argument(f"--{name}", action="store_true", help=text)
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder to write into (default: DIR-export beside it)")
