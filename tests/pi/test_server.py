"""The Pi half as the host sees it: real ZeroMQ, a pty, simulated wires."""

from concurrent.futures import ThreadPoolExecutor

import msgspec
import pytest

from polysight.host.acquisition.pi_client import HostHeartbeat
from polysight.pi_controller.service import Service
from polysight.shared import messages as m
from polysight.shared.errors import DeviceError
from polysight.shared.faults import PiFault, StageError
from polysight.shared.stage_line import Immediate
from polysight.shared.wires import WireClient, WireEdge
from tests.support.pi.host_side import HostSide
from tests.support.rigs import at_stage_port


def test_a_row_is_captured_completely_and_in_order(pi, hub, instrument):
    radar = WireClient(hub, listen=instrument.pi.sync_out)
    host = pi.host
    hello = host.ask(m.Hello())
    assert (hello.backend, hello.firmware, hello.state) == ("wires", "fake", "idle")
    host.accepted(host.begin())
    host.home()
    done = host.row(1)
    grid, burst = instrument.grid, instrument.burst
    n = grid.columns
    assert (done.status, done.points, done.edges, done.bursts) == ("done", n, n, n)
    assert (done.pulses, done.fault) == (n * burst.pulses, 0)
    seen = host.journalled
    assert [e.seq for e in seen] == list(range(1, len(seen) + 1))
    assert [type(e) for e in seen] == [m.RunStarted, m.RowStarted] + n * [m.Capture] + [m.RowFinished]
    captures = seen[2:-1]
    assert [c.point for c in captures] == list(range(n))
    assert [c.column for c in captures] == list(reversed(range(n)))  # odd rows run towards -x
    for c in captures:
        assert c.last_pulse_ns - c.first_pulse_ns == (burst.pulses - 1) * round(burst.period_us * 1e3)
        assert c.pulses == burst.pulses
        assert c.width_max_ns == round(burst.width_us * 1e3)
        assert c.jitter_ns == 0
    edges = [radar.receive(5) for _ in range(2 * done.pulses)]
    rises = [e.t_ns for e in edges if isinstance(e, WireEdge) and e.value]
    falls = [e.t_ns for e in edges if isinstance(e, WireEdge) and not e.value]
    assert len(rises) == done.pulses
    assert {b - a for a, b in zip(rises, falls, strict=True)} == {1000}
    assert rises[:: burst.pulses] == [c.first_pulse_ns for c in captures]
    radar.close()


