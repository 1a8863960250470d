"""Processes of the capture benchmark: `python -m benchmarks.capture_helpers send|count|process ...`.

`send RIG SEED CARD_ADDRESS HOST_ADDRESS PORT`: a paced card without commands. Reads lines `PACKETS PACKETS_PER_SECOND`
and answers each when it has sent them. The packets are built once and sent with `sendmmsg`; only their counters are
renewed, a block at a time.

`count HOST_ADDRESS PORT BUFFER_BYTES`: the plain way, one `recv_into` a packet, no placement, no file. Reads lines
`PACKETS`, and answers when that many came, or after three seconds without any in all.

`process RIG ROW_FILE`: the processing of a live scan during the capture. Decodes and synchronises the first published
row (350 points of 16 chirps) of a recorded file, again and again, for the receiving boards in turn, and answers every
line with the rows done so far and its CPU seconds.

Answers are lines of JSON.
"""

import ctypes
import json
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES, PACKET_HEADER_BYTES, decode_row
from polysight.capture.network import _Header, _IoVec, _Message, bind_udp, count_kernel_drops, enlarge_receive_buffer
from polysight.capture.receiver import take_priority
from polysight.sync.chain import BoardSetup, synchronise_row
from polysight_shared.config import Instrument, load_instrument

PACKETS = 4096
"""4096 packets of 1456 bytes are 1456 frames of 4096 bytes, 91 bursts of 16: blocks join without a seam."""


def make_block(rig: Instrument, seed: int) -> bytes:
    """Return a block of `PACKETS` full payloads: int16 I0..I3 Q0..Q3 a sample.

    A direct path, an echo 22 dB below it and noise; levels and frequencies are chosen.
    """
    rng = np.random.default_rng(seed)
    samples = rig.chirp.samples
    frames = PACKETS * MAX_PAYLOAD_BYTES // rig.frame_bytes
    t = np.arange(samples) / rig.chirp.sample_rate_hz
    phase = rng.uniform(0, 2 * np.pi, (frames, 1))
    tones: NDArray[np.complex128] = 800 * np.exp(1j * (2 * np.pi * 190e3 * t + phase)) + 60 * np.exp(
        1j * (2 * np.pi * 310e3 * t + phase)
    )
    noise = rng.normal(scale=15, size=(frames, samples, 2, 4))
    parts = np.stack([tones.real, tones.imag], axis=-1)[..., None] + noise
    return np.round(parts).astype("<i2").tobytes()


def make_packets(block: bytes) -> np.ndarray:
    """Return the packets of a block, uint8 [PACKETS, header and payload]; :func:`number` fills the headers in."""
    packets = np.zeros((PACKETS, PACKET_HEADER_BYTES + MAX_PAYLOAD_BYTES), dtype=np.uint8)
    packets[:, PACKET_HEADER_BYTES:] = np.frombuffer(block, dtype=np.uint8).reshape(PACKETS, MAX_PAYLOAD_BYTES)
    return packets


def number(packets: np.ndarray, first: int) -> None:
    """Write the headers of packets `first`, `first + 1`... since power-up: sequence number and byte count so far."""
    k = np.arange(first, first + len(packets), dtype=np.uint64)
    heads = np.empty(len(packets), dtype=[("sequence", "<u4"), ("low", "<u4"), ("high", "<u2")])
    count = k * np.uint64(MAX_PAYLOAD_BYTES)
    heads["sequence"] = (k + np.uint64(1)) & np.uint64(0xFFFFFFFF)
    heads["low"] = count & np.uint64(0xFFFFFFFF)
    heads["high"] = count >> np.uint64(32)
    packets[:, :PACKET_HEADER_BYTES] = heads.view(np.uint8).reshape(len(packets), struct.calcsize("<IIH"))


# A sender that is late by more than this does not catch up: a card has no more than its own buffer (chosen).
BEHIND_S = 0.005
# Packets due within this time go together, because a card's pace is finer than this process can wait (chosen).
TURN_S = 0.0005


