"""Images of simulated scenes: plates have their places and Fresnel's ratio, and each nuisance has an effect."""

import json
from dataclasses import replace

import numpy as np
import pytest

from polysight_worlds import METAL, NUISANCES, Plate, Stack, World, draw_nuisances, draw_world, published_rig, simulate
from polysight_worlds.__main__ import main
from polysight_worlds.images import ImagePair

RIG = published_rig()
# A third of the 350 columns, 200 rows and 150 pixels along each axis, about the same middle: a ninth of the work, and
# enough to see that something changes.
SMALL_RIG = replace(RIG, columns=118, rows=66)
SMALL_PIXELS = 50
CENTRE_M = float(RIG.centre_m[0]), float(RIG.centre_m[1])
# A lossy plastic
DIELECTRIC = Stack(below=5 - 1j)

# The amplitude ripples over some wavelengths of 4 mm from the edges of a plate. Pixels farther than this from all edges
# are the inner part of a plate.
EDGE_M = 0.015


def compute_ratio(images: ImagePair, plate: Plate) -> complex:
    """H / V over the inner part of a plate, of sums of the pixels' complex amplitudes."""
    x0, y0, x1, y1 = plate.box_m
    inside_x = (images.x_m > x0 + EDGE_M) & (images.x_m < x1 - EDGE_M)
    inside_y = (images.y_m > y0 + EDGE_M) & (images.y_m < y1 - EDGE_M)
    inside = np.ix_(inside_y, inside_x)
    return images.h[inside].mean() / images.v[inside].mean()


@pytest.fixture(scope="module")
def metal_world() -> World:
    """A metal plate at the middle of the image."""
    return World((Plate("plate", CENTRE_M, (0.06, 0.06), METAL),))


@pytest.fixture(scope="module")
def metal_images(metal_world) -> ImagePair:
    return simulate(metal_world)


@pytest.fixture(scope="module")
def small_images(metal_world) -> ImagePair:
    return simulate(metal_world, None, SMALL_RIG, pixels=SMALL_PIXELS)


def test_a_plate_is_seen_where_it_was_put(metal_images):
    """The edges of a plate are where the amplitude is half of the largest one."""
    x0, y0, x1, y1 = metal_images.world.plates[0].box_m
    is_bright = np.abs(metal_images.h) > 0.5 * np.abs(metal_images.h).max()
    bright_columns = np.flatnonzero(is_bright.any(axis=0))
    bright_rows = np.flatnonzero(is_bright.any(axis=1))
    edges_x_m = metal_images.x_m[bright_columns[[0, -1]]]
    edges_y_m = metal_images.y_m[bright_rows[[0, -1]]]
    # The edges are found within 1.7 mm; the limit is 5 mm, a twelfth of the plate's width.
    assert edges_x_m == pytest.approx([x0, x1], abs=0.005)
    assert edges_y_m == pytest.approx([y0, y1], abs=0.005)


def test_a_dielectric_relative_to_metal_has_the_ratio_of_fresnel(metal_images):
    plate = Plate("plate", CENTRE_M, (0.06, 0.06), DIELECTRIC)
    images = simulate(World((plate,)))
    ratio_of_metal = compute_ratio(metal_images, metal_images.world.plates[0])
    measured = compute_ratio(images, plate) / ratio_of_metal
    # Ripples of the edges leave 0.6 per cent.
    assert measured == pytest.approx(images.plate_ratio(plate), rel=0.01)


@pytest.mark.parametrize("name", [*NUISANCES, "all"])
def test_each_nuisance_changes_the_images_and_is_listed_as_active(name, metal_world, small_images):
    nuisances = draw_nuisances(np.random.default_rng(1), name)
    assert nuisances.active()
    images = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    assert images.h.shape == small_images.h.shape
    assert np.isfinite(images.h).all()
    # Some nuisances change the samples of one board only.
    change_of_h = np.abs(images.h - small_images.h).max() / np.abs(small_images.h).max()
    change_of_v = np.abs(images.v - small_images.v).max() / np.abs(small_images.v).max()
    # Far above rounding errors of complex64, 1e-7, and below the smallest effect of a nuisance, 0.006.
    assert max(change_of_h, change_of_v) > 1e-3


def test_the_same_nuisances_give_the_same_images_again(metal_world):
    nuisances = draw_nuisances(np.random.default_rng(5), "all")
    first = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    second = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    assert np.array_equal(first.h, second.h)


def test_nuisances_drawn_without_a_name_are_all_off():
    assert draw_nuisances(np.random.default_rng(0)).active() == ()


def test_a_drawn_world_has_one_metal_and_the_pieces_asked_for():
    world = draw_world(np.random.default_rng(3), CENTRE_M, with_table=True, pieces=7)
    # The pieces and the table under them.
    assert len(world.plates) == 7 + 1
    assert [plate.name for plate in world.plates if plate.stack.is_metal] == ["copper"]


def test_the_program_writes_images_and_truth(tmp_path):
    main(["--seed", "2", "--nuisances", "tilt", "drift", "--out", str(tmp_path / "scene.npz")])
    with np.load(tmp_path / "scene.npz") as arrays:
        assert arrays["h"].shape == (len(arrays["y_m"]), len(arrays["x_m"]))
        assert arrays["v"].dtype == np.complex64
    truth = json.loads((tmp_path / "scene.json").read_text())
    # "drift" is of the amplitude and of the phase.
    assert set(truth["active"]) == {"tilt_deg", "drift", "drift_deg"}
    # `draw_world` draws nine pieces unless it is told otherwise.
    assert len(truth["plates"]) == 9
    # The file is a label file too: its boxes are in mm from the middle of the picture, which reaches 150 mm to each
    # side.
    assert len(truth["labels"]) == 9
    assert truth["metal"] in truth["labels"]
    edges_mm = [edge for box in truth["labels"].values() for edge in box]
    assert max(abs(edge_mm) for edge_mm in edges_mm) < 150
