"""The direct path is found in the presence of an equally strong object, with its phase at the Cramer-Rao bound."""

import msgspec
import numpy as np
import pytest

from polysight.sync import loops
from polysight.sync.cubes import CubeForm
from polysight.sync.decimate import FOLD, SEARCH_FFT, whole_blocks
from polysight.sync.direct_path import prepare
from polysight.sync.offsets import half_scale, reference
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

CENTRE = 95.5


@pytest.fixture(scope="session")
def direct_paths(rig):
    return {b.name: prepare(rig, b) for b in rig.receivers}


@pytest.fixture(params=[0, 1], ids=["H", "V"])
def board(request, rig):
    return rig.receivers[request.param]


@pytest.fixture
def run(rig, paths, noise, direct_paths, align_single):
    """`run(board, ...)`: reference positions with random offsets; result, frequency error (Hz), phase error (rad)."""

    def synchronise_drawn_row(
        board, echo=1.0, snr_db=None, positions=150, seed=0, direct=1.0, gain=0.0, drift_hz=0.0, **more
    ):
        rng = np.random.default_rng(seed)
        signal, length = paths(board, positions, echo, rng, **more)
        pure, _ = paths(board, positions, 0.0, rng)
        signal = signal + (direct - 1) * pure
        signal *= ((1 + gain * rng.standard_normal(4)) * np.exp(1j * gain * rng.standard_normal(4)))[:, None]
        n = np.arange(rig.chirp.samples)
        rate = rig.chirp.sample_rate_hz
        df = rng.uniform(0.1, 0.8, positions)
        phase = rng.uniform(-np.pi, np.pi, positions)
        cycles = df[:, None] * (n - CENTRE) + 0.5 * drift_hz / rate / 192 * (n - CENTRE) ** 2
        signal *= np.exp(1j * (2 * np.pi * cycles + phase[:, None]))[:, None]
        if snr_db is not None:
            signal += noise(signal.shape, -snr_db, rng)
        referenced = reference(align_single(signal, np.ones(positions, bool)), direct_paths[board.name], rig.chirp)
        delay = length[0] / SPEED_OF_LIGHT_M_S
        f_error = (referenced.frequency - df - rig.chirp.hz_per_sample * delay + 0.5) % 1 - 0.5
        middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * CENTRE
        turn = np.exp(1j * (np.angle(referenced.amplitude) - phase - 2 * np.pi * middle_hz * delay))
        return referenced, f_error * rate, np.angle(turn / turn.mean())

    return synchronise_drawn_row


def test_without_an_object_it_is_exact(run, board):
    referenced, f, phase = run(board, echo=0.0)
    assert referenced.found.all()
    assert np.abs(f).max() < 0.5
    assert np.abs(phase).max() < 1e-3


@pytest.mark.parametrize(("step_bins", "is_found"), [(0.019, True), (-0.019, True), (0.021, False), (-0.021, False)])
def test_a_tone_whose_frequency_still_steps_by_a_fiftieth_of_a_bin_is_not_found(
    rig, paths, direct_paths, align_single, board, step_bins, is_found
):
    signal, _ = paths(board, 4, 0.0, np.random.default_rng(0))
    first, last = whole_blocks(rig.chirp.linear_samples)

    class Unsettled(loops.NumpyLoops):
        @staticmethod
        def remove(*arguments):
            removed = loops.NumpyLoops.remove(*arguments)
            return removed._replace(step=np.full_like(removed.step, step_bins / (last - first)))

    referenced = reference(align_single(signal, np.ones(4, bool)), direct_paths[board.name], rig.chirp, by=Unsettled)
    assert (referenced.found == is_found).all()
    assert (np.abs(referenced.samples).max() > 0) == is_found


@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
@pytest.mark.parametrize("cycles", [-0.12, 0.05])
def test_a_cube_that_is_mixed_down_may_have_any_if_near_zero(rig, paths, direct_paths, board, cycles, if_mode):
    """The passband of a receiver with complex1x has no negative IF; a cube that another program has mixed down may."""
    signal, _ = paths(board, 6, 0.0, np.random.default_rng(0))
    chirp = msgspec.structs.replace(rig.chirp, if_mode=if_mode)
    cube = (signal * np.exp(2j * np.pi * cycles * np.arange(chirp.samples))).astype(np.complex64)
    turn = np.ones((4, chirp.samples), np.complex64)
    form = CubeForm(False, turn, np.zeros(4, np.complex64), direct_paths[board.name], chirp, "")
    assert form.convert_row(cube.transpose(1, 0, 2), 16).valid.all()


