"""State shared by requests of the reading process: scans, live views, threads for reads, caches, started programs.

The page asks for the list of scans whole once, then for what has changed since (`ChangingList`): 2,000 scans are some
800 kB of JSON, and each open page asks every 4 s. The server numbers the states of its list; a page names the one that
it has.
"""

from __future__ import annotations

import asyncio
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import anyio
import msgspec
from starlette.requests import Request

from polysight import catalogue
from polysight.page import Watch
from polysight.products import read_products
from polysight.results import CheckResult, check_plate
from polysight.serve.programs import Programs, Queue
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode

READ_S = 30.0
"""Time limit of one read. Longer ones are refused, and so is their folder until they have returned."""
SIZE_S = 30.0
"""When the count of a folder's size takes longer, another thread continues with the other folders; chosen."""
HIDDEN = ".polysight"
"""Hidden folder in the folder of scans: logs of programs without a scan, the queue, the archive, the list's index."""
LIBRARIES = "libraries"
THUMBNAIL = "thumbnail"
# Drawn pictures and comparisons that are kept for the next request; chosen.
MAX_PICTURES = 400
MAX_COMPARISONS = 4
# A check plate's result takes a few hundred bytes; reading it again takes milliseconds for each scan.
MAX_CHECKS = 20_000
# Each live view forms images with an own pipeline. The number is chosen.
MAX_WATCHES = 4
# A live view without pages stays open for this long; chosen: a page that is loaded again finds it.
LINGER_S = 30.0
# Reads at a time, of all folders and of one: chosen, so that one folder that hangs takes half of the threads at most.
READERS = 4
READERS_OF_ONE_FOLDER = 2
# A size that is asked for is counted again if its count is older (chosen).
SIZE_AGE_S = 20.0
# The same for a scan that is running, whose folder grows; chosen, as often as the list is looked at.
GROWING_SIZE_AGE_S = 4.0
# Between two looks for a newer state or motion; chosen.
STREAM_INTERVAL_S = 0.1
# A page that receives nothing for some of these (chosen) reconnects.
ALIVE_INTERVAL_S = 2.0
T = TypeVar("T")


class Site:
    """Shared state of the requests to one server.

    Without `programs` nothing can be started; `config` is the rig file of new scans.
    """

    def __init__(
        self,
        scans: catalogue.Scans,
        watches: Watches,
        programs: Programs | None = None,
        config: Path | None = None,
    ) -> None:
        self.scans = scans
        self.watches = watches
        self.is_ending: Callable[[], bool] = lambda: False
        # Held from the check that no program uses the rig until a program is started on it.
        self.rig = threading.Lock()
        self.listed = ChangingList()
        self._programs = programs
        self._config = config
        self._queue: Queue | None = None
        self._readers = Readers()
        self._sizes = Sizes()

    @property
    def starts(self) -> bool:
        """True if programs and scans can be started from the page."""
        return self._programs is not None and self._config is not None

    @property
    def programs(self) -> Programs:
        """Started programs. Raises DeviceError if none can be started here."""
        if self._programs is None:
            raise DeviceError(
                "nothing can be started here",
                "this server only shows one scan",
                "start a server for scans: polysight serve",
            )
        return self._programs

    @property
    def config(self) -> Path:
        """The rig file of new scans. Raises ConfigError without one."""
        if self._config is None:
            raise ConfigError(
                "this server has no rig file", "it was started without one", "polysight serve --config FILE"
            )
        return self._config

    @property
    def queue(self) -> Queue:
        """Scans that wait for the rig. Raises ConfigError where none can be started."""
        if self._queue is None:
            raise ConfigError("nothing can be started here", "there is no queue", "polysight serve --config FILE")
        return self._queue

    def open_queue(self, start: Callable[[bytes], None]) -> None:
        """Open the queue, where scans can be started; `start` is given the waiting request of each, as it came."""
        if self.starts:
            self._queue = Queue(self.logs / "queue", start, lambda: {s.name: s.state for s in self.scans.list()})

    def name(self, request: Request, key: str = "scan") -> str:
        """Name of the scan that a request asks for: as given, or the only one. Raises ConfigError without one."""
        name = request.query_params.get(key) or self.scans.only
        if not name:
            raise ConfigError(
                "no scan is named", f"the address has no {key}=NAME", "choose a scan from the list",
                code=ErrorCode.KEY_MISSING,
            )  # fmt: skip
        return name

    async def read(self, name: str, work: Callable[[], T]) -> T:
        """Read something of a scan, "" for the whole folder, in a thread. Raises DeviceError, see :class:`Readers`."""
        return await self._readers.run(name.partition("/")[0], work)

    async def read_scan(self, request: Request, work: Callable[[Path], T]) -> T:
        """Run `work(folder)` in a thread, for the scan that a request names. Raises PolysightError."""
        name = self.name(request)
        return await self.read(name, lambda: work(self.scans.folder(name)))

    async def run_command(self, work: Callable[[], T]) -> T:
        """Run a command in a thread that no read can have taken."""
        return await anyio.to_thread.run_sync(work)

    def size(self, name: str, state: str) -> int | None:
        """Return the bytes of a scan in this state on the disk; None while they are being counted."""
        max_age_s = GROWING_SIZE_AGE_S if state == "running" else SIZE_AGE_S
        return self._sizes.read_size(self.scans.root / name, max_age_s)

    @property
    def logs(self) -> Path:
        """The hidden folder, `HIDDEN`."""
        return self.scans.root / HIDDEN

    def libraries(self) -> dict[str, Path]:
        """Return the libraries trained here, by name."""
        folder = self.scans.root / LIBRARIES
        if not folder.is_dir() or folder.is_symlink():
            return {}
        files = [path for path in sorted(folder.glob("*.npz")) if path.is_file() and not path.is_symlink()]
        return {path.stem: path for path in files}

    def close(self) -> None:
        """Close the live views and the queue; started programs continue."""
        self.watches.close()
        if self._queue is not None:
            self._queue.close()
        if self._programs is not None:
            self._programs.close()


