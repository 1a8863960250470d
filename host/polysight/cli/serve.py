"""The operator's page, and its functions as commands: serve, preview, scans, note, ask, probe, compare, check."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.cli.options import RIG_FILE, AddCommand, add_json_option, file_ending, readable_text
from polysight_shared.errors import ConfigError

if TYPE_CHECKING:
    from polysight.serve import ServerAddress

SCAN_COMMANDS = ("pause", "continue", "stop", "abort")


def add_commands(add: AddCommand) -> None:
    """Register the commands.

    The arguments of `add` are name, function (a text `module.function` names one that is loaded when it runs), help,
    example, and the options that the help shows first.
    """
    _add_serve(add)
    _add_lists(add)
    _add_results(add)


def _serve(args: argparse.Namespace) -> int:
    """Run `polysight serve`. Without `--config`, the rig file of the current folder is used, if there is one.

    Raises ConfigError if the rig file or a package is missing.
    """
    _check_extra()
    # This is printed before the modules of the server are loaded, which takes seconds.
    sys.stderr.write("polysight serve: starting\n")
    from polysight.serve import serve

    config = args.config
    if config is None and RIG_FILE.exists():
        config = RIG_FILE
    if config is not None and not config.is_file():
        raise ConfigError(
            f"{config}: no such file", "--config names a rig file", "correct the path, or leave --config out"
        )
    return serve(args.root, _make_place(args), config, not args.read_only)


def _run_preview(args: argparse.Namespace) -> int:
    """Run `polysight preview`. Raises ConfigError if the scan is a file, or a package is missing."""
    _check_extra()
    if args.folder.exists() and not args.folder.is_dir():
        raise ConfigError(
            f"{args.folder} is a file", "a scan is a folder, which may not exist yet", "give a scan folder"
        )
    sys.stderr.write("polysight preview: starting\n")
    from polysight.serve import preview

    return preview(args.folder, _make_place(args), args.control)


def _check_extra() -> None:
    """Raise ConfigError if the packages of the web server are not installed."""
    if any(importlib.util.find_spec(name) is None for name in ("starlette", "uvicorn")):
        raise ConfigError(
            "starlette and uvicorn are not installed",
            "the operator's page needs them; an installation without the page leaves them out",
            "pip install starlette uvicorn",
        )


def _make_place(args: argparse.Namespace) -> ServerAddress:
    """Return the address of the server from the options of `_add_place`."""
    from polysight.serve import ServerAddress

    return ServerAddress(
        host=args.host,
        port=args.port,
        hosts=tuple(args.allow_host),
        certificate=args.certificate,
        key=args.key,
    )


def _parse_port(text: str) -> int:
    """Parse a TCP port; 0 is any free port."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, 0..65535")
    return int(text)


def _add_serve(add: AddCommand) -> None:
    """Add `polysight serve` and `polysight preview`."""
    sub = add(
        "serve",
        _serve,
        "serve the operator's page: plan, start, watch, label and compare scans in a browser",
        "polysight serve scans --config instrument.toml        # then open the address that it prints",
        ("--config", "--port", "--host"),
    )
    _add_folder(sub)
    sub.add_argument("--config", type=Path, metavar="FILE", help="rig file of new scans (default: instrument.toml)")
    sub.add_argument("--read-only", action="store_true", help="show scans, but start and control nothing")
    _add_place(sub)
    sub = add(
        "preview",
        _run_preview,
        "serve the live view of one running or finished scan",
        "polysight preview scans/one                           # then open http://127.0.0.1:8080/\n"
        "  polysight preview scans/one --control --port 8081     # with buttons to pause and stop",
        ("--control", "--port", "--host"),
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder; it may not exist yet")
    sub.add_argument(
        "--control", action="store_true", help="let everyone who has the printed address pause and stop the scan"
    )
    _add_place(sub)


def _add_folder(sub: argparse.ArgumentParser) -> None:
    """Add the folder of scans."""
    text = "folder of scans (default: scans)"
    sub.add_argument("root", type=Path, nargs="?", default=Path("scans"), metavar="SCANS", help=text)


def _add_place(sub: argparse.ArgumentParser) -> None:
    """Add the options of the server's address."""
    sub.add_argument("--port", type=_parse_port, default=8080, help="TCP port (default: 8080; 0: any free one)")
    sub.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address (default: this machine; 0.0.0.0: the network)"
    )
    sub.add_argument(
        "--allow-host", action="append", default=[], metavar="NAME", help="accept requests to this host name too"
    )
    sub.add_argument("--certificate", type=Path, metavar="FILE", help="certificate of TLS (PEM), with --key")
    sub.add_argument("--key", type=Path, metavar="FILE", help="its private key (PEM)")


def _add_lists(add: AddCommand) -> None:
    """Add `polysight scans`, `note` and `ask`."""
    sub = add("scans", "scans.scans", "list the scans under a folder", "polysight scans scans")
    _add_folder(sub)
    sub.add_argument("--find", dest="text", default="", metavar="TEXT", help="search names, notes, tags and materials")
    sub.add_argument("--tag", dest="tags", action="append", default=[], metavar="TAG", help="only scans with this tag")
    add_json_option(sub)
    sub = add(
        "note",
        "scans.note",
        "show or change notes and tags of a scan",
        "polysight note scans/one --text 'second board' --tag oak",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument("--text", type=readable_text, metavar="TEXT", help="replace the notes")
    tags = {"type": readable_text, "action": "append", "default": [], "metavar": "TAG"}
    sub.add_argument("--tag", dest="add", help="add a tag", **tags)
    sub.add_argument("--untag", dest="remove", help="remove a tag", **tags)
    sub = add(
        "ask",
        "scans.ask_scan",
        "pause, continue, stop or abort a running scan",
        "polysight ask scans/one pause",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument(
        "request",
        choices=SCAN_COMMANDS,
        help="pause: before the next row; stop: after this row; abort: now, this row is lost; continue: after a pause",
    )


def _parse_point(text: str) -> tuple[float, float]:
    """Parse X,Y in millimetres."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form X,Y in mm, e.g. 45,0") from None
    return x, y


def _add_results(add: AddCommand) -> None:
    """Add `polysight probe`, `compare` and `check`."""
    sub = add(
        "probe",
        "scans.probe_scan",
        "print all results at one place of a processed scan",
        "polysight probe scans/one 45,0",
    )
    sub.add_argument("folder", type=Path, metavar="DATA", help="scan folder, or a folder of products")
    sub.add_argument("place_mm", type=_parse_point, metavar="X,Y", help="place, mm from the image's centre")
    sub.add_argument("--library", type=Path, metavar="FILE", help="reference library (default: the simulated one)")
    add_json_option(sub)
    sub = add(
        "compare",
        "scans.compare_scans",
        "compare two processed scans: differences of P and permittivity",
        "polysight compare scans/one scans/two --png difference.png",
    )
    for name in ("first", "second"):
        sub.add_argument(name, type=Path, metavar="DATA", help="scan folder, or a folder of products")
    sub.add_argument(
        "--png",
        dest="picture",
        type=file_ending(".png"),
        metavar="FILE.png",
        help="draw the difference of P in standard deviations",
    )
    add_json_option(sub)
    sub = add(
        "check",
        "scans.check",
        "compare the check plate of scans with its known permittivity",
        "polysight check scans/today\n  polysight check scans --chart check.png",
    )
    sub.add_argument("folders", type=Path, nargs="+", metavar="DATA", help="processed scan, or a folder of scans")
    sub.add_argument("--chart", type=file_ending(".png"), metavar="FILE.png", help="draw the control chart")
    add_json_option(sub)