@pytest.mark.parametrize("echo", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("echoes", [1, 9])
def test_the_object_3_to_4_bins_away_does_not_bias_it(run, board, echo, echoes):
    referenced, f, phase = run(board, echo=echo, echoes=echoes)
    assert referenced.found.all()
    assert np.abs(f).max() < 12  # Hz: a thousandth of a bin of the linear samples
    assert phase.std() < 1e-3


@pytest.mark.parametrize(("z_mm", "bins"), [(400, 2.35), (499, 3.56), (620, 5.30)])
def test_the_bias_is_small_for_every_object_distance(rig, align_single, board, z_mm, bins):
    rig = msgspec.structs.replace(rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=z_mm))
    rng = np.random.default_rng(1)
    n = 300
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    direct = np.linalg.norm(rx - tx, axis=1)
    v = np.add(specular_midpoint_m(rig, board), np.column_stack([rng.uniform(-0.05, 0.05, (n, 2)), np.zeros(n)]))
    d = np.linalg.norm(v - tx, axis=1)[:, None] + np.linalg.norm(v[:, None] - rx, axis=2)
    assert (d - direct).mean() * rig.chirp.hz_per_sample * 192 / SPEED_OF_LIGHT_M_S == pytest.approx(bins, abs=0.05)
    f = (rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(256)) / SPEED_OF_LIGHT_M_S
    received = np.exp(2j * np.pi * f * direct[:, None]) + np.exp(
        2j * np.pi * (f * d[..., None] + rng.uniform(size=(n, 1, 1)))
    )
    received *= np.exp(2j * np.pi * 0.3 * np.arange(256))
    referenced = reference(align_single(received, np.ones(n, bool)), prepare(rig, board), rig.chirp)
    true = 0.3 + rig.chirp.hz_per_sample * direct[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    assert np.abs(referenced.frequency - true).max() * rig.chirp.sample_rate_hz < 10
    assert np.angle(referenced.amplitude / referenced.amplitude.mean()).std() < 6e-4


def test_clutter_behind_the_object_hardly_moves_it_and_costs_little_noise(board, direct_paths):
    """Clutter of any direction: its power in the estimate over that of a plain mean; noise over that of one tone."""
    path = direct_paths[board.name]
    rx, blocks = path.folded_steering.shape
    time = (np.arange(blocks) - (blocks - 1) / 2) * FOLD
    paths_m = np.linspace(0.6, 1.4, 400)
    clutter = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(paths_m, path.sweep_hz))
    plain = np.stack([np.ones(blocks), -1j * time / (time**2).mean()]) / (rx * blocks)
    for weights, mean in zip(path.estimator, plain, strict=True):
        by_rx = weights.reshape(rx, blocks)
        passed = (np.abs(clutter @ by_rx.T) ** 2).sum(axis=1).mean()
        assert passed < 0.35 * rx * (np.abs(clutter @ mean) ** 2).mean()
    bounds = np.sqrt([1 / (rx * blocks), 1 / (rx * (time**2).sum())])
    assert (np.linalg.norm(path.estimator, axis=1) < [1.03, 1.09] * bounds).all()


