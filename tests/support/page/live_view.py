"""Helpers for tests of the live view: scans that grow line by line, and servers on free ports."""

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from polysight.acquisition.control import ALIVE_FILE, CONTROL_FOLDER, ControlFolder, StopRequest
from polysight.catalogue import Scans
from polysight.page.history import ScanHistory
from polysight.page.watch import Watch
from polysight.serve.front import Front
from polysight.serve.guard import Access
from polysight.serve.programs import Programs
from polysight.serve.server import ServerAddress, make_reader_app, make_server
from polysight.serve.site import Site, Watches
from polysight.serve.stage import StageControl
from polysight.store import EVENTS, MANIFEST, manifest, utc_now
from tests.support.processes import HANG_S, wait_for
from tests.support.store.facts import load_facts


def begin_history(started: dict[str, Any]) -> ScanHistory:
    """Return the history of a scan whose manifest has only its first line, the fact `started`."""
    content = manifest.parse(manifest.encode_line(started))
    assert content.started is not None
    return ScanHistory(content, content.started)


def add_fact(history: ScanHistory, fact: dict[str, Any]) -> None:
    """Add a fact to the history, as if its line were read from the manifest."""
    for parsed_fact in history.content.feed(manifest.encode_line(fact)):
        history.add_fact(parsed_fact)


class GrowingScan:
    """A copy of a finished scan, to which a test writes the lines of the manifest one by one, as if it were running."""

    def __init__(self, finished: Path, folder: Path) -> None:
        self._facts = load_facts(finished)
        self._events = (finished / EVENTS).read_bytes()
        self.path = folder
        folder.mkdir()
        shutil.copytree(finished / "raw", folder / "raw")

    def grow(self) -> str:
        """Write the next fact of the finished scan, and the events before it; return its name, or "" at the end."""
        if not self._facts:
            return ""
        fact = self._facts.pop(0)
        fact |= {key: utc_now() for key in fact if key.endswith("_utc")}
        # A fact has the length of the file of events at its time.
        event_bytes = fact.get("events", {}).get("bytes", 0)
        if event_bytes:
            (self.path / EVENTS).write_bytes(self._events[:event_bytes])
        self.write(fact)
        return str(fact["fact"])

    def write(self, fact: dict[str, Any]) -> None:
        """Write a fact that is not one of the finished scan."""
        with (self.path / MANIFEST).open("ab") as f:
            f.write(manifest.encode_line(fact))

    def grow_until(self, fact: str) -> None:
        """Write facts up to the next one of this name."""
        while self.grow() != fact:
            assert self._facts, f"no {fact} left"

    def touch_alive(self) -> None:
        """Touch the file by which a running scan shows that it is alive."""
        (self.path / CONTROL_FOLDER).mkdir(exist_ok=True)
        (self.path / CONTROL_FOLDER / ALIVE_FILE).touch()


@contextmanager
def open_control(folder: Path) -> Iterator[StopRequest]:
    """Execute the commands in `folder`/control as a running scan does; yield the stop request that they set."""
    stop = StopRequest()
    with ControlFolder(folder, stop) as control:
        control.open()
        wait_for((folder / CONTROL_FOLDER / ALIVE_FILE).exists, "the first sign of life")
        yield stop


class Served:
    """A site on a free port or at a given address.

    In the program the front and the reader of scans are two processes; here both run in one thread.
    """

    def __init__(
        self,
        site: Site,
        access: Access,
        host: str = "127.0.0.1",
        port: int = 0,
        server_address: ServerAddress | None = None,
    ) -> None:
        self.site = site
        starts = site.starts and access.control
        stage = StageControl(site.config) if starts else None
        front = Front(site.scans, access, starts, make_reader_app(site), stage)
        self._server = make_server(front, server_address or ServerAddress())
        site.is_ending = lambda: self._server.should_exit
        self._server.config.host = host
        self._server.config.port = port
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()
        wait_for(lambda: self._server.started, "the server serves")
        self.port = int(self._server.servers[0].sockets[0].getsockname()[1])
        self.address = f"http://{host}:{self.port}"

    def close(self) -> None:
        """End it."""
        self._server.should_exit = True
        self._thread.join(HANG_S)
        assert not self._thread.is_alive(), "the server does not end"


@contextmanager
def serve_view(watch: Watch, token: str = "", host: str = "127.0.0.1", port: int = 0) -> Iterator[Served]:
    """Serve one live view during the block."""
    access = Access(token, loopback=host == "127.0.0.1", control=bool(token))
    scans = Scans(watch.folder.parent, watch.folder.name)
    server = Served(Site(scans, Watches(bool(token), {watch.folder.name: watch})), access, host, port)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def serve_folder(
    root: Path,
    token: str = "",
    access: Access | None = None,
    config: Path | None = None,
    server_address: ServerAddress | None = None,
) -> Iterator[Served]:
    """Serve all scans in a folder during the block. With a rig file (`config`) the page can start programs."""
    access = access or Access(token, control=bool(token))
    programs = Programs() if config is not None else None
    server = Served(Site(Scans(root), Watches(access.control), programs, config), access, server_address=server_address)
    try:
        yield server
    finally:
        server.close()
        server.site.close()
