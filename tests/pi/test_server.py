"""The Pi half tested from the host's side: real ZeroMQ, a pty, simulated wires."""

from contextlib import closing

import msgspec
from tests.support.pi.host_side import Running
from tests.support.processes import HANG_S
from tests.support.rigs import set_stage_port

from polysight.acquisition.pi_client import HostHeartbeat
from polysight_pi.lines import GpiodLines, SpiLines, WireLines
from polysight_shared import messages as m
from polysight_shared.errors import DeviceError
from polysight_shared.faults import PiFault, StageError
from polysight_shared.messages import is_simulated
from polysight_shared.stage_line import Immediate, Parameter
from polysight_shared.wires import WireClient, WireEdge

# The first row of the scan, for the first time.
RUN_FIRST_ROW = m.RunRow(scan_id="scan", row_index=0, take=1)


def test_a_row_is_captured_completely_and_in_order(host, hub, instrument):
    """Every pulse on the wire of the shipped rig file is at its place, and the events agree."""
    radar = WireClient(hub, listen=instrument.pi.sync_out)
    hello = host.ask(m.Hello())
    assert (hello.backend, hello.firmware, hello.state) == ("wires", "fake", "ready")
    assert hello.stage == instrument.stage.placement_settings
    # Nanoseconds since 1970: after 2020.
    assert hello.t_unix_ns > 1_600_000_000 * 10**9
    row_finished = host.run_row(1)
    burst = instrument.burst
    columns = instrument.grid.columns
    assert row_finished.status == "done"
    assert (row_finished.points, row_finished.edges, row_finished.bursts) == (columns, columns, columns)
    assert row_finished.pulses == columns * burst.pulses
    assert (row_finished.fault, row_finished.timed_by) == (0, "one-shot")
    assert row_finished.pulses_seen
    events = host.journalled
    assert [e.seq for e in events] == list(range(1, len(events) + 1))
    assert [type(e) for e in events] == [m.RunStarted, m.RowStarted] + columns * [m.Capture] + [m.RowFinished]
    captures = host.list_events(m.Capture)
    assert [c.point for c in captures] == list(range(columns))
    # Odd rows run towards -x.
    assert [c.column for c in captures] == list(reversed(range(columns)))
    for c in captures:
        assert c.last_pulse_ns - c.first_pulse_ns == (burst.pulses - 1) * round(burst.period_us * 1e3)
        assert (c.pulses, c.width_max_ns, c.jitter_ns) == (burst.pulses, round(burst.width_us * 1e3), 0)
    edges = [radar.receive(HANG_S) for _ in range(2 * row_finished.pulses)]
    rises = [e.t_ns for e in edges if isinstance(e, WireEdge) and e.value]
    falls = [e.t_ns for e in edges if isinstance(e, WireEdge) and not e.value]
    # Each pulse lasts 1 us.
    assert {fall - rise for rise, fall in zip(rises, falls, strict=True)} == {1000}
    assert rises[:: burst.pulses] == [c.first_pulse_ns for c in captures]
    radar.close()


def test_only_backends_that_drive_pins_count_as_hardware():
    assert [is_simulated(kind.name) for kind in (GpiodLines, SpiLines, WireLines)] == [False, False, True]
    assert all(is_simulated(unknown) for unknown in ("", "fake", "gpio", "GPIOD", "lgpio"))


def test_the_stage_gets_its_settings_and_the_row_in_motor_steps(instrument, stage, hub):
    rig = msgspec.structs.replace(instrument, stage=msgspec.structs.replace(instrument.stage, heartbeat_ms=1000))
    with closing(Running(set_stage_port(rig, stage.port), hub)) as pi:
        pi.host.must_accept(pi.host.make_begin())
        pi.host.home()
        stage.stays_after = 2
        pi.host.start_row()
        # The same status is published more than once while the row lasts.
        for _ in range(2):
            pi.host.wait_for_event(m.StageStatus, lambda e: e.state == "row" and e.points == 2)
        stage.stays_after = None
        pi.host.wait_for_event(m.RowFinished)
    row = next(c for c in stage.seen if c.verb == "ROW")
    steps_per_mm = 200
    # The grid has eight columns and four rows, 2 mm apart. Its middle is at x 400 mm and y 250 mm.
    first_x = (400 - 3.5 * 2) * steps_per_mm
    first_y = (250 - 1.5 * 2) * steps_per_mm
    distance = 2 * steps_per_mm
    rate = 20 * steps_per_mm
    assert row.args == (first_x, distance, 8, first_y, rate)
    # The units are those of docs/spec/stage-line.md: milliseconds, microseconds, and steps of 1/200 mm.
    settings = {Parameter(c.args[0]): c.args[1] for c in stage.seen if c.verb == "SET"}
    assert settings == {
        Parameter.ACCEL: 200 * 200,
        Parameter.HEARTBEAT: 1000,
        Parameter.TRIGGER: 20,
        Parameter.TRAVEL_X: 800 * 200,
        Parameter.TRAVEL_Y: 500 * 200,
        Parameter.TRAVEL_SPEED: 40 * 200,
        Parameter.BACKLASH: 0,
        Parameter.PINS: 0,
    }


