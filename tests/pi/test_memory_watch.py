"""The Pi's memory is watched: clients that fill it are disconnected. One test uses the memory of this process."""

import os
from typing import Any

import pytest

from polysight_pi.system import CHECK_INTERVAL_S, CUTTING_TIME_S, MAX_BYTES, SPARE_BYTES, MemoryWatch
from polysight_shared import messages as m


class Ended:
    """Stands for the event that ends the watch: it is set after `waits` calls of `wait`."""

    def __init__(self, waits: int) -> None:
        self.left = waits
        self.waited_s: list[float] = []

    def wait(self, seconds: float) -> bool:
        self.waited_s.append(seconds)
        self.left -= 1
        return self.left < 0


class DrawnWatch(MemoryWatch):
    """A watch of a program whose memory has the next of `sizes` at each check, and then keeps the last one.

    Two connections are open whenever it cuts connections.
    """

    def __init__(self, sizes: list[int], waits: int, at_start: int = 0) -> None:
        self.sizes = [at_start, *sizes]
        self.cuts = 0
        self.said: list[str] = []
        super().__init__({5601}, self.said.append)
        self._ended: Any = Ended(waits)

    def resident_bytes(self) -> int:
        if len(self.sizes) > 1:
            return self.sizes.pop(0)
        return self.sizes[0]

    def _cut_connections(self) -> int:
        self.cuts += 1
        return 2

    def watch(self) -> None:
        self.run()
        os.close(self._statm)


@pytest.mark.parametrize(("above_bytes", "is_cut"), [(0, False), (1, True)])
def test_connections_are_cut_beyond_the_limit_alone(above_bytes, is_cut):
    watch = DrawnWatch([MAX_BYTES + above_bytes, 0], waits=2)
    watch.watch()
    assert (watch.cuts > 0) == is_cut
    assert bool(watch.said) == is_cut


@pytest.mark.parametrize(("above_bytes", "is_cut"), [(0, False), (1, True)])
def test_a_program_that_is_large_at_its_start_has_room_above_that(above_bytes, is_cut):
    watch = DrawnWatch([MAX_BYTES + SPARE_BYTES + above_bytes, 0], waits=2, at_start=MAX_BYTES)
    watch.watch()
    assert (watch.cuts > 0) == is_cut


def test_connections_that_come_again_are_cut_for_half_a_second():
    watch = DrawnWatch([MAX_BYTES + (9 << 20), 30 << 20], waits=11)
    watch.watch()
    assert CUTTING_TIME_S == 0.5
    # The first cut, and one after each interval.
    assert watch.cuts == 1 + 10
    assert watch._ended.waited_s[:11] == [CHECK_INTERVAL_S] * 11
    used_mib = (MAX_BYTES >> 20) + 9
    assert watch.said == [f"{used_mib} MiB in memory: 22 connections were cut, 30 MiB are left"]


def test_memory_that_stays_in_use_after_a_cut_raises_the_limit():
    left_bytes = MAX_BYTES + 1
    watch = DrawnWatch([left_bytes, left_bytes, left_bytes + SPARE_BYTES, left_bytes + SPARE_BYTES + 1, 0], waits=24)
    watch.watch()
    assert len(watch.said) == 2
    # The second cut was at the check that found more than the new limit, not at the one that found just the limit.
    assert watch.said[1].endswith(", 0 MiB are left")


def test_memory_of_the_tests_cuts_no_connection_of_a_service_in_their_process(pi, capfd):
    """A browser's test lost its connections when the tests before it had grown by more than the limit leaves."""
    memory = bytearray(b"x") * (2 * SPARE_BYTES)
    for _ in range(20):
        assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
        pi.clock.sleep(CHECK_INTERVAL_S)
    assert len(memory) == 2 * SPARE_BYTES
    assert "were cut" not in capfd.readouterr().err
