"""Tilted plates: the tilt is estimated from the phase, and corrected images agree with those of level plates."""

import numpy as np
import pytest
from benchmarks.coverage import Cubes
from tests.support.pipelines import make_pipeline

from polysight.imaging import Images, correct_tilt
from polysight.imaging.images import Illumination
from polysight.imaging.plane import find_plane
from polysight.materials.result import SMEAR, STEEP_FINDING, Tilts
from polysight.materials.segment import Segmentation, box_mask, make_patch
from polysight.polarimetry import ratio_from_permittivity
from polysight_simulators.scene import decode_scene

PLACES = [(-60.0, 40.0), (0.0, 40.0), (60.0, 40.0), (-60.0, -40.0), (0.0, -40.0), (60.0, -40.0)]
TILTS_DEG = [(0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-0.7, 0.7), (0.5, -1.0)]


@pytest.fixture(scope="module")
def tilted_images(rig):
    """Images of six plates of one material, each tilted as TILTS_DEG; and of the same six, level."""
    return [_form_images(rig, tilts) for tilts in (TILTS_DEG, [(0.0, 0.0)] * 6)]


def _form_images(rig, tilts, size=None):
    return _make_pipeline(rig, tilts, size).form_images()


def _make_pipeline(rig, tilts, size=None):
    plates = [
        {
            "name": "a",
            "centre_mm": list(place),
            "size_mm": [45.0, 45.0],
            "permittivity": [4.0, 0.4],
            "tilt_deg": list(t),
        }
        for place, t in zip(PLACES, tilts, strict=True)
    ]
    grid = {"columns": 49, "rows": 49, "step_x_mm": 10.0, "step_y_mm": 6.0} | (size or {})
    scene = {"name": "tilts", "object_distance_mm": 499.0, "grid": grid, "plates": plates}
    return make_pipeline(Cubes(rig, decode_scene(scene, "tilts")))


def _make_inside_masks(images):
    return [box_mask((x - 12, y - 12, x + 12, y + 12), images.x_m, images.y_m) for x, y in PLACES]


def _compute_ratios(h, v, masks):
    return np.array([np.median((v[m] / h[m]).real) + 1j * np.median((v[m] / h[m]).imag) for m in masks])


def _turn_polarisation():
    """Change of H and of V / H by each plate's turn of the polarisations: that of a tilted mirror's image."""
    t = np.conj(1 / ratio_from_permittivity(4.0 - 0.4j, np.radians(55.0)))
    d = np.sin(np.radians(55.0)) * np.radians([y for _, y in TILTS_DEG])
    leak = 0.05  # of the rig's channels
    turned_h = (1 - d) - d * t
    turned_v = (1 + d) * t + d
    h = turned_h + leak * turned_v
    v = turned_v + leak * turned_h
    return h / (1 + leak * t), v / h / ((t + leak) / (1 + leak * t))


def test_the_tilt_of_a_patch_is_estimated_from_its_phase(tilted_images):
    images = tilted_images[0]
    rises = [images.illumination.estimate_rise(images.h, images.v, mask) for mask in _make_inside_masks(images)]
    assert np.degrees(rises) == pytest.approx(np.array(TILTS_DEG), abs=0.12)


@pytest.mark.parametrize("grid", [(25, 25), (33, 31)])
def test_plates_at_the_ends_of_a_small_scan_do_not_seem_tilted(rig, grid):
    """A scan that ends close to the plates has more positions on one side of them."""
    columns, rows = grid
    images = _form_images(rig, [(0.0, 0.0)] * 6, {"columns": columns, "rows": rows})
    insides = _make_inside_masks(images)
    plates = [box_mask((x - 22.5, y - 22.5, x + 22.5, y + 22.5), images.x_m, images.y_m) for x, y in PLACES]
    apparent_deg = np.degrees([images.illumination.estimate_rise(images.h, images.v, inside) for inside in insides])
    pairs = zip(insides, plates, strict=True)
    deg = np.degrees([images.illumination.estimate_rise(images.h, images.v, inside, plate) for inside, plate in pairs])
    assert np.abs(apparent_deg).max() > 0.25
    assert np.sqrt(np.mean(deg**2)) < 0.4 * np.sqrt(np.mean(apparent_deg**2))


@pytest.mark.parametrize(("plates", "by_phase"), [(3, False), (4, True), (6, True)])
def test_phases_of_four_plates_which_can_contradict_a_plane_decide_it(rig, plates, by_phase):
    pipeline = _make_pipeline(rig, [(0.0, 0.0)] * 6, {"columns": 25, "rows": 25})
    insides = _make_inside_masks(pipeline.form_images())[:plates]
    plane = find_plane(pipeline.samples.filled, insides)
    assert (plane.plates, plane.by_phase) == (plates, by_phase)
    assert (plane.offset_std_m < 1e-4) is by_phase


