"""The simulated rig as processes, once for a module, and a rig file without a rig."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import tomli_w
from tests.support.doctor.live_rig import SCENE, LiveRig, make_impatient_rig
from tests.support.processes import Bench

from polysight_shared.tables import to_builtins
from polysight_simulators.loopback import move_to_free_subnet


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRig]:
    """A simulated rig that runs, with its Pi."""
    folder = tmp_path_factory.mktemp("d")
    (folder / "base.toml").write_text(tomli_w.dumps(to_builtins(make_impatient_rig())))
    (folder / "scene.toml").write_text(SCENE)
    with closing(Bench(folder)) as bench:
        options = ["--config", "base.toml", "--with-pi", "--scene", "scene.toml"]
        options += ["--dir", str(folder / "rig"), "--time-scale", "40"]
        rig = bench.start("python", "-m", "polysight_simulators.rig", *options)
        rig.wait_ready()
        yield LiveRig(folder, folder / "rig" / "instrument.toml")


@pytest.fixture
def deaf_rig(tmp_path: Path) -> LiveRig:
    """A rig file on a free subnet without any device."""
    path = tmp_path / "instrument.toml"
    path.write_text(tomli_w.dumps(to_builtins(move_to_free_subnet(make_impatient_rig()))))
    return LiveRig(tmp_path, path)
