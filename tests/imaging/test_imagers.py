"""The three imagers give the same image, and each is the adjoint of its forward model."""

from dataclasses import replace

import numpy as np
import pytest

from polysight.imaging import image_grid
from polysight.imaging.direct import DirectImager
from polysight.imaging.geometry import Antennas, Aperture, find_irregularity, find_scene_gate_m, scan_offsets_m
from polysight.imaging.samples import choose_imager, reduction
from polysight.imaging.spectral import KEEP_BYTES, IncrementalImager, SpectralImager, clear_cache, get_cached
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

IMAGERS = [SpectralImager, IncrementalImager, DirectImager]
# Arguments of `aperture`: columns, rows, step in x and in y (mm), pixels, size of a pixel (mm).
GRIDS = [
    # Positions and pixels on one lattice
    (15, 8, 2.0, 2.0, (20, 16), 2.0),
    # A lattice of 1 mm has both
    (9, 8, 5.0, 5.0, (20, 16), 2.0),
    (31, 6, 10.0, 6.0, (30, 9), 2.0),
    # No common lattice in x
    (40, 5, 2.137, 3.0, (20, 16), 2.0),
    # Coarse pixels, fine pixels
    (30, 5, 4.0, 4.0, (10, 8), 4.0),
    (20, 5, 2.0, 2.0, (25, 21), 0.5),
    # One column, one row
    (1, 8, 2.0, 2.0, (9, 7), 2.0),
    (12, 1, 2.0, 2.0, (9, 7), 2.0),
    # As wide as the published scan
    (350, 2, 2.0, 2.0, (150, 2), 2.0),
]


@pytest.fixture
def aperture(make_rig):
    """`aperture(columns, rows, ...)`: positions, pixels and frequencies of a scan; `shifts_m` [row] move rows in x."""

    def make(columns, rows, step_x, step_y, pixels, pixel, shifts_m=None, board=1) -> Aperture:
        rig = make_rig(columns, rows, step_x, step_y, pixels, pixel)
        plan = plan_raster(rig.grid)
        grid = image_grid(rig)
        antennas = Antennas.from_rig(rig, rig.receivers[board])
        offsets = scan_offsets_m(rig)
        if shifts_m is not None:
            offsets[..., 0] += np.asarray(shifts_m)[:, None]
        gate = reduction(rig.chirp, find_scene_gate_m((antennas,), plan, grid))
        return Aperture(antennas, offsets, gate.frequencies_hz, grid)

    return make


