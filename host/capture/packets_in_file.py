"""Recorded data packets: found in a file that holds them header and all, placed without the length of the record."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture import dca1000
from polysight.host.capture.dca1000 import MAX_PACKET_BYTES, MAX_PAYLOAD_BYTES
from polysight.host.capture.placed import Placed
from polysight.host.capture.placement import Placement
from polysight.shared.errors import DataError

_LOOKED_AT = 16


def packets_in_file(payload: NDArray[np.uint8]) -> list[bytes]:
    """The packets of a file that holds full packets one after another, the last perhaps short; none of any other.

    Some programs write packets to a file as they come: each 1456 bytes of payload then begin with ten of counters.
    """
    count = min(_LOOKED_AT, payload.size // MAX_PACKET_BYTES)
    if count < 2:
        return []
    some = payload[: count * MAX_PACKET_BYTES].reshape(count, MAX_PACKET_BYTES)
    heads = [dca1000.decode_packet_header(row.tobytes()) for row in some]
    (sequence, byte_count), k = heads[0], range(count)
    if heads != [(sequence + i, byte_count + i * MAX_PAYLOAD_BYTES) for i in k]:
        return []
    pieces = [payload[a : a + MAX_PACKET_BYTES].tobytes() for a in range(0, payload.size, MAX_PACKET_BYTES)]
    return [piece for piece in pieces if len(piece) > dca1000.PACKET_HEADER_BYTES]


def place_packets(packets: list[bytes]) -> tuple[NDArray[np.uint8], Placed]:
    """Place a record whose length is not known: it reaches from the lowest to the highest byte count.

    Returns its bytes, uint8 [n], and what became of the packets. Raises DataError when they are not of one record.
    """
    first = dca1000.decode_packet_header(packets[0])[1]
    half, whole = 1 << (dca1000.BYTE_COUNT_BITS - 1), 1 << dca1000.BYTE_COUNT_BITS
    ahead = [(dca1000.decode_packet_header(p)[1] - first + half) % whole - half for p in packets]
    ends = [a + len(p) - dca1000.PACKET_HEADER_BYTES for a, p in zip(ahead, packets, strict=True)]
    size = max(ends) - min(ahead)
    if size > 1 << 34:
        raise DataError(f"byte counts span {size} bytes: more than one record, or corrupted packets")
    out = np.zeros(size, dtype=np.uint8)
    placement = Placement(out)
    for packet in packets:
        placement.place_packet(packet)
    return out, placement.finish()
