"""The scans under a folder: a list, and the folder of a scan by its name.

Nothing is read again that has not changed, so that hundreds of scans are listed at once.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath

from polysight.catalogue.summary import PROGRAM, Stamp, Summary, as_of_now, stamp_of, summary_of
from polysight.products import IMAGE
from polysight.store import MANIFEST
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, no_such

READ_S = 3.0
"""Time limit for reading one folder of the list; it is then listed as `silent` until the read returns."""
_DEEP, _MOST = 4, 5000  # folders below the first, and scans, that are looked at


class Scans:
    """The scans in a folder, or a single one.

    Parameters
    ----------
    root
        Folder to look under.
    only
        Name of the one scan in it that is shown; it need not be there yet. None: all.
    """

    def __init__(self, root: Path, only: str | None = None) -> None:
        self.root, self.only = root, only
        self._kept: dict[str, tuple[Stamp, Summary]] = {}
        self._found: dict[str, list[Summary]] = {}  # by entry of the root
        self._reading: set[str] = set()  # entries of the root
        self._lock = threading.Lock()

    def list(self) -> list[Summary]:
        """Every scan, the newest first; what has changed since the last call is read again.

        A folder that takes longer than `READ_S` is listed as `silent`. Its thread cannot be ended: the folder is read
        again when that has returned.
        """
        with self._lock:
            entries = [self.only] if self.only is not None else [name for name, _ in _folders(self.root)]
            self._read_all(deque(entry for entry in entries if entry not in self._reading))
            found: list[Summary] = []
            for entry in entries:
                known = self._found.get(entry, [])
                if entry in self._reading:
                    known = [replace(s, state="silent") for s in known] or [Summary(entry, "silent")]
                found += known
            names = {s.name for s in found}
            self._kept = {name: kept for name, kept in list(self._kept.items()) if name in names}
        return sorted(found, key=lambda s: (-s.seconds, s.name))

    def _read_all(self, todo: deque[str]) -> None:
        """Read entries of the root in a thread; when it makes no progress for `READ_S`, another thread goes on."""
        while todo:
            worker = threading.Thread(target=self._read_entries, args=(todo,), name="list", daemon=True)
            worker.start()
            left = -1
            while worker.is_alive() and left != len(todo):
                left = len(todo)
                worker.join(READ_S)

    def _read_entries(self, todo: deque[str]) -> None:
        with suppress(IndexError):  # nothing is left
            while True:
                entry = todo.popleft()
                self._reading.add(entry)
                try:
                    self._found[entry] = self._summaries(entry)
                finally:
                    self._reading.discard(entry)

    def _summaries(self, entry: str) -> list[Summary]:
        """The scan that an entry of the root is, or those below it."""
        if self.only is not None or is_scan(self.root / entry):
            return [self._summary(entry)]
        return [self._summary(name) for name in _names(self.root / entry, f"{entry}/", 2)]

    def left_out(self) -> list[str]:
        """Names in the folder that hold a scan and are not listed: links, and names that cannot be shown; in ASCII."""
        if self.only is not None:
            return []
        with suppress(OSError), os.scandir(self.root) as entries:
            odd = [e for e in entries if not e.name.startswith(".") and (e.is_symlink() or not _is_name(e.name))]
            return sorted(ascii(e.name)[1:-1] for e in odd if is_scan(Path(e.path)))
        return []

    def summary(self, name: str) -> Summary:
        """One of them. Raises DataError as :meth:`folder`."""
        self.folder(name)
        return self._summary(name)

    def folder(self, name: str, new: bool = False) -> Path:
        """The folder of a scan.

        Parameters
        ----------
        name
            As the list has it.
        new
            A scan to be made: it need not be there.

        Raises
        ------
        DataError
            when the name leads out of the folder, also by a link, or there is no such scan.
        """
        parts = name.split("/")
        good = bool(name) and len(name) <= 1000 and len(parts) <= _DEEP and all(map(_is_name, parts))
        if self.only is not None:
            good = good and name == self.only
        path = self.root / PurePosixPath(name) if good else self.root
        try:
            good = good and path.resolve() == self.root.resolve() / name  # no link on the way
            inside = next((p for p in path.parents if self.root in p.parents and is_scan(p)), None)
            there = good and (new or name == self.only or is_scan(path))
        except (OSError, ValueError):
            there, inside = False, None
        if not good:
            raise DataError(
                f"no scan is called {name[:80]!r} here", "the name leads elsewhere, or is none", "see the list",
                code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip
        if inside is not None:
            raise DataError(
                f"{path}: no scan", f"it lies inside the scan {inside.name}", "give the scan's own name",
                code=ErrorCode.FILE_MISSING,
            )  # fmt: skip
        if not path.exists() and not there:
            raise no_such(path)
        if not there:
            raise DataError(
                f"{path}: no scan", "nothing was recorded there", "see the list", code=ErrorCode.FILE_MISSING
            )
        return path

    def _summary(self, name: str) -> Summary:
        folder = self.root / name
        stamp = stamp_of(folder)
        kept = self._kept.get(name)
        if kept is None or kept[0] != stamp:
            kept = self._kept[name] = (stamp, summary_of(folder, name))
        return as_of_now(folder, kept[1])


def folder_bytes(folder: Path) -> int:
    """Bytes of all files in a folder; links are not followed."""
    total = 0
    for where, _, files in os.walk(folder):
        for name in files:
            try:
                total += (Path(where) / name).lstat().st_size
            except OSError:
                continue  # it has just gone
    return total


def _names(root: Path, prefix: str = "", deep: int = 1) -> Iterator[str]:
    """Names of the scans below a folder. Links, hidden folders and the insides of scans are not looked at."""
    count = 0
    for entry, path in _folders(root):
        name = f"{prefix}{entry}"
        if is_scan(path):
            yield name
            count += 1
        elif deep < _DEEP:
            yield from _names(path, f"{name}/", deep + 1)
        if count >= _MOST:
            return


def _folders(root: Path) -> list[tuple[str, Path]]:
    """Names and paths of the folders in a folder, sorted; links and names that cannot be shown are left out."""
    with suppress(OSError), os.scandir(root) as entries:
        folders = [e for e in entries if _is_name(e.name) and e.is_dir(follow_symlinks=False)]
        return sorted((e.name, Path(e.path)) for e in folders)
    return []


def _is_name(part: str) -> bool:
    return bool(part) and not part.startswith(".") and part.isprintable() and "\\" not in part and len(part) <= 200


def is_scan(path: Path) -> bool:
    """True if a folder holds a scan, products, or programs that a page started."""
    return any((path / name).exists() for name in (MANIFEST, IMAGE, PROGRAM))
