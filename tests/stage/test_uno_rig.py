"""A scan with a whole simulated rig whose stage is the sketch's machine code on the emulated UNO."""

from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.processes import Bench
from tests.support.rigs import load_published_rig

from polysight.store.scan_folder import ScanFolder
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import load_scene, simulate

LIMIT_S = 200
SIMULATED_RIG = ("python", "-m", "polysight_simulators.rig")
SCENE = 'name = "a plate"\n[[plates]]\nname = "m"\ncentre_mm = [0, 0]\nsize_mm = [60.0, 60.0]\nmetal = true\n'


@pytest.mark.usefixtures("uno_programs")
def test_a_scan_sees_what_the_stage_truly_did(tmp_path: Path):
    """Every row is committed, and the radars measured the plate from the planned positions, also between triggers."""
    rig = load_published_rig()
    replace = msgspec.structs.replace
    rig = replace(
        rig,
        grid=replace(rig.grid, columns=6, rows=2),
        burst=replace(rig.burst, pulses=4),
        # The travel there is short, and a busy machine must not count as a silent host.
        stage=replace(rig.stage, centre_x_mm=15.0, centre_y_mm=4.0, heartbeat_ms=5000),
    )
    config = tmp_path / "rig.toml"
    scene = tmp_path / "scene.toml"
    config.write_text(tomli_w.dumps(to_builtins(rig)))
    scene.write_text(SCENE)
    with closing(Bench(tmp_path)) as bench:
        rig_options = ("--dir", tmp_path / "rig", "--with-pi", "--uno", "--time-scale", "2")
        simulated = bench.start(*SIMULATED_RIG, "--config", config, "--scene", scene, *rig_options)
        options = ("--out", tmp_path / "scan", "--no-process")
        ended = bench.run_polysight("scan", "--config", simulated.wait_ready(), *options, limit_s=LIMIT_S)
        assert ended.status == 0, ended.err
    # The same scan without a stage, at the plan's positions
    simulate(rig, load_scene(scene), tmp_path / "ideal")
    scan = ScanFolder.load(tmp_path / "scan")
    ideal = ScanFolder.load(tmp_path / "ideal")
    assert sorted(scan.committed_rows()) == [0, 1]
    for board in ("RH", "RV"):
        for row in (0, 1):
            samples = np.fromfile(scan.row_path(board, row), "<i2").astype(float)
            expected = np.fromfile(ideal.row_path(board, row), "<i2").astype(float)
            assert expected.std() > 100
            assert np.abs(samples - expected).max() <= 2  # of the converter's steps: positions are exact to 1 um


def test_a_time_scale_its_heartbeat_cannot_follow_is_refused(tmp_path: Path):
    with closing(Bench(tmp_path)) as bench:
        options = ("--config", RIG_FILE, "--dir", "rig", "--pattern", "--uno", "--time-scale", "5")
        process = bench.run(*SIMULATED_RIG, *options)
    assert process.status == 2
    assert "--time-scale 5" in process.err
