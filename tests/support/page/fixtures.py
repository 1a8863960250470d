"""Fixtures of the test folders `page` and `serve`: small scans, and watches, which follow a scan for the live view."""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from polysight.jobs.process import process
from polysight.page.watch import Watch
from polysight_simulators.scene import decode_scene, simulate
from tests.support.page.live_view import GrowingScan
from tests.support.processes import wait_for
from tests.support.products import skip_rendering
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, PET, make_scene
from tests.support.store.small_scan import Samples, SmallScan
from tests.support.suite import make_once


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    return Samples(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def finished_scan(samples: Samples, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished scan of three rows."""
    scan = SmallScan(samples, tmp_path_factory.mktemp("finished"))
    assert scan.run().exit_status == "success"
    return scan.path


@pytest.fixture
def growing(finished_scan: Path, tmp_path: Path) -> GrowingScan:
    """A scan that has not begun yet."""
    return GrowingScan(finished_scan, tmp_path / "scan")


class Watched(Watch):
    """A watch with a method that waits for a state of the scan."""

    def wait_for(self, condition: Callable[[dict[str, Any]], bool]) -> None:
        """Wait until the condition holds for the state that the page would show."""
        wait_for(lambda: condition(json.loads(self.state.data)), "a snapshot")


@pytest.fixture
def watching() -> Iterator[Callable[..., Watched]]:
    """A function that starts a watch, which runs until the test ends."""
    with ExitStack() as watched:

        def watch(*arguments: Any, **options: Any) -> Watched:
            new_watch = watched.enter_context(closing(Watched(*arguments, **options)))
            new_watch.start()
            return new_watch

        yield watch


@pytest.fixture(scope="session")
def processed_scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two processed scans, `one` and `two`, of copper and PET; they differ in their noise."""
    scene = decode_scene(make_scene(COPPER, PET, columns=15, rows=17), "test")

    def make(root: Path) -> None:
        for name, seed in (("one", 3), ("two", 7)):
            folder = simulate(load_published_rig(), scene, root / name, seed=seed)
            with skip_rendering():
                assert process(folder, folder / "products", threads=1) == 0

    return make_once(tmp_path_factory, "processed", make)
