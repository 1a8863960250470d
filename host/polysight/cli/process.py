"""The commands on recorded data: process, surface, image, focus, sync-report, and for the rig: calibrate, leakage."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import msgspec

from polysight.cli.options import (
    AddCommand,
    CommandParser,
    add_action,
    add_json_option,
    add_material_options,
    count,
    material_settings,
    number,
    rig_file,
)
from polysight.settings import Settings, path_text
from polysight_shared.config import MAX_IMAGE_MM, MAX_PIXEL_MM, MAX_PIXELS, MIN_PIXEL_MM

_parse_shift = number(float, "a shift of at most 1000 mm", lambda value: abs(value) <= 1000)
_search_range = number(float, "a length of 0.5 to 100 mm", lambda value: 0.5 <= value <= 100)
_millimetres = number(float, "a length above 0, at most 50 mm", lambda value: 0 < value <= 50)
_radius = number(float, "a radius of 50 to 500 mm", lambda value: 50 <= value <= 500)
_turn = number(float, "angles of at most 360 degrees, as 0,30,60", lambda value: abs(value) <= 360)
_parse_degrees = number(float, "`one`, `pixel` or an angle of 5 to 80 degrees", lambda value: 5 <= value <= 80)


def _parse_angles(text: str) -> tuple[float, ...]:
    """Parse the angles of a turntable, separated by commas."""
    return tuple(_turn(part) for part in text.split(","))


def _parse_axis(text: str) -> tuple[float, float]:
    """Parse x and z of a turntable's axis, millimetres, separated by a comma."""
    x, _, z = text.partition(",")
    if not (x and z):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form X,Z in mm, e.g. 0,45")
    return _parse_shift(x), _parse_shift(z)


def _parse_incidence(text: str) -> str | float:
    """Parse `one`, `pixel`, or degrees."""
    if text in ("one", "pixel"):
        return text
    return _parse_degrees(text)


def process_settings(args: argparse.Namespace, data: Path) -> Settings:
    """Return the settings of `polysight process` for one scan. Raises ConfigError."""
    # `--incidence` takes the word of a method, or the degrees of given images.
    method = args.incidence
    degrees = None
    if isinstance(args.incidence, float):
        method = "one"
        degrees = args.incidence
    return msgspec.structs.replace(
        material_settings(args),
        config=path_text(rig_file(args.config, data)),
        reference=path_text(args.reference),
        incidence=method,
        incidence_deg=degrees,
        bands=args.bands,
        sparse=args.sparse,
    )


def _process(args: argparse.Namespace) -> int:
    """Run `polysight process`: one scan in this program, several as a batch."""
    from polysight.jobs.output import say

    # This is printed before the other modules are loaded, which takes most of a second.
    say("checking data and settings")
    from polysight.jobs.batch import find_scans, process_several
    from polysight.jobs.process import process

    scans = find_scans(args.data)
    if len(args.data) == 1 and scans == args.data and args.dask is None:
        return process(args.data[0], args.out, process_settings(args, args.data[0]))
    # The paths are absolute, because the processes of a batch may have another working folder.
    several = [(data, process_settings(args, data.absolute())) for data in scans]
    return process_several(several, args.out, at_a_time=args.jobs, dask=args.dask, again=args.again)


def _run_surface(args: argparse.Namespace) -> int:
    """Run `polysight surface`."""
    from polysight.jobs.surface import surface

    return surface(
        args.data,
        args.out,
        rig_file(args.config, args.data[0]),
        args.reference,
        turned_deg=args.turned,
        axis_mm=args.axis,
        as_json=args.as_json,
    )


def _image(args: argparse.Namespace) -> int:
    """Run `polysight image`."""
    from polysight.jobs.process import image

    columns, rows, pixel_mm = args.grid or (None, None, None)
    settings = Settings(
        config=path_text(rig_file(args.config, args.data)),
        depth_mm=args.depth,
        columns=columns,
        rows=rows,
        pixel_mm=pixel_mm,
        sparse=args.sparse,
    )
    return image(args.data, args.out, settings)


def _run_focus(args: argparse.Namespace) -> int:
    from polysight.jobs.process import focus

    return focus(args.data, args.out, rig_file(args.config, args.data), args.depth)


def _run_sync_report(args: argparse.Namespace) -> int:
    from polysight.jobs.process import sync_report

    return sync_report(args.data, args.out, rig_file(args.config, args.data))


def _add_surface(add: AddCommand) -> None:
    """Add `polysight surface` and its options."""
    sub = add(
        "surface",
        _run_surface,
        "measure shape and permittivity of curved and tilted objects",
        "polysight surface scans/bottle --out out/bottle",
    )
    _add_data(sub, several=True, images=False)
    sub.add_argument(
        "--turned",
        type=_parse_angles,
        default=(),
        metavar="DEGREES,...",
        help="join scans of an object on a turntable, one angle for each scan: 0,30,60",
    )
    sub.add_argument(
        "--axis",
        type=_parse_axis,
        metavar="X,Z",
        help="turntable's axis: mm from the grid's middle, and from the object plane (default: 0,0)",
    )
    sub.add_argument(
        "--reference",
        type=Path,
        metavar="SCAN",
        help="scan of a flat metal plate, or of a metal sphere (default: the sphere of the rig file's calibration)",
    )
    add_json_option(sub)


