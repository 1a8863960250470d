"""What the requests share: the scans, who is let in, open live views, pictures that were drawn, sizes on the disk."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import anyio
from starlette.requests import Request

from polysight.host.catalogue import Pixels, Scans, folder_bytes
from polysight.host.products import SavedProducts, read_products
from polysight.host.serve.guard import Access
from polysight.host.serve.programs import Programs
from polysight.host.serve.watches import Watches

HIDDEN = ".polysight"
"""Folder beside the scans that holds the logs of programs that belong to no scan."""
LIBRARIES = "libraries"
_KEPT = 400  # pictures
_SIZES_S = 20.0  # a folder's size is asked for again after so long, at most
T = TypeVar("T")


class Site:
    """One served folder of scans.

    Parameters
    ----------
    scans
        What is shown.
    access
        Who is let in.
    watches
        Live views.
    programs
        Starts programs; None where nothing can be started.
    config
        Rig file of new scans; None where there is none.
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
        self._pictures: OrderedDict[tuple[Any, ...], Any] = OrderedDict()
        self._heavy = anyio.CapacityLimiter(2)
        self._sizes = Sizes()

    def name(self, request: Request, key: str = "scan") -> str:
        """Which scan a request is about: as it says, or the only one there is."""
        return request.query_params.get(key, self.scans.only or "")

    async def compute(self, work: Callable[..., T], *arguments: Any) -> T:
        """Do something that takes a processor, in a thread; two at most at once."""
        return await anyio.to_thread.run_sync(work, *arguments, limiter=self._heavy)

    async def act(self, work: Callable[..., T], *arguments: Any) -> T:
        """Do something that waits, in a thread; never behind what computes."""
        return await anyio.to_thread.run_sync(work, *arguments)

    def drawn(self, folder: Path, what: tuple[Any, ...], draw: Callable[[Pixels], T]) -> T:
        """A picture of a scan's products, drawn once as long as they stay the same."""
        products = read_products(folder)
        key = (str(products.folder), (products.folder / "image.npz").stat().st_mtime_ns, *what)
        if key not in self._pictures:
            self._pictures[key] = draw(Pixels(SavedProducts(products.folder)))
            while len(self._pictures) > _KEPT:
                self._pictures.popitem(last=False)
        return self._pictures[key]

    def size(self, name: str) -> int | None:
        """Bytes of a scan on the disk; None while they are being counted."""
        return self._sizes.of(self.scans.root / name)

    @property
    def logs(self) -> Path:
        """Folder of programs that belong to no scan."""
        return self.scans.root / HIDDEN

    def libraries(self) -> dict[str, Path]:
        """Libraries that were trained here, by name."""
        folder = self.scans.root / LIBRARIES
        found = sorted(folder.glob("*.npz")) if folder.is_dir() and not folder.is_symlink() else []
        return {path.stem: path for path in found if path.is_file() and not path.is_symlink()}

    def close(self) -> None:
        """End what belongs to the server; programs go on."""
        self.watches.close()
        if self.programs is not None:
            self.programs.close()


class Sizes:
    """Sizes of folders, counted in the background one after another."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[int, float]] = {}
        self._wanted: OrderedDict[Path, None] = OrderedDict()
        self._lock = threading.Lock()
        self._busy = False

    def of(self, folder: Path) -> int | None:
        """The bytes as counted last; None before that."""
        size, at = self._known.get(folder, (None, float("-inf")))
        if time.monotonic() - at > _SIZES_S:
            with self._lock:
                self._wanted[folder] = None
                begin, self._busy = not self._busy, True
            if begin:
                threading.Thread(target=self._count, name="sizes", daemon=True).start()
        return size

    def _count(self) -> None:
        while True:
            with self._lock:
                if not self._wanted:
                    self._busy = False
                    return
                folder, _ = self._wanted.popitem(last=False)
            self._known[folder] = (folder_bytes(folder), time.monotonic())
