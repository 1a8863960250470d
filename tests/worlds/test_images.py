"""Images of drawn scenes: what is true stands in them, and each nuisance does something."""

import json
from dataclasses import replace

import numpy as np
import pytest

from polysight_worlds import METAL, NUISANCES, Plate, Stack, World, draw_nuisances, draw_world, published_rig, simulate
from polysight_worlds.__main__ import main
from polysight_worlds.images import ImagePair

RIG = published_rig()
# A ninth of the positions and pixels, about the same middle: enough to see that something changes.
SMALL_RIG = replace(RIG, columns=118, rows=66)
SMALL_PIXELS = 50
CENTRE_M = float(RIG.centre_m[0]), float(RIG.centre_m[1])
DIELECTRIC = Stack(below=5 - 1j)


# Edges of a plate are bright and ripple over some wavelengths of 4 mm: its inner part begins here. Chosen.
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


def test_a_plate_stands_where_it_was_put(metal_images):
    x0, y0, x1, y1 = metal_images.world.plates[0].box_m
    """Its edges, at half of the largest amplitude, are found within 5 mm (chosen)."""
    lit = np.abs(metal_images.h) > 0.5 * np.abs(metal_images.h).max()
    columns = np.flatnonzero(lit.any(axis=0))
    rows = np.flatnonzero(lit.any(axis=1))
    assert metal_images.x_m[columns[[0, -1]]] == pytest.approx([x0, x1], abs=0.005)
    assert metal_images.y_m[rows[[0, -1]]] == pytest.approx([y0, y1], abs=0.005)


def test_a_dielectric_relative_to_metal_has_the_ratio_of_fresnel(metal_images):
    plate = Plate("plate", CENTRE_M, (0.06, 0.06), DIELECTRIC)
    images = simulate(World((plate,)))
    measured = compute_ratio(images, plate) / compute_ratio(metal_images, metal_images.world.plates[0])
    assert measured == pytest.approx(images.plate_ratio(plate), rel=0.01)


@pytest.mark.parametrize("name", [*NUISANCES, "all"])
def test_each_nuisance_changes_the_images_and_is_listed_as_active(name, metal_world, small_images):
    nuisances = draw_nuisances(np.random.default_rng(1), name)
    assert nuisances.active()
    images = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    assert images.h.shape == small_images.h.shape
    assert np.isfinite(images.h).all()
    # Some nuisances change only one of the boards.
    change_of_h = np.abs(images.h - small_images.h).max() / np.abs(small_images.h).max()
    change_of_v = np.abs(images.v - small_images.v).max() / np.abs(small_images.v).max()
    assert max(change_of_h, change_of_v) > 1e-3


def test_a_seed_gives_one_scan(metal_world):
    nuisances = draw_nuisances(np.random.default_rng(5), "all")
    first = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    second = simulate(metal_world, nuisances, SMALL_RIG, pixels=SMALL_PIXELS)
    assert np.array_equal(first.h, second.h)


def test_no_nuisance_is_none():
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
    assert set(truth["active"]) == {"tilt_deg", "drift", "drift_deg"}
    assert len(truth["plates"]) == 9
    # The file is a label file too: its boxes are in mm from the middle of the picture, which reaches 150 mm to each
    # side.
    assert len(truth["labels"]) == 9
    assert truth["metal"] in truth["labels"]
    assert max(abs(edge) for box in truth["labels"].values() for edge in box) < 150
