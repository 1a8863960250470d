"""Burst alignment: offsets at the Cramer-Rao bound, averages, and bad, missing or silent chirps.

The chirps of a burst are the same signal, each with another offset of frequency and phase. Alignment estimates the
offsets relative to each other, removes them and averages the chirps, in two halves.
"""

import numpy as np
import pytest

from polysight.sync.offsets import align_row

# Samples in which a chirp is linear, as in the published rig, and their middle
LINEAR = (0, 192)
CENTRE = 95.5

# Chirps of a burst
CHIRPS = 16

# Amplitude of the direct path in the words of the fixture `counts`
COUNTS = 1000


@pytest.fixture
def burst(paths, noise, rig, counts):
    """Raw words [position, chirp, sample, 2, rx], true frequency and phase of each chirp, and the ideal signal."""

    def make(positions, snr_db, echo=1.0, seed=0, chirps=CHIRPS):
        rng = np.random.default_rng(seed)
        signal, _ = paths(rig.receivers[0], positions=positions, echo=echo, rng=rng)
        n = np.arange(signal.shape[-1]) - CENTRE
        df = rng.uniform(-0.1, 0.1, (positions, chirps))
        phase = rng.uniform(-np.pi, np.pi, (positions, chirps))
        # [position, chirp, sample], the same for all RX
        turn = np.exp(1j * (2 * np.pi * df[..., None] * n + phase[..., None]))
        frames = signal[:, :, None] * turn[:, None]
        frames = frames + noise(frames.shape, power_db=-snr_db, rng=rng)
        return counts(frames.swapaxes(0, 1)), df, phase, signal

    return make


def average_halves(aligned):
    """Sum of the two halves of the average, complex [position, rx, block]."""
    return aligned.halves.sum(axis=1)


def _compute_errors(aligned, df, phase):
    """Errors of frequency (cycles per sample) and phase of each chirp relative to its burst."""
    f = aligned.frequency - df
    turns = np.exp(1j * (aligned.phase - phase))
    return f - f.mean(axis=1, keepdims=True), np.angle(turns / turns.mean(axis=1, keepdims=True))


def _compute_bounds(signal, snr_db):
    """Cramer-Rao bounds of frequency (cycles per sample) and phase of a known waveform in white noise.

    With the energy E = sum |s|^2, its spread S = sum |s|^2 (n - centre)^2 and the noise power N, the variances are
    N / (2 S) of the angular frequency and N / 2 (1 / E + centre^2 / S) of the phase at n = 0, the middle sample.
    """
    inside = signal[..., slice(*LINEAR)]
    n = np.arange(inside.shape[-1]) - CENTRE
    energy = (np.abs(inside) ** 2).sum(axis=1)
    power = 10 ** (-snr_db / 10)
    centre = (energy * n).sum(axis=1) / energy.sum(axis=1)
    spread = (energy * (n - centre[:, None]) ** 2).sum(axis=1)
    frequency = np.sqrt((power / 2 / spread).mean()) / 2 / np.pi
    phase = np.sqrt((power / 2 * (1 / energy.sum(axis=1) + centre**2 / spread)).mean())
    return frequency, phase


@pytest.mark.parametrize("echo", [0.0, 1.0])
@pytest.mark.parametrize("snr_db", [10, 20])
def test_offsets_are_at_the_cramer_rao_bound(burst, snr_db, echo):
    frames, df, phase, signal = burst(positions=120, snr_db=snr_db, echo=echo)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    assert aligned.good.all()
    # Errors are relative to the mean of the 16 chirps, which makes them smaller.
    mean_factor = np.sqrt(CHIRPS / (CHIRPS - 1))
    for error, bound in zip(_compute_errors(aligned, df, phase), _compute_bounds(signal, snr_db), strict=True):
        error_std = error.std() * mean_factor
        # The standard deviation of 120 x 16 errors is known to 1.6 %.
        assert 0.9 * bound < error_std < 1.1 * bound


