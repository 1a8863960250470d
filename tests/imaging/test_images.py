"""Images of points and planes: position, phase, amplitude, flatness, resolution; rows in any order, or masked."""

from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import scipy.signal
from tests.support.refusals import expect_refusal

from polysight.imaging import (
    UNKNOWN_PLANE,
    ImageBuilder,
    Images,
    backproject,
    image_grid,
    move_to_plane,
    plane,
    samples as reduced,
)
from polysight.imaging.geometry import Antennas, find_ends, find_scene_gate_m, row_offsets_m
from polysight.imaging.images import Dispersion
from polysight.imaging.samples import mirror_samples, reduction
from polysight.materials.layers import Spectrum
from polysight.polarimetry import multilayer
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S


def _build(rig, rows, **options):
    """An image builder with the rows of both receivers; `rows(board)` makes those of one."""
    builder = ImageBuilder(rig, **options)
    for board in rig.receivers:
        for index, row in rows(board):
            builder.add_row(board.name, index, row)
    return builder


def _find_peak(image, x_m, y_m):
    """x and y of the strongest pixel, refined by a parabola through its neighbours."""
    amplitude = np.abs(image)
    iy, ix = np.unravel_index(np.argmax(amplitude), amplitude.shape)

    def find_vertex(before_peak, at_peak, after_peak):
        """The parabola's maximum, in pixels from the middle one of the three."""
        return 0.5 * (before_peak - after_peak) / (before_peak - 2 * at_peak + after_peak)

    dx = find_vertex(*amplitude[iy, ix - 1 : ix + 2])
    dy = find_vertex(*amplitude[iy - 1 : iy + 2, ix])
    pixel_m = x_m[1] - x_m[0]
    return x_m[ix] + dx * pixel_m, y_m[iy] + dy * pixel_m


@pytest.mark.parametrize("behind_m", [0.0, 0.004, -0.004])
def test_a_point_on_a_pixel_has_its_phase_and_amplitude_in_both_channels(make_rig, points_rows, behind_m):
    rig = make_rig(columns=41, rows=41)
    grid = image_grid(rig)
    point = np.array([grid.x_m[25], grid.y_m[14], grid.z_m + behind_m])
    amplitude = 0.8 * np.exp(1j)
    images = _build(rig, lambda b: points_rows(rig, b, [point], [amplitude])).finish(behind_m)
    # A percent; errors of up to 6e-5 are measured.
    for raw in (images.h_raw, images.v_raw):
        assert abs(raw[14, 25] / amplitude - 1) < 0.01


def test_resolution_is_that_of_the_aperture(make_rig, points_rows):
    """Without a taper a point is 0.886 lambda h / (2 L cos^3) wide in x and 0.886 lambda h / (2 L cos) in y.

    These are the widths between the -3 dB points, as of a sinc: they follow from the range of sin(theta_tx) +
    sin(theta_rx) over an aperture of length L, at the height h over the plane and the incidence angle of the cosine.
    """
    pixel_mm = 0.5
    rig = make_rig(columns=41, rows=41, pixels=(80, 80), pixel=pixel_mm)
    grid = image_grid(rig)
    point = np.array([grid.x_m[40], grid.y_m[40], grid.z_m])
    raw = np.abs(_build(rig, lambda b: points_rows(rig, b, [point], [1.0]), taper="boxcar").finish().h_raw)
    cut_x = raw[40]
    cut_y = raw[:, 40]
    width_x = (cut_x > cut_x.max() / np.sqrt(2)).sum() * pixel_mm
    width_y = (cut_y > cut_y.max() / np.sqrt(2)).sum() * pixel_mm
    # Incidence angle of RH
    cos = np.cos(np.radians(54.93))
    # 41 positions, 4 mm each
    length_mm = 164.0
    # At 78.6 GHz, the middle of all 256 samples
    wavelength_mm = 3.814
    # The plane is 499 mm from the stage's, the antennas stand some 11 mm before it.
    height_mm = 488.0
    limit_y = 0.886 * wavelength_mm * height_mm / (2 * length_mm * cos)
    limit_x = 0.886 * wavelength_mm * height_mm / (2 * length_mm * cos**3)
    # A width is counted in pixels of 0.5 mm: 0.15 of the narrower one, 8.7 mm, are two or three.
    assert width_y == pytest.approx(limit_y, rel=0.15)
    assert width_x == pytest.approx(limit_x, rel=0.15)


