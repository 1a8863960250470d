"""Inspect a recording of a DCA1000: range profile, clipping, silent antennas, order of I and Q.

`inspect_bin` reads payload, in a layout that is given. A file of whole packets, with headers, is recognised and placed
by byte count first. `inspect_pcap` reads a packet capture (pcap or pcapng): the replies of the card, and its record,
placed as live data is. `recognise_format` recognises other kinds of files.
"""

from __future__ import annotations

import io
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.capture import dca1000
from polysight.capture.dca1000 import (
    MAX_PACKET_BYTES,
    MAX_PAYLOAD_BYTES,
    Code,
    Counters,
    PacketLog,
    Status,
    decode_row,
    decode_two_lane,
)
from polysight.capture.placement import EarlierRecords, PlacedRecord, counter_differences, place_record
from polysight_shared.errors import DataError, ErrorCode, ProtocolError
from polysight_shared.files import read_bounded

MAX_BYTES = 256 << 20
"""Part of a file that is read: eleven rows of the published scan."""
# More chirps do not change the statistics noticeably.
MAX_CHIRPS = 4096
# Packets at its beginning by which a file of whole packets is recognised (chosen).
_HEADERS_READ = 16
# Full scale of the ADC, counts.
_FULL_SCALE = 32767
# First bytes of pcap in both byte orders (with us, with ns), and of pcapng.
_PCAP_HEADS = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\n\r\r\n")
_UDP_HEADER_BYTES = 8
# Largest capture file: 18 minutes of three boards at the published scan's pace, 22.9 MB a row of 17.5 s and board.
_MAX_PCAP_BYTES = 4 << 30
# Longest record of a capture: more than seven hundred rows of the published scan. Byte counts that span more are not
# those of one record.
_MAX_RECORD_BYTES = 1 << 34
# Height of a peak over the median of the range profile that noise does not reach; chosen.
_CLEAR_PEAK_DB = 10.0
# Constant offset, in counts, that the radar's high-pass filter does not let through; chosen.
_HIGH_DC = 0.05 * _FULL_SCALE
# Level relative to the loudest antenna's below which an antenna counts as off (-23 dB, as in synchronisation); chosen.
SILENT_SHARE = 0.07
# First bytes of other kinds of files, and what `recognise_format` calls them.
MAGIC = {
    b"\x7fELF": "a program", b"\x89PNG": "a picture (PNG)", b"\xff\xd8\xff": "a picture (JPEG)", b"%PDF": "a PDF",
    b"PK\x03\x04": "an archive (zip)", b"\x1f\x8b": "compressed (gzip)", b"\x89HDF": "HDF5",
    b"BZh": "compressed (bzip2)", b"\xfd7zXZ": "compressed (xz)", b"\x93NUMPY": "a numpy array",
    b"RIFF": "sound or video (RIFF)", b"MATLAB 5.0": "a MATLAB file",
}  # fmt: skip


def recognise_format(head: bytes) -> str:
    """Describe the kind of file that begins with these bytes: `a picture (PNG)`, `text`, `empty`, `unknown bytes`."""
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    if not head:
        return "empty"
    text = head.decode("utf-8", "ignore")
    printable = all(c.isprintable() or c.isspace() for c in text)
    # The head may end within a character of UTF-8, of which up to three bytes are left.
    if len(text.encode()) > len(head) - 4 and printable:
        return "text"
    return "unknown bytes"


@dataclass(frozen=True)
class Layout:
    """Layout of complex samples in a recording: LVDS lanes (2 or 4), samples of a chirp, RX antennas, Q before I."""

    lanes: int = 4
    samples: int = 256
    rx: int = 4
    q_first: bool = False

    @property
    def chirp_bytes(self) -> int:
        """Bytes of one chirp of all antennas."""
        return self.samples * self.rx * 4


@dataclass
class CardReport:
    """A card in a packet capture.

    `address` is its IPv4 address. `replies` are pairs (command, status) in order, those of asynchronous statuses too,
    `version` is that of the FPGA, `status` all status bits that the card sent. `record` is the result of placing its
    data, None without data. The last packet holds `tail_bytes` and came `tail_after_s` after the one before it; both
    are 0 if it is a full one.
    """

    address: str
    replies: list[tuple[str, int]]
    version: str
    status: Status
    record: PlacedRecord | None
    tail_bytes: int
    tail_after_s: float


