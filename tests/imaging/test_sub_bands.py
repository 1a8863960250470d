"""Sub-bands cover the linear part of the sweep and overlap by half; the model of layers uses the same frequencies."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.imaging.images import MIN_SAMPLES, sub_bands
from polysight.materials.layers import Spectrum
from polysight_shared.errors import ConfigError, ErrorCode

CHIRP = load_published_rig().chirp


@given(st.integers(1, 15))
def test_sub_bands_cover_the_linear_samples_and_overlap_by_half(count):
    bands = sub_bands(CHIRP, count)
    first, last = CHIRP.linear_samples
    assert len(bands) == count
    assert (bands[0].samples[0], bands[-1].samples[1]) == (first, last)
    # `count` bands that overlap by half are count + 1 halves.
    length = 2 * (last - first) / (count + 1)
    for band in bands:
        band_first, band_end = band.samples
        size = band_end - band_first
        # Bands begin and end at whole samples.
        assert abs(size - length) <= 1
        assert size >= MIN_SAMPLES - 1
        assert band.last_hz - band.first_hz == pytest.approx((size - 1) * CHIRP.hz_per_sample)
    starts = [band.samples[0] for band in bands]
    np.testing.assert_allclose(np.diff(starts), length / 2, atol=1)


@given(st.integers(1, 15))
def test_the_model_of_a_layer_averages_over_the_same_frequencies(count):
    spectrum = Spectrum.from_chirp(CHIRP, count)
    for band, hz, weight in zip(sub_bands(CHIRP, count), spectrum.frequency_hz, spectrum.weight, strict=True):
        middle_hz = (band.first_hz + band.last_hz) / 2
        # Bands begin and end at whole samples: frequencies agree within two of them.
        assert np.sum(hz * weight) == pytest.approx(middle_hz, abs=2 * CHIRP.hz_per_sample)
        assert band.first_hz - 2 * CHIRP.hz_per_sample <= hz.min()
        assert hz.max() <= band.last_hz + 2 * CHIRP.hz_per_sample


@pytest.mark.parametrize("count", [0, -1, 16, 1000])
def test_no_band_and_too_many_bands_are_refused(count):
    with expect_refusal(ErrorCode.VALUE_INVALID, count):
        sub_bands(CHIRP, count)


@pytest.mark.parametrize("linear_samples", [(0, 192), (10, 100), (0, 25), (0, 37)])
def test_the_advised_number_of_parts_is_the_largest_that_is_possible(linear_samples):
    """Parts of at least 24 samples, which overlap by half."""
    chirp = msgspec.structs.replace(CHIRP, linear_samples=linear_samples)
    with pytest.raises(ConfigError) as refusal:
        sub_bands(chirp, 1000)
    # "use 1 to 15": the largest number is the last word.
    most = int(refusal.value.remedy.removeprefix("use 1 to "))
    assert len(sub_bands(chirp, most)) == most
    with expect_refusal(ErrorCode.VALUE_INVALID):
        sub_bands(chirp, most + 1)
