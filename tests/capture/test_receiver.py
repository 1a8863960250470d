"""The receiver process over real sockets: bit-exact rows, masked losses, clear errors, a clean end."""

import math
import os
import signal
import socket
import subprocess
import sys
import time
import zlib
from contextlib import closing
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

import numpy as np
import pytest
from tests.support.capture.records import FULL, HEADER_BYTES, encode_packets
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal

from polysight.acquisition.capture_rig import has_record_ended
from polysight.acquisition.control import read_start_ticks
from polysight.capture import network, receiver_process
from polysight.capture.dca1000 import Status
from polysight.capture.network import BatchReceiver, bind_udp, enlarge_receive_buffer, usable_packets
from polysight.capture.receiver import BeginRow, EndRow, Open, Progress, ReceiverProcess, Report, RowCapture
from polysight.capture.row_files import read_index
from polysight_shared.config import Board
from polysight_shared.errors import DeviceError, ErrorCode

# Bytes of a frame
FRAME = 4096


@pytest.fixture
def card(board):
    """A socket that sends from the address and port of the board's card."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((board.card_address, 1024))
        yield sender


def draw_noise(size: int, seed: int) -> bytes:
    return np.random.default_rng(seed).integers(0, 256, size, dtype=np.uint8).tobytes()


def send(card: socket.socket, board: Board, packets: list[bytes]) -> None:
    """Send packets that fit in the receive buffer even if the receiver does not run meanwhile."""
    assert len(packets) <= usable_packets(1 << 20)
    for packet in packets:
        card.sendto(packet, (board.host_address, board.data_port))


def begin_row(
    receiver: ReceiverProcess,
    path: Path,
    expected_bytes: int,
    frame_bytes: int = FRAME,
    row: int = 0,
    take: int = 1,
    after_reset: bool = True,
) -> int:
    """Begin a row of this size; return the number of packets from before it that the receiver has dropped.

    `after_reset`: the card's counters begin at zero again.
    """
    return receiver.begin_row(row, take, expected_bytes, frame_bytes, path, after_reset=after_reset)


def make_open(board: Board) -> Open:
    """Return the request to open the data socket of a board, with a receive buffer that a kernel grants to anyone."""
    return Open(
        board=board.name,
        host_address=board.host_address,
        data_port=board.data_port,
        card_address=board.card_address,
        buffer_bytes=212_992,
    )


def make_begin_row(path: Path, expected_bytes: int) -> BeginRow:
    """Return the request to receive row 0 with frames as long as a packet."""
    return BeginRow(row=0, take=1, expected_bytes=expected_bytes, frame_bytes=FULL, path=str(path), after_reset=True)


def test_rows_are_bit_exact_and_counters_continue(board, card, tmp_path):
    size = 300 * FRAME
    first = draw_noise(size, seed=1)
    second = draw_noise(size, seed=2)
    third = draw_noise(size, seed=3)
    packets_of_row = math.ceil(size / FULL)
    disturbed_row = 1
    with ReceiverProcess(board, 4 << 20) as receiver:
        assert receiver.granted_bytes >= 1 << 20
        for k, data in enumerate((first, second, third)):
            path = tmp_path / f"{k}.part"
            stale_packets = begin_row(receiver, path, size, row=k, after_reset=k == 0)
            assert stale_packets == 0
            # The card's counters continue from row to row.
            packets = encode_packets(data, sequence=1 + k * packets_of_row, byte_count=k * size)
            if k == disturbed_row:
                # The first two packets are lost, two are exchanged, one of them comes twice, and one is too short.
                packets = [*packets[2:50], packets[51], packets[50], packets[51], *packets[52:]]
                send(card, board, [*packets, b"tiny"])
                wait_for(lambda: receiver.report().received == size - 2 * FULL, "packets")
            else:
                send(card, board, packets)
                wait_for(lambda: receiver.poll().complete, "packets")
            row = receiver.end_row()
            assert (row.row, row.take, row.expected) == (k, 1, size)
            assert row.located
            assert row.crc32 == zlib.crc32(path.read_bytes())
            assert row.kernel_drops == 0
            facts, arrivals = read_index(path.with_suffix(".idx"))
            times_ns = arrivals[:, 0].tolist()
            assert row.index_crc32 == zlib.crc32(path.with_suffix(".idx").read_bytes())
            assert (np.diff(arrivals, axis=0) >= 0).all()
            assert times_ns[0] == row.first_arrival_ns
            assert times_ns[-1] == row.last_arrival_ns
            counts = row.counts
            if k == disturbed_row:
                assert row.missing == [(0, 2 * FULL)]
                assert facts["missing"] == [[0, 2 * FULL]]
                assert (counts.late, counts.duplicates, counts.malformed) == (1, 1, 1)
                assert path.read_bytes() == bytes(2 * FULL) + data[2 * FULL :]
            else:
                assert row.complete
                assert (counts.late, counts.duplicates) == (0, 0)
                assert counts.placed == packets_of_row
                # Only the last packet is not full.
                assert counts.short == 1
                assert path.read_bytes() == data


@pytest.mark.parametrize("source_port", [1024, 4098, 0])
def test_packets_of_the_card_are_data_from_any_source_port(board, tmp_path, source_port):
    data = draw_noise(20_000, seed=4)
    with (
        ReceiverProcess(board, 1 << 20) as receiver,
        closing(bind_udp(board.card_address, source_port, "card")) as card,
    ):
        begin_row(receiver, tmp_path / "a.part", len(data), frame_bytes=1)
        send(card, board, encode_packets(data, sequence=1, byte_count=0))
        wait_for(lambda: receiver.poll().complete, "packets")
        row = receiver.end_row()
    assert row.complete
    assert row.strangers == 0
    assert (tmp_path / "a.part").read_bytes() == data


def test_packets_of_other_machines_and_from_before_the_row_are_not_data(board, card, tmp_path):
    data = draw_noise(20_000, seed=4)
    packets_from_before = encode_packets(draw_noise(5000, seed=5), sequence=1, byte_count=0)
    assert len(packets_from_before) == 4
    packet_of_stranger = encode_packets(draw_noise(5000, seed=6), sequence=1, byte_count=0)[0]
    any_port = 0
    with (
        ReceiverProcess(board, 1 << 20) as receiver,
        closing(bind_udp(board.host_address, any_port, "stranger")) as stranger,
    ):
        send(card, board, packets_from_before)
        wait_for(lambda: _count_waiting_bytes(board) > 0, "packets")
        assert begin_row(receiver, tmp_path / "a.part", len(data), frame_bytes=1) == 4
        stranger.sendto(packet_of_stranger, (board.host_address, board.data_port))
        send(card, board, encode_packets(data, sequence=1, byte_count=0))
        wait_for(lambda: receiver.poll().complete, "packets")
        row = receiver.end_row()
    assert row.complete
    assert row.strangers == 1
    assert row.stale == 4
    assert (tmp_path / "a.part").read_bytes() == data


def test_between_rows_the_progress_is_that_of_no_row():
    receiver = receiver_process.Receiver(Connection(os.open(os.devnull, os.O_RDWR)))
    answer = receiver._answer(Report())
    assert answer == Progress(row=-1, take=0, received=0, complete=False, last_arrival_ns=0)
    receiver._connection.close()


@pytest.mark.parametrize("last_bytes", [FULL, 100])
def test_a_row_is_reported_as_complete_without_a_request(board, card, tmp_path, monkeypatch, last_bytes):
    """This also holds if the last packet is full, so that its size does not show that it is the last one."""
    for name in ("take_core", "take_priority"):
        monkeypatch.setattr(receiver_process, name, lambda *_, **__: (None, ""))
    data = draw_noise(3 * FULL + last_bytes, seed=8)
    host, process = Pipe()
    receiver = receiver_process.Receiver(process)
    receiver._answer(make_open(board))
    receiver._answer(make_begin_row(tmp_path / "a.part", len(data)))
    *first_packets, last_packet = encode_packets(data, sequence=1, byte_count=0)
    send(card, board, first_packets)
    receiver._receive()
    assert not host.poll()
    send(card, board, [last_packet])
    receiver._receive()
    assert host.poll()
    receiver._discard()
    assert receiver._socket is not None
    receiver._socket.close()
    host.close()
    process.close()


@pytest.mark.parametrize("clock_set_s", [0, 3600])
def test_a_row_ends_with_all_that_came_before(board, card, tmp_path, monkeypatch, clock_set_s):
    """The first packets are of another machine, the receiver reads one batch at a time, and the clock may be set.

    The packets fit into the buffer that a kernel grants to anyone (208 KiB requested, twice that granted).
    """
    packets_of_stranger = 270
    for name in ("take_core", "take_priority"):
        monkeypatch.setattr(receiver_process, name, lambda *_, **__: (None, ""))
    monkeypatch.setattr(receiver_process, "_MAX_BATCHES", 1)
    data = draw_noise(40 * FULL, seed=7)
    receiver = receiver_process.Receiver(Connection(os.open(os.devnull, os.O_RDWR)))
    receiver._answer(make_open(board))
    receiver._answer(make_begin_row(tmp_path / "a.part", len(data)))
    any_port = 0
    with closing(bind_udp(board.host_address, any_port, "stranger")) as stranger:
        for _ in range(packets_of_stranger):
            stranger.sendto(b"x" * 100, (board.host_address, board.data_port))
    send(card, board, encode_packets(data, sequence=1, byte_count=0))
    assert receiver._batches is not None
    receiver._batches._clocks_differ_ns -= clock_set_s * 10**9
    row = receiver._answer(EndRow())
    assert receiver._socket is not None
    receiver._socket.close()
    assert isinstance(row, RowCapture)
    assert row.complete
    assert row.strangers == packets_of_stranger
    assert row.kernel_drops == 0


def _count_waiting_bytes(board: Board) -> int:
    """Return the number of bytes that wait in the kernel for the data port, from /proc/net/udp.

    After its number a line has the local address, the remote one, the state, and the bytes to send and to receive. All
    numbers are hexadecimal; an IP address has its last byte first.
    """
    address = socket.inet_aton(board.host_address)[::-1].hex().upper()
    local_address_of_board = f"{address}:{board.data_port:04X}"
    _, *lines = Path("/proc/net/udp").read_text().splitlines()
    for line in lines:
        _, local_address, _, _, queues, *_ = line.split()
        if local_address == local_address_of_board:
            _, bytes_to_receive = queues.split(":")
            return int(bytes_to_receive, 16)
    return 0


def test_a_new_row_discards_the_one_before_and_may_be_empty(board, tmp_path):
    with ReceiverProcess(board, 1 << 20) as receiver:
        begin_row(receiver, tmp_path / "a.part", FRAME, take=1, after_reset=False)
        # The process has not reported anything of the row yet.
        assert not receiver._progress.complete
        begin_row(receiver, tmp_path / "b.part", FRAME, take=2, after_reset=False)
        assert not (tmp_path / "a.part").exists()
        row = receiver.end_row()
    assert row.counts.placed == 0
    assert row.missing == [(0, FRAME)]
    assert row.first_arrival_ns == 0


def test_errors_of_the_receiver_process_are_raised_in_the_host(board, tmp_path):
    with ReceiverProcess(board, 1 << 20) as receiver:
        with expect_refusal(ErrorCode.BUSY, f"{board.host_address}:{board.data_port}"):
            ReceiverProcess(board, 1 << 20)
        (tmp_path / "file").write_text("")
        with expect_refusal(ErrorCode.FILE_UNWRITABLE):
            begin_row(receiver, tmp_path / "file" / "a.part", FRAME, after_reset=False)
        with pytest.raises(DeviceError):
            receiver.end_row()
        os.kill(receiver._process.pid, signal.SIGKILL)
        with expect_refusal(ErrorCode.NO_ANSWER):
            receiver.report()
        with pytest.raises(DeviceError):
            receiver.report()


def test_a_receiver_ignores_ctrl_c_and_ends_with_its_host(board):
    receiver = ReceiverProcess(board, 1 << 20)
    os.kill(receiver._process.pid, signal.SIGINT)
    assert receiver.report().received == 0
    pid = receiver._process.pid
    receiver.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_receiver_ends_when_its_host_is_killed(board, tmp_path):
    # A host with a receiver; it prints the receiver's process id.
    code = (
        "import time\nfrom polysight_shared.config import Board\n"
        "from polysight.capture.receiver import ReceiverProcess\n"
        f"r = ReceiverProcess(Board('RH', 'receive_h', '{board.card_address}', '{board.host_address}', 1, "
        f"{board.data_port}, ()), 1 << 20)\n"
        f"from pathlib import Path\nr.begin_row(0, 1, 4096, 4096, Path({str(tmp_path / 'a.part')!r}))\n"
        "print(r._process.pid, flush=True)\ntime.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as host:
        assert host.stdout is not None
        pid = int(host.stdout.readline())
        host.kill()
    wait_for(lambda: read_start_ticks(pid) is None, "the receiver's end")
    with closing(bind_udp(board.host_address, board.data_port, "free again")):
        pass


def test_packets_dropped_by_the_kernel_count_only_for_their_board(board, card, tmp_path):
    """Two receivers, one of which is stopped while packets come: only its row counts drops."""
    other_board = Board(
        name="RV",
        role="receive_v",
        card_address=board.card_address,
        host_address=board.host_address,
        command_port=4202,
        data_port=4203,
        mount=(),
    )
    # The buffer of 64 KiB holds some of the packets, and not all.
    buffer_bytes = 1 << 16
    packets_of_row = 2000
    packets_to_other = 20
    row_bytes = packets_of_row * FULL
    with (
        ReceiverProcess(board, buffer_bytes) as stopped_receiver,
        ReceiverProcess(other_board, buffer_bytes) as other_receiver,
    ):
        for receiver in (stopped_receiver, other_receiver):
            begin_row(receiver, tmp_path / f"{receiver.board.name}.part", row_bytes, frame_bytes=FULL)
        os.kill(stopped_receiver.pid, signal.SIGSTOP)
        packets = encode_packets(draw_noise(row_bytes, seed=3), sequence=1, byte_count=0)
        for packet in packets:
            card.sendto(packet, (board.host_address, board.data_port))
        for packet in packets[:packets_to_other]:
            card.sendto(packet, (other_board.host_address, other_board.data_port))
        os.kill(stopped_receiver.pid, signal.SIGCONT)
        wait_for(lambda: other_receiver.report().received == packets_to_other * FULL, "packets")
        row_with_drops = stopped_receiver.end_row()
        assert row_with_drops.kernel_drops > 0
        assert row_with_drops.kernel_drops == packets_of_row - row_with_drops.counts.placed
        assert row_with_drops.losses.tail_bytes == row_bytes - row_with_drops.bytes
        assert other_receiver.end_row().kernel_drops == 0
        # The next row begins to count at zero.
        begin_row(stopped_receiver, tmp_path / "next.part", FRAME, row=1, after_reset=False)
        assert stopped_receiver.end_row().kernel_drops == 0


def test_data_dropped_by_the_card_masks_the_row(board, card, tmp_path):
    data = draw_noise(20_000, seed=4)
    with ReceiverProcess(board, 1 << 20) as receiver:
        begin_row(receiver, tmp_path / "a.part", len(data), frame_bytes=1000)
        send(card, board, encode_packets(data, sequence=1, byte_count=0))
        wait_for(lambda: receiver.poll().complete, "packets")
        row = receiver.end_row(Status.LVDS_BUFFER_FULL | Status.RECORD_COMPLETED)
    assert row.lost_before_packets == Status.LVDS_BUFFER_FULL
    assert not row.complete
    assert row.missing == [(0, len(data))]
    assert "dropped data before numbering it (LVDS_BUFFER_FULL)" in row.reason
    assert read_index(tmp_path / "a.idx")[0]["card_status"] == row.card_status


def test_the_short_last_packet_is_reported_immediately(board, card, tmp_path):
    """Frames were missed: the byte count is not reached, and the card's short last packet shows the end."""
    with ReceiverProcess(board, 1 << 20) as receiver:
        begin_row(receiver, tmp_path / "a.part", 10 * FRAME)
        send(card, board, encode_packets(draw_noise(9 * FRAME, seed=4), sequence=1, byte_count=0))
        wait_for(lambda: receiver.poll().ended, "packets")
        assert not receiver.poll().complete
        row = receiver.end_row()
    assert not row.located
    assert "1 frames early" in row.reason


