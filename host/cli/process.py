"""The commands that turn recorded data into images: process, image, focus, sync-report."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.host.cli.options import (
    Add,
    add_material_options,
    count,
    material_request,
    positive,
    rig_file,
    text_of,
)
from polysight.shared.errors import ConfigError

if TYPE_CHECKING:
    from polysight.host.process import ProcessRequest


def request_of(args: argparse.Namespace, data: Path, out: Path) -> ProcessRequest:
    """What the options of `polysight process` ask to do with one scan. Raises ConfigError."""
    from polysight.host.process import ProcessRequest

    if args.reference is None and args.reference_by is not None:
        raise ConfigError(
            f"--reference-by {args.reference_by} without --reference would do nothing",
            "it says how the metal scan named by --reference is used",
            "add --reference SCAN, or leave it out",
        )
    return ProcessRequest(
        data=str(data),
        out=str(out),
        config=text_of(rig_file(args.config, data)),
        reference=text_of(args.reference),
        reference_by=args.reference_by or "position",
        incidence=args.incidence,
        bands=args.bands,
        **material_request(args),
    )


def _process(args: argparse.Namespace) -> int:
    from polysight.host.jobs.batch import process_several, scans_of
    from polysight.host.jobs.process import process

    scans = scans_of(args.data)
    if len(args.data) == 1 and scans == args.data and args.dask is None:
        return process(request_of(args, args.data[0], args.out))
    requests = [request_of(args, data.absolute(), args.out.absolute() / data.absolute().name) for data in scans]
    return process_several(requests, args.out, args.jobs, args.dask, args.again)


def _image(args: argparse.Namespace) -> int:
    from polysight.host.imaging import View
    from polysight.host.jobs.process import image

    view = View(args.depth, *(args.grid or (None, None, None)))
    return image(args.data, args.out, rig_file(args.config, args.data), view)


def _focus(args: argparse.Namespace) -> int:
    from polysight.host.jobs.process import focus

    return focus(args.data, args.out, rig_file(args.config, args.data), args.depth)


def _sync_report(args: argparse.Namespace) -> int:
    from polysight.host.jobs.process import sync_report

    return sync_report(args.data, args.out, rig_file(args.config, args.data))


def add_commands(add: Add) -> None:
    """Register the commands."""
    for name, run, text in (
        ("process", _process, "make images, material names and the report from recorded data"),
        ("image", _image, "make only the images from recorded data (image.npz), without naming materials"),
    ):
        sub = add(name, run, text, f"polysight {name} scans/one --out out/one")
        _add_data_arguments(sub, several=name == "process")
        if name == "process":
            add_material_options(sub)
            _add_polarimetry_options(sub)
        else:
            _add_view_options(sub)
    sub = add(
        "focus",
        _focus,
        "find the object plane's distance and tilt by the sharpness of the image; changes no file of the scan",
        "polysight focus scans/one --out out/focus",
    )
    sub.add_argument("data", type=Path, metavar="DATA", help="scan folder, or the authors' unsynced/<scan>")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for focus.json and focus.png")
    sub.add_argument(
        "--depth", type=positive, default=8.0, metavar="MM", help="how far to look to either side (default: 8 mm)"
    )
    sub.add_argument("--config", type=Path, default=None, metavar="FILE", help="rig file for unsynced/<scan>")
    sub = add(
        "sync-report",
        _sync_report,
        "say what synchronisation leaves of frequency, phase and amplitude errors, beside the Cramer-Rao bound",
        "polysight sync-report scans/one --out out/sync",
    )
    sub.add_argument("data", type=Path, metavar="DATA", help="scan folder, or the authors' unsynced/<scan>")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for sync.json, sync.txt, figures")
    sub.add_argument(
        "--config",
        type=Path,
        default=None,
        metavar="FILE",
        help="rig file for unsynced/<scan>; scan folders bring their own (default: instrument.toml, if it is here)",
    )


def _add_data_arguments(sub: argparse.ArgumentParser, several: bool) -> None:
    """What `process` and `image` work on; with `several` also the options that matter when more than one is given."""
    sub.add_argument(
        "data",
        type=Path,
        nargs="+" if several else None,
        metavar="DATA",
        help="scan folder, or the authors' unsynced/<scan> or raw/<scan>"
        + ("; several, or a folder of scans, are processed at once" if several else ""),
    )
    sub.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the products; earlier ones are replaced"
    )
    sub.add_argument(
        "--config",
        type=Path,
        default=None,
        metavar="FILE",
        help="rig file for the authors' data; scan folders bring their own (default: instrument.toml beside the data,"
        " or here)",
    )
    if not several:
        return
    many = sub.add_argument_group("several scans", "their products go to DIR/<scan>/, what each says to DIR/<scan>.log")
    many.add_argument(
        "--jobs", type=count, metavar="N", help="scans at a time (default: one a core, as far as memory goes)"
    )
    many.add_argument("--again", action="store_true", help="process scans again that are finished")
    many.add_argument(
        "--dask", metavar="ADDRESS", help="on a Dask cluster, e.g. tcp://host:8786, whose workers see the same folders"
    )


def grid(text: str) -> tuple[int, int, float]:
    """`COLUMNSxROWS@MM`: pixels and their distance."""
    words = re.fullmatch(r"(\d{1,4})x(\d{1,4})@(\d+(?:\.\d+)?)", text)
    columns, rows, pixel_mm = (int(words[1]), int(words[2]), float(words[3])) if words else (0, 0, 0.0)
    if min(columns, rows) < 2 or pixel_mm <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}: a grid is COLUMNSxROWS@MM, for example 300x300@1")
    return columns, rows, pixel_mm


def _add_view_options(sub: argparse.ArgumentParser) -> None:
    """`--depth` and `--grid` of `polysight image`."""
    sub.add_argument(
        "--depth",
        type=float,
        default=0.0,
        metavar="MM",
        help="image a plane that lies so much farther than the rig file's, or nearer below 0 (default: 0)",
    )
    sub.add_argument(
        "--grid",
        type=grid,
        metavar="COLUMNSxROWS@MM",
        help="pixels, and their distance in mm, about the same centre (default: the rig file's)",
    )


def _add_polarimetry_options(sub: argparse.ArgumentParser) -> None:
    """`--reference`, `--reference-by`, `--incidence` and `--bands` of `polysight process`."""
    sub.add_argument(
        "--reference",
        type=Path,
        metavar="SCAN",
        help="scan of a metal plate over the whole plane, as the metal reference (default: metal in the scene)",
    )
    sub.add_argument(
        "--reference-by",
        choices=["position", "mean"],
        help="with --reference: divide by it pixel by pixel, masked where it is weak (default), or by one number a"
        " channel",
    )
    sub.add_argument(
        "--incidence",
        choices=["one", "pixel"],
        default="one",
        help="incidence angle: one number for the image (default), or each pixel's own; both are in quality.json",
    )
    sub.add_argument(
        "--bands",
        type=count,
        default=1,
        metavar="K",
        help="image K sub-bands of the sweep too, for `polysight permittivity --layer ... --bands K` (default: none)",
    )
