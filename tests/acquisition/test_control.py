"""Commands from other programs to a running scan: executed once, not by a later scan, and without disturbing it."""

import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from tests.support.page.live_view import open_control
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts
from tests.support.store.small_scan import SmallScan

from polysight.acquisition import control as control_module
from polysight.acquisition.control import (
    ALIVE_FILE,
    CONTROL_FOLDER,
    ControlFolder,
    ScanCommand,
    SignOfLife,
    StopRequest,
    read_life,
    read_start_ticks,
    send_command,
)
from polysight.acquisition.scan import run_scan
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.errors import ErrorCode


@pytest.fixture
def control(tmp_path):
    """Folder of a scan that takes commands, and its stop request."""
    with open_control(tmp_path) as stop:
        yield tmp_path, stop


def test_commands_are_obeyed_once(control):
    folder, stop = control
    send_command(folder, ScanCommand.PAUSE)
    assert stop.paused
    send_command(folder, ScanCommand.CONTINUE)
    assert not stop.paused
    assert not stop.after_row
    send_command(folder, ScanCommand.STOP)
    assert stop.after_row
    assert not stop.now
    # The same command again, from a double click or a second phone, does not stop the scan within the row.
    send_command(folder, ScanCommand.STOP)
    assert stop.after_row
    assert not stop.now
    send_command(folder, ScanCommand.ABORT)
    assert stop.now


def test_a_sender_waits_until_its_command_is_obeyed(tmp_path):
    """The scan's thread stops between reading the command's file and the stop request."""
    still_waiting = []

    class HeldRequest(StopRequest):
        def request(self, asker: str = "") -> None:
            sender.join(0.3)
            still_waiting.append(sender.is_alive())
            super().request(asker)

    stop = HeldRequest()
    sender = threading.Thread(target=lambda: send_command(tmp_path, ScanCommand.STOP))
    with ControlFolder(tmp_path, stop) as control:
        control.open()
        wait_for((tmp_path / CONTROL_FOLDER / ALIVE_FILE).exists, "the first sign of life")
        sender.start()
        sender.join()
        assert stop.after_row
    assert still_waiting == [True]


def test_an_empty_file_with_the_name_of_a_command_is_that_command(control):
    """`touch` in a shell makes such a file."""
    folder, stop = control
    (folder / CONTROL_FOLDER / "pause").touch()
    wait_for(lambda: stop.paused, "the pause")


def test_the_status_of_a_scan_names_its_host_and_requests_and_ends_with_it(tmp_path):
    assert read_life(tmp_path) is None
    stop = StopRequest()
    with ControlFolder(tmp_path, stop) as control:
        # A second call does nothing.
        control.open()
        control.open()
        wait_for(lambda: read_life(tmp_path), "the first sign of life")
        life = read_life(tmp_path)
        assert life.pid == os.getpid()
        assert life.ticks == read_start_ticks(os.getpid())
        assert not life.killed
        assert life.doing == "rows"
        assert life.asked == ""
        assert life.asker == ""
        wait_for(lambda: read_life(tmp_path).written_s != life.written_s, "the next sign of life")
        send_command(tmp_path, ScanCommand.STOP, "the page at 192.168.1.7")
        wait_for(lambda: read_life(tmp_path).asked, "what was asked")
        life = read_life(tmp_path)
        assert life.asked == "stop"
        assert life.asker == "the page at 192.168.1.7"
        control.end_rows()
        wait_for(lambda: read_life(tmp_path).doing == "materials", "that rows have ended")
        with expect_refusal(ErrorCode.NO_ANSWER, "materials"):
            send_command(tmp_path, ScanCommand.ABORT)
        assert not stop.now
    assert not (tmp_path / CONTROL_FOLDER).exists()


def test_after_the_rows_no_command_is_obeyed(tmp_path):
    stop = StopRequest()

    def has_ended_rows() -> bool:
        life = read_life(tmp_path)
        return life is not None and life.doing == "materials"

    def reports_a_request() -> bool:
        life = read_life(tmp_path)
        return life is not None and life.asked != ""

    with ControlFolder(tmp_path, stop) as control:
        control.open()
        wait_for((tmp_path / CONTROL_FOLDER / ALIVE_FILE).exists, "the first sign of life")
        control.end_rows()
        wait_for(has_ended_rows, "the end of the rows")
        (tmp_path / CONTROL_FOLDER / "pause").touch()
        # Commands are read before each sign of life.
        stop.request("a signal")
        wait_for(reports_a_request, "a sign of life after the command")
        assert not stop.paused
        assert (tmp_path / CONTROL_FOLDER / "pause").exists()


def test_a_sign_of_life_is_written_once_an_interval(tmp_path, monkeypatch):
    """Commands are looked for more often; each look touches no disk."""
    monkeypatch.setattr(control_module, "_ALIVE_INTERVAL_S", 3600.0)
    looks = []
    written = []
    monkeypatch.setattr(ControlFolder, "_obey_command", lambda _, command: looks.append(command))
    monkeypatch.setattr(ControlFolder, "_write", lambda _, life: written.append(life))
    with ControlFolder(tmp_path, StopRequest()) as control:
        control.open()
        # In each look the file of every command is looked for.
        wait_for(lambda: len(looks) > 5 * len(ScanCommand), "five looks")
        assert len(written) == 1


