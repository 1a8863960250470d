"""Commands on what was found already: `polysight materials` and `polysight report`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polysight.host.products.files import MATERIALS, find_products, read_products

REPORT = "report.html"


def materials(data: Sequence[Path], as_json: bool) -> int:
    """What the patches of processed scans were named, and their permittivity; returns the exit status.

    Raises
    ------
    DataError
        when a folder holds no materials.
    """
    scans = [read_products(folder, MATERIALS) for folder in data]
    if as_json:
        sys.stdout.write(json.dumps([{"products": str(s.folder), **s.materials} for s in scans], indent=1) + "\n")
        return 0
    for scan in scans:
        kind = "simulated " if scan.simulated else ""
        sys.stdout.write(f"{scan.folder}: {kind}scan {scan.scan_id}\n" + "".join(map(_line, scan.segments)))
    return 0


def _line(row: dict[str, Any]) -> str:
    name = row["name"] or "not named"
    sure = f"{100 * row['confidence']:.0f} %" if row.get("confidence") is not None else ""
    e = row.get("permittivity")
    told = ("metal-like" if row.get("metal_like") else "-") if e is None else f"{e['real']:6.2f} - j{-e['imag']:5.2f}"
    if e is not None and e.get("real_std") is not None:
        told += f"  +- {e['real_std']:.2f}"
    return f"{row['label']:>3}  {name:24s} {sure:>5s}  {told}\n"


def report(folder: Path) -> int:
    """Say where the report of a scan is, and make it from the raw rows where it is not there; the exit status.

    Raises
    ------
    PolysightError
        as processing the scan does.
    """
    found = find_products(folder, REPORT)
    if found is None:
        from polysight.host.offline import process
        from polysight.host.process.request import Options

        return process(folder, folder / "products", None, Options())
    sys.stdout.write(f"report:   {found.folder / REPORT}\n")
    return 0