@pytest.fixture
def plane_rows(synced_row):
    """`plane_rows(rig, board, reflectivity, holes)`: rows of a uniform plane.

    Positions (row, i) in `holes` are missing. The direct path has the amplitude of one over its length, as the builder
    assumes, so that all receivers' gains are 1.
    """

    def make(rig, board, reflectivity=1.0, holes=()):
        antennas = Antennas.from_rig(rig, board)
        echo = reflectivity * mirror_samples(antennas, image_grid(rig).z_m, rig.chirp)
        samples = echo + 1 / antennas.direct_m[:, None]
        for row in plan_raster(rig.grid):
            valid = np.array([(row.index, i) not in holes for i in range(row.points)])
            yield row.index, synced_row(np.repeat(samples[:, None], row.points, axis=1), valid)

    return make


@pytest.mark.parametrize("taper", ["hann", "boxcar"])
def test_a_uniform_plane_is_flat_after_division_with_missing_positions(make_rig, plane_rows, taper):
    rig = make_rig(columns=37, rows=31, step_x=6.0)
    # 60 random positions, and the whole row 5
    random_holes = {(int(row), int(i)) for row, i in np.random.default_rng(0).integers(0, 31, (60, 2))}
    holes = random_holes | {(5, i) for i in range(37)}
    images = _build(rig, lambda b: plane_rows(rig, b, 0.5j, holes), taper=taper).finish()
    # Nearly the whole image is compared.
    assert images.valid.mean() > 0.9
    for flat, raw in ((images.h, images.h_raw), (images.v, images.v_raw)):
        # Samples are conjugates of waves, images are not.
        np.testing.assert_allclose(flat[images.valid], np.conj(0.5j), atol=2e-3)
        # Without the division by the footprint it is not flat.
        level = np.abs(raw[images.valid])
        assert level.max() > 1.3 * level.min()


def test_the_image_of_a_sheet_has_its_reflection_coefficient(make_rig, plane_rows):
    """Samples are the conjugate of the wave (+2 pi f tau); images have the sign of Fresnel's coefficients."""
    rig = make_rig(columns=37, rows=31, step_x=6.0)
    chirp = rig.chirp
    sweep_hz = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)

    def reflect_sheet(frequency_hz):
        """r_s of 3 mm of a lossy plastic in air, at 55 degrees."""
        r_s, _ = multilayer([4 - 0.4j, 1.0], [3e-3, np.inf], frequency_hz, np.radians(55))
        return r_s

    images = _build(rig, lambda b: plane_rows(rig, b, reflect_sheet(sweep_hz).conj())).finish()
    spectrum = Spectrum.from_chirp(chirp)
    mean_r_s = (reflect_sheet(spectrum.frequency_hz[0]) * spectrum.weight[0]).sum()
    # A wrong sign would change the imaginary part by 0.27, which is far more than 2 % of the amplitude (0.47).
    assert abs(mean_r_s.imag) > 0.1
    for flat in (images.h, images.v):
        np.testing.assert_allclose(flat[images.valid], mean_r_s, atol=0.02 * abs(mean_r_s))


def test_receiver_gains_are_measured_on_the_direct_path_and_removed(make_rig, points_rows):
    rig = make_rig()
    point = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    # Arbitrary gains, in units of the converter: 800 and differences between the RX
    gains = np.array([1.0, 0.8 * np.exp(0.4j), 1.3 * np.exp(-0.3j), 0.9]) * 800
    equal_gains = _build(rig, lambda b: points_rows(rig, b, [point], [0.7])).finish()
    builder = _build(rig, lambda b: points_rows(rig, b, [point], [0.7], gains=gains))
    np.testing.assert_allclose(builder.rx_calibration("RH"), gains, rtol=1e-3)
    images = builder.finish()
    np.testing.assert_allclose(images.h_raw, equal_gains.h_raw, atol=2e-3 * np.abs(equal_gains.h_raw).max())
    np.testing.assert_allclose(images.v_raw, equal_gains.v_raw, atol=2e-3 * np.abs(equal_gains.v_raw).max())


def test_rows_may_come_in_any_order_and_a_row_added_again_replaces_the_earlier_one(make_rig, points_rows, synced_row):
    rig = make_rig(columns=15, rows=12)
    point = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    board = rig.receivers[0]
    rows = list(points_rows(rig, board, [point], [1.0]))
    forward = ImageBuilder(rig)
    backward = ImageBuilder(rig)
    # A row 3 with other samples, which the true one replaces
    backward.add_row(board.name, 3, synced_row(np.ones_like(rows[3][1].samples)))
    for index, row in rows:
        forward.add_row(board.name, index, row)
    for index, row in reversed(rows):
        backward.add_row(board.name, index, row)
    np.testing.assert_array_equal(forward.finish().h_raw, backward.finish().h_raw)