def _divide_by_first(words):
    """Frequency of each chirp relative to the first by the paper's method: division, long FFT, highest peak."""
    first, end = LINEAR
    frames = words[:, :, first:end, 0] + 1j * words[:, :, first:end, 1]
    first_chirp = frames[:, :1]
    # A sample of 0 cannot be divided by.
    ratio = frames / np.where(first_chirp == 0, 1, first_chirp)
    bins = 4096
    spectrum = np.abs(np.fft.fft(ratio, bins, axis=2)).sum(axis=-1)
    top_bin = np.argmax(spectrum, axis=2)
    return np.fft.fftfreq(bins)[top_bin]


@pytest.mark.parametrize("snr_db", [0, 5])
def test_at_low_snr_there_are_no_gross_errors_and_half_the_error_of_division(burst, snr_db):
    """A gross error is one of another peak of the spectrum: more than half a bin of the 192 samples."""
    frames, df, phase, signal = burst(positions=30, snr_db=snr_db)
    f, _ = _compute_errors(align_row(frames, np.ones(df.shape, bool), LINEAR), df, phase)
    half_bin = 1 / 192 / 2
    frequency_bound, _ = _compute_bounds(signal, snr_db)
    assert np.abs(f).max() < half_bin
    # The largest of 480 normally distributed errors (30 bursts of 16) is about three standard deviations.
    assert np.abs(f).max() < 8 * frequency_bound
    error_of_division = _divide_by_first(frames) - df
    error_of_division -= np.median(error_of_division, axis=1, keepdims=True)
    # Division has gross errors: only its other errors are compared.
    is_small = np.abs(error_of_division) < half_bin
    assert f.std() < 0.5 * error_of_division[is_small].std()


def test_average_is_the_signal_with_its_noise_reduced(burst):
    frames, df, _, signal = burst(positions=20, snr_db=10)
    noise_power = 10 ** (-10 / 10)
    mean = average_halves(align_row(frames, np.ones(df.shape, bool), LINEAR)) / COUNTS
    n = np.arange(48)
    # The signal in the middle of each block of four samples, by a cubic through them
    middles = signal[..., :192].reshape(20, 4, 48, 4) @ (np.array([-1, 9, 9, -1]) / 16)
    for position in range(20):
        # The average has the frequency and phase of its reference chirp: they are estimated and removed.
        product = (mean[position] * middles[position].conj()).sum(axis=0)
        spectrum = np.fft.fft(product, 1 << 16)
        peak = np.argmax(np.abs(spectrum))
        f = peak / (1 << 16)
        without_offset = mean[position] * np.exp(-1j * (2 * np.pi * f * n + np.angle(spectrum[peak])))
        residual = (np.abs(without_offset - middles[position]) ** 2).mean()
        # The noise is averaged over the chirps, and over the four samples of a block. The mean power over the 192
        # numbers of a position scatters by 7 %.
        assert residual < 1.5 * noise_power / CHIRPS / 4


def test_a_common_frequency_and_phase_of_all_chirps_has_no_other_effect(burst, counts):
    frames, df, _, _ = burst(positions=6, snr_db=15)
    n = np.arange(frames.shape[2])
    # [rx, position, chirp, sample], as the fixture `counts` expects
    received = (frames[..., 0, :] + 1j * frames[..., 1, :]).transpose(3, 0, 1, 2) / COUNTS
    # An arbitrary common frequency (0.07 cycles per sample) and phase (1 rad)
    shifted = counts(received * np.exp(1j * (2 * np.pi * 0.07 * n + 1.0)))
    valid = np.ones(df.shape, bool)
    result = align_row(frames, valid, LINEAR)
    shifted_result = align_row(shifted, valid, LINEAR)
    relative = result.frequency - result.frequency.mean(axis=1, keepdims=True)
    shifted_relative = shifted_result.frequency - shifted_result.frequency.mean(axis=1, keepdims=True)
    # The shifted words are rounded to counts again. That changes the frequencies by 6e-8 cycles per sample (measured),
    # and the average by 0.3 counts: less than a hundredth of the direct path.
    np.testing.assert_allclose(relative, shifted_relative, atol=1e-5)
    average = np.abs(average_halves(result))
    np.testing.assert_allclose(np.abs(average_halves(shifted_result)), average, atol=0.01 * COUNTS)


