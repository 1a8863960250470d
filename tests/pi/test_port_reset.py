"""Opening its port resets an UNO (DTR); two commands by hand, one after another, find the stage as it was left."""

from __future__ import annotations

import json
import subprocess
import sys

import msgspec
import pytest

from polysight.simulators import uno
from polysight.simulators.builds import sketch_compiler
from tests.support.paths import REPO, RIG_FILE
from tests.support.pi.program import run

LACKING = {"uno": uno.missing(), "sketch": [] if sketch_compiler() else ["g++"], "python": []}


@pytest.fixture(params=LACKING)
def port(request, tmp_path):
    """The serial port of a simulated stage that resets as an UNO does."""
    if lacking := LACKING[request.param]:
        pytest.skip(f"not this stage without {' '.join(lacking)}: {uno.ENABLING_COMMAND}")
    link = tmp_path / "tty"
    module = "polysight.simulators." + ("uno" if request.param == "uno" else "stage")
    scale = "2" if request.param == "uno" else "10"
    command = [sys.executable, "-m", module, "--config", str(RIG_FILE), "--link", str(link), "--time-scale", scale]
    command += ["--python"] if request.param == "python" else []
    with subprocess.Popen(command, cwd=REPO, stdout=subprocess.PIPE, text=True) as stage:
        assert stage.stdout is not None
        assert stage.stdout.readline().startswith("ready")
        yield str(link)
        stage.terminate()


@pytest.mark.slow
def test_a_jog_after_a_home_is_obeyed(port, write_config, instrument):
    """As programs of their own, as bring-up tells; until another one lets DTR fall when it closes the port."""
    pi = msgspec.structs.replace(instrument.pi, command_address="tcp://127.0.0.1:9")  # no service
    instrument = msgspec.structs.replace(instrument, pi=pi)
    by_hand = ("--config", write_config(instrument), "--stage-port", port, "--json")
    assert json.loads(run("home", *by_hand).stdout) == {"x_mm": 0.0, "y_mm": 0.0}
    assert json.loads(run("jog", *by_hand, "--dx", 10).stdout) == {"x_mm": 10.0, "y_mm": 0.0}
    assert json.loads(run("jog", *by_hand, "--dx", -4, "--dy", 1.5).stdout) == {"x_mm": 6.0, "y_mm": 1.5}
    subprocess.run(["stty", "-F", port, "hupcl"], check=True)
    done = run("jog", *by_hand, "--dx", 1)
    assert done.returncode != 0
    assert "polysight-pi home" in done.stderr