COMPLETE = Progress(row=0, take=1, received=9, complete=True, last_arrival_ns=1)
INCOMPLETE = Progress(row=0, take=1, received=9, complete=False, last_arrival_ns=1)
# A packet came 0.2 s after the end of the row, which is at 1 s.
LATE_PACKET = Progress(row=0, take=1, received=9, complete=False, last_arrival_ns=1_200_000_000)
SHORT_LAST_PACKET = Progress(row=0, take=1, received=9, complete=False, last_arrival_ns=1, ended=True)
NO_PACKET = Progress(row=0, take=1, received=0, complete=False, last_arrival_ns=0)
NO_STATUS = Status(0)


@pytest.mark.parametrize(
    ("progress", "status", "now_s", "ended"),
    [
        # The row ended at 1 s. Its record has ended when it is complete; after a silence of 0.2 s (`GRACE_NS`) if the
        # card has reported the end, by its status or a short last packet; or after 3 s of silence.
        (COMPLETE, NO_STATUS, 1.0, True),
        (INCOMPLETE, Status.RECORD_COMPLETED, 1.1, False),
        (INCOMPLETE, Status.RECORD_COMPLETED, 1.3, True),
        (LATE_PACKET, Status.RECORD_COMPLETED, 1.3, False),
        (SHORT_LAST_PACKET, NO_STATUS, 1.1, False),
        (SHORT_LAST_PACKET, NO_STATUS, 1.3, True),
        (INCOMPLETE, Status.NO_LVDS_DATA, 3.9, False),
        (INCOMPLETE, NO_STATUS, 4.1, True),
        (NO_PACKET, NO_STATUS, 4.1, True),
    ],
)
def test_a_record_ends_with_the_first_of_its_signs_or_its_time_limit(progress, status, now_s, ended):
    now_ns = int(now_s * 1e9)
    assert has_record_ended(progress, status, since_ns=10**9, now_ns=now_ns, silence_ns=3 * 10**9) == ended


