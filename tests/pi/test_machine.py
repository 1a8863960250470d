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

# After the loss of host, stage or chip the stage begins to stop within this time (docs/spec/wire.md).
SAFE_WITHIN_S = 0.5
ROW_STATES = ("running", "held", "stopping", "done", "ending")
_, _, from_state_machine_on = (REPO / "docs/spec/wire.md").read_text(encoding="utf-8").partition("## State machine\n")
# The page's section on the state machine.
SECTION, _, _ = from_state_machine_on.partition("\n## ")


def test_a_fresh_machine_has_no_fault_and_nothing_to_wait_for():
    machine = Bench().machine
    assert (machine.state, machine.fault, machine.reason) == ("idle", 0, "")
    assert not machine.homed
    assert not machine.in_run
    assert machine.row is None
    assert machine.lost_mm == (0.0, 0.0)


@pytest.mark.parametrize("motion", ["homing", "row before its first point"])
def test_a_reset_of_the_stage_whose_banner_was_lost_is_noticed_in_time(motion):
    """The stage prints a banner when it starts. Without it statuses show the reset: the stage is idle too early."""
    bench = Bench().begin_and_home()
    if motion == "homing":
        bench.machine.command("Home")
        bench.run_posted()
        bench.send_reply(Reply("ok", bench.stage.number))
    else:
        bench.start()
    # The statuses of two seconds, with a heartbeat of half a second.
    for _ in range(2 * STATUS_PER_HEARTBEAT * 2):
        bench.send_status(0, state="idle")
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.STAGE_LOST)
    assert not bench.machine.homed


def test_a_row_that_does_not_end_is_a_fault_after_half_a_minute_and_three_times_its_duration():
    long_row = msgspec.structs.replace(ROW, points=400)
    for row in (ROW, long_row):
        bench = Bench().begin_and_home()
        limit_s = 30 + 3 * estimate_row_duration_s(row, bench.stage.config, 20.0)
        bench.start(row)
        bench.let_time_pass(limit_s - 0.1)
        assert bench.machine.state == "running"
        bench.let_time_pass(0.2)
        assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.STAGE_LOST)


# x and y in motor steps.
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


def test_after_the_end_of_the_motion_a_missing_edge_is_awaited_for_a_limited_time():
    """The row has three points, and its last edge may be read after the report of the stage."""
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
def test_a_row_that_ends_at_another_position_is_a_fault(dx, dy):
    """The stage says "done"; the Pi compares the position in that report with its command. `dx`, `dy`: motor steps."""
    bench = Bench().begin_and_home()
    bench.start()
    for _ in range(3):
        bench.send_edge()
    bench.end_row(dx, dy)
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.status, finished.fault) == ("fault", PiFault.POSITION)
    # The position of the stage is not known any more: it has to be homed.
    assert bench.machine.state == "idle"


@pytest.mark.parametrize(
    "event",
    [("Abort", "by hand"), ("row fault", PiFault.HOST_LOST, "silent"), ("lasting fault", PiFault.JOURNAL_FULL, "full")],
)
def test_the_stage_is_stopped_before_the_burst_under_way_is_awaited(event, monkeypatch):
    """A call that sets a line may hang, and with it every thread that waits for the burst's end."""
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_edge()
    sent_before_disarming: list[Immediate] = []
    disarm = bench.loop.disarm

    def note_and_disarm():
        sent_before_disarming.extend(bench.stage.sent)
        return disarm()

    monkeypatch.setattr(bench.loop, "disarm", note_and_disarm)
    bench.machine.handle_event(*event)
    assert sent_before_disarming[-1:] == [Immediate.STOP]


@pytest.mark.parametrize("extra_pulses", [1, -1])
def test_a_row_whose_stage_counts_other_trigger_pulses_is_a_fault(extra_pulses):
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
    """From its last sign of life at most half a second passes until no edge is answered and STOP was sent.

    Time is virtual.
    """
    bench = Bench().begin_and_home()
    bench.machine.command("BeginRun", heartbeat_ms)
    bench.start()
    if is_held:
        bench.machine.command("Hold")
    for _ in range(beats):
        bench.let_time_pass(heartbeat_ms / 1e3)
        bench.machine.note_host_alive()
    assert bench.armed, "a host that is heard is not lost"
    last_sign_s = bench.t
    while bench.armed:
        bench.let_time_pass(0.001)
    assert bench.t - last_sign_s <= SAFE_WITHIN_S
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
    # A person at the Pi homes without a host: nothing ends it.
    bench.let_time_pass(200.0)
    assert bench.machine.state == "homing"


