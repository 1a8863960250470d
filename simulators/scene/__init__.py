"""From a scene file to what the radars send, and to whole scans on disk.

`scene_file` declares what lies on the object plane, and `specimens` draws how it really is. `optics` says how plates
reflect and sums their echo exactly but slowly; `field` (with `field_grid`, `spectral`) computes the same at every stage
position fast; `receiver` adds what one board does to the signal; `radar` puts them together to frames for given stage
offsets. `cubes` gives the samples after a perfect synchronisation without any frames. `simulated_scan` writes a scan
of frames, in this project's scan folder (`layouts`) or in the published data set's forms (`published_layout`), and
truth.json.
"""

from polysight.simulators.scene.cubes import reference_cube, synced_cube
from polysight.simulators.scene.layouts import OwnLayout
from polysight.simulators.scene.optics import layered, strips
from polysight.simulators.scene.published_layout import (
    AuthorsLayout,
    Errors,
    Material,
    write_cube,
    write_labels,
    write_material,
)
from polysight.simulators.scene.radar import PatternSource, SignalSource, SimulatedRig, pattern_frames
from polysight.simulators.scene.scene_file import (
    Disturbances,
    Layer,
    Plate,
    Point,
    Scene,
    apply_scene,
    decode_scene,
    load_scene,
    without_offset,
)
from polysight.simulators.scene.simulated_scan import lost_bytes, row_offsets_mm, simulate, truth
from polysight.simulators.scene.specimens import draw_specimens

__all__ = [
    "AuthorsLayout",
    "Disturbances",
    "Errors",
    "Layer",
    "Material",
    "OwnLayout",
    "PatternSource",
    "Plate",
    "Point",
    "Scene",
    "SignalSource",
    "SimulatedRig",
    "apply_scene",
    "decode_scene",
    "draw_specimens",
    "layered",
    "load_scene",
    "lost_bytes",
    "pattern_frames",
    "reference_cube",
    "row_offsets_mm",
    "simulate",
    "strips",
    "synced_cube",
    "truth",
    "without_offset",
    "write_cube",
    "write_labels",
    "write_material",
]