def add_commands(add: AddCommand) -> None:
    """Register the commands. The last argument of `add` names the options that the help shows first."""
    sub = add(
        "process",
        _process,
        "make images, material names and a report from recorded data",
        "polysight process scans/one --out out/one",
        ("--library", "--metal-box", "--metal"),
    )
    _add_data(sub, several=True)
    add_material_options(sub)
    _add_polarimetry_options(sub)
    _add_sparse(sub)
    _add_several_options(sub)
    _add_surface(add)
    sub = add("image", _image, "make only the images from recorded data", "polysight image scans/one --out out/one")
    _add_data(sub)
    sub.add_argument(
        "--depth",
        type=_parse_shift,
        default=0.0,
        metavar="MM",
        help="shift of the imaged plane, away from the rig (default: 0)",
    )
    sub.add_argument(
        "--grid",
        type=parse_grid,
        metavar="COLUMNSxROWS@MM",
        help="number and distance of pixels (default: the rig file's)",
    )
    _add_sparse(sub)
    sub = add(
        "focus",
        _run_focus,
        "find the distance and tilt of the object plane by the sharpness of the image",
        "polysight focus scans/one --out out/focus",
    )
    _add_data(sub)
    sub.add_argument(
        "--depth", type=_search_range, default=8.0, metavar="MM", help="search range to either side (default: 8 mm)"
    )
    sub = add(
        "sync-report",
        _run_sync_report,
        "report the errors that remain after synchronisation, compared with the Cramer-Rao bound",
        "polysight sync-report scans/one --out out/sync",
    )
    _add_data(sub)
    _add_calibrate(add)
    _add_leakage(add)


def _add_data(sub: argparse.ArgumentParser, several: bool = False, images: bool = True) -> None:
    """Add the options for the recorded data, the folder of results, and the rig file of published data.

    Only commands for `several` scans may take `images`, too.
    """
    text = "scan folder, or published unsynced/<scan> or raw/<scan>"
    if several and not images:
        text += "; or several"
    elif several:
        text += "; or images: published labels/<scan>, or .npz with h and v; or several, or a folder of them"
    sub.add_argument("data", type=Path, nargs="+" if several else None, metavar="DATA", help=text)
    sub.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the results; earlier ones are replaced"
    )
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="rig file of published data (default: instrument.toml in its folder or here, or the packaged one)",
    )


def _add_sparse(sub: argparse.ArgumentParser) -> None:
    """Add `--sparse`."""
    sub.add_argument(
        "--sparse",
        action="store_true",
        help="reconstruct positions that are masked, were not recorded, or lie between steps too wide for the image",
    )


def _add_several_options(sub: argparse.ArgumentParser) -> None:
    """Add the options for several scans."""
    group = sub.add_argument_group(
        "several scans", "their products go to DIR/<scan>/, their messages to DIR/<scan>.log"
    )
    group.add_argument("--jobs", type=count, metavar="N", help="scans at a time (default: as cores and memory allow)")
    group.add_argument("--again", action="store_true", help="process finished scans again")
    group.add_argument(
        "--dask", metavar="ADDRESS", help="use a Dask cluster with the same folders, e.g. tcp://host:8786"
    )


def parse_grid(text: str) -> tuple[int, int, float]:
    """Parse `COLUMNSxROWS@MM`: pixels and their distance."""
    words = re.fullmatch(r"(\d{1,4})x(\d{1,4})@(\d+(?:\.\d+)?)", text)
    if words is None:
        raise argparse.ArgumentTypeError(f"{text!r}: a grid is COLUMNSxROWS@MM, for example 300x300@1")
    columns = int(words[1])
    rows = int(words[2])
    pixel_mm = float(words[3])
    if min(columns, rows) < 2 or columns * rows > MAX_PIXELS or not MIN_PIXEL_MM <= pixel_mm <= MAX_PIXEL_MM:
        raise argparse.ArgumentTypeError(
            f"{text!r}: a grid has 2 x 2 to {MAX_PIXELS} pixels, {MIN_PIXEL_MM:g} to {MAX_PIXEL_MM:g} mm apart"
        )
    if max(columns, rows) * pixel_mm > MAX_IMAGE_MM:
        raise argparse.ArgumentTypeError(f"{text!r}: an image has a width and height of at most {MAX_IMAGE_MM:g} mm")
    return columns, rows, pixel_mm


