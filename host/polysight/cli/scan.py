"""The commands that make and keep a scan: scan, resume, validate, drop-raw."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.cli.options import Add, add_config_option, add_json_option, add_material_options, material_settings


def _scan(args: argparse.Namespace) -> int:
    from polysight.jobs.live_scan import scan

    settings = material_settings(args)
    return scan(args.config, args.out, settings, args.truth, args.keep_incomplete, not args.no_process)


def _resume(args: argparse.Namespace) -> int:
    from polysight.jobs.live_scan import resume

    return resume(args.folder, material_settings(args), args.keep_incomplete, not args.no_process, args.config)


def _validate(args: argparse.Namespace) -> int:
    from polysight.jobs.recordings import replace_folder, validate_folder

    if args.replace:
        return replace_folder(args.folder, args.json)
    return validate_folder(args.folder, args.json)


def _drop_raw(args: argparse.Namespace) -> int:
    from polysight.jobs.scans import drop_raw

    return drop_raw(args.folder, args.products, args.yes)


def _add_recording_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--keep-incomplete", action="store_true", help="after all retakes keep a row with gaps, masked, and continue"
    )
    sub.add_argument("--no-process", action="store_true", help="only record; `polysight process` can follow later")
    add_material_options(sub)


def add_commands(add: Add) -> None:
    """Register the commands."""
    sub = add(
        "scan",
        _scan,
        "scan with the rig and process meanwhile (Ctrl-C: stop after the row; twice: stop now)",
        "polysight scan --config instrument.toml --out scans/one",
    )
    add_config_option(sub)
    sub.add_argument("--out", type=Path, required=True, metavar="SCAN", help="new scan folder; never overwritten")
    _add_recording_options(sub)
    sub.add_argument("--truth", type=Path, metavar="FILE", help="truth.json of a simulated scene, for the report")

    sub = add("resume", _resume, "resume an interrupted scan at its first missing row", "polysight resume scans/one")
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder; the rig file is in it")
    _add_recording_options(sub)
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="take [pi], [limits] and the boards' addresses from this rig file from now on (default: the scan's)",
    )

    sub = add(
        "validate", _validate, "check every file of a scan folder and list all faults", "polysight validate scans/one"
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument(
        "--replace", action="store_true", help="place every row again from its packets, and commit what changes"
    )
    add_json_option(sub)

    sub = add(
        "drop-raw",
        _drop_raw,
        "delete the raw rows of a processed scan; its products and digests stay",
        "polysight drop-raw scans/one",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument("--products", type=Path, metavar="DIR", help="products made from it (default: SCAN/products)")
    sub.add_argument("--yes", action="store_true", help="do not ask for confirmation")
