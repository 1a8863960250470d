"""The simulated rig under native control: its rig file, its signals, and its chip behind a socket."""

from __future__ import annotations

import socket
import struct
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import refused
from tests.support.rigs import published_rig

from polysight.radar.board import RadarBoard, State
from polysight.radar.commands import constraints, program
from polysight.radar.control import open_board
from polysight.radar.usb import SystemClock
from polysight_shared.error_codes import ErrorCode
from polysight_simulators.radars import RadarBoard as Simulated
from polysight_simulators.radars import RadarSocket, make_image
from polysight_simulators.rig import derive
from polysight_simulators.scene import SimulatedRig, decode_scene, without_offset

EMPTY = decode_scene({"name": "the direct path alone"}, "test")


def test_the_derived_rig_keeps_all_constraints_and_has_every_address(tmp_path: Path):
    rig = derive(published_rig(), EMPTY, tmp_path, native=True)
    assert rig.radar.control == "native"
    assert [c for c in constraints(rig, 5600) if not c.holds] == []
    assert len({b.usb_serial for b in rig.radar.native.values()}) == 3
    assert all(b.usb_serial.startswith("tcp://127.") for b in rig.radar.native.values())


def test_offsets_give_the_same_signals_from_scene_rig_file_and_program(tmp_path: Path):
    """The same start frequencies, from the scene, the rig file or native control, give the same samples."""
    result = derive(published_rig(), EMPTY, tmp_path)
    native = derive(published_rig(), EMPTY, tmp_path, native=True)
    origin_mm = np.zeros(2)
    a = SimulatedRig(published_rig(), EMPTY, 5).signals("RH", origin_mm, origin_mm)
    b = SimulatedRig(result, without_offset(EMPTY), 5).signals("RH", origin_mm, origin_mm)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, SimulatedRig(native, EMPTY, 5).signals("RH", origin_mm, origin_mm))
    assert {b.start_offset_hz for b in result.recorded} == {EMPTY.disturbances.if_offset_hz}
    moved = tuple(
        msgspec.structs.replace(x, start_offset_hz=x.start_offset_hz + 1e5) if x.name == "RH" else x
        for x in native.boards
    )
    programmed = SimulatedRig(msgspec.structs.replace(native, boards=moved), EMPTY, 5).signals(
        "RH", origin_mm, origin_mm
    )
    assert not np.allclose(a, programmed)


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


def test_a_board_runs_a_row_over_its_socket(rig, served_board):
    radar_socket, board = served_board
    radar = RadarBoard("LS", open_board(radar_socket.address), SystemClock(), program(rig, rig.by_name("LS")))
    radar.configure()
    radar.arm(2)
    for n in range(2):
        assert board.trigger(n * 1.5e-3)
    wait_for(lambda: radar.poll() is State.DONE, "the end of the row")
    assert radar_socket.chip.errors == []
    radar.close()


def test_a_board_unplugged_behind_its_socket_is_a_fault_with_its_address(rig, served_board):
    radar_socket, board = served_board
    radar = RadarBoard("LS", open_board(radar_socket.address), SystemClock(), program(rig, rig.by_name("LS")))
    radar.configure()
    board.plugged = False
    assert radar.poll() is State.FAULT
    assert radar_socket.address in radar.reason
    radar.close()


def test_an_address_without_a_server_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with refused(ErrorCode.NO_ANSWER, f"tcp://127.0.0.1:{port}"):
        open_board(f"tcp://127.0.0.1:{port}")
    with refused(ErrorCode.NO_ANSWER, "tcp://nonsense"):
        open_board("tcp://nonsense")


def test_a_split_request_is_processed(served_board):
    radar_socket, _ = served_board
    ask = struct.pack("<ccH", b"B", b"W", 2) + b"\x81\x87" + struct.pack("<ccH", b"B", b"R", 1)
    with socket.create_connection(("127.0.0.1", int(radar_socket.address.rpartition(":")[2]))) as client:
        client.settimeout(HANG_S)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in ask:
            client.sendall(bytes((byte,)))
            time.sleep(0.001)
        assert client.recv(3, socket.MSG_WAITALL) == b"\x01\x00\x00"