class SuspendedClocks:
    """Two clocks in place of the module `time`; the kernel suspends the process before some of their readings."""

    def __init__(self, difference_ns: int, pauses_ns: list[int]) -> None:
        self._now_ns = 0
        self._difference_ns = difference_ns
        self._pauses_ns = pauses_ns

    def monotonic_ns(self) -> int:
        # A reading takes 100 ns.
        self._now_ns += 100
        if self._pauses_ns:
            self._now_ns += self._pauses_ns.pop(0)
        return self._now_ns

    def time_ns(self) -> int:
        return self.monotonic_ns() + self._difference_ns


@pytest.mark.parametrize("suspended_reading", range(3))
def test_a_pause_between_readings_of_two_clocks_does_not_change_their_difference(monkeypatch, suspended_reading):
    pauses_ns = [0, 0, 0]
    pauses_ns[suspended_reading] = 800_000
    monkeypatch.setattr(network, "time", SuspendedClocks(5_000_000_000, pauses_ns))
    assert network.measure_clock_difference() == 5_000_000_000


def test_of_readings_that_were_all_interrupted_the_closest_counts(monkeypatch):
    # Five attempts of three readings each, with a pause in the middle reading, which is that of the other clock. The
    # second attempt has the shortest pause. The other clock was read at the end of the pause and counts as read in its
    # middle, so that half of the pause is the error.
    pauses_of_attempts_ns = [800_000, 30_000, 500_000, 600_000, 700_000]
    pauses_ns = []
    for pause_ns in pauses_of_attempts_ns:
        pauses_ns += [0, pause_ns, 0]
    monkeypatch.setattr(network, "time", SuspendedClocks(5_000_000_000, pauses_ns))
    assert network.measure_clock_difference() == 5_000_000_000 + min(pauses_of_attempts_ns) // 2


