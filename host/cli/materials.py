"""The commands on materials: materials, report, permittivity, concentration, classify, train, export."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.data import packaged
from polysight.host.cli.options import Add, add_config_option, add_model_option, count, number
from polysight.shared.errors import ConfigError

if TYPE_CHECKING:
    from polysight.host.materials import Layer


def _materials(args: argparse.Namespace) -> int:
    from polysight.host.jobs.materials import materials

    return materials(args.data, args.json)


def _report(args: argparse.Namespace) -> int:
    from polysight.host.jobs.materials import report

    return report(args.scan)


def _permittivity(args: argparse.Namespace) -> int:
    from polysight.host.jobs.materials import permittivity

    given = {"--bands": args.bands, "--amplitude": args.amplitude, "--config": args.config}
    useless = [name for name, value in given.items() if value is not None]
    if useless and not args.layer:
        raise ConfigError(
            f"{' and '.join(useless)} without --layer would do nothing",
            "it says how layers are fitted; one interface needs none of it",
            "add the layers (--layer), or leave it out",
        )
    amplitude = 10.0 if args.amplitude is None else args.amplitude
    return permittivity(args.products, args.config, args.layer, args.segment, args.json, args.bands, amplitude / 100)


def _concentration(args: argparse.Namespace) -> int:
    from polysight.host.jobs.materials import concentration

    return concentration(args.data, dict(args.value), args.confidence, args.json)


def _classify(args: argparse.Namespace) -> int:
    from polysight.host.jobs.classify import classify

    return classify(args.data, args.library, args.model, args.json)


def _layer(text: str) -> Layer:
    from polysight.host.materials import LAYER_FORMS, parse_layer

    try:
        return parse_layer(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no layer: write {LAYER_FORMS}") from None


def _value(text: str) -> tuple[str, float]:
    name, _, number = text.rpartition("=")
    try:
        return name, float(number)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PERCENT, e.g. water=0") from None


_percent = number(float, "a percentage from 0 to 100", lambda value: 0 <= value <= 100)


_share = number(float, "a share from 0.5 to below 1", lambda value: 0.5 <= value < 1)


def add_commands(add: Add) -> None:
    """Register the commands."""
    _add_results(add)
    _add_permittivity(add)
    _add_concentration(add)
    _add_classify(add)
    _add_train(add)
    _add_export(add)


def _add_results(add: Add) -> None:
    sub = add(
        "materials",
        _materials,
        "what the patches of processed scans were named, and their permittivity",
        "polysight materials out/one",
    )
    sub.add_argument(
        "data", type=Path, nargs="+", metavar="DATA", help="folders that polysight process wrote, or scan folders"
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")

    sub = add(
        "report",
        _report,
        "say where a scan's report is; make it from the raw rows where it is not there",
        "polysight report scans/one",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan folder, or a folder that polysight process wrote")


def _add_permittivity(add: Add) -> None:
    sub = add(
        "permittivity",
        _permittivity,
        "permittivity of the patches of a processed scan, also of a thin sheet or of a liquid behind a wall",
        "polysight permittivity out/one --segment 3 --layer glass,5.5,0.05,3 --layer liquid,?\n"
        "  polysight permittivity out/one --layer sheet,?,0.5-3 --layer plate,metal",
    )
    sub.add_argument(
        "products", type=Path, metavar="PRODUCTS", help="folder that polysight process wrote, or a scan folder"
    )
    sub.add_argument("--segment", type=int, metavar="N", help="this patch only (default: all)")
    sub.add_argument(
        "--layer",
        type=_layer,
        action="append",
        default=[],
        metavar="LAYER",
        help="layers in the order the wave meets them: NAME,REAL,LOSS,MM or NAME,metal for a known one, NAME,?,MM for"
        " the unknown one; NAME,?,A-B fits its thickness too, from A to B mm, NAME,?,? any thickness; without MM the"
        " last one has no back (default: one interface)",
    )
    sub.add_argument(
        "--bands",
        type=count,
        metavar="K",
        help="with --layer: use K sub-bands of the sweep, as processed with --bands K (default: the whole sweep; all"
        " sub-bands where a thickness is fitted)",
    )
    sub.add_argument(
        "--amplitude",
        type=_percent,
        metavar="PERCENT",
        help="with --layer: how far |H| may be trusted; 0 uses the ratio alone (default: 10)",
    )
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="with --layer: take the chirp from this rig file (default: the one the products were made with)",
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _add_concentration(add: Add) -> None:
    sub = add(
        "concentration",
        _concentration,
        "concentration of a solution from its polarisation angle, each concentration judged by the others",
        "polysight concentration sugar.npz --value water=0",
    )
    sub.add_argument("data", type=Path, metavar="LIBRARY", help="library (.npz), or folder of published material files")
    sub.add_argument(
        "--value",
        type=_value,
        action="append",
        default=[],
        metavar="NAME=PERCENT",
        help="concentration of a material whose name does not tell it as '(3.8%%)' does",
    )
    sub.add_argument("--confidence", type=_share, default=0.9, help="of the intervals (default: 0.9)")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _add_classify(add: Add) -> None:
    sub = add(
        "classify",
        _classify,
        "name the patches of processed scans, of several angles together; or judge the classifiers on a library",
        "polysight classify out/at-60 out/at-55",
    )
    sub.add_argument(
        "data",
        type=Path,
        nargs="+",
        metavar="DATA",
        help="folders that polysight process wrote, one for each angle the same patches were scanned under; or one"
        " library (.npz) or folder of published material files, on which every classifier is judged",
    )
    sub.add_argument("--library", type=Path, metavar="FILE", help="reference library (default: the simulated one)")
    add_model_option(sub)
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _train(args: argparse.Namespace) -> int:
    if args.authors is not None and (args.data or args.simulate):
        raise ConfigError(
            f"{'DATA' if args.data else '--simulate'} and --authors together",
            "a library is made of scans of this rig, or of the published files: not of both",
            "give one of them",
        )
    if args.authors is not None:
        from polysight.papers.sensys2026.dataset import train_authors

        return train_authors(args.authors, args.config, args.out)
    from polysight.host.jobs.train import train

    scenes = None if args.simulate is None else packaged(args.simulate)
    return train(scenes, args.data, args.config, args.out, args.times)


def _add_train(add: Add) -> None:
    sub = add(
        "train",
        _train,
        "make the classifier's reference library from labelled scans, or from simulated ones",
        "polysight train --simulate examples/library --out library.npz",
    )
    add_config_option(sub, shipped=True)
    sub.add_argument(
        "data", type=Path, nargs="*", metavar="DATA", help="scans that polysight label names, or simulated ones"
    )
    sub.add_argument(
        "--simulate", type=Path, default=None, metavar="DIR", help="simulate every scene in DIR and use it"
    )
    sub.add_argument(
        "--times", type=count, default=1, metavar="N", help="simulate each scene N times, each with other specimens"
    )
    sub.add_argument(
        "--authors", type=Path, default=None, metavar="DIR", help="the published data set: its materials/ and labels/"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help="library to write (.npz)")


_FORMATS = {
    "hdf5": "image.h5: arrays with axes as dimension scales, units, config, versions (needs h5py)",
    "netcdf": "image.nc: an xarray dataset; complex variables as h_real, h_imag (needs h5netcdf)",
    "zarr": "image.zarr: the same dataset as a Zarr store (needs zarr)",
    "mat": "image.mat: the same for MATLAB and Octave",
    "png": "amplitude (dB) and phase (degrees) of H, V and P, and the materials",
    "csv": "materials.csv: a line a patch, permittivity with standard errors",
}


def _export(args: argparse.Namespace) -> int:
    formats = [name for name in _FORMATS if getattr(args, name)]
    if args.cphd:
        from polysight.host.jobs.phase_history import export_cphd

        export_cphd(args.products, args.out)
        if not formats:
            return 0
    from polysight.host.report import export

    return export(args.products, formats, args.out)


def _add_export(add: Add) -> None:
    sub = add(
        "export",
        _export,
        "write the products of a processed scan for other programs: HDF5, NetCDF, Zarr, MATLAB, PNG, CSV, CPHD",
        "polysight export out/one --hdf5 --csv",
    )
    sub.add_argument("products", type=Path, metavar="DIR", help="folder that polysight process wrote, or a scan folder")
    for name, text in _FORMATS.items():
        sub.add_argument(f"--{name}", action="store_true", help=text)
    sub.add_argument(
        "--cphd",
        action="store_true",
        help="phase-history.cphd: the scan's rows as bistatic phase history, for other SAR processors (needs sarkit)",
    )
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder to write into (default: DIR-export beside it)")
