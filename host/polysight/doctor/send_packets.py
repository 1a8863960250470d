"""Send packets as a capture card does: `python -I send_packets.py CARD CARD_PORT HOST PORT PACKETS RATE BYTES`.

It prints the time in seconds that it took. The program imports nothing of this package, so that it starts without delay
on a busy machine.
"""

import socket
import struct
import sys
import time

# Longest delay after which packets are sent faster to catch up; chosen. A card, too, catches up only what its buffer
# holds.
_MAX_LAG_S = 0.005


def main(card: str, card_port: int, host: str, port: int, packets: int, rate: float, size: int) -> None:
    """Send packets of `size` payload bytes with the counters of a card that was reset, at `rate` packets/s."""
    period_s = 1 / rate
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((card, card_port))
        began = due = time.perf_counter()
        for k in range(packets):
            count = k * size
            # Header: sequence number, which begins with 1, and bytes sent before, 48 bits; little-endian.
            sock.sendto(struct.pack("<IIH", k + 1, count & 0xFFFFFFFF, count >> 32) + bytes(size), (host, port))
            due = max(due + period_s, time.perf_counter() - _MAX_LAG_S)
            # A shorter sleep would take longer than requested: several packets are sent without a pause instead.
            if (early_s := due - time.perf_counter()) > 0.0005:
                time.sleep(early_s)
        sys.stdout.write(f"{time.perf_counter() - began}\n")


if __name__ == "__main__":
    _, card, card_port, host, port, packets, rate, size = sys.argv
    main(
        card=card,
        card_port=int(card_port),
        host=host,
        port=int(port),
        packets=int(packets),
        rate=float(rate),
        size=int(size),
    )
