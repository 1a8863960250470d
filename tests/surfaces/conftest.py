"""Simulated scans of solids, in the form that the surface estimator takes.

The echoes are those of `polysight_worlds`, which shares no code with the estimator.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from polysight.surfaces import Optics, Samples, SeenEchoes, aim_antenna, find_voltages, learn_gains, see_points
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_worlds.rig import published_boards
from polysight_worlds.shape_scenes import ShapeNuisances, reference_sphere, scan_offsets, scan_shapes
from polysight_worlds.shapes import Shape

# Specular points are searched where the path from TX over the point to RX is within these limits. A mirror on the
# object plane has a path of 1.7 m.
GATE_M = (1.5, 1.85)
# Fewer frequencies than in a scan, for speed. With steps of 433 MHz, paths repeat every c / 433 MHz = 0.7 m, which is
# wider than the limits above.
FREQUENCIES_HZ = np.linspace(76.282e9, 79.749e9, 9)

# Positions of a scan, 2 mm apart: 158 x 110 mm, less than the published scan, for speed.
COLUMNS = 80
ROWS = 56
See = Callable[..., SeenEchoes]


def make_nominal_optics() -> Optics:
    """Return the places and polarisations of the published rig's antennas in the estimator's form."""
    boards = published_boards()
    middle = {name: np.mean([rx.position for rx in rxs], axis=0) for name, rxs in boards.receivers().items()}
    tx_m = boards.tx.position
    # Distance of the object plane
    plane_m = 0.499
    # Parts of s and p: TX sends both with half of the power each, H receives s, V receives p.
    half = float(np.sqrt(0.5))
    return Optics(
        tx=aim_antenna(tx_m, boards.tx.boresight, middle["h"], plane_m, (half, half)),
        h=aim_antenna(middle["h"], boards.h[0].boresight, tx_m, plane_m, (1.0, 0.0)),
        v=aim_antenna(middle["v"], boards.v[0].boresight, tx_m, plane_m, (0.0, 1.0)),
        wave_number=2 * np.pi * float(FREQUENCIES_HZ.mean()) / SPEED_OF_LIGHT_M_S,
    )


def scan_on_grid(
    shapes: Sequence[Shape], columns: int = COLUMNS, rows: int = ROWS, noise: float = 1.0
) -> tuple[Samples, Samples]:
    """Return the samples of H and V of a scan of shapes; `noise` is relative to the published rig's."""
    offsets = scan_offsets(columns, rows)
    cubes = scan_shapes(shapes, offsets, ShapeNuisances(noise=noise), frequencies_hz=FREQUENCIES_HZ)
    boards = published_boards()
    both_samples = []
    for name, rxs in boards.receivers().items():
        places = np.array([rx.position for rx in rxs])
        valid = np.ones(offsets.shape[:2], bool)
        both_samples.append(Samples(cubes[name], valid, offsets, FREQUENCIES_HZ, boards.tx.position, places))
    return both_samples[0], both_samples[1]


@pytest.fixture(scope="session")
def optics() -> Optics:
    return make_nominal_optics()


@pytest.fixture(scope="session")
def see(optics) -> See:
    """`see(shapes, columns, rows, noise)`: the specular points that a scan of shapes shows."""

    def see_shapes(shapes: Sequence[Shape], columns: int = COLUMNS, rows: int = ROWS, noise: float = 1.0) -> SeenEchoes:
        return see_points(*scan_on_grid(shapes, columns, rows, noise), optics, GATE_M)

    return see_shapes


@pytest.fixture(scope="session")
def metal(see):
    """Points of the reference sphere, metal with a radius of 125 mm.

    Its scan is larger than those of the tests, so that it shows all directions that occur in them.
    """
    return see([reference_sphere()], columns=COLUMNS + 10, rows=ROWS + 10)


@pytest.fixture(scope="session")
def gains(metal):
    """`gains(rig)`: the gains that the metal sphere shows for a rig."""

    def learn(rig: Optics):
        return learn_gains(find_voltages(metal, rig), rig.wave_number)

    return learn
