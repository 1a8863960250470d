"""Small scans to look at, watches, and a browser: fixtures of the rooms `page` and `serve`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from polysight.host.page.watch import Watch
from tests.support.page.chromium import Browser, find_chromium
from tests.support.page.live_view import GrowingScan
from tests.support.store.small_scan import Samples, SmallScan


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    return Samples(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def finished(samples: Samples, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished scan of three rows."""
    scan = SmallScan(samples, tmp_path_factory.mktemp("finished"))
    assert scan.run().exit_status == "success"
    return scan.path


@pytest.fixture
def growing(finished: Path, tmp_path: Path) -> GrowingScan:
    """A scan that has not begun yet."""
    return GrowingScan(finished, tmp_path / "scan")


@pytest.fixture
def watching() -> Iterator[Callable[..., Watch]]:
    """Makes watches, as `Watch`, that look on until the test ends."""
    made: list[Watch] = []

    def watch(*arguments: object, **options: object) -> Watch:
        made.append(Watch(*arguments, **options))  # pyright: ignore[reportArgumentType]
        made[-1].start()
        return made[-1]

    yield watch
    for one in made:
        one.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if find_chromium() is None:
        pytest.skip("no chromium here: sudo apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("browser")) as made:
        yield made
