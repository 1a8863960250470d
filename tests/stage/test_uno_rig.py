"""A scan with a whole simulated rig whose stage is the sketch's machine code on the emulated UNO."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w

from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.tables import to_builtins
from tests.support.paths import POLYSIGHT, REPO, RIG_FILE
from tests.support.rigs import published_rig

LIMIT_S = 200
SCENE = 'name = "a plate"\n[[plates]]\nname = "m"\ncentre_mm = [0, 0]\nsize_mm = [60.0, 60.0]\nmetal = true\n'


def run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=REPO)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("uno_programs")
def test_a_scan_sees_what_the_stage_truly_did(tmp_path: Path):
    """Every row is committed, and the radars saw the plate from where the plan has the stage, between triggers too."""
    rig = published_rig()
    replace = msgspec.structs.replace
    rig = replace(
        rig,
        grid=replace(rig.grid, columns=6, rows=2),
        burst=replace(rig.burst, pulses=4),
        # The journey there is short, and a busy machine is no silent host.
        stage=replace(rig.stage, centre_x_mm=15.0, centre_y_mm=4.0, heartbeat_ms=5000),
    )
    config, scene = tmp_path / "rig.toml", tmp_path / "scene.toml"
    config.write_text(tomli_w.dumps(to_builtins(rig)))
    scene.write_text(SCENE)
    command = [
        sys.executable,
        "-m",
        "polysight.simulators.rig",
        "--config",
        str(config),
        "--scene",
        str(scene),
        "--with-pi",
    ]
    command += ["--dir", str(tmp_path / "rig"), "--uno", "--time-scale", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPO) as process:
        try:
            assert process.stdout is not None
            simulated = process.stdout.readline().removeprefix("ready ").strip()
            program = str(POLYSIGHT)
            run(program, "scan", "--config", simulated, "--out", str(tmp_path / "scan"), "--no-process")
        finally:
            process.send_signal(signal.SIGTERM)
    # The same scan without a stage, computed for the plan's positions.
    run(
        sys.executable,
        "-m",
        "polysight.simulators",
        "simulate",
        str(scene),
        "--config",
        str(config),
        "--out",
        str(tmp_path / "ideal"),
    )
    scan, ideal = ScanFolder.load(tmp_path / "scan"), ScanFolder.load(tmp_path / "ideal")
    assert sorted(scan.committed()) == [0, 1]
    for board in ("RH", "RV"):
        for row in (0, 1):
            seen = np.fromfile(scan.row_path(board, row), "<i2").astype(float)
            expected = np.fromfile(ideal.row_path(board, row), "<i2").astype(float)
            assert expected.std() > 100
            assert np.abs(seen - expected).max() <= 2  # of the converter's steps: positions are exact to 1 um


def test_a_time_scale_its_heartbeat_cannot_follow_is_refused(tmp_path: Path):
    command = [sys.executable, "-m", "polysight.simulators.rig", "--config", str(RIG_FILE), "--pattern"]
    command += ["--dir", str(tmp_path / "rig"), "--uno", "--time-scale", "5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=REPO)
    assert done.returncode == 2
    assert "--time-scale 5" in done.stderr