def test_resume_is_sent_to_a_held_stage_only_when_it_rests():
    """When the stage rests, the place of the hold is known, and with it the times of the edges before and after it."""
    bench = Bench().begin_and_home()
    bench.start()
    bench.machine.command("Hold")
    bench.machine.command("Resume")
    bench.send_status(0)
    assert bench.stage.sent == [Immediate.HOLD]
    bench.send_status(0, state="hold", x=70_000)
    assert bench.stage.sent == [Immediate.HOLD, Immediate.RESUME]
    # A second status of this kind does not send it again.
    bench.send_status(0, state="hold", x=70_000)
    assert bench.stage.sent == [Immediate.HOLD, Immediate.RESUME]


def test_a_host_that_announced_no_heartbeat_may_be_silent_in_a_row():
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
    """The loop of the link runs in virtual time until it notices that no further answer comes.

    The stage dies at some moment within a heartbeat (`phase`, as a fraction of it); an answer takes `answer_s`.
    """
    heartbeat_s = heartbeat_ms / 1e3
    watch = StatusWatch(heartbeat_s, 0.0)
    watch.interval_s = heartbeat_s / STATUS_PER_HEARTBEAT
    dead_s = 2.0 + phase * heartbeat_s
    now_s = 0.0
    # Times at which the answers to open questions come
    answers_s = []
    while True:
        now_s += watch.look_s
        if answers_s and answers_s[0] <= now_s:
            answers_s.pop(0)
            watch.note_answer()
        elif watch.silent_s(now_s):
            break
        if watch.is_due(now_s) and now_s + answer_s < dead_s:
            answers_s.append(now_s + answer_s)
        # The stage died at 2.5 s at the latest. A loop that never notices it ends here.
        assert now_s < 10
    # A stage that answers is not lost; sums of seconds are rounded.
    assert dead_s < now_s + 1e-9
    assert now_s - dead_s <= SAFE_WITHIN_S


def test_a_stage_at_rest_may_answer_late():
    """A scan continues if a busy machine delays the answer between two rows; a moving stage would count as lost.

    When it moves, its time begins again, and is half of its heartbeat of 1 s; it is looked at every 50 ms.
    """
    heartbeat_s = 1.0
    watch = StatusWatch(heartbeat_s, 0.0)
    watch.ask_every(IDLE_STATUS_S, 0.0)
    now_s = 0.0
    while now_s < IDLE_STATUS_S + SILENT_AT_REST_S - 0.1:
        now_s += watch.look_s
        assert not watch.silent_s(now_s)
        watch.is_due(now_s)
    watch.ask_every(heartbeat_s / STATUS_PER_HEARTBEAT, now_s)
    row_begins_s = now_s
    while not watch.silent_s(now_s):
        now_s += watch.look_s
    silent_s = now_s - row_begins_s
    # Half of the heartbeat, and at most two looks
    assert heartbeat_s / 2 < silent_s < heartbeat_s / 2 + 2 * 0.05


@pytest.mark.parametrize("is_lasting", [True, False])
def test_a_lost_trigger_line_or_edge_stops_the_motion_immediately(is_lasting):
    """The trigger loop notices the loss within its look-up time, and the machine acts in the same turn.

    A lost edge is a fault of its row. A lost line lasts: no motion is accepted after it.
    """
    assert LOOK_UP_S <= SAFE_WITHIN_S / 2
    bench = Bench().begin_and_home()
    bench.start()
    bench.send_edge()
    if is_lasting:
        job = None
        number = PiFault.TRIGGER_LINE_LOST
    else:
        job = bench.machine.row.job  # type: ignore[union-attr]
        number = PiFault.EDGE_LOST
    bench.machine.on_loop_fault(LoopFault(job, number, "gone"))
    assert not bench.armed
    assert bench.stage.sent == [Immediate.STOP]
    bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    assert bench.list_events(m.RowFinished)[-1].fault == number
    assert bench.machine.state == ("fault" if is_lasting else "ready")
    if is_lasting:
        with pytest.raises(RefusedError):
            bench.machine.command("Home")


def test_a_trigger_wire_that_comes_off_is_noticed_while_the_row_runs():
    """The stage passes points without an edge: that is a fault at the second status after the first such one.

    Statuses are a quarter of the heartbeat of 0.5 s apart.
    """
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
    """Between two statuses at least one edge comes; a status may count up to three points whose edges come later."""
    watch = TriggerWatch()
    edges = 0
    for points_ahead, more_edges in steps:
        edges += 1 + more_edges
        assert not watch.is_silent(edges + points_ahead, edges)


