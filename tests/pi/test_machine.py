"""Laws of the state machine and of the checks before and during a row, with a clock set by tests."""

import re
from collections.abc import Callable
from contextlib import suppress
from typing import get_args

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from tests.support.paths import REPO
from tests.support.pi.machine_bench import ROW, Bench
from tests.support.rigs import load_published_rig

from polysight.planning.forecast import row_motion_s
from polysight_pi.executor import check_run, read_burst
from polysight_pi.machine import RefusedError
from polysight_pi.motions import estimate_row_duration_s
from polysight_pi.rules import RULES, TIMEOUTS_S, WIRE_STATE, State
from polysight_pi.stage import IDLE_STATUS_S, SILENT_AT_REST_S, STATUS_PER_HEARTBEAT, StatusWatch
from polysight_pi.trigger import LOOK_UP_S, LoopFault, TriggerWatch
from polysight_shared import messages as m
from polysight_shared.faults import PiFault, StageError
from polysight_shared.raster import MIN_PERIOD_US, WIDTH_US, Burst, plan_raster
from polysight_shared.stage_line import Immediate, Reply

SAFE_WITHIN_S = 0.5
ROW_STATES = ("running", "held", "stopping", "done", "ending")
SPEC_PAGE = (REPO / "docs/spec/wire.md").read_text(encoding="utf-8").split("## State machine\n")[1].split("\n## ")[0]


def test_a_fresh_machine_has_no_fault_and_nothing_to_wait_for():
    machine = Bench().machine
    assert (machine.state, machine.fault, machine.reason) == ("idle", 0, "")
    assert (machine.homed, machine.in_run, machine.row, machine.lost_mm) == (False, False, None, (0.0, 0.0))


@pytest.mark.parametrize("motion", ["homing", "row before its first point"])
def test_a_reset_whose_banner_was_lost_is_noticed_in_time(motion):
    bench = Bench().begin_and_home()
    if motion == "homing":
        bench.machine.command("Home")
        bench.run_posted()
        bench.send_reply(Reply("ok", bench.stage.number))
    else:
        bench.start()
    for _ in range(2 * STATUS_PER_HEARTBEAT * 2):  # of two seconds
        bench.send_status(0, state="idle")
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.STAGE_LOST)
    assert not bench.machine.homed


def test_a_row_that_does_not_end_is_given_up_after_half_a_minute_and_three_times_its_duration():
    long_row = msgspec.structs.replace(ROW, points=400)
    for row in (ROW, long_row):
        bench = Bench().begin_and_home()
        limit_s = 30 + 3 * estimate_row_duration_s(row, bench.stage.config, 20.0)
        bench.start(row)
        bench.let_time_pass(limit_s - 0.1)
        assert bench.machine.state == "running"
        bench.let_time_pass(0.2)
        assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.STAGE_LOST)


@pytest.mark.parametrize("place", [(500, 0), (0, -1)])
def test_a_homing_that_does_not_end_at_zero_is_a_fault(place):
    bench = Bench().begin_and_home()
    bench.machine.command("Home")
    bench.run_posted()
    bench.send_reply(Reply("ok", bench.stage.number))
    x, y = map(str, place)
    bench.send_reply(Reply("done", bench.stage.number, fields={"x": x, "y": y}))
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.POSITION)
    assert not bench.machine.homed


def test_the_last_edge_is_awaited_in_done_and_then_no_longer():
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_edge()
    bench.send_edge()
    bench.end_row()
    assert bench.machine.state == "done"
    bench.let_time_pass(2.0)
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.status, finished.fault) == ("fault", PiFault.POINTS_MISMATCH)
    assert bench.machine.state == "ready"


@pytest.mark.parametrize(("dx", "dy"), [(0, 1), (1, 0), (0, 20_000), (-4000, 0)])
def test_a_row_that_ends_elsewhere_is_not_counted(dx, dy):
    """The Pi does not rely on the stage's report: the position is compared with the command."""
    bench = Bench().begin_and_home()
    bench.start()
    for _ in range(3):
        bench.send_edge()
    bench.end_row(dx, dy)
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.status, finished.fault) == ("fault", PiFault.POSITION)
    assert bench.machine.state == "idle", "its position is not known"