def test_clutter_half_as_strong_0_9_m_behind_it_leaves_its_phase(rig, align_single, board, direct_paths):
    rng = np.random.default_rng(8)
    n = 300
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    direct = np.linalg.norm(rx - tx, axis=1)
    clutter = direct + 0.9 + rng.uniform(-0.04, 0.04, (n, 1))
    f = (rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(256)) / SPEED_OF_LIGHT_M_S
    received = np.exp(2j * np.pi * f * direct[:, None]) + 0.5 * np.exp(
        2j * np.pi * (f * clutter[..., None] + rng.uniform(size=(n, 4, 1)))
    )
    received *= np.exp(2j * np.pi * 0.3 * np.arange(256))
    referenced = reference(align_single(received, np.ones(n, bool)), direct_paths[board.name], rig.chirp)
    true = 0.3 + rig.chirp.hz_per_sample * direct[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    assert np.angle(referenced.amplitude / referenced.amplitude.mean()).std() < 2.5e-3
    assert (referenced.frequency - true).std() * rig.chirp.sample_rate_hz < 50


def test_unequal_receivers_do_not_bias_it_much(run, board):
    referenced, f, phase = run(board, gain=0.2, echoes=5)
    assert referenced.found.all()
    assert f.std() < 25
    assert phase.std() < 2e-3


def test_noise_is_near_the_cramer_rao_bound(run, board):
    referenced, f, phase = run(board, snr_db=16, positions=600)
    power = 10**-1.6
    n = 192
    f_bound = np.sqrt(power / 2 / (4 * n * (n**2 - 1) / 12)) / 2 / np.pi * 2.15e6
    assert referenced.found.all()
    assert f.std() < 1.2 * f_bound
    assert phase.std() < 1.15 * np.sqrt(power / 2 / (4 * n))


def test_two_tones_2_5_bins_apart_at_16_db_cost_little_over_one_tones_bound(rig, noise, align_single, board):
    near = msgspec.structs.replace(rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=412.0))
    rng = np.random.default_rng(4)
    trials = 1500
    tx = np.array(tx_position_m(near))
    rx = np.array(rx_positions_m(near, board))
    v = np.array(specular_midpoint_m(near, board))
    direct = np.linalg.norm(rx - tx, axis=1)
    echo = np.linalg.norm(v - tx) + np.linalg.norm(v - rx, axis=1)
    bins = (echo - direct).mean() * rig.chirp.hz_per_sample * 192 / SPEED_OF_LIGHT_M_S
    assert bins == pytest.approx(2.5, abs=0.05)
    f = (rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(256)) / SPEED_OF_LIGHT_M_S
    between, phase = rng.uniform(size=(2, trials, 1, 1))
    signal = np.exp(2j * np.pi * f * direct[:, None]) + np.exp(2j * np.pi * (f * echo[:, None] + between))
    signal *= np.exp(2j * np.pi * (0.3 * (np.arange(256) - CENTRE) + phase))
    signal += noise(signal.shape, -16, rng)
    referenced = reference(align_single(signal, np.ones(trials, bool)), prepare(near, board), near.chirp)
    error = np.angle(referenced.amplitude) - 2 * np.pi * phase[:, 0, 0]
    error = np.angle(np.exp(1j * error) / np.exp(1j * error).mean())
    assert referenced.found.all()
    assert error.std() < 1.2 * np.sqrt(10**-1.6 / 2 / (4 * 192))