def test_stage_gets_the_row_in_steps_and_a_heartbeat(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    stage.pace_s = 0.1  # the row takes longer than two quarters of a heartbeat
    host.home()
    host.row(0)
    row = next(c for c in stage.seen if c.verb == "ROW")
    half, y = 3.5 * 2 * 200, 250 * 200 - 1.5 * 2 * 200
    assert row.args == (400 * 200 - half, 400, 8, y, 4000)
    sets = {c.args[0]: c.args[1] for c in stage.seen if c.verb == "SET"}
    assert sets == {0: 40000, 1: 1000, 2: 20, 3: 160000, 4: 100000, 5: 8000, 6: 0}
    assert stage.bytes_seen.count(Immediate.STATUS) >= 2
    assert any(isinstance(e, m.StageStatus) and e.state == "row" for e in host.events)


def test_homing_tells_the_steps_that_were_lost(pi, stage):
    """The check after a scan: home again, against the switches."""
    host = pi.host
    host.accepted(host.begin())
    host.home()
    assert (host.ask(m.Status()).lost_x_mm, host.ask(m.Status()).lost_y_mm) == (0, 0)
    stage.lost = (-7, 12)
    host.home()
    status = host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (-7 / 200, 12 / 200)


def test_repeated_requests_act_once(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.02
    run = m.RunRow(scan_id="scan", row_index=0, take=1)
    assert host.accepted(run).state == "running"
    assert host.accepted(run).state == "running"
    host.wait(m.RowFinished)
    assert host.accepted(run).state == "ready"
    assert stage.rows_run == 1
    assert host.row(0, take=2).status == "done"
    assert stage.rows_run == 2
    end = m.EndRun(scan_id="scan", exit_status="success")
    host.accepted(end)
    host.accepted(end)
    assert sum(isinstance(e, m.RunStopped) for e in host.replay()) == 1


def test_refusals_name_their_number(pi):
    host = pi.host

    def number(command):
        reply = host.ask(command)
        assert isinstance(reply, m.Refused), reply
        assert reply.what
        assert reply.remedy
        return reply.number

    run = m.RunRow(scan_id="scan", row_index=0, take=1)
    assert number(run) == PiFault.NOT_READY  # no run
    plan = host.begin().plan
    assert number(host.begin(period_us=299.0)) == PiFault.PERIOD_TOO_SHORT
    assert number(host.begin(width_us=4.5)) == PiFault.PULSE_TOO_LONG
    assert number(host.begin(speed_mm_s=1000.0)) == PiFault.BAD_REQUEST
    assert number(host.begin(pulses=100)) == PiFault.BAD_REQUEST
    assert number(host.begin(plan=msgspec.structs.replace(plan, columns=402))) == PiFault.BAD_REQUEST
    assert number(host.begin(plan=msgspec.structs.replace(plan, step_x_mm=2.0011))) == PiFault.BAD_REQUEST
    host.accepted(host.begin())
    assert number(host.begin(plan=msgspec.structs.replace(plan, rows=3))) == PiFault.BAD_REQUEST
    assert number(run) == PiFault.NOT_READY  # not homed
    host.home()
    assert number(m.RunRow(scan_id="scan", row_index=4, take=1)) == PiFault.BAD_REQUEST
    assert number(m.RunRow(scan_id="other", row_index=0, take=1)) == PiFault.NOT_READY
    assert number(m.Hold()) == PiFault.NOT_READY
    host.commands.send(b"\x93nonsense")
    reply = m.unpack_reply(host.commands.recv())
    assert isinstance(reply, m.Refused)
    assert reply.number == PiFault.BAD_REQUEST
    host.commands.send(m.pack(m.Hello(version="2.0")))
    refused = m.unpack_reply(host.commands.recv())
    assert isinstance(refused, m.Refused)
    assert refused.number == PiFault.VERSION
    assert "2.0" in refused.what


def test_hold_and_resume_lose_nothing(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.03
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    host.wait(m.Capture)
    assert host.accepted(m.Hold()).state == "held"
    assert host.accepted(m.Hold()).state == "held"
    assert host.ask(m.Status()).row_index == 0
    assert host.accepted(m.Resume()).state == "running"
    assert host.wait(m.RowFinished).status == "done"
    assert stage.bytes_seen.count(Immediate.HOLD) == 1


def test_abort_ends_the_row_and_the_next_one_runs_without_homing(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.03
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    host.wait(m.Capture)
    host.accepted(m.Abort(reason="enough"))
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault, done.reason) == ("aborted", PiFault.ABORTED, "enough")
    captures = [e for e in host.events if isinstance(e, m.Capture)]
    assert done.bursts == len(captures) < 8
    host.until_state("ready")
    stage.pace_s = 0.0
    assert host.row(0, take=2).status == "done"
    assert sum(c.verb == "HOME" for c in stage.seen) == 1


def test_a_new_host_aborts_the_row_of_the_dead_one(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.05
    host.accepted(m.RunRow(scan_id="scan", row_index=2, take=1))
    host.wait(m.Capture)
    assert host.accepted(host.begin()).state == "ready"
    started = host.wait(m.RunStarted, lambda e: e.resumed)
    before = host.journalled[-2]
    assert isinstance(before, m.RowFinished)
    assert before.status == "aborted"
    assert started.seq == before.seq + 1
    stage.pace_s = 0.0
    assert host.row(2, take=1).status == "done"  # the same take runs: the new host knows of no earlier one


@pytest.mark.parametrize("wrong", ["skip", "extra"])
def test_counts_that_differ_fault_the_row_alone(pi, stage, wrong):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    if wrong == "skip":
        stage.skip = {5}
    else:
        stage.extra = True
    done = host.row(0)
    assert (done.status, done.fault) == ("fault", PiFault.POINTS_MISMATCH)
    fault = next(e for e in host.events if isinstance(e, m.Fault))
    assert fault.number == PiFault.POINTS_MISMATCH
    stage.skip, stage.extra = set(), False
    host.until_state("ready")
    assert host.ask(m.Status()).fault == PiFault.POINTS_MISMATCH
    assert host.row(0, take=2).status == "done"
    assert host.ask(m.Status()).fault == 0


def test_stage_alarm_in_a_row_is_a_fault_until_homed(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.alarm_at = {3: StageError.LIMIT_SWITCH}
    done = host.row(0)
    assert (done.status, done.fault) == ("fault", PiFault.STAGE_ALARM)
    captures = [e for e in host.events if isinstance(e, m.Capture)]
    assert done.bursts == len(captures) <= 3  # edges under way when the alarm came are not answered
    assert "limit switch" in done.reason
    status = host.until_state("fault")
    assert not status.homed
    assert isinstance(host.ask(m.RunRow(scan_id="scan", row_index=0, take=2)), m.Refused)
    host.home()
    assert host.row(0, take=2).status == "done"


def test_losing_the_stage_is_a_fault_with_the_outputs_low(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.05
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    host.wait(m.Capture)
    stage.unplug()
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault) == ("fault", PiFault.STAGE_LOST)
    assert host.until_state("fault").fault == PiFault.STAGE_LOST
    host.accepted(m.Home())  # nothing is plugged in again
    assert host.until_state("fault").fault == PiFault.STAGE_LOST


def test_a_silent_stage_is_lost(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.3
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    stage.deaf = True
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault) == ("fault", PiFault.STAGE_LOST)
    assert "silent" in done.reason


def test_a_host_that_falls_silent_ends_the_row(pi, stage):
    host = pi.host
    host.accepted(host.begin(heartbeat_ms=100))
    host.home()
    stage.pace_s = 0.3
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    done = host.wait(m.RowFinished)  # listens, and says nothing
    assert (done.status, done.fault) == ("fault", PiFault.HOST_LOST), done.reason
    assert Immediate.STOP in stage.bytes_seen
    assert host.until_state("ready").fault == PiFault.HOST_LOST
    stage.pace_s = 0.0
    host.accepted(host.begin())
    assert host.row(0, take=2).status == "done"


def test_a_host_with_a_heartbeat_does_not_need_to_ask(pi, stage, instrument):
    """The host's own heartbeat keeps the row, for longer than silence would be put up with; it ends with the host."""
    host = pi.host
    host.accepted(host.begin(heartbeat_ms=250))
    host.home()
    stage.pace_s = 0.4
    where = msgspec.structs.replace(instrument.pi, command_address=pi.service.server.command_address)
    beats = HostHeartbeat(host.context, msgspec.structs.replace(instrument, pi=where), "scan", 0.05)
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    host.wait(m.Capture, lambda e: e.point == 4)
    beats.stop()
    done = host.wait(m.RowFinished)
    assert done.fault == PiFault.HOST_LOST, done.reason


def test_a_sign_of_life_counts_for_its_run_alone(pi):
    host = pi.host
    assert host.ask(m.Alive(scan_id="scan")).number == PiFault.NOT_READY
    host.accepted(host.begin())
    assert host.accepted(m.Alive(scan_id="scan")).state == "idle"
    assert host.ask(m.Alive(scan_id="another")).number == PiFault.NOT_READY
    host.accepted(m.EndRun(scan_id="scan", exit_status="success"))
    assert host.ask(m.Alive(scan_id="scan")).number == PiFault.NOT_READY


def test_lost_and_damaged_lines_do_not_matter(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    stage.damage = 2
    host.home()
    stage.lose = 1
    stage.lose_end = 1
    done = host.row(0)
    assert done.status == "done", done.reason
    assert stage.rows_run == 1


def test_wires_that_break_are_the_trigger_line_lost(pi, stage):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    stage.pace_s = 0.05
    host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    host.wait(m.Capture)
    pi.service._loop._lines._client._socket.shutdown(2)
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault) == ("fault", PiFault.TRIGGER_LINE_LOST)
    refused = host.ask(m.Home())
    assert refused.number == PiFault.TRIGGER_LINE_LOST


def test_replay_from_any_sequence(pi):
    host = pi.host
    host.accepted(host.begin())
    host.home()
    host.row(0)
    everything = host.journalled
    for first in range(1, len(everything) + 1):
        assert host.replay(from_seq=first) == everything[first - 1 :]
        assert host.replay(from_seq=first, limit=2) == everything[first - 1 : first + 1]
    assert host.replay("unknown") == []
    beat = host.wait(m.Heartbeat, lambda e: e.seq == everything[-1].seq)
    assert (beat.scan_id, beat.state) == ("scan", "ready")


def test_an_exception_in_the_executor_ends_the_program_with_the_outputs_low(instrument, stage, hub, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("threading.excepthook", lambda _: None)
    monkeypatch.setattr("polysight.pi_controller.row_machine.RowMachine.on_burst", fail)
    service = Service(at_stage_port(instrument, stage.port), hub)
    with ThreadPoolExecutor(1) as pool:
        served = pool.submit(service.serve)
        host = HostSide(service.server.command_address, service.server.event_address, instrument)
        host.accepted(host.begin())
        host.home()
        stage.pace_s = 0.2  # the reply to the row goes out before its first edge comes
        host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
        with pytest.raises(DeviceError, match="a bug"):
            served.result(timeout=60)
    service.close()
    assert not service._loop._lines._active
    host.close()
