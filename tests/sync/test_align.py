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
    frames, df, phase, signal = burst(120, snr_db, echo)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    assert aligned.good.all()
    # Errors are relative to the mean of the 16 chirps, which makes them smaller.
    mean_factor = np.sqrt(CHIRPS / (CHIRPS - 1))
    for error, bound in zip(_compute_errors(aligned, df, phase), _compute_bounds(signal, snr_db), strict=True):
        assert 0.9 * bound < error.std() * mean_factor < 1.1 * bound


def _divide_by_first(words):
    """Frequency of each chirp relative to the first by the paper's method: division, long FFT, highest peak."""
    frames = (words[..., 0, :] + 1j * words[..., 1, :])[:, :, slice(*LINEAR)]
    ratio = frames / np.where(frames[:, :1] == 0, 1, frames[:, :1])
    spectrum = np.abs(np.fft.fft(ratio, 4096, axis=2)).sum(axis=-1)
    top = np.argmax(spectrum, axis=2)
    return np.where(top < 2048, top, top - 4096) / 4096


@pytest.mark.parametrize("snr_db", [0, 5])
def test_at_low_snr_there_are_no_gross_errors_and_half_the_error_of_division(burst, snr_db):
    """A gross error is one of another peak of the spectrum: more than half a bin of the 192 samples."""
    frames, df, phase, signal = burst(30, snr_db)
    f, _ = _compute_errors(align_row(frames, np.ones(df.shape, bool), LINEAR), df, phase)
    half_bin = 1 / 192 / 2
    frequency_bound, _ = _compute_bounds(signal, snr_db)
    assert np.abs(f).max() < half_bin
    # In 480 chirps (30 bursts of 16) none is off by eight standard deviations.
    assert np.abs(f).max() < 8 * frequency_bound
    error_of_division = _divide_by_first(frames) - df
    error_of_division -= np.median(error_of_division, axis=1, keepdims=True)
    # Division has gross errors; its others are compared.
    is_small = np.abs(error_of_division) < half_bin
    assert f.std() < 0.5 * error_of_division[is_small].std()


def test_average_is_the_signal_with_its_noise_reduced(burst):
    frames, df, _, signal = burst(20, snr_db=10)
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
        # The noise has 0.1 of the power of the direct path; it is averaged over the chirps and over four samples.
        assert residual < 1.5 * 0.1 / CHIRPS / 4


def test_a_common_frequency_and_phase_of_all_chirps_has_no_other_effect(burst, counts):
    frames, df, _, _ = burst(6, 15)
    n = np.arange(frames.shape[2])
    received = (frames[..., 0, :] + 1j * frames[..., 1, :]).transpose(3, 0, 1, 2) / COUNTS
    # 0.07 cycles per sample and 1 rad; any would do.
    shifted = counts(received * np.exp(1j * (2 * np.pi * 0.07 * n + 1.0)))
    valid = np.ones(df.shape, bool)
    result = align_row(frames, valid, LINEAR)
    shifted_result = align_row(shifted, valid, LINEAR)
    relative, shifted_relative = (
        aligned.frequency - aligned.frequency.mean(axis=1, keepdims=True) for aligned in (result, shifted_result)
    )
    np.testing.assert_allclose(relative, shifted_relative, atol=1e-5)
    # Within a hundredth of the direct path: the shifted words are rounded again.
    average = np.abs(average_halves(result))
    np.testing.assert_allclose(np.abs(average_halves(shifted_result)), average, atol=0.01 * COUNTS)


def test_the_residual_is_the_true_error(burst):
    frames, df, phase, _ = burst(60, 12)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    # Of frequency and of phase
    for k, error in enumerate(_compute_errors(aligned, df, phase)):
        assert aligned.error[:, k].std() == pytest.approx(error.std(), rel=0.15)


@pytest.mark.parametrize("noisy_chirp", [0, 7])
def test_a_chirp_of_noise_is_left_out(burst, noise, noisy_chirp):
    frames, df, _, _ = burst(12, snr_db=15)
    rng = np.random.default_rng(5)
    frames[:, noisy_chirp] = np.rint(COUNTS * noise(frames[:, noisy_chirp].shape, power_db=3, rng=rng).real)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    other_chirps = np.delete(np.arange(CHIRPS), noisy_chirp)
    assert not aligned.good[:, noisy_chirp].any()
    assert aligned.good[:, other_chirps].all()
    f = aligned.frequency[:, other_chirps] - df[:, other_chirps]
    sample_rate_hz = 2.15e6
    # A bin of 192 samples is 11 kHz: less than a hundredth of it
    assert (f - f.mean(axis=1, keepdims=True)).std() * sample_rate_hz < 60


@pytest.mark.parametrize("content", ["saturated", "silent", "another signal"])
@pytest.mark.parametrize("bad_chirp", [0, 9])
def test_one_spoiled_chirp_of_16_changes_nothing(burst, content, bad_chirp):
    """The average is that of the 15 others for any content of the bad chirp."""
    frames, df, _, _ = burst(6, 15)
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
    # Magnitudes do not depend on which chirp is the reference. Within 3 % of the direct path; chosen.
    average = np.abs(average_halves(expected))
    np.testing.assert_allclose(np.abs(average_halves(aligned)), average, atol=0.03 * COUNTS)


def test_missing_chirps_and_positions_have_no_part_in_the_averages(burst):
    frames, df, _, _ = burst(10, snr_db=15)
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
