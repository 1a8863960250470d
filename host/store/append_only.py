"""A file that only grows, and whose end is known: what the manifest and the event log are made of.

Also `sync_folder`, which makes names in a folder durable, and `crc32`, which is zlib-ng's where that is installed.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack, suppress
from pathlib import Path

from polysight.shared.errors import DeviceError
from polysight.shared.files import open_to_write

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["AppendFile", "crc32", "sync_folder"]


class AppendFile:
    """A file open for durable appending. No buffer: what one call could not write, no later call writes by surprise.

    Parameters
    ----------
    path
        The file.
    create
        Make it when it is absent.

    Attributes
    ----------
    length
        Bytes that count. What a failed :meth:`append` has left behind them is overwritten or cut off.

    Raises
    ------
    DeviceError
        if it cannot be opened.
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
            raise self._failed("made" if fresh else "opened", e) from None

    def lock(self) -> bool:
        """Keep other programs from locking this file, until it is closed; False if one has.

        Raises DeviceError if the file system cannot lock; the file is closed then.
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
            ) from None
        return True

    def cut(self, length: int) -> None:
        """Forget what follows the first `length` bytes. Raises DeviceError."""
        try:
            os.ftruncate(self._file.fileno(), length)
            os.fsync(self._file.fileno())
        except OSError as e:
            raise self._failed("cut at its last whole record", e) from None
        self.length = length

    def append(self, data: bytes) -> None:
        """Write `data` behind the end; it is durable when this returns. Raises DeviceError, and the end stays."""
        left, end = memoryview(data), self.length
        try:
            while left:
                written = os.pwrite(self._file.fileno(), left, end)
                left, end = left[written:], end + written
            os.fsync(self._file.fileno())
        except OSError as e:
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), self.length)
            raise self._failed("written", e) from None
        self.length = end

    def close(self) -> None:
        """Close the file. Twice is once."""
        self._file.close()

    def _failed(self, done: str, e: OSError) -> DeviceError:
        return DeviceError(
            f"{self.path}: cannot be {done}: {e.strerror}",
            "the disk is full, read-only or fails",
            f"free space; `polysight resume {self.path.parent}` goes on from the last committed row",
        )


def sync_folder(path: Path) -> None:
    """Make names made, renamed or removed in a folder durable. Raises DeviceError."""
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
            f"free space below {path}, then go on",
        ) from None
