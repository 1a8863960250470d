"""Every end of a scan leaves the rig at rest, the stage moves only on request, and errors say how many rows are stored.

A stored row is called safe in the messages: it is committed to the scan folder, and resuming the scan keeps it.
"""

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

from polysight.acquisition import pi_client, scan
from polysight.acquisition.control import StopRequest, ignore_hangup
from polysight.acquisition.pi_client import PiClient
from polysight.acquisition.ready import make_ready
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.jobs import live_scan, process
from polysight.settings import DEFAULT
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared import messages as m
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError, ScanError, convert_os_error
from polysight_shared.faults import PiFault, explain

# Row 1 (rows count from 0) and its first take (takes count from 1), as a key of the fake Pi's faults.
FIRST_TAKE_OF_ROW_1 = (1, 1)
# Id of the scan of a `MovingPi`.
OWN_SCAN = "mine"


def list_motion_commands(pi) -> list[type]:
    """Return the types of the commands that the Pi got, without questions and signs of life."""
    return [type(c) for c in pi.commands if not isinstance(c, m.Status | m.Replay | m.Alive)]


class MovingPi(PiClient):
    """The client of the scan `OWN_SCAN`; its Pi reports that the scan `running_id` runs.

    The stage is in the first of `states` until an abort. After it, each reading of the status moves the stage on to the
    next state, up to the last one.
    """

    def __init__(self, running_id: str, states: list[str]) -> None:
        self._scan_id = OWN_SCAN
        self.running_id = running_id
        self.states = states
        self.aborts: list[str] = []

    def status(self) -> SimpleNamespace:
        state = self.states[0]
        is_last_state = len(self.states) == 1
        if self.aborts and not is_last_state:
            del self.states[0]
        return SimpleNamespace(scan_id=self.running_id, state=state)

    def abort(self, reason: str) -> None:
        self.aborts.append(reason)


def test_after_an_abort_the_host_waits_until_the_stage_rests(monkeypatch):
    monkeypatch.setattr(pi_client, "_POLL_S", 0.001)
    pi = MovingPi(OWN_SCAN, ["running", "held", "done", "ready"])
    pi.come_to_rest("an error")
    assert pi.aborts == ["an error"]
    assert pi.states == ["ready"]


def test_after_an_abort_the_host_waits_for_a_stage_that_never_rests_up_to_a_time_limit(monkeypatch):
    monkeypatch.setattr(pi_client, "_POLL_S", 0.001)
    monkeypatch.setattr(pi_client, "_REST_TIMEOUT_S", 0.01)
    restless_pi = MovingPi(OWN_SCAN, ["running"])
    restless_pi.come_to_rest("an error")
    assert restless_pi.aborts == ["an error"]


# No run at all, and two ids that come before and after `OWN_SCAN` in the alphabet.
@pytest.mark.parametrize("running_id", ["", "another", "z"])
def test_a_run_of_another_host_is_not_aborted(running_id):
    pi = MovingPi(running_id, ["running"])
    pi.come_to_rest("an error")
    assert pi.aborts == []


def test_a_scan_can_be_stopped_before_the_pi_is_asked_for_a_run(rig, tmp_path):
    """The first report of progress comes before the command BeginRun.

    At that report `polysight scan` opens the folder in which other programs leave their request to stop
    (`ControlFolder`).
    """
    begun_at_reports = []

    def note_if_run_has_begun(p) -> None:
        if p.phase not in ("connect", "warning"):
            begun_at_reports.append(m.BeginRun in list_motion_commands(rig.pi))

    run_scan(rig.instrument, tmp_path / "s", progress=note_if_run_has_begun)
    assert not begun_at_reports[0]


# --- the stage moves only on request ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [int(PiFault.STAGE_ALARM), int(PiFault.JOURNAL_FULL)])
def test_after_a_lasting_fault_nothing_is_homed_and_the_error_is_that_of_the_fault(rig, tmp_path, fault):
    """The Pi ends row 1 with this fault and stays in state `fault`, as after an emergency stop."""
    rig.pi.fail_rows[FIRST_TAKE_OF_ROW_1] = fault
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
    scan_ended = load_facts(tmp_path / "s", "scan_ended")[0]
    assert scan_ended["exit_status"] == "fail"
    assert scan_ended["remedy"] == e.value.remedy


