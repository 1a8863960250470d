"""Echoes of curved and tilted shapes, from an installed package that offers them.

The simulator's own field holds flat plates that are nearly level. Shapes come from another package, found by its entry
point `polysight.shape_echoes`: this project's is `worlds/`, which shares no code with the simulators. It gets plain
tables and arrays; `polysight_worlds.scene_shapes.simulate_echoes` says which.
"""

from importlib.metadata import entry_points
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.tables import to_builtins
from polysight_simulators.scene.scene_file import Scene

# Group of entry points in which a package offers its function.
ENTRY_POINT_GROUP = "polysight.shape_echoes"


def find_echoes(scene: Scene) -> Any:
    """Return the function that computes echoes of shapes. Raises ConfigError if no package offers it."""
    offered = list(entry_points(group=ENTRY_POINT_GROUP))
    if not offered:
        raise ConfigError(
            f"scene {scene.name} has [[shapes]]",
            "the simulator itself has flat plates only, and no installed package computes shapes",
            "run: pip install ./worlds",
            code=ErrorCode.PACKAGE_MISSING,
        )
    return offered[0].load()


def shape_field(
    rig: Instrument,
    scene: Scene,
    board: Board,
    axes_m: tuple[NDArray[np.floating], NDArray[np.floating]],
    nodes_hz: NDArray[np.floating],
    centre_m: NDArray[np.floating],
    path_m: float,
) -> NDArray[np.complex64]:
    """Return echoes of a scene's shapes on a grid of stage offsets, complex64 [y, x, rx, node].

    `axes_m` are the offsets in x and in y, `nodes_hz` the frequencies. The places of shapes in a scene file are
    relative to `centre_m`, the image's centre on the object plane. The phase of the path `path_m` is removed, so that
    the result varies slowly with frequency. Amplitudes are relative to a free path of 1 m.
    """
    x, y = np.meshgrid(*axes_m)
    disturbances = scene.disturbances
    samples = find_echoes(scene)(
        shapes=[to_builtins(shape) for shape in scene.shapes],
        rig=to_builtins(rig),
        role=board.role,
        leakage=(complex(*disturbances.leakage_h), complex(*disturbances.leakage_v)),
        offsets_m=np.stack([x.ravel(), y.ravel()], axis=1),
        frequencies_hz=nodes_hz,
        centre_m=tuple(centre_m.tolist()),
        path_m=path_m,
    )
    # From [rx, node, offset] to [y, x, rx, node].
    receivers, nodes, _ = samples.shape
    on_grid = samples.reshape(receivers, nodes, *x.shape)
    return np.moveaxis(on_grid, (0, 1), (2, 3)).astype(np.complex64)
