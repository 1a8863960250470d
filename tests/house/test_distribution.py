"""The tests themselves: their distribution to workers."""

from tests.support.paths import REPO
from tests.support.suite import FIRST, ROOMS, TOGETHER


def test_what_is_named_is_there():
    assert [f for f in {*FIRST, *ROOMS, *TOGETHER, *TOGETHER.values()} if not (REPO / f).exists()] == []
