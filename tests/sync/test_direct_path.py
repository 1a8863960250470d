"""The direct path is found in the presence of an equally strong object, with its phase at the Cramer-Rao bound.

The direct path from TX to RX is the reference of frequency and phase of each position. The echo of the object lies only
3 to 4 bins of the 192 linear samples above it. A bin is 11 kHz: an error of 11 Hz is a thousandth of it.
"""

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

# Middle of the linear samples
CENTRE = 95.5

# Linear samples of a chirp; a bin is the sample rate over it, 11 kHz.
LINEAR_SAMPLES = 192


def sweep_turns_per_m(rig):
    """Turns of the phase per metre of path, at each sample of a chirp."""
    return (rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(256)) / SPEED_OF_LIGHT_M_S


def shift_if(signal, cycles):
    """The signal [..., 256] with an IF that is higher by `cycles` per sample."""
    return signal * np.exp(2j * np.pi * cycles * np.arange(256))


def scatter_of_phase(amplitudes):
    """Standard deviation of the phases of amplitudes that should be equal, radians."""
    return np.angle(amplitudes / amplitudes.mean()).std()


@pytest.fixture(scope="session")
def direct_paths(rig):
    """The estimator of each receiver's direct path."""
    return {b.name: prepare(rig, b) for b in rig.receivers}


@pytest.fixture(params=[0, 1], ids=["H", "V"])
def board(request, rig):
    return rig.receivers[request.param]


@pytest.fixture
def run(rig, paths, noise, direct_paths, align_single):
    """`run(board, ...)`: reference positions with random offsets; result, frequency error (Hz), phase error (rad).

    `echo` is the strength of the echoes, `direct` that of the direct path. `gain`: the four RX differ by this much in
    amplitude and phase. `drift_hz`: change of the IF within the linear samples, as by crystals that differ.
    """

    def synchronise_random_row(
        board, echo=1.0, snr_db=None, positions=150, seed=0, direct=1.0, gain=0.0, drift_hz=0.0, **more
    ):
        rng = np.random.default_rng(seed)
        signal, direct_m = paths(board, positions=positions, echo=echo, rng=rng, **more)
        direct_alone, _ = paths(board, positions=positions, echo=0.0, rng=rng)
        signal = signal + (direct - 1) * direct_alone
        gain_of_rx = (1 + gain * rng.standard_normal(4)) * np.exp(1j * gain * rng.standard_normal(4))
        signal *= gain_of_rx[:, None]
        n = np.arange(rig.chirp.samples)
        rate = rig.chirp.sample_rate_hz
        df = rng.uniform(0.1, 0.8, positions)
        phase = rng.uniform(-np.pi, np.pi, positions)
        drift = drift_hz / rate / LINEAR_SAMPLES
        cycles = df[:, None] * (n - CENTRE) + 0.5 * drift * (n - CENTRE) ** 2
        signal *= np.exp(1j * (2 * np.pi * cycles + phase[:, None]))[:, None]
        if snr_db is not None:
            signal += noise(signal.shape, power_db=-snr_db, rng=rng)
        referenced = reference(align_single(signal, np.ones(positions, bool)), direct_paths[board.name], rig.chirp)
        # The true tone is the offset plus the direct path's own delay; frequencies wrap after a cycle per sample.
        delay_s = direct_m[0] / SPEED_OF_LIGHT_M_S
        frequency_error = (referenced.frequency - df - rig.chirp.hz_per_sample * delay_s + 0.5) % 1 - 0.5
        middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * CENTRE
        turn = np.exp(1j * (np.angle(referenced.amplitude) - phase - 2 * np.pi * middle_hz * delay_s))
        return referenced, frequency_error * rate, np.angle(turn / turn.mean())

    return synchronise_random_row


def test_without_an_object_the_direct_path_is_exact(run, board):
    referenced, error_hz, phase_error = run(board, echo=0.0)
    assert referenced.found.all()
    # Measured: 0.4 Hz, 4e-5 of a bin, and 4e-5 rad
    assert np.abs(error_hz).max() < 0.5
    assert np.abs(phase_error).max() < 1e-3


