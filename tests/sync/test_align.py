"""Burst alignment: offsets at the Cramer-Rao bound, averages, and bad, missing or silent chirps."""

import numpy as np
import pytest

from polysight.sync.offsets import align_row

LINEAR = (0, 192)
CENTRE = 95.5
CHIRPS = 16


@pytest.fixture
def burst(paths, noise, rig, counts):
    """Raw words [position, chirp, sample, 2, rx], true frequency and phase of each chirp, and the ideal signal."""

    def make(positions, snr_db, echo=1.0, seed=0, chirps=CHIRPS):
        rng = np.random.default_rng(seed)
        signal, _ = paths(rig.receivers[0], positions, echo, rng)
        n = np.arange(signal.shape[-1]) - CENTRE
        df = rng.uniform(-0.1, 0.1, (positions, chirps))
        phase = rng.uniform(-np.pi, np.pi, (positions, chirps))
        turn = np.exp(1j * (2 * np.pi * df[..., None] * n + phase[..., None]))
        frames = signal[:, :, None] * turn[:, None]
        frames = frames + noise(frames.shape, -snr_db, rng)
        return counts(frames.swapaxes(0, 1)), df, phase, signal

    return make


def average_halves(aligned):
    """Averages complex [position, rx, block]."""
    return aligned.halves.sum(axis=1)


def _compute_errors(aligned, df, phase):
    """Errors of frequency (cycles per sample) and phase of each chirp relative to its burst."""
    f = aligned.frequency - df
    turns = np.exp(1j * (aligned.phase - phase))
    return f - f.mean(axis=1, keepdims=True), np.angle(turns / turns.mean(axis=1, keepdims=True))


def _compute_bounds(signal, snr_db):
    """Cramer-Rao bounds of frequency and phase offset of a known waveform in white noise."""
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
    mean_factor = np.sqrt(CHIRPS / (CHIRPS - 1))  # the mean was taken out of the errors
    for error, bound in zip(_compute_errors(aligned, df, phase), _compute_bounds(signal, snr_db), strict=True):
        assert error.std() * mean_factor < 1.1 * bound
        assert error.std() * mean_factor > 0.9 * bound


def _divide_by_first(words):
    """Frequency of each chirp relative to the first by the paper's method: division, long FFT, highest peak."""
    frames = (words[..., 0, :] + 1j * words[..., 1, :])[:, :, slice(*LINEAR)]
    ratio = frames / np.where(frames[:, :1] == 0, 1, frames[:, :1])
    spectrum = np.abs(np.fft.fft(ratio, 4096, axis=2)).sum(axis=-1)
    top = np.argmax(spectrum, axis=2)
    return np.where(top < 2048, top, top - 4096) / 4096


@pytest.mark.parametrize("snr_db", [0, 5])
def test_at_low_snr_there_are_no_gross_errors_and_half_the_error_of_division(burst, snr_db):
    frames, df, phase, signal = burst(30, snr_db)
    f, _ = _compute_errors(align_row(frames, np.ones(df.shape, bool), LINEAR), df, phase)
    bin_ = 1 / 192
    assert np.abs(f).max() < bin_ / 2
    assert np.abs(f).max() < 8 * _compute_bounds(signal, snr_db)[0]
    divided = _divide_by_first(frames) - df
    divided -= np.median(divided, axis=1, keepdims=True)
    small = np.abs(divided) < bin_ / 2  # without its gross errors
    assert f.std() < 0.5 * divided[small].std()


def test_average_is_the_signal_with_its_noise_reduced(burst):
    frames, df, _, signal = burst(20, 10)
    mean = average_halves(align_row(frames, np.ones(df.shape, bool), LINEAR)) / 1000
    n = np.arange(48)
    middles = signal[..., :192].reshape(20, 4, 48, 4) @ (np.array([-1, 9, 9, -1]) / 16)
    for p in range(20):  # the average differs by the frequency and phase of its reference chirp
        z = (mean[p] * middles[p].conj()).sum(axis=0)
        grid = np.fft.fft(z, 1 << 16)
        f = np.argmax(np.abs(grid)) / (1 << 16)
        back = mean[p] * np.exp(-1j * (2 * np.pi * f * n + np.angle(grid[np.argmax(np.abs(grid))])))
        residual = (np.abs(back - middles[p]) ** 2).mean()
        assert residual < 1.5 * 0.1 / CHIRPS / 4