def test_without_rows_the_image_is_empty(make_rig):
    images = ImageBuilder(make_rig(columns=5, rows=5, pixels=(6, 6))).finish()
    assert not images.valid.any()
    assert not images.h.any()


def test_rows_of_another_plan_are_refused(make_rig, synced_row):
    builder = ImageBuilder(make_rig(columns=7, rows=5))
    row = synced_row(np.zeros((4, 7, 256)))
    # The transmitter has no rows.
    with expect_refusal(ErrorCode.MISMATCH, "LS"):
        builder.add_row("LS", 0, row)
    # The last row is 4.
    with expect_refusal(ErrorCode.MISMATCH, 5, "RH"):
        builder.add_row("RH", 5, row)
    # Six positions instead of seven
    with expect_refusal(ErrorCode.MISMATCH, 6, 7):
        builder.add_row("RH", 0, synced_row(np.zeros((4, 6, 256))))


def test_random_offsets_of_every_chirp_do_not_change_the_image(make_rig, points_rows):
    """Raw chirps with offsets and noise, and a direct path as strong as the echoes, are synchronised and imaged."""
    rig = make_rig(columns=31, rows=25)
    pulses = 3
    rig = msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=pulses))
    rng = np.random.default_rng(6)
    centre = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    points = centre + np.array([[-20, 10, 0], [15, -15, 0], [5, 22, 0]]) / 1e3
    amplitudes = np.array([0.4, 0.4j, -0.3])
    ideal = _build(rig, lambda b: points_rows(rig, b, points, amplitudes, direct=0.0)).finish()

    def disturb(board):
        """Rows whose chirps each have another frequency and phase offset, synchronised as received ones are."""
        setup = BoardSetup.from_rig(rig, board, compensate_filter=False)
        # As received, the RX differ by the lengths of their direct paths.
        steering = setup.path.steering
        n = np.arange(256)
        for index, row in points_rows(rig, board, points, amplitudes):
            clean = row.samples * steering[:, None]
            # Cycles per sample
            frequency_offset = rng.uniform(0.3, 0.45, (31, pulses))
            phase_offset = rng.uniform(-np.pi, np.pi, (31, pulses))
            turned_rad = 2 * np.pi * frequency_offset[..., None] * n + phase_offset[..., None]
            chirps = clean[:, :, None] * np.exp(1j * turned_rad)
            chirps += 0.15 * (rng.standard_normal(chirps.shape) + 1j * rng.standard_normal(chirps.shape))
            received = (800 * chirps).reshape(4, -1, 256).astype(np.complex64)
            no_chirp_lost = np.ones(31 * pulses, bool)
            yield index, synchronise_row(received, no_chirp_lost, setup)

    images = _build(rig, disturb).finish()
    for image, ideal_image in ((images.h_raw, ideal.h_raw), (images.v_raw, ideal.v_raw)):
        # The correlation is 1 for equal images. The noise leaves 0.998 (measured).
        correlation = abs(np.vdot(image, ideal_image)) / np.linalg.norm(image) / np.linalg.norm(ideal_image)
        assert correlation > 0.98


@pytest.mark.parametrize("change", [0.0, 0.2 - 0.3j])
def test_the_dispersion_of_a_plane_is_the_change_of_its_reflectivity_over_the_sweep(make_rig, synced_row, change):
    """A mirror whose reflectivity grows as 1 + change (f - middle) / sweep; the sweep is that of the linear part."""
    rig = make_rig(columns=31, rows=21, step_x=8.0, step_y=8.0, pixels=(12, 10))
    chirp = rig.chirp
    first, end = chirp.linear_samples
    last = end - 1
    # (f - middle) / sweep of each sample: -1/2 to 1/2 over the linear part
    place_in_sweep = (np.arange(chirp.samples) - (first + last) / 2) / (last - first)
    builder = ImageBuilder(rig)
    for board in rig.receivers:
        antennas = Antennas.from_rig(rig, board)
        # Samples are conjugates of fields.
        reflectivity = 1 + np.conj(change) * place_in_sweep
        echo = mirror_samples(antennas, float(np.mean(builder.grid.z_m)), chirp) * reflectivity
        row = np.broadcast_to((1 / antennas.direct_m[:, None] + echo)[:, None], (4, 31, 256))
        for index in range(21):
            builder.add_row(board.name, index, synced_row(np.ascontiguousarray(row, np.complex64)))
    dispersion = builder.form_dispersion()
    valid = builder.finish().valid
    for channel in (dispersion.h, dispersion.v):
        # The window leaves a little of the direct path: 3e-4 is measured.
        np.testing.assert_allclose(channel[valid], change, atol=0.02)
    ends = chirp.first_sample_hz + chirp.hz_per_sample * np.array([first, last])
    np.testing.assert_allclose(dispersion.band_hz, ends)


