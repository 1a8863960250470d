"""Where and how urgently a receiver runs, what buffer the kernel grants, and what is said when it is too little."""

from __future__ import annotations

import os

import pytest

from polysight.host.capture.network import check_receive_buffer, usable_packets
from polysight.host.capture.receiver import ReceiverProcess
from polysight.host.capture.scheduling import receiver_cores, take_core, take_priority
from polysight.shared.errors import DeviceError

FULL = 1456


def test_cores_leave_the_first_to_the_host():
    assert receiver_cores(2, [0]) == [None, None]
    assert receiver_cores(2, []) == [None, None]
    assert receiver_cores(2, [0, 1]) == [1, 1]
    assert receiver_cores(3, [0, 1, 2, 5]) == [5, 2, 1]
    assert len(receiver_cores(2)) == 2


def test_where_and_how_urgently_it_runs_is_said(board):
    core = max(os.sched_getaffinity(0))
    with ReceiverProcess(board, 1 << 20, core) as receiver:
        pinned = os.sched_getaffinity(receiver.pid) == {core}
        urgent = os.sched_getscheduler(receiver.pid) == os.SCHED_RR
        assert (f"core {core}" in receiver.scheduling) is pinned
        assert ("real-time" in receiver.scheduling) is urgent
        assert pinned or any("not pinned" in w for w in receiver.warnings)
        assert urgent or any("no real-time priority" in w for w in receiver.warnings)


def test_what_is_not_permitted_is_said(monkeypatch):
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    for name in ("sched_setaffinity", "sched_setscheduler", "setpriority"):
        monkeypatch.setattr(os, name, refuse)
    assert take_core(None) == (None, "")
    core, why = take_core(1)
    assert core is None
    assert "not pinned to core 1" in why
    priority, why = take_priority()
    assert priority.startswith("nice ")
    assert why == "no real-time priority: Operation not permitted; nice -5: Operation not permitted"


def test_buffer_below_two_bursts_is_refused_with_the_command(tmp_path):
    limit = tmp_path / "rmem_max"
    limit.write_text("212992\n")
    burst = 16 * 4096
    assert check_receive_buffer("RH", 8 << 20, 8 << 20, burst, limit) == ""
    warning = check_receive_buffer("RH", 212_992, 8 << 20, burst, limit)
    assert "212992 bytes granted" in warning
    assert "net.core.rmem_max is 212992" in warning
    assert "`sysctl -w net.core.rmem_max=8388608`" in warning
    with pytest.raises(DeviceError, match="less than two bursts") as e:
        check_receive_buffer("RH", 100_000, 8 << 20, burst, limit)
    assert "`sysctl -w net.core.rmem_max=8388608`" in e.value.remedy
    with pytest.raises(DeviceError) as e:
        check_receive_buffer("RH", 8192, 8192, burst, tmp_path / "absent")
    enough = int(e.value.remedy.split("receive_buffer_bytes = ")[1].split()[0])
    assert usable_packets(enough) * FULL >= 2 * burst
    assert check_receive_buffer("RH", enough, enough, burst, limit) == ""