@pytest.mark.parametrize(
    "event",
    [("Abort", "by hand"), ("row fault", PiFault.HOST_LOST, "silent"), ("lasting fault", PiFault.JOURNAL_FULL, "full")],
)
def test_stop_does_not_wait_for_the_burst_under_way(event, monkeypatch):
    """A call that sets a line may hang, and with it every thread that waits for the burst's end."""
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_edge()
    sent: list[Immediate] = []
    disarm = bench.loop.disarm

    def note_and_disarm():
        sent.extend(bench.stage.sent)
        return disarm()

    monkeypatch.setattr(bench.loop, "disarm", note_and_disarm)
    bench.machine.handle_event(*event)
    assert sent[-1:] == [Immediate.STOP]


@pytest.mark.parametrize("extra_pulses", [1, -1])
def test_a_row_whose_stage_counts_other_trigger_pulses_is_not_counted(extra_pulses):
    bench = Bench().begin_and_home()
    bench.start()
    for _ in range(3):
        bench.send_edge()
    bench.end_row(extra_pulses=extra_pulses)
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.status, finished.fault) == ("fault", PiFault.POINTS_MISMATCH)


@pytest.mark.parametrize("is_held", [False, True])
@given(beats=st.integers(0, 30), heartbeat_ms=st.integers(10, 100))
def test_a_host_that_falls_silent_ends_the_row_in_time(is_held, beats, heartbeat_ms):
    """Virtual time from its last sign of life until the outputs are off and the stage has been sent a stop."""
    bench = Bench().begin_and_home()
    bench.machine.command("BeginRun", heartbeat_ms)
    bench.start()
    bench.machine.command("Hold") if is_held else None
    for _ in range(beats):
        bench.let_time_pass(heartbeat_ms / 1e3)
        bench.machine.note_host_alive()
    assert bench.armed, "a host that is heard is not lost"
    last = bench.t
    while bench.armed:
        bench.let_time_pass(0.001)
    assert bench.t - last <= SAFE_WITHIN_S
    assert bench.stage.sent[-1] == Immediate.STOP
    bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.status, finished.fault) == ("fault", PiFault.HOST_LOST)
    assert (bench.machine.state, bench.machine.fault) == ("ready", PiFault.HOST_LOST)


def test_a_host_that_falls_silent_ends_its_homing():
    bench = Bench().begin_and_home()
    bench.machine.command("BeginRun", 100)
    bench.machine.command("Home")
    bench.run_posted()
    bench.send_reply(Reply("ok", bench.stage.number))
    bench.let_time_pass(SAFE_WITHIN_S)
    assert bench.stage.sent == [Immediate.STOP]
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.HOST_LOST)
    bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    bench.machine.command("Home")
    bench.run_posted()
    bench.send_reply(Reply("ok", bench.stage.number))
    bench.let_time_pass(200.0)
    assert bench.machine.state == "homing", "a person at the Pi homes without a host"


def test_a_held_row_continues_when_the_stage_rests():
    """Then the place of the hold is known, and with it the times of the edges around it."""
    bench = Bench().begin_and_home()
    bench.start()
    bench.machine.command("Hold")
    bench.machine.command("Resume")
    bench.send_status(0)
    assert bench.stage.sent == [Immediate.HOLD]
    bench.send_status(0, state="hold", x=70_000)
    assert bench.stage.sent == [Immediate.HOLD, Immediate.RESUME]
    bench.send_status(0, state="hold", x=70_000)
    assert bench.stage.sent == [Immediate.HOLD, Immediate.RESUME], "once"


def test_a_host_without_a_heartbeat_is_not_watched():
    bench = Bench().begin_and_home()
    bench.start()
    bench.let_time_pass(20.0)
    assert bench.armed


@given(
    phase=st.floats(0, 1),
    answer_s=st.floats(0.001, 0.1),
    heartbeat_ms=st.integers(200, 500),
)
def test_a_stage_that_falls_silent_is_noticed_in_time(phase, answer_s, heartbeat_ms):
    """The link's loop in virtual time: it polls every slice; from some moment on no answer comes."""
    heartbeat_s = heartbeat_ms / 1e3
    watch = StatusWatch(heartbeat_s, 0.0)
    watch.interval_s = heartbeat_s / STATUS_PER_HEARTBEAT
    dead_s = 2.0 + phase * heartbeat_s
    t = 0.0
    answers = []
    while True:
        t += watch.look_s
        if answers and answers[0] <= t:
            answers.pop(0)
            watch.note_answer()
        elif watch.silent_s(t):
            break
        if watch.is_due(t) and t + answer_s < dead_s:
            answers.append(t + answer_s)
        assert t < 10
    assert dead_s < t + 1e-9, "a stage that answers is not lost"
    assert t - dead_s <= SAFE_WITHIN_S


