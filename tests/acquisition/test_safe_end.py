"""Every end of a scan leaves the rig at rest; nothing moves without a request; errors name the rows that are safe."""

import errno
import io
import os
import signal
import sys
import threading
from contextlib import suppress
from types import SimpleNamespace

import msgspec
import pytest
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.acquisition import pi_client, scan as running
from polysight.acquisition.control import StopRequest, ignore_hangup
from polysight.acquisition.pi_client import PiClient
from polysight.acquisition.ready import make_ready
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.jobs import live_scan as live, live_scan as progress, process as processing
from polysight.settings import DEFAULT
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared import messages as m
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError, ScanError, convert_os_error
from polysight_shared.faults import PiFault, explain


def list_motion_commands(pi) -> list[type]:
    """Return the types of the commands that the Pi got, without questions and signs of life."""
    return [type(c) for c in pi.commands if not isinstance(c, m.Status | m.Replay | m.Alive)]


class MovingPi(PiClient):
    """A client of a Pi whose stage passes through `states` while `scan_id` runs: each answer has the next state."""

    def __init__(self, scan_id: str, states: list[str]) -> None:
        self._scan_id = "mine"
        self.running_id = scan_id
        self.states = states
        self.aborts: list[str] = []

    def status(self) -> SimpleNamespace:
        state = self.states.pop(0) if self.aborts and len(self.states) > 1 else self.states[0]
        return SimpleNamespace(scan_id=self.running_id, state=state)

    def abort(self, reason: str) -> None:
        self.aborts.append(reason)


def test_after_an_abort_the_host_waits_until_the_stage_rests_or_a_time_limit(monkeypatch):
    monkeypatch.setattr(pi_client, "_POLL_S", 0.001)
    pi = MovingPi("mine", ["running", "held", "done", "ready"])
    pi.come_to_rest("an error")
    assert (pi.aborts, pi.states) == (["an error"], ["ready"])
    monkeypatch.setattr(pi_client, "_REST_TIMEOUT_S", 0.01)
    restless_pi = MovingPi("mine", ["running"])
    restless_pi.come_to_rest("an error")
    assert restless_pi.aborts == ["an error"]


@pytest.mark.parametrize("other", ["", "another", "z"])
def test_a_run_of_another_host_is_not_aborted(other):
    pi = MovingPi(other, ["running"])
    pi.come_to_rest("an error")
    assert pi.aborts == []


def test_a_scan_can_be_stopped_before_the_pi_is_asked_for_a_run(rig, tmp_path):
    """The scan reports its progress before BeginRun: at the first report it opens the folder for commands."""
    begun_at_reports = []

    def note(p) -> None:
        if p.phase not in ("connect", "warning"):
            begun_at_reports.append(m.BeginRun in list_motion_commands(rig.pi))

    run_scan(rig.instrument, tmp_path / "s", progress=note)
    assert not begun_at_reports[0]


# --- the stage moves only on request ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [int(PiFault.STAGE_ALARM), int(PiFault.JOURNAL_FULL)])
def test_after_a_lasting_fault_nothing_is_homed_and_the_error_is_that_of_the_fault(rig, tmp_path, fault):
    """The Pi ends row 1 with this fault and stays in state `fault`, as after an emergency stop."""
    rig.pi.fail_rows[1, 1] = fault
    rig.pi.latched_reason = "stage alarm 14: the emergency stop is pressed"
    phases = []
    with expect_refusal(ErrorCode.STAGE_NOT_READY, explain(fault).problem) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=lambda p: phases.append(p.phase))
    assert "retake" not in phases
    assert rig.pi.latched_reason in e.value.what
    assert e.value.remedy.startswith(explain(fault).remedy)
    assert f"1 of 4 rows are safe; `polysight resume {tmp_path / 's'}`" in e.value.remedy
    # The stage was homed at the start only.
    assert list_motion_commands(rig.pi).count(m.Home) == 1
    assert list_motion_commands(rig.pi)[-2:] == [m.Abort, m.EndRun]
    ended = load_facts(tmp_path / "s", "scan_ended")[0]
    assert (ended["exit_status"], ended["remedy"]) == ("fail", e.value.remedy)


@pytest.mark.parametrize(("fault", "homes"), [(int(PiFault.STAGE_ALARM), 0), (int(PiFault.JOURNAL_FULL), 2)])
def test_at_its_start_a_scan_homes_after_any_fault_but_that_of_the_stage(rig, tmp_path, fault, homes):
    """An alarm of the stage may be its emergency stop, and a person has to look at it.

    `homes` is the number of homings: none, or one at the start and one at the end of the scan.
    """
    rig.pi.state = "fault"
    rig.pi.fault = fault
    rig.pi.latched_reason = "the reason"
    if homes:
        assert run_scan(rig.instrument, tmp_path / "s").exit_status == "success"
    else:
        with expect_refusal(ErrorCode.STAGE_NOT_READY, explain(fault).problem) as e:
            run_scan(rig.instrument, tmp_path / "s")
        assert "polysight-pi home" in e.value.remedy
    assert list_motion_commands(rig.pi).count(m.Home) == homes


