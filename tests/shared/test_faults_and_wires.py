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


def test_every_number_of_a_fault_is_unique_and_has_an_explanation():
    numbers = [*map(int, StageError), *map(int, PiFault)]
    assert sorted(numbers) == sorted(EXPLANATIONS)
    # An explanation has a problem, a cause and a remedy; none is empty.
    assert all(all(explain(number)) for number in numbers)


def test_a_number_that_no_table_has_is_named_in_its_explanation():
    unused_number = 250
    assert str(unused_number) in explain(unused_number).problem


def test_the_firmware_header_is_the_table():
    assert (REPO / "arduino_stage" / "stage_errors.h").read_text() == format_c_header()


# Times in ns, positions in um and speeds in um/s are any integers of up to 60 bits.
integers = st.integers(-(2**60), 2**60)
lines = st.integers(0, 60)
levels = st.integers(0, 1)
messages = st.one_of(
    st.builds(WireEdge, t_ns=integers, line=lines, value=levels),
    st.builds(WireMotion, t_ns=integers, x_um=integers, y_um=integers, vx_um_s=integers),
)


@given(messages)
def test_wire_lines_round_trip(message: WireEdge | WireMotion):
    assert parse(encode(message).decode().strip()) == message


@pytest.mark.parametrize("line", ["", "S 1 2", "S 1 2 3", "M 1 2 3", "X 1 2 3", "S a 2 1"])
def test_other_lines_are_refused(line: str):
    with pytest.raises(ProtocolError):
        parse(line)


def test_a_client_receives_all_edges_in_order_and_detects_the_end_of_the_hub(tmp_path: Path):
    # The test itself is the hub: it sends 1000 edges of one line, and closes the connection.
    path = tmp_path / "hub"
    hub = socket.socket(socket.AF_UNIX)
    hub.bind(str(path))
    hub.listen()
    line = 26
    sent = [WireEdge(t_ns=k, line=line, value=k % 2) for k in range(1000)]

    def serve() -> None:
        peer, _ = hub.accept()
        # The client asks for the edges of a line (L), and the hub confirms (K).
        assert peer.recv(100) == b"L 26\n"
        peer.sendall(b"K\n" + b"".join(map(encode, sent)))
        peer.close()

    thread = threading.Thread(target=serve)
    thread.start()
    client = WireClient(path, listen=(line,))
    assert [client.receive(HANG_S) for _ in sent] == sent
    with pytest.raises(DeviceError):
        client.receive(HANG_S)
    client.close()
    thread.join()
    hub.close()


def test_a_missing_hub_is_an_error(tmp_path: Path):
    with expect_refusal(ErrorCode.NO_ANSWER, tmp_path):
        WireClient(tmp_path / "none", timeout_s=0.05)