def test_a_stage_at_rest_may_answer_late():
    """A scan continues if a busy machine delays the answer between two rows; a moving stage would count as lost."""
    watch = StatusWatch(1.0, 0.0)
    watch.ask_every(IDLE_STATUS_S, 0.0)
    t = 0.0
    while t < IDLE_STATUS_S + SILENT_AT_REST_S - 0.1:
        t += watch.look_s
        assert not watch.silent_s(t)
        watch.is_due(t)
    watch.ask_every(1.0 / STATUS_PER_HEARTBEAT, t)
    row_begins_s = t
    while not watch.silent_s(t):
        t += watch.look_s
    assert 0.5 < t - row_begins_s < 0.6


@pytest.mark.parametrize("lasting", [True, False])
def test_a_lost_trigger_line_stops_every_motion_immediately(lasting):
    """The loop notices within its look-up time; the machine acts in the same turn."""
    assert LOOK_UP_S <= SAFE_WITHIN_S / 2
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_edge()
    job = None if lasting else bench.machine.row.job  # type: ignore[union-attr]
    number = PiFault.TRIGGER_LINE_LOST if lasting else PiFault.EDGE_LOST
    bench.machine.on_loop_fault(LoopFault(job, number, "gone"))
    assert not bench.armed
    assert bench.stage.sent == [Immediate.STOP]
    bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    assert bench.list_events(m.RowFinished)[-1].fault == number
    assert bench.machine.state == ("fault" if lasting else "ready")
    if lasting:
        with pytest.raises(RefusedError):
            bench.machine.command("Home")


def test_a_wire_that_comes_off_is_noticed_while_the_row_runs():
    """Points are passed without an edge: a fault after two more statuses, a quarter of the heartbeat apart."""
    assert 3 * 0.5 / STATUS_PER_HEARTBEAT <= SAFE_WITHIN_S
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_status(0)
    bench.send_edge()
    bench.send_status(1)
    bench.send_status(2)
    assert bench.armed
    bench.send_status(3)
    assert not bench.armed
    assert bench.machine.fault == PiFault.TRIGGER_LINE_LOST
    assert bench.stage.sent == [Immediate.STOP]
    assert "3 points, 1 edges" in bench.machine.reason


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=30))
def test_a_wire_with_edges_is_never_reported_off(steps):
    """Statuses and edges in any order, statuses up to three points ahead of the edges seen when one follows soon."""
    watch = TriggerWatch()
    edges = 0
    for ahead, later_ns in steps:
        edges += later_ns + 1  # between two statuses at least one edge came
        assert not watch.is_silent(edges + ahead, edges)


def test_the_first_fault_wins():
    bench = Bench().begin_and_home()
    bench.start()
    bench.machine.on_loop_fault(LoopFault(bench.machine.row.job, PiFault.EDGE_LOST, "2 edges lost"))  # type: ignore[union-attr]
    bench.machine.handle_event("stage lost", PiFault.STAGE_LOST, "silent")
    bench.run_posted()
    assert (bench.machine.fault, bench.machine.reason) == (PiFault.EDGE_LOST, "2 edges lost")
    assert [e.number for e in bench.list_events(m.Fault)] == [PiFault.EDGE_LOST, PiFault.STAGE_LOST], "both are told"
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.fault, finished.reason) == (PiFault.EDGE_LOST, "2 edges lost")
    bench.machine.command("Home")
    assert bench.machine.fault == 0


JOG = m.Jog(axis="x", from_mm=0.0, distance_mm=10.0, speed_mm_s=20.0, heartbeat_ms=100)


def test_a_jog_without_its_host_stops_in_time_and_keeps_the_position():
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    bench.let_time_pass(0.3)
    assert bench.machine.note_jog_alive("")
    bench.let_time_pass(0.39)
    assert not bench.stage.sent
    bench.let_time_pass(0.02)
    assert bench.stage.sent == [Immediate.STOP]
    bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    ended = bench.list_events(m.Jogged)[-1]
    assert (ended.status, ended.fault, bench.machine.state) == ("fault", PiFault.HOST_LOST, "ready")


def test_a_stage_that_does_not_stop_its_jog_is_lost():
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    bench.machine.command("Abort", "requested")
    bench.let_time_pass(3.1)
    assert (bench.machine.state, bench.machine.homed) == ("fault", False)
    assert bench.list_events(m.Jogged)[-1].status == "aborted"


