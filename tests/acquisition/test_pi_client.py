"""The host's client of the Pi: repeated commands, events in place of lost replies, and questions to a silent Pi."""

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import zmq
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.acquisition import pi_client
from polysight.acquisition.pi_client import ATTEMPTS, PiClient, RefusedError
from polysight.acquisition.ready import make_begin_run
from polysight.acquisition.scan import RunningScan
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.raster import Row, plan_raster

RIG = load_published_rig()
# Row and take of a `RunRow` whose reply is lost.
ROW = 4
TAKE = 2
# Silence after which this client asks the Pi for its status.
SILENCE_LIMIT_S = 5.0
STATUS = m.StatusReply(
    state="ready", homed=True, x_mm=10.0, y_mm=0.0, scan_id="s", row_index=-1, take=0, points=0, pulses=0, last_seq=0,
    fault=0, reason="",
)  # fmt: skip
RUN = make_begin_run(RIG, "s", plan_raster(RIG.grid))


class Clock:
    """Replaces the module `time`. Only `sleep` advances it."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class ScriptedPi(PiClient):
    """A client without sockets: `answer(command)` returns the Pi's reply, or None for a lost reply."""

    def __init__(self, answer: Callable[[Any], Any]) -> None:
        self.answer = answer
        self.sent: list[Any] = []
        self._context = None
        self._instrument = RIG
        self._heartbeat = None
        self._address = "tcp://pi:5601"
        self._timeout_s = 3.0
        self._silence_s = SILENCE_LIMIT_S
        self._on_event = lambda _: None
        self._events = SimpleNamespace(poll=lambda _: 0)
        self._handshake = SimpleNamespace(is_refused=lambda: False, lacks_curve=False)
        self._owner = "this program"
        self._scan_id = "s"
        self._last_seq = 0
        self._last_heard_s = 0.0
        self._pending = deque()
        self.gaps_filled = 0
        self.state = "idle"

    def _send_once(self, command: Any, _: float) -> Any:
        self.sent.append(command)
        reply = self.answer(command)
        if isinstance(reply, m.Refused):
            raise RefusedError(type(command).__name__, reply)
        return reply

    def count(self, kind: type) -> int:
        """Number of commands of a kind that were sent."""
        return sum(isinstance(command, kind) for command in self.sent)


@pytest.fixture
def clock(monkeypatch):
    fake = Clock()
    monkeypatch.setattr(pi_client, "time", fake)
    return fake


@pytest.fixture(autouse=True)
def heartbeats(monkeypatch):
    """Counts of the heartbeats that were started and stopped."""
    counts = {"started": 0, "stopped": 0}

    class Heartbeat:
        def __init__(self, *_: Any) -> None:
            counts["started"] += 1

        def stop(self) -> None:
            counts["stopped"] += 1

    monkeypatch.setattr(pi_client, "HostHeartbeat", Heartbeat)
    return counts


HEARTBEAT_MS = 100


def begin_run(pi: ScriptedPi) -> None:
    pi.begin_run(msgspec.structs.replace(RUN, heartbeat_ms=HEARTBEAT_MS))


def refuse_runs(number: int, scan_id: str, times: int) -> Callable[[Any], Any]:
    """Return the answers of a Pi in which the scan `scan_id` runs.

    It answers questions for its status, refuses the first `times` other commands with the fault `number`, and accepts
    the later ones.
    """
    refusals_left = times

    def answer(command: Any) -> Any:
        nonlocal refusals_left
        if isinstance(command, m.Status):
            return msgspec.structs.replace(STATUS, scan_id=scan_id)
        if refusals_left == 0:
            return m.Accepted(state="ready")
        refusals_left -= 1
        return m.Refused(number=number, problem="another run is alive")

    return answer


@pytest.mark.usefixtures("clock")
def test_a_run_of_this_scan_that_still_counts_as_alive_is_waited_for(heartbeats):
    refusals = 3
    pi = ScriptedPi(refuse_runs(int(PiFault.NOT_READY), "s", times=refusals))
    begin_run(pi)
    assert pi.count(m.BeginRun) == refusals + 1
    assert heartbeats == {"started": 1, "stopped": 0}


def test_a_run_of_this_scan_is_waited_for_ten_heartbeats(clock):
    begin_s = clock.now
    more_refusals_than_requests = 10**6
    pi = ScriptedPi(refuse_runs(int(PiFault.NOT_READY), "s", times=more_refusals_than_requests))
    with expect_refusal(ErrorCode.REFUSED_BY_PEER, "another run is alive"):
        begin_run(pi)
    ten_heartbeats_s = 10 * HEARTBEAT_MS / 1e3
    # The client asks again at intervals of 0.05 s, and may notice the limit one interval late.
    assert clock.now - begin_s == pytest.approx(ten_heartbeats_s, abs=0.05 + 0.01)


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(
    ("number", "scan_id"), [(PiFault.NOT_READY, "another"), (PiFault.EDGE_LOST, "s")], ids=["another scan", "fault"]
)
def test_a_run_that_is_refused_for_another_reason_is_not_requested_again(heartbeats, number, scan_id):
    pi = ScriptedPi(refuse_runs(int(number), scan_id, times=1))
    with expect_refusal(ErrorCode.REFUSED_BY_PEER, "another run is alive"):
        begin_run(pi)
    assert pi.count(m.BeginRun) == 1
    assert heartbeats["started"] == 0


