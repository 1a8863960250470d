"""Imaging: from synchronised rows to the H and V images.

`ImageBuilder` reduces each row to the range gate, chooses an imager and returns `Images`, divided by the
footprint (the image of a mirror); `SubBandImages` does the same for parts of the sweep. The three imagers have one
interface (`samples.Imager`): direct sum (`backproject` and its adjoint `project`), spectral, and incremental row by
row. `move_to_plane` estimates the plane of the plates and images on it, `focus_sweep` finds the plane by sharpness,
`correct_tilt` removes the effect of tilted plates, `describe_imaging` measures the point response. `ImagedWith` lists
the settings that the gains of an image depend on.
"""

from polysight.imaging.direct import (
    backproject as backproject,
    project as project,
)
from polysight.imaging.focus import (
    Focus as Focus,
    focus_sweep as focus_sweep,
)
from polysight.imaging.geometry import (
    Antennas as Antennas,
    Aperture as Aperture,
    ImageGrid as ImageGrid,
    find_needed_gate_m as find_needed_gate_m,
    find_scene_gate_m as find_scene_gate_m,
    image_grid as image_grid,
    make_window as make_window,
    row_offsets_m as row_offsets_m,
    scan_offsets_m as scan_offsets_m,
)
from polysight.imaging.images import (
    AS_IN_RIG_FILE as AS_IN_RIG_FILE,
    MAX_RISE as MAX_RISE,
    TAPERS as TAPERS,
    Dispersion as Dispersion,
    Illumination as Illumination,
    Image as Image,
    ImageBuilder as ImageBuilder,
    ImagedWith as ImagedWith,
    Images as Images,
    Mask as Mask,
    Rise as Rise,
    SubBand as SubBand,
    SubBandImages as SubBandImages,
    View as View,
    correct_tilt as correct_tilt,
    illumination_geometry as illumination_geometry,
    sub_bands as sub_bands,
)
from polysight.imaging.plane import (
    PLANE_REACH_M as PLANE_REACH_M,
    UNKNOWN_PLANE as UNKNOWN_PLANE,
    PlaneEstimate as PlaneEstimate,
    move_to_plane as move_to_plane,
)
from polysight.imaging.resolution import (
    FieldLimits as FieldLimits,
    PhaseSlope as PhaseSlope,
    PointResponse as PointResponse,
    compute_field_limits as compute_field_limits,
    compute_point_response as compute_point_response,
    describe_imaging as describe_imaging,
)
from polysight.imaging.samples import (
    BoardSamples as BoardSamples,
    ReducedRow as ReducedRow,
    reduction as reduction,
)
from polysight.imaging.sparse import (
    fill_missing as fill_missing,
    fill_sub_bands as fill_sub_bands,
)
