"""The picture of a surface: near points hide those behind them."""

import io
from dataclasses import replace

import matplotlib
import numpy as np
from matplotlib.image import imread

from polysight.report import surface_figure
from polysight.report.figures import find_point_permittivities
from polysight.surfaces import Segment, Surface


def make_surface() -> Surface:
    """A disc of permittivity 6 in front of a table of permittivity 2; the points of the table come last."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60)))
    is_near = np.hypot(x, y) < 0.05
    x = np.concatenate([x, x[is_near]])
    y = np.concatenate([y, y[is_near]])
    z = np.full(x.size, 0.7)
    z[is_near.size :] = 0.5
    number = (z == 0.5).astype(int)
    x = x[::-1]
    y = y[::-1]
    z = z[::-1]
    number = number[::-1]
    count = x.size
    medium = (2.0 + 0j, 6.0 + 0j)
    segments = tuple(
        Segment(
            number=index,
            points=10,
            centre_m=(0, 0, 0.6),
            normal=(0, 0, -1),
            radius_mm=None,
            incidence_deg=50.0,
            permittivity=eps,
            covariance=((0.1, 0.0), (0.0, 0.1)),
        )
        for index, eps in enumerate(medium)
    )
    return Surface(
        scan_id="drawn",
        simulated=True,
        points_m=np.stack([x, y, z], axis=1),
        normals=np.tile([0.0, 0.0, -1.0], (count, 1)),
        curvature=np.zeros((count, 2, 2)),
        incidence_deg=np.full(count, 50.0),
        permittivity=np.array(medium)[number],
        covariance=np.zeros((count, 2, 2)),
        position_std_m=np.zeros(count),
        normal_std_deg=np.zeros(count),
        segment=number,
        segments=segments,
    )


def count_pixels(surface: Surface, value: float) -> int:
    """Pixels of the view from the rig (its left third) in the colour map's colour of `value`."""
    pixels = imread(io.BytesIO(surface_figure(surface)))
    view = pixels[:, : pixels.shape[1] // 3, :3]
    colour = np.array(matplotlib.colormaps["viridis"](value)[:3])
    return int((np.abs(view - colour).max(axis=2) < 0.02).sum())


def test_an_object_hides_the_table_behind_it():
    # Colours span permittivities from 1.8 to 6.2: 5 per cent more than 2 to 6 on either side.
    colour_of_object = (6 - 1.8) / (6.2 - 1.8)
    # Chosen: of a hidden object only few pixels would be left, at the rims of points.
    assert count_pixels(make_surface(), colour_of_object) > 500


def test_each_point_has_the_permittivity_of_its_own_segment():
    surface = make_surface()
    expected = np.where(surface.segment == 1, 6.0, 2.0)
    assert np.array_equal(find_point_permittivities(surface), expected)
    far, near = surface.segments
    unknown = replace(surface, segments=(far, replace(near, permittivity=None)))
    expected = np.where(surface.segment == 1, np.nan, 2.0)
    assert np.array_equal(find_point_permittivities(unknown), expected, equal_nan=True)