def _draw_noise(rng, shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def _draw_samples(aperture, rng):
    """Samples of a point in noise; a tenth of the positions is missing (0)."""
    pixels = np.zeros(aperture.grid.shape, complex)
    pixels[aperture.grid.shape[0] // 3, aperture.grid.shape[1] // 2] = 1j
    samples = DirectImager(aperture).samples(pixels) + 0.3 * _draw_noise(rng, aperture.shape)
    is_scanned = rng.uniform(size=aperture.shape[2:]) > 0.1
    return (samples * is_scanned).astype(np.complex64)


@pytest.mark.parametrize("shifts", ["serpentine", "every row its own"])
@pytest.mark.parametrize("grid", GRIDS)
def test_spectral_and_row_by_row_equal_the_direct_sum(aperture, grid, shifts):
    rng = np.random.default_rng(1)
    if shifts == "serpentine":
        shifts_m = None
    else:
        rows = grid[1]
        shifts_m = rng.uniform(-1e-3, 1e-3, rows)
    a = aperture(*grid, shifts_m=shifts_m)
    samples = _draw_samples(a, rng)
    # The echo of a mirror on the object plane, which is the same at all positions.
    excess_m = a.antennas.mirror_m(a.grid.z_m) - a.antennas.direct_m
    echo = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(excess_m, a.frequencies_hz)).astype(np.complex64)
    weights = rng.uniform(0, 1, a.shape[2:]).astype(np.float32)
    images = [make(a).image(samples) for make in IMAGERS]
    echoes = [make(a).image_constant_echo(echo, weights) for make in IMAGERS]
    # Peak of a point of amplitude 1 in an image of all samples, and in one of the weighted constant echo.
    point_peak = np.prod(a.shape)
    echo_peak = weights.sum() * echo.size
    for (spectral, by_rows, direct), peak in ((images, point_peak), (echoes, echo_peak)):
        # Bounds relative to the peak, for single precision: rounding errors average out less over few positions. Errors
        # of up to 0.8 of the bounds are measured.
        if a.shape[3] > 300:
            bound = 1e-6
        elif a.shape[2] * a.shape[3] > 20:
            bound = 5e-6
        else:
            bound = 4e-5
        assert np.abs(spectral - direct).max() < bound * peak
        assert np.abs(by_rows - direct).max() < bound * peak


@pytest.mark.parametrize("make", IMAGERS)
@pytest.mark.parametrize("grid", GRIDS)
def test_every_imager_is_the_adjoint_of_its_forward_model(aperture, grid, make):
    """<samples(x), y> = <x, image(y)> for any pixels x and samples y."""
    rng = np.random.default_rng(2)
    a = aperture(*grid)
    imager = make(a)
    pixels = _draw_noise(rng, a.grid.shape)
    samples = _draw_noise(rng, a.shape)
    image = imager.image(samples)
    forward = np.vdot(imager.samples(pixels), samples)
    back = np.vdot(pixels, image)
    assert abs(forward - back) < 1e-5 * np.linalg.norm(pixels) * np.linalg.norm(image)


def test_forward_models_agree(aperture):
    rng = np.random.default_rng(3)
    a = aperture(31, 12, 4.0, 4.0, (20, 16), 2.0)
    pixels = _draw_noise(rng, a.grid.shape)
    spectral, by_rows, direct = (make(a).samples(pixels) for make in IMAGERS)
    for samples in (spectral, by_rows):
        assert np.linalg.norm(samples - direct) < 3e-5 * np.linalg.norm(direct)


@pytest.mark.parametrize("make", IMAGERS)
def test_a_common_phase_is_kept(aperture, make):
    a = aperture(15, 8, 4.0, 2.0, (12, 10), 2.0)
    samples = _draw_samples(a, np.random.default_rng(4))
    rotated = make(a).image((samples * np.exp(0.7j)).astype(np.complex64))
    np.testing.assert_allclose(rotated, make(a).image(samples) * np.exp(0.7j), atol=1e-6 * np.abs(rotated).max())


def test_a_row_added_again_replaces_the_earlier_one_in_any_order(aperture):
    rng = np.random.default_rng(5)
    a = aperture(15, 6, 4.0, 4.0, (12, 10), 2.0)
    samples = _draw_samples(a, rng)
    other_samples = _draw_noise(rng, a.shape)
    zero_weights = np.zeros(15, np.float32)
    starts = a.offsets_m[:, 0, 0]
    imager = IncrementalImager(a)
    for r in rng.permutation(6):
        imager.add_row(r, other_samples[:, :, r], zero_weights, starts[r] + 1e-4)
        imager.add_row(r, -other_samples[:, :, r], zero_weights, starts[r] + 1e-4)
        imager.add_row(r, samples[:, :, r], zero_weights, starts[r])
    expected = SpectralImager(a).image(samples)
    assert np.abs(imager.image_of_sum(np.ones(4)) - expected).max() < 1e-5 * np.abs(expected).max()


def test_kernels_computed_again_give_the_same_image(aperture):
    a = aperture(15, 8, 4.0, 2.0, (12, 10), 2.0)
    samples = _draw_samples(a, np.random.default_rng(6))
    warm = SpectralImager(a).image(samples)
    clear_cache()
    np.testing.assert_array_equal(SpectralImager(a).image(samples), warm)


def test_two_imagers_used_alternately_give_the_images_that_each_gives_alone(aperture):
    """Imagers of one geometry share the memory of transforms, the kernels, and the last constant echo."""
    rng = np.random.default_rng(8)
    a = aperture(15, 8, 4.0, 2.0, (12, 10), 2.0)
    samples = [_draw_noise(rng, a.shape) for _ in range(2)]
    echoes = [_draw_noise(rng, a.shape[:2]) for _ in range(2)]
    weights = rng.uniform(0, 1, a.shape[2:]).astype(np.float32)
    alone = []
    for y, echo in zip(samples, echoes, strict=True):
        clear_cache()
        alone.append((SpectralImager(a).image(y.copy()), SpectralImager(a).image_constant_echo(echo, weights)))
    imagers = [SpectralImager(a), SpectralImager(a)]

    def make_both_images(i):
        return imagers[i].image(samples[i]), imagers[i].image_constant_echo(echoes[i], weights)

    # All are made before the first is compared: a later one must not overwrite an earlier one.
    alternating = [make_both_images(i) for i in (0, 1, 0, 1)]
    for i, images in enumerate(alternating):
        np.testing.assert_array_equal(images, alone[i % 2])


def test_another_geometry_gets_other_kernels(aperture):
    rng = np.random.default_rng(7)
    a = aperture(15, 8, 4.0, 2.0, (12, 10), 2.0)
    samples = _draw_noise(rng, a.shape)
    lower = Aperture(a.antennas, a.offsets_m, a.frequencies_hz, replace(a.grid, z_m=a.grid.z_m + 5e-3))
    for geometry in (a, lower):
        spectral = SpectralImager(geometry).image(samples)
        direct = DirectImager(geometry).image(samples)
        assert np.abs(spectral - direct).max() < 3e-5 * np.abs(direct).max()


@pytest.fixture
def small_cache():
    """`ask(key, share)` gets an array that fills this share of the cache; `keys` lists those that had to be made."""
    keys = []

    def ask(key, share):
        # An array of the shape that fills this share, without its memory.
        array = np.broadcast_to(np.complex64(0), (int(share * KEEP_BYTES / 8),))
        return get_cached((key,), lambda: keys.append(key) or array)

    clear_cache()
    yield ask, keys
    clear_cache()


def test_kernels_are_kept_while_they_fit_and_the_least_recently_used_go_first(small_cache):
    ask, keys = small_cache
    for key in "abab":
        ask(key, 0.4)
    assert keys == ["a", "b"]
    # Two arrays of 0.4 fit, three do not: "a" is dropped, which was used before "b".
    ask("c", 0.4)
    ask("b", 0.4)
    ask("a", 0.4)
    assert keys == ["a", "b", "c", "a"]


def test_kernels_larger_than_the_cache_are_kept_alone(small_cache):
    ask, keys = small_cache
    assert ask("a", 1.5).size == ask("a", 1.5).size
    assert keys == ["a"]


# Each makes positions [row, column, axis] irregular by more than the 1 micrometre that is tolerated.
def _shift_x(offsets):
    offsets[2, 3, 0] += 2e-5


def _shift_z(offsets):
    offsets[2, 3, 2] += 2e-5


def _bend_y(offsets):
    offsets[2, :, 1] += np.linspace(0, 1e-4, offsets.shape[1])


def _lose_rows(offsets):
    offsets[3:, :, 1] += 1e-3


@pytest.mark.parametrize("change", [_shift_x, _shift_z, _bend_y, _lose_rows])
def test_irregular_positions_are_imaged_directly_with_a_notice(aperture, change):
    a = aperture(9, 6, 4.0, 4.0, (8, 8), 2.0)
    assert isinstance(choose_imager(a)[0], SpectralImager)
    assert choose_imager(a)[1] is None
    change(a.offsets_m)
    imager, notice = choose_imager(a)
    assert isinstance(imager, DirectImager)
    assert notice


def test_a_micrometre_of_jitter_is_imaged_spectrally(aperture):
    rng = np.random.default_rng(8)
    a = aperture(31, 12, 4.0, 4.0, (12, 10), 2.0)
    a.offsets_m[..., 0] += rng.uniform(-3e-7, 3e-7, a.offsets_m.shape[:2])
    assert find_irregularity(a) is None
    points_on_a_diagonal = np.eye(10, 12)
    samples = DirectImager(a).samples(points_on_a_diagonal)
    image = SpectralImager(a).image(samples)
    exact = DirectImager(a).image(samples)
    # 0.3 micrometres are 5e-4 rad of a wave of 3.8 mm, and differ from position to position.
    assert np.abs(image - exact).max() < 2e-4 * np.abs(exact).max()


def test_a_curved_surface_is_imaged_at_its_position(aperture):
    a = aperture(31, 21, 4.0, 4.0, (11, 11), 2.0)
    # An arbitrary smooth surface: waves of 5 mm
    z_m = a.grid.z_m + 5e-3 * np.sin(np.arange(121).reshape(11, 11) / 9)
    curved = Aperture(a.antennas, a.offsets_m, a.frequencies_hz, replace(a.grid, z_m=z_m))
    imager, notice = choose_imager(curved)
    assert notice
    pixels = np.zeros((11, 11))
    pixels[7, 4] = 1
    image = imager.image(imager.samples(pixels))
    assert np.unravel_index(np.argmax(np.abs(image)), image.shape) == (7, 4)
    # All samples add up in phase.
    assert image[7, 4].real == pytest.approx(np.prod(a.shape))


def test_steps_without_a_common_divisor_are_irregular(make_rig):
    """Rows 2.137 mm apart and pixels of 2 mm."""
    rig = make_rig(columns=5, rows=5, step_y=2.137)
    antennas = Antennas.from_rig(rig, rig.receivers[0])
    aperture = Aperture(antennas, scan_offsets_m(rig), np.array([77e9]), image_grid(rig))
    assert find_irregularity(aperture) is not None
