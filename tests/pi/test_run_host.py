"""Which clients may command a run, whose silence ends a row, and how a hanging program is noticed."""

from __future__ import annotations

import select
import socket
import stat
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from hypothesis import given, settings, strategies as st
from tests.support.pi.fakes import FakeDriver, FakeLines
from tests.support.pi.host_side import Running
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.rigs import set_stage_port

from polysight_pi import executor as executors, system
from polysight_pi.client import home_by_service, take_over
from polysight_pi.executor import REPLAYED_IN_A_ROW, Executor
from polysight_pi.journal import Journal, JournalThread
from polysight_pi.service import TAKE_OVER_KEY
from polysight_pi.trigger import TriggerLoop
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault, StageError
from polysight_shared.raster import RasterPlan
from polysight_shared.stage_line import Reply

HEARTBEAT_S = 0.1
# A host is lost after a silence of four of its heartbeats.
LIMIT_S = 4 * HEARTBEAT_S


class SlowDriver(FakeDriver):
    """A stage that takes `row_takes_s` to accept a row, as when the serial line loses its answer."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self.row_takes_s = 0.0

    def row(self, *_: Any) -> int:
        self.bench.t += self.row_takes_s
        return super().row(*_)


class Bench:
    """An executor whose turns the test runs, with a clock that it sets."""

    def __init__(self, folder: Path) -> None:
        # The clock, seconds.
        self.t = 100.0
        self.events: list[Any] = []
        self.stage = SlowDriver(self)
        # The trigger loop is not started, so that no edge comes; nor is the journal, whose jobs run between turns.
        loop = TriggerLoop(FakeLines(), lambda _: None, lambda: None)
        self.journal = Journal(folder, lambda raws: self.events.extend(map(m.unpack_event, raws)))
        self.journal_thread = JournalThread(self.journal)
        stage: Any = self.stage
        self.executor = Executor(stage, loop, self.journal_thread)
        self.executor._machine._clock = lambda: self.t

    def run_turn(self, *items: Any) -> None:
        for item in items:
            self.executor.post(item)
        # A command that the journal answers needs a second turn. An item in the queue keeps a turn from waiting.
        for _ in range(2):
            self.executor.post(lambda: None)
            self.executor._turn()
            self.journal_thread.do_waiting()

    def ask(self, command: m.AnyCommand) -> Any:
        replies: list[m.AnyReply] = []
        assert self.executor.submit(command, replies.append)
        self.run_turn()
        return replies[0] if replies else None

    def begin_run(self, scan_id: str = "s", heartbeat_s: float = HEARTBEAT_S) -> Any:
        heartbeat_ms = round(heartbeat_s * 1e3)
        burst = {"pulses": 4, "period_us": 1500.0, "width_us": 1.0, "speed_mm_s": 20.0}
        plan = RasterPlan(columns=40, rows=2, step_x_mm=2.0, step_y_mm=2.0)
        return self.ask(m.BeginRun(scan_id=scan_id, plan=plan, heartbeat_ms=heartbeat_ms, **burst))

    def make_ready(self) -> Bench:
        assert isinstance(self.begin_run(), m.Accepted)
        self.ask(m.Home())
        self.run_turn(Reply("ok", self.stage.number), Reply("done", self.stage.number))
        assert self.executor.status.state == "ready"
        return self

    def run_row(self) -> Any:
        return self.ask(m.RunRow(scan_id="s", row_index=0, take=1))

    def list_events(self, kind: type) -> list[Any]:
        return [e for e in self.events if isinstance(e, kind)]

    @property
    def state(self) -> str:
        return self.executor.status.state


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path / "journal")
    yield bench
    bench.journal.close()


def test_a_host_that_waits_for_its_row_to_begin_is_not_silent(bench):
    """While a line to the stage is sent again nothing else is executed, and the host cannot send `Alive`."""
    bench.make_ready()
    bench.stage.row_takes_s = LIMIT_S + 0.15
    assert isinstance(bench.run_row(), m.Accepted)
    bench.run_turn()
    assert (bench.state, bench.list_events(m.Fault)) == ("running", [])
    bench.t += LIMIT_S + 0.001
    bench.run_turn()
    # From the beginning of the row on the host is watched.
    assert bench.list_events(m.Fault)[0].number == PiFault.HOST_LOST


@given(every_s=st.floats(0.01, 0.2), client=st.sampled_from(["events", "another's"]))
@settings(max_examples=20, deadline=None)
def test_questions_of_other_clients_are_no_sign_of_life_of_the_host(tmp_path_factory, every_s, client):
    bench = Bench(tmp_path_factory.mktemp("j"))
    bench.make_ready()
    bench.run_row()
    row_begun_s = bench.t
    while not bench.list_events(m.Fault):
        # The fault comes with the first question after the limit; a question takes two turns.
        assert bench.t - row_begun_s <= LIMIT_S + 2 * every_s
        bench.t += every_s
        if client == "events":
            bench.ask(m.Replay(scan_id="s", from_seq=1))
        else:
            bench.ask(m.RunRow(scan_id="another", row_index=0, take=1))
            assert isinstance(bench.executor.host_alive("another", ""), m.Refused)
    assert bench.list_events(m.Fault)[0].number == PiFault.HOST_LOST
    bench.journal.close()


def test_another_host_cannot_begin_a_run_while_the_first_one_lives(bench):
    bench.make_ready()
    bench.t += HEARTBEAT_S
    refusal = bench.begin_run("other")
    assert refusal.number == PiFault.NOT_READY
    assert refusal.remedy
    # Nothing has changed, and the first host may begin its run again.
    assert (bench.state, bench.executor.status.scan_id) == ("ready", "s")
    assert isinstance(bench.begin_run("s"), m.Accepted)
    # When the first host has been silent for long enough, another one may begin.
    bench.t += LIMIT_S
    assert isinstance(bench.begin_run("other"), m.Accepted)


def test_replays_have_few_events_while_a_row_runs_and_many_before_and_after(bench):
    """A client that asks for one part after another gets all events. Other scans are replayed only between rows."""
    bench.make_ready()
    for _ in range(60):
        # Each request to begin the run adds an event to its journal.
        bench.begin_run()
    assert len(bench.ask(m.Replay(scan_id="s", from_seq=1)).events) == 61
    bench.run_row()
    numbers: list[int] = []
    while (reply := bench.ask(m.Replay(scan_id="s", from_seq=len(numbers) + 1))).events:
        assert len(reply.events) <= REPLAYED_IN_A_ROW
        numbers += [e.seq for e in reply.events]
    assert numbers == list(range(1, reply.last_seq + 1))
    refusal = bench.ask(m.Replay(scan_id="earlier", from_seq=1))
    assert refusal.number == PiFault.NOT_READY

    # The row ends because its host is silent; the stage reports that it was stopped.
    bench.t += LIMIT_S
    bench.run_turn()
    bench.run_turn(Reply("alarm", number=StageError.STOPPED))
    bench.run_turn()
    assert bench.state == "ready"
    assert len(bench.ask(m.Replay(scan_id="s", from_seq=1)).events) > REPLAYED_IN_A_ROW
    assert bench.ask(m.Replay(scan_id="earlier", from_seq=1)).last_seq == 0


@pytest.fixture
def owner_in_row(pi, stage):
    """The host that owns the run, during row 0; the stage stops after its second point."""
    host = pi.host
    host.must_accept(host.make_begin(owner="mine", heartbeat_ms=10_000))
    host.home("mine")
    stage.stays_after = 2
    host.start_row(owner="mine")
    host.wait_for_event(m.Capture)
    return host


@pytest.fixture
def hang(pi):
    """Function that lets the executor hang until the returned event is set."""
    is_hanging = threading.Event()
    released = threading.Event()

    def report_and_hang():
        is_hanging.set()
        released.wait(HANG_S)

    def hang_executor():
        pi.service.executor.post(report_and_hang)
        assert is_hanging.wait(HANG_S)
        return released

    yield hang_executor
    released.set()


def test_only_the_owner_commands_a_run(owner_in_row, stage):
    host = owner_in_row
    for owner in ("", "other", "min", "mine-"):
        for command in (
            m.Hold(owner=owner), m.Resume(owner=owner), m.Abort(owner=owner), m.Alive(scan_id="scan", owner=owner),
            m.EndRun(scan_id="scan", exit_status="abort", owner=owner),
            m.RunRow(scan_id="scan", row_index=1, take=1, owner=owner), m.Home(owner=owner),
        ):  # fmt: skip
            assert host.must_refuse(command) == PiFault.NOT_OWNER, command
        # No other run begins while the host of this one lives.
        assert host.must_refuse(host.make_begin(owner=owner)) == PiFault.NOT_READY
    stage.stays_after = None
    assert host.wait_for_event(m.RowFinished).status == "done"
    # The rule holds between two rows as well.
    assert host.must_refuse(m.Home(owner="other")) == PiFault.NOT_OWNER
    host.must_accept(m.EndRun(scan_id="scan", exit_status="success", owner="mine"))


def test_a_command_for_an_earlier_take_of_a_row_does_not_move_the_stage(host, stage):
    """The numbers of a row's takes only increase: a command for an earlier take is a late copy, or an error.

    The last command may be repeated if its answer was lost, and acts once.
    """
    for row, take in ((1, 1), (2, 1), (1, 2), (1, 4)):
        assert host.run_row(row, take).status == "done"
    for row, take in ((1, 1), (1, 2), (1, 3), (2, 1)):
        earlier_row = m.RunRow(scan_id="scan", row_index=row, take=take)
        assert host.must_refuse(earlier_row) == PiFault.BAD_REQUEST
    # The last command again.
    host.must_accept(m.RunRow(scan_id="scan", row_index=1, take=4))
    assert stage.rows_run == 4
    assert sum(isinstance(e, m.RowStarted) for e in host.replay()) == 4
    # A new run of the same scan continues its takes.
    host.must_accept(host.make_begin())
    assert host.must_refuse(m.RunRow(scan_id="scan", row_index=1, take=4)) == PiFault.BAD_REQUEST
    assert host.run_row(1, 5).status == "done"


def test_takes_increase_across_a_restart_of_the_pi(instrument, stage, hub):
    """The Pi reads the earlier takes from the journal."""
    rig = set_stage_port(instrument, stage.port)
    for first_take in (1, 2):
        with closing(Running(rig, hub)) as running:
            running.host.must_accept(running.host.make_begin())
            running.host.home()
            if first_take > 1:
                earlier_row = m.RunRow(scan_id="scan", row_index=0, take=first_take - 1)
                assert running.host.must_refuse(earlier_row) == PiFault.BAD_REQUEST
            assert running.host.run_row(0, first_take).status == "done"


def make_jog(from_mm: float, distance_mm: float, axis: m.Axis = "x", **changes) -> m.Jog:
    fields = {"speed_mm_s": 20.0, "heartbeat_ms": 10_000, **changes}
    return m.Jog(axis=axis, from_mm=from_mm, distance_mm=distance_mm, **fields)


def test_a_jog_moves_once_and_within_its_limits(host, stage):
    host.must_accept(make_jog(0, 10))
    assert host.wait_for_event(m.Jogged).end_mm == 10.0
    host.wait_for_state("ready")
    # The same jog again is a copy of the command: it begins at 0, and the stage is at 10 mm, 2000 steps.
    host.must_accept(make_jog(0, 10))
    assert [c.args[0] for c in stage.seen if c.verb == "MOVE"] == [2000]
    # From another place than the stage's, beyond a limit, too long, without length, and speeds out of range.
    for invalid_jog in (
        make_jog(0, 20), make_jog(10, -10.1), make_jog(10, 100, "y"), make_jog(10, 0), make_jog(10, 5, speed_mm_s=1e5),
        make_jog(10, 5, speed_mm_s=5e-324), make_jog(10, 100, speed_mm_s=1),
    ):  # fmt: skip
        assert host.must_refuse(invalid_jog) == PiFault.BAD_REQUEST, invalid_jog
    assert sum(c.verb == "MOVE" for c in stage.seen) == 1
    assert any(isinstance(e, m.Jogged) for e in host.replay())
    assert host.run_row(0).status == "done"


def test_a_jog_is_refused_in_a_row_and_to_other_clients_while_the_host_lives(owner_in_row, stage):
    host = owner_in_row
    assert host.must_refuse(make_jog(0, 10, owner="mine")) == PiFault.NOT_READY
    assert host.must_refuse(make_jog(0, 10, owner="other")) == PiFault.NOT_OWNER
    stage.stays_after = None
    host.wait_for_event(m.RowFinished)
    assert host.must_refuse(make_jog(0, 10, owner="other")) == PiFault.NOT_OWNER


def test_a_jog_outside_of_a_run_is_watched_and_aborted(pi, stage):
    host = pi.host
    # The stage is not homed.
    assert host.must_refuse(make_jog(0, 10)) == PiFault.NOT_READY
    host.must_accept(m.Home())
    host.wait_for_state("homed")
    stage.pace_s = 60.0
    host.must_accept(make_jog(0, 10, owner="page"))
    host.must_accept(m.Alive(scan_id="", owner="page"))
    assert host.must_refuse(m.Alive(scan_id="", owner="other")) == PiFault.NOT_READY
    assert host.must_refuse(make_jog(0, 20)) == PiFault.NOT_READY
    host.must_accept(m.Abort(owner="page"))
    assert host.wait_for_event(m.Jogged).status == "aborted"
    host.wait_for_state("homed")


def test_a_host_of_an_older_release_homes_in_its_own_run(pi):
    """A host of an older release sends no owner in `Home`."""
    pi.host.must_accept(pi.host.make_begin(owner="mine", heartbeat_ms=10_000, owns_home=False))
    pi.host.home()


def test_a_person_at_the_pi_takes_over(pi, owner_in_row, instrument):
    # Who can read this file on the Pi may command a run that another host owns.
    key = Path(instrument.pi.journal_dir) / TAKE_OVER_KEY
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    replace = msgspec.structs.replace
    rig_on_pi = replace(instrument, pi=replace(instrument.pi, command_address=pi.service.server.command_address))
    assert take_over(rig_on_pi, "hold") == "held"
    assert take_over(rig_on_pi, "resume") == "running"
    take_over(rig_on_pi, "abort")
    assert owner_in_row.wait_for_event(m.RowFinished).status == "aborted"
    owner_in_row.wait_for_state("ready")
    assert take_over(rig_on_pi, "end") == "homed"


def test_the_commands_on_the_pi_wait_for_a_service_that_answers_late(rig):
    def answer() -> None:
        service.recv()
        time.sleep(0.1)
        service.send(m.pack(m.Refused(number=PiFault.NOT_OWNER, problem="the host is alive")))

    with zmq.Context() as context, context.socket(zmq.REP) as service:
        port = service.bind_to_random_port("tcp://127.0.0.1")
        pi = msgspec.structs.replace(rig.pi, command_address=f"tcp://127.0.0.1:{port}")
        thread = threading.Thread(target=answer)
        thread.start()
        with expect_refusal(ErrorCode.REFUSED_BY_PEER, "the host is alive"):
            home_by_service(msgspec.structs.replace(rig, pi=pi))
        thread.join()


def test_a_run_without_a_heartbeat_can_be_replaced(pi):
    host = pi.host
    host.must_accept(host.make_begin(owner="mine"))
    host.must_accept(host.make_begin(owner="another"))
    assert host.must_refuse(m.Abort(owner="mine")) == PiFault.NOT_OWNER
    host.must_accept(m.Abort(owner="another"))


def test_while_the_executor_hangs_commands_are_refused_and_no_heartbeat_is_sent(pi, hang, monkeypatch):
    host = pi.host
    monkeypatch.setattr("polysight_pi.service.HUNG_S", 0.5)
    monkeypatch.setattr(executors, "TURN_S", 0.05)

    def ask_until(kind):
        """Ask for the status until the reply is of this kind; return it."""
        replies = []

        def is_of_kind() -> bool:
            replies.append(host.ask(m.Status()))
            return isinstance(replies[-1], kind)

        wait_for(is_of_kind, kind.__name__)
        return replies[-1]

    released = hang()
    assert ask_until(m.Refused).number == PiFault.PROGRAM

    def is_silent() -> bool:
        if not host.subscriber.poll(300):
            return True
        # An event that was sent before.
        host.subscriber.recv_multipart()
        return False

    wait_for(is_silent, "no heartbeat while it hangs")
    released.set()
    ask_until(m.StatusReply)


def test_a_command_that_fails_in_the_program_is_a_refusal(pi, monkeypatch, capfd):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(pi.service.executor, "_replay", fail)
    assert pi.host.must_refuse(m.Replay(scan_id="scan", from_seq=1)) == PiFault.PROGRAM
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
    # The log has the traceback.
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_only_the_executor_notifies_the_watchdog(pi, hang, monkeypatch, tmp_path):
    """One datagram per turn, and none while the executor hangs, although the server still answers (sd_notify(3))."""
    monkeypatch.setattr(executors, "TURN_S", 0.2)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(HANG_S)
        system.notify_systemd("READY=1")
        assert listener.recv(100) == b"READY=1"
        assert {listener.recv(100) for _ in range(2)} == {b"WATCHDOG=1"}
        released = hang()
        while select.select([listener], [], [], 0)[0]:
            listener.recv(100)
        listener.settimeout(2 * executors.TURN_S)
        pi.host.ask(m.Status())
        with pytest.raises(TimeoutError):
            listener.recv(100)
        released.set()
        listener.settimeout(HANG_S)
        assert listener.recv(100) == b"WATCHDOG=1"
