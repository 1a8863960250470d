"""`polysight reproduce`: make the items, write the files as they come, then the page."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from polysight.host.reproduce.catalogue import MAKERS, TITLES
from polysight.host.reproduce.item import Item, Run
from polysight.host.reproduce.report import write_item, write_page
from polysight.shared.errors import ConfigError, PolysightError


def reproduce(out: Path, keys: Sequence[str] = (), run: Run | None = None) -> int:
    """Make items (default: all) into a folder.

    An item that fails is named on the page and on stderr, and the others are made all the same.

    Returns
    -------
    int
        Exit status, 0 only when every item was made.

    Raises
    ------
    ConfigError
        when an item's name is not known, or nothing makes it yet.
    """
    run = run or Run()
    for key in keys:
        if key not in MAKERS:
            why = f"{TITLES[key]}: not reproduced yet" if key in TITLES else "the paper has no such item"
            raise ConfigError(f"item {key!r} cannot be made", why, f"give some of: {' '.join(MAKERS)}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(f"{out} is a file", "the results need a folder", "give another --out") from None
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    failed: dict[str, str] = {}
    for key in dict.fromkeys(keys) or MAKERS:
        began = time.monotonic()
        try:
            item = MAKERS[key](run)
            pictures |= write_item(out, item)
        except PolysightError as e:
            failed[key] = str(e)
            sys.stderr.write(f"{key}: {e}\n")
            continue
        items.append(item)
        sys.stderr.write(f"simulated {item.title}: {time.monotonic() - began:.0f} s\n")
    page = write_page(out, items, pictures, failed, run.quick)
    sys.stdout.write(f"{page}: {len(items)} simulated items beside the published values\n")
    return 1 if failed else 0
