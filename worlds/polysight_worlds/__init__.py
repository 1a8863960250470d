"""Images of simulated scenes by vector physical optics: an opinion of its own about what the instrument sees.

`draw_world` and `draw_nuisances` make a scene and what disturbs its scan, `simulate` gives the pair of images. Only
numpy and scipy are used, nothing of the instrument or its simulators, so that tests may compare the two.
"""

from polysight_worlds.images import ImagePair, backproject, simulate
from polysight_worlds.media import COPPER, METAL, Stack, reflect
from polysight_worlds.rig import Rig, load_rig, published_rig
from polysight_worlds.scan import record
from polysight_worlds.world import (
    NUISANCES,
    TABLE_2,
    Body,
    Nuisances,
    Plate,
    World,
    dish,
    draw_nuisances,
    draw_world,
    table,
)

__all__ = [
    "COPPER",
    "METAL",
    "NUISANCES",
    "TABLE_2",
    "Body",
    "ImagePair",
    "Nuisances",
    "Plate",
    "Rig",
    "Stack",
    "World",
    "backproject",
    "dish",
    "draw_nuisances",
    "draw_world",
    "load_rig",
    "published_rig",
    "record",
    "reflect",
    "simulate",
    "table",
]
