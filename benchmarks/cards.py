"""Cards that send at a pace, on a loopback subnet of their own, and a wait for their receivers."""

from __future__ import annotations

import random
from contextlib import ExitStack
from pathlib import Path

import msgspec

from benchmarks.child import Child
from benchmarks.signal_block import make_block
from polysight_shared.config import Board, Instrument


class Cards:
    """A sender for each receiving board.

    `blocks` is what each sends again and again, `folder` is where row files go.
    """

    def __init__(self, rig: Instrument, config: Path, folder: Path, stack: ExitStack) -> None:
        subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
        self.rig, self.folder, self.buffer_bytes = rig, folder, rig.card.receive_buffer_bytes
        self.boards: list[Board] = [
            replace_addresses(b, f"{subnet}.{180 + k}", f"{subnet}.30") for k, b in enumerate(rig.receivers)
        ]
        self.blocks = [make_block(rig, k) for k in range(len(self.boards))]
        self.senders: list[Child] = []
        for k, b in enumerate(self.boards):
            child = Child("benchmarks.sender", config, k, b.card_address, b.host_address, b.data_port)
            stack.callback(child.close)
            self.senders.append(child)
        for sender in self.senders:
            sender.hear()

    def start_sending(self, packets: int, rate: float) -> None:
        """Every sender sends this many packets at its share of the rate."""
        for sender in self.senders:
            sender.say(packets, rate / len(self.senders))

    def sent(self) -> float:
        """Wait for the senders; returns the longest time one took."""
        return max(sender.hear()["seconds"] for sender in self.senders)

    def queues(self) -> list[int]:
        """Bytes of kernel memory that wait at each board's port."""
        ports = [b.data_port for b in self.boards]
        found = [0] * len(ports)
        for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]:
            words = line.split()
            port = int(words[1].split(":")[1], 16)
            if port in ports:
                found[ports.index(port)] = int(words[4].split(":")[1], 16)
        return found


def replace_addresses(board: Board, card: str, host: str) -> Board:
    """The board on another subnet."""
    return msgspec.structs.replace(board, card_address=card, host_address=host)
