"""The options of `polysight preview`."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

from polysight.host.cli_materials import Add
from polysight.shared.errors import ConfigError


def _preview(args: argparse.Namespace) -> int:
    if any(importlib.util.find_spec(name) is None for name in ("starlette", "uvicorn")):
        raise ConfigError(
            "starlette and uvicorn are not installed",
            "the live view is an extra of the host half",
            "pip install '.[preview]', from the repository",
        )
    if args.folder.exists() and not args.folder.is_dir():
        raise ConfigError(f"{args.folder} is a file", "a scan is a folder, there or not yet", "give a scan folder")
    from polysight.host.page.server import preview

    return preview(args.folder, args.host, args.port, args.control)


def _port(text: str) -> int:
    """A TCP port, 0 for any that is free."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, 0..65535")
    return int(text)


def add_preview_command(add: Add) -> None:
    """`polysight preview`."""
    sub = add(
        "preview",
        _preview,
        "show a running or finished scan in a browser: time left, images row by row, faults in words",
        "polysight preview scans/one                           # then open http://127.0.0.1:8080/\n"
        "  polysight preview scans/one --control --port 8081     # with buttons to pause and stop",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder; it may not be there yet")
    sub.add_argument("--port", type=_port, default=8080, help="TCP port (default: 8080; 0: any that is free)")
    sub.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS",
        help="address to serve at (default: 127.0.0.1, this machine only; 0.0.0.0: the whole network can look on)",
    )  # fmt: skip
    sub.add_argument(
        "--control", action="store_true", help="buttons to pause, stop and abort, for who has the printed address"
    )
