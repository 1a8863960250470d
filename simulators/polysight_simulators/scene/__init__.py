"""Simulate radar data: from a scene file to the frames of the radars, and to whole scans on disk.

`scene_file` defines the scene file (plates, points, shapes, disturbances) and draws the true permittivities and
positions. `shapes` gets the echoes of shapes from an installed package.
`optics` has the reflection of plates and the exact but slow sum of their echo; `field` computes the same echo fast at
every stage position. `radar` (`SimulatedRig`) adds the effects of a board and gives the frames for stage offsets;
`cubes` gives the samples after ideal synchronisation without frames. `simulate` writes a scan, as a scan folder or in
the published data set's layout (`layouts`), with truth.json.
"""

from polysight_simulators.scene.cubes import reference_cube, synced_cube
from polysight_simulators.scene.layouts import AuthorsLayout, OwnLayout, write_cube
from polysight_simulators.scene.optics import reflect_layers, strips
from polysight_simulators.scene.radar import PatternSource, SignalSource, SimulatedRig
from polysight_simulators.scene.scene_file import (
    Disturbances,
    Layer,
    Plate,
    Point,
    Scene,
    apply_scene,
    decode_scene,
    draw_specimens,
    load_scene,
    without_offset,
)
from polysight_simulators.scene.simulated_scan import find_lost_bytes, row_offsets_mm, simulate, truth
