"""State shared by all requests: scans, access, live views, threads for reads, caches, sizes on the disk."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import anyio
from starlette.requests import Request

from polysight.catalogue import Comparison, Pixels, Scans, compare, folder_bytes
from polysight.products import read_products
from polysight.serve.guard import Access
from polysight.serve.programs import Programs
from polysight.serve.watches import Watches
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError

READ_S = 30.0
"""Time limit of one read. Longer ones are refused, and so is their folder until they have returned."""
SIZE_S = 30.0
"""Time after which other folders are counted by another thread."""
HIDDEN = ".polysight"
"""Folder beside the scans that holds the logs of programs that belong to no scan."""
LIBRARIES = "libraries"
_PICTURES, _COMPARISONS = 400, 4  # that are kept
_THREADS, _THREADS_A_FOLDER = 4, 2  # of reads at a time
_SIZES_S = 20.0  # a folder's size is asked for again after so long, at most
T = TypeVar("T")


class Site:
    """Shared state of the requests to one server.

    Without `programs` nothing can be started; `config` is the rig file of new scans.
    """

    def __init__(
        self,
        scans: Scans,
        access: Access,
        watches: Watches,
        programs: Programs | None = None,
        config: Path | None = None,
    ) -> None:
        self.scans, self.access, self.watches = scans, access, watches
        self.programs, self.config = programs, config
        self.ending: Callable[[], bool] = lambda: False
        self.rig = threading.Lock()  # held from the check that the rig is free until a program has it
        self._pictures, self._comparisons = Recent(_PICTURES), Recent(_COMPARISONS)
        self._readers = Readers()
        self._sizes = Sizes()

    def name(self, request: Request, key: str = "scan") -> str:
        """Name of the scan that a request asks for: as given, or the only one. Raises ConfigError without one."""
        name = request.query_params.get(key) or self.scans.only
        if not name:
            raise ConfigError(
                "no scan is named", f"the address has no {key}=NAME", "choose a scan from the list",
                code=ErrorCode.KEY_MISSING,
            )  # fmt: skip
        return name

    async def read(self, name: str, work: Callable[..., T], *arguments: Any) -> T:
        """Read something of a scan, "" for the whole folder, in a thread. Raises DeviceError, see :class:`Readers`."""
        return await self._readers.run(name.partition("/")[0], work, *arguments)

    async def read_scan(self, request: Request, work: Callable[..., T], *arguments: Any) -> T:
        """Run `work(folder, *arguments)` in a thread, for the scan that a request names. Raises PolysightError."""
        name = self.name(request)
        return await self.read(name, lambda: work(self.scans.folder(name), *arguments))

    async def act(self, work: Callable[..., T], *arguments: Any) -> T:
        """Run a command that waits, in a thread of its own, never behind reads."""
        return await anyio.to_thread.run_sync(work, *arguments)

    def draw(self, folder: Path, what: tuple[Any, ...], draw: Callable[[Pixels], T]) -> T:
        """A picture of a scan's products, drawn again only when these have changed."""
        products, key = _stamped(folder)
        return self._pictures.get((key, *what), lambda: draw(Pixels(products)))

    def compare(self, first: Path, second: Path) -> Comparison:
        """Two processed scans compared, computed again only when their products have changed. Raises DataError."""
        key = (_stamped(first)[1], _stamped(second)[1])
        return self._comparisons.get(key, lambda: compare(first, second))

    def size(self, name: str) -> int | None:
        """Bytes of a scan on the disk; None while they are being counted."""
        return self._sizes.of(self.scans.root / name)

    @property
    def logs(self) -> Path:
        """Folder of programs that belong to no scan."""
        return self.scans.root / HIDDEN

    def libraries(self) -> dict[str, Path]:
        """Libraries trained here, by name."""
        folder = self.scans.root / LIBRARIES
        found = sorted(folder.glob("*.npz")) if folder.is_dir() and not folder.is_symlink() else []
        return {path.stem: path for path in found if path.is_file() and not path.is_symlink()}

    def close(self) -> None:
        """Close the live views; started programs go on."""
        self.watches.close()
        if self.programs is not None:
            self.programs.close()


