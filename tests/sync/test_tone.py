"""Tones are estimated at the Cramer-Rao bound; phase ramps are exact."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from polysight.sync.loops import block_edges, block_times, cis, estimate_tone, find_band, phasor


@given(st.floats(-0.49, 0.49), st.floats(-3.1, 3.1), st.integers(24, 256))
def test_a_clean_tone_is_recovered(frequency, phase, n):
    # The phase is that in the middle of the record.
    from_middle = np.arange(n) - (n - 1) / 2
    samples = np.exp(1j * (2 * np.pi * frequency * from_middle + phase)).astype(np.complex64)
    tone = estimate_tone(samples[None])
    # A thousandth of a bin, and a twentieth of a degree. Rounding to single precision leaves 6e-8 rad (measured).
    assert tone.frequency[0] == pytest.approx(frequency, abs=1e-3 / n)
    assert np.angle(tone.amplitude[0] * np.exp(-1j * phase)) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("snr_db", [7, 16, 22, 30])
def test_error_is_at_the_cramer_rao_bound(noise, snr_db):
    """Rife and Boorstyn 1974: var(w) = sigma^2 / (2 A^2 sum (n - mean)^2), var(central phase) = sigma^2 / (2 A^2 N)."""
    rng = np.random.default_rng(1)
    n = 192
    trials = 20_000
    f = rng.uniform(-0.49, 0.49, trials)
    t = np.arange(n) - (n - 1) / 2
    z = np.exp(2j * np.pi * f[:, None] * t) + noise((trials, n), power_db=-snr_db, rng=rng)
    tone = estimate_tone(z.astype(np.complex64))
    power = 10 ** (-snr_db / 10)
    w_bound = np.sqrt(power / 2 / (t**2).sum())
    phase_bound = np.sqrt(power / 2 / n)
    # A standard deviation of 20,000 trials is known to half a per cent; a few per cent are left to the estimator.
    assert 0.97 < (tone.frequency - f).std() * 2 * np.pi / w_bound < 1.05
    assert 0.97 < np.angle(tone.amplitude).std() / phase_bound < 1.05


@given(st.integers(1, 300))
def test_blocks_cover_a_record_once(n):
    edges = block_edges(n)
    assert (edges[0], edges[-1]) == (0, n)
    assert (np.diff(edges) > 0).all()
    assert np.average(block_times(edges), weights=np.diff(edges)) == pytest.approx(0, abs=1e-9)


@given(st.floats(-1e4, 1e4))
def test_cis_is_on_the_unit_circle_at_its_angle(angle):
    assert cis(np.array(angle)) == pytest.approx(np.exp(1j * angle), abs=5e-7)


def test_phasor_is_the_exponential():
    frequency = np.array([0.3, -0.41])
    phase = np.array([1.0, -2.0])
    centre = 95.5
    from_centre = np.arange(250) - centre
    expected = np.exp(1j * (2 * np.pi * frequency[:, None] * from_centre + phase[:, None]))
    np.testing.assert_allclose(phasor(frequency, phase, 250, centre), expected, atol=1e-6)


@pytest.mark.parametrize("frequency", [0.0, 0.0005, 0.25, 0.5, 0.9995])
def test_the_band_of_a_tone_has_its_frequency_in_its_middle_also_at_zero(frequency):
    """Frequencies are in cycles per sample: 1 is the same as 0."""
    # Two positions, whose tones have different phases
    phase_cycles = np.array([0.1, 0.7])[:, None, None]
    chirps = np.exp(2j * np.pi * (frequency * np.arange(192) + phase_cycles)).astype(np.complex64)
    middle = find_band(np.tile(chirps, (1, 4, 1)))
    assert ((middle >= 0) & (middle < 1)).all()
    error = (middle - frequency + 0.5) % 1 - 0.5
    # The band is found in the spectra of the quarters of a chirp: a twentieth of their bin
    assert np.abs(error).max() < 0.05 / 48
