"""A stop does not wait for a hanging disk, for sockets, or for a hanging thread.

The campaign (`--long`) measures the time to STOP at a hundred moments.
"""

import math
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import msgspec
import pytest
from tests.support.pi.host_side import Running
from tests.support.processes import HANG_S, wait_for
from tests.support.rigs import set_stage_port

from polysight_pi import executor as executors, journal as journals, stage as stages
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.stage_line import Immediate

# After the loss of the host the stage begins to stop within this time (docs/spec/wire.md).
SAFE_WITHIN_S = 0.5
# Silence after which a part of the program counts as hanging, in these tests; 3 s in the program.
LATE_S = 0.6
OWNER = "mine"


class FrozenDisk:
    """Writes and syncs of the journal block until :meth:`thaw`, as on a file system that was frozen (fsfreeze)."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._frozen = False
        self._thawed = threading.Event()
        self.blocked = threading.Event()
        for name in ("fsync", "pwrite"):
            patch.setattr(os, name, self._make_freezable(getattr(os, name)))

    def _make_freezable(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def wait_and_call(*args: Any) -> Any:
            if self._frozen:
                self.blocked.set()
                self._thawed.wait(HANG_S)
            return call(*args)

        return wait_and_call

    def freeze(self) -> None:
        self.blocked.clear()
        self._thawed.clear()
        self._frozen = True

    def thaw(self) -> None:
        self._frozen = False
        self._thawed.set()


@pytest.fixture
def disk(monkeypatch) -> Iterator[FrozenDisk]:
    disk = FrozenDisk(monkeypatch)
    yield disk
    disk.thaw()


@pytest.fixture
def owned_run(pi, stage):
    """A begun run with an owner; the stage is homed, and stops in a row after its second point."""
    pi.host.must_accept(pi.host.make_begin(owner=OWNER))
    pi.host.home(OWNER)
    stage.stays_after = 2
    return pi.host


def stop_is_sent(stage) -> bool:
    return Immediate.STOP in stage.bytes_seen


def test_abort_stops_and_is_answered_while_the_disk_hangs(owned_run, stage, disk):
    owned_run.start_row(owner=OWNER)
    owned_run.wait_for_event(m.Capture)
    events_before = len(owned_run.journalled)
    disk.freeze()
    stage.stays_after = 4
    assert disk.blocked.wait(HANG_S)
    stage.bytes_seen.clear()
    owned_run.must_accept(m.Abort(owner=OWNER))
    wait_for(lambda: stop_is_sent(stage), "STOP")
    owned_run.wait_for_state("ready")
    assert not owned_run.list_events(m.RowFinished), "what is not journalled is not published"
    disk.thaw()
    assert owned_run.wait_for_event(m.RowFinished).status == "aborted"
    assert [e.seq for e in owned_run.replay()] == list(range(1, owned_run.journalled[-1].seq + 1))
    assert len(owned_run.journalled) > events_before


@pytest.mark.parametrize("host_lives", [True, False])
def test_a_hanging_disk_ends_the_row_whether_its_host_lives_or_not(disk, pi, stage, monkeypatch, host_lives):
    """The silence of a host ends the row as always. With a living host the disk ends it, and the watchdog expires.

    A host that announced no heartbeat (0) counts as living.
    """
    monkeypatch.setattr("polysight_pi.service.LATE_S", LATE_S)
    host = pi.host
    host.must_accept(host.make_begin(heartbeat_ms=0 if host_lives else 100, owner=OWNER))
    host.home(OWNER)
    stage.stays_after = 2
    pi.clock.stands = True
    host.start_row(owner=OWNER)
    disk.freeze()
    stage.stays_after = 4
    pi.clock.stands = False
    wait_for(lambda: stop_is_sent(stage), "STOP")
    expected_fault = PiFault.PROGRAM_LATE if host_lives else PiFault.HOST_LOST
    assert host.wait_for_state("ready").fault == expected_fault
    # An entry for each time that the watchdog is notified.
    notified: list[bool] = []
    monkeypatch.setattr(pi.service.executor, "_turned", lambda: notified.append(True))
    wait_for(lambda: pi.service._find_late() != "", "that the journal is late")
    notified.clear()
    pi.clock.sleep(3 * executors.TURN_S)
    # The watchdog is notified only if every part of the program is in time.
    assert not notified
    disk.thaw()
    assert host.wait_for_event(m.RowFinished).fault == expected_fault
    wait_for(lambda: bool(notified), "that the watchdog is notified again")


def test_sockets_are_served_between_rare_heartbeats(instrument, stage, hub):
    """A Pi without events is not late, however rarely it reports: otherwise the watchdog would end the service."""
    settings = msgspec.structs.replace(instrument.pi, heartbeat_ms=3_600_000)
    rig = msgspec.structs.replace(instrument, pi=settings)
    with closing(Running(set_stage_port(rig, stage.port), hub)) as pi:
        # Without a stage there are no statuses to send, either.
        stage.unplug()
        pi.host.wait_for_state("fault")
        pi.clock.sleep(LATE_S)
        wait_for(lambda: pi.service.server.find_late(LATE_S) == "", "that each socket is served")


def test_after_a_pause_of_the_whole_program_the_fault_does_not_name_one_part_only(host_in_row, pi, monkeypatch):
    """On a busy machine the executor, which judges the others, is as late as they are."""
    monkeypatch.setattr(executors, "LATE_S", LATE_S)

    def pause() -> None:
        pi.clock.sleep(1.5 * LATE_S)
        monkeypatch.setattr(pi.service.executor, "_find_late", lambda: "the event socket has not been served")

    pi.service.executor.post(pause)
    finished = host_in_row.wait_for_event(m.RowFinished)
    assert finished.fault == PiFault.PROGRAM_LATE
    assert "served; this program did not run for" in finished.reason


def test_a_command_of_a_run_is_accepted_only_when_its_event_is_on_the_disk(disk, pi):
    """The commands are those that begin a run, start a row, or end the run. Others are answered meanwhile."""
    host = pi.host
    commands: list[Any] = [host.make_begin(), m.RunRow(scan_id="scan", row_index=0, take=1)]
    commands.append(m.EndRun(scan_id="scan", exit_status="success"))
    for command in commands:
        disk.freeze()
        answers: list[Any] = []
        assert pi.service.executor.submit(command, answers.append)
        assert disk.blocked.wait(HANG_S)
        kinds_before = {type(e) for e in host.journalled}
        assert isinstance(host.ask(m.Status()), m.StatusReply)
        assert not answers
        disk.thaw()
        wait_for(lambda: bool(answers), "an answer")  # noqa: B023
        assert isinstance(answers[0], m.Accepted), answers
        stored, _ = pi.service._journal._journal.read("scan", from_seq=1, limit=99)
        assert {type(m.unpack_event(raw)) for raw in stored} > kinds_before
        if isinstance(command, m.BeginRun):
            host.home()
        elif isinstance(command, m.RunRow):
            host.wait_for_event(m.RowFinished)


@pytest.mark.usefixtures("host")
def test_a_full_queue_of_the_journal_loses_no_reply(pi, stage):
    """Requests that wait for the journal are answered once there is room."""
    # The first job of the journal waits, and the queue behind it is filled.
    go_on = threading.Event()
    pi.service._journal.call(lambda _: go_on.wait(HANG_S), lambda _: None)
    for _ in range(journals.JOBS_WAITING + 1):
        pi.service._journal.call(lambda _: None, lambda _: None)
    answers: list[Any] = []
    assert pi.service.executor.submit(m.RunRow(scan_id="scan", row_index=0, take=1), answers.append)
    wait_for(lambda: stage.rows_run == 1, "the row")
    go_on.set()
    wait_for(lambda: bool(answers), "an answer")
    assert isinstance(answers[0], m.Accepted), answers


def test_events_beyond_the_queue_of_a_hanging_disk_are_dropped_with_one_error(tmp_path):
    """Events that wait must not fill the memory."""
    journal = journals.JournalThread(journals.Journal(tmp_path))
    errors: list[Any] = []
    for _ in range(journals.JOBS_WAITING + journals.EVENTS_WAITING + 10):
        journal.add(m.RunStopped, exit_status="abort")
        journal.commit(errors.append)
    assert len(errors) == 1
    assert errors[0].number == PiFault.JOURNAL_FULL
    journal.do_waiting()
    journal.stop(0.0)


def test_an_executor_that_hangs_stops_the_stage(pi, stage, monkeypatch):
    """Another thread requests the stage's status, so that its requests do not show that the executor lives.

    They end when the executor hangs, and STOP is sent.
    """
    monkeypatch.setattr(stages, "CALLER_LATE_S", LATE_S)
    host = pi.host
    host.must_accept(host.make_begin())
    host.home()
    stage.stays_after = 2
    host.start_row()
    host.wait_for_event(m.Capture)
    go_on = threading.Event()
    pi.service.executor.post(lambda: go_on.wait(HANG_S))
    wait_for(lambda: stop_is_sent(stage), "STOP")
    status_requests = stage.bytes_seen.count(Immediate.STATUS)
    pi.clock.sleep(LATE_S)
    # Without requests the stage's own heartbeat would stop it as well.
    assert stage.bytes_seen.count(Immediate.STATUS) == status_requests
    go_on.set()
    assert host.wait_for_event(m.RowFinished).fault == PiFault.STAGE_LOST


@pytest.mark.parametrize("socket", ["command", "event"])
def test_sockets_that_hang_stop_the_motion(pi, stage, monkeypatch, socket):
    monkeypatch.setattr("polysight_pi.service.LATE_S", LATE_S)
    server = pi.service.server
    host = pi.host
    go_on = threading.Event()
    host.must_accept(host.make_begin())
    host.home()
    stage.stays_after = 2
    host.start_row()
    host.wait_for_event(m.Capture)
    method_name = "_send_replies" if socket == "command" else "_publish_heartbeat"
    method = getattr(server, method_name)

    def hang_and_call(*arguments):
        go_on.wait(HANG_S)
        return method(*arguments)

    monkeypatch.setattr(server, method_name, hang_and_call)
    wait_for(lambda: stop_is_sent(stage), "STOP")
    go_on.set()
    row_finished = host.wait_for_event(m.RowFinished)
    assert row_finished.fault == PiFault.PROGRAM_LATE
    assert socket in row_finished.reason


# Program of subscribers to events that all disconnect together. Arguments: the address, the number of subscribers, and
# the number of topics of each.
LEAVE = """
import random, sys, time, zmq
address, subscribers, topics = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
context = zmq.Context()
context.max_sockets = subscribers + 100
rng = random.Random(subscribers)
sockets = [context.socket(zmq.SUB) for _ in range(subscribers)]
for s in sockets:
    s.connect(address)
    for _ in range(topics):
        s.setsockopt(zmq.SUBSCRIBE, b"event" + rng.randbytes(400))
