"""Images of simulated scenes by vector physical optics: an independent prediction of the instrument's images.

`draw_world` and `draw_nuisances` make a scene and what disturbs its scan, `simulate` gives the pair of images. Curved
and tilted pieces (`sphere`, `cylinder`, `plate`; more in `shapes`) are seen by `record_shapes`: the samples of both
boards after synchronisation, at any stage positions; `Shape.project` gives the place of their surface. `draw_shapes`
and `scan_shapes` draw and disturb such scans. Only numpy and scipy are used, nothing of the instrument or its
simulators, so that tests may compare the two.
"""

from polysight_worlds.images import ImagePair, simulate
from polysight_worlds.media import METAL, Stack, reflect
from polysight_worlds.rig import Boards, Rig, load_boards, load_rig, published_boards, published_rig
from polysight_worlds.scan import record
from polysight_worlds.shape_echoes import record_shapes
from polysight_worlds.shape_scenes import (
    KINDS,
    ShapeNuisances,
    ShapeScene,
    draw_shapes,
    reference_sphere,
    scan_offsets,
    scan_shapes,
)
from polysight_worlds.shapes import Shape, cylinder, plate, sphere
from polysight_worlds.world import NUISANCES, TABLE_2, Body, Plate, World, draw_nuisances, draw_world