def test_the_reported_residual_is_as_large_as_the_true_error(burst):
    frames, df, phase, _ = burst(positions=60, snr_db=12)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    frequency_error, phase_error = _compute_errors(aligned, df, phase)
    # The standard deviations of 60 x 16 errors differ by 3 % (measured).
    assert aligned.error[:, 0].std() == pytest.approx(frequency_error.std(), rel=0.15)
    assert aligned.error[:, 1].std() == pytest.approx(phase_error.std(), rel=0.15)


@pytest.mark.parametrize("noisy_chirp", [0, 7])
def test_a_chirp_of_noise_is_left_out(burst, noise, noisy_chirp):
    frames, df, _, _ = burst(positions=12, snr_db=15)
    rng = np.random.default_rng(5)
    frames[:, noisy_chirp] = np.rint(COUNTS * noise(frames[:, noisy_chirp].shape, power_db=3, rng=rng).real)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    other_chirps = np.delete(np.arange(CHIRPS), noisy_chirp)
    assert not aligned.good[:, noisy_chirp].any()
    assert aligned.good[:, other_chirps].all()
    f = aligned.frequency[:, other_chirps] - df[:, other_chirps]
    sample_rate_hz = 2.15e6
    # 60 Hz are half a hundredth of a bin of the 192 samples (11 kHz); the noise of the other chirps gives 19 Hz.
    assert (f - f.mean(axis=1, keepdims=True)).std() * sample_rate_hz < 60


@pytest.mark.parametrize("content", ["saturated", "silent", "another signal"])
@pytest.mark.parametrize("bad_chirp", [0, 9])
def test_the_average_of_16_chirps_of_which_one_is_bad_is_that_of_the_15_others(burst, content, bad_chirp):
    frames, df, _, _ = burst(positions=6, snr_db=15)
    spoiled = frames.copy()
    if content == "saturated":
        # The whole chirp is clipped.
        spoiled[:, bad_chirp] = np.clip(60 * spoiled[:, bad_chirp].astype(np.int32), -32768, 32767)
    elif content == "silent":
        spoiled[:, bad_chirp] = 0
    else:
        # A chirp whose frequency crosses the band
        n = np.arange(frames.shape[2])
        spoiled[:, bad_chirp] = np.rint(3000 * np.cos(2 * np.pi * (0.0004 * n + 0.3) * n))[:, None, None]
    is_other_chirp = np.ones(df.shape, bool)
    is_other_chirp[:, bad_chirp] = False
    aligned = align_row(spoiled, np.ones(df.shape, bool), LINEAR)
    expected = align_row(frames, is_other_chirp, LINEAR)
    np.testing.assert_array_equal(aligned.good, is_other_chirp)
    # Magnitudes do not depend on which chirp is the reference. One chirp has 1 / 16 = 6 % of the average: half of that.
    average = np.abs(average_halves(expected))
    np.testing.assert_allclose(np.abs(average_halves(aligned)), average, atol=0.03 * COUNTS)


def test_missing_chirps_and_positions_have_no_part_in_the_averages(burst):
    frames, df, _, _ = burst(positions=10, snr_db=15)
    # Position 3 is missing, 5 has lost three chirps, and 6 has one chirp only.
    valid = np.ones(df.shape, bool)
    valid[3] = False
    valid[5, [0, 4, 9]] = False
    valid[6, 1:] = False
    frames[~valid] = 0
    aligned = align_row(frames, valid, LINEAR)
    np.testing.assert_array_equal(aligned.good.sum(axis=1), [16, 16, 16, 0, 16, 13, 1, 16, 16, 16])
    assert not aligned.halves[3].any()
    assert np.isfinite(aligned.halves).all()
    # The one chirp is its own average.
    alone = align_row(frames[6:7, :1], np.ones((1, 1), bool), LINEAR)
    np.testing.assert_array_equal(aligned.halves[6], alone.halves[0])


def test_silent_chirps_give_no_average():
    aligned = align_row(np.zeros((3, 2, 256, 2, 4), np.int16), np.ones((3, 2), bool), LINEAR)
    assert not aligned.good.any()
    assert not aligned.halves.any()
