"""A take of a row ends with the Pi's report, a request to stop or a time limit; with a scripted Pi and no sockets."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal
from tests.support.rigs import make_rig_with

from polysight.acquisition import pulse_times, row
from polysight.acquisition.control import StopRequest
from polysight.acquisition.row import ON_REQUEST, RowState, RowTaker, RowTransaction, Take, row_limit_s
from polysight.capture import Progress, Status
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault, explain
from polysight_shared.raster import Row

RIG = make_rig_with(limits={"end_of_record_s": 3.0})
PULSES = RIG.burst.pulses
ROW = Row(index=4, y_mm=8.0, x_start_mm=0.0, step_mm=2.0, points=3)
TAKE = 2
STATUS = m.StatusReply(
    state="running", homed=True, x_mm=0.0, y_mm=8.0, scan_id="s", row_index=4, take=2, points=0, pulses=0, last_seq=0,
    fault=0, reason="",
)  # fmt: skip


# By this the clock advances with each look at the Pi's events, and with each look at the boards' progress.
LOOK_S = 0.5


class Clock:
    """Replaces `time`; it advances only by looks."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)


def make_burst(point: int, row_index: int = ROW.index, take: int = TAKE) -> m.Capture:
    return m.Capture(
        scan_id="s", seq=1, t_mono_ns=1, row_index=row_index, take=take, point=point, column=point, pulses=PULSES,
        edge_ns=1, first_pulse_ns=2, last_pulse_ns=3, width_max_ns=1000, jitter_ns=0,
    )  # fmt: skip


def make_end(status: m.RowStatus = "done", row_index: int = ROW.index, take: int = TAKE) -> m.RowFinished:
    return m.RowFinished(
        scan_id="s", seq=1, t_mono_ns=1, row_index=row_index, take=take, status=status, points=3, edges=3, bursts=3,
        pulses=3 * PULSES,
    )  # fmt: skip


BURSTS = [make_burst(point) for point in range(3)]


