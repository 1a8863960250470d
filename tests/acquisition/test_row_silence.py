"""A board that sends nothing is reported some time after enough bursts to fill two of its packets."""

import time
from types import SimpleNamespace

import pytest
from tests.support.rigs import make_rig_with

from polysight.acquisition.row import _SilenceCheck

NS_PER_S = 1_000_000_000


def find_silent(rig, received: dict[str, int], bursts: int, age_s: float) -> list[str]:
    """Return the boards reported as silent in a row whose bursts were all sent `age_s` ago.

    `received`: bytes of each board.
    """
    progress = {name: SimpleNamespace(received=count) for name, count in received.items()}
    check = _SilenceCheck(rig, SimpleNamespace(reports=lambda: progress))
    event = SimpleNamespace(received_ns=time.monotonic_ns() - int(age_s * NS_PER_S))
    return check.find_silent_boards([event] * bursts)


@pytest.mark.parametrize("pulses", [1, 2, 16])
def test_a_board_is_silent_if_it_sent_nothing_although_two_packets_were_due(pulses):
    rig = make_rig_with(burst={"pulses": pulses})
    two_packets_bytes = 2 * rig.card.packet_bytes
    burst_bytes = pulses * rig.frame_bytes
    # Bursts whose data fills two packets.
    enough = next(count for count in range(1, 100) if count * burst_bytes >= two_packets_bytes)
    # Longer than a board may be silent.
    long_ago_s = rig.limits.end_of_record_s + 10
    assert find_silent(rig, {"RH": 0, "RV": 1}, enough, long_ago_s) == ["RH"]
    assert find_silent(rig, {"RH": 0, "RV": 0}, enough + 5, long_ago_s) == ["RH", "RV"]
    assert find_silent(rig, {"RH": 1, "RV": 1}, enough, long_ago_s) == []
    assert find_silent(rig, {"RH": 0, "RV": 0}, enough - 1, long_ago_s) == []
    assert find_silent(rig, {"RH": 0, "RV": 0}, enough, age_s=0.0) == []
