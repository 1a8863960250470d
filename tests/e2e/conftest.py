"""A simulated rig of real processes, with the commands of the host and of the Pi run as a user runs them."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from tests.support.processes import Bench
from tests.support.rigs import make_rig_with
from tests.support.simulated_rig import SCENE, Rig, run_simulated_rig

from polysight_shared.config import Instrument
from polysight_simulators.loopback import move_to_free_subnet


@pytest.fixture(scope="session")
def running_rig() -> Callable[..., AbstractContextManager[Rig]]:
    """`with running_rig(folder, ...) as rig:` runs a simulated rig during the block."""
    return run_simulated_rig


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Starts programs in a folder of the test, and ends them after it."""
    new_bench = Bench(tmp_path)
    yield new_bench
    new_bench.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with run_simulated_rig(tmp_path) as new_rig:
        yield new_rig


@pytest.fixture
def rig_without_compiler(tmp_path: Path) -> Iterator[Rig]:
    """A rig whose simulators find no compiler: its stage is the Python stand-in."""
    with run_simulated_rig(tmp_path, env={"PATH": str(tmp_path)}) as new_rig:
        yield new_rig


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def lonely_instrument(tmp_path: Path) -> Instrument:
    """A rig file's content with addresses on a free loopback subnet, without devices."""
    pi = {"journal_dir": str(tmp_path / "journal")}
    stage = {"port": str(tmp_path / "ttyNONE")}
    return move_to_free_subnet(make_rig_with(limits={"command_timeout_s": 0.6}, pi=pi, stage=stage))
