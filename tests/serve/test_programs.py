"""Programs that a page starts: found again by another server, never signalled, and distinguished from others.

Each program leaves three files in a folder of the scan: KIND.json (its process id, start time and command line),
KIND.log (its output) and KIND.status (its exit status).
"""

import json
import os
import shutil
import signal
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import tomli_w
import zmq
from tests.support.page.asking import TOKEN, get, post
from tests.support.page.live_view import serve_folder
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.catalogue import PROGRAM_FOLDER, find_program
from polysight.jobs.live_scan import _check_new
from polysight.serve.programs import Programs
from polysight.store import validate
from polysight_shared import messages as m
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.tables import to_builtins


@pytest.fixture
def programs() -> Iterator[Programs]:
    running_programs = Programs()
    yield running_programs
    running_programs.close()


def wait_for_end(folder: Path, kind: str) -> None:
    def has_ended() -> bool:
        program = find_program(folder, kind)
        assert program is not None
        return not program.running

    wait_for(has_ended, "its end")


def test_a_program_leaves_its_log_and_its_exit_status(programs, tmp_path):
    programs.start(tmp_path, "export", ["--version"])
    wait_for(lambda: find_program(tmp_path, "export").status is not None, "its status")
    program = find_program(tmp_path, "export")
    assert program.status == 0
    assert program.words == ("polysight", "--version")
    assert program.log.split()[0] == "polysight"

    # The folder is not a scan, so that the second program fails.
    programs.start(tmp_path, "export", ["validate", tmp_path])
    wait_for(lambda: find_program(tmp_path, "export").status is not None, "its status")
    program = find_program(tmp_path, "export")
    assert program.status == DataError.exit_status
    assert "why:" in program.log
    # The output of the first program stays in the file, but is not shown.
    assert "--version" not in program.log


@pytest.fixture
def sleeping(programs: Programs, tmp_path: Path) -> Iterator[Path]:
    """A folder for which a program runs; it is killed after the test."""
    pid = programs.launch(["/bin/sleep", "60"], tmp_path / PROGRAM_FOLDER / "scan")
    try:
        yield tmp_path
    finally:
        os.killpg(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    # A program that is killed leaves no exit status.
    assert find_program(tmp_path, "scan").status is None


def test_a_program_is_recognized_by_its_process_id_and_its_start_time(sleeping):
    assert find_program(sleeping, "scan").running
    file = sleeping / PROGRAM_FOLDER / "scan.json"
    answer = json.loads(file.read_text())
    file.write_text(json.dumps(answer | {"ticks": answer["ticks"] - 1}))
    # With another start time the process id is that of another process, which got it later.
    assert not find_program(sleeping, "scan").running


def test_one_program_of_a_kind_runs_in_a_folder(programs, sleeping):
    with expect_refusal(ErrorCode.BUSY):
        programs.start(sleeping, "scan", ["--version"])


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b"{}", b'{"pid":1,"ticks":"x"}', b"\xff", b'{"pid":-1,"ticks":0,"words":[],"started_utc":""}'],
)
def test_an_invented_process_number_is_not_a_running_program(tmp_path, content):
    (tmp_path / PROGRAM_FOLDER).mkdir()
    (tmp_path / PROGRAM_FOLDER / "scan.json").write_bytes(content)
    program = find_program(tmp_path, "scan")
    assert program is None or not program.running


def test_a_log_is_shown_without_control_characters(tmp_path):
    """A log has no colours, no bell, and no U+202E, which reverses text. Bytes that are not UTF-8 become U+FFFD."""
    (tmp_path / PROGRAM_FOLDER).mkdir()
    answer = {"pid": 0, "ticks": 0, "words": ["x"], "started_utc": ""}
    (tmp_path / PROGRAM_FOLDER / "scan.json").write_text(json.dumps(answer))
    (tmp_path / PROGRAM_FOLDER / "scan.log").write_bytes(b"--- t x\n\x1b[31mred\x1b[0m\x07 \xe2\x80\xaeback\xff\n")
    assert find_program(tmp_path, "scan").log == "red back\ufffd"


def test_a_scan_may_begin_in_a_folder_with_its_log_and_notes(tmp_path):
    (tmp_path / PROGRAM_FOLDER).mkdir()
    (tmp_path / "operator.json").write_text("{}")
    _check_new(tmp_path)
    (tmp_path / "something").touch()
    with pytest.raises(ConfigError):
        _check_new(tmp_path)


