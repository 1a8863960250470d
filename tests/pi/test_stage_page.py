"""Home and jog on the operator's page: the stage moves within the limits, and can be stopped."""

import threading
from collections.abc import Iterator

import msgspec
import pytest
from tests.support.page.asking import TOKEN, post
from tests.support.page.chromium import DESK, PHONE, Browser, find_axe
from tests.support.page.live_view import Served, serve_folder

from polysight_shared import messages as m

SIZES = pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])


@pytest.fixture
def view(pi, instrument, write_config, tmp_path) -> Iterator[Served]:
    """A page with a Pi and its stage, which is not homed."""
    server = pi.service.server
    addresses = msgspec.structs.replace(
        instrument.pi, command_address=server.command_address, event_address=server.event_address
    )
    config = write_config(msgspec.structs.replace(instrument, pi=addresses))
    (tmp_path / "scans").mkdir()
    with serve_folder(tmp_path / "scans", TOKEN, config=config) as view:
        yield view


def home(view: Served, pi) -> None:
    status, _ = post(view, "/api/stage/home")
    assert status == 200
    pi.host.wait_for_state("homed")


def list_moves(stage) -> list[object]:
    return [line for line in stage.seen if line.verb == "MOVE"]


@pytest.mark.parametrize("command", ["look", "home", "stop", "jog"])
def test_without_the_token_nothing_of_the_stage_is_shown_or_moved(view, stage, command):
    seen_before = list(stage.seen)
    status, _ = post(view, f"/api/stage/{command}", {"axis": "x", "distance_mm": 1.0}, token="wrong")
    assert status == 403
    assert not [line for line in stage.seen[len(seen_before) :] if line.verb in ("HOME", "MOVE")]


def test_a_jog_before_homing_past_a_limit_or_too_far_is_refused_and_moves_nothing(view, pi, stage):
    # Statuses of HTTP: the rig does not allow the jog now, or the request is invalid in itself.
    not_now = 409
    invalid = 400

    def ask_to_jog(axis, distance_mm):
        status, _ = post(view, "/api/stage/jog", {"axis": axis, "distance_mm": distance_mm})
        return status

    assert ask_to_jog("x", 1.0) == not_now
    home(view, pi)
    assert ask_to_jog("x", -1.0) == not_now
    # A jog is at most 100 mm.
    assert ask_to_jog("x", 100.1) == invalid
    assert ask_to_jog("z", 1.0) == invalid
    assert not list_moves(stage)


def test_a_jog_is_stopped_by_another_request_and_a_second_one_is_refused(view, pi, stage):
    home(view, pi)
    stage.pace_s = 60.0
    answers = []
    jog = threading.Thread(
        target=lambda: answers.append(post(view, "/api/stage/jog", {"axis": "x", "distance_mm": 10.0}))
    )
    jog.start()
    pi.host.wait_for_state("jogging")
    _, refusal = post(view, "/api/stage/jog", {"axis": "y", "distance_mm": 1.0})
    assert refusal["code"] == "busy"
    stop_status, _ = post(view, "/api/stage/stop")
    assert stop_status == 200
    jog.join()
    ((status, answer),) = answers
    assert status == 409
    assert "stopped" in answer["what"]
    assert pi.host.wait_for_event(m.Jogged).status == "aborted"
    assert len(list_moves(stage)) == 1


@SIZES
def test_the_stage_is_homed_and_jogged_between_its_limits(browser: Browser, view, instrument, tmp_path, size):
    travel_mm = instrument.stage.travel_x_mm
    browser.visit(f"{view.address}/new#token={TOKEN}", size)
    browser.wait("document.querySelector('.time')", "the plan")
    browser.evaluate("document.querySelector('#stage > summary').click()")
    stage_text = "document.getElementById('stage-told').textContent"
    browser.wait(f"{stage_text}.startsWith('Not homed')", "the state")
    enabled = "[...document.querySelectorAll('#axes button:enabled')].map((b) => b.getAttribute('aria-label')).join()"
    assert browser.evaluate(enabled) == ""

    browser.evaluate("document.getElementById('stage-home').click()")
    forward = ",".join(f"Move {axis} by {step} mm" for axis in "xy" for step in (1, 10, 100))
    # The stage is at the corner: it cannot move further back.
    browser.wait(f"{enabled} == '{forward}'", "buttons that lead within the limits")
    browser.evaluate("document.querySelector('[aria-label=\"Move x by 10 mm\"]').click()")
    place = "document.getElementById('axes').innerText"
    browser.wait(f"{place}.includes('x 10.0 mm') && {stage_text} == 'At rest.'", "the end of the jog")
    assert f"limits 0 and {travel_mm:g} mm" in browser.evaluate(place)
    browser.wait(f"{enabled}.includes('Move x by -10 mm')", "the way back")
    assert "Move x by -100 mm" not in browser.evaluate(enabled)

    browser.save_screenshot(tmp_path / "stage.png")
    browser.check_whole(view.address)
    axe = find_axe()
    if axe is not None:
        assert browser.find_violations(axe) == []


def test_a_pi_that_does_not_answer_is_reported_and_can_be_asked_again(
    browser: Browser, instrument, write_config, tmp_path
):
    silent = msgspec.structs.replace(
        instrument.pi, command_address="tcp://127.0.0.1:9", event_address="tcp://127.0.0.1:9"
    )
    limits = msgspec.structs.replace(instrument.limits, command_timeout_s=0.5)
    config = write_config(msgspec.structs.replace(instrument, pi=silent, limits=limits))
    (tmp_path / "scans").mkdir()
    with serve_folder(tmp_path / "scans", TOKEN, config=config) as view:
        browser.visit(f"{view.address}/new#token={TOKEN}", PHONE)
        browser.wait("document.querySelector('.time')", "the plan")
        browser.evaluate("document.querySelector('#stage > summary').click()")
        browser.wait("document.getElementById('stage-told').textContent.includes('did not answer')", "the error")
        assert not browser.evaluate("document.getElementById('stage-home').disabled")