def test_the_end_of_the_program_stops_a_jog_and_reports_it():
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    assert not bench.machine.terminate(), "no row is waited for"
    assert bench.stage.sent == [Immediate.STOP]
    ended = bench.list_events(m.Jogged)[-1]
    assert (ended.status, ended.fault) == ("aborted", PiFault.ABORTED)


@pytest.mark.parametrize(("x", "y"), [(2001, 0), (2000, 1), (0, 0)])
def test_a_jog_that_ends_elsewhere_loses_the_position(x, y):
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    bench.send_reply(Reply("done", bench.stage.number, fields={"x": str(x), "y": str(y)}))
    assert (bench.machine.state, bench.machine.fault, bench.machine.homed) == ("fault", PiFault.POSITION, False)


ACTIONS: dict[str, Callable[[Bench], object]] = {
    "home": lambda b: b.machine.command("Home"),
    "begin": lambda b: b.machine.command("BeginRun", 100),
    "end run": lambda b: b.machine.command("EndRun"),
    "row": lambda b: b.start(),
    "jog": lambda b: b.machine.command("Jog", JOG),
    "hold": lambda b: b.machine.command("Hold"),
    "resume": lambda b: b.machine.command("Resume"),
    "abort": lambda b: b.machine.command("Abort", "requested"),
    "edge": lambda b: b.send_edge(),
    "status": lambda b: b.send_status(len(b.list_events(m.Capture))),
    "ok": lambda b: b.send_reply(Reply("ok", b.stage.number)),
    "done": lambda b: b.end_row(),
    "stopped": lambda b: b.send_reply(Reply("alarm", number=StageError.STOPPED)),
    "limit": lambda b: b.send_reply(Reply("alarm", number=StageError.LIMIT_SWITCH)),
    "banner": lambda b: b.send_reply(Reply("banner")),
    "lines gone": lambda b: b.machine.on_loop_fault(LoopFault(None, PiFault.TRIGGER_LINE_LOST, "gone")),
    "edge lost": lambda b: (
        b.machine.row and b.machine.on_loop_fault(LoopFault(b.machine.row.job, PiFault.EDGE_LOST, "lost"))
    ),
    "stage lost": lambda b: b.machine.handle_event("stage lost", PiFault.STAGE_LOST, "silent"),
    "time": lambda b: b.let_time_pass(0.45),
}


@settings(max_examples=300)
@given(st.sampled_from(["cold", "homed", "in a row"]), st.lists(st.sampled_from(sorted(ACTIONS)), max_size=40))
def test_any_order_of_events(start, actions):
    """Only moves of the table, the first fault is kept, rows end once, and only a row is armed."""
    bench = Bench() if start == "cold" else Bench().begin_and_home()
    machine = bench.machine
    if start == "in a row":
        bench.start()
    for action in actions:
        fault_before = machine.fault, machine.reason
        with suppress(RefusedError):
            ACTIONS[action](bench)
            bench.run_posted()
            # These clear it
            if fault_before[0] and action not in ("home", "row", "jog"):
                assert (machine.fault, machine.reason) == fault_before, "the first fault wins"
            assert bench.armed <= (machine.row is not None), "edges are answered only during a row"
            assert (machine.row is not None) == (machine.state in ROW_STATES)
            assert (machine.row is not None) == (
                len(bench.list_events(m.RowStarted)) == len(bench.list_events(m.RowFinished)) + 1
            )
        assert (machine.jog is not None) == (machine.state == "jogging")
    if machine.row is not None:
        # A held row waits for a person
        machine.handle_event("Resume")
        bench.let_time_pass(400.0)
        assert machine.row is None, "every row ends"


# --- the table and its page -------------------------------------------------------------------------------------------


def find_code_words_of_cells(row: str) -> list[list[str]]:
    """Words in backquotes of each cell of a table's row."""
    return [re.findall(r"`([^`]+)`", cell) for cell in row.strip("|").split("|")]


def test_the_page_shows_the_rules():
    table_rows = [find_code_words_of_cells(row) for row in SPEC_PAGE.splitlines() if row.startswith("| `")]
    rules = [(e[0], tuple(s), tuple(next_states)) for e, s, next_states, *_ in (r for r in table_rows if len(r) == 4)]
    assert rules == [(r.event, tuple(r.states.split()), tuple(r.leads_to.split())) for r in RULES]
    answer = {
        s[0]: (next_states[0] if next_states else s[0]) for s, next_states, *_ in (r for r in table_rows if len(r) == 3)
    }
    assert answer == {s: WIRE_STATE.get(s, s) for s in get_args(State)}
    limits = {
        row[0][0]: float(n[0])
        for row in table_rows
        if len(row) == 3
        for n in [read_row_seconds(SPEC_PAGE, row[0][0])]
        if n
    }
    assert limits == TIMEOUTS_S


