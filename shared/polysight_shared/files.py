"""Read files with limits (no pipe blocks the program, no size fills its memory), and write them safely."""

from __future__ import annotations

import errno
import json
import os
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

from polysight_shared.errors import DataError, DeviceError, ErrorCode

try:
    import fcntl
except ImportError:
    # Windows.
    fcntl = None

# A hundred times the manifest of a scan of ten thousand rows.
MAX_JSON_BYTES = 256 << 20


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Does not block on a pipe without a writer.

    Raises
    ------
    DataError
        if it is a folder, a device or a pipe.
    OSError
        if it cannot be opened.
    """
    # Windows has no pipes in folders, and no flag for them.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise DataError(
                f"{path}: is not a regular file",
                "it is a folder, a device or a pipe",
                "give a file",
                code=ErrorCode.FILE_FOREIGN,
            )
        # The returned file has a duplicate, so that this descriptor can be closed here, also after an error.
        return os.fdopen(os.dup(descriptor), "rb")
    finally:
        os.close(descriptor)


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of at most `max_bytes` bytes.

    Raises
    ------
    DataError
        if it is larger, or not a regular file.
    OSError
        if it cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = b""
        if size <= max_bytes:
            data = file.read(max_bytes + 1)
    # The file may have grown meanwhile.
    size = max(size, len(data))
    if size > max_bytes:
        problem = f"{path}: {size} bytes, the limit is {max_bytes}"
        raise DataError(problem, "it is another kind of file", "check the path", code=ErrorCode.FILE_TOO_LARGE)
    return data


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file.

    Raises
    ------
    ValueError
        if it is not JSON in UTF-8, or nested too deeply.
    DataError, OSError
        as `read_bounded`.
    """
    try:
        # Editors of Windows write a mark of the byte order first.
        return json.loads(read_bounded(path, max_bytes).decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("nested too deeply") from None


@contextmanager
def name_in_errors(path: Path) -> Iterator[None]:
    """Add this path to an OSError of the block that has none, such as a full disk during a write."""
    try:
        yield
    except OSError as e:
        if e.filename is None:
            e.filename = str(path)
        raise


@contextmanager
def _name_in_os_errors(path: Path) -> Iterator[None]:
    """Let an OSError of the block name this path, instead of an internal file that the user does not know."""
    try:
        yield
    except OSError as e:
        e.filename = str(path)
        e.filename2 = None
        raise


def _require_file_or_nothing(path: Path) -> None:
    """Raise OSError if a folder, a device or a pipe has this path: a rename would fail, or remove it."""
    if path.is_dir():
        # Also ".", "/" and "..", which end in no name for a temporary file in the same folder.
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is a device or a pipe, not a file", str(path))


def require_writable(path: Path) -> None:
    """Raise OSError if no file can be written at this path; called before long work, so that it is not lost."""
    _require_file_or_nothing(path)
    require_writable_folder(path.absolute().parent)


def require_writable_folder(folder: Path) -> None:
    """Raise PermissionError or NotADirectoryError if nothing can be made in a folder, which need not exist."""
    parent = next(candidate for candidate in (folder, *folder.parents) if candidate.exists())
    if not parent.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(parent))
    if not os.access(parent, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(parent))


def open_to_write(path: Path, mode: str = "wb", buffering: int = -1) -> IO[Any]:
    """Open a file for writing. Raises OSError, also for a symbolic link, through which nothing is written."""
    refuse_link(path)
    return path.open(mode, buffering)


def refuse_link(path: Path) -> None:
    """Raise OSError for a symbolic link."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link; polysight does not write through links", str(path))


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file, or keep the present one; raises as :func:`write_together`."""
    write_together({path: data})


def write_together(files: Mapping[Path, bytes]) -> None:
    """Write files that belong together.

    Each is written to a temporary file in its folder and flushed to disk; then all are renamed, in their order. A
    program that is killed between two renames has not renamed the last file yet. Readers must therefore check the last
    file: if it is new, so are all others.

    Raises
    ------
    OSError
        if one cannot be written, or is no regular file; nothing has changed then. If one cannot be renamed, those
        before it are replaced.
    DeviceError
        if a folder cannot be made durable; all files are replaced then.
    """
    parts: dict[Path, Path] = {}
    try:
        for path, data in files.items():
            _require_file_or_nothing(path)
            # A name of its own: two programs may write the same file at the same time.
            part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
            with name_in_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            with _name_in_os_errors(path), part.open("xb") as f:
                parts[path] = part
                f.write(data)
                f.flush()
                os.fsync(f.fileno())
        for path, part in parts.items():
            with _name_in_os_errors(path):
                part.replace(path)
    except BaseException:
        for part in parts.values():
            part.unlink(missing_ok=True)
        raise
    for folder in dict.fromkeys(path.parent for path in files):
        sync_folder(folder)


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Let one program, and one thread of it, at a time read and replace a small file of a folder; the others wait.

    The folder itself is locked with flock(2): a kill releases it, and nothing is left on the disk. Where folders cannot
    be locked (Windows, some network drives) nothing is held. A thread that holds a folder must not hold it again.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Flush names that were created, renamed or removed in a folder to disk. Raises DeviceError."""
    if not hasattr(os, "O_DIRECTORY"):
        # Windows cannot open folders; NTFS writes their changes to its journal.
        return
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as e:
        raise DeviceError(
            f"{path}: cannot be made durable: {e.strerror}",
            "the disk is full or fails",
            f"free space below {path}",
            code=ErrorCode.FILE_UNWRITABLE,
        ) from None