def test_a_corrected_tilted_plate_has_the_ratio_and_brightness_of_a_level_one(tilted_images):
    images, level = tilted_images
    masks = _make_inside_masks(images)
    rises = [images.illumination.estimate_rise(images.h, images.v, mask) for mask in masks]
    corrected = correct_tilt(images, masks, rises)
    h_turned, ratio_turned = _turn_polarisation()
    truth = _compute_ratios(level.h, level.v, masks) * ratio_turned
    error_before = np.abs(_compute_ratios(images.h, images.v, masks) / truth - 1)
    error_after = np.abs(_compute_ratios(corrected.h, corrected.v, masks) / truth - 1)
    assert error_before.max() > 0.02
    assert error_after.max() < 0.02  # the turn is a first order in the rise
    brightness = [np.median(np.abs(corrected.h[m])) / np.median(np.abs(level.h[m])) for m in masks] / np.abs(h_turned)
    across = [i for i, (x, _) in enumerate(TILTS_DEG) if x == 0]
    assert np.array(brightness)[across] == pytest.approx(1, abs=0.015)


def test_tilts_follow_a_transposed_image(tilted_images):
    images = tilted_images[0]
    transposed = images.transpose()
    assert (images.illumination.across, transposed.illumination.across) == (1, 0)
    for mask in _make_inside_masks(images):
        rise = images.illumination.estimate_rise(images.h, images.v, mask)
        transposed_rise = transposed.illumination.estimate_rise(transposed.h, transposed.v, mask.T)
        assert transposed_rise[::-1] == pytest.approx(rise, abs=1e-9)
        factors = images.illumination.to_level(mask, rise)
        swapped = transposed.illumination.to_level(mask.T, transposed_rise)
        assert np.sort(swapped, axis=1) == pytest.approx(np.sort(factors, axis=1), rel=1e-6)


def test_noise_gives_no_tilt_and_steep_phases_are_reported():
    rng = np.random.default_rng(1)
    flat = np.ones((2, 40, 40), np.complex64)
    lit = Illumination(flat, np.stack([np.eye(2)] * 2), np.array([1900.0, 1900.0]), (2e-3, 2e-3))
    mask = np.ones((40, 40), bool)
    noise = rng.standard_normal((40, 80)).view(np.complex128)
    assert lit.estimate_rise(noise, noise, mask) == (0.0, 0.0)
    for slope in (0.02, 0.08):
        along = np.exp(-1j * slope * 1900 * 2e-3 * np.arange(40))
        image = np.tile(along, (40, 1)).astype(np.complex128)
        assert lit.estimate_rise(image, image, mask) == pytest.approx((slope, 0.0))


def test_correction_factors_stay_finite_at_the_edge_of_the_illumination():
    footprints = np.ones((2, 20, 20), np.complex64)
    footprints[:, :, 10:] = 0
    lit = Illumination(footprints, np.stack([np.eye(2)] * 2), np.array([1900.0, 1900.0]), (2e-3, 2e-3))
    factors = lit.to_level(np.ones((20, 20), bool), (0.02, 0.0))
    assert np.isfinite(factors).all()
    assert factors.min() > 0.5
    assert factors.max() < 2


@pytest.mark.parametrize(
    ("level_h", "level_v", "row", "refused"),
    [
        (0.05, 0.05, 70, SMEAR),
        (0.3, 0.002, 70, SMEAR),  # of H alone, as by a row that only H's board lacks
        (0.05, 0.05, 40, STEEP_FINDING),  # not at the end of what is illuminated: a curved object is as dim
        (0.5, 0.2, 70, STEEP_FINDING),
    ],
)
def test_a_dim_steep_patch_at_the_end_of_the_scan_is_a_smear(level_h, level_v, row, refused):
    """Positions without data spread plates to the end of the scan, where the footprint's correction lifts them."""
    usable = np.ones((100, 100), bool)
    usable[90:] = False
    axis_m = (np.arange(100) - 49.5) * 2e-3
    plate = np.zeros((100, 100), bool)
    plate[5:23, 30:50] = True
    second_plate = np.zeros((100, 100), bool)
    second_plate[row : row + 18, 30:50] = True
    h, v = (
        (plate + level * second_plate * np.exp(-1j * 0.1 * 1900 * axis_m)).astype(np.complex64)
        for level in (level_h, level_v)
    )
    images = Images(h, v, axis_m, axis_m, usable)
    lit = Illumination(
        np.ones((2, 100, 100), np.complex64), np.stack([np.eye(2)] * 2), np.array([1900.0, 1900.0]), (2e-3, 2e-3)
    )
    patches = tuple(make_patch(i, mask, axis_m, axis_m, 5.0, usable) for i, mask in ((1, plate), (2, second_plate)))
    tilts = Tilts.estimate(images, lit, Segmentation(plate + 2 * second_plate.astype(np.int32), patches))
    assert tilts.refusals() == {2: refused}


@pytest.mark.parametrize("radius_m", [0.1, 0.3, np.inf])
def test_the_curvature_of_a_patch_is_estimated_from_its_phase(radius_m):
    flat = np.ones((2, 24, 24), np.complex64)
    lit = Illumination(flat, np.stack([np.eye(2)] * 2), np.array([1900.0, 1900.0]), (2e-3, 2e-3))
    x_m = (np.arange(24) - 11.5) * 2e-3
    height_m = 0.01 * x_m + x_m**2 / (2 * radius_m)
    noise = np.random.default_rng(1).standard_normal((24, 48)).view(np.complex128)
    image = np.tile(np.exp(-1j * 1900.0 * height_m), (24, 1)) + 0.05 * noise
    along_x, along_y = lit.estimate_bend(image, image, np.ones((24, 24), bool))
    assert along_x == pytest.approx(1 / radius_m, abs=0.2)
    assert along_y == pytest.approx(0.0, abs=0.2)
