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
from polysight_shared.errors import ConfigError
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import load_scene, simulate

# Time after which the scan counts as hung: many times as long as it takes
LIMIT_S = 200
SIMULATED_RIG = ("python", "-m", "polysight_simulators.rig")
SCENE = 'name = "a plate"\n[[plates]]\nname = "m"\ncentre_mm = [0, 0]\nsize_mm = [60.0, 60.0]\nmetal = true\n'


@pytest.mark.usefixtures("uno_programs")
def test_echoes_of_a_scan_are_those_of_the_planned_positions(tmp_path: Path):
    """The simulated radars compute echoes for the position of the emulated stage.

    They are those of a simulated scan without a stage, whose positions are the planned ones.
    """
    rig = load_published_rig()
    replace = msgspec.structs.replace
    rig = replace(
        rig,
        grid=replace(rig.grid, columns=6, rows=2),
        burst=replace(rig.burst, pulses=4),
        # A small area near the home corner, which the stage reaches soon. The heartbeat is long, as a busy machine must
        # not count as a silent host.
        stage=replace(rig.stage, centre_x_mm=15.0, centre_y_mm=4.0, heartbeat_ms=5000),
    )
    config = tmp_path / "rig.toml"
    scene = tmp_path / "scene.toml"
    config.write_text(tomli_w.dumps(to_builtins(rig)))
    scene.write_text(SCENE)
    with closing(Bench(tmp_path)) as bench:
        # Slower than real time. At 2 the emulated stage falls behind on a busy machine, so that simulated time is as
        # fast as the host's. The host then takes it for real time, and refuses rows whose packets come irregularly.
        rig_options = ("--dir", tmp_path / "rig", "--with-pi", "--uno", "--time-scale", "0.5")
        simulated = bench.start(*SIMULATED_RIG, "--config", config, "--scene", scene, *rig_options)
        options = ("--out", tmp_path / "scan", "--no-process")
        ended = bench.run_polysight("scan", "--config", simulated.wait_ready(), *options, limit_s=LIMIT_S)
        assert ended.status == 0, ended.err
    # The same scan without a stage, at the plan's positions.
    simulate(rig, load_scene(scene), tmp_path / "ideal")
    scan = ScanFolder.load(tmp_path / "scan")
    ideal = ScanFolder.load(tmp_path / "ideal")
    assert sorted(scan.committed_rows()) == [0, 1]
    for board in ("RH", "RV"):
        for row in (0, 1):
            samples = np.fromfile(scan.row_path(board, row), "<i2").astype(float)
            expected = np.fromfile(ideal.row_path(board, row), "<i2").astype(float)
            # There is a signal, in steps of the converter.
            assert expected.std() > 100
            # Positions are exact to 1 um, which changes no sample by more than two steps of the converter.
            assert np.abs(samples - expected).max() <= 2


def test_a_time_scale_is_refused_at_which_the_heartbeat_would_be_lost(tmp_path: Path):
    with closing(Bench(tmp_path)) as bench:
        options = ("--config", RIG_FILE, "--dir", "rig", "--pattern", "--uno", "--time-scale", "5")
        process = bench.run(*SIMULATED_RIG, *options)
    assert process.status == ConfigError.exit_status
    assert "--time-scale 5" in process.err
