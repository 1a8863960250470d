"""The tilt of a plate is estimated from the phase of its image; corrected images agree with those of level plates.

A *rise* is the tangent of a tilt, along x and along y.
"""

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

# Growth of the phase along a plate with a rise of 1, radians per metre; about as on the published rig
PHASE_RAD_PER_M = 1900.0
# Centres of six plates in millimetres, and their tilts along x and y.
PLACES = [(-60.0, 40.0), (0.0, 40.0), (60.0, 40.0), (-60.0, -40.0), (0.0, -40.0), (60.0, -40.0)]
TILTS_DEG = [(0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-0.7, 0.7), (0.5, -1.0)]


@pytest.fixture(scope="module")
def tilted_images(rig):
    """Images of six plates of one material, each tilted as TILTS_DEG, and of the same six plates level."""
    tilted = _form_images(rig, TILTS_DEG)
    level = _form_images(rig, [(0.0, 0.0)] * 6)
    return tilted, level


def _form_images(rig, tilts, size=None):
    return _make_pipeline(rig, tilts, size).form_images()


def _make_pipeline(rig, tilts, size=None):
    """Return the pipeline of a scan of the plates with these tilts; `size` changes fields of the scan's grid."""
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
    """Return the pixels of each plate within 12 mm of its middle along x and y. The plates are 45 mm wide."""
    return [box_mask((x - 12, y - 12, x + 12, y + 12), images.x_m, images.y_m) for x, y in PLACES]


def _compute_ratios(h, v, masks):
    """Return the median V / H of each mask."""
    return np.array([np.median((v[m] / h[m]).real) + 1j * np.median((v[m] / h[m]).imag) for m in masks])


def _turn_polarisation():
    """Return the factors by which a tilt across the plane of incidence changes H and V / H of each plate.

    Such a tilt turns the plane of incidence, and with it the polarisations: each channel gets some of the other.
    """
    t = np.conj(1 / ratio_from_permittivity(4.0 - 0.4j, np.radians(55.0)))
    turn_rad = np.sin(np.radians(55.0)) * np.radians([tilt_y for _, tilt_y in TILTS_DEG])
    # Leakage of the rig's channels
    leakage = 0.05
    turned_h = (1 - turn_rad) - turn_rad * t
    turned_v = (1 + turn_rad) * t + turn_rad
    h = turned_h + leakage * turned_v
    v = turned_v + leakage * turned_h
    level_h = 1 + leakage * t
    level_ratio = (t + leakage) / level_h
    return h / level_h, v / h / level_ratio


def test_the_tilt_of_a_patch_is_estimated_from_its_phase(tilted_images):
    images = tilted_images[0]
    rises = [images.illumination.estimate_rise(images.h, images.v, mask) for mask in _make_inside_masks(images)]
    # Tilts are found to about a tenth of a degree, that of the level plate, too.
    assert np.degrees(rises) == pytest.approx(np.array(TILTS_DEG), abs=0.12)


@pytest.mark.parametrize("grid", [(25, 25), (33, 31)])
def test_plates_at_the_ends_of_a_small_scan_do_not_seem_tilted(rig, grid):
    """A scan that ends close to a plate has more positions on one side of it than on the other."""
    columns, rows = grid
    images = _form_images(rig, [(0.0, 0.0)] * 6, {"columns": columns, "rows": rows})
    apparent_rises = []
    rises = []
    for (x, y), inside in zip(PLACES, _make_inside_masks(images), strict=True):
        plate = box_mask((x - 22.5, y - 22.5, x + 22.5, y + 22.5), images.x_m, images.y_m)
        apparent_rises.append(images.illumination.estimate_rise(images.h, images.v, inside))
        # With the whole plate its edges are known, and the effect of the end of the scan is removed.
        rises.append(images.illumination.estimate_rise(images.h, images.v, inside, plate))
    apparent_deg = np.degrees(apparent_rises)
    # Level plates seem tilted by up to 0.32 and 0.74 degrees; with their edges known, by 0.05 degrees (rms).
    assert np.abs(apparent_deg).max() > 0.25
    rms_apparent_deg = np.sqrt(np.mean(apparent_deg**2))
    rms_deg = np.sqrt(np.mean(np.degrees(rises) ** 2))
    assert rms_deg < 0.4 * rms_apparent_deg


@pytest.mark.parametrize(("plates", "by_phase"), [(3, False), (4, True), (6, True)])
def test_the_plane_is_measured_by_phases_from_four_plates_on(rig, plates, by_phase):
    # A plane has three unknowns: only a fourth plate can contradict it.
    pipeline = _make_pipeline(rig, [(0.0, 0.0)] * 6, {"columns": 25, "rows": 25})
    insides = _make_inside_masks(pipeline.form_images())[:plates]
    plane = find_plane(pipeline.samples.filled, insides)
    assert plane.plates == plates
    assert plane.by_phase is by_phase
    # Phases give its offset to less than 0.1 mm; without them the error is 0.8 mm.
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
    # Without the correction one plate at least is wrong by more than the limit below.
    assert error_before.max() > 0.02
    # The expected factors are themselves of the first order in the rise.
    assert error_after.max() < 0.02
    brightness = np.array([np.median(np.abs(corrected.h[m])) / np.median(np.abs(level.h[m])) for m in masks])
    brightness = brightness / np.abs(h_turned)
    # A tilt along x changes the incidence angle, and so the brightness.
    tilted_across_only = [i for i, (tilt_x, _) in enumerate(TILTS_DEG) if tilt_x == 0]
    assert brightness[tilted_across_only] == pytest.approx(1, abs=0.015)


