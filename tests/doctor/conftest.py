"""The simulated rig as processes, once for a module, and a rig file without a rig."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomli_w
from tests.support.doctor.live_rig import SCENE, LiveRig, impatient_rig
from tests.support.processes import LIMIT_S, wait_for

from polysight_shared.tables import to_builtins
from polysight_simulators.loopback import on_free_subnet


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRig]:
    folder = tmp_path_factory.mktemp("d")
    (folder / "base.toml").write_text(tomli_w.dumps(to_builtins(impatient_rig())))
    (folder / "scene.toml").write_text(SCENE)
    command = [sys.executable, "-m", "polysight_simulators.rig", "--config", str(folder / "base.toml"), "--with-pi"]
    command += ["--scene", str(folder / "scene.toml"), "--dir", str(folder / "rig"), "--time-scale", "40"]
    log = folder / "rig.log"
    with log.open("wb") as out:
        rig = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)

    def ready() -> bool:
        assert rig.poll() is None, log.read_text()
        return "ready " in log.read_text()

    try:
        wait_for(ready, "the simulated rig")
        yield LiveRig(folder, folder / "rig" / "instrument.toml")
    finally:
        rig.terminate()
        rig.wait(LIMIT_S)


@pytest.fixture
def unanswered(tmp_path: Path) -> LiveRig:
    """A rig file on a free subnet without any device."""
    path = tmp_path / "instrument.toml"
    path.write_text(tomli_w.dumps(to_builtins(on_free_subnet(impatient_rig()))))
    return LiveRig(tmp_path, path)