time.sleep(1.0)
for s in sockets:
    s.close(linger=0)
context.term()
"""


def test_subscribers_that_disconnect_together_delay_no_command(
    start, instrument, hub, request, record_testsuite_property
):
    """The publisher's next send then lasts long: libzmq removes the subscribers within it."""
    is_campaign = request.config.getoption("--long")
    program, host = start(instrument, "--wires", hub)
    host.must_accept(host.make_begin(owner=OWNER))
    arguments = [program.events_line[1], "1000" if is_campaign else "100", "1"]
    longest_s = 0.0
    with subprocess.Popen([sys.executable, "-c", LEAVE, *arguments]) as leaving:
        left_s = math.inf
        while time.monotonic() < left_s + 2.0:
            begin_s = time.monotonic()
            host.must_accept(m.Alive(scan_id="scan", owner=OWNER))
            longest_s = max(longest_s, time.monotonic() - begin_s)
            time.sleep(0.005)
            if leaving.poll() is not None:
                left_s = min(left_s, time.monotonic())
    record_testsuite_property("longest_answer_to_alive_ms", longest_s * 1e3)
    assert leaving.returncode == 0
    # 0.1 s is a quarter of the time for which a host with a heartbeat of 100 ms may be silent.
    assert longest_s < (0.1 if is_campaign else HANG_S)


