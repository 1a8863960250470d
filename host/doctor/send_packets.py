"""Packets at a pace, as a card sends them: `python -m polysight.host.doctor.send_packets CARD HOST PORT PACKETS RATE`.

Prints the seconds it took. Fresh counters, full packets.
"""

from __future__ import annotations

import socket
import struct
import sys
import time

from polysight.host.capture import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES

_BEHIND_S = 0.005  # a card makes up for no more than its own buffer


def main(argv: list[str]) -> int:
    """Send, then say how long it took."""
    card, host, port, packets, rate = argv[1:]
    total, period_s, to = int(packets), 1 / float(rate), (host, int(port))
    payload = bytes(range(256)) * 6
    payload = payload[:MAX_PAYLOAD_BYTES]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((card, CARD_SOURCE_PORT))
        began = due = time.perf_counter()
        for k in range(total):
            count = k * MAX_PAYLOAD_BYTES
            sock.sendto(struct.pack("<IIH", k + 1, count & 0xFFFFFFFF, count >> 32) + payload, to)
            due = max(due + period_s, time.perf_counter() - _BEHIND_S)
            if (ahead := due - time.perf_counter()) > 0.0005:
                time.sleep(ahead)
        sys.stdout.write(f"{time.perf_counter() - began}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
