"""Folders and files from elsewhere: no path leads out of a scan, and no small archive takes much memory."""

from __future__ import annotations

import errno
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.capture import kind_of
from polysight.shared.errors import DataError
from polysight.shared.files import open_regular

_MAY_BE_LINK = "products"
MOST_BYTES = 2 << 30
"""Of arrays in one archive: a hundred times the images of the published scan."""


def inside(folder: Path, name: str, within: str = "") -> Path:
    """The path of a file that a scan's manifest names, relative to the scan folder.

    Parameters
    ----------
    folder
        The scan folder.
    name
        What the manifest says.
    within
        Folder in the scan in which it has to lie; "" for anywhere.

    Raises
    ------
    DataError
        if it lies elsewhere, links followed.
    """
    path, root = folder / name, (folder / within).resolve()
    try:
        there = ".." not in path.parts and path.resolve().is_relative_to(folder.resolve() / within)
        there = there and path.resolve() != root and root.is_relative_to(folder.resolve())
    except (OSError, ValueError):  # a name that no file can have
        there = False
    if not there:
        raise DataError(
            f"{folder}: its manifest names {name!r}, which lies outside {folder / within}",
            "the manifest was made by another program or changed, or a link leads out of the scan",
            "nothing there is read, written or removed; `polysight validate` a copy of the scan as it was recorded",
        )
    return path


def check_links(folder: Path) -> None:
    """Refuse a scan folder in which a link leads out of it, or in which there is a pipe or a device.

    Only `products` may be a link: they are replaced as a whole, and only where products are.

    Raises
    ------
    DataError
        naming it.
    """
    root, left = folder.resolve(), [folder]
    while left:
        try:
            with os.scandir(left.pop()) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    if entry.is_symlink():
                        if path != folder / _MAY_BE_LINK and not _leads_into(path, root):
                            raise _strange(folder, path, "is a link that leads out of it")
                    elif entry.is_dir(follow_symlinks=False):
                        left.append(path)
                    elif not entry.is_file(follow_symlinks=False):
                        raise _strange(folder, path, "is neither a file nor a folder")
        except OSError:  # gone meanwhile, or not to be listed: whoever wants a file there says so
            continue


def _leads_into(link: Path, root: Path) -> bool:
    try:
        return link.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # links in a circle
        return False


def _strange(folder: Path, path: Path, what: str) -> DataError:
    return DataError(
        f"{folder}: {path.relative_to(folder)} {what}",
        "the folder was made by another program or changed: what is done with the scan would be done there",
        f"nothing was read or written; remove it (rm '{path}'), or put what it leads to in its place",
    )


@contextmanager
def open_npz(path: Path) -> Iterator[Any]:
    """Open an archive of arrays, without pickled objects, once what it says of its size is believable.

    Raises
    ------
    DataError
        if it is no regular file, or its arrays would take more than :data:`MOST_BYTES`.
    OSError, ValueError, KeyError, EOFError
        if it is no such archive, as numpy does.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    with open_regular(path) as f:
        try:
            with zipfile.ZipFile(f) as archive:
                size = sum(member.file_size for member in archive.infolist())
        except zipfile.BadZipFile as e:
            f.seek(0)
            raise ValueError(f"it is {kind_of(f.read(512))}, not an archive of arrays ({e})") from None
        if size > MOST_BYTES:
            raise DataError(
                f"{path}: its arrays take {size} bytes, more than the {MOST_BYTES} bytes that are read",
                "it was not made by this program, or is damaged",
                "process the scan again, or cut the image area ([image] of the rig file)",
            )
        f.seek(0)
        try:
            with np.load(f, allow_pickle=False) as arrays:
                yield arrays
        except MemoryError as e:
            raise ValueError(f"an array in it is larger than the file says: {e}") from None