def read_row_seconds(page: str, state: str) -> list[str]:
    line = next(x for x in page.splitlines() if x.startswith(f"| `{state}` |") and x.count("|") == 4)
    return re.findall(r"(\d+(?:\.\d+)?) s\b", line.split("|")[3])


def test_the_rules_are_whole():
    """Every state can be reached and left, an event has one rule in a state, and rules name only existing states."""
    states = set(get_args(State))
    named = [(s, r.event) for r in RULES for s in r.states.split()]
    assert len(set(named)) == len(named)
    assert {s for s, _ in named} == states
    assert {s for r in RULES for s in r.leads_to.split()} <= states | {"same"}
    reached = set()
    todo = ["idle"]
    while todo:
        state = todo.pop()
        if state not in reached:
            reached.add(state)
            todo += [
                next_state
                for r in RULES
                if state in r.states.split()
                for next_state in r.leads_to.split()
                if next_state != "same"
            ]
    assert reached == states
    lasting = {s for r in RULES if r.event == "stage lost" for s in r.states.split()}
    assert lasting == states, "losing the stage is answered in every state"


RIG = load_published_rig()
replace = msgspec.structs.replace


def find_broken_rule(make: Callable[[], object]) -> str:
    """The violated rule of the rig file; "" if there is none."""
    try:
        make()
    except ValueError as e:
        return str(e)
    return ""


@given(
    columns=st.integers(1, 450),
    rows=st.integers(1, 300),
    speed=st.integers(1, 100),
    accel=st.integers(10, 500),
    backlash=st.integers(0, 10),
    centre=st.integers(300, 500),
)
@settings(max_examples=200, deadline=None)
def test_the_pi_takes_a_raster_when_the_rig_file_is_taken(columns, rows, speed, accel, backlash, centre):
    """BeginRun accepts exactly the rig files that `config` and the doctor accept."""
    stage = replace(
        RIG.stage, speed_mm_s=float(speed), accel_mm_s2=float(accel), backlash_mm=float(backlash),
        centre_x_mm=float(centre), travel_speed_mm_s=100.0,
    )  # fmt: skip
    grid = replace(RIG.grid, columns=columns, rows=rows)
    burst = Burst(pulses=1, period_us=MIN_PERIOD_US)
    run = m.BeginRun(
        scan_id="s", plan=plan_raster(grid), pulses=1, period_us=burst.period_us, width_us=burst.width_us,
        speed_mm_s=stage.speed_mm_s,
    )  # fmt: skip
    broken = find_broken_rule(lambda: replace(RIG, stage=stage, grid=grid, burst=burst))
    if not broken:
        return check_run(run, stage)
    with pytest.raises(RefusedError) as refused:
        check_run(run, stage)
    assert (refused.value.number, refused.value.what) == (PiFault.BAD_REQUEST, broken)


def test_the_run_up_is_what_the_host_counts_with():
    """A row from rest to rest: its points and the run-up at both ends, at a speed that is reached."""
    grid = RIG.grid
    stage = RIG.stage
    v = stage.speed_mm_s
    a = stage.accel_mm_s2
    length = (grid.columns - 1) * grid.step_x_mm + 2 * stage.run_up_mm(grid.step_x_mm)
    assert row_motion_s(grid, stage) == pytest.approx(length / v + v / a)
    assert stage.run_up_mm(2.0, 20.0) == pytest.approx(20.0**2 / (2 * a) + 2.0)


@given(period=st.floats(1, 1000), width=st.floats(0.001, 10))
@settings(max_examples=100, deadline=None)
def test_the_pi_sends_the_pulses_that_the_rig_file_may_hold(period, width):
    def sent() -> bool:
        try:
            return bool(read_burst(m.Pulse(pulses=1, period_us=period, width_us=width)))
        except RefusedError:
            return False

    edges = (MIN_PERIOD_US, *WIDTH_US)
    # The Pi counts in whole nanoseconds
    if min(abs(x - e) for e in edges for x in (period, width)) > 1e-3:
        assert sent() == (not find_broken_rule(lambda: Burst(pulses=1, period_us=period, width_us=width)))
