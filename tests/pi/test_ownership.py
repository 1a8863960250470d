"""Who may command a run: the program that began it, and a person at the Pi; and the signs of a hanging program."""

from __future__ import annotations

import select
import socket
import stat
import threading
import time
from pathlib import Path

import msgspec
import pytest

from polysight_pi import executor as executors
from polysight_pi import system
from polysight_pi.client import take_over
from polysight_pi.service import TAKE_OVER_KEY
from polysight_shared import messages as m
from polysight_shared.faults import PiFault


@pytest.fixture
def owner_in_row(pi, stage):
    """The host that owns the run, during row 0."""
    host = pi.host
    host.accepted(host.begin(owner="mine", heartbeat_ms=10_000))
    host.home()
    stage.pace_s = 0.05
    host.start_row(owner="mine")
    host.wait(m.Capture)
    return host


@pytest.fixture
def hang(pi):
    """Lets the executor hang, until the returned event is set."""
    hangs, released = threading.Event(), threading.Event()

    def hang():
        pi.service.executor.post(lambda: (hangs.set(), released.wait(60)))
        assert hangs.wait(60)
        return released

    yield hang
    released.set()


def test_only_the_owner_commands_a_run(owner_in_row):
    host = owner_in_row
    for owner in ("", "other", "min", "mine-"):
        for command in (
            m.Hold(owner=owner), m.Resume(owner=owner), m.Abort(owner=owner), m.Alive(scan_id="scan", owner=owner),
            m.EndRun(scan_id="scan", exit_status="abort", owner=owner),
            m.RunRow(scan_id="scan", row_index=1, take=1, owner=owner),
        ):  # fmt: skip
            assert host.refused(command) == PiFault.NOT_OWNER, command
        assert host.refused(host.begin(owner=owner)) == PiFault.NOT_READY, "its host is alive"
    assert host.wait(m.RowFinished).status == "done"
    host.accepted(m.EndRun(scan_id="scan", exit_status="success", owner="mine"))


def test_a_person_at_the_pi_takes_over(pi, owner_in_row, instrument):
    key = Path(instrument.pi.journal_dir) / TAKE_OVER_KEY
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    replace = msgspec.structs.replace
    here = replace(instrument, pi=replace(instrument.pi, command_address=pi.service.server.command_address))
    assert take_over(here, "hold") == "held"
    assert take_over(here, "resume") == "running"
    take_over(here, "abort")
    assert owner_in_row.wait(m.RowFinished).status == "aborted"
    owner_in_row.until_state("ready")
    assert take_over(here, "end") == "homed"


def test_a_run_without_a_heartbeat_can_be_replaced(pi):
    host = pi.host
    host.accepted(host.begin(owner="mine"))
    host.accepted(host.begin(owner="another"))
    assert host.refused(m.Abort(owner="mine")) == PiFault.NOT_OWNER
    host.accepted(m.Abort(owner="another"))


def test_a_hanging_executor_does_not_look_alive(pi, hang, monkeypatch):
    """Commands are refused and no heartbeat is sent, until it runs again."""
    host = pi.host
    monkeypatch.setattr("polysight_pi.service.HUNG_S", 0.5)
    monkeypatch.setattr(executors, "TURN_S", 0.05)

    def until(kind):
        deadline = time.monotonic() + 60
        while not isinstance(reply := host.ask(m.Status()), kind):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return reply

    released = hang()
    assert until(m.Refused).number == PiFault.PROGRAM
    while host.subscriber.poll(0):
        host.subscriber.recv_multipart()
    assert not host.subscriber.poll(300), "no heartbeat while it hangs"
    released.set()
    until(m.StatusReply)


def test_a_command_that_fails_in_the_program_is_a_refusal(pi, monkeypatch, capfd):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(pi.service.executor, "_replay", fail)
    assert pi.host.refused(m.Replay(scan_id="scan", from_seq=1)) == PiFault.PROGRAM
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
    assert "ZeroDivisionError" in capfd.readouterr().err, "the log has the trace"


def test_the_watchdog_is_fed_by_the_executor_alone(pi, hang, monkeypatch, tmp_path):
    """One datagram per turn, none while it hangs (sd_notify(3))."""
    monkeypatch.setattr(executors, "TURN_S", 0.2)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(60)
        system.notify_systemd("READY=1")
        assert listener.recv(100) == b"READY=1"
        assert {listener.recv(100) for _ in range(2)} == {b"WATCHDOG=1"}
        released = hang()
        while select.select([listener], [], [], 0)[0]:
            listener.recv(100)
        listener.settimeout(2 * executors.TURN_S)
        pi.host.ask(m.Status())  # the server is alive
        with pytest.raises(TimeoutError):
            listener.recv(100)
        released.set()
        listener.settimeout(60)
        assert listener.recv(100) == b"WATCHDOG=1"
