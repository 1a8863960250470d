"""A scan with a fake Pi and fake cards: every way in which a row or a scan can end."""

import hashlib
import socket
import subprocess
import sys
import threading
import time

import msgspec
import numpy as np
import pytest
from tests.support.acquisition.fake_cards import FULL, FakeCard, make_payload
from tests.support.acquisition.fake_rig import FakeRig
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts
from tests.support.store.plain_scan import list_errors

from polysight.acquisition import capture_rig
from polysight.acquisition.capture_rig import CaptureRig
from polysight.acquisition.control import StopRequest
from polysight.acquisition.scan import find_last_takes, resume_scan, run_scan
from polysight.capture import card
from polysight.capture.dca1000 import Code
from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.config import Board
from polysight_shared.errors import ErrorCode, ScanError
from polysight_shared.faults import PiFault
from polysight_shared.messages import Capture, RunStarted, RunStopped

# Takes of a row with the default limit of two retakes.
ALL_TAKES = (1, 2, 3)


def compute_digests(scan: ScanFolder) -> dict[str, str]:
    """Return the digest of each committed payload by its file."""
    digests = {}
    for row in scan.committed_rows().values():
        for board in row.boards.values():
            digests[board.file] = hashlib.sha256((scan.path / board.file).read_bytes()).hexdigest()
    return digests


def test_a_scan_without_faults_is_bit_exact_and_valid(rig, payload, tmp_path):
    rows = []
    calls = []
    result = run_scan(rig.instrument, tmp_path / "s", on_row=rows.append, progress=calls.append)
    assert (result.exit_status, result.processing_error) == ("success", None)
    assert rows == [0, 1, 2, 3]
    scan = ScanFolder.load(tmp_path / "s")
    assert scan.complete
    assert scan.simulated
    for row in scan.rows():
        for board in ("RH", "RV"):
            data = scan.read_row(board, row)
            assert data.payload.tobytes() == payload(board, row, rig.instrument.row_bytes)
            assert data.missing == []
            assert data.mask is None
    assert validate(tmp_path / "s") == []
    events = read_events(tmp_path / "s" / "events.msgpack").events
    assert [e.seq for e in events] == list(range(1, len(events) + 1))
    assert isinstance(events[0], RunStarted)
    assert isinstance(events[-1], RunStopped)
    assert sum(isinstance(e, Capture) for e in events) == rig.instrument.grid.columns * rig.instrument.grid.rows
    assert {p.phase for p in calls} >= {"connect", "home", "row", "committed", "end"}
    assert calls[-1].committed == 4


def test_lost_events_are_fetched_from_the_journal(rig, tmp_path):
    lost_events = 7
    rig.pi.lose_events = lost_events
    assert run_scan(rig.instrument, tmp_path / "s").exit_status == "success"
    assert list_errors(tmp_path / "s") == []
    ended = load_facts(tmp_path / "s", "scan_ended")[0]
    # Events that come after a gap are fetched again, too.
    assert ended["events_refetched"] >= lost_events


def test_a_row_whose_reply_was_lost_runs_once(rig, tmp_path):
    has_lost_replies = False

    def progress(p):
        nonlocal has_lost_replies
        if p.phase == "row" and p.row == 1 and not has_lost_replies:
            has_lost_replies = True
            rig.pi.lose_replies = 2

    assert run_scan(rig.instrument, tmp_path / "s", progress=progress).exit_status == "success"
    assert rig.pi.rows_run == [(0, 1), (1, 1), (2, 1), (3, 1)]


# Numbers of the packets of a row: 0 to 25.
@pytest.mark.parametrize("dropped", [{0}, {5}, {25}, {0, 1, 25}])
def test_a_row_with_lost_packets_is_retaken(rig, payload, tmp_path, dropped):
    row = 1
    first_take = 1
    rig.cards["RV"].drop[row, first_take] = dropped
    messages = []

    def record_messages_of_rows(p) -> None:
        if p.phase == "row" and p.message:
            messages.append(p.message)

    result = run_scan(rig.instrument, tmp_path / "s", progress=record_messages_of_rows)
    assert messages == ["row 0", "row 1", "row 1, take 2", "row 2", "row 3"]
    assert (result.exit_status, result.retakes) == ("success", 1)
    scan = ScanFolder.load(tmp_path / "s")
    assert scan.committed_rows()[row].take == first_take + 1
    assert scan.read_row("RV", row).payload.tobytes() == payload("RV", row, rig.instrument.row_bytes)
    (rejected,) = load_facts(scan, "row_rejected")
    assert rejected["row"] == row
    assert rejected["take"] == first_take
    assert "RV" in rejected["reasons"][0]
    assert list_errors(tmp_path / "s") == []


