"""From synchronised rows to the two channel images.

`ImageBuilder` takes rows (range gate and reduction), chooses an imager and returns `ChannelImages`, flattened by the
footprint of a mirror; `SubBandImages` does so for parts of the sweep. Three imagers keep one contract: direct
(`backproject`, and its adjoint `project`), spectral, and row-incremental. `focus_sweep` finds the plane by sharpness,
`imaging_facts` measures the point response.
"""

from polysight.host.imaging.aperture import Aperture
from polysight.host.imaging.direct import backproject, project
from polysight.host.imaging.focus import Focus, focus_sweep
from polysight.host.imaging.gain_conditions import ImagedWith
from polysight.host.imaging.geometry import Antennas, ImageGrid, image_grid, row_offsets_m, scan_offsets_m
from polysight.host.imaging.images import (
    AS_IN_RIG_FILE,
    TAPERS,
    ChannelImages,
    ImageBuilder,
    SubBand,
    SubBandImages,
    View,
    needed_gate_m,
    sub_bands,
)
from polysight.host.imaging.plane import PLANE_REACH_M, UNKNOWN_PLANE, PlaneEstimate, find_plane, on_their_plane
from polysight.host.imaging.reduce import reduction, scene_gate_m
from polysight.host.imaging.resolution import PointResponse, imaging_facts, point_response
from polysight.host.imaging.samples import ReducedRow
from polysight.host.imaging.tilt import Illumination, Rise, levelled
from polysight.host.imaging.window import Window, window_weights

__all__ = [
    "AS_IN_RIG_FILE",
    "PLANE_REACH_M",
    "TAPERS",
    "UNKNOWN_PLANE",
    "Antennas",
    "Aperture",
    "ChannelImages",
    "Focus",
    "Illumination",
    "ImageBuilder",
    "ImageGrid",
    "ImagedWith",
    "PlaneEstimate",
    "PointResponse",
    "ReducedRow",
    "Rise",
    "SubBand",
    "SubBandImages",
    "View",
    "Window",
    "backproject",
    "find_plane",
    "focus_sweep",
    "image_grid",
    "imaging_facts",
    "levelled",
    "needed_gate_m",
    "on_their_plane",
    "point_response",
    "project",
    "reduction",
    "row_offsets_m",
    "scan_offsets_m",
    "scene_gate_m",
    "sub_bands",
    "window_weights",
]
