"""Radars that are re-armed for each row: the line server's client, its errors, and a scan that depends on it."""

import shutil
import socket
import struct
import subprocess
import sys

import msgspec
import pytest
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.acquisition.scan import run_scan
from polysight.radar.control import (
    RETRIGGER_LINE,
    BoardState,
    Endless,
    LineServers,
    RadarControl,
    RadarState,
    open_radar_control,
)
from polysight.store.scan_folder import ScanFolder
from polysight_shared.config import Instrument, Radar
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.tables import decode, to_builtins


class Server:
    """A control server for a test, on a free port."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(HANG_S)
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.clients: list[socket.socket] = []

    def accept(self) -> socket.socket:
        client, _ = self.listener.accept()
        client.settimeout(HANG_S)
        self.clients.append(client)
        return client

    def close(self) -> None:
        for s in (*self.clients, self.listener):
            s.close()


@pytest.fixture
def server():
    simulated_server = Server()
    yield simulated_server
    simulated_server.close()


def test_each_row_sends_the_line_once_over_one_connection(server):
    with LineServers({"RH": server.address}, 5.0) as radars:
        client = server.accept()
        for _ in range(3):
            radars.arm(48)
            assert client.recv(100) == b"Retrigger\n"
            assert radars.states()["RH"].state is RadarState.UNKNOWN
            assert "never replies" in radars.states()["RH"].detail
    assert client.recv(1) == b""


def test_a_server_that_closes_after_each_line_gets_a_new_connection(server):
    with LineServers({"RH": server.address}, 5.0) as radars:
        for row in range(3):
            # The first connection exists before a row is armed.
            if row == 0:
                client = server.accept()
            else:
                radars.arm(1)
                client = server.accept()
                assert client.recv(100) == RETRIGGER_LINE
            client.close()
            wait_for(lambda: radars._is_closed("RH"), "radar")
            assert radars.states()["RH"].state is RadarState.UNKNOWN


def test_a_reset_is_a_fault_until_the_next_line(server):
    with LineServers({"RH": server.address}, 5.0) as radars:
        client = server.accept()
        radars.arm(1)
        assert client.recv(100) == RETRIGGER_LINE
        # Closed without delay: the connection is reset.
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        wait_for(lambda: radars.states()["RH"].state is RadarState.FAULT, "radar")
        assert "reset" in radars.states()["RH"].detail
        radars.arm(1)
        assert server.accept().recv(100) == RETRIGGER_LINE
        assert radars.states()["RH"].state is RadarState.UNKNOWN


def test_refused_connection_is_an_error_with_a_remedy(server):
    server.close()
    with pytest.raises(DeviceError) as e:
        LineServers({"RH": server.address}, 5.0)
    assert server.address in e.value.what
    assert "radar.servers" in e.value.remedy


def test_a_server_that_ends_between_rows_is_named(server):
    with LineServers({"RH": server.address}, 5.0) as radars:
        server.accept()
        server.close()
        wait_for(lambda: radars._is_closed("RH"), "radar")
        with pytest.raises(DeviceError):
            radars.arm(1)


def test_unknown_host_is_named():
    with pytest.raises(DeviceError) as e:
        LineServers({"RH": "no-such-host.invalid:5000"}, 2.0)
    assert "no-such-host.invalid:5000" in e.value.what


# Program in a network of its own: it connects to a server, and then switches the network off without closing the
# connection, as when the server's machine loses power.
HALF_OPEN_PROGRAM = """
import socket, subprocess
from polysight.radar.control import LineServers
from polysight_shared.errors import DeviceError
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
listener = socket.create_server(("127.0.0.1", 5000))
radars = LineServers({"RH": "127.0.0.1:5000"}, 0.5)
radars.arm(1)
subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
try:
    radars.arm(1)
except DeviceError as e:
    print(e)
