"""Checks for untrusted scan folders and archives: paths that leave the folder, links, and oversized arrays."""

from __future__ import annotations

import errno
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from polysight.capture import kind_of
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import open_regular

_MAY_BE_LINK = "products"
MAX_BYTES = 2 << 30
"""Largest size of the arrays in one archive: a hundred times the images of the published scan."""


def inside(folder: Path, name: str, within: str = "") -> Path:
    """Return the path of a file that a manifest names, relative to the scan folder and inside its folder `within`.

    Only the name is foreign: `folder` is the user's own path, in whatever form.

    Raises
    ------
    DataError
        if the path, with links followed, is elsewhere.
    """
    path = folder / name
    home = folder.resolve()
    root = (folder / within).resolve() if within else home
    try:
        target = path.resolve()
        is_inside = ".." not in Path(name).parts and target.is_relative_to(home / within)
        is_inside = is_inside and target != root and root.is_relative_to(home)
    except (OSError, ValueError):  # a name that no file can have
        is_inside = False
    if not is_inside:
        raise DataError(
            f"{folder}: its manifest names {name!r}, which lies outside {folder / within}",
            "the manifest was made by another program or changed, or a link leads out of the scan",
            "nothing there is read, written or removed; `polysight validate` a copy of the scan as it was recorded",
            code=ErrorCode.PATH_OUTSIDE,
        )
    return path


def check_links(folder: Path) -> None:
    """Check that a scan folder contains no link that leads out of it, no pipe and no device.

    Only `products` may be such a link, because products are only replaced as a whole. Raises DataError.
    """
    root, left = folder.resolve(), [folder]
    while left:
        try:
            with os.scandir(left.pop()) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    if entry.is_symlink():
                        if path != folder / _MAY_BE_LINK and not _leads_into(path, root):
                            raise _refused(folder, path, "is a link that leads out of it", ErrorCode.PATH_OUTSIDE)
                    elif entry.is_dir(follow_symlinks=False):
                        left.append(path)
                    elif not entry.is_file(follow_symlinks=False):
                        raise _refused(folder, path, "is neither a file nor a folder", ErrorCode.FILE_FOREIGN)
        except OSError:  # deleted in the meantime, or not readable: reported when a file is read
            continue


def _leads_into(link: Path, root: Path) -> bool:
    try:
        return link.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # links in a circle
        return False


def _refused(folder: Path, path: Path, what: str, code: ErrorCode) -> DataError:
    return DataError(
        f"{folder}: {path.relative_to(folder)} {what}",
        "the folder was made by another program or changed; reading or writing the scan would affect other files",
        f"nothing was read or written; remove it (rm '{path}'), or replace it by a copy of its target",
        code=code,
    )


@contextmanager
def open_npz(path: Path) -> Iterator[Any]:
    """Open an archive of arrays, without pickled objects, after a check of its uncompressed size.

    Raises
    ------
    DataError
        if it is no regular file, or its arrays exceed :data:`MAX_BYTES`.
    OSError, ValueError, KeyError, EOFError
        if it is not an archive of arrays, as numpy does.
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
        if size > MAX_BYTES:
            raise DataError(
                f"{path}: its arrays take {size} bytes, the limit is {MAX_BYTES} bytes",
                "it was not made by this program, or is damaged",
                "process the scan again, or cut the image area ([image] of the rig file)",
                code=ErrorCode.FILE_TOO_LARGE,
            )
        f.seek(0)
        try:
            with np.load(f, allow_pickle=False) as arrays:
                yield arrays
        except MemoryError as e:
            raise ValueError(f"an array in it is larger than the file says: {e}") from None
