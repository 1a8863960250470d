"""For single checks of `polysight doctor`: a rig, the context of a check, and simulated frames of a board at rest."""

import functools
from pathlib import Path

import numpy as np

from polysight.calibration.direct_signal import find_direct
from polysight.doctor.context import CheckContext, DoctorOptions, LoadResult, System
from polysight.sync import BoardSetup
from polysight_simulators.scene import SimulatedRig, decode_scene
from tests.support.rigs import make_programmed_rig


def report_no_loss(_rig, rates):
    """Replaces the measurement of the receivers: each rate is reached, and none of nine packets is lost."""
    return [LoadResult(wanted=rate, reached=rate, sent=9, lost=0) for rate in rates], "any core"


# A computer whose disk (200 MB/s) and receivers are fast enough; nothing is measured.
QUICK = System(write_speed=lambda _folder: 200e6, measure_receivers=report_no_loss)
# Number of simulated frames of a board
FRAMES = 32
RIG = make_programmed_rig()
# A scene of one point in front of the middle of a small grid
SMALL = {
    "name": "s",
    "grid": {"columns": 4, "rows": 2},
    "points": [{"position_mm": [0.0, 0.0], "amplitude": [0.3, 0.0]}],
}


def simulate_frames(board, rig=RIG, **disturbances):
    """Simulated frames of a board at rest, int16 [frame, sample, I or Q, RX]; `disturbances` as in a scene file."""
    scene = decode_scene({**SMALL, "disturbances": {"if_offset_hz": 0.0, **disturbances}}, "test")
    radar = SimulatedRig(rig, scene)
    x_mm = np.zeros(FRAMES)
    y_mm = np.zeros(FRAMES)
    return radar.chirps(board, x_mm, y_mm).reshape(FRAMES, -1, 2, 4)


@functools.cache
def make_setup(board):
    """The setup with which a board's direct path is found. It does not depend on the start frequency: made once."""
    return BoardSetup.from_rig(RIG, RIG.by_name(board))


def make_direct_signal(board, rig=RIG, **disturbances):
    """The direct path that the doctor finds in simulated frames of a board."""
    words = simulate_frames(board, rig, **disturbances)
    return find_direct(rig, rig.by_name(board), words, np.ones(FRAMES, bool), make_setup(board))


def make_context(rig=RIG, out=Path(), system=QUICK, **more):
    """A context for single checks, with the rig loaded already."""
    return CheckContext(DoctorOptions(Path("rig.toml"), out), system, loaded_rig=rig, **more)