@pytest.mark.slow
def test_whenever_the_disk_hangs_the_stage_is_stopped_in_time(
    disk, pi, stage, instrument, request, record_testsuite_property
):
    """STOP is sent within half a second of the last heartbeat, or of the command to abort, wherever the disk hangs.

    In a third of the moments the stage's answer is lost, so that the row's command is sent again while it runs.
    """
    moments = 4
    moments_of_a_minute: tuple[int, ...] = ()
    if request.config.getoption("--long"):
        moments = 100
        moments_of_a_minute = (1, 50, 100)
    host = pi.host
    rng = random.Random(36)
    longest_s = 0.0
    # The host may be silent for four of these, 0.36 s; the rest of half a second is for the program.
    heartbeat_ms = 90
    stage.pace_s = 0.02
    stage.stays_after = instrument.grid.columns
    host.must_accept(host.make_begin(owner=OWNER, heartbeat_ms=heartbeat_ms))
    host.home(OWNER)
    for take in range(1, moments + 1):
        stage.bytes_seen.clear()
        aborts = rng.random() < 0.5
        host.must_accept(host.make_begin(owner=OWNER, heartbeat_ms=0 if aborts else heartbeat_ms))
        freeze_before = rng.random() < 0.3
        if freeze_before:
            disk.freeze()
        if rng.random() < 0.3:
            stage.damage = 1
        answers: list[Any] = []
        pi.service.executor.submit(m.RunRow(scan_id="scan", row_index=0, take=take, owner=OWNER), answers.append)
        wait_for(lambda: stage.moving, "motion")
        time.sleep(rng.uniform(0.0, 0.15))
        disk.freeze()
        begin_s = time.monotonic()
        if aborts:
            pi.service.executor.submit(m.Abort(owner=OWNER), lambda _: None)
        else:
            pi.service.executor.host_alive("scan", OWNER)
        while not stop_is_sent(stage):
            time.sleep(0.001)
            assert time.monotonic() - begin_s < HANG_S
        longest_s = max(longest_s, time.monotonic() - begin_s)
        if take in moments_of_a_minute:
            time.sleep(60.0)
        else:
            time.sleep(rng.uniform(0.0, 0.05))
        disk.thaw()
        host.wait_for_state("ready")
    record_testsuite_property("longest_time_to_stop_ms", longest_s * 1e3)
    if request.config.getoption("--long"):
        assert longest_s < SAFE_WITHIN_S
