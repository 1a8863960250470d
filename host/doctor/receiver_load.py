"""How many packets this machine's receivers hold while it computes: measured over loopback with the scan's own."""

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

from polysight.host.capture import MAX_PAYLOAD_BYTES, ReceiverProcess, receiver_cores
from polysight.shared.config import Instrument

SECONDS = 1.5  # of each rate
SEND_US = (
    11.0  # a card takes so long for a packet beside its delay: 5, 10, 25, 50 us are 706, 545, 325, 193 Mbit/s (TI)
)
_DRAIN_S = 5.0
_BUSY = "while True: sum(range(100_000))"


@dataclass(frozen=True)
class Held:
    """One rate, tried: packets/s asked for and reached, packets sent and lost, all of one card at the mean."""

    wanted: float
    reached: float
    sent: int
    lost: int

    @property
    def mbit_s(self) -> float:
        """Payload of one card, Mbit/s."""
        return self.reached * MAX_PAYLOAD_BYTES * 8e-6


def rates(rig: Instrument) -> list[float]:
    """Packets/s of one card: in a burst, when it sends what it has stored, and at its fastest."""
    burst = rig.frame_bytes / MAX_PAYLOAD_BYTES / (rig.burst.period_us * 1e-6)
    return sorted({burst, *(1e6 / (delay_us + SEND_US) for delay_us in (rig.card.packet_delay_us, 5.0))})


def measure(rig: Instrument, some: list[float], seconds: float = SECONDS) -> tuple[list[Held], str]:
    """Send at these rates to receivers of every recorded board at once, beside a busy process a core.

    Returns what was held, and how the receivers run. Raises DeviceError as ReceiverProcess does.
    """
    subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
    boards = [
        msgspec.structs.replace(b, card_address=f"{subnet}.{100 + k}", host_address=f"{subnet}.30")
        for k, b in enumerate(rig.recorded)
    ]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="polysight-receivers-")))
        cores = receiver_cores(len(boards))
        receivers = [
            stack.enter_context(ReceiverProcess(b, rig.card.receive_buffer_bytes, core))
            for b, core in zip(boards, cores, strict=True)
        ]
        for _ in range(os.cpu_count() or 1):
            stack.callback(_end, subprocess.Popen([sys.executable, "-c", _BUSY], start_new_session=True))
        return [_try(rate, seconds, receivers, folder) for rate in some], receivers[0].scheduling


def _try(rate: float, seconds: float, receivers: list[ReceiverProcess], folder: Path) -> Held:
    packets = max(2, round(rate * seconds))
    for r in receivers:
        r.begin_row(0, 1, packets * MAX_PAYLOAD_BYTES, 1, folder / f"{r.board.name}.part")
    senders = [
        subprocess.Popen(
            [
                *(sys.executable, "-m", "polysight.host.doctor.send_packets", r.board.card_address),
                *(r.board.host_address, str(r.board.data_port), str(packets), str(rate)),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        for r in receivers
    ]
    took = [float(sender.communicate()[0] or "inf") for sender in senders]
    deadline = time.monotonic() + _DRAIN_S
    while not all(r.poll().complete for r in receivers) and time.monotonic() < deadline:
        before = [r.report().received for r in receivers]
        time.sleep(0.2)
        if [r.report().received for r in receivers] == before:
            break
    captures = [r.end_row() for r in receivers]
    lost = sum(packets - c.packets for c in captures)
    return Held(rate, packets / max(took), packets * len(receivers), lost)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