def _draw_rows(rig, synced_row, rng):
    """(board, index, row) of noise with a direct path, in random order, some rows twice, some positions missing."""
    columns = rig.grid.columns
    order = [(b.name, int(i)) for b in rig.receivers for i in rng.permutation(rig.grid.rows)]
    for name, index in order + order[:5]:
        samples = 1 + 0.5 * (rng.standard_normal((4, columns, 256)) + 1j * rng.standard_normal((4, columns, 256)))
        yield name, index, synced_row(samples, rng.uniform(size=columns) > 0.1)


def test_the_live_image_after_every_row_is_the_image_of_the_rows_so_far(make_rig, synced_row):
    rig = make_rig(columns=15, rows=9, pixels=(16, 14))
    rng = np.random.default_rng(8)
    live = ImageBuilder(rig, live=True)
    plain = ImageBuilder(rig)
    for name, index, row in _draw_rows(rig, synced_row, rng):
        for builder in (live, plain):
            builder.add_row(name, index, row)
        live_images = live.current()
        images = plain.finish()
        pairs = [(live_images.h_raw, images.h_raw), (live_images.v_raw, images.v_raw)]
        pairs += zip(live_images.illumination.footprints, images.illumination.footprints, strict=True)
        for live_image, image in pairs:
            # Rounding errors of the running sums, in single precision. After a few rows an image is weaker than 0.2,
            # but its errors are not smaller.
            assert np.abs(live_image - image).max() <= 2e-5 * max(np.abs(image).max(), 0.2)
    for channel in ("h", "v", "valid"):
        np.testing.assert_array_equal(getattr(live.finish(), channel), getattr(plain.finish(), channel))


def test_a_gate_that_is_applied_in_parts_gives_the_same_image(make_rig, synced_row, monkeypatch):
    """A matrix product of more than `_MAX_PRODUCT` multiplications is computed in parts; with 1 every product is."""
    rig = make_rig(columns=15, rows=9, pixels=(16, 14))
    images = []
    for max_product in (reduced._MAX_PRODUCT, 1):
        monkeypatch.setattr(reduced, "_MAX_PRODUCT", max_product)
        builder = ImageBuilder(rig)
        for name, index, row in _draw_rows(rig, synced_row, np.random.default_rng(8)):
            builder.add_row(name, index, row)
        images.append(builder.finish())
    np.testing.assert_allclose(images[0].h_raw, images[1].h_raw, atol=1e-5 * np.abs(images[1].h_raw).max())


def test_measured_offsets_of_rows_improve_the_focus(make_rig, points_rows):
    """Odd rows are shifted by 1.2 mm, as by backlash: with the true offsets the image is undisturbed."""
    rig = make_rig(columns=101, rows=9, pixels=(16, 9))
    board = rig.receivers[0]
    point = np.array(specular_midpoint_m(rig, board))
    shifts = [1.2e-3 * (row.index % 2) for row in plan_raster(rig.grid)]
    undisturbed = ImageBuilder(rig)
    with_true_offsets = ImageBuilder(rig)
    with_planned_offsets = ImageBuilder(rig)
    for index, row in points_rows(rig, board, [point], [1.0]):
        undisturbed.add_row(board.name, index, row)
    for index, row in points_rows(rig, board, [point], [1.0], shifts_m=shifts):
        with_planned_offsets.add_row(board.name, index, row)
        planned_m = row_offsets_m(rig, plan_raster(rig.grid).row(index))
        with_true_offsets.add_row(board.name, index, row, np.add(planned_m, [shifts[index], 0]))
    ideal_image = undisturbed.finish().h_raw
    peak = np.abs(ideal_image).max()
    error_known = np.abs(with_true_offsets.finish().h_raw - ideal_image).max() / peak
    error_ignored = np.abs(with_planned_offsets.finish().h_raw - ideal_image).max() / peak
    # Measured: 0.4 % of the peak with the true offsets, 4.4 % with the planned ones
    assert error_known < 0.01
    assert error_ignored > 10 * error_known


