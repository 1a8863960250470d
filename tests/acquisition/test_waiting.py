"""Between rows the scan waits for processing and disk, so that it loses no data, and stops on request."""

import os
import resource
import shutil
import signal
import threading
import time
from types import SimpleNamespace

import msgspec
import pytest
import zmq
from tests.support.processes import HANG_S
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.acquisition import ready, row, scan
from polysight.acquisition.control import StopRequest
from polysight.acquisition.progress import NICE
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.store.validation import validate
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode

# The Pi's report of the end of a row, in tests that only look whether it has come.
REPORT = "the Pi's report"


def change_limits(instrument, **limits):
    """Return the rig with other values in its table [limits]."""
    return msgspec.structs.replace(instrument, limits=msgspec.structs.replace(instrument.limits, **limits))


class HeldProcessing:
    """Processing of committed rows that waits until a test releases it."""

    def __init__(self) -> None:
        self._may_process = threading.Event()

    def process(self, _: int) -> None:
        assert self._may_process.wait(HANG_S)

    def release(self) -> None:
        self._may_process.set()


def test_the_next_row_waits_for_processing_with_a_notice(rig, tmp_path):
    """Processing hangs on row 0 and one row may wait: row 1 is the last one recorded until processing continues."""
    processing = HeldProcessing()
    rows_begun = []
    messages_at_wait = []
    rows_begun_at_wait = []

    def release_processing_at_wait(p) -> None:
        if p.phase == "row" and p.message:
            rows_begun.append(p.row)
        if p.phase == "wait":
            messages_at_wait.append(p.message)
            rows_begun_at_wait.append(list(rows_begun))
            processing.release()

    result = run_scan(
        change_limits(rig.instrument, rows_waiting=1),
        tmp_path / "s",
        on_row=processing.process,
        progress=release_processing_at_wait,
    )
    assert result.exit_status == "success"
    # The message begins with the number of rows that wait.
    assert messages_at_wait[0].startswith("2")
    assert rows_begun_at_wait[0] == [0, 1]
    assert rows_begun == [0, 1, 2, 3]
    assert result.processing_error is None
    assert validate(tmp_path / "s") == []


def test_a_scan_that_waits_for_processing_can_be_stopped(rig, tmp_path):
    processing = HeldProcessing()
    stop = StopRequest()

    def stop_at_wait(p) -> None:
        if p.phase == "wait":
            stop.request()
            processing.release()

    result = run_scan(
        change_limits(rig.instrument, rows_waiting=1),
        tmp_path / "s",
        on_row=processing.process,
        progress=stop_at_wait,
        stop=stop,
    )
    assert result.exit_status == "abort"
    assert sorted(result.folder.committed_rows()) == [0, 1]


def test_a_resumed_scan_does_not_wait_for_the_processing_of_earlier_rows(rig, tmp_path):
    stop = StopRequest()

    def stop_in_row_2(p) -> None:
        if p.row == 2:
            stop.request()

    run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=stop_in_row_2)
    processing = HeldProcessing()
    waits = []

    def release_processing_after_first_row(p) -> None:
        if p.phase == "wait":
            waits.append(p.message)
        if p.phase == "committed":
            processing.release()

    resume_scan(tmp_path / "s", on_row=processing.process, progress=release_processing_after_first_row)
    assert waits == []


def test_the_scan_waits_for_a_slow_disk_and_loses_nothing(rig, receivers, payload, tmp_path, monkeypatch):
    """The receivers are stopped (SIGSTOP) before the request to write row 1, until the notice appears."""
    monkeypatch.setattr(row, "_DISK_NOTICE_S", 0.05)
    notices: list[str] = []
    rows_run_at_notice = []

    def stop_receivers_until_notice(p) -> None:
        if p.state == "writing" and p.row == 1 and p.phase == "state" and not notices:
            for pid in receivers.values():
                os.kill(pid, signal.SIGSTOP)
        if p.phase == "wait" and p.row == 1 and not notices:
            notices.append(p.message)
            rows_run_at_notice.extend(rig.pi.rows_run)
            for pid in receivers.values():
                os.kill(pid, signal.SIGCONT)

    result = run_scan(rig.instrument, tmp_path / "s", progress=stop_receivers_until_notice)
    # The next row, row 2, has not begun.
    assert len(rows_run_at_notice) == 2
    assert "disk" in notices[0]
    assert result.exit_status == "success"
    assert result.retakes == 0
    for index in range(4):
        assert result.folder.read_row("RH", index).payload.tobytes() == payload("RH", index, rig.instrument.row_bytes)