def _stamped(folder: Path) -> tuple[Path, tuple[Any, ...]]:
    """The folder of a scan's products, and what changes when these do."""
    products = read_products(folder).folder
    files = [products / name for name in ("image.npz", "materials.json", "quality.json")]
    return products, (str(products), *(path.stat().st_mtime_ns for path in files if path.exists()))


class Recent:
    """Results by key; the oldest go when there are more than `most`."""

    def __init__(self, most: int) -> None:
        self._most, self._kept = most, OrderedDict[Any, Any]()
        self._lock = threading.Lock()

    def get(self, key: Any, make: Callable[[], T]) -> T:
        """The result of a key, made if it is not kept."""
        with self._lock:
            if key in self._kept:
                return self._kept[key]
        made = make()
        with self._lock:
            self._kept[key] = made
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return made


class Readers:
    """Threads for reads, with a time limit each; one folder never takes all of them.

    A read that hangs (a network drive that is gone) cannot be ended: its thread is left behind, and further reads of
    the same folder are refused until it returns.
    """

    def __init__(self) -> None:
        self._threads = anyio.CapacityLimiter(_THREADS)
        self._turns: dict[str, anyio.CapacityLimiter] = {}
        self._hanging: dict[str, list[threading.Event]] = {}  # set when they have returned

    async def run(self, folder: str, work: Callable[..., T], *arguments: Any) -> T:
        """Run a read of a folder.

        Raises
        ------
        DeviceError
            with `NO_ANSWER` when it takes longer than `READ_S`, or another read of this folder still hangs.
        """
        turn = self._turns.setdefault(folder, anyio.CapacityLimiter(_THREADS_A_FOLDER))
        try:
            async with turn, self._threads:
                self._check(folder)
                return await self._run(folder, lambda: work(*arguments))
        finally:
            if not turn.statistics().borrowed_tokens and not turn.statistics().tasks_waiting:
                self._turns.pop(folder, None)

    async def _run(self, folder: str, work: Callable[[], T]) -> T:
        returned = threading.Event()

        def tracked() -> T:
            try:
                return work()
            finally:
                returned.set()

        own = anyio.CapacityLimiter(1)
        with anyio.move_on_after(READ_S):
            return await anyio.to_thread.run_sync(tracked, abandon_on_cancel=True, limiter=own)
        self._hanging.setdefault(folder, []).append(returned)
        raise _no_answer(folder)

    def _check(self, folder: str) -> None:
        """Refuse a folder of which a read hangs."""
        hanging = [returned for returned in self._hanging.pop(folder, []) if not returned.is_set()]
        if hanging:
            self._hanging[folder] = hanging
            raise _no_answer(folder)


def _no_answer(folder: str) -> DeviceError:
    return DeviceError(
        f"{folder or 'the folder of scans'} did not answer within {READ_S:g} s", "its drive is gone, or very busy",
        "check the network drive, then load the page again", code=ErrorCode.NO_ANSWER,
    )  # fmt: skip


class Sizes:
    """Sizes of folders, counted in the background one after another; one that hangs holds up no other for long."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[int, float]] = {}
        self._wanted: OrderedDict[Path, None] = OrderedDict()
        self._counting: dict[Path, float] = {}  # since when
        self._lock = threading.Lock()

    def of(self, folder: Path) -> int | None:
        """Size in bytes at the last count; None before the first."""
        size, at = self._known.get(folder, (None, float("-inf")))
        now = time.monotonic()
        if now - at > _SIZES_S:
            with self._lock:
                if folder not in self._counting:
                    self._wanted[folder] = None
                if all(now - since > SIZE_S for since in self._counting.values()):
                    self._next()
        return size

    def _next(self) -> None:
        """Begin with the next folder, with the lock held."""
        if self._wanted:
            folder, _ = self._wanted.popitem(last=False)
            self._counting[folder] = time.monotonic()
            threading.Thread(target=self._count, args=(folder,), name="sizes", daemon=True).start()

    def _count(self, folder: Path) -> None:
        self._known[folder] = (folder_bytes(folder), time.monotonic())
        with self._lock:
            del self._counting[folder]
            self._next()
