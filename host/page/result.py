"""The verdict of a scan's products, looked up again when they change."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from polysight.host.products import MATERIALS, QUALITY, find_products
from polysight.host.verdict import Verdict
from polysight.shared.errors import PolysightError


class ResultTail:
    """Follows the products of one scan folder; nothing in it is written.

    Parameters
    ----------
    folder
        The scan folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: tuple[tuple[int, int], ...] | None = None
        self._verdict: Verdict | None = None

    def look(self) -> Verdict | None:
        """The verdict, or None: not processed yet, by an earlier release, or the products cannot be read."""
        found = find_products(self._folder, QUALITY)
        seen = () if found is None else tuple(_state(found.folder / name) for name in (MATERIALS, QUALITY))
        if seen != self._seen:
            self._seen, self._verdict = seen, None
            with suppress(PolysightError):  # they are being replaced, or damaged: `polysight materials` says how
                self._verdict = None if found is None else found.verdict
        return self._verdict


def _state(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_size
