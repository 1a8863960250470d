"""Only the silence of the run's host ends a row; commands of other clients meanwhile. On a clock that tests turn.

The executor's turns are taken by hand, so that what blocks it takes exactly as long as the test says.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.pi.fakes import FakeDriver, FakeLines

from polysight_pi.executor import REPLAYED_IN_A_ROW, Executor
from polysight_pi.journal import Journal
from polysight_pi.trigger import TriggerLoop
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.raster import RasterPlan
from polysight_shared.stage_line import Reply

HEARTBEAT_S = 0.1
LIMIT_S = 4 * HEARTBEAT_S


class SlowDriver(FakeDriver):
    """A stage whose serial line loses an answer: the line is sent again after a while."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench, self.row_takes_s = bench, 0.0

    def row(self, *_: Any) -> int:
        self.bench.t += self.row_takes_s
        return super().row(*_)


class Bench:
    """An executor whose turns the test takes."""

    def __init__(self, folder: Path) -> None:
        self.t = 100.0
        self.events: list[Any] = []
        self.stage = SlowDriver(self)
        loop = TriggerLoop(FakeLines(), lambda _: None, lambda: None)  # not started: no edge comes
        self.journal = Journal(folder, lambda raws: self.events.extend(map(m.unpack_event, raws)))
        stage: Any = self.stage
        self.executor = Executor(stage, loop, self.journal)
        self.executor._machine._clock = lambda: self.t

    def turn(self, *items: Any) -> None:
        for item in items:
            self.executor.post(item)
        self.executor.post(lambda: None)  # so that no turn waits
        self.executor._turn()

    def ask(self, command: m.AnyCommand) -> Any:
        replies: list[m.AnyReply] = []
        assert self.executor.submit(command, replies.append)
        self.turn()
        return replies[0] if replies else None

    def begin(self, scan_id: str = "s", heartbeat_s: float = HEARTBEAT_S) -> Any:
        heartbeat_ms = round(heartbeat_s * 1e3)
        burst = {"pulses": 4, "period_us": 1500.0, "width_us": 1.0, "speed_mm_s": 20.0}
        plan = RasterPlan(40, 2, 2.0, 2.0)
        return self.ask(m.BeginRun(scan_id=scan_id, plan=plan, heartbeat_ms=heartbeat_ms, **burst))

    def ready(self) -> Bench:
        assert isinstance(self.begin(), m.Accepted)
        self.ask(m.Home())
        self.turn(Reply("ok", self.stage.number), Reply("done", self.stage.number))
        assert self.executor.status.state == "ready"
        return self

    def run_row(self) -> Any:
        return self.ask(m.RunRow(scan_id="s", row_index=0, take=1))

    def of(self, kind: type) -> list[Any]:
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
    """A line to the stage is sent again: nothing else is taken meanwhile, so that no `Alive` can come."""
    bench.ready()
    bench.stage.row_takes_s = LIMIT_S + 0.15
    assert isinstance(bench.run_row(), m.Accepted)
    bench.turn()
    assert (bench.state, bench.of(m.Fault)) == ("running", [])
    bench.t += LIMIT_S + 0.001
    bench.turn()
    assert bench.of(m.Fault)[0].number == PiFault.HOST_LOST, "from then on it is watched"


@given(every_s=st.floats(0.01, 0.2), which=st.sampled_from(["events", "another's"]))
@settings(max_examples=20, deadline=None)
def test_another_clients_questions_do_not_keep_a_dead_hosts_row(tmp_path_factory, every_s, which):
    bench = Bench(tmp_path_factory.mktemp("j"))
    bench.ready()
    bench.run_row()
    last = bench.t
    while not bench.of(m.Fault):
        assert bench.t - last <= LIMIT_S + 2 * every_s
        bench.t += every_s
        if which == "events":
            bench.ask(m.Replay(scan_id="s", from_seq=1))
        else:
            bench.ask(m.RunRow(scan_id="another", row_index=0, take=1))
            assert isinstance(bench.executor.host_alive("another", ""), m.Refused)
    assert bench.of(m.Fault)[0].number == PiFault.HOST_LOST
    bench.journal.close()


def test_another_machine_does_not_take_a_pi_whose_host_lives(bench):
    bench.ready()
    bench.t += HEARTBEAT_S
    refused = bench.begin("other")
    assert (refused.number, bool(refused.remedy)) == (PiFault.NOT_READY, True)
    assert (bench.state, bench.executor.status.scan_id) == ("ready", "s"), "nothing has changed"
    assert isinstance(bench.begin("s"), m.Accepted), "its own host may begin anew"
    bench.t += LIMIT_S
    assert isinstance(bench.begin("other"), m.Accepted), "a host that died keeps nobody out"


def test_a_run_whose_host_promised_nothing_may_be_taken_over(bench):
    bench.begin(heartbeat_s=0)
    assert isinstance(bench.begin("other"), m.Accepted)


def test_replies_are_short_while_a_row_runs_and_whole_before_and_after(bench):
    bench.ready()
    for _ in range(60):
        bench.begin()  # each adds an event
    assert len(bench.ask(m.Replay(scan_id="s", from_seq=1)).events) == 61
    bench.run_row()
    paged: list[int] = []
    while (reply := bench.ask(m.Replay(scan_id="s", from_seq=len(paged) + 1))).events:
        assert len(reply.events) <= REPLAYED_IN_A_ROW
        paged += [e.seq for e in reply.events]
    assert paged == list(range(1, reply.last_seq + 1)), "who pages gets them all"
    elsewhere = bench.ask(m.Replay(scan_id="earlier", from_seq=1))
    assert elsewhere.number == PiFault.NOT_READY
    bench.t += LIMIT_S
    bench.turn()
    bench.turn(Reply("alarm", number=15))
    bench.turn()
    assert bench.state == "ready"
    assert len(bench.ask(m.Replay(scan_id="s", from_seq=1)).events) > REPLAYED_IN_A_ROW
    assert bench.ask(m.Replay(scan_id="earlier", from_seq=1)).last_seq == 0