def test_jittered_positions_are_imaged_exactly_with_a_notice(make_rig, points_rows, caplog):
    rig = make_rig(columns=15, rows=9, pixels=(9, 9))
    board = rig.receivers[0]
    rng = np.random.default_rng(9)
    grid = image_grid(rig)
    middle_point = np.array([grid.x_m[4], grid.y_m[4], grid.z_m])
    # 0.3 mm along each axis: half a radian of a wave of 3.8 mm
    jitter_m = rng.normal(0, 3e-4, (rig.grid.rows, rig.grid.columns, 3))
    with_true_offsets = ImageBuilder(rig, live=True)
    with_planned_offsets = ImageBuilder(rig)
    for index, row in points_rows(rig, board, [middle_point], [1.0], jitter_m=jitter_m):
        with_planned_offsets.add_row(board.name, index, row)
        planned_xy_m = row_offsets_m(rig, plan_raster(rig.grid).row(index))
        planned_xyz_m = np.pad(planned_xy_m, ((0, 0), (0, 1)))
        with_true_offsets.add_row(board.name, index, row, planned_xyz_m + jitter_m[index])
    images = with_true_offsets.finish()
    # Measured: 1.0001 with the true offsets, 0.88 with the planned ones, since the samples do not add up in phase
    assert abs(images.h_raw[4, 4] - 1) < 0.01
    assert abs(with_planned_offsets.finish().h_raw[4, 4]) < 0.95
    assert images.notices
    assert caplog.records
    np.testing.assert_array_equal(with_true_offsets.current().h_raw, images.h_raw)


def test_a_row_far_from_its_planned_position_is_imaged_correctly(make_rig, synced_row):
    """Beyond the range of the running sums the live image is computed from all rows."""
    rig = make_rig(columns=15, rows=9, pixels=(16, 14))
    live = ImageBuilder(rig, live=True)
    for name, index, row in _draw_rows(rig, synced_row, np.random.default_rng(13)):
        planned = row_offsets_m(rig, plan_raster(rig.grid).row(index))
        # Row 3 lies 5 mm farther in x.
        shift_x_m = 5e-3 if index == 3 else 0.0
        live.add_row(name, index, row, np.add(planned, [shift_x_m, 0]))
    np.testing.assert_array_equal(live.current().h_raw, live.finish().h_raw)


def test_a_masked_position_equals_one_that_was_not_scanned(make_rig, synced_row):
    rig = make_rig(columns=15, rows=9, pixels=(16, 14))
    rng = np.random.default_rng(12)
    is_scanned = rng.uniform(size=(9, 15)) > 0.4
    masked = ImageBuilder(rig, live=True)
    not_scanned = ImageBuilder(rig)
    for name, index, row in _draw_rows(rig, synced_row, rng):
        masked.add_row(name, index, row)
        # A row is in the order in which it was scanned; every second one begins at the last column.
        in_scan_order = is_scanned[index][:: plan_raster(rig.grid).row(index).direction]
        not_scanned.add_row(name, index, synced_row(row.samples, row.valid & in_scan_order))
    for board in masked.boards.values():
        board.keep(is_scanned)
    np.testing.assert_array_equal(masked.current().h_raw, not_scanned.finish().h_raw)
    np.testing.assert_array_equal(masked.rx_calibration("RV"), not_scanned.rx_calibration("RV"))


def test_points_anywhere_are_found_within_a_tenth_of_a_pixel_and_their_phase_within_0_05_rad(make_rig, points_rows):
    """The place is the peak on a ten times finer grid (0.2 mm); the phase is that at the true place, its middle."""
    rig = make_rig(columns=61, rows=41, pixels=(60, 50))
    rng = np.random.default_rng(10)
    grid = image_grid(rig)
    for board in rig.receivers:
        for _ in range(3):
            # Not within five pixels of the border
            point = np.array([rng.uniform(*grid.x_m[[5, -6]]), rng.uniform(*grid.y_m[[5, -6]]), grid.z_m])
            amplitude = np.exp(1j * rng.uniform(-np.pi, np.pi))
            samples = _build(rig, lambda b, p=point, a=amplitude: points_rows(rig, b, [p], [a])).boards[board.name]
            fine_m = np.arange(-8, 9) * 2e-4
            fine_grid = replace(grid, x_m=point[0] + fine_m, y_m=point[1] + fine_m, pixel_m=2e-4)
            image, _, _ = samples.image(fine_grid)
            x, y = _find_peak(image, fine_grid.x_m, fine_grid.y_m)
            # Errors of up to 1e-7 m and 2e-5 rad are measured.
            assert np.hypot(x - point[0], y - point[1]) < 0.1 * grid.pixel_m
            assert abs(np.angle(image[8, 8] / amplitude)) < 0.05


