"""`polysight drop-raw`: give the space of raw rows back once they are processed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from host.confirm import typed
from host.report import read_image
from host.store.raw import Digests, drop, droppable
from host.store.scanfolder import ScanFolder
from shared.errors import ConfigError, DataError

WORD = "drop"


def drop_raw(folder: Path, products: Path | None, yes: bool) -> int:
    """Remove every raw row that saved products were made from, once confirmed; returns the exit status.

    Raises
    ------
    DataError
        when there are no products, or they were made from nothing of this scan.
    ConfigError
        when it is not confirmed; nothing was removed.
    """
    scan = ScanFolder.load(folder)
    products = products or folder / "products"
    processed = processed_digests(products)
    what = droppable(scan, processed)
    for line in what.kept:
        sys.stdout.write(f"kept: {line}\n")
    if not what.files:
        if what.kept:
            raise DataError(
                f"{folder}: nothing can be dropped",
                f"{products} is made from none of its rows",
                f"`polysight process {folder} --out DIR`, then --products DIR",
            )
        sys.stdout.write(f"{folder}: every processed row is dropped already\n")
        return 0
    text = (
        f"{folder}: the raw data of {len(what.files)} rows, {what.bytes / 1e6:.1f} MB, is removed. {products} stays;"
        " it cannot be processed again."
    )
    said = typed(text, WORD, yes)
    if said != WORD:
        raise ConfigError(f"nothing dropped: answered {said!r}", f"{WORD!r} was asked for", f"type {WORD}, or --yes")
    drop(scan, processed, products)
    sys.stdout.write(f"{folder}: dropped; its digests stay in the manifest\n")
    return 0


def processed_digests(products: Path) -> Digests:
    """What saved products were made from, as quality.json beside a readable image.npz says. Raises DataError."""
    read_image(products / "image.npz")
    path = products / "quality.json"
    try:
        boards: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["boards"]
        return {name: {int(r): str(crc) for r, crc in b["raw_crc32"].items()} for name, b in boards.items()}
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as e:
        raise DataError(
            f"{path}: does not say what it was made from: {e}",
            "made by an earlier release, damaged, or from another program's recordings",
            "`polysight process SCAN --out DIR` makes it again",
        ) from None