def test_a_packet_has_the_time_of_its_arrival_and_not_that_of_the_read(board, card):
    with closing(bind_udp(board.host_address, board.data_port, "x")) as sock:
        receiver = BatchReceiver(sock, board.card_address)
        before_ns = time.monotonic_ns()
        card.sendto(b"0123456789abc", (board.host_address, board.data_port))
        sock.sendto(b"stranger", (board.host_address, board.data_port))
        between_ns = time.monotonic_ns()
        while time.monotonic_ns() < between_ns + 20_000_000:
            time.sleep(0.005)
        card.sendto(b"0123456789", (board.host_address, board.data_port))
        assert receiver.receive() == 2
        assert receiver.strangers == 1
        assert receiver.packets[0, :13].tobytes() == b"0123456789abc"
        assert receiver.lengths[:2].tolist() == [13, 10]
        first, second = receiver.times_ns[:2].tolist()
        # The kernel stamps with the wall clock, which may run at a slightly different rate: 1 ms is allowed.
        assert before_ns - 1_000_000 < first
        assert first < second <= time.monotonic_ns()
        assert receiver.receive() == 0


def test_a_receiver_is_drained_when_a_batch_is_not_full(board, card):
    """A read returns at most two packets.

    `sent`: packets sent before the read, `received`: packets that it returns, `is_drained`: none can wait any more.
    """
    with closing(bind_udp(board.host_address, board.data_port, "x")) as sock:
        receiver = BatchReceiver(sock, board.card_address, batch=2)
        for sent, received, is_drained in ((1, 1, True), (2, 2, False), (0, 0, True), (3, 2, False), (0, 1, True)):
            for _ in range(sent):
                card.sendto(b"0123456789a", (board.host_address, board.data_port))
            assert receiver.receive() == received
            assert receiver.is_drained == is_drained