@pytest.fixture
def refusing_pi(tmp_path: Path) -> Iterator[tuple[Path, Callable[[], None]]]:
    """A rig file, and a function that makes its Pi refuse the next command; until then programs wait for an answer."""
    rig = load_published_rig()
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    pi = context.socket(zmq.REP)
    pi.bind("tcp://127.0.0.1:*")
    addresses = msgspec.structs.replace(rig.pi, command_address=pi.getsockopt_string(zmq.LAST_ENDPOINT))
    limits = msgspec.structs.replace(rig.limits, command_timeout_s=HANG_S)
    config = tmp_path / "rig.toml"
    config.write_text(tomli_w.dumps(to_builtins(msgspec.structs.replace(rig, pi=addresses, limits=limits))))

    def refuse() -> None:
        assert pi.poll(round(HANG_S * 1e3))
        pi.recv()
        pi.send(m.pack(m.Refused(number=int(PiFault.NOT_READY), problem="its lid is open", cause="", remedy="")))

    yield config, refuse
    context.destroy(linger=0)


def test_a_scan_starts_with_its_plan_and_a_refusal_by_the_pi_has_its_cause(refusing_pi, tmp_path):
    config, refuse = refusing_pi
    root = tmp_path / "scans"
    root.mkdir()
    with serve_folder(root, TOKEN, config=config) as view:
        for name in ("../out", ".hidden"):
            status, _ = post(view, "/api/start", {"name": name})
            assert status == 404, name
        for wrong_part in ({"plan": {"rows": 0}}, {"x": 1}, {"plan": {"columns": 1999}}, {"library": "no"}):
            status, _ = post(view, "/api/start", {"name": "a", **wrong_part})
            assert status == 400, wrong_part
        assert [p.name for p in root.iterdir()] == []

        request = {"name": "week/one", "plan": {"rows": 3}, "notes": "n", "tags": ["t"]}
        assert post(view, "/api/start", request)[0] == 200
        folder = root / "week" / "one"
        rig = tomllib.loads((folder / PROGRAM_FOLDER / "instrument.toml").read_text())
        assert rig["grid"]["rows"] == 3
        assert get(view, "/api/scan?scan=week/one")["state"] == "begun"
        # The rig does one scan at a time.
        assert post(view, "/api/start", {"name": "two"})[0] == 409
        assert not (root / "two").exists()

        refuse()
        wait_for_end(folder, "scan")
        wait_for(lambda: find_program(folder, "scan").status is not None, "its status")
        assert find_program(folder, "scan").status != 0
        wait_for(lambda: get(view, "/api/scan?scan=week/one")["state"] == "failed", "the state")
        reason = get(view, "/api/scan?scan=week/one")["reason"]
        assert "its lid is open" in reason
        # The reason is not a command line of the log.
        assert "polysight" not in reason
        assert reason in find_program(folder, "scan").log
        assert get(view, "/api/scans")["scans"][0]["tags"] == ["t"]

        # A scan that could not start may be started again by the same name, and keeps its notes.
        assert post(view, "/api/start", {"name": "week/one"})[0] == 200
        assert get(view, "/api/scan?scan=week/one")["notes"] == "n"
        refuse()
        wait_for_end(folder, "scan")


def test_files_that_a_page_leaves_in_a_scan_folder_are_not_a_fault(finished_scan, tmp_path):
    shutil.copytree(finished_scan, tmp_path / "one")
    findings_before = validate(tmp_path / "one")
    (tmp_path / "one" / PROGRAM_FOLDER).mkdir()
    (tmp_path / "one" / PROGRAM_FOLDER / "scan.log").touch()
    (tmp_path / "one" / "operator.json").write_text('{"notes": "", "tags": []}')
    (tmp_path / "one" / "export").mkdir()
    assert validate(tmp_path / "one") == findings_before


@pytest.mark.parametrize("name", ["", "scan.log", "scan.json", "scan.status"])
def test_nothing_is_written_through_a_link(programs, tmp_path, name):
    """A copied scan folder may have links in place of logs."""
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "file").write_text("as it was")
    if name:
        (tmp_path / "scan" / PROGRAM_FOLDER).mkdir(parents=True)
        (tmp_path / "scan" / PROGRAM_FOLDER / name).symlink_to(tmp_path / "victim" / "file")
    else:
        (tmp_path / "scan").mkdir()
        (tmp_path / "scan" / PROGRAM_FOLDER).symlink_to(tmp_path / "victim")
    assert find_program(tmp_path / "scan", "scan") is None
    with pytest.raises(DeviceError):
        programs.start(tmp_path / "scan", "scan", ["--version"])
    assert [p.name for p in (tmp_path / "victim").iterdir()] == ["file"]
    assert (tmp_path / "victim" / "file").read_text() == "as it was"
