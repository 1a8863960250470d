"""The operator's page in a real browser: a scan of the simulated rig is planned, started, paused, stopped and resumed.

Scans continue when the server of the page is killed.
"""

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from tests.support.page.chromium import DESK, PHONE, Browser
from tests.support.processes import Program
from tests.support.scenes import write_small_scene
from tests.support.simulated_rig import Rig, run_simulated_rig

from polysight.acquisition.pi_client import PiClient
from polysight.catalogue import PROGRAM_FOLDER, find_program
from polysight.store import ScanFolder, validate
from polysight_shared.messages import BeginRun
from polysight_shared.raster import plan_raster

# So many rows that a scan can be stopped before its end on a slow machine, too.
ROWS = 40
SCENE = write_small_scene(10, ROWS, step_mm=(10.0, 5.0))
pytestmark = pytest.mark.slow


class Lab:
    """A rig, a server for its scans, and a browser."""

    def __init__(self, rig: Rig, browser: Browser) -> None:
        self.rig = rig
        self.browser = browser
        self.scans = rig.folder / "scans"
        self.scans.mkdir()
        self.serve()

    def serve(self) -> None:
        """Start the server with a new token."""
        options = ("--config", self.rig.config, "--port", "0")
        self.server: Program = self.rig.start("polysight", "serve", self.scans, *options)
        self.rig.wait_for(lambda: "token=" in self.server.err, "the server's address")
        shown_address = re.search(r"(http://127\.0\.0\.1:\d+)/#token=(\S+)", self.server.err)
        assert shown_address is not None, self.server.err
        self.address, self.token = shown_address.groups()

    def open(self, path: str, size: tuple[int, int, bool] = DESK) -> None:
        """Go to a page with the token."""
        self.browser.visit(f"{self.address}{path}#token={self.token}", size)
        self.browser.wait("document.querySelector('.bar nav a')", "the page")

    def fill(self, **values: Any) -> None:
        """Type into fields, as a person does."""
        for field, value in values.items():
            self.browser.fill(f"#{field}", str(value))

    def click(self, element: str) -> None:
        """Wait for a button, and press it."""
        self.browser.click(f"#{element}")

    def start(self, name: str, **changes: Any) -> Path:
        """Start a scan from the page; return its folder."""
        self.open("/new")
        self.browser.wait("document.querySelector('.time')", "the plan")
        self.fill(name=name, **changes)
        self.click("start")
        is_watching = "location.pathname == '/watch' && document.getElementById('headline')"
        self.browser.wait(is_watching, "the live view")
        return self.scans / name

    def wait_headline(self, text: str) -> None:
        """Wait until the live view shows this text."""
        self.browser.wait(f"document.getElementById('headline')?.innerText == {json.dumps(text)}", text)

    def wait_rows(self, folder: Path, rows: int) -> None:
        """Wait until so many rows are committed, on the page and on the disk."""
        self.browser.wait(f"parseInt(document.getElementById('count')?.innerText) >= {rows}", f"{rows} rows")
        assert len(ScanFolder.load(folder).committed_rows()) >= rows

    def wait_end(self, folder: Path) -> None:
        """Wait until the program that the page started has ended; check the scan, and that the page had no errors."""
        self.rig.wait_for(lambda: not _program(folder).running, "the end of the program")
        assert [finding for finding in validate(folder) if finding.level == "error"] == []
        assert self.browser.errors == []


def _program(folder: Path) -> Any:
    """The program that scans into a folder, or did."""
    program = find_program(folder, "scan")
    assert program is not None
    return program


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Lab]:
    with run_simulated_rig(tmp_path_factory.mktemp("lab"), time_scale=3.0, scene=SCENE) as rig:
        yield Lab(rig, browser)


def test_a_scan_is_planned_started_and_shown(lab):
    lab.open("/new")
    lab.browser.wait("document.querySelector('.time')", "the plan")
    duration = lab.browser.evaluate("document.querySelector('.time').innerText")
    lab.fill(rows=5)
    lab.browser.wait(f"document.querySelector('.time')?.innerText != {json.dumps(duration)}", "the plan of five rows")
    lab.fill(columns=1999)
    lab.browser.wait("document.getElementById('start').disabled", "that too long rows are refused")
    assert "travel" in lab.browser.read_text("forecast")
    folder = lab.start("first", rows=5, notes="the first one", tags="new, oak")
    lab.browser.wait("document.getElementById('count')?.innerText == '5 of 5 rows'", "all rows")
    lab.click("to-result")
    lab.browser.wait("location.pathname == '/scan'", "the result")
    lab.wait_end(folder)
    assert ScanFolder.load(folder).plan.rows == 5
    lab.open("/")
    # The entry of a scan has no text before it is drawn.
    lab.browser.wait("document.querySelector('#list li')?.innerText", "the entry of the scan")
    list_text = lab.browser.read_text("list")
    assert "first" in list_text
    assert "the first one" in list_text
    assert "oak" in list_text