def test_homing_reports_lost_steps(host, stage):
    """Homing after a scan measures how many motor steps were lost since the last homing."""
    status = host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (0, 0)
    stage.lost = (-7, 12)
    host.home()
    status = host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (-7 / 200, 12 / 200)


def test_repeated_requests_act_once(host, stage):
    host.must_accept(host.make_begin())
    stage.stays_after = 2
    assert host.must_accept(RUN_FIRST_ROW).state == "running"
    assert host.must_accept(RUN_FIRST_ROW).state == "running"
    stage.stays_after = None
    host.wait_for_event(m.RowFinished)
    host.wait_for_state("ready")
    assert host.must_accept(RUN_FIRST_ROW).state == "ready"
    assert stage.rows_run == 1
    assert host.run_row(0, take=2).status == "done"
    assert stage.rows_run == 2
    end = m.EndRun(scan_id="scan", exit_status="success")
    host.must_accept(end)
    host.must_accept(end)
    assert sum(isinstance(e, m.RunStopped) for e in host.replay()) == 1


def test_each_refusal_has_the_fault_number_of_its_cause(pi):
    host = pi.host
    plan = host.make_begin().plan
    replace = msgspec.structs.replace
    # No run has begun.
    assert host.must_refuse(RUN_FIRST_ROW) == PiFault.NOT_READY
    assert host.must_refuse(host.make_begin(period_us=299.0)) == PiFault.PERIOD_TOO_SHORT
    assert host.must_refuse(host.make_begin(width_us=4.5)) == PiFault.PULSE_TOO_LONG
    for impossible_values in (
        {"speed_mm_s": 1000.0}, {"speed_mm_s": 5e-324}, {"speed_mm_s": 0.1},
        {"pulses": 100}, {"plan": replace(plan, columns=402)},
        {"plan": replace(plan, step_x_mm=2.0011)},
    ):  # fmt: skip
        assert host.must_refuse(host.make_begin(**impossible_values)) == PiFault.BAD_REQUEST
    host.must_accept(host.make_begin())
    assert host.must_refuse(host.make_begin(plan=replace(plan, rows=3))) == PiFault.BAD_REQUEST
    # The stage is not homed.
    assert host.must_refuse(RUN_FIRST_ROW) == PiFault.NOT_READY
    host.home()
    assert host.must_refuse(m.RunRow(scan_id="scan", row_index=4, take=1)) == PiFault.BAD_REQUEST
    assert host.must_refuse(m.RunRow(scan_id="other", row_index=0, take=1)) == PiFault.NOT_READY
    assert host.must_refuse(m.Hold()) == PiFault.NOT_READY
    assert host.must_refuse(b"\x93nonsense") == PiFault.BAD_REQUEST
    refused = host.ask(m.Hello(version="2.0"))
    assert refused.number == PiFault.VERSION
    assert "2.0" in refused.problem


def test_hold_and_resume_lose_nothing(host_in_row, stage):
    host = host_in_row
    assert host.must_accept(m.Hold()).state == "held"
    assert host.must_accept(m.Hold()).state == "held"
    assert host.ask(m.Status()).row_index == 0
    assert host.must_accept(m.Resume()).state == "running"
    stage.stays_after = None
    assert host.wait_for_event(m.RowFinished).status == "done"
    assert stage.bytes_seen.count(Immediate.HOLD) == 1


def test_abort_ends_the_row_and_the_next_one_runs_without_homing(host_in_row, stage):
    host = host_in_row
    host.must_accept(m.Abort(reason="enough"))
    row_finished = host.wait_for_event(m.RowFinished)
    assert (row_finished.status, row_finished.fault, row_finished.reason) == ("aborted", PiFault.ABORTED, "enough")
    assert row_finished.bursts == len(host.list_events(m.Capture))
    # Not the whole row of eight points
    assert row_finished.bursts < 8
    host.wait_for_state("ready")
    stage.stays_after = None
    assert host.run_row(0, take=2).status == "done"
    assert sum(c.verb == "HOME" for c in stage.seen) == 1


