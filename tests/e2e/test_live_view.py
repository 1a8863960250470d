"""`polysight preview` beside a real scan of the simulated rig: it follows, it asks, and it sees the scan die."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest
from tests.support.processes import LIMIT_S, idle_s
from tests.support.scenes import small_scene

from polysight.store.validation import validate

ROWS = 40
SCENE = small_scene(10, ROWS, step_mm=(10.0, 5.0))


class View:
    """The live view's process, asked over HTTP."""

    def __init__(self, rig) -> None:
        self._program = rig.start("polysight", "preview", rig.folder / "scan", "--port", "0", "--control")
        rig.wait_for(lambda: "token=" in self._program.err, "the address of the live view")
        shown_address = re.search(r"(http://127\.0\.0\.1:\d+)/#token=(\S+)", self._program.err)
        assert shown_address is not None, self._program.err
        self._address, self._token = shown_address.groups()

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._program.process.pid

    def state(self) -> dict[str, Any]:
        """What a page is told."""
        with suppress(URLError), urlopen(f"{self._address}/api/state") as reply:
            return json.load(reply)
        return {"status": {"headline": "not there yet"}}

    def ask(self, command: str) -> None:
        """What a button does."""
        headers = {"X-Polysight-Token": self._token}
        with urlopen(Request(f"{self._address}/api/control/{command}", b"", headers)) as reply:
            assert reply.status == 200

    def wait(self, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """The first state that meets a condition."""
        deadline = idle_s() + LIMIT_S
        while not condition(state := self.state()):
            assert self._program.process.poll() is None, self._program.err
            assert idle_s() < deadline, f"not within {LIMIT_S:g} s: {what}; the view says {state}"
            # What looks on here costs the scan time
            time.sleep(0.2)
        return state

    def wait_headline(self, headline: str) -> dict[str, Any]:
        """Until the page says so."""
        return self.wait(lambda s: s["status"]["headline"] == headline, headline)


def priority(pid: int) -> int:
    """Nice value of a process."""
    return os.getpriority(os.PRIO_PROCESS, pid)


def rows_shown(state: dict[str, Any]) -> int:
    return (state.get("pictures") or {"rows": 0})["rows"]


@pytest.fixture
def slow_rig(running_rig, tmp_path) -> Iterator[Any]:
    """A rig that takes a while for its many short rows."""
    with running_rig(tmp_path, time_scale=10.0, scene=SCENE) as new_rig:
        yield new_rig


def test_a_scan_is_followed_paused_lost_and_stopped(slow_rig):
    rig = slow_rig
    view = View(rig)
    view.wait_headline("No scan here yet")
    scan = rig.scan("--no-process")

    state = view.wait(lambda s: rows_shown(s) >= 1, "the first row's image")
    assert state["scan"]["simulated"] is True
    assert state["scan"]["marks"].startswith("c")
    assert [state[key] for key in ("control", "running", "paused")] == [True, True, False]

    view.ask("pause")
    paused = view.wait_headline("Paused")
    rows = paused["scan"]["committed"]
    assert 1 <= rows < ROWS
    assert rig.committed() == rows
    view.ask("continue")
    view.wait(lambda s: rows_shown(s) > rows, "rows after the pause")

    scan.kill()
    headline = view.wait_headline("The scan program was killed")
    assert "polysight resume" in headline["status"]["do"]

    again = rig.start("polysight", "resume", rig.folder / "scan", "--no-process")
    view.wait(lambda s: s["running"], "that the scan goes on is seen")
    view.wait(lambda s: s["scan"]["committed"] > headline["scan"]["committed"], "rows after the kill")
    view.ask("abort")
    ended = view.wait_headline("Aborted on request")
    assert ended["scan"]["committed"] < ROWS
    assert again.wait().status != 0
    assert [f for f in validate(rig.folder / "scan") if f.level == "error"] == []
    state = view.wait(lambda s: rows_shown(s) == s["scan"]["committed"], "every row's image")
    assert state["boards"][0]["frames_received"] == state["boards"][0]["frames_expected"]