def test_retakes_are_bounded_and_the_error_names_the_board(rig, tmp_path):
    row = 1
    for take in ALL_TAKES:
        rig.cards["RV"].drop[row, take] = {3}
    with expect_refusal(ErrorCode.ROW_INCOMPLETE, "RV", f"{len(ALL_TAKES)} takes"):
        run_scan(rig.instrument, tmp_path / "s")
    scan = ScanFolder.load(tmp_path / "s")
    assert list(scan.committed_rows()) == [0]
    assert load_facts(scan, "scan_ended")[0]["exit_status"] == "fail"
    assert rig.pi.journal[scan.scan_id][-1].exit_status == "fail"
    result = resume_scan(tmp_path / "s")
    assert result.exit_status == "success"
    # The resumed scan counts on from the takes before.
    assert ScanFolder.load(tmp_path / "s").committed_rows()[row].take == len(ALL_TAKES) + 1
    assert list_errors(tmp_path / "s") == []


def test_keep_incomplete_masks_exactly_what_was_lost(rig, payload, tmp_path):
    row = 1
    for take in ALL_TAKES:
        rig.cards["RV"].drop[row, take] = {3, 4, 9}
    result = run_scan(rig.instrument, tmp_path / "s", keep_incomplete=True)
    assert result.exit_status == "success"
    assert result.incomplete_rows == [row]
    assert load_facts(result.folder, "row_committed")[row]["faults"] == [{"kind": "lost_on_the_way", "board": "RV"}]
    data = ScanFolder.load(tmp_path / "s").read_row("RV", row)
    assert data.missing == [(3 * FULL, 5 * FULL), (9 * FULL, 10 * FULL)]
    truth = np.frombuffer(payload("RV", 1, rig.instrument.row_bytes), dtype=np.uint8)
    assert data.mask is not None
    assert np.array_equal(data.payload[~data.mask], truth[~data.mask])
    assert not data.payload[data.mask].any()
    assert list_errors(tmp_path / "s") == []


def test_an_incomplete_row_with_a_frame_too_few_is_masked_as_a_whole(rig, tmp_path):
    row = 1
    for take in ALL_TAKES:
        rig.cards["RH"].missing_end_bytes[row, take] = rig.instrument.frame_bytes
    run_scan(rig.instrument, tmp_path / "s", keep_incomplete=True)
    scan = ScanFolder.load(tmp_path / "s")
    assert scan.read_row("RH", row).missing == [(0, rig.instrument.row_bytes)]
    assert scan.committed_rows()[row].boards["RH"].frames_received == 0


def test_a_scan_that_was_stopped_after_a_row_resumes_and_keeps_its_rows(rig, payload, tmp_path):
    stop = StopRequest()

    def progress(p):
        if p.phase == "row" and p.row == 1 and not stop.after_row:
            stop.request()

    result = run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=progress)
    assert result.exit_status == "abort"
    assert list(result.folder.committed_rows()) == [0, 1]
    digests_before = compute_digests(result.folder)
    # A killed program may leave half of a row and half of a line.
    (tmp_path / "s" / "raw" / "RH" / "0002.part").write_bytes(b"half a row")
    with (tmp_path / "s" / "manifest.jsonl").open("ab") as f:
        f.write(b'{"fact": "row_comm')
    rows: list[int] = []
    result = resume_scan(tmp_path / "s", on_row=rows.append)
    assert result.exit_status == "success"
    assert rows == [0, 1, 2, 3]
    digests_after = compute_digests(result.folder)
    assert digests_after.items() >= digests_before.items()
    assert result.folder.read_row("RV", 3).payload.tobytes() == payload("RV", 3, rig.instrument.row_bytes)
    assert list_errors(tmp_path / "s") == []
    assert set(find_last_takes(result.folder)) == {0, 1, 2, 3}


def test_a_scan_whose_host_was_killed_resumes_and_keeps_its_rows(rig, config, payload, tmp_path):
    """The host is killed in row 2. The Pi finishes that row, and its report must not end the new take of the row."""
    code = (
        "import sys\nfrom pathlib import Path\nfrom polysight_shared.config import load_instrument\n"
        "from polysight.acquisition.scan import run_scan\n"
        "run_scan(load_instrument(Path(sys.argv[1])), Path(sys.argv[2]))"
    )
    rig.pi.hang_at = {2}
    with subprocess.Popen([sys.executable, "-c", code, str(config), str(tmp_path / "s")]) as host:
        wait_for(lambda: rig.pi.hanging is not None, "row 2")
        host.kill()
    rig.pi.hang_at = set()
    rig.pi.end_hanging_row = True
    wait_for(lambda: rig.pi.hanging is None, "the end of row 2")
    scan = ScanFolder.load(tmp_path / "s")
    digests_before = compute_digests(scan)
    assert list(scan.rows()) == [0, 1]
    assert list_errors(tmp_path / "s") == []
    result = resume_scan(tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 0)
    assert compute_digests(result.folder).items() >= digests_before.items()
    assert [r.take for r in result.folder.committed_rows().values()] == [1, 1, 2, 1]
    assert result.folder.read_row("RH", 2).payload.tobytes() == payload("RH", 2, rig.instrument.row_bytes)
    assert validate(tmp_path / "s") == []