@dataclass
class Report:
    """Content of a recording.

    `profile_db`, float64 [samples], is the power range profile: with a Hann window, mean over chirps and antennas, in
    dB over its median. `peak_bin` is its highest bin, apart from those that a constant offset fills, and `peak_db` the
    value there. `rx_profile_db`, [rx, samples], are the profiles of the antennas, in dB over the same median. `rx_rms`
    and `rx_dc` (constant offset) are one value per antenna, in ADC counts. `clipped` counts values at full scale in all
    of the payload, `left_over_bytes` the bytes after the last complete chirp. `chirps` is the number of chirps in the
    file; all other statistics are those of the first `MAX_CHIRPS`. `remarks` are sentences on suspicious properties;
    `card` is None unless the file is a packet capture. `simulated` is set by the caller.
    """

    path: Path
    bytes: int
    layout: Layout
    chirps: int
    peak_bin: int
    peak_db: float
    clipped: int
    rx_dc: list[float]
    rx_rms: list[float]
    left_over_bytes: int
    profile_db: NDArray[np.float64]
    rx_profile_db: NDArray[np.float64]
    remarks: list[str] = field(default_factory=list)
    card: CardReport | None = None
    simulated: bool = False


def read_packets(payload: NDArray[np.uint8]) -> list[bytes]:
    """Return the packets of a file of consecutive full packets, the last perhaps short; [] for any other file.

    Some programs write packets as they come: 1456 bytes of payload, each after ten bytes of counters. `payload` is the
    file's content, uint8 [n].
    """
    count = min(_HEADERS_READ, payload.size // MAX_PACKET_BYTES)
    if count < 2:
        return []
    packets = payload[: count * MAX_PACKET_BYTES].reshape(count, MAX_PACKET_BYTES)
    heads = [dca1000.decode_packet_header(row.tobytes()) for row in packets]
    sequence, byte_count = heads[0]
    if heads != [(sequence + k, byte_count + k * MAX_PAYLOAD_BYTES) for k in range(count)]:
        return []
    pieces = [payload[a : a + MAX_PACKET_BYTES].tobytes() for a in range(0, payload.size, MAX_PACKET_BYTES)]
    return [piece for piece in pieces if len(piece) > dca1000.PACKET_HEADER_BYTES]


def place_packets(packets: list[bytes]) -> tuple[NDArray[np.uint8], PlacedRecord]:
    """Place a record of unknown length, from the lowest to the highest byte count.

    Returns its bytes, uint8 [n], and the result. Raises DataError if the packets are not of one record.
    """
    counts = np.array([dca1000.decode_packet_header(p)[1] for p in packets])
    # Bytes from the first packet in the file to each, negative for one that was sent before it.
    offsets = counter_differences(counts, int(counts[0]), dca1000.BYTE_COUNT_BITS)
    sizes = np.array([len(p) for p in packets]) - dca1000.PACKET_HEADER_BYTES
    size = int((offsets + sizes).max() - offsets.min())
    if size > _MAX_RECORD_BYTES:
        problem = f"byte counts span {size} bytes"
        cause = "the file contains more than one record, or corrupted packets"
        raise DataError(problem, cause, "cut the capture to one record", code=ErrorCode.FILE_DAMAGED)
    log = PacketLog(size)
    for packet in packets:
        # All with the arrival time 0.
        log.add(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]), 0)
    # The record begins with the packet of the lowest byte count.
    sequence, byte_count = dca1000.decode_packet_header(packets[int(np.argmin(offsets))])
    placed, out = place_record(log, past=EarlierRecords(Counters(byte_count, sequence)))
    return out, placed


