"""Inspect a packet capture of a DCA1000: the replies of the card and its record, placed as live data is.

`read_pcap` reads the UDP datagrams of a classic pcap file of Ethernet packets; a pcapng file is refused, with the
command that converts it. `inspect_pcap` splits them into replies and data packets, and inspects the record of one card.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polysight.capture import dca1000
from polysight.capture.dca1000 import Code, Status
from polysight.capture.inspect import CardReport, Layout, Report, inspect_payload, place_packets, unreadable
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, ProtocolError
from polysight_shared.files import read_bounded

_MAGIC = {0xA1B2C3D4: 1_000, 0xA1B23C4D: 1}  # microseconds or nanoseconds, as ns a tick
_PCAPNG = 0x0A0D0D0A
_RECORD_AGAIN = "record again: end tcpdump with Ctrl-C"
_MAX_BYTES = 4 << 30  # half an hour of three boards
_ETHERNET, _IPV4, _VLAN, _UDP = 1, 0x0800, 0x8100, 17


class Datagram(NamedTuple):
    """One UDP datagram and when it was seen."""

    t_ns: int
    source: tuple[str, int]
    destination: tuple[str, int]
    payload: bytes


def is_pcap(head: bytes) -> bool:
    """True if a file that begins with these four bytes is a pcap or pcapng file, in either byte order."""
    return len(head) >= 4 and any(struct.unpack_from(f"{order}I", head)[0] in (*_MAGIC, _PCAPNG) for order in "<>")


def read_pcap(path: Path) -> Iterator[Datagram]:
    """Yield the UDP datagrams of a file, in order; other packets are skipped.

    Raises
    ------
    DataError
        if the file is not a classic pcap file of Ethernet packets, or ends within a packet.
    """
    try:
        raw = read_bounded(path, _MAX_BYTES)
    except OSError as e:
        raise unreadable(path, e) from None
    for order in "<>":
        if len(raw) >= 24 and (tick := _MAGIC.get(struct.unpack_from(order + "I", raw)[0])) is not None:
            break
    else:
        newer = len(raw) >= 4 and struct.unpack_from("<I", raw)[0] == _PCAPNG
        raise DataError(
            f"{path}: not a pcap file",
            "it is pcapng" if newer else "another kind of file",
            f"`editcap -F pcap {path.name} converted.pcap` makes one" if newer else "record with `tcpdump -w`",
            code=ErrorCode.FILE_FOREIGN,
        )
    link = struct.unpack_from(order + "I", raw, 20)[0]
    if link != _ETHERNET:
        what = f"{path}: link type {link}, expected {_ETHERNET} (Ethernet)"
        raise DataError(what, "recorded on `-i any`?", code=ErrorCode.FILE_FOREIGN)
    header = struct.Struct(order + "IIII")
    position = 24
    while position < len(raw):
        kept = header.unpack_from(raw, position)[2] if position + header.size <= len(raw) else 0
        if position + header.size + kept > len(raw):
            what = f"{path}: ends within the packet at byte {position}"
            raise DataError(what, "truncated file", _RECORD_AGAIN, code=ErrorCode.FILE_DAMAGED)
        seconds, ticks, kept, _ = header.unpack_from(raw, position)
        position += header.size
        found = _udp(raw[position : position + kept])
        position += kept
        if found is not None:
            yield Datagram(seconds * 1_000_000_000 + ticks * tick, *found)


def _udp(frame: bytes) -> tuple[tuple[str, int], tuple[str, int], bytes] | None:
    """Return source, destination and payload of an Ethernet frame with an unfragmented IPv4 UDP datagram, or None."""
    at, kind = 14, int.from_bytes(frame[12:14], "big")
    if kind == _VLAN:
        at, kind = 18, int.from_bytes(frame[16:18], "big")
    if kind != _IPV4 or len(frame) < at + 28 or frame[at] >> 4 != 4 or frame[at + 9] != _UDP:
        return None
    if int.from_bytes(frame[at + 6 : at + 8], "big") & 0x3FFF:
        return None
    udp = at + (frame[at] & 0x0F) * 4
    source_port, destination_port, length = struct.unpack_from(">HHH", frame, udp)
    source, destination = (".".join(map(str, frame[at + k : at + k + 4])) for k in (12, 16))
    return (source, source_port), (destination, destination_port), frame[udp + 8 : udp + length]


def inspect_pcap(path: Path, layout: Layout = Layout(), card_address: str = "") -> Report:  # noqa: B008 - immutable
    """Inspect a packet capture (of `tcpdump -w`) with one record of a card.

    `card_address` selects one of several cards.

    Raises
    ------
    DataError
        if the file is no packet capture, has nothing from a card, or several cards and none was selected.
    """
    card, packets = _from_card(path, card_address)
    data = [d for d in packets if len(d.payload) > dca1000.PACKET_HEADER_BYTES]
    if not data:
        if not card.replies:
            raise DataError(
                f"{path}: contains nothing from a DCA1000{f' at {card_address}' if card_address else ''}",
                "another capture, or another card",
                "record on the card's interface",
                code=ErrorCode.NO_DATA,
            )
        return _empty(path, layout, card)
    payload, card.record = place_packets([d.payload for d in data])
    if len(data) > 1 and len(data[-1].payload) < len(data[0].payload):
        card.tail_bytes = len(data[-1].payload) - dca1000.PACKET_HEADER_BYTES
        card.tail_after_s = (data[-1].t_ns - data[-2].t_ns) / 1e9
    report = inspect_payload(path, payload, layout)
    report.card = card
    if card.record.missing:
        report.remarks.append(f"{sum(b - a for a, b in card.record.missing)} bytes are missing")
    return report


def _from_card(path: Path, card_address: str) -> tuple[CardReport, list[Datagram]]:
    """Return a card's replies and its other datagrams. Raises DataError for several cards."""
    card, packets = CardReport("", [], "", Status(0), None, 0, 0.0), []
    for datagram in read_pcap(path):
        if datagram.source[1] != dca1000.CARD_SOURCE_PORT or card_address not in ("", datagram.source[0]):
            continue
        if card.address not in ("", datagram.source[0]):
            raise DataError(
                f"{path}: holds packets of {card.address} and {datagram.source[0]}",
                "several cards were recorded at once",
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
            card.status |= Status(reply.status & 0x0FFF)
        name = Code(reply.code).name if reply.code in set(Code) else f"0x{reply.code:02x}"
        card.replies.append((name, reply.status))
        if reply.code == Code.VERSION:
            card.version = str(dca1000.decode_version(reply.status))
    return card, packets


def _empty(path: Path, layout: Layout, card: CardReport) -> Report:
    none = np.zeros(0)
    return Report(path, 0, layout, 0, 0, 0.0, 0, [], [], 0, none, none, remarks=["no data packets"], card=card)