def test_the_kernel_counts_the_packets_that_a_full_socket_drops(board, card):
    with closing(bind_udp(board.host_address, board.data_port, "x")) as sock:
        enlarge_receive_buffer(sock, 1 << 14)
        receiver = BatchReceiver(sock, board.card_address)
        assert network.count_kernel_drops(sock) == 0
        sent = 100
        for _ in range(sent):
            card.sendto(bytes(HEADER_BYTES + FULL), (board.host_address, board.data_port))
        received = receiver.receive()
        # The buffer of 16 KiB holds some of the packets, and not all.
        assert 0 < received < sent
        assert network.count_kernel_drops(sock) == sent - received


def test_packets_that_came_before_the_wall_clock_was_set_have_the_time_of_the_read(board, card, monkeypatch):
    """One millisecond is a jump that the clock itself does not make; the kernel's times are of the clock before."""
    differ_ns = network.measure_clock_difference()
    monkeypatch.setattr(network, "measure_clock_difference", lambda: differ_ns)
    with closing(bind_udp(board.host_address, board.data_port, "x")) as sock:
        receiver = BatchReceiver(sock, board.card_address)
        for jump_ns, is_time_of_read in ((999_000, False), (1_001_000, True), (-1_001_000, True)):
            card.sendto(b"0123456789a", (board.host_address, board.data_port))
            differ_ns += jump_ns
            read_ns = time.monotonic_ns()
            assert receiver.receive() == 1
            assert (receiver.times_ns[0] >= read_ns) == is_time_of_read


def test_a_socket_with_the_address_of_another_machine_is_refused():
    with expect_refusal(ErrorCode.VALUE_INVALID):
        bind_udp("192.0.2.1", 4098, "RH data")


def test_a_receive_buffer_that_the_system_allows_is_reported_as_large_as_requested():
    """Linux itself reports twice the size."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sock:
        granted = enlarge_receive_buffer(sock, 1 << 16)
    assert granted == 1 << 16
    assert isinstance(granted, int)
