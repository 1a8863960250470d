"""Chirps with interference or clipping are left out, as if they had not been received, and counted."""

import numpy as np
import pytest

from polysight.sync import BoardSetup, align_row, loops as sync_loops, synchronise_row
from polysight.sync.offsets import align_in_numpy, align_pieces

# Samples in which a chirp is linear, as in the published rig
LINEAR = (0, 192)

POSITIONS = 10
CHIRPS = 16

# Amplitude of the direct path in the words of the fixture `counts`
COUNTS = 1000


@pytest.fixture(params=["compiled", "numpy"])
def align(request):
    """`align(words, valid)`: align bursts with the compiled loops, or in NumPy."""
    if request.param == "numpy":
        by = align_in_numpy
    elif sync_loops.load_library() is None:
        pytest.skip("no compiled loops: python -m polysight.sync.build")
    else:
        by = sync_loops.load_library().align

    def run(words, valid=None):
        valid = np.ones(words.shape[:2], bool) if valid is None else valid
        return align_pieces([words], valid, LINEAR, by=by)

    return run


@pytest.fixture
def receive_bursts(paths, noise, rig):
    """Bursts as received, complex [position, chirp, rx, sample], direct path 1."""

    def make(snr_db=8.0, seed=0, echo=1.0):
        rng = np.random.default_rng(seed)
        signal, _ = paths(rig.receivers[0], positions=POSITIONS, echo=echo, rng=rng)
        shape = POSITIONS, CHIRPS, 1, 1
        n = np.arange(signal.shape[-1])
        # The direct path is at 0.35 cycles per sample; each chirp has its own offset of frequency and phase.
        turns = 0.35 * n + rng.uniform(-0.09, 0.09, shape) * n + rng.uniform(size=shape)
        frames = signal[:, None] * np.exp(2j * np.pi * turns)
        return frames + noise(frames.shape, power_db=-snr_db, rng=rng)

    return make


def add_crossing_chirp(frames, chosen, level, rng, samples=40):
    """Add another radar's chirp of amplitude `level` to the chosen chirps [position, chirp].

    It crosses the band of the signal within 40 samples, beginning anywhere.
    """
    disturbed = frames.copy()
    n = np.arange(samples) - samples / 2
    for position, chirp in np.argwhere(chosen):
        first = rng.integers(0, LINEAR[1] - samples)
        turns = 0.35 * n + n**2 / samples * rng.uniform(0.15, 0.45) + rng.uniform(size=(4, 1))
        disturbed[position, chirp, :, first : first + samples] += level * np.exp(2j * np.pi * turns)
    return disturbed


def choose_chirps(count, rng):
    """Mark `count` random chirps of every burst, bool [position, chirp]."""
    first_of_each = np.arange(CHIRPS) < count + np.zeros((POSITIONS, 1))
    return rng.permuted(first_of_each, axis=1)


def make_words(counts, frames):
    """Received words int16 [position, chirp, sample, 2, rx]."""
    return counts(frames.transpose(2, 0, 1, 3))


@pytest.mark.parametrize("count", [1, 2, 4, 6])
@pytest.mark.parametrize("level", [2.0, 8.0])
def test_bursts_with_disturbed_chirps_give_the_average_of_the_others(align, receive_bursts, counts, count, level):
    rng = np.random.default_rng(count)
    chosen = choose_chirps(count, rng)
    words = make_words(counts, add_crossing_chirp(receive_bursts(), chosen, level, rng))
    aligned = align(words)
    expected = align(words, ~chosen)
    np.testing.assert_array_equal(aligned.good, ~chosen)
    np.testing.assert_array_equal(aligned.halves, expected.halves)
    assert not aligned.clipped.any()


@pytest.mark.parametrize("level", [0.2, 0.5, 1.0])
def test_disturbances_too_weak_to_be_found_change_the_average_by_less_than_its_noise(
    align, receive_bursts, counts, level
):
    rng = np.random.default_rng(9)
    chosen = choose_chirps(3, rng)
    quiet = receive_bursts()
    aligned = align(make_words(counts, add_crossing_chirp(quiet, chosen, level, rng)))
    clean = align(make_words(counts, quiet))
    deviation = np.abs(aligned.halves.sum(axis=1)) - np.abs(clean.halves.sum(axis=1))
    # Noise of -8 dB, in one of its two parts, averaged over the chirps and over four samples
    noise = COUNTS * 10 ** (-8 / 20) / np.sqrt(2 * CHIRPS * 4)
    assert np.sqrt((deviation**2).mean()) < noise


@pytest.mark.parametrize("snr_db", [-3.0, 8.0, 25.0, 60.0])
@pytest.mark.parametrize("echo", [0.0, 1.0, 3.0])
def test_no_chirp_of_an_undisturbed_burst_is_left_out(align, receive_bursts, counts, snr_db, echo):
    assert align(make_words(counts, receive_bursts(snr_db, echo=echo))).good.all()