def make_row_event(kind: type, row: int, take: int) -> Any:
    content: dict[str, Any]
    if kind is m.RowStarted:
        content = {"row": Row(index=row, y_mm=0.0, x_start_mm=0.0, step_mm=2.0, points=3), "take": take}
    else:
        content = {"row_index": row, "take": take, "status": "done", "points": 3, "edges": 3, "bursts": 3, "pulses": 6}
    return kind(scan_id="s", seq=1, t_mono_ns=1, **content)


@pytest.mark.parametrize("kind", [m.RowStarted, m.RowFinished])
def test_a_row_whose_reply_is_lost_has_begun_if_there_is_an_event_of_that_take(kind):
    def lose_reply(command: Any) -> Any:
        return STATUS if isinstance(command, m.Status) else None

    pi = ScriptedPi(lose_reply)
    pi._pending.append(make_row_event(kind, ROW, TAKE))
    pi.run_row("s", ROW, TAKE)
    assert pi.count(m.RunRow) == 1
    other_takes = [(ROW, TAKE - 1), (ROW, TAKE + 1), (ROW - 1, TAKE), (ROW + 1, TAKE)]
    for other_row, other_take in other_takes:
        pi = ScriptedPi(lose_reply)
        pi._pending.append(make_row_event(kind, other_row, other_take))
        with expect_refusal(ErrorCode.NO_ANSWER, "RunRow"):
            pi.run_row("s", ROW, TAKE)
        assert pi.count(m.RunRow) == ATTEMPTS


@pytest.mark.parametrize(
    ("state", "row", "take", "has_begun"),
    [
        ("running", ROW, TAKE, True),
        ("held", ROW, TAKE, True),
        ("ready", ROW, TAKE, False),
        ("running", ROW, TAKE - 1, False),
        ("running", ROW - 1, TAKE, False),
    ],
)
def test_a_row_whose_reply_is_lost_has_begun_if_the_pi_runs_or_holds_that_take(state, row, take, has_begun):
    status = msgspec.structs.replace(STATUS, state=state, row_index=row, take=take)
    pi = ScriptedPi(lambda command: status if isinstance(command, m.Status) else None)
    if has_begun:
        pi.run_row("s", ROW, TAKE)
    else:
        with expect_refusal(ErrorCode.NO_ANSWER, "RunRow"):
            pi.run_row("s", ROW, TAKE)
    assert pi.count(m.RunRow) == (1 if has_begun else ATTEMPTS)


@pytest.mark.parametrize(("silent_s", "questions"), [(0.0, 0), (SILENCE_LIMIT_S - 0.1, 0), (SILENCE_LIMIT_S + 0.1, 1)])
def test_only_a_pi_that_is_silent_for_long_is_asked_whether_it_answers(clock, silent_s, questions):
    pi = ScriptedPi(lambda _: STATUS)
    pi._last_heard_s = clock.now - silent_s
    assert pi.events() == []
    assert pi.count(m.Status) == questions


def test_the_error_names_the_event_that_is_missing_in_the_pis_journal():
    """The Pi's status counts 9 events, but its journal has only 7, and the host has them all."""

    def answer(command: Any) -> Any:
        if isinstance(command, m.Status):
            return msgspec.structs.replace(STATUS, last_seq=9)
        return m.ReplayReply(events=[], last_seq=7)

    pi = ScriptedPi(answer)
    pi._last_seq = 7
    with expect_refusal(ErrorCode.NO_DATA, "lacks event 8 (it ends at 7)"):
        pi.drain()


def test_an_interrupted_jog_stops_the_stage(heartbeats):
    """Ctrl-C comes with the third reading of the status, while the stage moves."""
    states = iter(["ready", "jogging"])

    def answer(command: Any) -> Any:
        if isinstance(command, m.Status):
            try:
                return msgspec.structs.replace(STATUS, state=next(states))
            except StopIteration:
                raise KeyboardInterrupt from None
        return m.Accepted(state="jogging")

    pi = ScriptedPi(answer)
    with pytest.raises(KeyboardInterrupt):
        pi.jog("x", distance_mm=5.0, speed_mm_s=10.0)
    last_two_commands = [type(command) for command in pi.sent[-2:]]
    assert last_two_commands == [m.Status, m.Abort]
    assert heartbeats == {"started": 1, "stopped": 1}


def test_a_command_without_a_connection_has_no_reply():
    def raise_again(_: bytes) -> None:
        raise zmq.Again

    # `_send_once` uses nothing of its client but the socket for commands.
    unconnected_client: Any = SimpleNamespace(_commands=SimpleNamespace(send=raise_again))
    assert PiClient._send_once(unconnected_client, m.Status(), timeout_s=1.0) is None


@pytest.mark.parametrize(("lost_events", "is_warned"), [(0, False), (1, True), (7, True)])
def test_a_journal_that_is_shorter_than_the_hosts_events_is_a_warning(tmp_path, lost_events, is_warned):
    """The Pi reports as `lost_events` how many of the host's events its journal lacks, in its event RunStarted."""
    warnings: list[str] = []
    # `_warn_of_lost_events` uses nothing of its scan but the folder and the function that warns.
    scan: Any = SimpleNamespace(_scan=SimpleNamespace(path=tmp_path), _warn=warnings.append)
    run_started = m.RunStarted(scan_id="s", seq=9, t_mono_ns=1, plan=RUN.plan, resumed=True, lost_events=lost_events)
    RunningScan._warn_of_lost_events(scan, [make_row_event(m.RowStarted, ROW, TAKE), run_started])
    assert len(warnings) == int(is_warned)
    assert all(f"ends {lost_events} events before" in warning for warning in warnings)
    assert all(warning.endswith("the scan continues with event 9") for warning in warnings)
