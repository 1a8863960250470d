"""Scans are computed by convolutions, which are compared with the sum over facets; the rig is the published one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polysight_worlds import Body, Plate, Rig, Stack, World, load_rig, published_rig, record
from polysight_worlds.optics import Facets, scatter
from polysight_worlds.scan import Surface, make_surface

ROOT = Path(__file__).parents[2]
LAYER = Stack(((4 - 0.4j, 0.003),), 2 - 0.1j)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The published rig on a small grid, at two frequencies."""
    return replace(published_rig(), columns=60, rows=40, frequencies_hz=np.array([76.3e9, 79.7e9]))


def make_facets(surface: Surface, plate: Plate, rig: Rig) -> Facets:
    """One facet for each cell of a surface, at its height and with its slopes."""
    rows, columns = surface.cover.shape
    columns_x_m = surface.x0_m + np.arange(columns) * rig.step_m
    rows_y_m = surface.y0_m + np.arange(rows) * rig.step_m
    x, y = (grid.ravel() for grid in np.meshgrid(columns_x_m, rows_y_m))
    z = rig.plane_m - plate.height_mm / 1000 + surface.height_m.ravel()
    slope_x, slope_y = (np.full(x.shape, slope) for slope in surface.mean_slopes)
    if surface.local_slopes is not None:
        slope_x = slope_x + surface.local_slopes[0].ravel()
        slope_y = slope_y + surface.local_slopes[1].ravel()
    step = np.full(x.shape, rig.step_m)
    flat = np.zeros(x.shape)
    # The product of the first and the second edge is the normal: y by x is -z, on which side the antennas are.
    edge_y = np.stack([flat, step, step * slope_y])
    edge_x = np.stack([step, flat, step * slope_x])
    return Facets(np.stack([x, y, z]), edge_y, edge_x)


@pytest.mark.parametrize(
    ("shape", "error"),
    # Limits of the relative error. A flat and level plate is exact but for rounding, 1.4e-7. Heights and slopes are
    # approximated by the first terms of series, whose error grows with them; V of tilted plates, which is small, has
    # the largest: 0.3 and 7 per cent. The other shapes have 0.03 to 0.4 per cent.
    [
        ({}, 1e-5),
        ({"height_mm": 4.0}, 1e-5),
        ({"tilt_x_deg": 1.5, "tilt_y_deg": -1.0}, 5e-3),
        ({"tilt_x_deg": 8.0, "tilt_y_deg": -5.0}, 8e-2),
        ({"waviness_mm": 0.15}, 1e-2),
        ({"roughness_mm": 0.1}, 3e-2),
        ({"bow_mm": (0.2, -0.1)}, 1e-2),
    ],
)
@pytest.mark.parametrize("channel", ["h", "v"])
def test_convolutions_equal_the_sum_over_facets(rig, shape, error, channel):
    plate = Plate("plate", (0.01, 0.09), (0.050, 0.044), LAYER, **shape)
    rx = getattr(rig, channel)
    data = record(rig, rx, World((plate,)), seed=7)
    # The stream of random numbers from which `record` draws the surface of the first plate with this seed.
    surface = make_surface(plate, rig.step_m, np.random.default_rng([7, 2, 0]))

    # The sum over facets is slow: 12 drawn positions are compared.
    x, y = rig.offsets_m()
    rng = np.random.default_rng(0)
    row = rng.integers(0, rig.rows, 12)
    column = rng.integers(0, rig.columns, 12)
    offsets = np.stack([x[column], y[row], np.zeros(12)], axis=1)
    expected = scatter(rig.tx, rx, make_facets(surface, plate, rig), plate.stack, rig.frequencies_hz, offsets)
    deviation = data[:, row, column].T - expected
    rms_expected = np.sqrt(np.mean(np.abs(expected) ** 2))
    rms_deviation = np.sqrt(np.mean(np.abs(deviation) ** 2))
    assert rms_deviation < error * rms_expected


def test_the_rig_file_is_the_published_rig():
    loaded = load_rig(ROOT / "instrument.toml")
    built = published_rig()
    for name in ("tx", "h", "v"):
        loaded_value = getattr(loaded, name)
        built_value = getattr(built, name)
        # Lengths in the file are rounded to a micrometre.
        assert loaded_value.position == pytest.approx(built_value.position, abs=1e-5)
        assert loaded_value.polarisation == pytest.approx(built_value.polarisation, abs=1e-5)
    # The paper gives 55 degrees; the places of the antennas give 55.02.
    assert loaded.incidence_deg("h") == pytest.approx(55, abs=0.1)
    # Place of the transmit antenna TX2 in the rig's description, which has tenths of a millimetre
    assert loaded.tx.position == pytest.approx([-0.7055, 0.0974, 0.0130], abs=1e-4)


def test_a_rough_surface_has_the_rms_that_was_asked_for():
    plate = Plate("plate", (0, 0), (0.4, 0.4), LAYER, roughness_mm=0.2)
    heights_m = make_surface(plate, 0.002, np.random.default_rng(0)).height_m
    # Neighbouring cells are not independent, so that the rms of one surface varies by some per cent.
    assert np.std(heights_m) == pytest.approx(0.2e-3, rel=0.1)


def test_cells_cover_the_plates_area():
    step_m = 0.002
    # Plates of whole cells, of parts of cells, and a disc.
    for size_m, is_round in (((0.05, 0.044), False), ((0.0473, 0.0391), False), ((0.06, 0.06), True)):
        plate = Plate("plate", (0, 0), size_m, LAYER, round_=is_round)
        # A cell's cover is the part of it that lies on the plate.
        cover = make_surface(plate, step_m, np.random.default_rng(0)).cover
        area_m2 = cover.sum() * step_m**2
        expected_m2 = size_m[0] * size_m[1]
        if is_round:
            expected_m2 *= np.pi / 4
        # Rectangles are exact; the rim of the disc is wrong by 0.05 per cent.
        assert area_m2 == pytest.approx(expected_m2, rel=0.01)


def test_a_body_of_facets_is_the_plate_that_it_copies(rig):
    plate = Plate("plate", (0.01, 0.09), (0.040, 0.030), LAYER)
    facets = make_facets(make_surface(plate, rig.step_m, np.random.default_rng(0)), plate, rig)
    small_rig = replace(rig, columns=9, rows=7)
    of_plate = record(small_rig, small_rig.h, World((plate,)))
    of_body = record(small_rig, small_rig.h, World((), (Body("plate", facets, LAYER),)))
    # Echoes are stored in single precision: they differ by 2e-7.
    assert np.abs(of_plate - of_body).max() < 1e-4 * np.abs(of_plate).max()