def test_a_common_frequency_and_phase_of_all_chirps_has_no_other_effect(burst, counts):
    frames, df, _, _ = burst(6, 15)
    n = np.arange(frames.shape[2])
    received = (frames[..., 0, :] + 1j * frames[..., 1, :]).transpose(3, 0, 1, 2) / 1000
    shifted = counts(received * np.exp(1j * (2 * np.pi * 0.07 * n + 1.0)))
    valid = np.ones(df.shape, bool)
    result = align_row(frames, valid, LINEAR)
    shifted_result = align_row(shifted, valid, LINEAR)
    relative = [a.frequency - a.frequency.mean(axis=1, keepdims=True) for a in (result, shifted_result)]
    np.testing.assert_allclose(*relative, atol=1e-5)
    # Within a hundredth of the direct path.
    np.testing.assert_allclose(np.abs(average_halves(shifted_result)), np.abs(average_halves(result)), atol=10)


def test_the_residual_is_the_true_error(burst):
    frames, df, phase, _ = burst(60, 12)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    for k, error in enumerate(_compute_errors(aligned, df, phase)):
        assert aligned.error[:, k].std() == pytest.approx(error.std(), rel=0.15)


@pytest.mark.parametrize("bad", [0, 7])
def test_a_chirp_of_noise_is_left_out(burst, noise, bad):
    frames, df, _, _ = burst(12, 15)
    rng = np.random.default_rng(5)
    frames[:, bad] = np.rint(1000 * noise(frames[:, bad].shape, 3, rng).real)
    aligned = align_row(frames, np.ones(df.shape, bool), LINEAR)
    other_chirps = np.delete(np.arange(CHIRPS), bad)
    assert not aligned.good[:, bad].any()
    assert aligned.good[:, other_chirps].all()
    f = aligned.frequency[:, other_chirps] - df[:, other_chirps]
    assert (f - f.mean(axis=1, keepdims=True)).std() * 2.15e6 < 60  # Hz; a hundredth of an IF bin


@pytest.mark.parametrize("content", ["saturated", "silent", "another signal"])
@pytest.mark.parametrize("bad_chirp", [0, 9])
def test_one_spoiled_chirp_of_16_changes_nothing(burst, content, bad_chirp):
    """The average is that of the 15 others for any content of the bad chirp."""
    frames, df, _, _ = burst(6, 15)
    spoiled = frames.copy()
    if content == "saturated":
        spoiled[:, bad_chirp] = np.clip(60 * spoiled[:, bad_chirp].astype(np.int32), -32768, 32767)
    elif content == "silent":
        spoiled[:, bad_chirp] = 0
    else:
        n = np.arange(frames.shape[2])
        spoiled[:, bad_chirp] = np.rint(3000 * np.cos(2 * np.pi * (0.0004 * n + 0.3) * n))[:, None, None]
    without = np.ones(df.shape, bool)
    without[:, bad_chirp] = False
    aligned = align_row(spoiled, np.ones(df.shape, bool), LINEAR)
    expected = align_row(frames, without, LINEAR)
    np.testing.assert_array_equal(aligned.good, without)
    # Magnitudes do not depend on the reference chirp.
    np.testing.assert_allclose(np.abs(average_halves(aligned)), np.abs(average_halves(expected)), atol=30)


def test_missing_chirps_and_missing_positions(burst):
    frames, df, _, _ = burst(10, 15)
    valid = np.ones(df.shape, bool)
    valid[3] = False
    valid[5, [0, 4, 9]] = False
    valid[6, 1:] = False
    frames[~valid] = 0
    aligned = align_row(frames, valid, LINEAR)
    np.testing.assert_array_equal(aligned.good.sum(axis=1), [16, 16, 16, 0, 16, 13, 1, 16, 16, 16])
    assert not aligned.halves[3].any()
    assert np.isfinite(aligned.halves).all()
    alone = align_row(frames[6:7, :1], np.ones((1, 1), bool), LINEAR)
    np.testing.assert_array_equal(aligned.halves[6], alone.halves[0])


def test_silent_chirps_give_no_average():
    aligned = align_row(np.zeros((3, 2, 256, 2, 4), np.int16), np.ones((3, 2), bool), LINEAR)
    assert not aligned.good.any()
    assert not aligned.halves.any()
