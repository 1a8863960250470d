"""Who may command a run: the program that began it, and a person at the Pi; and what a hanging program looks like."""

from __future__ import annotations

import select
import socket
import stat
import threading
import time
from pathlib import Path

import msgspec
import pytest

from polysight.pi_controller import executor as executors
from polysight.pi_controller import system
from polysight.pi_controller.client import take_over
from polysight.pi_controller.service import TAKE_OVER_KEY
from polysight.shared import messages as m
from polysight.shared.faults import PiFault


def begin_a_row(pi, stage):
    host = pi.host
    host.accepted(host.begin(owner="mine", heartbeat_ms=10_000))
    host.home()
    stage.pace_s = 0.03
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1, owner="mine"))
    host.wait(m.Capture)


@pytest.mark.parametrize("owner", ["", "other", "min", "mine-"])
def test_whom_the_run_does_not_belong_commands_nothing(pi, stage, owner):
    begin_a_row(pi, stage)
    host = pi.host
    for command in (
        m.Hold(owner=owner), m.Resume(owner=owner), m.Abort(owner=owner), m.Alive(scan_id="scan", owner=owner),
        m.EndRun(scan_id="scan", exit_status="abort", owner=owner),
        m.RunRow(scan_id="scan", row_index=1, take=1, owner=owner),
    ):  # fmt: skip
        reply = host.ask(command)
        assert isinstance(reply, m.Refused), command
        assert reply.number == PiFault.NOT_OWNER
    assert isinstance(host.ask(host.begin(owner=owner)), m.Refused), "its host lives"
    assert host.wait(m.RowFinished).status == "done"
    host.accepted(m.EndRun(scan_id="scan", exit_status="success", owner="mine"))


def test_a_person_at_the_pi_takes_over(pi, stage, instrument):
    begin_a_row(pi, stage)
    journal = Path(instrument.pi.journal_dir)
    assert stat.S_IMODE((journal / TAKE_OVER_KEY).stat().st_mode) == 0o600
    server = pi.service.server
    replace = msgspec.structs.replace
    here = replace(instrument, pi=replace(instrument.pi, command_address=server.command_address))
    assert take_over(here, "hold") == "held"
    assert take_over(here, "resume") == "running"
    take_over(here, "abort")
    assert pi.host.wait(m.RowFinished).status == "aborted"
    pi.host.until_state("ready")
    assert take_over(here, "end") == "homed"


def test_a_dead_hosts_run_is_anybodys(pi):
    """Who promised nothing, or has not kept it, keeps nobody out."""
    host = pi.host
    host.accepted(host.begin(owner="mine"))
    host.accepted(host.begin(owner="another"))
    assert host.ask(m.Abort(owner="mine")).number == PiFault.NOT_OWNER
    host.accepted(m.Abort(owner="another"))


def test_a_hanging_executor_does_not_look_alive(pi, monkeypatch):
    host, released = pi.host, threading.Event()
    monkeypatch.setattr("polysight.pi_controller.server.HUNG_S", 0.5)
    monkeypatch.setattr(executors, "TURN_S", 0.05)
    pi.service.executor.post(lambda: released.wait(60))
    deadline = time.monotonic() + 60
    while not isinstance(reply := host.ask(m.Status()), m.Refused) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert isinstance(reply, m.Refused)
    assert reply.number == PiFault.PROGRAM
    while host.subscriber.poll(0):
        host.subscriber.recv_multipart()
    assert not host.subscriber.poll(300), "no heartbeat while it hangs"
    released.set()
    deadline = time.monotonic() + 60
    while isinstance(host.ask(m.Status()), m.Refused) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert isinstance(host.ask(m.Status()), m.StatusReply)


def test_a_command_that_fails_in_the_program_is_a_refusal(pi, monkeypatch, capfd):
    def fail(*_):
        raise ZeroDivisionError("a fault of this program")

    monkeypatch.setattr(pi.service.executor, "_replay", fail)
    reply = pi.host.ask(m.Replay(scan_id="scan", from_seq=1))
    assert isinstance(reply, m.Refused)
    assert reply.number == PiFault.PROGRAM
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
    assert "ZeroDivisionError" in capfd.readouterr().err, "the log has the trace"


def test_the_watchdog_is_fed_by_the_executor_alone(pi, monkeypatch, tmp_path):
    """A datagram a turn while it turns, none while it hangs (sd_notify(3))."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(str(tmp_path / "notify"))
    listener.settimeout(60)
    monkeypatch.setattr(executors, "TURN_S", 0.2)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    system.notify_systemd("READY=1")
    assert listener.recv(100) == b"READY=1"
    assert {listener.recv(100) for _ in range(2)} == {b"WATCHDOG=1"}
    released, hangs = threading.Event(), threading.Event()
    pi.service.executor.post(lambda: (hangs.set(), released.wait(60)))
    assert hangs.wait(60)
    while select.select([listener], [], [], 0)[0]:
        listener.recv(100)
    listener.settimeout(2 * executors.TURN_S)
    pi.host.ask(m.Status())  # the server lives
    with pytest.raises(TimeoutError):
        listener.recv(100)
    released.set()
    listener.settimeout(60)
    assert listener.recv(100) == b"WATCHDOG=1"
    listener.close()
