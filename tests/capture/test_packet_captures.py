"""Packet captures frame by frame: which datagrams are a card's, its replies, its last packet, and frames cut short."""

import struct
from pathlib import Path

import pytest
from tests.support.capture.recordings import CARD, OTHER, encode_udp_frame
from tests.support.capture.records import encode_packets
from tests.support.refusals import expect_refusal

from polysight.capture.dca1000 import Status
from polysight.capture.inspect import inspect_pcap, is_pcap, read_pcap
from polysight_shared.errors import ErrorCode

ADDRESS = "192.168.33.180"
# Replies of a card: its version 2.8, two status messages, and one of an unknown command.
VERSION = bytes.fromhex("5aa50e000204aaee")
STATUS = bytes.fromhex("5aa50a000001aaee")
OTHER_STATUS = bytes.fromhex("5aa50a000100aaee")
UNKNOWN = bytes.fromhex("5aa555000700aaee")


def write_frames(path: Path, *frames: bytes, link: int = 1) -> Path:
    """Write a packet capture of these frames, one a second from 100.5 s on; `link` 1 is Ethernet."""
    raw = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    for second, frame in enumerate(frames, 100):
        raw += struct.pack("<IIII", second, 500_000, len(frame), len(frame)) + frame
    path.write_bytes(raw)
    return path


def change_bytes(frame: bytes, changes: dict[int, bytes]) -> bytes:
    """Return the frame with other bytes at these places. The header of IP begins at byte 14, that of UDP at 34."""
    for start, new in changes.items():
        frame = frame[:start] + new + frame[start + len(new) :]
    return frame


def test_datagrams_come_with_their_time_and_source(tmp_path):
    path = write_frames(tmp_path / "a.pcap", encode_udp_frame(1024, b"first"), encode_udp_frame(7, b"second", OTHER))
    first, second = read_pcap(path)
    assert (first.source, first.payload, first.t_s) == ((ADDRESS, 1024), b"first", pytest.approx(100.5))
    assert (second.source, second.payload, second.t_s) == (("192.168.33.181", 7), b"second", pytest.approx(101.5))


def test_bytes_after_a_datagram_are_not_part_of_it(tmp_path):
    """Ethernet pads frames to 60 bytes."""
    frame = encode_udp_frame(1024, b"short").ljust(60, b"\0")
    (datagram,) = read_pcap(write_frames(tmp_path / "a.pcap", frame))
    assert datagram.payload == b"short"


@pytest.mark.parametrize(
    "changes",
    [
        # ARP, TCP, a first fragment, and a second one.
        {12: b"\x08\x06"}, {23: b"\x06"}, {20: b"\x20\x00"}, {20: b"\x00\x01"},
    ],
)  # fmt: skip
def test_other_packets_and_fragments_are_skipped(tmp_path, changes):
    frame = change_bytes(encode_udp_frame(1024, bytes(32)), changes)
    path = write_frames(tmp_path / "a.pcap", frame, encode_udp_frame(1024, b"kept"))
    assert [datagram.payload for datagram in read_pcap(path)] == [b"kept"]


# Cut in the header of IP, of UDP, and in the payload.
@pytest.mark.parametrize("kept_bytes", [20, 41, 45])
def test_a_frame_that_was_cut_is_named_by_its_number(tmp_path, kept_bytes):
    frame = encode_udp_frame(1024, b"whole")
    path = write_frames(tmp_path / "a.pcap", frame, frame[:kept_bytes], frame)
    with expect_refusal(ErrorCode.FILE_DAMAGED, "ends within packet 2"):
        list(read_pcap(path))


def test_a_capture_of_another_link_is_refused(tmp_path):
    with expect_refusal(ErrorCode.FILE_FOREIGN, "link type 113", "tcpdump -i eth0"):
        list(read_pcap(write_frames(tmp_path / "a.pcap", encode_udp_frame(1024, b"x"), link=113)))
    (tmp_path / "b.pcap").write_bytes(b"text")
    with expect_refusal(ErrorCode.FILE_FOREIGN, "not a packet capture"):
        list(read_pcap(tmp_path / "b.pcap"))
    assert is_pcap(bytes.fromhex("d4c3b2a1") + b"more")
    assert not is_pcap(b"text")


def test_replies_of_a_card_are_read_and_their_status_bits_joined(tmp_path):
    frames = [encode_udp_frame(1024, reply) for reply in (VERSION, STATUS, UNKNOWN, OTHER_STATUS)]
    report = inspect_pcap(write_frames(tmp_path / "a.pcap", *frames))
    assert report.card is not None
    assert report.card.replies == [("VERSION", 0x0402), ("STATUS", 0x0100), ("0x55", 7), ("STATUS", 0x0001)]
    assert report.card.status == Status.RECORD_COMPLETED | Status.NO_LVDS_DATA
    assert (report.card.version, report.card.address, report.remarks) == ("2.8", ADDRESS, ["no data packets"])


@pytest.mark.parametrize("port", [1023, 1025, 4098])
def test_datagrams_of_other_ports_are_not_a_cards(tmp_path, port):
    with expect_refusal(ErrorCode.NO_DATA, "nothing from a DCA1000"):
        inspect_pcap(write_frames(tmp_path / "a.pcap", encode_udp_frame(port, VERSION)))


@pytest.mark.parametrize("cards", [(CARD, OTHER), (OTHER, CARD)])
def test_a_capture_of_two_cards_is_read_only_for_the_chosen_one(tmp_path, cards):
    path = write_frames(tmp_path / "a.pcap", *(encode_udp_frame(1024, VERSION, card) for card in cards))
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "192.168.33.180", "192.168.33.181"):
        inspect_pcap(path)
    for address in (ADDRESS, "192.168.33.181"):
        report = inspect_pcap(path, card_address=address)
        assert report.card is not None
        assert (report.card.address, len(report.card.replies)) == (address, 1)
    with expect_refusal(ErrorCode.NO_DATA, "at 192.168.33.182"):
        inspect_pcap(path, card_address="192.168.33.182")


@pytest.mark.parametrize(("last_bytes", "tail"), [(1456, (0, 0.0)), (100, (100, 1.0)), (1455, (1455, 1.0))])
def test_a_shorter_last_packet_is_the_tail_of_a_record(tmp_path, last_bytes, tail):
    payload = bytes(range(256)) * 64
    packets = encode_packets(payload[: 10 * 1456 + last_bytes], 1, 0)
    assert len(packets) == 11
    path = write_frames(tmp_path / "a.pcap", *(encode_udp_frame(1024, packet) for packet in packets))
    report = inspect_pcap(path)
    assert report.card is not None
    assert (report.card.tail_bytes, report.card.tail_after_s) == (tail[0], pytest.approx(tail[1]))
    assert report.bytes == 10 * 1456 + last_bytes
    # Two packets are missing, which is reported; a header without payload does not count as data.
    gap = [*packets[:4], *packets[6:], packets[0][:10]]
    report = inspect_pcap(write_frames(tmp_path / "b.pcap", *(encode_udp_frame(1024, packet) for packet in gap)))
    assert f"{2 * 1456} bytes are missing" in report.remarks