@pytest.mark.parametrize(("fault", "homes"), [(int(PiFault.STAGE_ALARM), 0), (int(PiFault.JOURNAL_FULL), 2)])
def test_at_its_start_a_scan_homes_after_any_fault_but_that_of_the_stage(rig, tmp_path, fault, homes):
    """A stage that reports an alarm may be in emergency stop, so that a person has to look at it first.

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
    rig.pi.fail_rows[FIRST_TAKE_OF_ROW_1] = int(PiFault.HOST_LOST)
    assert run_scan(rig.instrument, tmp_path / "s").retakes == 1
    commands = list_motion_commands(rig.pi)
    row_starts = [place for place, command in enumerate(commands) if command is m.RunRow]
    first_row_start = row_starts[0]
    last_row_start = row_starts[-1]
    # The stage is homed at the start, and not between rows.
    assert commands.index(m.Home) < first_row_start
    assert m.Home not in commands[first_row_start:last_row_start]


def test_pi_that_restarted_between_rows_ends_the_scan_immediately(rig, tmp_path):
    def restart_pi_after_row_1(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.run = None
            rig.pi.homed = False
            rig.pi.state = "idle"

    with expect_refusal(ErrorCode.STAGE_NOT_READY) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=restart_pi_after_row_1)
    assert "2 of 4 rows are safe" in e.value.remedy
    homings_of_failed_scan = 1
    assert list_motion_commands(rig.pi).count(m.Home) == homings_of_failed_scan
    # A person requested the resumed scan: it homes the stage at its start, and after its last row.
    homings_of_resumed_scan = 2
    assert resume_scan(tmp_path / "s").exit_status == "success"
    assert list_motion_commands(rig.pi).count(m.Home) == homings_of_failed_scan + homings_of_resumed_scan


def test_run_that_another_host_has_begun_is_left_alone(rig, tmp_path):
    def let_another_host_begin_a_run_after_row_1(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.run = msgspec.structs.replace(rig.pi.run, scan_id="another")

    with expect_refusal(ErrorCode.STAGE_NOT_READY, "another"):
        run_scan(rig.instrument, tmp_path / "s", progress=let_another_host_begin_a_run_after_row_1)
    assert m.Abort not in list_motion_commands(rig.pi)


@pytest.mark.parametrize("state", ["idle", "homed"])
def test_stage_that_is_not_ready_between_rows_is_not_homed(rig, tmp_path, state):
    def change_state_after_row_1(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.homed = state == "homed"
            rig.pi.state = state

    with expect_refusal(ErrorCode.STAGE_NOT_READY, repr(state)) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=change_state_after_row_1)
    assert "polysight-pi home" in e.value.remedy
    assert list_motion_commands(rig.pi).count(m.Home) == 1


class SelfHomingPi:
    """A Pi whose stage passes through `states`, one at each reading of the status; the scan must not home it."""

    def __init__(self, states: list[str]) -> None:
        self._states = iter(states)
        self.event_socket = SimpleNamespace(poll=lambda _: None)

    def status(self) -> SimpleNamespace:
        return SimpleNamespace(state=next(self._states), scan_id="s", homed=True, fault=0, reason="")

    def events(self) -> list:
        return []

    def home(self) -> None:
        pytest.fail("the scan homed the stage itself")


def test_homing_that_another_program_started_is_waited_for():
    pi = SelfHomingPi(["homing", "homing", "ready"])
    assert make_ready(pi, StopRequest(), notify=lambda *_: None, scan_id="s", first=False)


# --- errors, and the number of stored rows ----------------------------------------------------------------------------


@pytest.mark.parametrize("board", ["RH", "RV"])
def test_receiver_that_dies_in_a_row_is_noticed_and_the_row_is_aborted(rig, receivers, tmp_path, board):
    """For each board: the Pi gets Abort, and the error is reported before the queued rows are processed."""
    rig.pi.hang_at = {1}
    messages_at_end = []
    was_processing_held_at_end = []
    may_process = threading.Event()

    def process_when_allowed(_: int) -> None:
        may_process.wait(HANG_S)

    def kill_receiver_and_allow_processing_at_end(p) -> None:
        if p.phase == "state" and p.state == "running" and p.row == 1:
            os.kill(receivers[board], signal.SIGKILL)
        if p.phase == "end":
            messages_at_end.append(p.message)
            was_processing_held_at_end.append(not may_process.is_set())
            may_process.set()

    with expect_refusal(ErrorCode.NO_ANSWER, board) as e:
        run_scan(
            rig.instrument,
            tmp_path / "s",
            on_row=process_when_allowed,
            progress=kill_receiver_and_allow_processing_at_end,
        )
    assert "1 of 4 rows are safe" in e.value.remedy
    assert list_motion_commands(rig.pi)[-2:] == [m.Abort, m.EndRun]
    assert rig.pi.hanging is None
    folder = ScanFolder.load(tmp_path / "s")
    last_event = rig.pi.journal[folder.scan_id][-1]
    assert last_event.exit_status == "fail"
    assert messages_at_end == [f"{e.value.what}; 1 rows wait to be processed"]
    assert was_processing_held_at_end == [True]


def test_every_error_has_the_number_of_stored_rows(rig, tmp_path, monkeypatch):
    def fail_to_commit(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(scan, "commit_row", fail_to_commit)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)) as e:
        run_scan(rig.instrument, tmp_path / "s")
    stored_rows = f"0 of 4 rows are safe; `polysight resume {tmp_path / 's'}` continues from there"
    assert e.value.__notes__ == [stored_rows]
    assert convert_os_error(e.value).remedy.endswith(stored_rows)


def test_the_error_of_a_pi_that_is_lost_has_the_number_of_stored_rows(rig, tmp_path):
    more_replies_than_are_sent = 10_000

    def lose_pi_after_row_1(p) -> None:
        if p.phase == "committed" and p.row == 1:
            rig.pi.lose_replies = more_replies_than_are_sent

    with expect_refusal(ErrorCode.NO_ANSWER) as e:
        run_scan(rig.instrument, tmp_path / "s", progress=lose_pi_after_row_1)
    assert f"2 of 4 rows are safe; `polysight resume {tmp_path / 's'}`" in e.value.remedy


# --- a display that fails ---------------------------------------------------------------------------------------------


def test_a_display_that_fails_does_not_end_the_scan(rig, tmp_path):
    reports = []

    def display_until_disk_is_full(p) -> None:
        reports.append(p)
        if p.state == "running":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    result = run_scan(rig.instrument, tmp_path / "s", progress=display_until_disk_is_full)
    assert result.exit_status == "success"
    # After its error the display is not called any more.
    assert reports[-1].state == "running"
    assert any(os.strerror(errno.ENOSPC) in warning for warning in result.warnings)


class FullDisk(io.StringIO):
    """A log on a disk that is full from `break_off` on."""

    def break_off(self) -> None:
        self.write = self.refuse

    def refuse(self, *_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class ClosedPipe(io.TextIOWrapper):
    """A pipe whose reader closes it at `break_off`."""

    def __init__(self) -> None:
        self._read, write = os.pipe()
        super().__init__(io.FileIO(write, "w"), write_through=True)

    def break_off(self) -> None:
        os.close(self._read)


@pytest.mark.parametrize("kind", [FullDisk, ClosedPipe])
def test_scan_without_a_terminal_is_recorded_and_processed(config, tmp_path, monkeypatch, kind):
    """In row 1 the terminal closes (SIGHUP), and stdout and stderr fail."""
    stdout = kind()
    stderr = kind()
    idle_pipeline = SimpleNamespace(add_row=lambda _: None, quality=SimpleNamespace(boards={}))
    processed_pipelines = []

    def make_no_products(pipeline, *_: object, **__: object) -> SimpleNamespace:
        processed_pipelines.append(pipeline)
        return SimpleNamespace(summary=lambda: "", exit_status=0)

    monkeypatch.setattr(process, "check_inputs", lambda *_: None)
    monkeypatch.setattr(process, "Pipeline", lambda *_, **__: idle_pipeline)
    monkeypatch.setattr(process, "make_products", make_no_products)
    monkeypatch.setattr(process, "publish_images", lambda *_: None)
    update = live_scan.ScanBar.update

    def close_terminal_in_row_1_and_update(bar, p) -> None:
        if p.phase == "state" and p.state == "running" and p.row == 1:
            os.kill(os.getpid(), signal.SIGHUP)
            stdout.break_off()
            stderr.break_off()
        update(bar, p)

    monkeypatch.setattr(live_scan.ScanBar, "update", close_terminal_in_row_1_and_update)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", stderr)
        patch.setattr(sys, "stdout", stdout)
        # Printing the summary, which comes last, fails.
        with suppress(OSError):
            live_scan.scan(config, tmp_path / "s", DEFAULT, truth=None, keep_incomplete=False, process=True)
    stdout.close()
    stderr.close()
    assert validate(tmp_path / "s") == []
    assert processed_pipelines == [idle_pipeline]


def test_the_signal_of_a_closed_terminal_is_ignored_during_the_block_only():
    signals = []

    def note_signal(number: int, _: object) -> None:
        signals.append(number)

    earlier_handler = signal.signal(signal.SIGHUP, note_signal)
    try:
        with ignore_hangup():
            os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        wait_for(lambda: len(signals) > 0, "the signal")
        # Only the second signal has reached the handler.
        assert signals == [signal.SIGHUP]
    finally:
        signal.signal(signal.SIGHUP, earlier_handler)


@pytest.mark.parametrize("error", [ValueError("oops"), ScanError("no images", why="", remedy="look")])
def test_when_processing_fails_it_is_reported_that_every_row_is_committed(config, tmp_path, monkeypatch, capsys, error):
    def fail_to_make_pipeline(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(process, "check_inputs", lambda *_: None)
    monkeypatch.setattr(process, "Pipeline", fail_to_make_pipeline)
    with pytest.raises(PolysightError) as e:
        live_scan.scan(config, tmp_path / "s", DEFAULT, truth=None, keep_incomplete=False, process=True)
    message_of_error = error.args[0]
    assert message_of_error in e.value.what
    assert "every row is committed" in capsys.readouterr().out
    assert f"polysight process {tmp_path / 's'}" in e.value.remedy


def test_a_complete_scan_succeeds_if_the_pi_run_cannot_be_ended(rig, tmp_path, monkeypatch):
    """The disk of the Pi may be full. Every row is committed, so nothing is missing."""

    def refuse_end(*_):
        raise DeviceError("the Pi did not write it down", "its disk is full", "remove old journals")

    monkeypatch.setattr(PiClient, "end_run", refuse_end)
    result = run_scan(rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    assert result.folder.complete
    assert any("the Pi did not write it down" in warning for warning in result.warnings)
    ends = load_facts(result.folder, "scan_ended")
    assert [end["exit_status"] for end in ends] == ["success"]