def test_a_new_host_aborts_the_row_of_the_dead_one(host_in_row, stage):
    host = host_in_row
    assert host.must_accept(host.make_begin()).state == "ready"
    started = host.wait_for_event(m.RunStarted, lambda e: e.resumed)
    event_before = host.journalled[-2]
    assert isinstance(event_before, m.RowFinished)
    assert (event_before.status, started.seq) == ("aborted", event_before.seq + 1)
    stage.stays_after = None
    assert host.run_row(0, take=2).status == "done"


def test_stage_alarm_in_a_row_is_a_fault_until_homed(host, stage):
    stage.alarm_at = {3: StageError.LIMIT_SWITCH}
    row_finished = host.run_row(0)
    assert (row_finished.status, row_finished.fault) == ("fault", PiFault.STAGE_ALARM)
    # The alarm is at the third point; edges that are still under way then get no burst.
    assert row_finished.bursts == len(host.list_events(m.Capture)) <= 3
    assert not host.wait_for_state("fault").homed
    assert host.must_refuse(m.RunRow(scan_id="scan", row_index=0, take=2)) == PiFault.NOT_READY
    host.home()
    assert host.run_row(0, take=2).status == "done"


def test_a_host_whose_heartbeat_ends_ends_the_row(pi, stage, instrument):
    """With heartbeats the row runs longer than the timeout; without them it ends with the fault HOST_LOST."""
    host = pi.host
    host.must_accept(host.make_begin(heartbeat_ms=100))
    host.home()
    stage.stays_after = 2
    pi_settings = msgspec.structs.replace(instrument.pi, command_address=pi.service.server.command_address)
    beats = HostHeartbeat(host.context, msgspec.structs.replace(instrument, pi=pi_settings), "scan", 0.05)
    host.start_row()
    host.wait_for_event(m.Capture)
    # Three times the allowed silence, four heartbeats of 0.1 s.
    pi.clock.sleep(1.2)
    assert host.ask(m.Status()).state == "running"
    beats.stop()
    row_finished = host.wait_for_event(m.RowFinished)
    assert (row_finished.status, row_finished.fault) == ("fault", PiFault.HOST_LOST), row_finished.reason
    assert Immediate.STOP in stage.bytes_seen
    assert host.wait_for_state("ready").fault == PiFault.HOST_LOST
    stage.stays_after = None
    host.must_accept(host.make_begin())
    assert host.run_row(0, take=2).status == "done"


def test_a_heartbeat_counts_only_for_the_run_that_it_names(pi):
    host = pi.host
    alive = m.Alive(scan_id="scan")
    assert host.must_refuse(alive) == PiFault.NOT_READY
    host.must_accept(host.make_begin())
    assert host.must_accept(alive).state == "idle"
    assert host.must_refuse(m.Alive(scan_id="another")) == PiFault.NOT_READY
    host.must_accept(m.EndRun(scan_id="scan", exit_status="success"))
    assert host.must_refuse(alive) == PiFault.NOT_READY


def test_lost_and_damaged_lines_of_the_stage_are_repeated_and_spoil_no_row(pi, stage):
    host = pi.host
    host.must_accept(host.make_begin())
    stage.damage = 2
    host.home()
    stage.lose = stage.lose_end = 1
    row_finished = host.run_row(0)
    assert row_finished.status == "done", row_finished.reason
    assert stage.rows_run == 1


def test_replay_from_any_sequence(host):
    host.run_row(0)
    everything = host.journalled
    for first in range(1, len(everything) + 1):
        assert host.replay(from_seq=first) == everything[first - 1 :]
        assert host.replay(from_seq=first, limit=2) == everything[first - 1 : first + 1]
    assert host.replay("unknown") == []
    beat = host.wait_for_event(m.Heartbeat, lambda e: e.seq == everything[-1].seq)
    assert (beat.scan_id, beat.state) == ("scan", "ready")


def test_an_exception_in_the_executor_ends_the_program_with_the_outputs_low(pi, host, stage, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    raised = []
    monkeypatch.setattr("threading.excepthook", lambda args: raised.append(args.exc_type))
    monkeypatch.setattr("polysight_pi.machine.Machine.on_burst", fail)
    # The row is accepted before its first edge comes.
    stage.stays_after = 0
    host.start_row()
    stage.stays_after = None
    pi.thread.join(HANG_S)
    # The first exception ends the thread of the executor, the second one the service, which watches that thread.
    assert raised == [ZeroDivisionError, DeviceError]
    pi.service._loop.stop()
    assert not pi.service._loop._lines._active