def test_a_row_with_a_fault_that_does_not_last_is_retaken_without_homing(rig, tmp_path):
    rig.pi.fail_rows[1, 1] = int(PiFault.HOST_LOST)
    assert run_scan(rig.instrument, tmp_path / "s").retakes == 1
    sent = list_motion_commands(rig.pi)
    # The stage is homed at the start, and not between rows.
    assert sent.index(m.Home) < sent.index(m.RunRow)
    last_row = len(sent) - 1 - sent[::-1].index(m.RunRow)
    assert m.Home not in sent[sent.index(m.RunRow) : last_row]


def test_pi_that_restarted_between_rows_ends_the_scan_immediately(rig, tmp_path):
    def answer(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.run = None
            rig.pi.homed = False
            rig.pi.state = "idle"

    with expect_refusal(ErrorCode.STAGE_NOT_READY) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert "2 of 4 rows are safe" in e.value.remedy
    assert list_motion_commands(rig.pi).count(m.Home) == 1
    assert resume_scan(tmp_path / "s").exit_status == "success"
    # Once for the first scan; at the start of the resumed one, which a person requested, and after its last row.
    assert list_motion_commands(rig.pi).count(m.Home) == 3


def test_run_that_another_host_has_begun_is_left_alone(rig, tmp_path):
    def answer(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.run = msgspec.structs.replace(rig.pi.run, scan_id="another")

    with expect_refusal(ErrorCode.STAGE_NOT_READY, "another"):
        run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert m.Abort not in list_motion_commands(rig.pi)


@pytest.mark.parametrize("state", ["idle", "homed"])
def test_stage_that_is_not_ready_between_rows_is_not_homed(rig, tmp_path, state):
    def answer(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.homed = state == "homed"
            rig.pi.state = state

    with expect_refusal(ErrorCode.STAGE_NOT_READY, repr(state)) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert "polysight-pi home" in e.value.remedy
    assert list_motion_commands(rig.pi).count(m.Home) == 1


def test_homing_that_another_program_started_is_waited_for():
    states = iter(["homing", "homing", "ready"])
    status = SimpleNamespace(scan_id="s", homed=True, fault=0, reason="")
    socket = SimpleNamespace(poll=lambda _: None)

    def next_status():
        return SimpleNamespace(**vars(status), state=next(states))

    pi = SimpleNamespace(status=next_status, event_socket=socket, events=list, home=None)
    assert make_ready(pi, StopRequest(), lambda *_: None, "s", first=False)


# --- errors and the rows that are safe --------------------------------------------------------------------------------


@pytest.mark.parametrize("board", ["RH", "RV"])
def test_receiver_that_dies_in_a_row_is_noticed_and_the_row_is_aborted(rig, receivers, tmp_path, board):
    """For each board: the Pi gets Abort, and the error is reported before the queued rows are processed."""
    rig.pi.hang_at = {1}
    messages_at_end = []
    release = threading.Event()

    def progress(p) -> None:
        if p.phase == "state" and (p.state, p.row) == ("running", 1):
            os.kill(receivers[board], signal.SIGKILL)
        if p.phase == "end":
            messages_at_end.append((release.is_set(), p.message))
            release.set()

    with expect_refusal(ErrorCode.NO_ANSWER, board) as e:
        run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: release.wait(HANG_S) and None, progress=progress)
    assert "1 of 4 rows are safe" in e.value.remedy
    assert list_motion_commands(rig.pi)[-2:] == [m.Abort, m.EndRun]
    assert rig.pi.hanging is None
    scan = ScanFolder.load(tmp_path / "s")
    assert rig.pi.journal[scan.scan_id][-1].exit_status == "fail"
    assert messages_at_end == [(False, f"{e.value.what}; 1 rows wait to be processed")]


def test_every_error_names_the_rows_that_are_safe(rig, tmp_path, monkeypatch):
    def commit(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(running, "commit_row", commit)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)) as e:
        run_scan(rig.instrument, tmp_path / "s")
    safe = f"0 of 4 rows are safe; `polysight resume {tmp_path / 's'}` continues from there"
    assert e.value.__notes__ == [safe]
    assert convert_os_error(e.value).remedy.endswith(safe)


def test_the_error_of_a_pi_that_is_lost_has_the_rows_that_are_safe(rig, tmp_path):
    def answer(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.lose_replies = 10_000

    with expect_refusal(ErrorCode.NO_ANSWER) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert f"2 of 4 rows are safe; `polysight resume {tmp_path / 's'}`" in e.value.remedy


# --- a display that fails ---------------------------------------------------------------------------------------------


def test_a_display_that_fails_does_not_end_the_scan(rig, tmp_path):
    calls = []

    def answer(p) -> None:
        calls.append(p)
        if p.state == "running":
            raise OSError(28, "No space left on device")

    result = run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert result.exit_status == "success"
    # After its error it is not called any more.
    assert calls[-1].state == "running"
    assert [w for w in result.warnings if "No space left" in w]


class FullDisk(io.StringIO):
    """A log on a disk that is full from `break_off` on."""

    def break_off(self) -> None:
        self.write = self.refuse

    def refuse(self, *_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class ClosedPipe(io.TextIOWrapper):
    """A pipe whose reader ends at `break_off`."""

    def __init__(self) -> None:
        self._read, write = os.pipe()
        super().__init__(io.FileIO(write, "w"), write_through=True)

    def break_off(self) -> None:
        os.close(self._read)


@pytest.mark.parametrize("kind", [FullDisk, ClosedPipe])
def test_scan_without_a_terminal_is_recorded_and_processed(config, tmp_path, monkeypatch, kind):
    """In row 1 the terminal closes (SIGHUP), and stdout and stderr fail."""
    commands = []
    streams = [kind(), kind()]
    monkeypatch.setattr(processing, "check_inputs", lambda *_: None)
    no_rows = SimpleNamespace(add_row=lambda _: None, quality=SimpleNamespace(boards={}))
    monkeypatch.setattr(processing, "Pipeline", lambda *_, **__: no_rows)
    monkeypatch.setattr(
        processing,
        "make_products",
        lambda *given, **_: commands.append(given) or SimpleNamespace(summary=str, exit_status=0),
    )
    monkeypatch.setattr(processing, "publish_images", lambda *_: None)
    update = progress.ScanBar.update

    def update_progress(bar, p) -> None:
        if (p.phase, p.state, p.row) == ("state", "running", 1):
            os.kill(os.getpid(), signal.SIGHUP)
            for stream in streams:
                stream.break_off()
        update(bar, p)

    monkeypatch.setattr(progress.ScanBar, "update", update_progress)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", streams[0])
        patch.setattr(sys, "stdout", streams[1])
        # Printing the summary, which comes last, fails.
        with suppress(OSError):
            live.scan(config, tmp_path / "s", DEFAULT, truth=None, keep_incomplete=False, process=True)
    for stream in streams:
        stream.close()
    assert validate(tmp_path / "s") == []
    assert len(commands) == 1


def test_the_signal_of_a_closed_terminal_is_ignored_during_the_block_only():
    signals = []
    earlier_handler = signal.signal(signal.SIGHUP, lambda *_: signals.append(1))
    try:
        with ignore_hangup():
            os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        wait_for(lambda: signals, "the signal")
        # Only the second signal has reached the handler from before.
        assert signals == [1]
    finally:
        signal.signal(signal.SIGHUP, earlier_handler)


@pytest.mark.parametrize("error", [ValueError("oops"), ScanError("no images", "", "look")])
def test_when_processing_fails_it_is_reported_that_every_row_is_there(config, tmp_path, monkeypatch, capsys, error):
    monkeypatch.setattr(processing, "check_inputs", lambda *_: None)

    def broken(*_: object, **__: object):
        raise error

    monkeypatch.setattr(processing, "Pipeline", broken)
    with pytest.raises(PolysightError) as e:
        live.scan(config, tmp_path / "s", DEFAULT, truth=None, keep_incomplete=False, process=True)
    assert str(error.args[0]) in e.value.what
    assert "every row is committed" in capsys.readouterr().out
    assert f"polysight process {tmp_path / 's'}" in e.value.remedy


def test_a_complete_scan_succeeds_if_the_pi_run_cannot_be_ended(rig, tmp_path, monkeypatch):
    """The disk of the Pi may be full. Every row is committed, so nothing is missing."""

    def refuse_end(*_):
        raise DeviceError("the Pi did not write it down", "its disk is full", "remove old journals")

    monkeypatch.setattr(PiClient, "end_run", refuse_end)
    result = run_scan(rig.instrument, tmp_path / "s")
    assert (result.exit_status, result.folder.complete) == ("success", True)
    assert any("the Pi did not write it down" in w for w in result.warnings)
    assert [f["exit_status"] for f in load_facts(result.folder, "scan_ended")] == ["success"]