# Tones above and below the direct path by the object's distance, and their strengths relative to it. A stronger peak is
# taken for the direct path, and so is a comparable one below.
@pytest.mark.parametrize(("side", "strength"), [(1, 5.0), (-1, 0.6), (0, 0.0)])
def test_the_second_peak_is_used_where_the_amplitude_is_an_outlier(
    rig, paths, noise, direct_paths, align_single, board, side, strength
):
    """At some positions a tone hides the direct path; its amplitude is known from the row."""
    path = direct_paths[board.name]
    rng = np.random.default_rng(6)
    signal, length = paths(board, 40, 0.0, rng)
    distance = side * np.mean(path.object_bins) / SEARCH_FFT / FOLD
    tone = strength * signal * np.exp(2j * np.pi * distance * np.arange(256))
    is_disturbed = np.arange(40) % 8 == 3
    signal = signal + is_disturbed[:, None, None] * tone + noise(signal.shape, -10, rng)
    signal *= np.exp(2j * np.pi * 0.25 * np.arange(256))
    referenced = reference(align_single(signal, np.ones(40, bool)), path, rig.chirp)
    true = 0.25 + rig.chirp.hz_per_sample * length[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # IF bins; the tone is 3.5 away
    assert np.abs(referenced.frequency - true).max() * 192 < 0.1


def test_a_far_stronger_object_at_some_positions_does_not_hide_the_direct_path(
    rig, paths, direct_paths, align_single, board
):
    signal, _ = paths(board, 40, 0.5, np.random.default_rng(6), spread_m=0.02)
    pure, length = paths(board, 40, 0.0, np.random.default_rng(6))
    strong = np.arange(40) % 8 == 3
    signal = np.where(strong[:, None, None], pure + 8 * (signal - pure), signal)
    signal *= np.exp(2j * np.pi * 0.25 * np.arange(256))
    referenced = reference(align_single(signal, np.ones(40, bool)), direct_paths[board.name], rig.chirp)
    true = 0.25 + rig.chirp.hz_per_sample * length[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # IF bins; the object is 3.5 away
    assert np.abs(referenced.frequency - true).max() * 192 < 0.1


def test_halves_are_scaled_to_the_average_of_their_chirps():
    """Of an odd number of good chirps the first half has one more; both are parts of the average of all."""
    scale = half_scale(np.arange(6))
    np.testing.assert_allclose(scale, [(0, 0), (1, 1), (2, 2), (3 / 2, 3), (2, 2), (5 / 3, 5 / 2)], rtol=1e-6)


def test_the_lower_of_two_peaks_is_used_if_the_object_is_stronger(run, board):
    referenced, f, _ = run(board, echo=1.0, direct=0.5, spread_m=0.05)
    assert referenced.found.all()
    assert np.abs(f).max() < 100


def test_a_slope_difference_of_the_crystals_is_removed(run, board):
    referenced, _, phase = run(board, drift_hz=5.5e3, snr_db=20)
    assert referenced.found.all()
    inside = referenced.samples / 1000
    flat = run(board, drift_hz=0.0, snr_db=20)[0].samples / 1000
    assert np.sqrt((np.abs(inside - flat) ** 2).mean()) < 0.05
    assert phase.std() < 0.01


def test_a_referenced_echo_has_the_positive_phase_of_its_excess_path(rig, paths, direct_paths, align_single, board):
    rng = np.random.default_rng(3)
    only_direct, length = paths(board, 1, 0.0, rng)
    v = np.add(specular_midpoint_m(rig, board), (0.02, -0.03, 0))
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    excess = np.linalg.norm(v - tx) + np.linalg.norm(v - rx, axis=1) - length
    f = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(256)
    echo = 0.8 * np.exp(2j * np.pi * f * (excess + length)[:, None] / SPEED_OF_LIGHT_M_S)
    turn = np.exp(1j * (2 * np.pi * 0.3 * np.arange(256) + 2.0))
    received = ((only_direct[0] + echo) * turn)[None].astype(np.complex64)
    referenced = reference(align_single(received, np.ones(1, bool)), direct_paths[board.name], rig.chirp)
    f = direct_paths[board.name].sweep_hz
    expected = 1 + 0.8 * np.exp(2j * np.pi * f * excess[:, None] / SPEED_OF_LIGHT_M_S)
    np.testing.assert_allclose(referenced.samples[:, 0] / 1000, expected, atol=3e-3)


def check_what_is_left(referenced, path):
    """The other positions have a direct path of that amplitude, but no phase."""
    samples = referenced.samples[:, referenced.found].swapaxes(0, 1)
    remainder = samples.reshape(len(samples), -1) @ path.estimator[0]
    size = np.abs(referenced.amplitude[referenced.found])
    np.testing.assert_allclose(remainder, size, rtol=0, atol=1e-5 * size.max())


@pytest.mark.parametrize("echo", [0.0, 1.0, 2.0])
def test_what_is_left_has_the_direct_path_s_amplitude_and_no_phase(run, direct_paths, board, echo):
    referenced, _, _ = run(board, echo=echo, echoes=9, snr_db=10)
    assert referenced.found.mean() > 0.95
    check_what_is_left(referenced, direct_paths[board.name])


@pytest.mark.parametrize("loop", [None, loops.NumpyLoops])
def test_of_two_tones_that_look_like_direct_path_and_object_the_one_with_the_row_s_amplitude_is_taken(
    rig, paths, noise, direct_paths, align_single, board, loop
):
    """A tone as far below the direct path as the object lies above it: in most positions the second search finds it."""
    rng = np.random.default_rng(4)
    path = direct_paths[board.name]
    signal, _ = paths(board, 60, 0.0, rng)
    signal += noise(signal.shape, -20, rng)
    below = np.mean(path.object_bins) / (256 * 4)
    disturbed = np.arange(5, 60, 7)
    signal[disturbed] += 0.4 * signal[disturbed] * np.exp(-2j * np.pi * below * np.arange(256))
    signal *= np.exp(2j * np.pi * 0.3 * np.arange(256))
    referenced = reference(align_single(signal, np.ones(60, bool)), path, rig.chirp, loop)
    size = np.abs(referenced.amplitude)
    is_usual = np.abs(size / np.median(size) - 1) < 0.1
    assert is_usual[disturbed].sum() > len(disturbed) / 2
    assert np.ptp(referenced.frequency[is_usual]) < below / 10
    check_what_is_left(referenced, path)


def test_noise_alone_and_lost_positions_are_not_found(rig, paths, noise, direct_paths, align_single, board):
    rng = np.random.default_rng(2)
    signal, _ = paths(board, 40, 1.0, rng)
    signal *= np.exp(2j * np.pi * 0.2 * np.arange(256))
    signal[5] = noise(signal[5].shape, -10, rng)
    signal[9] *= 0.05
    usable = np.ones(40, bool)
    usable[20] = False
    referenced = reference(align_single(signal, usable), direct_paths[board.name], rig.chirp)
    assert np.flatnonzero(~referenced.found).tolist() == [5, 9, 20]
    assert not referenced.samples[:, [5, 9, 20]].any()


@pytest.mark.parametrize(("relative", "is_found"), [(0.35, True), (0.25, False)])
def test_a_direct_path_below_three_tenths_of_the_rows_is_lost(
    rig, paths, direct_paths, align_single, board, relative, is_found
):
    signal, _ = paths(board, 40, 0.0, np.random.default_rng(2))
    signal[9] *= relative
    signal *= np.exp(2j * np.pi * 0.2 * np.arange(256))
    referenced = reference(align_single(signal, np.ones(40, bool)), direct_paths[board.name], rig.chirp)
    assert referenced.found[9] == is_found
    assert referenced.found.sum() == 39 + is_found


def test_a_row_of_noise_has_no_direct_path(rig, noise, direct_paths, align_single, board):
    received = noise((400, 4, 256), 0, np.random.default_rng(7)).astype(np.complex64)
    assert not reference(align_single(received, np.ones(400, bool)), direct_paths[board.name], rig.chirp).found.any()


@pytest.mark.parametrize(("snr_db", "least", "most"), [(-17, 0.0, 0.05), (-13.5, 0.1, 0.9), (-10.5, 0.95, 1.0)])
def test_a_direct_path_is_found_from_15_db_over_the_noise_of_its_estimate(run, board, snr_db, least, most):
    """-13.5 dB in a sample of one RX: averaged over 4 RX and 192 samples in a window, 15 dB."""
    referenced, _, _ = run(board, echo=0.0, snr_db=snr_db, positions=300)
    assert least <= referenced.found.mean() <= most


def test_an_if_outside_the_band_is_masked(rig, paths, direct_paths, align_single, board):
    signal, _ = paths(board, 4, 1.0, np.random.default_rng(2))
    base = rig.chirp.hz_per_sample * 1.39 / SPEED_OF_LIGHT_M_S
    signal *= np.exp(2j * np.pi * (np.array([0.2, 0.5, 0.95, 0.7])[:, None] - base) * np.arange(256))[:, None]
    referenced = reference(align_single(signal, np.ones(4, bool)), direct_paths[board.name], rig.chirp)
    assert referenced.found.tolist() == [True, True, False, True]
    two = msgspec.structs.replace(rig.chirp, if_mode="complex2x")
    referenced = reference(align_single(signal, np.ones(4, bool)), direct_paths[board.name], two)
    assert referenced.found.tolist() == [True, False, True, True]


def test_the_compiled_search_is_never_given_more_blocks_than_it_has_room_for(rig, align_single, noise, monkeypatch):
    """Otherwise the loop would write beyond its arrays."""
    compiled = loops.load_library()
    if compiled is None:
        pytest.skip("nothing is compiled here")
    blocks_searched = []
    find = type(compiled).find

    def find_and_note(self, halves, **arguments):
        blocks_searched.append(halves.shape[-1])
        return find(self, halves, **arguments)

    monkeypatch.setattr(type(compiled), "find", find_and_note)
    rng = np.random.default_rng(0)
    for linear in ((0, 192), (0, 1024), (0, 1200)):
        chirp = msgspec.structs.replace(
            rig.chirp,
            samples=linear[1],
            linear_samples=linear,
            sample_rate_hz=rig.chirp.sample_rate_hz * linear[1] / 192,
        )
        path = prepare(msgspec.structs.replace(rig, chirp=chirp), rig.receivers[0])
        received = noise((3, 4, linear[1]), 0.0, rng) + np.exp(0.5j * np.arange(linear[1]))
        referenced = reference(align_single(received, np.ones(3, bool), linear), path, chirp)
        assert np.isfinite(referenced.samples).all()
    assert blocks_searched == [48, 256]
