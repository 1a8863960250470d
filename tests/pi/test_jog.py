"""A jog from the host: the stage moves to its target while the host lives, and no further."""

import json
import os
import signal
import threading

import msgspec
import pytest
import zmq
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal

from polysight.acquisition import PiClient
from polysight.cli.main import main
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode


@pytest.fixture
def rig(pi, instrument):
    """The rig as its host sees it, with the stage homed."""
    pi.host.must_accept(m.Home())
    pi.host.wait_for_state("homed")
    server = pi.service.server
    addresses = msgspec.structs.replace(
        instrument.pi, command_address=server.command_address, event_address=server.event_address
    )
    return msgspec.structs.replace(instrument, pi=addresses)


@pytest.fixture
def client(rig):
    """The host's own client."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with PiClient(context, rig) as client:
        yield client
    context.destroy(linger=0)


def test_the_command_prints_the_stage_position_and_its_limits(rig, write_config, capsys):
    config = str(write_config(rig))
    assert main(["jog", "x", "10", "--config", config]) == 0
    assert f"x 10.000 mm (limits: 0 and {rig.stage.travel_x_mm:g} mm)" in capsys.readouterr().out
    assert main(["jog", "x", "-2.5", "--speed-mm-s", "5", "--json", "--config", config]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["x_mm"], answer["y_mm"], answer["travel_y_mm"]) == (7.5, 0.0, rig.stage.travel_y_mm)


def test_the_heartbeat_of_the_client_keeps_a_long_jog_moving(client, pi, stage):
    """The jog lasts many times longer than the timeout of a silent host; another client's abort ends it."""
    # The stage reports the end of a motion after a minute.
    stage.pace_s = 60.0

    def abort_later() -> None:
        pi.host.wait_for_state("jogging")
        jog = pi.service.executor._machine.jog
        begun_s = jog.alive_s
        wait_for(lambda: jog.alive_s > begun_s + 3 * jog.timeout_s, "heartbeats of the jog")
        pi.host.must_accept(m.Abort())

    person = threading.Thread(target=abort_later)
    person.start()
    with expect_refusal(ErrorCode.STAGE_NOT_READY, "aborted"):
        client.jog("x", distance_mm=10.0, speed_mm_s=20.0)
    person.join()
    assert pi.host.wait_for_event(m.Jogged).status == "aborted"


def test_an_interrupted_jog_is_stopped(client, pi, stage):
    stage.pace_s = 60.0

    def interrupt_later() -> None:
        pi.host.wait_for_state("jogging")
        os.kill(os.getpid(), signal.SIGINT)

    operator = threading.Thread(target=interrupt_later)
    operator.start()
    with pytest.raises(KeyboardInterrupt):
        client.jog("x", distance_mm=10.0, speed_mm_s=20.0)
    operator.join()
    ended = pi.host.wait_for_event(m.Jogged)
    assert (ended.status, ended.reason) == ("aborted", "stopped by its operator")
