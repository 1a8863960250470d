"""The commands on materials: materials, report, permittivity, concentration, classify, train, export, label."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.cli.options import (
    AddCommand,
    add_config_option,
    add_json_option,
    add_model_option,
    count,
    number,
    readable_text,
)
from polysight.data import find_packaged
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.files import require_writable

if TYPE_CHECKING:
    from polysight.materials import Layer


def _run_materials(args: argparse.Namespace) -> int:
    """Run `polysight materials`. Raises ConfigError unless either scans or the catalogue are given."""
    from polysight.jobs.materials import catalogue, materials

    if bool(args.data) == args.catalogue:
        raise ConfigError(
            "materials takes either DATA or --catalogue",
            "it prints the patches of scans, or the materials of the literature",
            "polysight materials out/one, or polysight materials --catalogue",
            code=ErrorCode.VALUES_CONFLICT,
        )
    if args.catalogue:
        return catalogue(args.as_json)
    return materials(args.data, args.as_json)


def _run_permittivity(args: argparse.Namespace) -> int:
    """Run `polysight permittivity`. Raises ConfigError for options that have no effect without layers."""
    from polysight.jobs.materials import permittivity

    options = {"--bands": args.bands, "--amplitude": args.amplitude, "--config": args.config}
    useless = [name for name, value in options.items() if value is not None]
    if useless and not args.layer:
        raise ConfigError(
            f"{' and '.join(useless)} without --layer would do nothing",
            "these options say how layers are fitted; a single interface does not need them",
            "add the layers (--layer), or leave these options out",
            code=ErrorCode.VALUES_CONFLICT,
        )
    amplitude = 10.0 if args.amplitude is None else args.amplitude
    return permittivity(
        folder=args.products,
        config=args.config,
        stack=args.layer,
        number=args.patch,
        as_json=args.as_json,
        bands=args.bands,
        amplitude_error=amplitude / 100,
    )


def _parse_layer_option(text: str) -> Layer:
    """Parse a layer of a stack, see `LAYER_FORMS`."""
    from polysight.materials import LAYER_FORMS, parse_layer

    try:
        return parse_layer(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a layer: write {LAYER_FORMS}") from None


def _parse_value(text: str) -> tuple[str, float]:
    """Parse NAME=PERCENT; the name may contain `=`."""
    name, _, number = text.rpartition("=")
    try:
        return name, _percent(number)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PERCENT, e.g. water=0") from None


_percent = number(float, "a percentage from 0 to 100", lambda value: 0 <= value <= 100)


_share = number(float, "a share from 0.5 to below 1", lambda value: 0.5 <= value < 1)


def add_commands(add: AddCommand) -> None:
    """Register the commands. The last argument of `add` names the options that the help shows first."""
    _add_results(add)
    _add_permittivity(add)
    _add_concentration(add)
    _add_classify(add)
    _add_train(add)
    _add_export(add)
    _add_label(add)


def _add_results(add: AddCommand) -> None:
    """Add `polysight materials` and `polysight report`."""
    sub = add(
        "materials",
        _run_materials,
        "print names and permittivities of the patches of processed scans, or the catalogue of the literature",
        "polysight materials out/one\n  polysight materials --catalogue",
    )
    sub.add_argument("data", type=Path, nargs="*", metavar="DATA", help="scan folders, or folders of products")
    sub.add_argument("--catalogue", action="store_true", help="print the permittivities of the open literature instead")
    add_json_option(sub)

    sub = add(
        "report",
        "materials.report",
        "print where a scan's report is; make it if it is missing",
        "polysight report scans/one",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder, or a folder of products")


def _add_permittivity(add: AddCommand) -> None:
    """Add `polysight permittivity` and its options."""
    sub = add(
        "permittivity",
        _run_permittivity,
        "print the permittivity of patches, also of a layer in a stack",
        "polysight permittivity out/one --patch 3 --layer glass,5.5,0.05,3 --layer liquid,?\n"
        "  polysight permittivity out/one --layer sheet,?,0.5-3 --layer plate,metal",
    )
    sub.add_argument("products", type=Path, metavar="PRODUCTS", help="folder of products, or a scan folder")
    sub.add_argument("--patch", "--segment", type=int, metavar="N", help="this patch only (default: all)")
    sub.add_argument(
        "--layer",
        type=_parse_layer_option,
        action="append",
        default=[],
        metavar="LAYER",
        help="a layer, in the order the wave meets them; known: NAME,REAL,LOSS,MM or NAME,metal; unknown: NAME,?,MM,"
        " with its thickness fitted NAME,?,A-B (mm) or NAME,?,?; without MM the last layer has no back",
    )
    add_json_option(sub)
    group = sub.add_argument_group("with --layer")
    group.add_argument(
        "--bands",
        type=count,
        metavar="K",
        help="use K sub-bands, as processed with --bands K (default: all where a thickness is fitted, else none)",
    )
    group.add_argument(
        "--amplitude", type=_percent, metavar="PERCENT", help="error of |H| (default: 10; 0: use the ratio alone)"
    )
    group.add_argument("--config", type=Path, metavar="FILE", help="rig file of the chirp (default: the products')")


def _add_concentration(add: AddCommand) -> None:
    """Add `polysight concentration` and its options."""
    sub = add(
        "concentration",
        "materials.concentration",
        "estimate the concentration of solutions from the polarisation angle",
        "polysight concentration sugar.npz --value water=0",
    )
    sub.add_argument("data", type=Path, metavar="LIBRARY", help="library (.npz), or folder of published material files")
    sub.add_argument(
        "--value",
        dest="values",
        type=_parse_value,
        action="append",
        default=[],
        metavar="NAME=PERCENT",
        help="concentration of a material without one in its name, such as '(3.8%%)'",
    )
    sub.add_argument("--confidence", type=_share, default=0.9, help="of the intervals (default: 0.9)")
    add_json_option(sub)


def _add_classify(add: AddCommand) -> None:
    """Add `polysight classify` and its options."""
    sub = add(
        "classify",
        "materials.classify",
        "name the patches of processed scans, or judge the classifiers on a library",
        "polysight classify out/at-60 out/at-55",
    )
    sub.add_argument(
        "data",
        type=Path,
        nargs="+",
        metavar="DATA",
        help="folders of products, one for each angle the patches were scanned under; or one library (.npz) or folder"
        " of published material files",
    )
    sub.add_argument("--library", type=Path, metavar="FILE", help="reference library (default: the simulated one)")
    add_model_option(sub)
    add_json_option(sub)


def _train(args: argparse.Namespace) -> int:
    """Run `polysight train`, on scans and scenes or on the published data set. Raises ConfigError for both."""
    if args.authors is not None and (args.data or args.simulate):
        raise ConfigError(
            f"{'DATA' if args.data else '--simulate'} and --authors together",
            "a library is made of scans of this rig, or of the published files: not of both",
            "give one of them",
            code=ErrorCode.VALUES_CONFLICT,
        )
    if args.authors is not None:
        from polysight.jobs.demo import require_package

        require_package("polysight_papers", "papers")
        from polysight_papers.sensys2026.dataset import train_authors

        require_writable(args.out)
        return train_authors(args.authors, args.config, args.out)
    from polysight.jobs.train import train

    scenes = None
    if args.simulate is not None:
        scenes = find_packaged(args.simulate)
    require_writable(args.out)
    return train(scenes, args.data, args.config, args.out, args.times)


def _add_train(add: AddCommand) -> None:
    """Add `polysight train` and its options."""
    sub = add(
        "train",
        _train,
        "make a reference library from labelled or simulated scans",
        "polysight train --simulate examples/library --out library.npz",
        ("--simulate", "--authors"),
    )
    sub.add_argument("data", type=Path, nargs="*", metavar="DATA", help="labelled or simulated scans")
    sub.add_argument("--simulate", type=Path, metavar="DIR", help="simulate every scene in DIR and use it")
    sub.add_argument(
        "--times", type=count, default=1, metavar="N", help="simulate each scene N times, with other specimens"
    )
    sub.add_argument("--authors", type=Path, metavar="DIR", help="the published data set (materials/, labels/)")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help="library to write (.npz)")
    add_config_option(sub, shipped=True)


# Option of each format to its help.
_FORMATS = {
    "csv": "materials.csv: a line a patch, permittivity with standard errors",
    "netcdf": "image.nc: an xarray dataset; complex variables as h_real, h_imag (needs h5netcdf)",
    "mat": "image.mat: for MATLAB and Octave",
}


def _export(args: argparse.Namespace) -> int:
    """Run `polysight export`."""
    from polysight.products import export

    return export(args.products, [name for name in _FORMATS if getattr(args, name)], args.out)


def _add_export(add: AddCommand) -> None:
    """Add `polysight export` and its options."""
    sub = add(
        "export",
        _export,
        "export a processed scan to NetCDF, MATLAB or CSV",
        "polysight export out/one --netcdf --csv",
        ("--csv", "--mat", "--netcdf"),
    )
    sub.add_argument("products", type=Path, metavar="DIR", help="folder of products, or a scan folder")
    for name, text in _FORMATS.items():
        sub.add_argument(f"--{name}", action="store_true", help=text)
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder to write into (default: DIR-export, next to DIR)")


_LABEL_EXAMPLES = (
    "polysight label scans/one                               # asks for the name of each patch\n"
    "  polysight label scans/one --from-patches --metal 1 --rename 2=oak --rename 3=glass\n"
    "  polysight label scans/one --box oak=-20,-20,20,20 --specimen 'oak=board 7'"
)


def _label(args: argparse.Namespace) -> int:
    """Run `polysight label`, which asks for names only at a terminal."""
    from polysight.jobs.label import Edits, label

    edits = Edits(
        from_patches=args.from_patches,
        removed=args.remove,
        renames=args.rename,
        boxes=args.box,
        specimens=args.specimen,
        metal=args.metal,
    )
    ask = input if sys.stdin.isatty() else None
    return label(args.scan, edits, list_only=args.list, ask=ask)


def _parse_box(text: str) -> tuple[str, tuple[float, float, float, float]]:
    """Parse NAME=x0,y0,x1,y1; the name may contain `=`."""
    name, _, corners = readable_text(text).rpartition("=")
    try:
        x0, y0, x1, y1 = (float(part) for part in corners.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=x0,y0,x1,y1 in mm") from None
    return name, (x0, y0, x1, y1)


def _parse_pair(text: str) -> str:
    """Check that a text has the form NAME=TEXT, neither of them empty, and return it unchanged."""
    if "=" not in text.strip("="):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=TEXT")
    return readable_text(text)


def _add_label(add: AddCommand) -> None:
    """Add `polysight label` and its options."""
    sub = add(
        "label",
        _label,
        "draw and name boxes on a processed scan, as training data",
        _LABEL_EXAMPLES,
        ("--from-patches", "--rename", "--box"),
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="processed scan folder, or a folder of products")
    sub.add_argument("--from-patches", action="store_true", help="begin with the patches found, named by number")
    sub.add_argument(
        "--rename",
        type=_parse_pair,
        action="append",
        default=[],
        metavar="OLD=NEW",
        help="rename a box or a patch's number",
    )
    sub.add_argument(
        "--box",
        type=_parse_box,
        action="append",
        default=[],
        metavar="NAME=x0,y0,x1,y1",
        help="draw a box: corners in mm from the image centre; NAME#2 is a second piece of the same material",
    )
    sub.add_argument("--remove", action="append", default=[], metavar="NAME", help="remove a box")
    sub.add_argument("--metal", metavar="NAME", help="the metal reference (default: the box with a metal's name)")
    sub.add_argument(
        "--specimen",
        type=_parse_pair,
        action="append",
        default=[],
        metavar="NAME=WHICH",
        help="name the piece of material in a box, the same in every scan of it",
    )
    sub.add_argument("--list", action="store_true", help="print boxes and patches, and write nothing")
