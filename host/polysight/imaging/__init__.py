"""Imaging: from synchronised rows to the H and V images.

`ImageBuilder` reduces each row to the range gate, chooses an imager and returns `Images`, divided by the
footprint (the image of a mirror); `SubBandImages` does the same for parts of the sweep. The three imagers have one
interface (`samples.Imager`): direct sum (`backproject` and its adjoint `project`), spectral, and incremental row by
row. `move_to_plane` estimates the plane of the plates and images on it, `focus_sweep` finds the plane by sharpness,
`correct_tilt` removes the effect of tilted plates, `imaging_facts` measures the point response. `ImagedWith` lists the
settings that the gains of an image depend on.
"""

from polysight.imaging.direct import backproject, project
from polysight.imaging.geometry import (
    Antennas,
    Aperture,
    ImageGrid,
    image_grid,
    row_offsets_m,
    scan_offsets_m,
    window_weights,
)
from polysight.imaging.images import (
    AS_IN_RIG_FILE,
    MAX_RISE,
    TAPERS,
    Dispersion,
    Illumination,
    Image,
    ImageBuilder,
    ImagedWith,
    Images,
    Mask,
    Rise,
    SubBand,
    SubBandImages,
    View,
    correct_tilt,
    find_needed_gate_m,
    illumination_geometry,
    sub_bands,
)
from polysight.imaging.plane import PLANE_REACH_M, UNKNOWN_PLANE, Focus, PlaneEstimate, focus_sweep, move_to_plane
from polysight.imaging.resolution import (
    FieldLimits,
    PhaseSlope,
    PointResponse,
    field_limits,
    imaging_facts,
    point_response,
)
from polysight.imaging.samples import BoardSamples, ReducedRow, reduction, scene_gate_m
from polysight.imaging.sparse import fill_missing, fill_sub_bands

__all__ = [
    "AS_IN_RIG_FILE",
    "MAX_RISE",
    "PLANE_REACH_M",
    "TAPERS",
    "UNKNOWN_PLANE",
    "Antennas",
    "Aperture",
    "BoardSamples",
    "Dispersion",
    "FieldLimits",
    "Focus",
    "Illumination",
    "Image",
    "ImageBuilder",
    "ImageGrid",
    "ImagedWith",
    "Images",
    "Mask",
    "PhaseSlope",
    "PlaneEstimate",
    "PointResponse",
    "ReducedRow",
    "Rise",
    "SubBand",
    "SubBandImages",
    "View",
    "backproject",
    "correct_tilt",
    "field_limits",
    "fill_missing",
    "fill_sub_bands",
    "find_needed_gate_m",
    "focus_sweep",
    "illumination_geometry",
    "image_grid",
    "imaging_facts",
    "move_to_plane",
    "point_response",
    "project",
    "reduction",
    "row_offsets_m",
    "scan_offsets_m",
    "scene_gate_m",
    "sub_bands",
    "window_weights",
]