def inspect_bin(path: Path, layout: Layout = Layout()) -> Report:
    """Inspect a payload file in this layout.

    Raises DataError if the file is missing, of another kind, or shorter than one chirp.
    """
    try:
        size = path.stat().st_size
        payload = np.fromfile(path, dtype=np.uint8, count=MAX_BYTES)
    except OSError as e:
        raise _unreadable_error(path, e) from None
    kind = recognise_format(payload[:4096].tobytes())
    if kind not in ("empty", "unknown bytes"):
        problem = f"{path}: not a capture: it begins as {kind}"
        remedy = "give a row (.bin) or a packet capture (.pcap)"
        raise DataError(problem, "a card records samples", remedy, code=ErrorCode.FILE_FOREIGN)
    packets = read_packets(payload)
    if packets:
        payload, _ = place_packets(packets)
    report = inspect_payload(path, payload, layout)
    if packets:
        report.remarks.append("whole packets, not payload: programs must remove the counters of each packet first")
    if size > MAX_BYTES:
        report.remarks.append(f"only the first {MAX_BYTES >> 20} MiB of {size >> 20} MiB were read")
    return report


def _unreadable_error(path: Path, e: OSError) -> DataError:
    """Return the error for a recording that cannot be read."""
    problem = f"{path}: cannot be read: {e.strerror}"
    return DataError(problem, "the path is wrong", "give a recording", code=ErrorCode.FILE_UNREADABLE)