def test_full_disk_between_rows_ends_the_scan_before_the_next_row(rig, tmp_path, monkeypatch):
    disk_usage = shutil.disk_usage

    def fill_after_two_rows(path):
        free_bytes = 1 << 40
        if len(rig.pi.rows_run) >= 2:
            # Space for one board's row, and there are two boards.
            free_bytes = rig.instrument.row_bytes
        return disk_usage(path)._replace(free=free_bytes)

    monkeypatch.setattr(ready.shutil, "disk_usage", fill_after_two_rows)
    with expect_refusal(ErrorCode.DISK_FULL):
        run_scan(rig.instrument, tmp_path / "s")
    assert rig.pi.rows_run == [(0, 1), (1, 1)]
    ended = load_facts(tmp_path / "s", "scan_ended")[0]
    assert ended["exit_status"] == "fail"
    monkeypatch.undo()
    assert resume_scan(tmp_path / "s").exit_status == "success"


def test_disk_that_cannot_hold_the_row_is_an_error_before_its_first_pulse(rig, receivers, tmp_path):
    """Reserving the file fails: a limit on the size of files (RLIMIT_FSIZE) replaces a full disk."""

    def progress(p) -> None:
        if p.state == "waiting" and len(rig.pi.rows_run) == 2:
            for pid in receivers.values():
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (1000, 1000))

    with expect_refusal(ErrorCode.DISK_FULL, "resume"):
        run_scan(rig.instrument, tmp_path / "s", progress=progress)
    assert rig.pi.rows_run == [(0, 1), (1, 1)]
    assert not list((tmp_path / "s").rglob("*.part"))
    result = resume_scan(tmp_path / "s")
    assert result.exit_status == "success"
    assert validate(tmp_path / "s") == []


def test_capture_has_priority_over_processing(rig, receivers, tmp_path):
    """A receiver has real-time priority or, if that is not permitted, a nice value lower by at least NICE."""
    # Nice values go from -20 to 19; this one stands for real-time priority.
    real_time = -100
    largest_nice_value = 19
    nice_of_processing = []
    nice_of_receivers = []

    def note_nice_of_processing(_: int) -> None:
        nice_of_processing.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    def note_nice_of_receivers(p) -> None:
        if p.state == "running" and not nice_of_receivers:
            for pid in receivers.values():
                if os.sched_getscheduler(pid) in (os.SCHED_RR, os.SCHED_FIFO):
                    nice_of_receivers.append(real_time)
                else:
                    nice_of_receivers.append(os.getpriority(os.PRIO_PROCESS, pid))

    run_scan(rig.instrument, tmp_path / "s", on_row=note_nice_of_processing, progress=note_nice_of_receivers)
    boards = 2
    rows = 4
    assert len(nice_of_receivers) == boards
    assert len(nice_of_processing) == rows
    difference = min(nice_of_processing) - max(nice_of_receivers)
    assert difference >= NICE or min(nice_of_processing) == largest_nice_value


def test_a_complete_row_that_was_held_is_committed_with_a_note(rig, tmp_path):
    rig.pi.notes[1, 1] = "held on the way: some positions were passed below full speed"
    result = run_scan(rig.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 0)
    facts = {f["row"]: f for f in load_facts(result.folder, "row_committed")}
    assert facts[1]["take"] == 1
    assert facts[1]["note"].startswith("held")
    assert "note" not in facts[0]
    assert validate(tmp_path / "s") == []


def test_a_report_that_comes_as_the_time_is_up_ends_the_row(rig, monkeypatch):
    def take_report(take) -> None:
        take.finished = REPORT

    monkeypatch.setattr(row, "row_limit_s", lambda *_: -1.0)
    take = SimpleNamespace(finished=None, aborted=None, row=None)
    taker = SimpleNamespace(_instrument=rig.instrument, _rig=None, _poll=take_report)
    row.RowTaker._wait_for_row(taker, take, transaction=None)
    assert take.finished == REPORT


def test_a_report_that_comes_while_the_program_is_held_ends_the_row(rig, monkeypatch):
    """The loop finds no events, and is delayed until long after the row's time limit."""
    looks = []

    def look_for_report(take) -> None:
        looks.append("a look at the Pi's events")
        # The report comes with the second look.
        if len(looks) == 2:
            take.finished = REPORT

    def monotonic() -> float:
        if looks:
            return 1e6
        return 0.0

    monkeypatch.setattr(row, "time", SimpleNamespace(monotonic=monotonic))
    monkeypatch.setattr(row, "row_limit_s", lambda *_: 60.0)
    take = SimpleNamespace(finished=None, aborted=None, row=None)
    taker = SimpleNamespace(
        _instrument=rig.instrument,
        _rig=None,
        _poll=look_for_report,
        _stop=SimpleNamespace(now=False),
        _find_fatal_fault=lambda *_: None,
        _pi=SimpleNamespace(state="running"),
    )
    row.RowTaker._wait_for_row(taker, take, transaction=None)
    assert take.finished == REPORT


