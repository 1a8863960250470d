"""Append-only file with durable writes, for the manifest and the event log.

Also `sync_folder`, which makes names in a folder durable, and `crc32` (zlib-ng's if installed).
"""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack, suppress
from pathlib import Path

from polysight.capture import write_error
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError
from polysight_shared.files import open_to_write

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["AppendFile", "crc32", "sync_folder"]


class AppendFile:
    """A file open for durable, unbuffered appending; with `create`, made if missing.

    `length` is the number of valid bytes; bytes behind them, from a failed :meth:`append`, are overwritten or cut off.

    Raises
    ------
    DeviceError
        if the file cannot be opened.
    """

    def __init__(self, path: Path, create: bool) -> None:
        self.path = path
        fresh = create and not path.exists()
        try:
            with ExitStack() as stack:
                self._file = stack.enter_context(open_to_write(path, "xb" if fresh else "r+b", 0))
                if fresh:
                    sync_folder(path.parent)
                self.length = os.fstat(self._file.fileno()).st_size
                stack.pop_all()
        except OSError as e:
            raise write_error(path, "created" if fresh else "opened", e) from None

    def lock(self) -> bool:
        """Lock this file until it is closed; return False if another program has locked it.

        Raises DeviceError if the file system cannot lock, and closes the file then.
        """
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as e:
            self._file.close()
            raise DeviceError(
                f"{self.path}: cannot be locked: {e.strerror}",
                "a network disk whose server offers no locks, or the disk fails",
                "put the scan on a local disk, or have its server offer locks",
                code=ErrorCode.FILE_UNWRITABLE,
            ) from None
        return True

    def cut(self, length: int) -> None:
        """Truncate the file to `length` bytes. Raises DeviceError."""
        try:
            os.ftruncate(self._file.fileno(), length)
            os.fsync(self._file.fileno())
        except OSError as e:
            raise write_error(self.path, "cut at its last complete record", e) from None
        self.length = length

    def append(self, data: bytes) -> None:
        """Append `data` durably. After a DeviceError the file has its former length."""
        left, end = memoryview(data), self.length
        try:
            while left:
                written = os.pwrite(self._file.fileno(), left, end)
                left, end = left[written:], end + written
            os.fsync(self._file.fileno())
        except OSError as e:
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), self.length)
            raise write_error(self.path, "written", e) from None
        self.length = end

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        self._file.close()


def sync_folder(path: Path) -> None:
    """Make names that were created, renamed or removed in a folder durable. Raises DeviceError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as e:
        what, why = f"{path}: cannot be made durable: {e.strerror}", "the disk is full or fails"
        raise DeviceError(what, why, f"free space below {path}", code=ErrorCode.FILE_UNWRITABLE) from None