def inspect_payload(path: Path, payload: NDArray[np.uint8], layout: Layout) -> Report:
    """Inspect payload bytes, uint8 [n]; `path` is for the report. Raises DataError as :func:`inspect_bin`."""
    chirps = payload.size // layout.chirp_bytes
    if not chirps:
        raise DataError(
            f"{path}: {payload.size} bytes are less than a chirp of {layout.samples} samples x {layout.rx} RX",
            "empty or truncated file",
            "record again; `polysight inspect` needs at least one chirp",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    # int16 [word] of the whole payload, for the count of clipped values. Everything else is computed from `cube`,
    # complex [rx, chirp, sample], and `power` [rx, bin].
    words = payload[: payload.size // 2 * 2].view("<i2")
    shape = min(chirps, MAX_CHIRPS), layout.samples, layout.rx
    if layout.lanes == 4:
        cube = decode_row(payload, (), *shape, layout.q_first)[0]
    else:
        cube = decode_two_lane(payload, *shape, layout.q_first)
    power = (np.abs(np.fft.fft(cube * np.hanning(layout.samples), axis=-1)) ** 2).mean(axis=1)
    mean = power.mean(axis=0)
    floor = max(float(np.median(mean)), 1e-12)
    profile = 10 * np.log10(np.maximum(mean, 1e-12) / floor)
    profile_of_rx = 10 * np.log10(np.maximum(power, 1e-12) / floor)
    # A constant offset fills bin 0 and, through the Hann window, bins 1 and -1: they are left out.
    peak = 2 + int(np.argmax(profile[2:-1]))
    report = Report(
        path=path,
        bytes=int(payload.size),
        layout=layout,
        chirps=chirps,
        peak_bin=peak,
        peak_db=float(profile[peak]),
        clipped=int(((words >= _FULL_SCALE) | (words <= -_FULL_SCALE - 1)).sum()),
        rx_dc=[float(v) for v in np.abs(cube.mean(axis=(1, 2)))],
        rx_rms=[float(v) for v in np.sqrt(np.mean(np.abs(cube) ** 2, axis=(1, 2)))],
        left_over_bytes=int(payload.size % layout.chirp_bytes),
        profile_db=profile,
        rx_profile_db=profile_of_rx,
    )
    # I and Q of uniformly distributed 16-bit values have an RMS of sqrt(2 / 3) = 0.8 of full scale. A receiver with
    # such a level would clip, and have a peak.
    if report.peak_db < _CLEAR_PEAK_DB and min(report.rx_rms) > 0.5 * _FULL_SCALE:
        raise DataError(
            f"{path}: not a recording: its values fill the whole range of 16 bits, without a peak in the range profile",
            "random, compressed or encrypted data, or text",
            "give a row (.bin) or a packet capture (.pcap)",
            code=ErrorCode.FILE_FOREIGN,
        )
    report.remarks = _collect_remarks(report, is_mirrored(mean))
    return report


def is_mirrored(power: NDArray[np.float64]) -> bool:
    """True if a complex spectrum, float64 [bin], is at negative frequencies: I and Q are swapped.

    Most echoes are from near objects, so their power is in the first quarter of the bins, or if I and Q are swapped, in
    the last one. The halves cannot be compared: TI's mode "complex 1x" has IFs up to 0.9 of the sample rate, which fill
    the upper half, too. The spectrum counts as mirrored if the last quarter has four times the power of the first.
    Three bins on either side of zero are left out (both numbers are chosen).
    """
    bins = power.size
    quarter = bins // 4
    omitted = 3
    first_quarter = power[omitted + 1 : quarter + 1]
    last_quarter = power[bins - quarter : bins - omitted]
    return bool(last_quarter.sum() > 4 * first_quarter.sum())


def _collect_remarks(report: Report, mirrored: bool) -> list[str]:
    """List suspicious properties of a recording; `mirrored`: most power is at negative frequencies."""
    remarks = []
    if max(report.rx_rms) == 0:
        return ["every sample is zero: nothing was recorded"]
    if mirrored:
        remarks.append("most power is at negative frequencies: I and Q seem to be swapped (--q-first)")
    # Counted as on the board's silk screen.
    if silent := [f"RX{k}" for k, v in enumerate(report.rx_rms, 1) if v < SILENT_SHARE * max(report.rx_rms)]:
        remarks.append(f"no signal on {', '.join(silent)}: antennas off, or another lane layout")
    if report.clipped:
        remarks.append(f"{report.clipped} values are at full scale: the receiver clips, lower its gain")
    if report.left_over_bytes:
        remarks.append(f"{report.left_over_bytes} bytes after the last complete chirp: truncated, or another layout")
    if max(report.rx_dc) > _HIGH_DC:
        remarks.append(
            f"constant offset of {max(report.rx_dc):.0f} counts, which this radar's high-pass filter would remove"
        )
    if report.peak_db < _CLEAR_PEAK_DB:
        remarks.append("no clear peak in the range profile: noise, or a wrong layout (--lanes, --samples)")
    return remarks


# --- packet captures ---


class Datagram(NamedTuple):
    """One UDP datagram and when it was seen."""

    # Since 1970.
    t_s: float
    # Address and port.
    source: tuple[str, int]
    payload: bytes


def is_pcap(head: bytes) -> bool:
    """True if a file that begins with these four bytes is a pcap or pcapng file."""
    return head[:4] in _PCAP_HEADS


def read_pcap(path: Path) -> Iterator[Datagram]:
    """Yield the UDP datagrams of a pcap or pcapng file, in order; other packets and fragments are skipped.

    Raises
    ------
    DataError
        if the file is not a packet capture of an Ethernet interface, or ends within a packet.
    """
    # Imported here, because dpkt loads a hundred protocols.
    import dpkt

    try:
        raw = read_bounded(path, _MAX_PCAP_BYTES)
    except OSError as e:
        raise _unreadable_error(path, e) from None
    try:
        reader = dpkt.pcap.UniversalReader(io.BytesIO(raw))
    except (dpkt.Error, ValueError, struct.error):
        problem = f"{path}: not a packet capture"
        cause = "another kind of file, or truncated"
        remedy = "record with `tcpdump -w`"
        raise DataError(problem, cause, remedy, code=ErrorCode.FILE_FOREIGN) from None
    if reader.datalink() != dpkt.pcap.DLT_EN10MB:
        problem = f"{path}: link type {reader.datalink()}, expected {dpkt.pcap.DLT_EN10MB} (Ethernet)"
        remedy = "record on one Ethernet interface: tcpdump -i eth0"
        raise DataError(problem, "recorded on `-i any`?", remedy, code=ErrorCode.FILE_FOREIGN)
    count = 0
    try:
        for t_s, frame in reader:
            datagram = _decode_udp(float(t_s), frame)
            count += 1
            if datagram is not None:
                yield datagram
    except (dpkt.Error, ValueError, struct.error):
        problem = f"{path}: ends within packet {count + 1}"
        remedy = "record again: end tcpdump with Ctrl-C"
        raise DataError(problem, "truncated file", remedy, code=ErrorCode.FILE_DAMAGED) from None


def _decode_udp(t_s: float, frame: bytes) -> Datagram | None:
    """Return the unfragmented UDP datagram in an Ethernet frame, or None. Raises ValueError if it is cut short."""
    import dpkt

    ethernet: Any = dpkt.ethernet.Ethernet(frame)
    ip: Any = ethernet.data
    if ethernet.type != dpkt.ethernet.ETH_TYPE_IP:
        return None
    if isinstance(ip, bytes):
        raise ValueError("cut within the header")
    if ip.p != dpkt.ip.IP_PROTO_UDP or ip.mf or ip.offset:
        return None
    udp: Any = ip.data
    if isinstance(udp, bytes) or len(udp) < udp.ulen:
        raise ValueError("cut within the payload")
    return Datagram(t_s, (socket.inet_ntoa(ip.src), udp.sport), bytes(udp.data[: udp.ulen - _UDP_HEADER_BYTES]))


def inspect_pcap(path: Path, layout: Layout = Layout(), card_address: str = "") -> Report:
    """Inspect a packet capture (of `tcpdump -w`) with one record of a card.

    `card_address` selects one of several cards.

    Raises
    ------
    DataError
        if the file is not a packet capture, has nothing from a card, or several cards and none was selected.
    """
    card, packets = _select_from_card(path, card_address)
    data = [d for d in packets if len(d.payload) > dca1000.PACKET_HEADER_BYTES]
    if not data:
        if not card.replies:
            address_text = f" at {card_address}" if card_address else ""
            raise DataError(
                f"{path}: contains nothing from a DCA1000{address_text}",
                "another capture, or another card",
                "record on the card's interface",
                code=ErrorCode.NO_DATA,
            )
        return _report_without_data(path, layout, card)
    payload, card.record = place_packets([d.payload for d in data])
    if len(data) > 1 and len(data[-1].payload) < len(data[0].payload):
        card.tail_bytes = len(data[-1].payload) - dca1000.PACKET_HEADER_BYTES
        card.tail_after_s = data[-1].t_s - data[-2].t_s
    report = inspect_payload(path, payload, layout)
    report.card = card
    if card.record.missing:
        report.remarks.append(f"{sum(b - a for a, b in card.record.missing)} bytes are missing")
    return report


def _select_from_card(path: Path, card_address: str) -> tuple[CardReport, list[Datagram]]:
    """Return the report of one card, with its replies, and its other datagrams.

    `card_address` "" is any; raises DataError if datagrams of several cards are there then.
    """
    card = CardReport(address="", replies=[], version="", status=Status(0), record=None, tail_bytes=0, tail_after_s=0.0)
    packets = []
    for datagram in read_pcap(path):
        if datagram.source[1] != dca1000.CARD_SOURCE_PORT or card_address not in ("", datagram.source[0]):
            continue
        if card.address not in ("", datagram.source[0]):
            raise DataError(
                f"{path}: contains packets of {card.address} and {datagram.source[0]}",
                "several cards were recorded together",
                f"choose one: --card {card.address}",
                code=ErrorCode.VALUES_CONFLICT,
            )
        card.address = datagram.source[0]
        try:
            reply = dca1000.decode_reply(datagram.payload)
        except ProtocolError:
            packets.append(datagram)
            continue
        if reply.code == Code.STATUS:
            # The bits that `Status` names.
            card.status |= Status(reply.status & 0x0FFF)
        if reply.code in set(Code):
            name = Code(reply.code).name
        else:
            name = f"0x{reply.code:02x}"
        card.replies.append((name, reply.status))
        if reply.code == Code.VERSION:
            card.version = str(dca1000.decode_version(reply.status))
    return card, packets


def _report_without_data(path: Path, layout: Layout, card: CardReport) -> Report:
    """Return the report of a packet capture with replies of a card only."""
    empty = np.zeros(0)
    return Report(
        path=path,
        bytes=0,
        layout=layout,
        chirps=0,
        peak_bin=0,
        peak_db=0.0,
        clipped=0,
        rx_dc=[],
        rx_rms=[],
        left_over_bytes=0,
        profile_db=empty,
        rx_profile_db=empty,
        remarks=["no data packets"],
        card=card,
    )