def test_a_row_that_is_held_has_no_time_limit(rig, tmp_path, monkeypatch):
    """While it is held each reading of the clock is a minute later, and the limit of a row is half a second here."""
    rig.pi.hang_at = {1}
    rig.pi.hang_held = True
    readings_s = [0.0]
    held_rows = []

    def note_held_row(p) -> None:
        if p.phase == "held":
            held_rows.append(p.row)

    def monotonic() -> float:
        if held_rows and len(readings_s) <= 20:
            readings_s.append(readings_s[-1] + 60.0)
        elif held_rows:
            rig.pi.hang_at = set()
            rig.pi.end_hanging_row = True
        return readings_s[-1]

    monkeypatch.setattr(row, "time", SimpleNamespace(monotonic=monotonic, monotonic_ns=time.monotonic_ns))
    monkeypatch.setattr(row, "row_limit_s", lambda *_: 0.5)
    result = run_scan(rig.instrument, tmp_path / "s", progress=note_held_row)
    assert result.exit_status == "success"
    assert held_rows == [1]


def test_stop_now_sends_abort_before_anything_else(rig, tmp_path, monkeypatch):
    """A stop requested while the loop waits: Abort is the next command, sent before the loop waits again."""
    rig.pi.hang_at = {0}
    rig.pi.hang_after_captures = True
    stop = StopRequest()
    points = []
    requests = []
    aborted = []
    # Timeouts with which the loop waits, in ms; None would be endless.
    sleeps: list[float] = []

    class Poller(zmq.Poller):
        def poll(self, timeout=None):
            if any(points) and not stop.now:
                stop.request()
                stop.request()
                requests.append((len(sleeps), len(rig.pi.commands)))
            sleeps.append(timeout)
            return super().poll(timeout)

    abort = row.PiClient.abort

    def note_and_abort(client, reason: str) -> None:
        aborted.append(len(sleeps))
        abort(client, reason)

    monkeypatch.setattr(row, "zmq", SimpleNamespace(Poller=Poller, POLLIN=zmq.POLLIN))
    monkeypatch.setattr(row.PiClient, "abort", note_and_abort)
    result = run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=lambda p: points.append(p.points))
    assert result.exit_status == "abort"
    waits_at_request, commands = requests[0]
    waits_at_abort = aborted[0]
    # The wait during which the stop was requested was the last one.
    assert waits_at_abort - waits_at_request == 1
    # A request is seen within 0.1 s, also if no event comes.
    assert 0 <= max(sleeps[:waits_at_abort]) <= 100
    assert isinstance(rig.pi.commands[commands], m.Abort)
    ended = load_facts(result.folder, "scan_ended")[0]
    assert (ended["exit_status"], ended["reason"]) == ("abort", "stopped on request, 4 of 4 rows are missing")


@pytest.mark.parametrize("state", ["waiting", "arming"])
def test_stop_now_before_the_row_begins_moves_nothing(rig, tmp_path, state):
    stop = StopRequest()

    def progress(p) -> None:
        if p.state == state and len(rig.pi.rows_run) == 1:
            stop.request()
            stop.request()

    result = run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=progress)
    assert result.exit_status == "abort"
    assert rig.pi.rows_run == [(0, 1)]
    assert list(result.folder.committed_rows()) == [0]
    assert resume_scan(tmp_path / "s").exit_status == "success"


def test_an_unexpected_exception_is_recorded_as_the_end_of_the_scan(rig, tmp_path, monkeypatch):

    class BugError(Exception):
        pass

    def fail_before_row_2(*_: object) -> None:
        if len(rig.pi.rows_run) == 2:
            raise BugError("oops")

    monkeypatch.setattr(scan, "check_disk", fail_before_row_2)
    with pytest.raises(BugError):
        run_scan(rig.instrument, tmp_path / "s")
    monkeypatch.undo()
    ended = load_facts(tmp_path / "s", "scan_ended")
    assert [(f["exit_status"], f["reason"]) for f in ended] == [("fail", "BugError: oops")]
    assert resume_scan(tmp_path / "s").exit_status == "success"
