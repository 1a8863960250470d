"""The digest of raw rows, whichever library makes it."""

import zlib

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from polysight.host.store.append_only import crc32


@given(st.binary(max_size=3000))
def test_it_is_that_of_zlib(data):
    assert crc32(data) == zlib.crc32(data)
    assert crc32(np.frombuffer(data, np.uint8).data) == zlib.crc32(data)
