"""Scans that wait for the rig: one after another, in order; the queue stops at a scan that did not finish."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal

from polysight.serve import programs
from polysight.serve.programs import Queue
from polysight_shared.errors import DeviceError, ErrorCode, ScanError


class Rig:
    """A rig that starts a requested scan unless it is busy or broken."""

    def __init__(self) -> None:
        # Names of scans that the queue has started.
        self.started: list[str] = []
        # Number of requests to start a scan.
        self.asked = 0
        self.is_busy = True
        self.is_broken = False
        # States of scans that did not finish, and of one that was started without the queue, "by hand".
        self.states: dict[str, str] = {}

    def list_states(self) -> dict[str, str]:
        """States of the scans by name, the newest first."""
        started = {name: self.states.get(name, "finished") for name in reversed(self.started)}
        if "by hand" in self.states:
            started["by hand"] = self.states["by hand"]
        return started

    def start(self, request: bytes) -> None:
        self.asked += 1
        if self.is_busy:
            raise ScanError("another is being scanned", code=ErrorCode.BUSY)
        if self.is_broken:
            raise DeviceError("no launcher")
        self.started.append(json.loads(request)["name"])
        self.is_busy = True


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture
def queue(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Queue]:
    # The queue looks at the rig every 10 ms, for a fast test.
    monkeypatch.setattr(programs, "LOOK_S", 0.01)
    rig_queue = Queue(tmp_path / "queue", rig.start, rig.list_states)
    for name in ("first", "second", "third"):
        rig_queue.add(name, json.dumps({"name": name}).encode())
    yield rig_queue
    rig_queue.close()


def test_scans_start_in_order_when_the_rig_is_free(queue, rig):
    assert queue.waiting().names == ["first", "second", "third"]
    with expect_refusal(ErrorCode.NAME_TAKEN):
        queue.add("second", b'{"name": "second"}')
    queue.remove("second")
    rig.is_busy = False
    wait_for(lambda: rig.started == ["first"], "the first")
    # The first scan has ended.
    rig.is_busy = False
    wait_for(lambda: rig.started == ["first", "third"], "the third")
    wait_for(lambda: queue.waiting().names == [], "an empty queue")


@pytest.mark.parametrize("state", ["failed", "stopped", "lost"])
def test_after_a_scan_that_did_not_finish_the_queue_waits_for_a_person(queue, rig, state):
    rig.states["first"] = state
    rig.is_busy = False
    wait_for(lambda: rig.started == ["first"], "the first")
    rig.is_busy = False
    wait_for(lambda: queue.waiting().held, "that it waits")
    assert "first" in queue.waiting().held
    assert rig.started == ["first"]
    queue.release()
    wait_for(lambda: rig.started == ["first", "second"], "the second")


def test_a_scan_that_cannot_be_started_stays_with_its_cause(queue, rig):
    rig.is_broken = True
    rig.is_busy = False
    wait_for(lambda: "no launcher" in queue.waiting().held, "the reason")
    assert queue.waiting().names[0] == "first"


def test_a_queue_survives_a_restart(queue, rig, tmp_path):
    queue.close()
    next_queue = Queue(tmp_path / "queue", rig.start, rig.list_states)
    assert next_queue.waiting().names == ["first", "second", "third"]
    next_queue.close()


@pytest.mark.parametrize("state", ["stopped", "failed", "lost"])
def test_a_scan_that_somebody_else_started_holds_the_queue_too(queue, rig, state):
    """A person who aborts a scan may be touching the rig."""
    rig.states["by hand"] = "running"
    # The queue reads the states with each request: two more requests show that it has read them.
    wait_for(lambda: rig.asked > 2, "that the queue has seen it")
    rig.states["by hand"] = state
    rig.is_busy = False
    wait_for(lambda: queue.waiting().held, "that it waits")
    assert "by hand" in queue.waiting().held
    assert rig.started == []
    queue.release()
    wait_for(lambda: rig.started == ["first"], "the first")


def test_a_scan_that_was_stopped_while_the_queue_was_empty_does_not_hold_it(queue, rig):
    for name in queue.waiting().names:
        queue.remove(name)
    rig.states["by hand"] = "stopped"
    rig.is_busy = False
    queue.add("first", b'{"name": "first"}')
    wait_for(lambda: rig.started == ["first"], "the first")


def test_after_a_restart_a_newest_scan_that_did_not_finish_holds_the_queue(queue, rig, tmp_path):
    queue.close()
    rig.states["by hand"] = "stopped"
    rig.is_busy = False
    next_queue = Queue(tmp_path / "queue", rig.start, rig.list_states)
    wait_for(lambda: next_queue.waiting().held, "that it waits")
    assert rig.started == []
    next_queue.close()
