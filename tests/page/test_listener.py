"""The page listens to the Pi's events and sends no requests."""

import select
import socket

import msgspec
import pytest
import zmq
from tests.support.processes import HANG_S, wait_for
from tests.support.rigs import load_published_rig
from zmq.utils.monitor import recv_monitor_message

from polysight.page.watch import PiListener
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.raster import plan_raster
from polysight_shared.sockets import EVENT_TOPIC, create_observer, create_publisher, make_server_context

RIG = load_published_rig()
# Fields that all events of the watched scan have.
COMMON = {"scan_id": "mine", "t_mono_ns": 1}


@pytest.fixture
def pi(tmp_path):
    """A function that sends events as the Pi does, and a listener that has received some."""
    context = make_server_context()
    events = create_publisher(context, "tcp://127.0.0.1:*", tmp_path)
    address = events.getsockopt_string(zmq.LAST_ENDPOINT)
    # The listener sends no requests: nothing answers at port 1.
    addresses = {"event_address": address, "command_address": "tcp://127.0.0.1:1"}
    instrument = msgspec.structs.replace(RIG, pi=msgspec.structs.replace(RIG.pi, **addresses))
    listener = PiListener(instrument, "mine")

    def send_events(*new_events: m.AnyEvent) -> None:
        for event in new_events:
            events.send_multipart([EVENT_TOPIC, m.pack(event)])

    def send_heartbeat() -> float:
        """A subscription takes a while: heartbeats are repeated until the listener has heard one."""
        send_events(m.Heartbeat(**COMMON, seq=0, state="ready", period_ms=100))
        return listener.state.heard_s

    wait_for(send_heartbeat, "the first event")
    send_events(m.Heartbeat(**COMMON, seq=0, state="homed", period_ms=100))
    wait_for(lambda: listener.state.state == "homed", "the last one")
    yield send_events, listener
    listener.close()
    context.destroy(linger=0)


def make_capture(point: int, scan: str = "mine") -> m.Capture:
    return m.Capture(
        scan_id=scan, t_mono_ns=1, seq=3, row_index=7, take=2, point=point, column=point, edge_ns=0, first_pulse_ns=0,
        last_pulse_ns=0, pulses=1, width_max_ns=0, jitter_ns=0,
    )  # fmt: skip


def make_row_finished(status: m.RowStatus) -> m.RowFinished:
    return m.RowFinished(**COMMON, seq=9, row_index=7, take=2, status=status, points=1, edges=1, bursts=1, pulses=1)


def test_the_stage_s_position_is_counted_from_the_rig_s_centre(pi):
    send_events, listener = pi
    send_events(
        m.StageStatus(**COMMON, seq=1, state="run", x_mm=RIG.stage.centre_x_mm - 3, y_mm=RIG.stage.centre_y_mm + 5)
    )
    wait_for(lambda: listener.state.x_mm is not None, "the stage")
    assert (listener.state.x_mm, listener.state.y_mm) == (-3.0, 5.0)


def test_a_row_is_shown_while_it_runs_and_rows_of_other_scans_are_not(pi):
    send_events, listener = pi
    send_events(
        m.RowStarted(**COMMON, seq=2, row=plan_raster(RIG.grid).row(7), take=2),
        make_capture(0),
        make_capture(1, "another"),
    )
    wait_for(lambda: listener.state.point, "a point")
    send_events(make_capture(4))
    wait_for(lambda: listener.state.point == 5, "the newest point")
    assert (listener.state.row, listener.state.take, listener.state.state) == (7, 2, "running")
    send_events(make_row_finished("done"))
    wait_for(lambda: listener.state.row == -1, "the row's end")


def test_faults_stay_until_a_row_ends_well(pi):
    send_events, listener = pi
    send_events(m.Fault(**COMMON, seq=4, number=PiFault.STAGE_LOST, problem="the stage does not answer"))
    wait_for(lambda: listener.state.faults, "the fault")
    send_events(make_row_finished("fault"), m.Heartbeat(**COMMON, seq=9, state="fault", period_ms=100))
    wait_for(lambda: listener.state.state == "fault", "the state")
    assert listener.state.faults[0].level == "error"
    send_events(make_row_finished("done"))
    wait_for(lambda: not listener.state.faults, "that it is over")


def test_bytes_that_are_no_message_are_reported_and_later_events_are_received(pi):
    send_events, listener = pi
    state_before = listener.state
    listener._receive(b"\xc1 no message")
    assert listener.state.receive_error is not None
    assert listener.state.receive_error.do or listener.state.receive_error.why
    assert (listener.state.row, listener.state.state) == (state_before.row, state_before.state)
    send_events(m.Heartbeat(**COMMON, seq=0, state="idle", period_ms=100))
    wait_for(lambda: listener.state.state == "idle", "the next event")
    assert listener.state.receive_error is None


def test_without_keys_the_view_receives_no_events_and_reports_it(tmp_path):
    # Keys are needed only for a Pi on another computer; 192.0.2.1 is reserved for documentation.
    elsewhere = {"event_address": "tcp://192.0.2.1:5602", "key_dir": str(tmp_path)}
    instrument = msgspec.structs.replace(RIG, pi=msgspec.structs.replace(RIG.pi, **elsewhere))
    listener = PiListener(instrument, "mine")
    wait_for(lambda: listener.state.receive_error, "why nothing is heard")
    assert str(tmp_path) in listener.state.receive_error.do, "the folder where the keys belong"
    listener.close()


# Begin of the command by which ZeroMQ asks the other side for a sign of life: the name's length, and the name.
PING = b"\x04PING"


def test_the_pi_forgets_a_view_that_hangs(tmp_path):
    """The Pi's queue for that subscriber is limited. A relay between both passes bytes until the view is to hang."""
    server_context = make_server_context()
    view_context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    events = create_publisher(server_context, "tcp://127.0.0.1:*", tmp_path)
    monitor = events.get_monitor_socket()
    port = int(events.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])

    def is_forgotten() -> bool:
        events.send_multipart([EVENT_TOPIC, b"x"])
        return bool(monitor.poll(0)) and recv_monitor_message(monitor)["event"] == zmq.Event.DISCONNECTED

    try:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
            view_socket = create_observer(view_context, address, tmp_path)
            view, _ = listener.accept()
            with view, socket.create_connection(("127.0.0.1", port)) as pi:
                received = b""
                # The Pi learns from the view's first PING how often it will send them.
                while PING not in received:
                    readable, _, _ = select.select([view, pi], [], [], HANG_S)
                    if pi in readable:
                        view.sendall(pi.recv(65536))
                    if view in readable:
                        part = view.recv(65536)
                        received += part
                        pi.sendall(part)
                wait_for(is_forgotten, "that it is forgotten")
            view_socket.close()
    finally:
        view_context.destroy(linger=0)
        events.disable_monitor()
        monitor.close()
        server_context.destroy(linger=0)