class Bench:
    """A taker with a scripted Pi, boards and radars.

    `batches` are the events that the Pi sends, one list at each look; `at_events` runs at each look. `journal` are
    events that are lost on the way and are only in the Pi's journal. `progress` is the report of a board.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self.clock = clock
        self.stop = StopRequest()
        self.batches: list[list[Any]] = []
        self.journal: list[Any] = []
        self.status = STATUS
        self.at_events = lambda: None
        self.aborts: list[str] = []
        self.points: list[int] = []
        self.notices: list[str] = []
        self.states: list[RowState] = []
        self.resets: list[str] = []
        self.looks_at_data = 0
        self.is_complete = True
        self.progress = Progress(row=ROW.index, take=TAKE, received=1, complete=False, last_arrival_ns=0)
        self.captures: dict[str, Any] = {}
        # A pipe that is always readable: the taker's poll returns immediately.
        read_end, write_end = os.pipe()
        os.write(write_end, b"x")
        self._pipe = (read_end, write_end)
        self.pi: Any = SimpleNamespace(
            event_socket=read_end, state="running", run_row=lambda *_: None, events=self._events,
            status=lambda: self.status, abort=self.aborts.append, drain=self._drain,
        )  # fmt: skip
        board = SimpleNamespace(fileno=lambda: read_end)
        bench = self

        class Rig:
            def __init__(self) -> None:
                self.receivers = {"RV": board}
                self.cards: dict[str, Any] = {}

            @property
            def complete(self) -> bool:
                return bench.is_complete

            def reports(self) -> dict[str, Progress]:
                bench.looks_at_data += 1
                clock.now += LOOK_S
                return {"RV": bench.progress}

            def statuses(self) -> dict[str, Status]:
                no_bit_set = Status(0)
                return {"RV": no_bit_set}

            def begin_row(self, *_: Any) -> None: ...

            def discard_before(self, _: int) -> None: ...

            def reset_before_next_row(self, name: str) -> None:
                bench.resets.append(name)

            def end_row(self, _: int) -> dict[str, Any]:
                return bench.captures

        radars: Any = SimpleNamespace(
            arm=lambda _: None, states=dict, note_row_start=lambda: None, wait_done=lambda _: []
        )  # fmt: skip
        rig: Any = Rig()
        self._taker = RowTaker(
            instrument=RIG,
            rig=rig,
            radars=radars,
            pi=self.pi,
            scan_id="s",
            folder=folder,
            stop=self.stop,
            on_point=self.points.append,
            notify=lambda _, notice: self.notices.append(notice),
        )

    def _events(self) -> list[Any]:
        self.clock.now += LOOK_S
        self.at_events()
        return self.batches.pop(0) if self.batches else []

    def _drain(self) -> None:
        self.batches.insert(0, self.journal)
        self.journal = []

    def take(self) -> Take:
        return self._taker.take(ROW, TAKE, RowTransaction(self.states.append))

    def close(self) -> None:
        for end in self._pipe:
            os.close(end)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(row, "time", clock)
    new = Bench(tmp_path, clock)
    yield new
    new.close()


def test_events_of_other_rows_and_takes_are_not_this_takes(bench):
    others = [(ROW.index - 1, TAKE), (ROW.index + 1, TAKE), (ROW.index, TAKE - 1), (ROW.index, TAKE + 1)]
    bench.batches = [
        [make_burst(0, *other) for other in others],
        [make_end("fault", *other) for other in others],
        BURSTS[:2],
        [BURSTS[2], make_end()],
    ]
    take = bench.take()
    assert [received.event for received in take.events] == BURSTS
    assert (bench.points, take.finished) == ([1, 2, 3], make_end())
    assert bench.states == [
        RowState.WAITING, RowState.ARMING, RowState.RUNNING, RowState.COLLECTING, RowState.WRITING, RowState.CHECKING,
    ]  # fmt: skip


@pytest.mark.parametrize("state", ["idle", "fault"])
def test_a_pi_that_restarted_within_a_row_is_an_error(bench, state):
    bench.pi.state = state
    bench.status = msgspec.structs.replace(STATUS, state=state, scan_id="")
    with expect_refusal(ErrorCode.STAGE_NOT_READY, "restarted in row 4", "polysight resume"):
        bench.take()


def test_a_pi_that_stopped_within_a_row_is_an_error_with_its_reason(bench):
    number = int(PiFault.STAGE_LOST)
    bench.pi.state = "fault"
    bench.status = msgspec.structs.replace(STATUS, state="fault", fault=number, reason="a cable")
    with expect_refusal(ErrorCode.STAGE_NOT_READY, f"stopped in row 4: {explain(number).problem}: a cable"):
        bench.take()


def test_a_pi_in_a_fault_whose_journal_has_the_rows_end_has_ended_the_row(bench):
    bench.pi.state = "fault"
    bench.status = msgspec.structs.replace(STATUS, state="fault")
    bench.journal = [make_end("fault")]
    assert bench.take().finished == make_end("fault")


def test_the_pis_status_is_believed_rather_than_a_heartbeat_from_before_the_row(bench):
    """The newest heartbeat reports the Pi as idle, but its status reports that the row runs."""
    bench.pi.state = "idle"
    bench.batches = [[], [], [make_end()]]
    assert bench.take().finished == make_end()


@pytest.mark.parametrize("is_stopped", [False, True])
def test_data_is_not_waited_for_if_it_is_complete_or_the_scan_is_to_stop_now(bench, is_stopped):
    bench.batches = [[*BURSTS, make_end()]]
    bench.is_complete = not is_stopped

    def stop_now() -> None:
        # The first request stops after the row, the second one immediately.
        bench.stop.request()
        bench.stop.request()

    if is_stopped:
        bench.at_events = stop_now
    bench.take()
    assert bench.looks_at_data == 0


@pytest.mark.parametrize("last_arrival_s", [0.0, 2.0])
def test_data_is_waited_for_until_nothing_came_for_the_limit(bench, last_arrival_s):
    bench.batches = [[*BURSTS, make_end()]]
    bench.is_complete = False
    # The end of the row comes with the first look.
    ended_s = bench.clock.now + LOOK_S
    arrival_ns = round((ended_s + last_arrival_s) * 1e9)
    bench.progress = Progress(row=ROW.index, take=TAKE, received=1, complete=False, last_arrival_ns=arrival_ns)
    bench.take()
    silence_s = bench.clock.now - ended_s - last_arrival_s
    assert silence_s == pytest.approx(RIG.limits.end_of_record_s, abs=LOOK_S)


def test_a_stop_now_aborts_the_row_once_and_waits_for_its_end(bench):
    def stop_now() -> None:
        # The first request stops after the row, the second one immediately.
        bench.stop.request()
        bench.stop.request()

    bench.at_events = stop_now
    bench.batches = [BURSTS[:1], [], [], [make_end("aborted")]]
    take = bench.take()
    assert (take.aborted, take.finished, bench.aborts) == (ON_REQUEST, make_end("aborted"), [ON_REQUEST.text])
    assert bench.states[3:] == [RowState.ABORTING, RowState.WRITING, RowState.CHECKING]


def test_the_end_of_an_aborted_row_is_waited_for_ten_seconds(bench):
    bench.stop.request()
    bench.at_events = bench.stop.request
    began_s = bench.clock.now
    take = bench.take()
    assert take.finished is None
    # The abort comes with the first look; the taker looks at the clock between two looks.
    waited_s = bench.clock.now - began_s - LOOK_S
    assert waited_s == pytest.approx(row._ABORT_TIMEOUT_S, abs=2 * LOOK_S + 0.1)


def test_a_row_that_does_not_end_is_an_error_after_its_time_limit(bench):
    began_s = bench.clock.now
    with expect_refusal(ErrorCode.NO_ANSWER, "row 4 did not end"):
        bench.take()
    assert bench.clock.now - began_s == pytest.approx(row_limit_s(RIG, ROW), abs=2 * LOOK_S + 0.1)


def test_a_card_whose_frames_contradict_the_pulses_is_reset_before_the_next_row(bench, tmp_path, monkeypatch):
    """The frames of a board are compared with the pulses if its record is located, or whole frames are missing."""
    paths = []

    def find_frames(path: Path, *_: Any) -> pulse_times.PlacedFrames:
        paths.append(path)
        slots = np.arange(3 * PULSES)
        return pulse_times.PlacedFrames(slots, [], 3 * PULSES, contradicted=path.parent.name != "whole")

    monkeypatch.setattr(pulse_times, "find_frames", find_frames)
    bench.captures = {
        "whole": SimpleNamespace(located=True, slipped=False),
        "displaced": SimpleNamespace(located=True, slipped=False),
        "slipped": SimpleNamespace(located=False, slipped=True),
        "lost": SimpleNamespace(located=False, slipped=False),
    }
    bench.batches = [[*BURSTS, make_end()]]
    take = bench.take()
    assert paths == [tmp_path / "raw" / name / "0004.part" for name in ("whole", "displaced", "slipped")]
    assert (list(take.frames), bench.resets) == (["whole", "displaced", "slipped"], ["displaced", "slipped"])


def test_a_held_row_has_no_time_limit_and_one_notice(bench):
    """The row is held just before its limit, for three times the limit. Afterwards the limit counts again from zero."""
    # Number of looks within the limit
    looks = int(row_limit_s(RIG, ROW) / LOOK_S)
    held_from_s = bench.clock.now + (looks - 1) * LOOK_S
    held_until_s = held_from_s + 3 * looks * LOOK_S

    def hold_for_three_limits() -> None:
        is_held = held_from_s <= bench.clock.now < held_until_s
        bench.pi.state = "held" if is_held else "running"

    bench.at_events = hold_for_three_limits
    # The end of the row comes after one limit of running, three of being held, and nearly one more (ten looks less).
    no_events: list[Any] = []
    bench.batches = [*([no_events] * (5 * looks - 10)), [*BURSTS, make_end()]]
    assert bench.take().finished == make_end()
    assert len(bench.notices) == 1
    assert "row 4 is held" in bench.notices[0]