def test_a_killed_program_is_distinguished_from_a_silent_one(tmp_path):
    """A program was killed if its process id is not in use, or belongs to a process with another start time.

    A process of another machine cannot be seen from here, and does not count as killed.
    """
    (tmp_path / CONTROL_FOLDER).mkdir()
    this_machine = socket.gethostname()
    own_start = read_start_ticks(os.getpid()) or 0
    # Linux has process ids of up to 2**22.
    unused_pid = 2**22 + 1
    lives = [
        (SignOfLife(pid=os.getpid(), ticks=own_start, host=this_machine), False),
        (SignOfLife(pid=os.getpid(), ticks=1, host=this_machine), True),
        (SignOfLife(pid=unused_pid, ticks=1, host=this_machine), True),
        (SignOfLife(pid=unused_pid, ticks=1, host="another machine"), False),
    ]
    for life, is_killed in lives:
        (tmp_path / CONTROL_FOLDER / ALIVE_FILE).write_bytes(msgspec.json.encode(life))
        assert read_life(tmp_path).killed is is_killed
    # A file that cannot be read shows nothing.
    for content in (b"", b"{", b"[]", b"\xff", b'{"pid": "x"}'):
        (tmp_path / CONTROL_FOLDER / ALIVE_FILE).write_bytes(content)
        assert not read_life(tmp_path).killed


def test_commands_for_an_earlier_scan_are_deleted(tmp_path):
    (tmp_path / CONTROL_FOLDER).mkdir()
    for command in ScanCommand:
        (tmp_path / CONTROL_FOLDER / command).touch()
    with open_control(tmp_path) as stop:
        send_command(tmp_path, ScanCommand.CONTINUE)
    assert not stop.after_row
    assert not stop.paused


def test_a_control_folder_that_was_not_opened_writes_nothing(tmp_path):
    with ControlFolder(tmp_path, StopRequest()):
        pass
    assert list(tmp_path.iterdir()) == []


def test_command_without_a_running_scan_is_refused(tmp_path):
    with expect_refusal(ErrorCode.NO_ANSWER, "pause", tmp_path):
        send_command(tmp_path, ScanCommand.PAUSE)


def test_command_that_is_not_accepted_is_withdrawn(tmp_path):
    (tmp_path / CONTROL_FOLDER).mkdir()
    with expect_refusal(ErrorCode.NO_ANSWER, "abort"):
        send_command(tmp_path, ScanCommand.ABORT, limit_s=0.2)
    assert list((tmp_path / CONTROL_FOLDER).iterdir()) == []


def test_a_control_folder_that_cannot_be_written_does_not_disturb_the_scan(tmp_path):
    with ControlFolder(tmp_path / "not" / "there", StopRequest()) as control:
        control.open()
        with expect_refusal(ErrorCode.NO_ANSWER):
            send_command(tmp_path / "not" / "there", ScanCommand.PAUSE)


def load_fact_contents(path: Path) -> list[str]:
    return [f["fact"] for f in load_facts(path)]


def load_boards_of_rows(path: Path) -> dict:
    """Return what was committed of each board, by row."""
    rows = ScanFolder.load(path).committed_rows()
    return {number: row.boards for number, row in rows.items()}


def scan_with(samples, folder: Path, stop: StopRequest, at_row_1) -> SmallScan:
    """Run a scan with this stop request; call `at_row_1` when row 0 is committed."""
    scan = SmallScan(samples, folder)

    def call_at_row_1(progress) -> None:
        if progress.phase == "committed" and progress.row == 0:
            at_row_1()

    with scan._connect_pi():
        run_scan(samples.instrument, scan.path, stop=stop, progress=call_at_row_1)
    return scan


def call_when_paused(folder: Path, act: Callable[[], None]) -> None:
    """Call `act` in a thread once the manifest says that the scan is paused."""

    def wait() -> None:
        wait_for(lambda: "scan_paused" in load_fact_contents(folder), "the pause in the manifest")
        act()

    threading.Thread(target=wait).start()


def test_a_paused_scan_waits_between_rows_and_then_records_the_others(samples, finished_scan, tmp_path):
    stop = StopRequest()

    def go_on() -> None:
        stop.paused = False

    def pause() -> None:
        stop.paused = True
        call_when_paused(tmp_path / "scan", go_on)

    scan = scan_with(samples, tmp_path, stop, pause)
    facts = [f for f in load_fact_contents(scan.path) if f != "radars"]
    assert facts[:4] == ["scan_started", "row_committed", "scan_paused", "scan_continued"]
    assert facts[4:] == ["row_committed", "row_committed", "scan_ended"]
    assert validate(scan.path) == []
    assert load_boards_of_rows(scan.path) == load_boards_of_rows(finished_scan)


def test_a_paused_scan_can_be_stopped(samples, tmp_path):
    stop = StopRequest()

    def pause() -> None:
        stop.paused = True
        call_when_paused(tmp_path / "scan", stop.request)

    scan = scan_with(samples, tmp_path, stop, pause)
    assert load_fact_contents(scan.path)[-1] == "scan_ended"
    assert list(ScanFolder.load(scan.path).committed_rows()) == [0]
    assert scan.run().exit_status == "success"