def _add_polarimetry_options(sub: argparse.ArgumentParser) -> None:
    """Add the options for the metal reference, the incidence angle and the sub-bands."""
    sub.add_argument(
        "--reference",
        type=Path,
        metavar="SCAN",
        help="scan of a metal plate as reference (default: metal in the scene)",
    )
    sub.add_argument(
        "--incidence",
        type=_parse_incidence,
        default="one",
        metavar="one|pixel|DEG",
        help="incidence angle: one for the image (default), or each pixel's own; degrees for given images",
    )
    sub.add_argument(
        "--bands", type=count, default=1, metavar="K", help="also image K sub-bands, to fit layers (default: none)"
    )


def _add_calibrate(add: AddCommand) -> None:
    """Add `polysight calibrate` and its actions."""
    sub = add(
        "calibrate",
        "calibrate.direct_path",
        "calibrate the rig from recorded scans; each action writes one dated file",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    # One of these is required, and each replaces the function given above.
    actions = sub.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_direct_path(actions)
    sub = add_action(
        actions,
        "hpf",
        "calibrate.hpf",
        "fit the receivers' high-pass filters to scans of one scene at several start frequencies",
        "polysight calibrate hpf scans/if-200 scans/if-500 scans/if-900 scans/if-1500",
    )
    sub.add_argument("scans", type=Path, nargs="+", metavar="SCAN", help="scans with different start_offset_hz")
    _add_outputs(sub)
    sub = add_action(
        actions,
        "metal",
        "calibrate.metal",
        "measure the gains of both channels at every pixel from a scan of a metal plate",
        "polysight calibrate metal scans/metal-plate",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan of a plate that covers the plane")
    sub.add_argument(
        "--bands",
        type=count,
        default=1,
        metavar="K",
        help="keep K sub-bands for `polysight process --bands K` (default: none)",
    )
    _add_outputs(sub)
    sub = add_action(
        actions,
        "sphere",
        "surface.sphere",
        "measure the gains of both channels over the direction with a scan of a metal sphere, for `polysight surface`",
        "polysight calibrate sphere scans/sphere --radius 125",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan of a metal sphere of 100 to 150 mm")
    sub.add_argument(
        "--radius", dest="radius_mm", type=_radius, required=True, metavar="MM", help="radius of the sphere"
    )
    _add_outputs(sub)
    sub = add_action(
        actions,
        "start-frequency",
        "calibrate.start_frequency",
        "find the start frequency that puts each direct path in the middle of the band",
        "polysight calibrate start-frequency scans/first-light",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="any scan")
    _add_outputs(sub)


def _add_direct_path(actions: argparse._SubParsersAction[CommandParser]) -> None:
    """Add `polysight calibrate direct-path`."""
    sub = add_action(
        actions,
        "direct-path",
        "calibrate.direct_path",
        "fit the places of receivers and object plane to a scan of points at known places",
        "polysight calibrate direct-path scans/points --target points.toml",
    )
    sub.add_argument("scan", type=Path, metavar="SCAN", help="scan of the target")
    sub.add_argument(
        "--target", type=Path, required=True, metavar="FILE", help="3 points or more: [[points]] position_mm = [x, y]"
    )
    sub.add_argument(
        "--prior",
        dest="prior_mm",
        type=_millimetres,
        default=5.0,
        metavar="MM",
        help="standard deviation of the places measured by hand (default: 5 mm)",
    )
    _add_outputs(sub, "; direct-path: refine its places instead of the scan's")


def _add_outputs(sub: argparse.ArgumentParser, more: str = "") -> None:
    """Add the options of all actions of `calibrate`; `more` continues the help of `--config`."""
    sub.add_argument(
        "--out", type=Path, default=Path("calibration"), metavar="DIR", help="folder (default: calibration)"
    )
    sub.add_argument("--config", type=Path, metavar="RIG", help=f"rig file of published recordings{more}")
    add_json_option(sub)


def _add_leakage(add: AddCommand) -> None:
    """Add `polysight leakage` and its options."""
    sub = add(
        "leakage",
        "calibrate.leakage",
        "measure the cross-polar leakage of both receivers, as lines for the rig file",
        "polysight leakage scans/plate --strips 0=scans/vertical --strips 90=scans/horizontal",
    )
    sub.add_argument("plate", type=Path, metavar="PLATE", help="scan of a whole metal plate over the plane")
    sub.add_argument(
        "--strips",
        type=_parse_strips,
        action="append",
        required=True,
        metavar="DEG=SCAN",
        help="scan of thin metal strips in its place, turned by DEG from the vertical towards +x; give two, best 0 and"
        " 90 (with one, both receivers are assumed to have the same leakage)",
    )
    sub.add_argument("--config", type=Path, metavar="FILE", help="rig file of published data")
    add_json_option(sub)


def _parse_strips(text: str) -> tuple[float, Path]:
    """Parse DEGREES=SCAN, the orientation of metal strips and their scan."""
    degrees, _, folder = text.partition("=")
    try:
        angle = float(degrees)
    except ValueError:
        angle = float("nan")
    if not -180 <= angle <= 180 or not folder:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form DEGREES=SCAN, e.g. 90=scans/horizontal")
    return angle, Path(folder)
