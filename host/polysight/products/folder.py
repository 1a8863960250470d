"""Write a folder of products atomically, and find the label files of a scan.

New products are written into a folder next to the old one, and replace it when complete. If the program is killed at
any time, the folder holds either the old or the new products.

Boxes drawn by hand are kept in `labels.json` of the scan folder. A `labels.json` among products comes from the
classifier; but if it contains `by_hand`, its boxes were drawn by hand, and it is kept when products of the same scan
are replaced.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from polysight.materials import PATCHES_FILE, Labels, read_labels
from polysight.products.processed import (
    FINISHED,
    IMAGE,
    LABELS,
    MATERIALS,
    QUALITY,
    REPORT,
    SCAN,
    ProcessedScan,
    raw_dropped,
)
from polysight.store import is_source, lock_file
from polysight.surfaces import POINTS, SURFACE
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, quote
from polysight_shared.files import require_writable_folder, sync_folder, write_atomically

# Picture of the boxes, and the products of surfaces.
LABELS_PICTURE = "labels.png"
SURFACES = (SURFACE, POINTS, "surface.png")
# Files and folders that a folder of products may hold; anything else is not ours and is never replaced.
PRODUCTS = (IMAGE, SCAN, QUALITY, MATERIALS, PATCHES_FILE, LABELS, LABELS_PICTURE, REPORT, "figures", *SURFACES)
# Mark of a label file drawn by hand, which can be found in a damaged file, too.
_BY_HAND_MARK = b'"by_hand": true'
# AT_FDCWD and RENAME_EXCHANGE of renameat2(2): paths start at the current folder, and the two are swapped.
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
# Time between two attempts to lock a folder that another program has locked, seconds; chosen.
_TRY_AGAIN_S = 0.5


class FolderLock:
    """Lock of a folder until it is closed; the folder is created.

    POSIX systems lock the folder itself. Windows cannot open folders: there a file next to it is locked.

    Raises
    ------
    BlockingIOError
        if another program has locked it.
    OSError
        if it cannot be created or opened, or if it is a symbolic link.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self._lock_path: Path | None = None
        if hasattr(os, "O_DIRECTORY"):
            self._descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        else:
            self._lock_path = folder.with_name(f"{folder.name}.lock")
            self._descriptor = os.open(self._lock_path, os.O_RDWR | os.O_CREAT)
        try:
            lock_file(self._descriptor)
            # Between opening and locking, the program that held the lock may have renamed the folder that was opened
            # here, to replace other products with it. Then `folder` is the name of another folder now.
            if self._lock_path is None and not os.path.samestat(os.fstat(self._descriptor), folder.stat()):
                raise BlockingIOError("it has just replaced another folder")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Unlock."""
        os.close(self._descriptor)
        if self._lock_path is not None:
            # Windows does not delete a file that another program has opened since.
            with suppress(OSError):
                self._lock_path.unlink()


def check_products_folder(out: Path, scan_id: str) -> None:
    """Raise ConfigError if products must not or cannot replace this folder; call it before processing.

    That is the case for a file, a folder with other files, a mount point, the current folder, a folder that cannot be
    written, and for the only remaining products of another scan, whose raw data was deleted.
    """
    try:
        require_writable_folder(out.resolve().parent)
        foreign_files = sorted(p.name for p in out.iterdir() if not (_is_product(p.name) or p.name.startswith(".")))
    except FileNotFoundError:
        return
    except OSError as e:
        raise _no_folder_error(out, e) from None
    if foreign_files:
        raise ConfigError(
            f"{out} is not empty: it contains {foreign_files[0]}",
            "products need a folder of their own",
            "give another --out",
            code=ErrorCode.FILE_EXISTS,
        )
    target = out.resolve()
    if Path.cwd().is_relative_to(target) or target.is_mount():
        kind = "a mount point" if target.is_mount() else "the current folder"
        raise ConfigError(
            f"{out} is {kind}",
            "products replace their whole folder",
            "give a folder inside it as --out",
            code=ErrorCode.VALUE_INVALID,
        )
    dropped = raw_dropped(out)
    if dropped and dropped.scan_id != scan_id:
        raise ConfigError(
            f"{out} contains the only products of scan {dropped.scan_id}",
            f"its raw rows were dropped on {dropped.dropped_utc[:10]}, so they cannot be made again",
            "give another --out",
            code=ErrorCode.NAME_TAKEN,
        )


def check_results_folder(out: Path) -> None:
    """Raise ConfigError if results other than products must not be written into this folder; call it before the work.

    That is the case for the folder of recorded rows, and for one that cannot be written.
    """
    require_writable_folder(out.absolute())
    if is_source(out):
        raise ConfigError(
            f"{out} contains the recorded rows of a scan",
            "results are not written among them",
            f"give a folder of their own: --out {quote(out / 'results')}",
            code=ErrorCode.FILE_EXISTS,
        )


@contextmanager
def replace_products(out: Path, scan_id: str, wait: bool = False) -> Iterator[Path]:
    """Yield a new folder for products; it replaces `out` if the block ends without an error.

    After an error `out` is unchanged. Hidden files of other programs, and boxes drawn by hand for this scan, are kept.
    With `wait` it waits while another program writes products there, and says so on stderr, once a minute.

    Raises
    ------
    ConfigError
        as :func:`check_products_folder`; if the folder cannot be created, or another program writes products there
        and `wait` is false.
    DeviceError
        if the new folder cannot replace `out`; the error names the new folder, which is kept.
    """
    # If the folder is a link, its target is replaced.
    target = out.resolve()
    new = target.with_name(f".{target.name}.new")
    old = target.with_name(f".{target.name}.old")
    if old.exists() and not target.exists():
        # A program was killed between the first two renames of `_replace`.
        old.rename(target)
    # It may also have been killed after them.
    shutil.rmtree(old, ignore_errors=True)
    check_products_folder(out, scan_id)
    lock = _lock(out, new, wait)
    keep = False
    try:
        yield new
        for name, content in _read_hand_labels(target, scan_id).items():
            write_atomically(new / name, content)
        try:
            _replace(new, target, old)
        except OSError as e:
            keep = True
            raise DeviceError(
                f"{out}: cannot be replaced: {e.strerror}",
                "it is a mount point, or you have no permission to write into the folder that contains it",
                f"the new products are in {new}: copy them before the next run; then give another --out",
            ) from None
    finally:
        lock.close()
        if not keep:
            shutil.rmtree(new, ignore_errors=True)


@contextmanager
def lock_products(out: Path) -> Iterator[None]:
    """Keep other programs from replacing the products in `out`. Raises ConfigError as :func:`replace_products`."""
    target = out.resolve()
    new = target.with_name(f".{target.name}.new")
    lock = _lock(out, new)
    try:
        yield
    finally:
        lock.close()
        shutil.rmtree(new, ignore_errors=True)


def _lock(out: Path, new: Path, wait: bool = False) -> FolderLock:
    """Create and lock the new folder next to `out`, and empty it; `wait` for a program that has locked it.

    Raises ConfigError.
    """
    waited_s = 0.0
    while True:
        try:
            new.parent.mkdir(parents=True, exist_ok=True)
            return _create_locked(new)
        except BlockingIOError:
            if not wait:
                raise ConfigError(
                    f"{out}: another program is writing products there",
                    "another polysight command of this scan has not ended",
                    "wait until it has, or give another --out",
                    code=ErrorCode.BUSY,
                ) from None
        except OSError as e:
            raise _no_folder_error(out, e) from None
        if waited_s % 60 == 0:
            message = f"waiting: another program is writing products in {out}"
            if waited_s > 0:
                message = f"still {message} ({waited_s / 60:.0f} min); Ctrl-C ends the wait, no recorded row is lost"
            # If the terminal was closed, it still waits.
            with suppress(OSError):
                sys.stderr.write(f"{message}\n")
        time.sleep(_TRY_AGAIN_S)
        waited_s += _TRY_AGAIN_S


def _no_folder_error(out: Path, e: OSError) -> ConfigError:
    """Return the error for a folder of products that cannot be created or read."""
    return ConfigError(
        f"{out}: cannot create the folder for products: {e.strerror}",
        "a file has that name, or you have no permission to write there",
        "give another --out",
        code=ErrorCode.FILE_UNREADABLE,
    )


def _create_locked(new: Path) -> FolderLock:
    """Create and lock the folder, delete leftovers of a killed program."""
    lock = FolderLock(new)
    try:
        for entry in new.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
    except BaseException:
        lock.close()
        raise
    return lock


def _replace(new: Path, target: Path, old: Path) -> None:
    """Put the folder `new` in the place of `target`, then move files of other programs from the old folder to it.

    Where both cannot be swapped in one step, `old` is the name of the old folder for a moment. The old products end up
    in the folder `new`.
    """
    sync_folder(new)
    if not target.exists():
        new.rename(target)
        sync_folder(target.parent)
        return
    if not _exchange(new, target):
        target.rename(old)
        new.rename(target)
        old.rename(new)
    sync_folder(target.parent)
    for entry in new.iterdir():
        # `write_atomically` left files `.part` if it was killed.
        if not _is_product(entry.name) and not entry.name.endswith(".part"):
            entry.rename(target / entry.name)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two folders atomically (Linux, renameat2). False if system or file system do not support it.

    Raises OSError for any other failure.
    """
    if sys.platform != "linux":
        return False
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    if renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(b))


