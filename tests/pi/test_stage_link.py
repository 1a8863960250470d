"""The serial link against a pty, and a port whose opening resets an UNO (DTR)."""

import itertools
import json
import os
import queue
import subprocess
from contextlib import closing
from types import SimpleNamespace

import msgspec
import pytest
from tests.support.pi.fakes import FakeStage
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig, set_stage_port
from tests.support.stage.processes import StageProcess

from polysight_pi import stage
from polysight_pi.cli import main
from polysight_pi.stage import BenchStage, StageLink, StageLost, StageLostError, StageRefusedError
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import StageError, explain
from polysight_shared.stage_line import Immediate, Parameter, Reply
from polysight_simulators.builds import sketch_compiler

BAUD_RATE = 115_200


@pytest.fixture
def dry_stage():
    """A stage without wires."""
    stage = FakeStage(None)
    yield stage
    stage.close()


@pytest.fixture
def connect(dry_stage):
    """Function that opens the link; it returns the link and the queue of its unsolicited replies."""
    links = []

    def connect(**options):
        news = queue.SimpleQueue()
        links.append(StageLink(dry_stage.port, BAUD_RATE, news.put, **options))
        return links[-1], news

    yield connect
    for link in links:
        link.close()


def test_the_link_waits_for_the_banner_and_then_greets_the_stage(dry_stage, connect):
    link, _ = connect()
    assert link.firmware == "fake"
    assert [c.verb for c in dry_stage.seen] == ["HELLO"]


def test_a_stage_without_banner_is_greeted_after_the_limit(dry_stage, connect):
    """A stage whose port was already open does not restart, and so prints no banner."""
    dry_stage.banner = False
    link, _ = connect(banner_timeout_s=0.05)
    assert link.request("SET", Parameter.HEARTBEAT, 500).kind == "ok"


def test_a_line_is_sent_again_with_its_number_and_acts_once(dry_stage, connect):
    link, _ = connect()
    # The next line arrives damaged; then the answer to one is lost.
    dry_stage.damage = 1
    link.request("SET", Parameter.HEARTBEAT, 500)
    dry_stage.lose = 1
    link.request("SET", Parameter.TRIGGER, 20)
    assert [(c.sequence, c.verb) for c in dry_stage.seen] == [(0, "HELLO"), (1, "SET"), (2, "SET")]


def test_a_line_that_always_arrives_damaged_is_sent_four_times(dry_stage, connect, monkeypatch):
    """Without this limit a stage that reports damage without end would be sent more lines than it reads."""
    link, _ = connect()
    lines: list[bytes] = []

    def report_damage(line: bytes) -> None:
        lines.append(line)
        dry_stage.say(Reply("error", None, StageError.BAD_CRC))

    monkeypatch.setattr(dry_stage, "_line", report_damage)
    with pytest.raises(StageLostError, match="damaged 4 times") as error:
        link.request("CLEAR")
    assert "cable" in error.value.why
    assert len(lines) == 4


def test_waiting_for_a_lost_answer_leaves_time_for_a_stop():
    """The thread that waits for an answer also sends the stops. A stop has to be sent within half a second."""
    # Waiting once for an answer may take a third of that.
    assert stage.ANSWER_TIMEOUT_S <= 0.5 / 3
    # A busy machine has 2 s to answer.
    assert stage.ANSWER_TIMEOUT_S * stage.TRIES >= 2.0


def test_a_refusal_of_the_stage_has_its_number_explanation_and_remedy(connect):
    link, _ = connect()
    with pytest.raises(StageRefusedError) as e:
        link.request("MOVE", 1, 2, 3)
    assert e.value.number == StageError.NOT_HOMED
    assert e.value.what.endswith(explain(StageError.NOT_HOMED).problem)
    assert e.value.remedy


def test_numbers_of_lines_begin_again_after_65535(connect):
    link, _ = connect()
    link._sequence = 65535
    assert link.request("SET", Parameter.HEARTBEAT, 500).sequence == 65535
    assert link.request("SET", Parameter.HEARTBEAT, 500).sequence == 0


def test_answers_are_distinguished_from_spontaneous_lines(dry_stage, connect):
    link, news = connect()
    dry_stage.say_raw(b"\x00garbage\n" + b"x" * 500 + b"\n")
    dry_stage.say(Reply("alarm", number=StageError.LIMIT_SWITCH))
    link.request("SET", Parameter.HEARTBEAT, 500)
    link.send_byte(Immediate.STATUS)
    kinds = [news.get(timeout=HANG_S).kind for _ in range(3)]
    assert sorted(kinds) == ["alarm", "ok", "status"]
    # One line has characters that no line may have, and one line is too long.
    assert link.bad_lines == 2


def test_silence_after_a_status_byte_is_a_lost_stage(dry_stage, connect):
    link, news = connect(heartbeat_s=0.2)
    link.ask_status_every(0.02)
    assert news.get(timeout=HANG_S).kind == "status"
    # From now on the stage answers nothing.
    dry_stage.deaf = True
    while not isinstance(stage_lost := news.get(timeout=HANG_S), StageLost):
        pass
    assert "silent" in stage_lost.reason
    with pytest.raises(StageLostError):
        link.request("SET", Parameter.HEARTBEAT, 500)


def test_a_moving_stage_that_receives_but_cannot_send_is_stopped(dry_stage, connect):
    # With its own heartbeat it would continue for longer than the half second of docs/spec/wire.md.
    link, news = connect(heartbeat_s=0.2)
    dry_stage.deaf = True
    link.ask_status_every(0.02)
    while not isinstance(news.get(timeout=HANG_S), StageLost):
        pass
    wait_for(lambda: Immediate.STOP in dry_stage.bytes_seen, "STOP")


