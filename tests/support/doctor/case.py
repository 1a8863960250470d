"""A rig with programmed start frequencies, contexts for single checks, and simulated frames of a board at rest."""

import functools
from pathlib import Path

import numpy as np

from polysight.calibration.direct_signal import find_direct
from polysight.doctor.context import CheckContext, DoctorOptions, LoadResult, System
from polysight.sync import BoardSetup
from polysight_simulators.scene import SimulatedRig, decode_scene
from tests.support.rigs import make_programmed_rig

# A computer whose disk and receivers count as fast enough, without a measurement.
QUICK = System(
    write_speed=lambda _folder: 200e6,
    measure_receivers=lambda _rig, rates: ([LoadResult(r, r, 9, 0) for r in rates], "any core"),
)
# Frames of a board at rest.
FRAMES = 32
RIG = make_programmed_rig()
SMALL = {
    "name": "s",
    "grid": {"columns": 4, "rows": 2},
    "points": [{"position_mm": [0.0, 0.0], "amplitude": [0.3, 0.0]}],
}


def simulate_frames(board, rig=RIG, **disturbances):
    """Frames of a board at rest, int16 [frame, sample, 2, rx]; simulated."""
    scene = decode_scene({**SMALL, "disturbances": {"if_offset_hz": 0.0, **disturbances}}, "test")
    radar = SimulatedRig(rig, scene)
    return radar.chirps(board, np.zeros(FRAMES), np.zeros(FRAMES)).reshape(FRAMES, -1, 2, 4)


setup_of = functools.cache(lambda board: BoardSetup.from_rig(RIG, RIG.by_name(board)))  # no start frequency changes it


def make_direct_signal(board, rig=RIG, **disturbances):
    """The doctor's finding on the direct path in simulated frames of a board."""
    words = simulate_frames(board, rig, **disturbances)
    return find_direct(rig, rig.by_name(board), words, np.ones(FRAMES, bool), setup_of(board))


def make_context(rig=RIG, out=Path(), system=QUICK, **more):
    """A context for single checks, with the rig loaded already."""
    return CheckContext(DoctorOptions(Path("rig.toml"), out), system, loaded_rig=rig, **more)