@pytest.mark.parametrize(("step_bins", "is_found"), [(0.019, True), (-0.019, True), (0.021, False), (-0.021, False)])
def test_a_tone_whose_last_frequency_step_is_more_than_a_fiftieth_of_a_bin_is_not_found(
    rig, paths, direct_paths, align_single, board, step_bins, is_found
):
    """The frequency is estimated in steps, which converge for a tone; these loops report a last step of `step_bins`."""
    signal, _ = paths(board, positions=4, echo=0.0, rng=np.random.default_rng(0))
    first, last = whole_blocks(rig.chirp.linear_samples)

    class UnsettledLoops(loops.NumpyLoops):
        @staticmethod
        def remove(*arguments):
            removed = loops.NumpyLoops.remove(*arguments)
            return removed._replace(step=np.full_like(removed.step, step_bins / (last - first)))

    aligned = align_single(signal, np.ones(4, bool))
    referenced = reference(aligned, direct_paths[board.name], rig.chirp, by=UnsettledLoops)
    assert (referenced.found == is_found).all()
    assert referenced.samples.any() == is_found


# `cycles`: per sample
@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
@pytest.mark.parametrize("cycles", [-0.12, 0.05])
def test_a_cube_that_is_mixed_down_may_have_any_if_near_zero(rig, paths, direct_paths, board, cycles, if_mode):
    """The passband of a receiver with complex1x has no negative IF; a cube that another program has mixed down may."""
    signal, _ = paths(board, positions=6, echo=0.0, rng=np.random.default_rng(0))
    chirp = msgspec.structs.replace(rig.chirp, if_mode=if_mode)
    cube = (signal * np.exp(2j * np.pi * cycles * np.arange(chirp.samples))).astype(np.complex64)
    form = CubeForm(
        conjugate=False,
        turn=np.ones((4, chirp.samples), np.complex64),
        constant=np.zeros(4, np.complex64),
        path=direct_paths[board.name],
        chirp=chirp,
        how="",
    )
    assert form.convert_row(cube.transpose(1, 0, 2), pulses=16).valid.all()


@pytest.mark.parametrize("echo", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("echoes", [1, 9])
def test_the_object_3_to_4_bins_away_does_not_bias_the_direct_path(run, board, echo, echoes):
    referenced, error_hz, phase_error = run(board, echo=echo, echoes=echoes)
    assert referenced.found.all()
    # A thousandth of a bin of the linear samples; 4 Hz and 3e-4 rad are measured.
    assert np.abs(error_hz).max() < 12
    assert phase_error.std() < 1e-3


@pytest.mark.parametrize(("z_mm", "bins"), [(400, 2.35), (499, 3.56), (620, 5.30)])
def test_the_bias_is_small_for_every_object_distance(rig, align_single, board, z_mm, bins):
    """`bins`: how far the echo of an object at the distance `z_mm` is above the direct path."""
    rig = msgspec.structs.replace(rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=z_mm))
    rng = np.random.default_rng(1)
    n = 300
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    # One point within 50 mm of the mirror point at each position
    aside_m = np.column_stack([rng.uniform(-0.05, 0.05, (n, 2)), np.zeros(n)])
    points = np.add(specular_midpoint_m(rig, board), aside_m)
    echo_m = np.linalg.norm(points - tx, axis=1)[:, None] + np.linalg.norm(points[:, None] - rx, axis=2)
    bins_per_m = rig.chirp.hz_per_sample * LINEAR_SAMPLES / SPEED_OF_LIGHT_M_S
    # The two boards see the echo at distances that differ by some hundredths of a bin.
    assert (echo_m - direct_m).mean() * bins_per_m == pytest.approx(bins, abs=0.05)
    turns_per_m = sweep_turns_per_m(rig)
    received = np.exp(2j * np.pi * turns_per_m * direct_m[:, None])
    received = received + np.exp(2j * np.pi * (turns_per_m * echo_m[..., None] + rng.uniform(size=(n, 1, 1))))
    received = shift_if(received, 0.3)
    referenced = reference(align_single(received, np.ones(n, bool)), prepare(rig, board), rig.chirp)
    true_frequency = 0.3 + rig.chirp.hz_per_sample * direct_m[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # A thousandth of a bin, and a few hundredths of a degree
    assert np.abs(referenced.frequency - true_frequency).max() * rig.chirp.sample_rate_hz < 10
    assert scatter_of_phase(referenced.amplitude) < 6e-4


def test_suppression_of_clutter_behind_the_object_costs_little_noise(board, direct_paths):
    """The estimate of the direct path, compared with the best one without an object and without clutter.

    Clutter may come from any direction and from paths 0.6 to 1.4 m longer than the direct path. Its power in the
    estimate is compared with that in a plain mean, the noise with the Cramer-Rao bound of one tone.
    """
    path = direct_paths[board.name]
    rx, blocks = path.folded_steering.shape
    time = (np.arange(blocks) - (blocks - 1) / 2) * FOLD
    paths_m = np.linspace(0.6, 1.4, 400)
    clutter = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(paths_m, path.sweep_hz))
    # Plain means of amplitude and of frequency (radians per sample)
    plain_means = np.stack([np.ones(blocks), -1j * time / (time**2).mean()]) / (rx * blocks)
    for weights, plain_mean in zip(path.estimator, plain_means, strict=True):
        power = (np.abs(clutter @ weights.reshape(rx, blocks).T) ** 2).sum(axis=1).mean()
        power_of_plain_mean = rx * (np.abs(clutter @ plain_mean) ** 2).mean()
        assert power < 0.35 * power_of_plain_mean
    # The power of the clutter is 0.15 to 0.22 of that in a plain mean (measured). The cost is noise: that of the
    # amplitude is up to 3 % and that of the frequency up to 8 % above the bounds.
    bounds = np.sqrt([1 / (rx * blocks), 1 / (rx * (time**2).sum())])
    assert (np.linalg.norm(path.estimator, axis=1) < [1.03, 1.09] * bounds).all()