def _is_product(name: str) -> bool:
    """Return true for the name of a product, or of the file with the settings of the products."""
    return name in PRODUCTS or name == FINISHED


def find_scan_folder(folder: Path) -> Path | None:
    """Return the scan folder of a scan or of its products; None for products outside a scan folder."""
    if is_source(folder):
        return folder
    parent = folder.resolve().parent
    if not is_source(parent):
        return None
    # Return the path as the user wrote it, if it names the parent: `Path(".").parent` is the folder itself.
    if folder.parent.resolve() == parent:
        return folder.parent
    return parent


def label_folder(folder: Path) -> Path:
    """Return the folder for `labels.json` of a scan or of products."""
    return find_scan_folder(folder) or folder


def find_labels(folder: Path) -> tuple[Path, Labels] | None:
    """Find boxes drawn by hand for a scan or its products; return their file and content, or None.

    Raises
    ------
    DataError
        if the file cannot be read.
    """
    scan = find_scan_folder(folder)
    if scan is not None and (path := scan / LABELS).exists():
        return path, read_labels(path)
    for path in (folder / LABELS, folder / "products" / LABELS):
        if path.exists() and (labels := read_labels(path)).by_hand:
            return path, labels
    return None


def _read_hand_labels(products: Path, scan_id: str) -> dict[str, bytes]:
    """Return the label file drawn by hand and its picture from products of this scan: file name to content.

    The result is empty if the products are of another scan or have no such file.
    """
    path = products / LABELS
    try:
        if not path.exists() or ProcessedScan(products).scan_id != scan_id or not _is_by_hand(path):
            return {}
        files = (path, products / LABELS_PICTURE)
        return {f.name: f.read_bytes() for f in files if f.exists()}
    except (OSError, DataError):
        # Damaged files cannot be shown to belong to this scan.
        return {}


def _is_by_hand(path: Path) -> bool:
    """True for a label file drawn by hand, even if it is damaged."""
    try:
        return read_labels(path).by_hand
    except DataError:
        return _BY_HAND_MARK in path.read_bytes()
