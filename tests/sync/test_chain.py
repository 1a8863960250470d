"""A row of raw chirps is synchronised: offsets and filter are removed, residuals measured, bad chirps left out."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.sync import BoardSetup, synchronise_row
from polysight.sync.cubes import CubeForm
from polysight.sync.high_pass_filter import high_pass
from polysight.sync.loops import estimate_tone
from polysight_shared.errors import ErrorCode
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Positions of a row, and chirps of each position
POSITIONS = 9
PULSES = 6

# Amplitude of the direct path in counts of the converter
COUNTS = 800


@pytest.fixture(scope="module")
def short_bursts_rig(rig):
    return msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=PULSES))


@pytest.fixture(scope="module")
def make_row(short_bursts_rig, paths, noise):
    """`make_row(...)`: chirps of one row in ADC counts, which of them are valid, and the ideal result.

    `offsets`: each chirp has a random offset of frequency and phase. `filtered`: the receiver's high-pass filter was
    applied. The ideal result are samples [rx, position, block] relative to the direct path.
    """
    board = short_bursts_rig.receivers[1]

    def make(offsets=True, filtered=False, snr_db=12.0, seed=0):
        signal, direct_m = paths(board, positions=POSITIONS, echo=1.0, rng=np.random.default_rng(8))
        rng = np.random.default_rng(seed)
        chirp = short_bursts_rig.chirp
        f = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
        # Relative to the direct path, sample by sample
        ideal = signal * np.exp(-2j * np.pi * f * direct_m[:, None] / SPEED_OF_LIGHT_M_S)
        n = np.arange(chirp.samples)
        # The direct path is at 0.35 cycles per sample.
        shape = (POSITIONS, PULSES)
        df = np.full(shape, 0.35)
        phase = np.zeros(shape)
        if offsets:
            df = df + rng.uniform(-0.08, 0.08, shape)
            phase = rng.uniform(-np.pi, np.pi, shape)
        turn = np.exp(1j * (2 * np.pi * df[..., None] * n + phase[..., None]))
        # [position, chirp, rx, sample]
        frames = signal[:, None] * turn[:, :, None]
        if filtered:
            # Each tone is multiplied by the filter's response. 1024 zeros before the chirp, so that the filter starts
            # with it.
            spectrum = np.fft.fft(np.pad(frames, [(0, 0)] * 3 + [(1024, 0)], mode="constant"), axis=-1)
            bins = np.fft.fftfreq(1280, 1 / chirp.sample_rate_hz) % chirp.sample_rate_hz
            frames = np.fft.ifft(spectrum * high_pass(chirp).response(bins), axis=-1)[..., 1024:]
        frames = frames + noise(frames.shape, power_db=-snr_db, rng=rng)
        counts = np.round(frames * COUNTS).transpose(2, 0, 1, 3).reshape(4, -1, chirp.samples)
        # The middle of each block of four samples, by a cubic through them
        blocks = ideal[..., :192].reshape(*ideal.shape[:2], -1, 4)
        middles = blocks @ (np.array([-1, 9, 9, -1]) / 16)
        return counts.astype(np.complex64), np.ones(POSITIONS * PULSES, bool), middles.swapaxes(0, 1)

    return make


@pytest.fixture(scope="module")
def setup(short_bursts_rig):
    return BoardSetup.from_rig(short_bursts_rig, short_bursts_rig.receivers[1], compensate_filter=False)


def _compute_relative_error(row, ideal, inside=slice(None)):
    """Rms error of a row over the rms of its ideal; `inside` selects blocks."""
    error = np.abs(row.samples / COUNTS - ideal)[..., inside]
    size = np.abs(ideal)[..., inside]
    return np.sqrt((error**2).mean() / (size**2).mean())


def test_a_disturbed_row_is_restored_to_the_ideal(make_row, setup):
    frames, valid, ideal = make_row()
    synchronised = synchronise_row(frames, valid, setup)
    assert synchronised.valid.all()
    assert (synchronised.chirps == PULSES).all()
    # Noise of -12 dB, averaged over the pulses, relative to direct path and echo, which are equally strong (together
    # the square root of 2). The average over the four samples of a block halves it once more, as measured.
    noise_floor = 10 ** (-12 / 20) / np.sqrt(PULSES) / np.sqrt(2)
    assert _compute_relative_error(synchronised, ideal) < 1.3 * noise_floor


def test_offsets_have_no_effect_beyond_noise(make_row, setup):
    frames, valid, _ = make_row(offsets=True, snr_db=30)
    with_offsets = synchronise_row(frames, valid, setup)
    frames, valid, _ = make_row(offsets=False, snr_db=30)
    without_offsets = synchronise_row(frames, valid, setup)
    difference = np.abs(with_offsets.samples - without_offsets.samples)
    # Noise of -30 dB is averaged over the pulses and over four samples; a difference of two averages has sqrt(2) of it.
    noise_of_difference = 10 ** (-30 / 20) * np.sqrt(2 / (PULSES * 4))
    assert np.sqrt((difference**2).mean()) < 1.5 * noise_of_difference * COUNTS


def test_the_high_pass_filter_is_compensated(make_row, short_bursts_rig, setup):
    frames, valid, ideal = make_row(filtered=True, snr_db=30)
    compensating_setup = BoardSetup.from_rig(short_bursts_rig, short_bursts_rig.receivers[1])
    compensated = synchronise_row(frames, valid, compensating_setup)
    not_compensated = synchronise_row(frames, valid, setup)
    # In the first blocks the filter has not settled.
    after_start = slice(3, None)
    # Measured: 0.005 with and 0.08 without compensation
    error = _compute_relative_error(compensated, ideal, after_start)
    assert error < 0.04
    assert error < 0.4 * _compute_relative_error(not_compensated, ideal, after_start)


def test_errors_shrink_from_received_to_averaged(make_row, setup):
    """Errors of frequency, phase (rad) and amplitude after each stage: received, aligned, averaged, referenced."""
    frames, valid, _ = make_row()
    synchronised = synchronise_row(frames, valid, setup)
    assert list(synchronised.stages) == ["received", "aligned", "averaged", "referenced"]
    f_hz, phase_rad, amplitude = zip(*synchronised.stages.values(), strict=True)
    received, aligned, averaged = 0, 1, 2
    # Alignment removes the offsets of the chirps: 100 kHz become 29 Hz (measured).
    assert f_hz[received] > 20 * f_hz[aligned]
    # The phase of received chirps is random: 1.7 rad. Alignment leaves 0.004 rad.
    assert phase_rad[received] > 1
    assert phase_rad[aligned] < 1 / 20
    # The average over six pulses reduces the noise, in theory by 2.4: measured are 2.3 in frequency and amplitude.
    assert f_hz[aligned] > 1.5 * f_hz[averaged]
    assert phase_rad[aligned] > phase_rad[averaged]
    assert amplitude[aligned] > 1.5 * amplitude[averaged]
    # Noise of -12 dB (0.25) in 6 x 4 x 192 samples changes the amplitude by 0.3 %.
    np.testing.assert_allclose(synchronised.direct_amplitude, COUNTS, rtol=0.05)


def test_measured_errors_are_the_true_ones(rig, paths, noise, setup):
    """Object and direct path are the same at every position, so their scatter is the error."""
    positions = 400
    snr_db = 12.0
    board = rig.receivers[1]
    signal, _ = paths(board, positions=1, echo=1.0, rng=np.random.default_rng(8))
    rng = np.random.default_rng(3)
    shape = (positions, PULSES)
    n = np.arange(256)
    df = 0.35 + rng.uniform(-0.08, 0.08, shape)
    phase = rng.uniform(-np.pi, np.pi, shape)
    frames = signal[0][:, None, None] * np.exp(2j * np.pi * df[..., None] * n + 1j * phase[..., None])
    frames = COUNTS * (frames + noise(frames.shape, power_db=-snr_db, rng=rng))
    full_setup = replace(setup, examined=positions)
    synchronised = synchronise_row(frames.reshape(4, -1, 256).astype(np.complex64), np.ones(df.size, bool), full_setup)

    # The echo at each position over the mean echo is a tone: its frequency and phase are the error of the reference.
    echo = (synchronised.samples / COUNTS - 1).astype(complex)
    mean_echo = echo.mean(axis=1, keepdims=True)
    tone = estimate_tone((echo * mean_echo.conj()).sum(axis=0).astype(np.complex64))
    f_hz, rad, _ = synchronised.stages["referenced"]
    # A standard deviation of 400 positions is known to 1 / sqrt(2 * 400) = 3.5 %; the limits, 15 %, are four of these.
    # A block is four samples.
    assert f_hz == pytest.approx(tone.frequency.std() * rig.chirp.sample_rate_hz / 4, rel=0.15)
    assert rad == pytest.approx(np.angle(tone.amplitude).std(), rel=0.15)
    averaged_rad, averaged_amplitude = synchronised.stages["averaged"][1:]
    assert averaged_amplitude == pytest.approx(synchronised.direct_amplitude.std() / COUNTS, rel=0.15)
    # Noise changes the phase as much as the relative amplitude.
    assert averaged_rad == pytest.approx(averaged_amplitude, rel=0.15)


def test_residuals_of_a_sample_of_positions_agree_with_those_of_all(rig, paths, noise, setup):
    """Residuals are measured at `examined` positions of a row only."""
    signal, _ = paths(rig.receivers[1], positions=300, echo=1.0, rng=np.random.default_rng(8))
    rng = np.random.default_rng(3)
    phases = np.exp(2j * np.pi * rng.uniform(size=(1, 300, PULSES, 1)))
    frames = COUNTS * (signal.swapaxes(0, 1)[:, :, None] * phases)
    frames = (frames + COUNTS * noise(frames.shape, power_db=-12.0, rng=rng)).reshape(4, -1, 256).astype(np.complex64)
    few_examined = synchronise_row(frames, np.ones(300 * PULSES, bool), replace(setup, examined=64))
    all_positions = synchronise_row(frames, np.ones(300 * PULSES, bool), replace(setup, examined=300))
    assert few_examined.errors["received"].shape[1] == 64 * PULSES
    assert few_examined.errors["aligned"].shape[1] == 64 * PULSES
    assert few_examined.errors["averaged"].shape[1] == 64
    assert all_positions.errors["averaged"].shape[1] == 300
    # A standard deviation of 64 positions is known to 1 / sqrt(2 * 64) = 9 %; 35 % are four of these.
    for stage, spread in all_positions.stages.items():
        np.testing.assert_allclose(few_examined.stages[stage], spread, rtol=0.35)


def test_clipped_and_missing_chirps_are_left_out(make_row, setup):
    frames, valid, ideal = make_row()
    # A clipped sample of one chirp at position 3, two missing chirps at position 5, and the whole position 7 missing
    frames[2, 3 * PULSES + 1, 40] = 32767
    valid[5 * PULSES : 5 * PULSES + 2] = False
    valid[7 * PULSES : 8 * PULSES] = False
    frames[:, ~valid] = 0
    synchronised = synchronise_row(frames, valid, setup)
    assert synchronised.chirps.tolist() == [6, 6, 6, 5, 6, 4, 6, 0, 6]
    assert synchronised.valid.tolist() == [True] * 7 + [False, True]
    assert not synchronised.samples[:, 7].any()
    is_valid = synchronised.valid
    # The noise of -12 dB (0.25), averaged over the pulses, is 0.1.
    assert np.abs(synchronised.samples[:, is_valid] / COUNTS - ideal[:, is_valid]).mean() < 0.2


def test_bursts_of_one_chirp_are_synchronised_by_the_direct_path_alone(make_row, setup):
    """Residuals that need two chirps are missing."""
    frames, valid, ideal = make_row(snr_db=20)
    single_chirp = replace(setup, pulses=1)
    synchronised = synchronise_row(frames[:, ::PULSES], valid[::PULSES], single_chirp)
    assert synchronised.valid.all()
    assert (synchronised.chirps == 1).all()
    assert "referenced" not in synchronised.stages
    noise = 10 ** (-20 / 20)
    _, _, amplitude_error = synchronised.stages["received"]
    # The amplitude is estimated from the samples of four RX. Half of the noise's power changes it, the other half its
    # phase.
    noise_of_amplitude = noise / np.sqrt(2 * 4 * 192)
    assert amplitude_error < 2 * noise_of_amplitude
    # As above, without an average over pulses: 0.35 of the noise is measured.
    assert _compute_relative_error(synchronised, ideal) < 1.3 * noise


def test_a_row_without_frames_is_invalid(setup):
    synchronised = synchronise_row(np.zeros((4, 2 * PULSES, 256), np.complex64), np.zeros(2 * PULSES, bool), setup)
    assert not synchronised.valid.any()
    assert synchronised.stages == {}


@pytest.mark.parametrize("shape", [(3, PULSES, 256), (4, PULSES + 1, 256), (4, PULSES, 128)])
def test_frames_of_another_rig_are_refused(setup, shape):
    with expect_refusal(ErrorCode.MISMATCH, shape[1]):
        synchronise_row(np.zeros(shape, np.complex64), np.ones(shape[1], bool), setup)


def test_a_truncated_recording_is_refused(setup):
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, PULSES):
        synchronise_row(np.zeros((4, PULSES, 256), np.complex64), np.ones(2 * PULSES, bool), setup)


@pytest.mark.parametrize("conjugate", [False, True])
def test_a_row_of_a_cube_is_converted_and_masked_where_it_is_empty_or_not_finite(short_bursts_rig, conjugate):
    """Samples of another program's cube are conjugated if necessary, multiplied by `turn`, and a constant is added."""
    rng = np.random.default_rng(3)
    shape = (4, POSITIONS, short_bursts_rig.chirp.samples)
    cube = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    # Position 1 is empty; 3 and 4 are not finite.
    cube[:, 1] = 0
    cube[2, 3, 7] = np.nan
    cube[0, 4, 0] = complex(1, -np.inf)
    # Position 6 is not empty: it has one small number.
    cube[:, 6] = 0
    cube[3, 6, -1] = -1e-30j
    turn = np.exp(2j * np.pi * rng.uniform(size=(4, short_bursts_rig.chirp.samples))).astype(np.complex64)
    constant = np.arange(4).astype(np.complex64)
    no_direct_path = None
    form = CubeForm(
        conjugate=conjugate,
        turn=turn,
        constant=constant,
        path=no_direct_path,
        chirp=short_bursts_rig.chirp,
        how="",
    )
    # A row that was scanned in the other direction
    row = form.convert_row(cube[:, ::-1], pulses=16)
    masked = [POSITIONS - 1 - position for position in (1, 3, 4)]
    assert np.flatnonzero(~row.valid).tolist() == sorted(masked)
    assert not row.samples[:, ~row.valid].any()
    assert row.chirps.tolist() == [16 * valid for valid in row.valid]
    in_scan_order = cube[:, ::-1]
    if conjugate:
        in_scan_order = in_scan_order.conj()
    expected = in_scan_order[:, row.valid] * turn[:, None] + constant[:, None, None]
    np.testing.assert_array_equal(row.samples[:, row.valid], expected)