def draw_map(folder: Path, name: str, limits: tuple[float, float] | None = None) -> catalogue.Picture:
    """Draw a map of a scan's products, or its `thumbnail`; cached until these change. Raises DataError."""
    return _draw(*_stamp_products(folder), name, limits)


def compare_products(first: Path, second: Path) -> catalogue.Comparison:
    """Compare two processed scans; cached until their products change. Raises DataError."""
    return _compare(first, second, _stamp_products(first), _stamp_products(second))


def check_products(folder: Path) -> CheckResult | None:
    """Check plate of a scan's products, None without one; read again only when these have changed. Raises DataError."""
    return _check(*_stamp_products(folder))


def _stamp_products(folder: Path) -> tuple[Path, str]:
    """Return the folder of a scan's products, and a stamp that changes with them."""
    products = read_products(folder).folder
    return products, catalogue.read_generation(products)


@lru_cache(maxsize=MAX_PICTURES)
def _draw(products: Path, stamp: str, name: str, limits: tuple[float, float] | None) -> catalogue.Picture:
    """Draw a map, or the thumbnail; `stamp` only distinguishes cached products of another generation."""
    del stamp
    pixels = catalogue.Pixels(products)
    if name == THUMBNAIL:
        return catalogue.thumbnail(pixels)
    return catalogue.draw_products(pixels, name, limits)


@lru_cache(maxsize=MAX_CHECKS)
def _check(products: Path, stamp: str) -> CheckResult | None:
    """Judge the check plate of products; None if the rig file names none. `stamp` as for `_draw`."""
    del stamp
    scan = read_products(products)
    if scan.rig is None:
        return None
    return check_plate(scan.rig.check, scan.segments)


@lru_cache(maxsize=MAX_COMPARISONS)
def _compare(first: Path, second: Path, *stamps: tuple[Path, str]) -> catalogue.Comparison:
    """Compare two scans; `stamps` only distinguish cached products of another generation."""
    del stamps
    return catalogue.compare(first, second)


class Readers:
    """Threads for reads, with a time limit each; one folder never takes all of them.

    A read that hangs (a disconnected network drive) cannot be ended: its thread is left behind, and further reads of
    the same folder are refused until it returns.
    """

    def __init__(self) -> None:
        self._threads = anyio.CapacityLimiter(READERS)
        self._turns: dict[str, anyio.CapacityLimiter] = {}
        self._hanging: dict[str, list[threading.Event]] = {}

    async def run(self, folder: str, work: Callable[[], T]) -> T:
        """Run a read of a folder.

        Raises
        ------
        DeviceError
            with `NO_ANSWER` when it takes longer than `READ_S`, or another read of this folder still hangs.
        """
        turn = self._turns.setdefault(folder, anyio.CapacityLimiter(READERS_OF_ONE_FOLDER))
        try:
            async with turn, self._threads:
                self._check(folder)
                return await self._run(folder, work)
        finally:
            if not turn.statistics().borrowed_tokens and not turn.statistics().tasks_waiting:
                self._turns.pop(folder, None)

    async def _run(self, folder: str, work: Callable[[], T]) -> T:
        """Run a read in a thread; after `READ_S` leave the thread behind and raise DeviceError."""
        returned = threading.Event()

        def work_and_return() -> T:
            try:
                return work()
            finally:
                returned.set()

        with anyio.move_on_after(READ_S):
            one_thread = anyio.CapacityLimiter(1)
            return await anyio.to_thread.run_sync(work_and_return, abandon_on_cancel=True, limiter=one_thread)
        self._hanging.setdefault(folder, []).append(returned)
        raise _no_answer_error(folder)

    def _check(self, folder: str) -> None:
        """Refuse a folder of which a read hangs."""
        hanging = [returned for returned in self._hanging.pop(folder, []) if not returned.is_set()]
        if hanging:
            self._hanging[folder] = hanging
            raise _no_answer_error(folder)