def test_processing_error_does_not_stop_the_scan(rig, tmp_path):
    def on_row(row: int) -> None:
        if row == 1:
            raise ScanError("cannot process")

    result = run_scan(rig.instrument, tmp_path / "s", on_row=on_row)
    assert result.exit_status == "success"
    assert isinstance(result.processing_error, ScanError)


def test_without_a_pi_the_error_has_its_port_and_the_command_that_starts_it(make_instrument, tmp_path):
    instrument = make_instrument(command_timeout_s=0.3)
    with expect_refusal(ErrorCode.NO_ANSWER, 5601, "polysight-pi run"):
        run_scan(instrument, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_the_error_of_a_card_that_does_not_reply_names_it(rig, tmp_path):
    rig.cards["RV"].mute = True
    with expect_refusal(ErrorCode.NO_ANSWER, "RV", rig.instrument.by_name("RV").card_address):
        run_scan(rig.instrument, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_the_error_of_a_radar_without_data_is_not_that_of_a_silent_card(rig, tmp_path):
    rig.cards["RH"].silent_data = True
    with expect_refusal(ErrorCode.ROW_INCOMPLETE, "RH", "SYNC_IN", "armed"):
        run_scan(rig.instrument, tmp_path / "s")


def test_the_error_of_a_port_in_use_has_its_address(rig, tmp_path):
    board = rig.instrument.by_name("RV")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_socket:
        other_socket.bind((board.host_address, board.data_port))
        with expect_refusal(ErrorCode.BUSY, f"{board.host_address}:{board.data_port}", "ss -ulnp"):
            run_scan(rig.instrument, tmp_path / "s")


def test_a_receive_buffer_below_two_bursts_ends_the_scan_before_it_begins(rig, tmp_path):
    card = msgspec.structs.replace(rig.instrument.card, receive_buffer_bytes=4096)
    with expect_refusal(ErrorCode.VALUE_INVALID, "sysctl -w net.core.rmem_max="):
        run_scan(msgspec.structs.replace(rig.instrument, card=card), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_frames_below_a_packet_end_the_scan_before_it_begins(rig, tmp_path):
    """If a packet has several frames, the times of all but one are unknown."""
    chirp = msgspec.structs.replace(rig.instrument.chirp, samples=64, linear_samples=(0, 64))
    with expect_refusal(ErrorCode.VALUE_INVALID, "1024 bytes", "more samples"):
        run_scan(msgspec.structs.replace(rig.instrument, chirp=chirp), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_existing_scan_is_not_overwritten(rig, tmp_path):
    run_scan(rig.instrument, tmp_path / "s")
    digests_before = compute_digests(ScanFolder.load(tmp_path / "s"))
    with expect_refusal(ErrorCode.FILE_EXISTS, "manifest"):
        run_scan(rig.instrument, tmp_path / "s")
    assert compute_digests(ScanFolder.load(tmp_path / "s")) == digests_before


# Time from the last data to the short last packet; a real card takes 2 s.
TAIL_S = 0.6
CONFIGURE = int(Code.CONFIGURE_FPGA)


class LateCard(FakeCard):
    """A card that keeps a row's last short packet for a while, as the real one does, or until the record's stop.

    Sends full packets immediately; the rest and the status `TAIL_S` later, or `lag_s` after the reply to a stop.
    """

    def __init__(self, board: Board, row_bytes: int, lag_s: float) -> None:
        self._lag_s = lag_s
        # Number of the record, and with the same number the bytes of its short last packet until they are sent.
        self._record = 0
        self._tail: tuple[int, bytes] | None = None
        self._lock = threading.Lock()
        # By row and take: number of the row's bytes that the card gets.
        self.cut: dict[tuple[int, int], int] = {}
        super().__init__(board, row_bytes)

    def send_row(self, row: int, take: int) -> None:
        if not self.recording:
            return
        data = make_payload(self.board.name, row, self.row_bytes)[: self.cut.get((row, take), self.row_bytes)]
        whole_packets = len(data) // FULL * FULL
        for a in range(0, whole_packets, FULL):
            self._rest = data[a : a + FULL]
            self._send_packet(FULL)
        self._tail = self._record, data[whole_packets:]
        threading.Timer(TAIL_S, self._finish, [self._record]).start()

    def _finish(self, record: int) -> None:
        with self._lock:
            if self._tail is None or self._tail[0] != record:
                return
            self._rest = self._tail[1]
            self._tail = None
            self.recording = False
            self.end_frames()

    def _command(self, code: int, sender: tuple[str, int]) -> None:
        recorded = self.recording
        self._record += code == Code.RECORD_START
        super()._command(code, sender)
        if code == Code.RECORD_STOP and recorded:
            time.sleep(self._lag_s)
            self._finish(self._record)


@pytest.mark.parametrize("lag_ms", [0, 5, 30])
def test_the_retake_of_a_row_that_ended_early_is_complete(make_instrument, payload, tmp_path, monkeypatch, lag_ms):
    """The Pi reports a fault in row 1. The last packet and the status arrive some ms after the reply to the stop."""
    # The lag is well within the time for which the scan waits (200 ms).
    assert lag_ms < 1000 * capture_rig._COMPLETED_TIMEOUT_S / 2
    monkeypatch.setattr(capture_rig, "_COMPLETED_TIMEOUT_S", HANG_S)
    rig = FakeRig(make_instrument(rows=2, end_of_record_s=HANG_S))
    for board in rig.instrument.recorded:
        card = LateCard(board, rig.instrument.row_bytes, lag_ms / 1e3)
        card.cut[1, 1] = 4 * FULL + 100
        rig.cards[board.name] = card
    rig.start_pi()
    rig.pi.fail_rows[1, 1] = int(PiFault.EDGE_LOST)
    try:
        result = run_scan(rig.instrument, tmp_path / "s")
    finally:
        rig.close()
    assert (result.exit_status, result.retakes) == ("success", 1)
    (rejected,) = load_facts(result.folder, "row_rejected")
    assert rejected["row"] == 1
    assert rejected["take"] == 1
    assert result.folder.read_row("RV", 1).payload.tobytes() == payload("RV", 1, rig.instrument.row_bytes)
    assert validate(tmp_path / "s") == []


def test_a_card_that_sent_nothing_is_configured_again_before_the_retake(rig, tmp_path):
    """The card lost power for a moment: it replies again, but its configuration is lost."""
    card = rig.cards["RH"]

    def mute_until_set_up_again(p) -> None:
        if p.phase == "state" and p.state == "running" and p.row == 1:
            card.silent_data = card.codes_received.count(CONFIGURE) == 2

    result = run_scan(rig.instrument, tmp_path / "s", progress=mute_until_set_up_again)
    assert (result.exit_status, result.retakes) == ("success", 1)
    # Configured twice at the start, and RH twice more.
    assert card.codes_received.count(CONFIGURE) == 4
    assert rig.cards["RV"].codes_received.count(CONFIGURE) == 2


def test_a_scan_is_not_resumed_with_the_cards_of_two_boards_exchanged(rig, tmp_path, monkeypatch):
    """Packets do not identify their card, so the manifest has the MAC address of each row's card, from the kernel."""
    macs = {rig.cards[name].board.card_address: f"12:34:56:78:90:{name}" for name in ("RH", "RV")}
    monkeypatch.setattr(card, "neighbour_mac", macs.get)
    stop = StopRequest()
    run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: stop.request(), stop=stop)
    row = load_facts(tmp_path / "s", "row_committed")[0]
    assert {name: board["card_mac"] for name, board in row["boards"].items()} == {
        "RH": "12:34:56:78:90:RH",
        "RV": "12:34:56:78:90:RV",
    }
    addresses = list(macs)
    macs.update(zip(addresses, [macs[address] for address in reversed(addresses)], strict=True))
    with expect_refusal(ErrorCode.MISMATCH, "RH", "RV", "12:34:56:78:90:RV"):
        resume_scan(tmp_path / "s")
    macs.update(zip(addresses, ["12:34:56:78:90:RH", "12:34:56:78:90:new"], strict=True))
    assert resume_scan(tmp_path / "s").exit_status == "success"


@pytest.mark.parametrize(("limit_s", "is_warned"), [(0.25, True), (3.0, False)])
def test_a_time_limit_below_that_of_the_card_is_a_warning(make_instrument, limit_s, is_warned):
    """A card sends the short last packet of a record 2 s after its last data."""
    with CaptureRig(make_instrument(end_of_record_s=limit_s)) as rig:
        assert any("end_of_record_s" in w for w in rig.warnings) == is_warned