def test_tilts_of_a_transposed_image_are_those_of_the_image_with_axes_exchanged(tilted_images):
    images = tilted_images[0]
    transposed = images.transpose()
    # Axis across the plane of incidence
    assert images.illumination.across == 1
    assert transposed.illumination.across == 0
    for mask in _make_inside_masks(images):
        rise = images.illumination.estimate_rise(images.h, images.v, mask)
        transposed_rise = transposed.illumination.estimate_rise(transposed.h, transposed.v, mask.T)
        assert transposed_rise[::-1] == pytest.approx(rise, abs=1e-9)
        factors = images.illumination.to_level(mask, rise)
        swapped = transposed.illumination.to_level(mask.T, transposed_rise)
        assert np.sort(swapped, axis=1) == pytest.approx(np.sort(factors, axis=1), rel=1e-6)


def make_illumination(footprints):
    """Return an illumination with these footprints [2, ny, nx] of both channels and pixels of 2 mm.

    For a rise of 1 the phase grows by PHASE_RAD_PER_M, and specular points move by 1 m.
    """
    moves_m = np.stack([np.eye(2)] * 2)
    phases_rad_per_m = np.array([PHASE_RAD_PER_M, PHASE_RAD_PER_M])
    pixel_m = (2e-3, 2e-3)
    return Illumination(footprints, moves_m, phases_rad_per_m, pixel_m)


def test_noise_gives_no_tilt_and_steep_phases_are_reported():
    rng = np.random.default_rng(1)
    illumination = make_illumination(np.ones((2, 40, 40), np.complex64))
    mask = np.ones((40, 40), bool)
    noise = rng.standard_normal((40, 80)).view(np.complex128)
    assert illumination.estimate_rise(noise, noise, mask) == (0.0, 0.0)
    # Rises of a tilt that is usual, and of one that is too steep
    for slope in (0.02, 0.08):
        along = np.exp(-1j * slope * PHASE_RAD_PER_M * 2e-3 * np.arange(40))
        image = np.tile(along, (40, 1)).astype(np.complex128)
        assert illumination.estimate_rise(image, image, mask) == pytest.approx((slope, 0.0))


def test_correction_factors_stay_finite_at_the_edge_of_the_illumination():
    footprints = np.ones((2, 20, 20), np.complex64)
    footprints[:, :, 10:] = 0
    illumination = make_illumination(footprints)
    factors = illumination.to_level(np.ones((20, 20), bool), (0.02, 0.0))
    assert np.isfinite(factors).all()
    # A division by the dark pixels would give 0 or infinity.
    assert factors.min() > 0.5
    assert factors.max() < 2


@pytest.mark.parametrize(
    ("level_h", "level_v", "row", "refused"),
    [
        (0.05, 0.05, 70, SMEAR),
        # H alone is bright, as by a row that only H's board lacks.
        (0.3, 0.002, 70, SMEAR),
        # The patch is not at the end of the scan: it may be a curved object, which is as dim.
        (0.05, 0.05, 40, STEEP_FINDING),
        (0.5, 0.2, 70, STEEP_FINDING),
    ],
)
def test_a_dim_steep_patch_at_the_end_of_the_scan_is_a_smear(level_h, level_v, row, refused):
    """Positions without data smear plates over the image; at the end of the scan a correction brightens the smear."""
    usable = np.ones((100, 100), bool)
    usable[90:] = False
    axis_m = (np.arange(100) - 49.5) * 2e-3
    plate = np.zeros((100, 100), bool)
    plate[5:23, 30:50] = True
    second_plate = np.zeros((100, 100), bool)
    second_plate[row : row + 18, 30:50] = True
    # The second patch has a rise of 0.1 along x: steeper than any plate's tilt (0.06).
    steep = second_plate * np.exp(-1j * 0.1 * PHASE_RAD_PER_M * axis_m)
    h = (plate + level_h * steep).astype(np.complex64)
    v = (plate + level_v * steep).astype(np.complex64)
    images = Images(h, v, axis_m, axis_m, usable)
    illumination = make_illumination(np.ones((2, 100, 100), np.complex64))
    patches = tuple(make_patch(i, mask, axis_m, axis_m, 5.0, usable) for i, mask in ((1, plate), (2, second_plate)))
    tilts = Tilts.estimate(images, illumination, Segmentation(plate + 2 * second_plate.astype(np.int32), patches))
    assert tilts.refusals() == {2: refused}


@pytest.mark.parametrize("radius_m", [0.1, 0.3, np.inf])
def test_the_curvature_of_a_patch_is_estimated_from_its_phase(radius_m):
    illumination = make_illumination(np.ones((2, 24, 24), np.complex64))
    x_m = (np.arange(24) - 11.5) * 2e-3
    height_m = 0.01 * x_m + x_m**2 / (2 * radius_m)
    noise = np.random.default_rng(1).standard_normal((24, 48)).view(np.complex128)
    image = np.tile(np.exp(-1j * PHASE_RAD_PER_M * height_m), (24, 1)) + 0.05 * noise
    along_x, along_y = illumination.estimate_bend(image, image, np.ones((24, 24), bool))
    # Curvatures, 1 / m, of 10, 3.3 and 0 are told apart with noise of 5 %.
    assert along_x == pytest.approx(1 / radius_m, abs=0.2)
    assert along_y == pytest.approx(0.0, abs=0.2)