def test_the_first_of_two_faults_is_that_of_the_row_and_both_are_reported():
    bench = Bench().begin_and_home()
    bench.start()
    bench.machine.on_loop_fault(LoopFault(bench.machine.row.job, PiFault.EDGE_LOST, "2 edges lost"))  # type: ignore[union-attr]
    bench.machine.handle_event("stage lost", PiFault.STAGE_LOST, "silent")
    bench.run_posted()
    assert (bench.machine.fault, bench.machine.reason) == (PiFault.EDGE_LOST, "2 edges lost")
    assert [e.number for e in bench.list_events(m.Fault)] == [PiFault.EDGE_LOST, PiFault.STAGE_LOST]
    finished = bench.list_events(m.RowFinished)[-1]
    assert (finished.fault, finished.reason) == (PiFault.EDGE_LOST, "2 edges lost")
    bench.machine.command("Home")
    assert bench.machine.fault == 0


JOG = m.Jog(axis="x", from_mm=0.0, distance_mm=10.0, speed_mm_s=20.0, heartbeat_ms=100)


def test_a_jog_without_its_host_stops_in_time_and_keeps_the_position():
    """A host may be silent for four of its heartbeats, 0.4 s here."""
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
    # From STOP to standstill the stage has 3 s.
    bench.let_time_pass(3.1)
    assert bench.machine.state == "fault"
    assert not bench.machine.homed
    assert bench.list_events(m.Jogged)[-1].status == "aborted"


def test_the_end_of_the_program_stops_a_jog_and_reports_it():
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    has_to_wait_for_a_row = bench.machine.terminate()
    assert not has_to_wait_for_a_row
    assert bench.stage.sent == [Immediate.STOP]
    ended = bench.list_events(m.Jogged)[-1]
    assert (ended.status, ended.fault) == ("aborted", PiFault.ABORTED)


# Motor steps; the jog of 10 mm ends at x 2000.
@pytest.mark.parametrize(("x", "y"), [(2001, 0), (2000, 1), (0, 0)])
def test_after_a_jog_that_ends_at_another_position_the_stage_has_to_be_homed(x, y):
    bench = Bench().begin_and_home()
    bench.machine.command("Jog", JOG)
    bench.send_reply(Reply("done", bench.stage.number, fields={"x": str(x), "y": str(y)}))
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.POSITION)
    assert not bench.machine.homed


def lose_edge(bench: Bench) -> None:
    """Lose an edge of the row, if there is a row."""
    row = bench.machine.row
    if row is not None:
        bench.machine.on_loop_fault(LoopFault(row.job, PiFault.EDGE_LOST, "lost"))


# What may happen to the machine: commands, edges, replies of the stage, losses, and time that passes. 0.45 s is longer
# than the host may be silent with the heartbeat of 100 ms.
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
    "edge lost": lose_edge,
    "stage lost": lambda b: b.machine.handle_event("stage lost", PiFault.STAGE_LOST, "silent"),
    "time": lambda b: b.let_time_pass(0.45),
}


@settings(max_examples=300)
@given(st.sampled_from(["cold", "homed", "in a row"]), st.lists(st.sampled_from(sorted(ACTIONS)), max_size=40))
def test_in_any_order_of_events_rows_end_once_and_the_first_fault_is_kept(start, actions):
    """Edges are answered only during a row."""
    bench = Bench() if start == "cold" else Bench().begin_and_home()
    machine = bench.machine
    if start == "in a row":
        bench.start()
    for action in actions:
        fault_before = machine.fault, machine.reason
        with suppress(RefusedError):
            ACTIONS[action](bench)
            bench.run_posted()
            # Only these commands clear a fault.
            if fault_before[0] and action not in ("home", "row", "jog"):
                assert (machine.fault, machine.reason) == fault_before, "the first fault wins"
            assert bench.armed <= (machine.row is not None), "edges are answered only during a row"
            assert (machine.row is not None) == (machine.state in ROW_STATES)
            unfinished_rows = len(bench.list_events(m.RowStarted)) - len(bench.list_events(m.RowFinished))
            assert (machine.row is not None) == (unfinished_rows == 1)
        assert (machine.jog is not None) == (machine.state == "jogging")
    if machine.row is not None:
        # A held row waits for a person without limit.
        machine.handle_event("Resume")
        bench.let_time_pass(400.0)
        assert machine.row is None, "every row ends"


