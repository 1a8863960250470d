"""A paced card without commands: `python -m benchmarks.sender RIG SEED CARD_ADDRESS HOST_ADDRESS PORT`.

Reads lines `PACKETS PACKETS_PER_SECOND` and answers each with one line of JSON when it has sent them. The packets are
built once and sent with `sendmmsg`; only their counters are renewed, a block at a time.
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.signal_block import PACKETS, make_block, make_packets, number
from polysight.capture.network import _Header, _IoVec, _Message
from polysight.capture.scheduling import take_priority
from polysight_shared.config import load_instrument

BEHIND_S = 0.005  # a card catches up on its own buffer at most; packets later than this are delayed
TURN_S = 0.0005  # packets due within this time go together, as the card's own pace is finer than this process can wait


class Sender:
    """Sends packet after packet, at a pace, from the card's address and source port."""

    def __init__(self, packets: np.ndarray, source: tuple[str, int], destination: tuple[str, int]) -> None:
        self._packets = packets
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(source)
        self._socket.connect(destination)
        self._vectors = (_IoVec * PACKETS)()
        self._messages = (_Message * PACKETS)()
        stride = packets.strides[0]
        for i in range(PACKETS):
            self._vectors[i] = _IoVec(packets.ctypes.data + i * stride, packets.shape[1])
            self._messages[i].header = _Header(vector=ctypes.addressof(self._vectors[i]), vector_length=1)
        self._size = ctypes.sizeof(_Message)
        self._base = ctypes.addressof(self._messages)
        self._sendmmsg = ctypes.CDLL(None, use_errno=True).sendmmsg
        self._next = 0

    def send(self, total: int, rate: float) -> float:
        """Send `total` packets at `rate` packets/s; returns the seconds it took."""
        start = began = time.perf_counter()
        sent = 0
        while sent < total:
            began = max(began, time.perf_counter() - sent / rate - BEHIND_S)
            due = min(total, int((time.perf_counter() - began) * rate) + 1)
            while sent < due:
                at = self._next % PACKETS
                if at == 0:
                    number(self._packets, self._next)
                n = self._call(at, min(due - sent, PACKETS - at))
                sent, self._next = sent + n, self._next + n
            ahead = began + (sent / rate) - time.perf_counter()
            if ahead > 0 and sent < total:
                time.sleep(max(ahead, TURN_S))
        return time.perf_counter() - start

    def _call(self, at: int, count: int) -> int:
        n = self._sendmmsg(self._socket.fileno(), ctypes.c_void_p(self._base + at * self._size), min(count, 1024), 0)
        if n < 0:
            number_ = ctypes.get_errno()
            raise OSError(number_, os.strerror(number_))
        return n


def main(argv: list[str]) -> int:
    """Serve until the standard input ends."""
    take_priority(real_time=1)  # a real card is not starved by what else this machine does
    rig_path, seed, card, host, port = argv[1:]
    sender = Sender(
        make_packets(make_block(load_instrument(Path(rig_path)), int(seed))), (card, 1024), (host, int(port))
    )
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        total, rate = line.split()
        took = sender.send(int(total), float(rate))
        sys.stdout.write(json.dumps({"sent": int(total), "seconds": took}) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
