"""Core and priority of a receiver, the receive buffer, and warnings if the system grants less."""

import errno
import os
import subprocess

import pytest
from tests.support.paths import REPO
from tests.support.refusals import expect_refusal

from polysight.capture.network import check_receive_buffer, usable_packets
from polysight.capture.receiver import Core, ReceiverProcess, receiver_cores, take_core, take_priority
from polysight_shared.errors import DeviceError, ErrorCode

# Payload bytes of a full packet.
FULL = 1456
RIGHTS = REPO / "host/rights.sh"


def test_receivers_get_cores_of_their_own_and_leave_the_first_to_the_host():
    """With too few cores they share one, marked by False; on a single core they are not pinned."""
    assert receiver_cores(2, [0]) == [None, None]
    assert receiver_cores(2, []) == [None, None]
    assert receiver_cores(2, [0, 1]) == [(1, False), (1, False)]
    assert receiver_cores(3, [0, 1, 2, 5]) == [(5, True), (2, True), (1, True)]
    assert len(receiver_cores(2)) == 2


def test_core_and_priority_are_reported(board):
    core = max(os.sched_getaffinity(0))
    with ReceiverProcess(board, 1 << 20, Core(core, exclusive=True)) as receiver:
        pinned = os.sched_getaffinity(receiver.pid) == {core}
        urgent = os.sched_getscheduler(receiver.pid) == os.SCHED_RR
        assert (f"core {core}" in receiver.scheduling) is pinned
        assert ("real-time" in receiver.scheduling) is urgent
        assert pinned or any("not pinned" in w for w in receiver.warnings)
        assert urgent or any("no real-time priority" in w for w in receiver.warnings)


@pytest.mark.parametrize(("exclusive", "has_priority"), [(True, True), (True, False), (False, True), (False, False)])
def test_a_shared_core_is_taken_with_priority_only(monkeypatch, exclusive, has_priority):
    cores_taken: list[set[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _pid, cores: cores_taken.append(cores))
    core, warning = take_core(1, exclusive, has_priority)
    assert warning == ""
    if exclusive or has_priority:
        assert core == 1
        assert cores_taken == [{1}]
    else:
        assert core is None
        assert cores_taken == []


def test_the_rights_are_written_to_the_files_that_logins_and_desktops_read(tmp_path):
    process = subprocess.run(
        ["sh", RIGHTS, "ada"], env={**os.environ, "ROOT": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert (process.returncode, process.stderr) == (0, "")
    limits = (tmp_path / "etc/security/limits.d/60-polysight.conf").read_text()
    assert limits.splitlines()[-2:] == ["ada - rtprio 10", "ada - nice -10"]
    desktop = (tmp_path / "etc/systemd/system/user@.service.d/60-polysight.conf").read_text()
    assert "LimitRTPRIO=10" in desktop
    assert "LimitNICE=-10" in desktop
    assert f"net.core.rmem_max = {8 << 20}" in (tmp_path / "etc/sysctl.d/60-polysight.conf").read_text()
    for arguments in ([], ["a b"], ["ada; reboot"]):
        process = subprocess.run(["sh", RIGHTS, *arguments], env={**os.environ, "ROOT": str(tmp_path)}, check=False)
        assert process.returncode == 2


def test_without_permission_core_and_priority_are_warnings(monkeypatch):
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    for name in ("sched_setaffinity", "sched_setscheduler", "setpriority"):
        monkeypatch.setattr(os, name, refuse)
    assert take_core(None) == (None, "")
    core, cause = take_core(1)
    assert core is None
    assert "not pinned to core 1" in cause
    priority, cause = take_priority()
    assert priority.startswith("nice ")
    assert cause == "no real-time priority: Operation not permitted; nice -5: Operation not permitted"


def test_buffer_below_two_bursts_is_refused_with_the_command(tmp_path):
    limit = tmp_path / "rmem_max"
    limit.write_text("212992\n")
    # 16 frames of 4096 bytes, 64 KiB. The sizes in bytes are the granted and the requested one.
    burst = 16 * 4096
    assert check_receive_buffer("RH", 8 << 20, 8 << 20, burst, limit) == ""
    warning = check_receive_buffer("RH", 212_992, 8 << 20, burst, limit)
    assert "212992 bytes granted" in warning
    assert "net.core.rmem_max is 212992" in warning
    assert "`sysctl -w net.core.rmem_max=8388608`" in warning
    with expect_refusal(ErrorCode.VALUE_INVALID, "`sysctl -w net.core.rmem_max=8388608`"):
        check_receive_buffer("RH", 100_000, 8 << 20, burst, limit)
    with expect_refusal(ErrorCode.VALUE_INVALID, "`sysctl -w net.core.rmem_max=", "net.core.rmem_max limits it"):
        check_receive_buffer("RH", 8192, 1 << 20, burst, tmp_path / "absent")
    with expect_refusal(ErrorCode.VALUE_INVALID, "card.receive_buffer_bytes"):
        check_receive_buffer("RH", 8192, 8192, burst, tmp_path / "absent")


def test_a_buffer_of_exactly_two_bursts_is_enough(tmp_path):
    """Linux grants twice the bytes, and a full packet of 1456 bytes takes 2304."""
    kernel_bytes_a_packet = 2304
    assert usable_packets(kernel_bytes_a_packet) == 2
    assert usable_packets(kernel_bytes_a_packet - 1) == 1
    assert usable_packets(kernel_bytes_a_packet // 2) == 1
    burst = 50 * FULL
    packets_of_two_bursts = 2 * 50
    granted = packets_of_two_bursts * kernel_bytes_a_packet // 2
    no_file = tmp_path / "absent"
    assert check_receive_buffer("RH", granted, granted, burst, no_file) == ""
    assert check_receive_buffer("RH", granted + 1, granted, burst, no_file) == ""
    with expect_refusal(ErrorCode.VALUE_INVALID, f"{granted} bytes, less than two bursts of {burst + 1}"):
        check_receive_buffer("RH", granted, granted, burst + 1, no_file)
    assert "granted" in check_receive_buffer("RH", granted, granted + 1, burst, no_file)
    # The advised size has room for two bursts and two packets more; the request is half of what Linux then grants.
    advised_bytes = (packets_of_two_bursts + 2) * kernel_bytes_a_packet // 2
    with expect_refusal(ErrorCode.VALUE_INVALID, f"rmem_max={advised_bytes}`"):
        check_receive_buffer("RH", 1000, 1000, burst, no_file)


@pytest.mark.parametrize(("granted", "needed"), [(8192, 8192), (16384, 8192), (8192, 8193), (8192, 1 << 23)])
def test_a_buffer_too_small_is_blamed_on_the_kernel_or_on_the_rig_file(tmp_path, granted, needed):
    burst = 16 * 4096
    limit = tmp_path / "rmem_max"
    limit.write_text("8192\n")
    with pytest.raises(DeviceError) as e:
        check_receive_buffer("RH", granted, needed, burst, limit)
    if granted < needed:
        assert e.value.why == "net.core.rmem_max is 8192"
        assert "receive_buffer_bytes" not in e.value.remedy
        return
    assert "card.receive_buffer_bytes" in e.value.why
    enough = int(e.value.remedy.split("receive_buffer_bytes = ")[1].split()[0])
    assert usable_packets(enough) * FULL >= 2 * burst
    assert check_receive_buffer("RH", enough, enough, burst, limit) == ""