def test_a_scan_pauses_continues_stops_and_is_resumed(lab):
    folder = lab.start("second", rows=ROWS)
    lab.wait_rows(folder, 1)
    lab.click("pause")
    lab.wait_headline("Paused")
    rows_at_pause = len(ScanFolder.load(folder).committed_rows())
    lab.click("continue")
    lab.wait_rows(folder, rows_at_pause + 1)
    lab.click("pause")
    lab.wait_headline("Paused")
    # It is stopped during the pause, so that rows are left to scan on a slow machine, too.
    lab.click("stop")
    lab.wait_headline("Stopped on request")
    lab.wait_end(folder)
    rows_at_stop = len(ScanFolder.load(folder).committed_rows())
    assert rows_at_pause < rows_at_stop < ROWS
    lab.click("resume")
    lab.wait_rows(folder, rows_at_stop + 1)
    lab.click("abort")
    lab.browser.evaluate("document.querySelector('#confirm button[value=yes]').click()")
    lab.wait_headline("Aborted on request")
    assert "the page" in lab.browser.read_text("detail")
    lab.wait_end(folder)


def test_a_second_scan_is_refused_and_the_first_one_continues_without_its_server(lab):
    folder = lab.start("third", rows=ROWS)
    lab.wait_rows(folder, 1)
    program_before = json.loads((folder / PROGRAM_FOLDER / "scan.json").read_text())
    pid = program_before["pid"]
    # The scan has the priority of the server, which is that of a program in a terminal. The server has another process,
    # which reads scans; that one has a lower priority, and is the first to be killed if memory is short.
    assert os.getpriority(os.PRIO_PROCESS, lab.server.process.pid) == os.getpriority(os.PRIO_PROCESS, pid)
    assert Path(f"/proc/{pid}/oom_score_adj").read_text() == Path("/proc/self/oom_score_adj").read_text()
    lab.open("/new")
    lab.browser.wait("document.querySelector('.time')", "the plan")
    lab.fill(name="fourth")
    lab.click("start")
    lab.browser.wait("document.getElementById('told').innerText.includes('third is being scanned')", "the refusal")
    assert not (lab.scans / "fourth").exists()
    # The browser counts the refused request as an error.
    lab.browser.errors.clear()
    lab.open("/watch?scan=third")
    lab.wait_headline("All is well")
    lab.server.kill()
    lab.browser.wait("document.body.classList.contains('lost')", "that the page says so")
    rows_without_server = len(ScanFolder.load(folder).committed_rows())
    lab.rig.wait_for(
        lambda: len(ScanFolder.load(folder).committed_rows()) > rows_without_server, "rows without a server"
    )
    lab.serve()
    lab.open("/watch?scan=third", PHONE)
    lab.wait_headline("All is well")
    assert json.loads((folder / PROGRAM_FOLDER / "scan.json").read_text()) == program_before
    assert _program(folder).running
    lab.click("pause")
    lab.wait_headline("Paused")
    lab.click("stop")
    lab.wait_headline("Stopped on request")
    lab.wait_end(folder)


def test_findings_of_the_doctor_are_shown_while_it_runs(lab):
    """Another host scans meanwhile: otherwise the doctor would load all cores to measure the receiving processes.

    That measurement is tested in tests/doctor.
    """
    plan = plan_raster(lab.rig.instrument.grid)
    run = BeginRun(scan_id="another", plan=plan, pulses=16, period_us=1500, width_us=1, speed_mm_s=20)
    with zmq.Context() as context, PiClient(context, lab.rig.instrument) as pi:
        pi.begin_run(run)
        lab.open("/new")
        lab.click("doctor")
        lab.browser.wait("document.querySelectorAll('#findings li').length > 10", "the first findings")
        lab.browser.wait("/\\d+ ok/.test(document.getElementById('doctor-told').innerText)", "its end")
        assert lab.browser.errors == []
        pi.end_run("another", "abort", "test")


def test_a_scan_that_cannot_begin_says_why(lab):
    lab.rig.pi.end()
    folder = lab.start("sixth", rows=ROWS)
    lab.browser.wait("document.getElementById('program-log').innerText.includes('did not answer')", "why")
    assert not (folder / "manifest.jsonl").exists()
    lab.rig.wait_for(lambda: not _program(folder).running, "the end of the program")
    assert _program(folder).status not in (0, None)
    lab.wait_headline("The scan could not start")
    assert "did not answer" in lab.browser.read_text("detail")
    lab.rig.start_pi()
    lab.open("/")
    lab.browser.wait("/failed[^]*did not answer/.test(document.getElementById('list').innerText)", "state and reason")
    lab.open("/watch?scan=sixth", PHONE)
    lab.click("again")
    lab.wait_rows(folder, 1)
    lab.click("pause")
    lab.wait_headline("Paused")
    lab.click("stop")
    lab.wait_headline("Stopped on request")
    lab.wait_end(folder)