# --- the rules of the machine and their page, docs/spec/wire.md -------------------------------------------------------


def find_code_words_of_cells(row: str) -> list[list[str]]:
    """Return the words in backquotes of each cell of a table's row."""
    return [re.findall(r"`([^`]+)`", cell) for cell in row.strip("|").split("|")]


def test_the_page_shows_the_rules():
    """One table has the rules in four columns: event, states, next states, action. Another has the states in three.

    Those are: the state, its name in messages if that is another one, and its time limit.
    """
    rules = []
    names_in_messages = {}
    limits_s = {}
    for line in SECTION.splitlines():
        if not line.startswith("| `"):
            continue
        cells = find_code_words_of_cells(line)
        if len(cells) == 4:
            events, states, next_states, _ = cells
            rules.append((events[0], tuple(states), tuple(next_states)))
        elif len(cells) == 3:
            states, names, _ = cells
            names_in_messages[states[0]] = names[0] if names else states[0]
            limit_s = re.search(r"(\d+(?:\.\d+)?) s\b", line.split("|")[3])
            if limit_s:
                limits_s[states[0]] = float(limit_s[1])

    assert rules == [(r.event, tuple(r.states.split()), tuple(r.leads_to.split())) for r in RULES]
    assert names_in_messages == {state: WIRE_STATE.get(state, state) for state in get_args(State)}
    assert limits_s == TIMEOUTS_S


def test_every_state_can_be_reached_and_left_and_an_event_has_one_rule_in_it():
    states = set(get_args(State))
    rules_of_states = [(state, rule.event) for rule in RULES for state in rule.states.split()]
    assert len(set(rules_of_states)) == len(rules_of_states)
    assert {state for state, _ in rules_of_states} == states
    assert {state for rule in RULES for state in rule.leads_to.split()} <= states | {"same"}

    # Follow the rules from the first state.
    reached = set()
    to_visit = ["idle"]
    while to_visit:
        state = to_visit.pop()
        if state in reached:
            continue
        reached.add(state)
        for rule in RULES:
            if state in rule.states.split():
                to_visit += [next_state for next_state in rule.leads_to.split() if next_state != "same"]
    assert reached == states

    states_that_may_lose_the_stage = set()
    for rule in RULES:
        if rule.event == "stage lost":
            states_that_may_lose_the_stage.update(rule.states.split())
    assert states_that_may_lose_the_stage == states


RIG = load_published_rig()
replace = msgspec.structs.replace


def find_broken_rule(make: Callable[[], object]) -> str:
    """Return the rule of the rig file that this violates; "" if it violates none."""
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
def test_the_pi_accepts_a_raster_exactly_if_the_rig_file_is_accepted(columns, rows, speed, accel, backlash, centre):
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


def test_the_host_forecasts_rows_with_the_run_up_of_the_pi():
    """A row has its points and a run-up at both ends, and begins and ends at rest.

    A ramp to the speed v takes v / a, and v^2 / 2a of the way: twice as long as this way would take at full speed.
    """
    grid = RIG.grid
    stage = RIG.stage
    speed = stage.speed_mm_s
    accel = stage.accel_mm_s2
    length_mm = (grid.columns - 1) * grid.step_x_mm + 2 * stage.run_up_mm(grid.step_x_mm)
    assert row_motion_s(grid, stage) == pytest.approx(length_mm / speed + speed / accel)
    assert stage.run_up_mm(2.0, 20.0) == pytest.approx(20.0**2 / (2 * accel) + 2.0)


@given(period_us=st.floats(1, 1000), width_us=st.floats(0.001, 10))
@settings(max_examples=100, deadline=None)
def test_the_pi_accepts_the_pulses_that_the_rig_file_may_have(period_us, width_us):
    def is_accepted() -> bool:
        try:
            return bool(read_burst(m.Pulse(pulses=1, period_us=period_us, width_us=width_us)))
        except RefusedError:
            return False

    # The Pi counts in whole nanoseconds, so that a value within one of a limit may be rounded to the other side.
    limits_us = (MIN_PERIOD_US, *WIDTH_US)
    distances_us = [abs(value_us - limit_us) for limit_us in limits_us for value_us in (period_us, width_us)]
    if min(distances_us) > 1e-3:
        broken_rule = find_broken_rule(lambda: Burst(pulses=1, period_us=period_us, width_us=width_us))
        assert is_accepted() == (not broken_rule)
