"""Measure packet loss of the scan's receivers over loopback while every core is busy."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec

from polysight.capture import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES, ReceiverProcess, receiver_cores
from polysight_shared.config import Instrument

# Time of a packet beyond its configured delay: delays of 5, 10, 25, 50 us give 706, 545, 325, 193 Mbit/s (TI).
PACKET_TIME_US = 11.0
_RATE_S = 1.5  # duration of each rate
_DRAIN_S = 5.0
_SENDER = Path(__file__).with_name("send_packets.py")
_BUSY_LOOP = "while True: sum(range(100_000))"


@dataclass(frozen=True)
class LoadResult:
    """Result at one rate: packets/s of a card requested (`wanted`) and reached; packets sent and lost by all cards."""

    wanted: float
    reached: float
    sent: int
    lost: int

    @property
    def mbit_s(self) -> float:
        """Payload rate of one card, Mbit/s."""
        return self.reached * MAX_PAYLOAD_BYTES * 8e-6


def card_rates(rig: Instrument) -> list[float]:
    """Packet rates of a card, packets/s, ascending: during bursts, while emptying its memory, and its maximum."""
    burst = rig.frame_bytes / MAX_PAYLOAD_BYTES / (rig.burst.period_us * 1e-6)
    return sorted({burst, *(1e6 / (delay_us + PACKET_TIME_US) for delay_us in (rig.card.packet_delay_us, 5.0))})


def measure_receivers(rig: Instrument, rates: list[float], seconds: float = _RATE_S) -> tuple[list[LoadResult], str]:
    """Send packets at each rate (packets/s) to the receivers of all recorded boards, with a busy process on each core.

    Returns the result for each rate and the receivers' scheduling. Raises DeviceError if a receiver does not start.
    """
    subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
    boards = [
        msgspec.structs.replace(b, card_address=f"{subnet}.{100 + k}", host_address=f"{subnet}.30")
        for k, b in enumerate(rig.recorded)
    ]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="polysight-receivers-")))
        receivers = [
            stack.enter_context(ReceiverProcess(b, rig.card.receive_buffer_bytes, core))
            for b, core in zip(boards, receiver_cores(len(boards)), strict=True)
        ]
        for _ in range(os.cpu_count() or 1):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", _BUSY_LOOP], start_new_session=True))
            stack.callback(busy.kill)
        results, sent = [], 0
        for rate in rates:
            packets = max(2, round(rate * seconds))
            results.append(_measure_rate(rate, sent, packets, receivers, folder))
            sent += packets
        return results, receivers[0].scheduling


def _measure_rate(rate: float, first: int, packets: int, receivers: list[ReceiverProcess], folder: Path) -> LoadResult:
    """Send `packets` packets to each receiver; like a card, the counters continue from record to record (`first`)."""
    for r in receivers:
        r.begin_row(0, 1, packets * MAX_PAYLOAD_BYTES, 1, folder / f"{r.board.name}.part")
    senders = []
    for r in receivers:
        card, host = (r.board.card_address, CARD_SOURCE_PORT), (r.board.host_address, r.board.data_port)
        words = map(str, (*card, *host, first, packets, rate, MAX_PAYLOAD_BYTES))
        command = [sys.executable, "-I", str(_SENDER), *words]
        senders.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    took_s = [float(sender.communicate()[0] or "inf") for sender in senders]
    deadline = time.monotonic() + _DRAIN_S
    while not all(r.poll().complete for r in receivers) and time.monotonic() < deadline:
        before = [r.report().received for r in receivers]
        time.sleep(0.2)
        if [r.report().received for r in receivers] == before:
            break
    lost = sum(packets - r.end_row().packets for r in receivers)
    return LoadResult(rate, packets / max(took_s), packets * len(receivers), lost)