class Sender:
    """Sends packet after packet, at a pace, from `source` (the card's address and port) to `destination`."""

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
        """Send `total` packets at `rate` packets/s; return the seconds that it took."""
        start = time.perf_counter()
        # Packet k is due at `first_due + k / rate`; a sender that is too late moves this schedule.
        first_due = start
        sent = 0
        while sent < total:
            first_due = max(first_due, time.perf_counter() - sent / rate - BEHIND_S)
            due = min(total, int((time.perf_counter() - first_due) * rate) + 1)
            while sent < due:
                position = self._next % PACKETS
                if position == 0:
                    number(self._packets, self._next)
                n = self._call(position, min(due - sent, PACKETS - position))
                sent = sent + n
                self._next = self._next + n
            ahead = first_due + (sent / rate) - time.perf_counter()
            if ahead > 0 and sent < total:
                time.sleep(max(ahead, TURN_S))
        return time.perf_counter() - start

    def _call(self, at: int, count: int) -> int:
        """Send at most `count` packets from position `at` of the block on; return how many were sent."""
        # Linux takes at most 1024 messages a call.
        n = self._sendmmsg(self._socket.fileno(), ctypes.c_void_p(self._base + at * self._size), min(count, 1024), 0)
        if n < 0:
            error_number = ctypes.get_errno()
            raise OSError(error_number, os.strerror(error_number))
        return n


def send(rig_path: str, seed: str, card: str, host: str, port: str) -> None:
    """Serve as a card; see above."""
    # A real card is not starved by what else this machine does.
    take_priority(real_time=1)
    packets = make_packets(make_block(load_instrument(Path(rig_path)), int(seed)))
    sender = Sender(packets, (card, CARD_SOURCE_PORT), (host, int(port)))

    def answer(line: str) -> dict[str, Any]:
        total, rate = line.split()
        return {"sent": int(total), "seconds": sender.send(int(total), float(rate))}

    say("ready")
    answer_lines(answer)


def count(host: str, port: str, buffer_bytes: str) -> None:
    """Serve as a plain receiver; see above."""
    sock = bind_udp(host, int(port), "plain loop")
    enlarge_receive_buffer(sock, int(buffer_bytes))
    sock.settimeout(1.0)
    buffer = memoryview(bytearray(2048))

    def answer(line: str) -> dict[str, Any]:
        expected = int(line)
        received = 0
        idle = 0
        drops = count_kernel_drops(sock)
        cpu = time.process_time()
        while received < expected and idle < 3:
            try:
                sock.recv_into(buffer)
            except TimeoutError:
                idle += 1
                continue
            received += 1
        return {"received": received, "drops": count_kernel_drops(sock) - drops, "cpu_s": time.process_time() - cpu}

    say("ready")
    answer_lines(answer)


def process(rig_path: str, row_file: str) -> None:
    """Process a row again and again; see above."""
    rig = load_instrument(Path(rig_path))
    # No byte range of the recorded row is missing.
    missing = ()
    setups = [BoardSetup.from_rig(rig, board) for board in rig.receivers]
    # Whole bursts of 16 chirps; the file may hold less than a row.
    size = np.fromfile(row_file, dtype=np.uint8, count=350 * rig.burst.pulses * rig.frame_bytes).size
    frames = size // rig.frame_bytes // rig.burst.pulses * rig.burst.pulses
    done = 0
    ended = threading.Event()

    def answer_until_end() -> None:
        answer_lines(lambda _: {"rows": done, "cpu_s": time.process_time(), "frames": frames})
        ended.set()

    threading.Thread(target=answer_until_end, daemon=True).start()
    while not ended.is_set():
        payload = np.fromfile(row_file, dtype=np.uint8, count=frames * rig.frame_bytes)
        synchronise_row(*decode_row(payload, missing, frames, rig.chirp.samples), setups[done % len(setups)])
        done += 1


def say(text: str) -> None:
    """Write a line to the standard output and flush it."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def answer_lines(answer: Callable[[str], dict[str, Any]]) -> None:
    """Answer every line of the standard input, until it ends."""
    for line in sys.stdin:
        say(json.dumps(answer(line)))


if __name__ == "__main__":
    {"send": send, "count": count, "process": process}[sys.argv[1]](*sys.argv[2:])
