"""The fault table is complete and agrees with the firmware; simulated wires preserve edges and their times."""

import socket
import threading
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from tests.support.paths import REPO
from tests.support.processes import HANG_S
from tests.support.refusals import expect_refusal

from polysight_shared.errors import DeviceError, ErrorCode, ProtocolError
from polysight_shared.faults import EXPLANATIONS, PiFault, StageError, explain, format_c_header
from polysight_shared.wires import WireClient, WireEdge, WireMotion, encode, parse


def test_every_number_is_explained_and_unique():
    numbers = [*map(int, StageError), *map(int, PiFault)]
    assert sorted(numbers) == sorted(EXPLANATIONS)
    assert all(all(explain(k)) for k in numbers)
    assert "250" in explain(250).problem


def test_the_firmware_header_is_the_table():
    assert (REPO / "arduino_stage" / "stage_errors.h").read_text() == format_c_header()


big = st.integers(-(2**60), 2**60)
messages = st.builds(WireEdge, big, st.integers(0, 60), st.integers(0, 1)) | st.builds(WireMotion, big, big, big, big)


@given(messages)
def test_wire_lines_round_trip(message: WireEdge | WireMotion):
    assert parse(encode(message).decode().strip()) == message


@pytest.mark.parametrize("line", ["", "S 1 2", "S 1 2 3", "M 1 2 3", "X 1 2 3", "S a 2 1"])
def test_other_lines_are_refused(line: str):
    with pytest.raises(ProtocolError):
        parse(line)


def test_a_client_receives_all_edges_in_order_and_detects_the_end_of_the_hub(tmp_path: Path):
    path = tmp_path / "hub"
    hub = socket.socket(socket.AF_UNIX)
    hub.bind(str(path))
    hub.listen()
    sent = [WireEdge(k, 26, k % 2) for k in range(1000)]

    def serve() -> None:
        peer, _ = hub.accept()
        assert peer.recv(100) == b"L 26\n"
        peer.sendall(b"K\n" + b"".join(map(encode, sent)))
        peer.close()

    thread = threading.Thread(target=serve)
    thread.start()
    client = WireClient(path, listen=(26,))
    assert [client.receive(HANG_S) for _ in sent] == sent
    with pytest.raises(DeviceError):
        client.receive(HANG_S)
    client.close()
    thread.join()
    hub.close()


def test_a_missing_hub_is_an_error(tmp_path: Path):
    with expect_refusal(ErrorCode.NO_ANSWER, tmp_path):
        WireClient(tmp_path / "none", timeout_s=0.05)