def test_the_image_is_the_float64_matched_filter_over_all_samples(make_rig, synced_row):
    """All 192 samples of every chirp summed in double precision, against 9 frequencies in single."""
    rig = make_rig(columns=31, rows=21, step_x=8.0, step_y=8.0, pixels=(12, 10))
    board = rig.receivers[1]
    chirp = rig.chirp
    antennas = Antennas.from_rig(rig, board)
    grid = image_grid(rig)
    plan = plan_raster(rig.grid)
    first, end = chirp.linear_samples
    sweep_hz = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    stage_m = np.stack([np.pad(row_offsets_m(rig, row), ((0, 0), (0, 1))) for row in plan])
    point = np.array([grid.x_m[5], grid.y_m[4], grid.z_m])
    from_tx_m = np.linalg.norm(point - stage_m - antennas.tx_m, axis=-1)
    to_rx_m = np.linalg.norm(point - stage_m - antennas.rx_m[:, None, None], axis=-1)
    # Samples [rx, row, position, sample] have the phase of the path in excess of the direct one.
    excess_m = from_tx_m + to_rx_m - antennas.direct_m[:, None, None]
    echo = np.exp(2j * np.pi * sweep_hz * excess_m[..., None] / SPEED_OF_LIGHT_M_S)
    builder = ImageBuilder(rig, taper="boxcar")
    gate = reduction(chirp, find_scene_gate_m(tuple(Antennas.from_rig(rig, r) for r in rig.receivers), plan, grid))
    # A direct path of 1 / d_rx keeps the receivers' gains at 1; the part of the echo in its estimate is added again.
    echo -= (echo @ gate.direct)[..., None]
    samples = (echo + 1 / antennas.direct_m[:, None, None, None]).astype(np.complex64)
    for row in plan:
        builder.add_row(board.name, row.index, synced_row(samples[:, row.index]))
    image = builder.boards[board.name].image()[0]

    window = scipy.signal.get_window("hann", end - first + 2, fftbins=False)[1:-1]
    window /= window.sum()
    # Nine pixels: at the point, and near and far from it
    pixels = np.stack(np.meshgrid([4, 5, 7], [0, 4, 9]), axis=-1).reshape(-1, 2)
    voxels = np.array([[grid.x_m[i], grid.y_m[j], grid.z_m] for i, j in pixels])
    positions_m = stage_m.reshape(-1, 3)
    matched_filter = np.zeros(len(voxels), complex)
    for rx in range(4):
        all_samples = (echo[rx, ..., first:end] * window).reshape(len(positions_m), -1)
        matched_filter += backproject(
            all_samples,
            frequencies_hz=sweep_hz[first:end],
            tx_m=antennas.tx_m + positions_m,
            rx_m=antennas.rx_m[rx] + positions_m,
            voxels_m=voxels,
            reference_m=np.full(len(positions_m), antennas.direct_m[rx]),
        )
    matched_filter /= 4 * plan.positions
    pixel_values = np.array([image[j, i] for i, j in pixels])
    assert np.abs(pixel_values - matched_filter).max() < 2e-6 * np.abs(matched_filter).max()