@pytest.mark.parametrize("travel_mm", [0.5, 1.0])
def test_motion_in_a_burst_is_not_a_disturbance(align, receive_bursts, counts, travel_mm):
    """While the stage moves, the path to a plate at the side changes by up to 1.6 times the travel."""
    wavelength_mm = 3.85
    turns = np.linspace(-0.5, 0.5, CHIRPS)[:, None, None] * 1.6 * travel_mm / wavelength_mm
    # The same seed: the second differs from the first by the echo alone, which turns from chirp to chirp.
    direct = receive_bursts(60.0, seed=3, echo=0.0)
    direct_and_echo = receive_bursts(60.0, seed=3)
    frames = direct + (direct_and_echo - direct) * np.exp(2j * np.pi * turns)
    assert align(make_words(counts, frames)).good.all()


def clip(words, limit):
    return np.clip(words, -limit, limit)


@pytest.mark.parametrize("limit", [0.4, 0.6, 0.75])
def test_a_burst_whose_chirps_are_all_clipped_is_not_used(align, receive_bursts, counts, limit):
    """`limit`: the level at which words are clipped, relative to the largest word."""
    words = make_words(counts, 8 * receive_bursts(20.0, echo=0.3))
    largest = np.abs(words).max()
    # In the receiver, before the converter
    clipped_below_full_scale = clip(words, int(limit * largest))
    aligned = align(clipped_below_full_scale)
    assert aligned.clipped.all()
    assert not aligned.good.any()
    assert not aligned.halves.any()
    # In the converter
    amplified = np.rint(words * (32767 / (limit * largest)))
    clipped_at_full_scale = clip(amplified, 32767).astype(np.int16)
    assert not align(clipped_at_full_scale).good.any()


def test_clipped_chirps_among_others_are_left_out(align, receive_bursts, counts):
    chosen = choose_chirps(5, np.random.default_rng(2))
    words = make_words(counts, 2.5 * receive_bursts(20.0))
    # Direct path and echo together reach 5000 counts: four times as much is clipped at 7000.
    clipped = clip(4 * words, 7000)
    words = np.where(chosen[..., None, None, None], clipped, words)
    aligned = align(words)
    expected = align(words, ~chosen)
    np.testing.assert_array_equal(aligned.clipped, chosen)
    np.testing.assert_array_equal(aligned.good, ~chosen)
    np.testing.assert_array_equal(aligned.halves, expected.halves)


def test_compiled_loops_and_numpy_leave_out_the_same_chirps(receive_bursts, counts):
    library = sync_loops.load_library()
    if library is None:
        pytest.skip("no compiled loops: python -m polysight.sync.build")
    rng = np.random.default_rng(1)
    for level in (0.5, 1.0, 2.0, 20.0):
        chosen = rng.random((POSITIONS, CHIRPS)) < 0.3
        words = make_words(counts, add_crossing_chirp(receive_bursts(12.0), chosen, level, rng))
        compiled = align_pieces([words], np.ones(words.shape[:2], bool), LINEAR, by=library.align)
        in_numpy = align_pieces([words], np.ones(words.shape[:2], bool), LINEAR, by=align_in_numpy)
        np.testing.assert_array_equal(compiled.good, in_numpy.good)
        largest = np.abs(in_numpy.halves).max()
        np.testing.assert_allclose(compiled.halves, in_numpy.halves, rtol=0, atol=3e-6 * largest)


def test_chirps_left_out_are_counted(rig, receive_bursts, counts):
    setup = BoardSetup.from_rig(rig, rig.receivers[0], compensate_filter=False)
    rng = np.random.default_rng(4)
    chosen = choose_chirps(2, rng)
    chosen[:4] = False
    words = make_words(counts, add_crossing_chirp(receive_bursts(15.0), chosen, 8.0, rng))
    # All chirps of position 0 are clipped, and three of position 1; three of the last position are lost.
    words[0] = clip(4 * words[0], int(2.5 * COUNTS))
    words[1, :3] = 32767
    valid = np.ones(chosen.size, bool)
    valid[-3:] = False
    row = synchronise_row(words.reshape(-1, *words.shape[2:]), valid, setup)
    assert row.chirps_clipped == CHIRPS + 3
    assert row.positions_clipped == 1
    assert row.chirps_disturbed == (chosen.ravel() & valid).sum()
    assert row.valid.tolist() == [False] + 9 * [True]
    np.testing.assert_array_equal(row.chirps[1:4], [13, 16, 16])


def test_no_chirp_of_a_burst_of_three_counts_as_disturbed(align, receive_bursts, counts):
    """With three chirps it is not certain which one differs from the others."""
    frames = receive_bursts()[:, :3]
    rng = np.random.default_rng(5)
    second_of_each = np.arange(3) == np.full((POSITIONS, 1), 1)
    words = make_words(counts, add_crossing_chirp(frames, second_of_each, 2.0, rng))
    assert align(words).good.all()
    assert align_row(words, np.ones((POSITIONS, 3), bool), LINEAR).good.all()
