"""A bottle, a pipe and a tilted box on a table: shape and permittivity from one simulated scan (docs/surfaces.md).

Needs the package in worlds/ (pip install ./worlds), which simulates the scan: exact series for the pipe and the metal
sphere, vector physical optics for the rest. One RX a board and every other position, with the noise that the whole
scan's averages have: four to five minutes of CPU.
"""

# %%
from dataclasses import replace
from pathlib import Path

import numpy as np

from polysight.data import find_packaged
from polysight.report import surface_figure
from polysight.surfaces import (
    Samples,
    Uncertainty,
    analyse_surface,
    find_voltages,
    learn_gains,
    make_optics,
    see_points,
    summary_lines,
    write_surface,
)
from polysight_shared.config import load_instrument
from polysight_worlds import (
    ShapeNuisances,
    Stack,
    load_boards,
    published_rig,
    reference_sphere,
    scan_offsets,
    scan_shapes,
)
from polysight_worlds.shape_scenes import FREQUENCIES_HZ
from polysight_worlds.shapes import bottle, cylinder, plate

RIG_FILE = find_packaged(Path("instrument.toml"))
OUT = Path("out/surfaces")
# Paths over the fronts of objects and over the table behind them.
GATE_M = (1.45, 2.2)

# %% The scene: the rig looks down on a table, on which a bottle, a pipe and a box lie side by side in y. The
# simulation knows no shadows and no echoes from one object to another. Lengths are metres: centre, then radius and
# length, or width and height; a stack is layers of (permittivity, thickness) on what lies below.
x, y = map(float, published_rig().centre_m)
glass_wall = Stack(((5.5 - 0.1j, 0.002),), 1.0)
shapes = [
    *bottle("bottle", glass_wall, (x - 0.06, y - 0.13, 0.541), 0.042, 0.16, axis=(1.0, 0.0, 0.0)),
    cylinder("pipe", Stack(below=6.0 - 0.4j), (x, y, 0.56), 0.06, 0.4, axis=(1.0, 0.08, 0.0)),
    plate("box", Stack(below=3.2 - 0.3j), (x, y + 0.15, 0.51), (0.2, 0.16), tilt_deg=(4.0, -5.0)),
    plate("table", Stack(below=2.6 - 0.2j), (x, y, 0.68), (1.6, 1.2), is_soft=True),
]

# %% The rig, with one RX a board.
boards = load_boards(RIG_FILE)
boards = replace(boards, h=boards.h[1:2], v=boards.v[1:2])
optics = make_optics(load_instrument(RIG_FILE))
optics = replace(
    optics,
    h=replace(optics.h, at_m=boards.h[0].position),
    v=replace(optics.v, at_m=boards.v[0].position),
)
offsets_m = scan_offsets(every=2)

valid = np.ones(offsets_m.shape[:2], bool)

# %% Both scans, of a metal sphere and of the scene, with their specular points.
points = {}
for number, (name, scene) in enumerate({"sphere": [reference_sphere()], "scene": shapes}.items(), start=1):
    cubes = scan_shapes(scene, offsets_m, ShapeNuisances(noise=0.25), boards=boards, number=number)
    samples = [
        Samples(cubes[channel], valid, offsets_m, FREQUENCIES_HZ, boards.tx.position, rxs[0].position[None])
        for channel, rxs in boards.receivers().items()
    ]
    points[name] = see_points(samples[0], samples[1], optics, GATE_M)

# %% The sphere gives the gains, for any error of the rig that is tried.
metal = points["sphere"][points["sphere"].segment == 0]
surface = analyse_surface(
    points["scene"],
    optics,
    lambda rig: learn_gains(find_voltages(metal, rig), rig.wave_number),
    uncertainty=Uncertainty(leakage=0.003, axis_rad=0.002, place_m=0.0003),
    scan_id="surfaces",
    simulated=True,
)
write_surface(OUT, surface)
(OUT / "surface.png").write_bytes(surface_figure(surface))
print("\n".join(summary_lines(surface)))
