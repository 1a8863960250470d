"""Lane layouts: a known cube is decoded from every layout."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.support.refusals import refused

from polysight.capture.dca1000 import decode_row, decode_two_lane
from polysight_shared.error_codes import ErrorCode


def cube(frames: int, samples: int, rx: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = rng.integers(-32768, 32768, (2, rx, frames, samples))
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def four_lane(x: np.ndarray) -> bytes:
    """I0 I1 I2 I3 Q0 Q1 Q2 Q3 a sample, written out sample by sample."""
    rx, frames, samples = x.shape
    words = []
    for f in range(frames):
        for n in range(samples):
            words += [x[r, f, n].real for r in range(rx)] + [x[r, f, n].imag for r in range(rx)]
    return np.array(words, dtype="<i2").tobytes()


def two_lane(x: np.ndarray) -> bytes:
    """A whole chirp of RX0, then RX1: I0 I1 Q0 Q1 I2 I3 Q2 Q3."""
    rx, frames, samples = x.shape
    words = []
    for f in range(frames):
        for r in range(rx):
            for n in range(0, samples, 2):
                a, b = x[r, f, n], x[r, f, n + 1]
                words += [a.real, b.real, a.imag, b.imag]
    return np.array(words, dtype="<i2").tobytes()


@given(st.integers(1, 4), st.integers(1, 9), st.sampled_from([1, 2, 4]))
def test_four_lane_round_trip(frames, samples, rx):
    x = cube(frames, samples, rx)
    got, valid = decode_row(four_lane(x), (), frames, samples, rx)
    assert got.dtype == np.complex64
    assert valid.all()
    assert np.array_equal(got, x)


@given(st.integers(1, 4), st.integers(1, 5), st.sampled_from([1, 2, 4]))
def test_two_lane_round_trip(chirps, pairs, rx):
    x = cube(chirps, 2 * pairs, rx)
    assert np.array_equal(decode_two_lane(two_lane(x), chirps, 2 * pairs, rx), x)


def test_swapped_order_exchanges_i_and_q():
    x = cube(2, 4, 4)
    swapped = x.imag + 1j * x.real
    assert np.array_equal(decode_row(four_lane(x), (), 2, 4, 4, swap_iq=True)[0], swapped)
    assert np.array_equal(decode_two_lane(two_lane(x), 2, 4, 4, swap_iq=True), swapped)


@given(st.lists(st.tuples(st.integers(0, 639), st.integers(1, 100)), max_size=4))
def test_frames_with_a_missing_byte_are_invalid_and_zero(cuts):
    x = cube(5, 8, 4)
    size = 5 * 8 * 16
    mask = np.zeros(size, dtype=bool)
    for a, n in cuts:
        mask[a : a + n] = True
    ranges = [(a, min(a + n, size)) for a, n in cuts]
    got, valid = decode_row(four_lane(x), ranges, 5, 8)
    assert np.array_equal(valid, ~mask.reshape(5, -1).any(axis=1))
    assert not got[:, ~valid].any()
    assert np.array_equal(got[:, valid], x[:, valid])


def test_short_data_is_refused():
    with refused(ErrorCode.NOT_ENOUGH_DATA):
        decode_row(bytes(100), (), 2, 4)
    with refused(ErrorCode.VALUE_INVALID):
        decode_two_lane(bytes(1000), 1, 3)
