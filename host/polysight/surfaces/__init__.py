"""Surfaces: shape and permittivity of curved and tilted objects, from the samples of one scan (docs/surfaces.md).

`Samples` are what the pipeline holds of a board after synchronisation. `see_points` finds the specular points in H and
measures the same points in V. `learn_gains` learns the receivers' gains from points of a metal sphere or plate. With
these, `analyse_surface` gives points, normals, curvature, and permittivity with its covariance. `write_surface` and
`read_surface` write and read the files.

Modules, from the samples to the result: `window` (fit of one echo), `joint` (of several), `points` (geometry), `paths`
(search), `measure` (both receivers, segments), `optics` (polarisation, curved reflection), `gains`, `permittivity`,
`result`.
"""

from polysight.surfaces.gains import Gains, find_voltages, learn_gains
from polysight.surfaces.measure import SeenEchoes, find_shape, see_points
from polysight.surfaces.optics import (
    Optics,
    VisibleNormals,
    aim_antenna,
    make_optics,
    mirror_point,
    mix_twisted,
    reflect_curved,
    reflect_flat,
    visible_normals,
)
from polysight.surfaces.permittivity import Reference, Uncertainty
from polysight.surfaces.result import (
    POINTS,
    SURFACE,
    Segment,
    Surface,
    analyse_surface,
    describe_form,
    describe_material,
    join_turned,
    plain_segment,
    read_surface,
    summary_lines,
    write_surface,
)
from polysight.surfaces.window import Echoes, Samples