def _no_answer_error(folder: str) -> DeviceError:
    """Return the error of a folder that does not answer."""
    return DeviceError(
        f"{folder or 'the folder of scans'} did not answer within {READ_S:g} s", "its drive is disconnected, or "
        "very busy",
        "check the network drive, then load the page again", code=ErrorCode.NO_ANSWER,
    )  # fmt: skip


class Sizes:
    """Sizes of folders, counted in the background one after another; one that hangs does not delay others for long."""

    def __init__(self) -> None:
        self._counted: dict[Path, tuple[int, float]] = {}
        self._waiting: OrderedDict[Path, None] = OrderedDict()
        self._counting_since: dict[Path, float] = {}
        self._lock = threading.Lock()

    def read_size(self, folder: Path, max_age_s: float = SIZE_AGE_S) -> int | None:
        """Return the size in bytes at the last count, None before the first; one older than `max_age_s` is renewed."""
        size, counted_at = self._counted.get(folder, (None, float("-inf")))
        now = time.monotonic()
        if now - counted_at > max_age_s:
            with self._lock:
                if folder not in self._counting_since:
                    self._waiting[folder] = None
                if all(now - since > SIZE_S for since in self._counting_since.values()):
                    self._begin_next()
        return size

    def _begin_next(self) -> None:
        """Begin with the next folder, with the lock held."""
        if self._waiting:
            folder, _ = self._waiting.popitem(last=False)
            self._counting_since[folder] = time.monotonic()
            threading.Thread(target=self._count, args=(folder,), name="sizes", daemon=True).start()

    def _count(self, folder: Path) -> None:
        """Count one folder, then begin with the next."""
        self._counted[folder] = (catalogue.folder_bytes(folder), time.monotonic())
        with self._lock:
            del self._counting_since[folder]
            self._begin_next()


class OpenWatch:
    """A live view that was opened for a page: how many event streams show it, and when it was last used."""

    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self.streams = 0
        self.used_at = time.monotonic()


