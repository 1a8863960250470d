"""A folder of products: made beside the earlier one, whose place it takes only when it is whole.

Whatever ends the program at any time, the folder holds the earlier products or the new ones, never a part of either.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from polysight.host.materials import PATCHES
from polysight.host.products.files import (
    FINISHED,
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    SCAN,
    SavedProducts,
    write_atomically,
)
from polysight.host.products.label_files import LABELS_PICTURE, kept_files
from polysight.host.store import sync_folder
from polysight.shared.errors import ConfigError, DataError, DeviceError

PRODUCTS = (IMAGE, SCAN, QUALITY, MATERIALS, PATCHES, LABELS, LABELS_PICTURE, "report.html", "figures")
RAW_DROPPED = "raw_dropped"
"""Key of quality.json: whose raw rows were dropped, because these products are kept of them."""
_HERE = -100  # AT_FDCWD of renameat2(2)
_EXCHANGE = 2


def check_products_folder(out: Path, scan_id: str) -> None:
    """Refuse a folder that products of a scan must not replace, before anything is processed.

    Raises
    ------
    ConfigError
        when it is a file, holds anything but products, or holds all that is left of another scan.
    """
    try:
        _check_writable(out.resolve().parent)
        strangers = sorted(p.name for p in out.iterdir() if not (_is_ours(p.name) or p.name.startswith(".")))
    except FileNotFoundError:
        return
    except OSError as e:
        raise _no_folder(out, e) from None
    if strangers:
        raise ConfigError(
            f"{out} is not empty: it holds {strangers[0]}",
            "products go into a folder of their own",
            "give another --out",
        )
    place = out.resolve()
    if Path.cwd().is_relative_to(place) or place.is_mount():
        what = "a mount point" if place.is_mount() else "the folder you are in"
        raise ConfigError(
            f"{out} is {what}", "products replace their folder as a whole", "give a folder inside it as --out"
        )
    dropped = _raw_dropped(out)
    if dropped and dropped.get("scan_id") != scan_id:
        raise ConfigError(
            f"{out} holds all that is left of scan {dropped.get('scan_id')}",
            f"its raw rows were dropped on {str(dropped.get('dropped_utc'))[:10]}, so nothing could make it again",
            "give another --out",
        )


@contextmanager
def making_products(out: Path, scan_id: str) -> Iterator[Path]:
    """A new folder to write products into, which takes the place of `out` when the block ends without an error.

    Ended otherwise, `out` is as it was. Hidden files in it that are not ours are kept, and boxes that a person drew
    for this scan.

    Raises
    ------
    ConfigError
        as :func:`check_products_folder`; when the folder cannot be made, or another program writes products there.
    DeviceError
        when the new folder cannot take its place; it is left then, and named.
    """
    place = out.resolve()  # of a link, what it points to
    new, old = place.with_name(f".{place.name}.new"), place.with_name(f".{place.name}.old")
    if old.exists() and not place.exists():
        old.rename(place)  # a program was killed between the two steps of a file system that needs two
    shutil.rmtree(old, ignore_errors=True)  # or just after them
    check_products_folder(out, scan_id)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        lock = _begin(new)
    except BlockingIOError:
        raise ConfigError(
            f"{out}: another program is writing products there", "it was started twice", "give another --out, or wait"
        ) from None
    except OSError as e:
        raise _no_folder(out, e) from None
    keep = False
    try:
        yield new
        for name, content in kept_files(place, scan_id).items():
            write_atomically(new / name, content)
        try:
            _take_place(new, place, old)
        except OSError as e:
            keep = True
            raise DeviceError(
                f"{out}: cannot be replaced: {e.strerror}",
                "it is a mount point, or you may not write beside it",
                f"the new products are in {new}: copy them before the next run; then give another --out",
            ) from None
    finally:
        os.close(lock)
        if not keep:
            shutil.rmtree(new, ignore_errors=True)


def _no_folder(out: Path, e: OSError) -> ConfigError:
    return ConfigError(
        f"{out}: no folder for products: {e.strerror}",
        "a file is in the way, or you may not write there",
        "give another --out",
    )


def _check_writable(folder: Path) -> None:
    """Raise PermissionError or NotADirectoryError where no folder can be made in `folder`, which may be to be made."""
    there = next(p for p in (folder, *folder.parents) if p.exists())
    if not there.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(there))
    if not os.access(there, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(there))


def _begin(new: Path) -> int:
    """The folder, empty and locked; what a killed program left in it is removed. Returns the lock's file descriptor."""
    new.mkdir(exist_ok=True)
    lock = os.open(new, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)  # what a link leads to is not ours
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.samestat(os.fstat(lock), new.stat()):
            raise BlockingIOError(errno.EAGAIN, "it has just taken its place")
        for entry in new.iterdir():
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
    except BaseException:
        os.close(lock)
        raise
    return lock


def _take_place(new: Path, place: Path, old: Path) -> None:
    """Swap the two; afterwards what was at `place` is at `new`, without what is not ours."""
    sync_folder(new)
    if not place.exists():
        new.rename(place)
        sync_folder(place.parent)
        return
    if not _exchange(new, place):
        place.rename(old)
        new.rename(place)
        old.rename(new)
    sync_folder(place.parent)
    for entry in new.iterdir():
        if not _is_ours(entry.name) and not entry.name.endswith(".part"):
            entry.rename(place / entry.name)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two folders in one step (Linux, renameat2). False where the system or the file system cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    if renameat2(_HERE, os.fsencode(a), _HERE, os.fsencode(b), _EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(b))


def _is_ours(name: str) -> bool:
    return name in PRODUCTS or name == FINISHED


def _raw_dropped(out: Path) -> dict[str, Any]:
    try:
        dropped = SavedProducts(out).quality.get(RAW_DROPPED)
    except DataError:  # a damaged file says nothing
        return {}
    return dropped if isinstance(dropped, dict) else {}
