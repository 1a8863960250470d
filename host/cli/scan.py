"""The commands that make and keep a scan: scan, resume, validate, drop-raw."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.host.cli.options import Add, add_config_option, add_material_options, material_request

if TYPE_CHECKING:
    from polysight.host.process import ProcessRequest


def _request(args: argparse.Namespace, folder: Path) -> ProcessRequest:
    """How the scan is processed: its products go into its own folder."""
    from polysight.host.process import ProcessRequest

    return ProcessRequest(data=str(folder), out=str(folder / "products"), **material_request(args))


def _scan(args: argparse.Namespace) -> int:
    from polysight.host.jobs.live_scan import scan

    return scan(args.config, _request(args, args.out), args.truth, args.keep_incomplete, not args.no_process)


def _resume(args: argparse.Namespace) -> int:
    from polysight.host.jobs.live_scan import resume

    return resume(_request(args, args.folder), args.keep_incomplete, not args.no_process, args.config)


def _validate(args: argparse.Namespace) -> int:
    from polysight.host.jobs.look import validate_folder

    if args.replace:
        from polysight.host.jobs.placement import replace_folder

        return replace_folder(args.folder, args.json)
    return validate_folder(args.folder, args.json)


def _drop_raw(args: argparse.Namespace) -> int:
    from polysight.host.jobs.drop_raw import drop_raw

    return drop_raw(args.folder, args.products, args.yes)


def _add_recording_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--keep-incomplete",
        action="store_true",
        help="after all retakes keep a row with gaps, masked, instead of ending the scan",
    )
    sub.add_argument("--no-process", action="store_true", help="only record; `polysight process` can follow later")


def add_commands(add: Add) -> None:
    """Register the commands."""
    _add_recording_commands(add)
    _add_file_commands(add)


def _add_recording_commands(add: Add) -> None:
    sub = add(
        "scan",
        _scan,
        "scan with the rig, and process while it scans; Ctrl-C ends it after the row, twice at once",
        "polysight scan --config instrument.toml --out scans/one",
    )
    add_config_option(sub)
    add_material_options(sub)
    sub.add_argument("--out", type=Path, required=True, metavar="SCAN", help="scan folder to make; never overwritten")
    sub.add_argument(
        "--truth", type=Path, default=None, metavar="FILE", help="truth.json of a simulated scene, for the report"
    )
    _add_recording_options(sub)

    sub = add(
        "resume",
        _resume,
        "go on with a scan that was stopped or killed, at its first missing row",
        "polysight resume scans/one",
    )
    add_material_options(sub)
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder; the rig file is in it")
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="take [pi], [limits] and the boards' addresses from this rig file from now on; all else must be the scan's"
        " (default: as before)",
    )
    _add_recording_options(sub)


def _add_file_commands(add: Add) -> None:
    sub = add(
        "validate", _validate, "check every file of a scan folder, and name every fault", "polysight validate scans/one"
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument(
        "--replace", action="store_true", help="place every row again from its packets, and commit what changes"
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")

    sub = add(
        "drop-raw",
        _drop_raw,
        "remove the raw rows of a finished scan that saved products were made from; their digests stay",
        "polysight drop-raw scans/one",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument("--products", type=Path, metavar="DIR", help="products made from it (default: SCAN/products)")
    sub.add_argument("--yes", action="store_true", help="do not ask; the default is to have the word drop typed")