def test_only_a_status_answers_a_status_request(dry_stage, connect):
    link, news = connect(heartbeat_s=0.2)
    dry_stage.deaf = True
    link.ask_status_every(0.02)
    stage_lost = None
    for _ in range(10_000):
        os.write(dry_stage.master, Reply("ok", 0).encode())
        if isinstance(stage_lost := news.get(timeout=HANG_S), StageLost):
            break
    assert isinstance(stage_lost, StageLost)


@pytest.mark.parametrize("refused_parameter", [Parameter.BACKLASH, Parameter.PINS])
def test_a_sketch_that_does_not_know_the_newest_setting_is_named_as_old(
    dry_stage, instrument, monkeypatch, refused_parameter
):
    request = StageLink.request

    def refuse_parameter(link, verb, *args):
        if verb == "SET" and args[0] == refused_parameter:
            raise StageRefusedError(verb, StageError.OUT_OF_RANGE)
        return request(link, verb, *args)

    monkeypatch.setattr(StageLink, "request", refuse_parameter)
    with pytest.raises(StageRefusedError) as e, BenchStage(set_stage_port(instrument, dry_stage.port).stage) as bench:
        bench.home()
    is_named_as_old = e.value.remedy == "flash the sketch of this release"
    assert is_named_as_old is (refused_parameter == Parameter.PINS)


def test_a_pulled_cable_is_a_lost_stage(dry_stage, connect):
    link, news = connect()
    dry_stage.unplug()
    assert isinstance(news.get(timeout=HANG_S), StageLost)
    with pytest.raises(StageLostError):
        link.send_byte(Immediate.STOP)


def test_a_missing_port_and_another_version_of_the_protocol_are_refused(tmp_path, monkeypatch, connect):
    with expect_refusal(ErrorCode.FILE_UNREADABLE, tmp_path / "none"):
        StageLink(str(tmp_path / "none"), BAUD_RATE, lambda _: None)
    monkeypatch.setattr("polysight_pi.stage.PROTOCOL_VERSION", 9)
    with expect_refusal(ErrorCode.VERSION_UNSUPPORTED, "protocol 2", 9):
        connect()


def test_other_steps_per_mm_are_refused_before_a_motion(dry_stage, instrument):
    dry_stage.steps = "160"
    with expect_refusal(ErrorCode.MISMATCH, 160, 200), BenchStage(set_stage_port(instrument, dry_stage.port).stage):
        pass
    assert [c.verb for c in dry_stage.seen] == ["HELLO"]


def test_jog_and_home_by_hand(dry_stage, instrument):
    with BenchStage(set_stage_port(instrument, dry_stage.port).stage) as stage:
        with pytest.raises(StageRefusedError):
            stage.jog(dx_mm=1, dy_mm=1, speed_mm_s=20)
        assert stage.home() == (0.0, 0.0)
        assert stage.jog(dx_mm=10, dy_mm=5.5, speed_mm_s=20) == (10.0, 5.5)
        assert stage.jog(dx_mm=-1, dy_mm=0, speed_mm_s=20) == (9.0, 5.5)
    # x, y and rate, with 200 steps/mm.
    last_command = dry_stage.seen[-1]
    assert last_command.verb == "MOVE"
    assert last_command.args == (9.0 * 200, 5.5 * 200, 20 * 200)


@pytest.mark.slow
def test_after_a_home_each_further_command_may_jog(write_config, instrument, tmp_path, capsys):
    """Each command opens the port again.

    That resets the stage only if another program has closed the port with its line DTR low.
    """
    port = tmp_path / "ttySTAGE"
    # No service listens there, so that the command uses the stage itself.
    pi = msgspec.structs.replace(instrument.pi, command_address="tcp://127.0.0.1:9")
    arguments = ["--config", str(write_config(msgspec.structs.replace(instrument, pi=pi))), "--stage-port", str(port)]

    def run_and_read_place(*command):
        assert main([*command, *arguments, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    with closing(StageProcess(tmp_path, "pc" if sketch_compiler() else "python", 20.0)):
        assert run_and_read_place("home") == {"x_mm": 0.0, "y_mm": 0.0}
        assert run_and_read_place("jog", "--dx", "10") == {"x_mm": 10.0, "y_mm": 0.0}
        assert run_and_read_place("jog", "--dx", "-4", "--dy", "1.5") == {"x_mm": 6.0, "y_mm": 1.5}

        def is_lost() -> bool:
            """True if the jog is refused; the stand-in may miss how its port was closed, if it polls too late."""
            subprocess.run(["stty", "-F", port, "hupcl"], check=True)
            return main(["jog", *arguments, "--dx", "1"]) != 0

        wait_for(is_lost, "the stage's reset")
        assert "polysight-pi home" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "tries"), [(StageError.BUSY, 7), (StageError.LIMIT_SWITCH, 1)])
def test_a_moving_stage_is_asked_again_to_clear_its_alarm_for_three_seconds(number, tries, monkeypatch):
    """Another refusal is final. The clock advances by half a second each time it is read: 0, 0.5, ... 3.0 s."""
    requests = []
    stops = []

    def refuse(verb):
        requests.append(verb)
        raise StageRefusedError(verb, number)

    clock = itertools.count(0, 0.5)
    monkeypatch.setattr(stage.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(stage.time, "sleep", lambda _: None)
    driver = stage.StageDriver(load_published_rig().stage, print)
    driver._open_link = SimpleNamespace(request=refuse, send_byte=stops.append)
    with pytest.raises(StageRefusedError):
        driver.clear(stop=True)
    assert requests == ["CLEAR"] * tries
    assert stops == [Immediate.STOP] * (tries - 1)
