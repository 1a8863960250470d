"""Expect an error by its code and the values it names, not by its sentences."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from polysight_shared.errors import ErrorCode, PolysightError


@contextmanager
def expect_refusal(code: ErrorCode, *values: object) -> Iterator[pytest.ExceptionInfo[PolysightError]]:
    """The block must raise a `PolysightError` with this code whose text has all `values` (names, numbers, paths)."""
    with pytest.raises(PolysightError) as caught:
        yield caught
    assert caught.value.code is code, f"{caught.value.code}: {caught.value}"
    for value in values:
        assert str(value) in str(caught.value)
