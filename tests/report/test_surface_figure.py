"""The picture of a surface, a cloud of points with permittivities: near points hide those behind them."""

import io
from dataclasses import replace

import matplotlib
import numpy as np
from matplotlib.image import imread

from polysight.report import surface_figure
from polysight.report.figures import find_point_permittivities
from polysight.surfaces import Segment, Surface


def make_surface() -> Surface:
    """A disc of permittivity 6 in front of a table of permittivity 2.

    The points of the table come last: drawn in this order, they would hide the disc.
    """
    axis_m = np.linspace(-0.1, 0.1, 60)
    grid_x, grid_y = np.meshgrid(axis_m, axis_m)
    table_m = np.column_stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, 0.7)])
    disc_m = table_m[np.hypot(table_m[:, 0], table_m[:, 1]) < 0.05]
    disc_m[:, 2] = 0.5
    points_m = np.concatenate([disc_m, table_m])
    # The number of each point's segment: 0 is the table, 1 the disc.
    number = np.repeat([1, 0], [len(disc_m), len(table_m)])
    count = len(points_m)
    permittivities = (2.0 + 0j, 6.0 + 0j)
    segments = []
    for index, permittivity in enumerate(permittivities):
        segment = Segment(
            number=index,
            points=10,
            centre_m=(0, 0, 0.6),
            normal=(0, 0, -1),
            radius_mm=None,
            incidence_deg=50.0,
            permittivity=permittivity,
            covariance=((0.1, 0.0), (0.0, 0.1)),
        )
        segments.append(segment)
    return Surface(
        scan_id="drawn",
        simulated=True,
        points_m=points_m,
        normals=np.tile([0.0, 0.0, -1.0], (count, 1)),
        curvature=np.zeros((count, 2, 2)),
        incidence_deg=np.full(count, 50.0),
        permittivity=np.array(permittivities)[number],
        covariance=np.zeros((count, 2, 2)),
        position_std_m=np.zeros(count),
        normal_std_deg=np.zeros(count),
        segment=number,
        segments=tuple(segments),
    )


def count_pixels(surface: Surface, value: float) -> int:
    """Pixels in the colour that the colour map has for `value` (0 to 1), in the left view, that from the rig."""
    pixels = imread(io.BytesIO(surface_figure(surface)))
    _, width, _ = pixels.shape
    views = 3
    view_from_rig = pixels[:, : width // views, :3]
    red, green, blue, _ = matplotlib.colormaps["viridis"](value)
    differences = np.abs(view_from_rig - np.array([red, green, blue])).max(axis=2)
    # Five of 255 levels.
    return int((differences < 0.02).sum())


def test_an_object_hides_the_table_behind_it():
    # Colours span permittivities from 1.8 to 6.2: 5 per cent more than 2 to 6 on either side.
    colour_of_object = (6 - 1.8) / (6.2 - 1.8)
    # 20,424 pixels have its colour; with the table drawn over it none would have it (both measured).
    assert count_pixels(make_surface(), colour_of_object) > 500


def test_each_point_has_the_permittivity_of_its_own_segment():
    surface = make_surface()
    expected = np.where(surface.segment == 1, 6.0, 2.0)
    assert np.array_equal(find_point_permittivities(surface), expected)
    far, near = surface.segments
    unknown = replace(surface, segments=(far, replace(near, permittivity=None)))
    expected = np.where(surface.segment == 1, np.nan, 2.0)
    assert np.array_equal(find_point_permittivities(unknown), expected, equal_nan=True)