"""


def test_a_server_whose_machine_has_disappeared_is_an_error():
    """Its connection is still open at this end ("half-open"), but no line is acknowledged."""
    if shutil.which("ip") is None or subprocess.run(["unshare", "-rn", "true"], check=False).returncode:
        pytest.skip("needs iproute2 and user namespaces")
    process = subprocess.run(
        ["unshare", "-rn", sys.executable, "-c", HALF_OPEN_PROGRAM],
        capture_output=True,
        text=True,
        check=True,
        timeout=HANG_S,
    )
    assert "did not acknowledge the line within 0.5 s" in process.stdout
    assert "half-open" in process.stdout


# --- radars in the rig file ---


def change_radar_settings(instrument: Instrument, **radar) -> dict:
    """The settings of a rig whose table [radar] has these values."""
    return {**to_builtins(instrument), "radar": radar}


@pytest.mark.parametrize(
    ("radar", "rule"),
    [
        ({"control": "telepathy"}, "radar.control"),
        ({"control": "line_server"}, "line_server"),
        ({"servers": {"XX": "127.0.0.1:5000"}}, "XX"),
        ({"servers": {"RH": "127.0.0.1"}}, "radar.servers"),
        ({"servers": {"RH": "127.0.0.1:70000"}}, "1..65535"),
    ],
)
def test_wrong_radar_tables_are_refused(make_instrument, radar, rule):
    with expect_refusal(ErrorCode.VALUE_INVALID, rule):
        decode(change_radar_settings(make_instrument(), **radar), Instrument, "test")


def test_backend_is_that_of_the_rig_file(make_instrument):
    assert isinstance(open_radar_control(make_instrument()), Endless)
    assert make_instrument().radar == Radar()


# --- rows that depend on the radars ---


class ScriptedRadars(RadarControl):
    """A radar backend that reports a scripted state of board RH after each arming."""

    def __init__(self, *script: RadarState) -> None:
        self._script = script
        self.armed = []
        self.closed = False
        # Boards that still wait after the pulses of an arming, by its number from 1.
        self.waiting: dict[int, list[str]] = {}

    def arm(self, frames: int) -> None:
        self.armed.append(frames)

    def states(self) -> dict[str, BoardState]:
        # The last state is kept.
        armings = min(len(self.armed), len(self._script))
        state = self._script[armings - 1]
        return {"RH": BoardState(state, "RF core fault 7"), "RV": BoardState(RadarState.ARMED)}

    def wait_done(self, timeout_s: float) -> list[str]:
        del timeout_s
        return self.waiting.get(len(self.armed), [])

    def close(self) -> None:
        self.closed = True


def list_rejection_reasons(scan: ScanFolder) -> list[str]:
    return [reason for fact in load_facts(scan, "row_rejected") for reason in fact["reasons"]]


def test_radars_are_armed_for_every_take_and_closed_at_the_end(rig, tmp_path):
    rig.cards["RV"].drop[1, 1] = {3}
    radars = ScriptedRadars(RadarState.ARMED)
    assert run_scan(rig.instrument, tmp_path / "s", radars=radars).exit_status == "success"
    # Four rows and a retake, each with 3 points of 3 pulses
    assert radars.armed == [3 * 3] * 5
    assert radars.closed


def test_a_row_whose_radar_is_in_fault_is_not_begun_and_the_radar_armed_again(rig, tmp_path):
    radars = ScriptedRadars(RadarState.FAULT, RadarState.ARMED)
    result = run_scan(rig.instrument, tmp_path / "s", radars=radars)
    assert (result.exit_status, result.retakes) == ("success", 1)
    # The first take was never sent to the stage.
    assert rig.pi.rows_run[0] == (0, 2)
    (fact,) = load_facts(result.folder, "row_rejected")
    assert fact["faults"] == [{"kind": "radar_stopped", "board": "RH"}, {"kind": "radar_stopped"}]
    assert any("RF core fault 7" in reason for reason in fact["reasons"])


def test_radar_that_faults_within_a_row_ends_it_immediately(rig, tmp_path):
    rig.pi.hang_at = {0}
    radars = ScriptedRadars(RadarState.ARMED)
    calls = []

    def progress(p) -> None:
        calls.append(p.state)
        if p.state == "running" and (p.row, p.take) == (0, 1):
            radars._script = (RadarState.FAULT, RadarState.ARMED)
            radars.armed = radars.armed[:1]
        if p.phase == "retake":
            rig.pi.hang_at = set()

    result = run_scan(rig.instrument, tmp_path / "s", radars=radars, progress=progress)
    assert (result.exit_status, result.retakes) == ("success", 1)
    assert "aborting" in calls
    assert any("RF core fault 7" in r for r in list_rejection_reasons(result.folder))


def test_radar_that_missed_a_pulse_has_its_row_taken_again(rig, tmp_path):
    """This holds for the transmitter too, whose data is not recorded."""
    radars = ScriptedRadars(RadarState.ARMED)
    radars.waiting = {2: ["LS"]}
    result = run_scan(rig.instrument, tmp_path / "s", radars=radars)
    assert (result.exit_status, result.retakes) == ("success", 1)
    (fact,) = load_facts(result.folder, "row_rejected")
    assert (fact["row"], fact["faults"]) == (1, [{"kind": "radar_waits", "board": "LS"}])


def test_board_that_sends_nothing_ends_the_row_before_its_end(rig, tmp_path):
    """Bursts are sent and a board sends nothing: the row, which would never end here, is aborted and retaken."""
    rig.cards["RH"].silent_data = True
    rig.pi.hang_at = {0}
    rig.pi.hang_after_captures = True
    limits = msgspec.structs.replace(rig.instrument.limits, row_retakes=1)

    def progress(p) -> None:
        if p.phase == "retake":
            rig.pi.hang_at = set()
            rig.cards["RH"].silent_data = False

    result = run_scan(msgspec.structs.replace(rig.instrument, limits=limits), tmp_path / "s", progress=progress)
    assert (result.exit_status, result.retakes) == ("success", 1)
    faults = load_facts(result.folder, "row_rejected")[0]["faults"]
    # The first fault is the reason of the abort, which is not that of a single board.
    assert faults[0] == {"kind": "no_data"}
    assert {"kind": "no_data", "board": "RH"} in faults


def test_without_data_after_all_retakes_the_error_names_the_radars_line_server(rig, server, tmp_path):
    rig.cards["RH"].silent_data = True
    radar = Radar("line_server", dict.fromkeys((b.name for b in rig.instrument.boards), server.address))
    with expect_refusal(ErrorCode.ROW_INCOMPLETE, "RH", server.address):
        run_scan(msgspec.structs.replace(rig.instrument, radar=radar), tmp_path / "s")
    lines = [server.accept().recv(1000) for _ in rig.instrument.boards]
    assert lines == [RETRIGGER_LINE * 3] * 3
    rejected = list_rejection_reasons(ScanFolder.load(tmp_path / "s"))
    assert any("may not have obeyed" in r for r in rejected)