@pytest.mark.parametrize(("offset_m", "moved"), [(4e-4, False), (-6e-4, True), (0.0149, True), (0.0151, False)])
@pytest.mark.parametrize("transposed", [False, True])
def test_images_are_formed_again_on_a_plane_that_is_off_and_within_reach(monkeypatch, offset_m, moved, transposed):
    """The plane must be off by 0.5 to 15 mm. The dispersion is on the same plane, and transposed as the images are.

    This builder adds the plane's offset to the pixels, so that they show on which plane they were formed.
    """
    nominal = np.arange(6, dtype=complex).reshape(2, 3)
    x_m = np.arange(3.0)
    y_m = np.arange(2.0)

    def make_images(h):
        return Images(h=h, v=h, x_m=x_m, y_m=y_m, valid=np.ones(h.shape, bool))

    builder = SimpleNamespace(
        finish=lambda offset: make_images(nominal + offset),
        form_dispersion=lambda offset: Dispersion(nominal + offset, nominal, (76e9, 80e9)),
    )
    estimate = replace(UNKNOWN_PLANE, offset_m=offset_m, plates=1)
    monkeypatch.setattr(plane, "find_plane", lambda *_: estimate)
    first = make_images(nominal).transpose() if transposed else make_images(nominal)
    assert move_to_plane(builder, first, [], transposed, move=False) == (estimate, first)
    _, on_plane = move_to_plane(builder, first, [], transposed, move=True)
    expected = nominal + (offset_m if moved else 0.0)
    np.testing.assert_array_equal(on_plane.h, expected.T if transposed else expected)
    np.testing.assert_array_equal(on_plane.dispersion.h, on_plane.h)


class PlatesOfOneReceiver:
    """Replaces `BoardSamples`, the samples of a receiver, in the plane estimate; for plates at given heights.

    The slope of an image is its change with range. That of a plate is the slope at its height, alternating by the
    standard deviation up and down from pixel to pixel. `turns_rad`: phase of a plate's pixels, alternating in sign.
    A mirror on the plane has the image 1 and the slope 0; metal reflects with the factor -1.
    """

    # Change of the relative slope of an echo per metre of its height, 1 / m^2; arbitrary
    SLOPE_PER_M = 40.0

    # Change of the phase of an echo with its height, radians per metre.
    PHASE_PER_M = 2000.0

    def __init__(self, masks, heights_m, stds_m, turns_rad=None) -> None:
        self._ones = np.ones(masks[0].shape, complex)
        self._image = -self._ones
        self._slope = np.zeros(masks[0].shape, complex)
        for k, mask in enumerate(masks):
            # -1, +1, -1, ... over the plate's pixels
            sign = 2 * (np.arange(mask.sum()) % 2) - 1
            if turns_rad is not None:
                self._image[mask] = -np.exp(1j * turns_rad[k] * sign)
            self._slope[mask] = self._image[mask] * self.SLOPE_PER_M * (heights_m[k] + stds_m[k] * sign)

    def image(self):
        return self._image, self._ones, None

    def range_slope(self):
        return self._slope, 0 * self._ones

    def mirror_image(self, step_m):
        return np.exp(1j * self.PHASE_PER_M * step_m) * self._ones

    def mirror_slope(self, step_m):
        return step_m * self.SLOPE_PER_M * self.mirror_image(step_m)


