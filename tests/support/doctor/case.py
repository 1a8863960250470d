"""A rig whose start frequencies are programmed, benches for single checks, and simulated frames of a board at rest."""

import functools
from pathlib import Path

import numpy as np

from polysight.host.calibration.direct_signal import find_direct
from polysight.host.doctor.bench import Bench, System, Wanted
from polysight.host.doctor.receiver_load import Held
from polysight.host.sync import BoardSetup
from polysight.simulators.scene import SimulatedRig, decode_scene
from tests.support.rigs import programmed_rig

QUICK = System(
    write_speed=lambda _folder: 200e6, held=lambda _rig, rates: ([Held(r, r, 9, 0) for r in rates], "any core")
)
FRAMES = 32


RIG = programmed_rig()
SMALL = {
    "name": "s",
    "grid": {"columns": 4, "rows": 2},
    "points": [{"position_mm": [0.0, 0.0], "amplitude": [0.3, 0.0]}],
}


def frames_of(board, rig=RIG, **disturbances):
    """Frames of a board at rest, int16 [frame, sample, 2, rx]; simulated."""
    scene = decode_scene({**SMALL, "disturbances": {"if_offset_hz": 0.0, **disturbances}}, "test")
    radar = SimulatedRig(rig, scene)
    return radar.chirps(board, np.zeros(FRAMES), np.zeros(FRAMES)).reshape(FRAMES, -1, 2, 4)


@functools.cache
def setup_of(board):
    """The board's setup, which no start frequency changes."""
    return BoardSetup.of(RIG, RIG.by_name(board))


def signal_of(board, rig=RIG, **disturbances):
    words = frames_of(board, rig, **disturbances)
    return find_direct(rig, rig.by_name(board), words, np.ones(FRAMES, bool), setup_of(board))


def bench_of(rig=RIG, out=Path(), system=QUICK, **more):
    return Bench(Wanted(Path("rig.toml"), out), system, given=rig, **more)
