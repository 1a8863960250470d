"""Opening its port resets an UNO (DTR): yet a command without the service finds the stage where it was left."""

from __future__ import annotations

import json
import subprocess
from contextlib import closing

import msgspec
import pytest
from tests.support.processes import wait_for
from tests.support.stage.processes import StageProcess

from polysight_pi.cli import main
from polysight_simulators.builds import sketch_compiler


@pytest.mark.slow
def test_a_jog_after_a_home_is_obeyed(write_config, instrument, tmp_path, capsys):
    """Until another program lets DTR fall when it closes the port."""
    port = tmp_path / "ttySTAGE"
    pi = msgspec.structs.replace(instrument.pi, command_address="tcp://127.0.0.1:9")  # no service
    arguments = ["--config", str(write_config(msgspec.structs.replace(instrument, pi=pi))), "--stage-port", str(port)]

    def place(*command):
        assert main([*command, *arguments, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    with closing(StageProcess(tmp_path, "pc" if sketch_compiler() else "python", 20.0)):
        assert place("home") == {"x_mm": 0.0, "y_mm": 0.0}
        assert place("jog", "--dx", "10") == {"x_mm": 10.0, "y_mm": 0.0}
        assert place("jog", "--dx", "-4", "--dy", "1.5") == {"x_mm": 6.0, "y_mm": 1.5}
        subprocess.run(["stty", "-F", port, "hupcl"], check=True)
        wait_for(lambda: main(["jog", *arguments, "--dx", "1"]) != 0, "the stage's reset")
        assert "polysight-pi home" in capsys.readouterr().err
