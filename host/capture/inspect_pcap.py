"""What is in a packet capture of a DCA1000: the card's replies and its record, placed as live data is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from polysight.host.capture import dca1000
from polysight.host.capture.dca1000 import Code, Status
from polysight.host.capture.inspect import CardReport, Known, Report, inspect_payload
from polysight.host.capture.packets_in_file import place_packets
from polysight.host.capture.pcap import read_pcap
from polysight.shared.errors import DataError, ProtocolError


def inspect_pcap(path: Path, known: Known = Known(), card_address: str = "") -> Report:  # noqa: B008 - immutable
    """Inspect a packet capture that holds one record of a card.

    Parameters
    ----------
    path
        A file as `tcpdump -w` writes it.
    known
        What is known of the recording.
    card_address
        Which card, where several were recorded.

    Raises
    ------
    DataError
        when the file is no packet capture, holds nothing from a card, or several cards and none was chosen.
    """
    replies: list[tuple[str, int]] = []
    packets: list[bytes] = []
    times: list[int] = []
    status, version, address = Status(0), "", ""
    for datagram in read_pcap(path):
        if datagram.source[1] != dca1000.CARD_SOURCE_PORT or card_address not in ("", datagram.source[0]):
            continue
        if address not in ("", datagram.source[0]):
            raise DataError(
                f"{path}: holds packets of {address} and {datagram.source[0]}",
                "several cards were recorded at once",
                f"choose one: --card {address}",
            )
        address = datagram.source[0]
        try:
            reply = dca1000.decode_reply(datagram.payload)
        except ProtocolError:
            packets.append(datagram.payload)
            times.append(datagram.t_ns)
            continue
        if reply.code == Code.STATUS:
            status |= Status(reply.status & 0x0FFF)
        name = Code(reply.code).name if reply.code in set(Code) else f"0x{reply.code:02x}"
        replies.append((name, reply.status))
        if reply.code == Code.VERSION:
            version = str(dca1000.decode_version(reply.status))
    card = CardReport(address, replies, version, status, None, 0, 0.0)
    data = [p for p in packets if len(p) > dca1000.PACKET_HEADER_BYTES]
    if not data:
        if not replies:
            raise DataError(
                f"{path}: nothing from a DCA1000{f' at {card_address}' if card_address else ''} in it",
                "another capture, or another card",
                "record on the card's interface",
            )
        return _empty(path, card)
    out = place_packets(data)
    card.record = out[1]
    if len(data) > 1 and len(data[-1]) < len(data[0]):
        card.tail_bytes = len(data[-1]) - dca1000.PACKET_HEADER_BYTES
        card.tail_after_s = (times[-1] - times[-2]) / 1e9
    report = inspect_payload(path, out[0], known)
    report.card = card
    if out[1].missing:
        report.remarks.append(f"{sum(b - a for a, b in out[1].missing)} bytes are missing")
    return report


def _empty(path: Path, card: CardReport) -> Report:
    none = np.zeros(0)
    return Report(
        path, 0, 0, False, 0, 0, 0, False, 0, 0.0, 0, [], [], 0, none, none, remarks=["no data packets"], card=card
    )