class Watches:
    """Open live views: one for each scan that a page shows; those without pages are closed when others are opened.

    `control`: scans may be controlled; `lasting`: watches that stay open, by name.
    """

    def __init__(self, control: bool, lasting: dict[str, Watch] | None = None) -> None:
        self._control = control
        self._lasting = lasting or {}
        self._open: dict[str, OpenWatch] = {}
        self._lock = threading.Lock()

    def open(self, name: str, folder: Path) -> Watch:
        """Return the live view of a scan; open it first if necessary. Raises DeviceError if too many are open."""
        watch = self._find(name)
        if watch is not None:
            return watch
        with self._lock:
            self._make_room()
        # It reads the folder, which may hang: without the lock.
        watch = Watch(folder, self._control)
        with self._lock:
            opened = self._open.setdefault(name, OpenWatch(watch))
        if opened.watch is watch:
            watch.start()
        else:
            watch.close()
        return opened.watch

    def _find(self, name: str) -> Watch | None:
        """Return the live view of a scan, and note that it was used; None if it is not open."""
        with self._lock:
            if name in self._open:
                self._open[name].used_at = time.monotonic()
                return self._open[name].watch
            return self._lasting.get(name)

    def _make_room(self) -> None:
        """Close live views without pages: after a while, or immediately when there are too many. Raises DeviceError."""
        too_many = len(self._open) >= MAX_WATCHES
        for name, opened in list(self._open.items()):
            if not opened.streams and (too_many or time.monotonic() - opened.used_at > LINGER_S):
                # Closed in a thread, because its folder may hang.
                threading.Thread(target=opened.watch.close, name="close", daemon=True).start()
                del self._open[name]
        if len(self._open) >= MAX_WATCHES:
            raise DeviceError(
                f"{MAX_WATCHES} live views are open", "each takes a part of a processor", "close one",
                code=ErrorCode.BUSY,
            )  # fmt: skip

    @contextmanager
    def _count_stream(self, name: str) -> Iterator[None]:
        """Count an event stream of a live view for the block, so that it is not closed meanwhile."""
        opened = self._open.get(name)
        if opened is None:
            yield
            return
        opened.streams += 1
        try:
            yield
        finally:
            opened.streams -= 1
            opened.used_at = time.monotonic()

    async def events(self, name: str, watch: Watch, is_ending: Callable[[], bool]) -> AsyncIterator[bytes]:
        """Return the server-sent events of one page: always the newest state and motion.

        Nothing is queued: a slow page gets fewer events, since `yield` waits for its socket.
        """
        sent_numbers = {"state": -1, "motion": -1}
        silent_s = 0.0
        with self._count_stream(name):
            while not is_ending():
                for kind, newest in (("state", watch.state), ("motion", watch.motion)):
                    if newest.version != sent_numbers[kind]:
                        sent_numbers[kind] = newest.version
                        silent_s = 0.0
                        yield b"event: %s\nid: %d\ndata: %s\n\n" % (kind.encode(), newest.version, newest.data)
                if silent_s >= ALIVE_INTERVAL_S:
                    silent_s = 0.0
                    yield b"event: alive\ndata: 0\n\n"
                await asyncio.sleep(STREAM_INTERVAL_S)
                silent_s += STREAM_INTERVAL_S

    def close(self) -> None:
        """Close all."""
        with self._lock:
            for watch in [*self._lasting.values(), *(opened.watch for opened in self._open.values())]:
                watch.close()
            self._open = {}
            self._lasting = {}


# --- the list of scans, as the page asks for it ---

# Random bytes that distinguish the states of this server from those of one that ran before.
ORIGIN_BYTES = 4


class ListedScan(catalogue.Summary, frozen=True, kw_only=True):
    """A line of the list with the scan's size, None while it is being counted."""

    bytes: int | None


class ListChanges(msgspec.Struct, frozen=True, kw_only=True):
    """Scans that are new or differ, and names that are gone; all scans if `whole`. `stamp` names the state reached."""

    stamp: str
    whole: bool
    scans: list[ListedScan]
    gone: list[str]


class ChangingList:
    """The newest list, with the number of the state in which each of its scans changed last."""

    def __init__(self) -> None:
        # A server that was started again counts from zero: stamps of another one are not its own.
        self._origin = secrets.token_hex(ORIGIN_BYTES)
        self._number = 0
        self._scans: dict[str, ListedScan] = {}
        self._changed_in: dict[str, int] = {}
        self._gone_in: dict[str, int] = {}
        self._lock = threading.Lock()

    def update(self, scans: Sequence[ListedScan], stamp: str) -> ListChanges:
        """Take over the newest list; return what differs from the state that `stamp` names, or all of it."""
        with self._lock:
            self._take_over({scan.name: scan for scan in scans})
            reached = f"{self._origin}-{self._number}"
            shown_state = self._find_state(stamp)
            if shown_state is None:
                return ListChanges(stamp=reached, whole=True, scans=list(self._scans.values()), gone=[])
            changed_scans = [scan for name, scan in self._scans.items() if self._changed_in[name] > shown_state]
            removed = [name for name, number in self._gone_in.items() if number > shown_state]
        return ListChanges(stamp=reached, whole=False, scans=changed_scans, gone=removed)

    def _take_over(self, scans: dict[str, ListedScan]) -> None:
        """Make this the newest list; note in which state each scan changed or went. The lock is held."""
        changed_names = [name for name, scan in scans.items() if self._scans.get(name) != scan]
        removed = [name for name in self._scans if name not in scans]
        if changed_names or removed:
            self._number += 1
        for name in changed_names:
            self._changed_in[name] = self._number
            self._gone_in.pop(name, None)
        for name in removed:
            del self._changed_in[name]
            self._gone_in[name] = self._number
        self._scans = scans

    def _find_state(self, stamp: str) -> int | None:
        """Return the number of the state that a stamp names; None if the stamp is not of this list."""
        origin, _, number = stamp.partition("-")
        is_number = number.isascii() and number.isdecimal() and len(number) <= len(str(self._number))
        if origin != self._origin or not is_number:
            return None
        return int(number)