def test_clutter_half_as_strong_on_a_path_0_9_m_longer_hardly_changes_the_phase(rig, align_single, board, direct_paths):
    rng = np.random.default_rng(8)
    n = 300
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    clutter_m = direct_m + 0.9 + rng.uniform(-0.04, 0.04, (n, 1))
    turns_per_m = sweep_turns_per_m(rig)
    # The phase of the clutter is random, also among the RX: it comes from any direction.
    clutter = 0.5 * np.exp(2j * np.pi * (turns_per_m * clutter_m[..., None] + rng.uniform(size=(n, 4, 1))))
    received = np.exp(2j * np.pi * turns_per_m * direct_m[:, None]) + clutter
    received = shift_if(received, 0.3)
    referenced = reference(align_single(received, np.ones(n, bool)), direct_paths[board.name], rig.chirp)
    true_frequency = 0.3 + rig.chirp.hz_per_sample * direct_m[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # 0.14 degrees and half a hundredth of a bin; 0.0019 rad and 19 Hz are measured.
    assert scatter_of_phase(referenced.amplitude) < 2.5e-3
    assert (referenced.frequency - true_frequency).std() * rig.chirp.sample_rate_hz < 50


def test_unequal_receivers_do_not_bias_the_direct_path_much(run, board):
    """The gains of the four RX differ by 20 % and by 0.2 rad."""
    referenced, error_hz, phase_error = run(board, gain=0.2, echoes=5)
    assert referenced.found.all()
    # Two thousandths of a bin, and a tenth of a degree; 1 Hz and 2e-4 rad are measured.
    assert error_hz.std() < 25
    assert phase_error.std() < 2e-3


def test_noise_is_near_the_cramer_rao_bound(run, board):
    referenced, error_hz, phase_error = run(board, snr_db=16, positions=600)
    # Of one tone in 192 samples of four RX: Rife and Boorstyn 1974, as in test_tone.py
    power = 10**-1.6
    n = LINEAR_SAMPLES
    sample_rate_hz = 2.15e6
    frequency_bound = np.sqrt(power / 2 / (4 * n * (n**2 - 1) / 12)) / 2 / np.pi * sample_rate_hz
    phase_bound = np.sqrt(power / 2 / (4 * n))
    assert referenced.found.all()
    # The suppression of clutter costs some percent of noise (as above): 10 and 6 % are measured.
    assert error_hz.std() < 1.2 * frequency_bound
    assert phase_error.std() < 1.15 * phase_bound


def test_two_tones_2_5_bins_apart_at_16_db_cost_little_over_one_tones_bound(rig, noise, align_single, board):
    # At this distance the echo is 2.5 bins above the direct path.
    near = msgspec.structs.replace(rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=412.0))
    rng = np.random.default_rng(4)
    trials = 1500
    tx = np.array(tx_position_m(near))
    rx = np.array(rx_positions_m(near, board))
    mirror_point = np.array(specular_midpoint_m(near, board))
    direct_m = np.linalg.norm(rx - tx, axis=1)
    echo_m = np.linalg.norm(mirror_point - tx) + np.linalg.norm(mirror_point - rx, axis=1)
    bins = (echo_m - direct_m).mean() * rig.chirp.hz_per_sample * LINEAR_SAMPLES / SPEED_OF_LIGHT_M_S
    # The two boards differ by some hundredths of a bin.
    assert bins == pytest.approx(2.5, abs=0.05)
    turns_per_m = sweep_turns_per_m(rig)
    # In turns: the phase of the echo relative to the direct path, and that of both
    phase_of_echo, phase = rng.uniform(size=(2, trials, 1, 1))
    signal = np.exp(2j * np.pi * turns_per_m * direct_m[:, None])
    signal = signal + np.exp(2j * np.pi * (turns_per_m * echo_m[:, None] + phase_of_echo))
    signal *= np.exp(2j * np.pi * (0.3 * (np.arange(256) - CENTRE) + phase))
    signal += noise(signal.shape, power_db=-16, rng=rng)
    referenced = reference(align_single(signal, np.ones(trials, bool)), prepare(near, board), near.chirp)
    assert referenced.found.all()
    bound_of_one_tone = np.sqrt(10**-1.6 / 2 / (4 * LINEAR_SAMPLES))
    without_phase = referenced.amplitude * np.exp(-2j * np.pi * phase[:, 0, 0])
    # 3 % above the bound are measured.
    assert scatter_of_phase(without_phase) < 1.2 * bound_of_one_tone


