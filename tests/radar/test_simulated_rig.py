"""The simulated rig under native control: its rig file keeps all constraints, its boards are reached over sockets."""

import socket
import threading
import time
from pathlib import Path

import pytest
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.radar.board import RadarBoard, State
from polysight.radar.commands import list_constraints, make_program
from polysight.radar.control import open_board
from polysight.radar.usb import SystemClock
from polysight_shared.errors import ErrorCode
from polysight_simulators.radars import RadarBoard as Simulated, RadarSocket, make_image
from polysight_simulators.rig import derive
from polysight_simulators.scene import decode_scene

# A scene without objects.
EMPTY = decode_scene({"name": "the direct path alone"}, "test")


def test_the_derived_rig_keeps_all_constraints_and_has_every_address(tmp_path: Path):
    rig = derive(load_published_rig(), EMPTY, tmp_path, native=True)
    assert rig.radar.control == "native"
    assert [c for c in list_constraints(rig, 5600) if not c.holds] == []
    assert len({b.usb_serial for b in rig.radar.native.values()}) == 3
    assert all(b.usb_serial.startswith("tcp://127.") for b in rig.radar.native.values())


@pytest.fixture
def served_board():
    """A simulated board at a TCP address, served by a thread."""
    board = Simulated(time.monotonic, flash=make_image())
    radar_socket = RadarSocket("tcp://127.0.0.1:0", board)
    stop = threading.Event()

    def serve() -> None:
        while not stop.wait(0.0005):
            radar_socket.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    yield radar_socket, board
    stop.set()
    thread.join()
    radar_socket.close()


class PatientClock(SystemClock):
    """A clock that runs a thousand times slower: the thread that serves the board may be delayed."""

    def now(self) -> float:
        return super().now() / 1000


def test_a_board_unplugged_from_its_socket_server_is_a_fault_with_its_address(rig, served_board):
    radar_socket, board = served_board
    radar = RadarBoard("LS", open_board(radar_socket.address), PatientClock(), make_program(rig, rig.by_name("LS")))
    radar.configure()
    board.plugged = False
    assert radar.poll() is State.FAULT
    assert radar_socket.address in radar.reason
    radar.close()


def test_an_address_without_a_server_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with expect_refusal(ErrorCode.NO_ANSWER, f"tcp://127.0.0.1:{port}"):
        open_board(f"tcp://127.0.0.1:{port}")
    with expect_refusal(ErrorCode.NO_ANSWER, "tcp://nonsense"):
        open_board("tcp://nonsense")