def make_masks(columns):
    """Insides of plates, two in each column, and the grid of their image."""
    masks = np.zeros((2 * columns, 24, 10 * columns), bool)
    for k, mask in enumerate(masks):
        x_px = 10 * (k // 2) + 3
        y_px = 12 * (k % 2) + 4
        mask[y_px : y_px + 4, x_px : x_px + 4] = True
    return masks, SimpleNamespace(x_m=np.arange(10 * columns) * 3e-3, y_m=np.arange(24) * 3e-3, pixel_m=3e-3)


@pytest.mark.parametrize(("coherence", "by_phase"), [(0.71, True), (0.69, False)])
def test_only_plates_of_coherent_pixels_have_a_height_by_phase(coherence, by_phase):
    """By phase all plates lie on the plane; by range the last one is 0.4 mm off, within its error.

    Coherence is |sum| / sum of magnitudes; it must exceed 0.7. Half of the last plate's pixels are turned by +angle,
    half by -angle, so that it is cos(angle).
    """
    masks, grid = make_masks(3)
    heights_m = [0.0, 0.0, 0.0, 0.0, 0.0, 4e-4]
    turns_rad = [0.0] * 5 + [np.arccos(coherence)]
    board = PlatesOfOneReceiver(masks, heights_m, [3e-4] * 6, turns_rad)
    estimate = plane.find_plane(SimpleNamespace(grid=grid, boards={"RH": board}), masks)
    assert estimate.by_phase
    np.testing.assert_allclose(estimate.heights_m, [0.0] * 5 + [0.0 if by_phase else 4e-4], atol=1e-9)


def test_only_plates_whose_range_is_known_to_5_cm_have_a_height(monkeypatch):
    monkeypatch.setattr(plane, "_fit_plane_by_phase", lambda *_: None)
    masks, grid = make_masks(3)
    heights_m = (0.004, 0.004, 0.07, 0.07, 0.07, 0.07)
    cases = (
        ((1e-3, 0.0499, 0.0501, 0.06, 0.06, 0.06), (0, 1)),
        ((0.0501,) * 6, ()),
    )
    for stds_m, known_plates in cases:
        boards = {"RH": PlatesOfOneReceiver(masks, heights_m, stds_m)}
        estimate = plane.find_plane(SimpleNamespace(grid=grid, boards=boards), masks)
        assert np.flatnonzero(np.isfinite(estimate.heights_m)).tolist() == list(known_plates)
        assert estimate.plates == len(known_plates)
        assert estimate.known is bool(known_plates)
        np.testing.assert_allclose(estimate.heights_m[list(known_plates)], 0.004)


# 40 scenes of ten plates of random thickness
RANDOM_HEIGHTS_M = np.random.default_rng(3).uniform(0, 6e-3, (40, 10))


@pytest.mark.parametrize("tilt_rad", [0.0, 0.03])
def test_plates_of_any_heights_are_on_a_plane_that_is_tilted_as_the_plates_are(monkeypatch, tilt_rad):
    """The heights of level plates of several thicknesses fit a tilted plane. Their own tilts show that it is level."""
    monkeypatch.setattr(plane, "_fit_plane_by_phase", lambda *_: None)
    masks, grid = make_masks(5)
    x_m = np.array([grid.x_m[mask.any(axis=0)].mean() for mask in masks])
    truth_rad = (np.arctan(tilt_rad), 0.0)
    errors_deg = {}
    # A rise of exactly 0 means that it is not known.
    seen_rises = [(tilt_rad + 1e-6, 1e-6)] * len(masks)
    for name, own_rises in (("seen", seen_rises), ("unseen", [])):
        tilts_rad = []
        for heights_m in RANDOM_HEIGHTS_M:
            board = PlatesOfOneReceiver(masks, heights_m + tilt_rad * (x_m - x_m.mean()), [3e-4] * len(masks))
            builder = SimpleNamespace(grid=grid, boards={"RH": board})
            tilts_rad.append(plane.find_plane(builder, masks, own_rises).tilt_rad)
        errors_deg[name] = np.sqrt(np.mean(np.degrees(np.array(tilts_rad) - truth_rad) ** 2))
    # Measured: 0.3 degrees with the plates' own tilts, 1.3 degrees without
    assert errors_deg["seen"] < 0.4
    assert errors_deg["unseen"] > 0.6


def test_tilts_of_few_or_differing_plates_determine_the_planes_tilt_poorly():
    prior_of_equal_tilts = plane.TiltPrior.from_plates([(0.01, 0.0), (0.01, 0.0), (0.01, 0.0)])
    # The prior without plates, 0, draws the mean 6 % towards it.
    assert prior_of_equal_tilts.mean[0] == pytest.approx(0.01, rel=0.1)
    # Their tilt along y is not known.
    prior_without_plates = plane.TiltPrior.from_plates([])
    assert prior_of_equal_tilts.mean[1] == 0.0
    assert prior_of_equal_tilts.std[1] == prior_without_plates.std[1]
    # Two plates are too few: their scatter is not known.
    prior_of_two = plane.TiltPrior.from_plates([(0.01, 0.01), (0.01, 0.01)])
    assert (prior_of_two.mean == 0).all()
    # The tilts differ along x, not along y.
    prior_of_unlike_tilts = plane.TiltPrior.from_plates([(-0.04, 0.01), (0.01, 0.01), (0.05, 0.01)])
    assert prior_of_unlike_tilts.std[0] > 2 * prior_of_unlike_tilts.std[1]


@pytest.mark.parametrize("level", [0.1, 1.0, 30.0])
def test_a_plate_ends_where_its_amplitude_falls_to_half_of_that_inside(level):
    pixels = np.arange(60)
    # Half of the level at 31 - 10.75 = 20.25 and at 31 + 10.75 = 41.75; each edge is four pixels wide.
    profile = level * np.clip(0.5 + (10.75 - np.abs(pixels - 31.0)) / 4, 0, 1)
    inside = np.arange(26, 37)
    ends = find_ends(profile, np.ones(60, bool), inside)
    np.testing.assert_allclose(ends, [20.25, 41.75])
    # Where the left edge is not lit, the plate has no end there.
    lit = pixels >= 22
    np.testing.assert_allclose(find_ends(profile, lit, inside), [-np.inf, 41.75])