# A tone above (1) or below (-1) the direct path, by the distance of the object's echo, and its strength relative to the
# direct path (0: no tone). The search takes a stronger peak for the direct path, and so it does a comparable one below.
@pytest.mark.parametrize(("side", "strength"), [(1, 5.0), (-1, 0.6), (0, 0.0)])
def test_the_second_peak_is_used_where_the_amplitude_is_an_outlier(
    rig, paths, noise, direct_paths, align_single, board, side, strength
):
    """At some positions a tone hides the direct path. The amplitude of the direct path is known from the other ones."""
    path = direct_paths[board.name]
    rng = np.random.default_rng(6)
    signal, direct_m = paths(board, positions=40, echo=0.0, rng=rng)
    # Cycles per sample: bins of the search's transform, of one sample in four
    distance = side * np.mean(path.object_bins) / SEARCH_FFT / FOLD
    tone = strength * signal * np.exp(2j * np.pi * distance * np.arange(256))
    is_disturbed = np.arange(40) % 8 == 3
    signal = signal + is_disturbed[:, None, None] * tone + noise(signal.shape, power_db=-10, rng=rng)
    signal = shift_if(signal, 0.25)
    referenced = reference(align_single(signal, np.ones(40, bool)), path, rig.chirp)
    true_frequency = 0.25 + rig.chirp.hz_per_sample * direct_m[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # A tenth of a bin; the tone is 3.5 bins away.
    assert np.abs(referenced.frequency - true_frequency).max() * LINEAR_SAMPLES < 0.1


def test_a_far_stronger_object_at_some_positions_does_not_hide_the_direct_path(
    rig, paths, direct_paths, align_single, board
):
    """At every eighth position the echo is four times as strong as the direct path, at the others half as strong."""
    signal, _ = paths(board, positions=40, echo=0.5, rng=np.random.default_rng(6), spread_m=0.02)
    direct_alone, direct_m = paths(board, positions=40, echo=0.0, rng=np.random.default_rng(6))
    has_strong_echo = np.arange(40) % 8 == 3
    signal = np.where(has_strong_echo[:, None, None], direct_alone + 8 * (signal - direct_alone), signal)
    signal = shift_if(signal, 0.25)
    referenced = reference(align_single(signal, np.ones(40, bool)), direct_paths[board.name], rig.chirp)
    true_frequency = 0.25 + rig.chirp.hz_per_sample * direct_m[0] / SPEED_OF_LIGHT_M_S
    assert referenced.found.all()
    # A tenth of a bin; the object is 3.5 bins away.
    assert np.abs(referenced.frequency - true_frequency).max() * LINEAR_SAMPLES < 0.1


def test_halves_are_scaled_to_the_average_of_their_chirps():
    """Factors that make of each half's part in the average of all chirps the average of its own chirps.

    The first half has one chirp more if their number is odd: of three, it has two, and its factor is 3 / 2.
    """
    scale = half_scale(np.arange(6))
    np.testing.assert_allclose(scale, [(0, 0), (1, 1), (2, 2), (3 / 2, 3), (2, 2), (5 / 3, 5 / 2)], rtol=1e-6)


def test_the_lower_of_two_peaks_is_used_if_the_object_is_stronger(run, board):
    referenced, error_hz, _ = run(board, echo=1.0, direct=0.5, spread_m=0.05)
    assert referenced.found.all()
    # A hundredth of a bin; the peak of the object is 3 to 4 bins higher.
    assert np.abs(error_hz).max() < 100


def test_a_slope_difference_of_the_crystals_is_removed(run, board):
    referenced, _, phase_error = run(board, drift_hz=5.5e3, snr_db=20)
    assert referenced.found.all()
    # Relative to the direct path, whose amplitude is 1000 counts
    with_drift = referenced.samples / 1000
    without_drift = run(board, drift_hz=0.0, snr_db=20)[0].samples / 1000
    # Both rows have the same noise: only the drift could make them differ. 0.01 is measured.
    assert np.sqrt((np.abs(with_drift - without_drift) ** 2).mean()) < 0.05
    # The Cramer-Rao bound at 20 dB is sqrt(0.01 / 2 / (4 * 192)) = 0.0026 rad, as measured.
    assert phase_error.std() < 0.01


def test_a_referenced_echo_has_the_positive_phase_of_its_excess_path(rig, paths, direct_paths, align_single, board):
    rng = np.random.default_rng(3)
    direct_alone, direct_m = paths(board, positions=1, echo=0.0, rng=rng)
    # A point some centimetres away from the mirror point
    point = np.add(specular_midpoint_m(rig, board), (0.02, -0.03, 0))
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    echo_m = np.linalg.norm(point - tx) + np.linalg.norm(point - rx, axis=1)
    echo = 0.8 * np.exp(2j * np.pi * sweep_turns_per_m(rig) * echo_m[:, None])
    offset = np.exp(1j * (2 * np.pi * 0.3 * np.arange(256) + 2.0))
    received = ((direct_alone[0] + echo) * offset)[None].astype(np.complex64)
    referenced = reference(align_single(received, np.ones(1, bool)), direct_paths[board.name], rig.chirp)
    block_turns_per_m = direct_paths[board.name].sweep_hz / SPEED_OF_LIGHT_M_S
    excess_m = echo_m - direct_m
    expected = 1 + 0.8 * np.exp(2j * np.pi * block_turns_per_m * excess_m[:, None])
    # Words are rounded to thousandths of the direct path; 1.5e-3 are measured.
    np.testing.assert_allclose(referenced.samples[:, 0] / 1000, expected, atol=3e-3)


def check_direct_path_is_real(referenced, path):
    """In the referenced samples the direct path has the amplitude that was reported, and the phase 0."""
    samples = referenced.samples[:, referenced.found].swapaxes(0, 1)
    direct_path = samples.reshape(len(samples), -1) @ path.estimator[0]
    amplitude = np.abs(referenced.amplitude[referenced.found])
    np.testing.assert_allclose(direct_path, amplitude, rtol=0, atol=1e-5 * amplitude.max())


@pytest.mark.parametrize("echo", [0.0, 1.0, 2.0])
def test_the_direct_path_in_referenced_samples_has_its_amplitude_and_no_phase(run, direct_paths, board, echo):
    referenced, _, _ = run(board, echo=echo, echoes=9, snr_db=10)
    # The law is tested at nearly all positions.
    assert referenced.found.mean() > 0.95
    check_direct_path_is_real(referenced, direct_paths[board.name])


@pytest.mark.parametrize("loop", [None, loops.NumpyLoops])
def test_of_two_tones_that_look_like_direct_path_and_object_the_one_with_the_row_s_amplitude_is_taken(
    rig, paths, noise, direct_paths, align_single, board, loop
):
    """At every seventh position there is a tone as far below the direct path as the object's echo would be above it.

    The search takes that tone for the direct path; its amplitude is unusual in the row, so that the other one is tried.
    """
    rng = np.random.default_rng(4)
    path = direct_paths[board.name]
    signal, _ = paths(board, positions=60, echo=0.0, rng=rng)
    signal += noise(signal.shape, power_db=-20, rng=rng)
    # Cycles per sample: bins of the search's transform, of one sample in four
    below = np.mean(path.object_bins) / SEARCH_FFT / FOLD
    disturbed = np.arange(5, 60, 7)
    signal[disturbed] += 0.4 * signal[disturbed] * np.exp(-2j * np.pi * below * np.arange(256))
    signal = shift_if(signal, 0.3)
    referenced = reference(align_single(signal, np.ones(60, bool)), path, rig.chirp, loop)
    amplitude = np.abs(referenced.amplitude)
    is_usual = np.abs(amplitude / np.median(amplitude) - 1) < 0.1
    # A tone of 0.4 does not have the usual amplitude: most of the disturbed positions have that of the direct path.
    assert is_usual[disturbed].sum() > len(disturbed) / 2
    assert np.ptp(referenced.frequency[is_usual]) < below / 10
    check_direct_path_is_real(referenced, path)


def test_noise_alone_and_lost_positions_are_not_found(rig, paths, noise, direct_paths, align_single, board):
    rng = np.random.default_rng(2)
    signal, _ = paths(board, positions=40, echo=1.0, rng=rng)
    signal = shift_if(signal, 0.2)
    # Position 5 has only noise, position 9 is weak, position 20 is lost.
    signal[5] = noise(signal[5].shape, power_db=-10, rng=rng)
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
    signal, _ = paths(board, positions=40, echo=0.0, rng=np.random.default_rng(2))
    signal[9] *= relative
    signal = shift_if(signal, 0.2)
    referenced = reference(align_single(signal, np.ones(40, bool)), direct_paths[board.name], rig.chirp)
    assert np.flatnonzero(~referenced.found).tolist() == ([] if is_found else [9])


def test_a_row_of_noise_has_no_direct_path(rig, noise, direct_paths, align_single, board):
    received = noise((400, 4, 256), power_db=0, rng=np.random.default_rng(7)).astype(np.complex64)
    referenced = reference(align_single(received, np.ones(400, bool)), direct_paths[board.name], rig.chirp)
    assert not referenced.found.any()


@pytest.mark.parametrize(("snr_db", "least", "most"), [(-17, 0.0, 0.05), (-13.5, 0.1, 0.9), (-10.5, 0.95, 1.0)])
def test_a_direct_path_is_found_from_15_db_over_the_noise_of_its_estimate(run, board, snr_db, least, most):
    """-13.5 dB in a sample of one RX becomes 15 dB by averaging over 4 RX and 192 samples (28.9 dB), with a window.

    At this limit some are found and others not. 3 dB below nearly none is found, 3 dB above nearly all: `least` and
    `most` limit the share that is found.
    """
    referenced, _, _ = run(board, echo=0.0, snr_db=snr_db, positions=300)
    assert least <= referenced.found.mean() <= most


def test_an_if_outside_the_band_is_masked(rig, paths, direct_paths, align_single, board):
    """Complex1x keeps an IF of 0 to 0.9 cycles per sample, complex2x one of -0.45 to 0.45."""
    signal, _ = paths(board, positions=4, echo=1.0, rng=np.random.default_rng(2))
    # The direct path of 1.39 m has a frequency of its own, which is subtracted.
    own_frequency = rig.chirp.hz_per_sample * 1.39 / SPEED_OF_LIGHT_M_S
    if_cycles = np.array([0.2, 0.5, 0.95, 0.7])[:, None]
    signal *= np.exp(2j * np.pi * (if_cycles - own_frequency) * np.arange(256))[:, None]
    referenced = reference(align_single(signal, np.ones(4, bool)), direct_paths[board.name], rig.chirp)
    assert referenced.found.tolist() == [True, True, False, True]
    # 0.95 and 0.7 are -0.05 and -0.3 in complex2x.
    complex2x = msgspec.structs.replace(rig.chirp, if_mode="complex2x")
    referenced = reference(align_single(signal, np.ones(4, bool)), direct_paths[board.name], complex2x)
    assert referenced.found.tolist() == [True, False, True, True]


def test_the_compiled_search_is_never_given_more_blocks_than_it_has_room_for(rig, align_single, noise, monkeypatch):
    """Otherwise the loop would write beyond its arrays. It has room for 256 blocks of four samples.

    300 blocks are searched in NumPy.
    """
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
    for samples in (192, 1024, 1200):
        linear = (0, samples)
        # As long as the published chirp, sampled faster
        sample_rate_hz = rig.chirp.sample_rate_hz * samples / 192
        chirp = msgspec.structs.replace(
            rig.chirp, samples=samples, linear_samples=linear, sample_rate_hz=sample_rate_hz
        )
        path = prepare(msgspec.structs.replace(rig, chirp=chirp), rig.receivers[0])
        received = noise((3, 4, samples), power_db=0.0, rng=rng) + np.exp(0.5j * np.arange(samples))
        referenced = reference(align_single(received, np.ones(3, bool), linear), path, chirp)
        assert np.isfinite(referenced.samples).all()
    assert blocks_searched == [48, 256]
