"""Options of the whole test suite, and the fixtures that many folders share."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from polysight_shared.config import Instrument

# Importing and collecting makes many objects that live to the end, among which there is no garbage to search for.
# `pytest_collection_finish` enables it again.
gc.disable()

# The tests start some hundred programs. Python compiles our modules once and saves the result for all of them, also if
# the shell has switched that off. Linear algebra uses one thread in each, because two threads that compete for few
# cores are ten times slower.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

# This must come before the first import of the helpers, so that their asserts show values when they fail.
pytest.register_assert_rewrite("tests.support")

from tests.support import preloaded  # noqa: E402
from tests.support.page.chromium import Browser, find_chromium  # noqa: E402
from tests.support.rigs import load_published_rig  # noqa: E402
from tests.support.suite import ByFile, Costs, sort_longest_first  # noqa: E402

# A shell lets programs in the background ignore Ctrl-C (SIGINT), and the programs of the tests would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Hypothesis has no deadline, because the machine may be busy. It draws the same examples in every run; with `--long` it
# draws more, and new ones in every run.
settings.register_profile(
    "patient", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
settings.register_profile("searching", settings.get_profile("patient"), max_examples=200, derandomize=False)
settings.load_profile("patient")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("instrument")
    group.addoption(
        "--stage-port", metavar="PORT", help="also talk to a real stage at this port: IT WILL HOME AND MOVE"
    )
    group.addoption("--uml", action="store_true", help="build a user-mode Linux and run the chain on its GPIO chip")
    group.addoption(
        "--pi-box", action="store_true", help="build a Debian for a Pi and run it on QEMU's Raspberry Pi 3B"
    )
    group.addoption("--costs", action="store_true", help="list what the tests cost, in processor time and by the clock")
    group.addoption("--long", action="store_true", help="the full number of randomised rows and random bytes")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--long"):
        settings.load_profile("searching")
    else:
        preloaded.install(preloaded.Server())
    if config.getoption("--costs"):
        config.pluginmanager.register(Costs())


def pytest_unconfigure(config: pytest.Config) -> None:
    if not config.getoption("--long"):
        preloaded.close()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--long"):
        # Ten thousand draws on a busy machine take longer than the limit after which a test counts as hanging.
        for item in items:
            item.add_marker(pytest.mark.timeout(0))
    # Without workers the tests keep the order of their collection.
    if hasattr(config, "workerinput"):
        sort_longest_first(items)


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByFile:
    return ByFile(config, log)


# Folders whose tests process whole scans but do not examine figures. Those of report, api, papers and e2e do.
FOLDERS_WITHOUT_RENDERING = ("calibration", "house", "jobs", "plan", "process", "products", "store")


@pytest.fixture(scope="module", autouse=True)
def _skip_rendering_in_some_folders(request: pytest.FixtureRequest) -> Iterator[None]:
    """Save every figure as one pixel where no test examines figures, because rendering takes seconds."""
    if request.path.parent.name not in FOLDERS_WITHOUT_RENDERING:
        yield
        return
    from tests.support.products import skip_rendering

    with skip_rendering():
        yield


@pytest.fixture(scope="session")
def rig() -> Instrument:
    """The published rig. Folders whose tests need another one have a fixture of the same name."""
    return load_published_rig()


@pytest.fixture(scope="session")
def _browser_of_worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if find_chromium() is None:
        pytest.skip("no chromium here: sudo apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture(scope="module")
def browser(_browser_of_worker: Browser) -> Iterator[Browser]:
    """A browser, the same for all tests of a worker."""
    yield _browser_of_worker
    # Otherwise the last page would keep sending requests to a server that has ended.
    _browser_of_worker.open("about:blank")
