"""Two capture cards together, paced, into real row files, while rows are processed."""

import argparse
import os
import random
import shutil
import tempfile
import time
import zlib
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from benchmarks.capture_helpers import PACKETS, make_block
from benchmarks.measure import ROOT, Child, ask, cpu_s
from polysight.capture.dca1000 import MAX_PAYLOAD_BYTES
from polysight.capture.receiver import ReceiverProcess, receiver_cores
from polysight_shared.config import Board, Instrument, load_instrument

RIG = ROOT / "instrument.toml"
# Blocks (`PACKETS` packets each) of one board in one row file: 286 MB, as much as twelve rows of the published scan.
ROW_BLOCKS = 48
# Share of the requested rate at which the senders count as in pace (chosen).
KEEPS_PACE = 0.98
MBIT_A_PACKET = MAX_PAYLOAD_BYTES * 8 / 1e6


class Cards:
    """A sender process for each receiving board, on loopback addresses drawn at random so that runs do not meet.

    `blocks` is what each sends again and again, `folder` is where row files go. `stack` ends the processes.
    """

    def __init__(self, rig: Instrument, config: Path, folder: Path, stack: ExitStack) -> None:
        # Last bytes as the DCA1000's defaults have them: cards from .180 on, the host at .30.
        subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
        self.rig = rig
        self.folder = folder
        self.buffer_bytes = rig.card.receive_buffer_bytes
        self.boards: list[Board] = [
            replace_addresses(b, f"{subnet}.{180 + k}", f"{subnet}.30") for k, b in enumerate(rig.receivers)
        ]
        self.blocks = [make_block(rig, k) for k in range(len(self.boards))]
        self.senders: list[Child] = []
        for k, b in enumerate(self.boards):
            addresses = (b.card_address, b.host_address, b.data_port)
            child = Child("benchmarks.capture_helpers", "send", config, k, *addresses)
            stack.callback(child.close)
            self.senders.append(child)
        # Each answers "ready" once its packets are built.
        for sender in self.senders:
            sender.hear()

    def start_sending(self, packets: int, rate: float) -> None:
        """Let every sender send this many packets at its share of the rate (packets/s of all)."""
        for sender in self.senders:
            sender.say(packets, rate / len(self.senders))

    def wait_until_sent(self) -> float:
        """Wait for the senders; return the longest time that one took, seconds."""
        return max(sender.hear()["seconds"] for sender in self.senders)

    def queues(self) -> list[int]:
        """Return bytes of kernel memory that wait at each board's port.

        In /proc/net/udp word 1 is the local `address:port`, word 4 the `sent:received` bytes that wait, hexadecimal.
        """
        ports = [b.data_port for b in self.boards]
        byte_counts = [0] * len(ports)
        for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]:
            words = line.split()
            port = int(words[1].split(":")[1], 16)
            if port in ports:
                byte_counts[ports.index(port)] = int(words[4].split(":")[1], 16)
        return byte_counts


def replace_addresses(board: Board, card: str, host: str) -> Board:
    """Return the board with addresses on another subnet."""
    return msgspec.structs.replace(board, card_address=card, host_address=host)


@dataclass
class Trial:
    """One rate, tried for a time. Rates (packets/s) and counts are of both cards together."""

    # Requested rate, and the rate that the senders reached.
    wanted: float
    rate: float = 0.0
    # Time of sending.
    seconds: float = 0.0
    # Packets sent; those not received; those that the kernel counted as dropped.
    packets: int = 0
    lost: int = 0
    kernel_drops: int = 0
    # True if all complete rows have the right checksum.
    exact: bool = True
    # Share of a core, each receiver.
    cpu: list[float] = field(default_factory=list)
    # Worst fill of a receive buffer, as a share.
    queue: float = 0.0
    # Worst time to make a row durable and begin the next.
    turn_s: float = 0.0
    # Rows processed a second meanwhile.
    rows_beside: float = 0.0
    # The machine's load average over a minute.
    load: float = 0.0

    @property
    def good(self) -> bool:
        """True if nothing was lost or changed."""
        return self.lost == 0 and self.exact

    @property
    def paced(self) -> bool:
        """True if the senders reached the requested rate."""
        return self.rate >= KEEPS_PACE * self.wanted

    def line(self) -> str:
        """Return the trial as a line of the table under HEAD."""
        cpu = "+".join(f"{100 * c:.0f}" for c in self.cpu)
        if self.lost:
            verdict = "LOSS"
        elif not self.exact:
            verdict = "WRONG BYTES"
        elif self.paced:
            verdict = "good"
        else:
            verdict = "good (senders)"
        return (
            f"{self.wanted:9.0f} {self.rate:9.0f} {self.rate * MBIT_A_PACKET:7.0f} {self.seconds:6.1f}"
            f" {self.packets:10d} {self.lost:8d} {self.kernel_drops:8d} {cpu:>9} {100 * self.queue:6.1f}"
            f" {self.turn_s:6.2f} {self.rows_beside:6.2f} {self.load:5.1f}  {verdict}"
        )


HEAD = (
    "   asked       got  Mbit/s   sec.    packets     lost  dropped  CPU % ea  que. %  turn s rows/s  load\n"
    "     1/s       1/s payload               sent            kernel  receiver   worst  worst  beside"
)


class Receivers:
    """The project's receivers, writing row files. Each file is deleted once it is checked, except the first row's."""

    def __init__(self, cards: Cards, stack: ExitStack) -> None:
        self._cards = cards
        cores = receiver_cores(len(cards.boards))
        self._receivers = [
            stack.enter_context(ReceiverProcess(b, cards.buffer_bytes, c))
            for b, c in zip(cards.boards, cores, strict=True)
        ]
        self.text = "; ".join(f"{r.board.name} {r.scheduling}, buffer {r.granted_bytes}" for r in self._receivers)
        self._row = 0
        # By index of the board: CRC-32 of 0, 1, 2, ... blocks, see `_expected_checksum`.
        self._checksums: dict[int, list[int]] = {}

    def try_rate(self, rate: float, seconds: float, beside: Child | None) -> Trial:
        """Receive rows for about `seconds` of sending; the time to make them durable in between does not count.

        `rate`: packets/s of all cards; `beside`: process that runs meanwhile and whose progress is noted.
        """
        cards = self._cards
        blocks_of_card = max(1, round(rate / len(cards.boards) * seconds / PACKETS))
        rows = -(-blocks_of_card // ROW_BLOCKS)
        # Sent by one card in one row.
        blocks = round(blocks_of_card / rows)
        packets = blocks * PACKETS
        state_before = ask(beside)
        cpu = [cpu_s(r.pid) for r in self._receivers]
        trial = Trial(rate)
        began = time.perf_counter()
        ended = 0.0
        for _ in range(rows):
            size = packets * MAX_PAYLOAD_BYTES
            for r in self._receivers:
                path = cards.folder / r.board.name / f"{self._row:04d}.part"
                # Take 1: no row is repeated. The senders count from their first packet on, as cards that were reset.
                r.begin_row(self._row, 1, size, cards.rig.frame_bytes, path, after_reset=self._row == 0)
            if ended:
                trial.turn_s = max(trial.turn_s, time.perf_counter() - ended)
            cards.start_sending(packets, rate)
            self._watch(trial, packets / (rate / len(cards.boards)))
            trial.seconds += cards.wait_until_sent()
            self._drain()
            ended = time.perf_counter()
            captures = [r.end_row() for r in self._receivers]
            for k, capture in enumerate(captures):
                trial.packets += packets
                trial.lost += packets - capture.counts.placed
                trial.kernel_drops += capture.kernel_drops
                trial.exact &= capture.missing_bytes > 0 or capture.crc32 == self._expected_checksum(k, blocks)
            for r in self._receivers:
                path = cards.folder / r.board.name / f"{self._row:04d}.part"
                if self._row:
                    path.unlink()
                else:
                    path.rename(cards.folder / f"{r.board.name}.bin")
            self._row += 1
        wall = time.perf_counter() - began
        state_after = ask(beside)
        trial.rate = trial.packets / trial.seconds
        # All CPU, the ends of rows included, over the time of sending: it belongs to these packets.
        trial.cpu = [(cpu_s(r.pid) - c) / trial.seconds for r, c in zip(self._receivers, cpu, strict=True)]
        trial.rows_beside = (state_after["rows"] - state_before["rows"]) / wall
        trial.load = os.getloadavg()[0]
        return trial

    def _watch(self, trial: Trial, seconds: float) -> None:
        """Note the worst fill of a receive buffer for so long."""
        limit = time.perf_counter() + seconds
        while (seconds_left := limit - time.perf_counter()) > 0:
            time.sleep(min(0.05, seconds_left))
            # The kernel grants twice the requested size (socket(7), SO_RCVBUF).
            trial.queue = max(trial.queue, max(self._cards.queues()) / (2 * self._cards.buffer_bytes))

    def _drain(self) -> None:
        """Wait until the receivers have taken the waiting packets; lost ones never come."""
        limit = time.perf_counter() + 5.0
        while any(self._cards.queues()) and time.perf_counter() < limit:
            time.sleep(0.01)

    def _expected_checksum(self, board: int, blocks: int) -> int:
        """Return the CRC-32 of so many blocks of a board, one after another."""
        checksums = self._checksums.setdefault(board, [0])
        while len(checksums) <= blocks:
            checksums.append(zlib.crc32(self._cards.blocks[board], checksums[-1]))
        return checksums[blocks]


class PlainLoops:
    """A plain `recv_into` loop for each card, in a process of its own, which only counts packets."""

    def __init__(self, cards: Cards, stack: ExitStack) -> None:
        self._cards = cards
        self._loops = []
        for b in cards.boards:
            loop = Child("benchmarks.capture_helpers", "count", b.host_address, b.data_port, cards.buffer_bytes)
            stack.callback(loop.close)
            self._loops.append(loop)
        for loop in self._loops:
            loop.hear()

    def try_rate(self, rate: float, seconds: float, beside: Child | None) -> Trial:
        """Count packets at this rate for so long; arguments as of `Receivers.try_rate`."""
        packets = max(1, round(rate / len(self._loops) * seconds / PACKETS)) * PACKETS
        state_before = ask(beside)
        began = time.perf_counter()
        for loop in self._loops:
            loop.say(packets)
        self._cards.start_sending(packets, rate)
        took = self._cards.wait_until_sent()
        answers = [loop.hear() for loop in self._loops]
        wall = time.perf_counter() - began
        total = packets * len(self._loops)
        return Trial(
            wanted=rate,
            rate=total / took,
            seconds=took,
            packets=total,
            lost=total - sum(a["received"] for a in answers),
            kernel_drops=sum(a["drops"] for a in answers),
            cpu=[a["cpu_s"] / took for a in answers],
            rows_beside=(ask(beside)["rows"] - state_before["rows"]) / wall,
            load=os.getloadavg()[0],
        )


def show(text: str) -> None:
    """Print a line and flush it."""
    print(text, flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--seconds", type=float, default=60.0, help="of the run (default 60)")
    parser.add_argument("--rate", type=float, default=120_000.0, help="packets/s of both cards (default 120000)")
    parser.add_argument("--alone", action="store_true", help="no processing of rows beside the capture")
    parser.add_argument("--no-compare", action="store_true", help="no plain loop for comparison")
    parser.add_argument("--folder", type=Path, default=None, help="where row files go (default: a temporary folder)")


def run(args: argparse.Namespace) -> int:
    """Receive at the rate, then compare with plain loops; return 1 if our receivers lost or changed something."""
    rig = load_instrument(RIG)
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="polysight-bench-", dir=args.folder))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        cards = Cards(rig, RIG, folder, stack)
        with ExitStack() as ours:
            sink = Receivers(cards, ours)
            show(f"{len(cards.boards)} cards, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {sink.text}")
            show(HEAD)
            # A slow trial first (chosen rate): it warms up, and its row is the one that is processed during the others.
            show(sink.try_rate(20_000, min(args.seconds, 2.0), None).line())
            beside = None
            if not args.alone:
                beside = processing_beside(cards, stack)
            fastest_trial = sink.try_rate(args.rate, args.seconds, beside)
            show(fastest_trial.line())
        if not args.no_compare:
            with ExitStack() as theirs:
                show("plain recv_into loops that only count:")
                plain = PlainLoops(cards, theirs).try_rate(args.rate, min(args.seconds, 3.0), beside)
                show(plain.line())
            ours_cpu = sum(fastest_trial.cpu) / fastest_trial.rate * 1e6
            plain_cpu = sum(plain.cpu) / plain.rate * 1e6
            show(
                f"at {args.rate:.0f} packets/s: {ours_cpu:.1f} us of CPU a packet, plain loop {plain_cpu:.1f} us and"
                f" {plain.lost} of {plain.packets} lost: ratio {plain_cpu / ours_cpu:.2f}"
            )
    if fastest_trial.good:
        return 0
    return 1


def processing_beside(cards: Cards, stack: ExitStack) -> Child:
    """Start the processing of rows; print its pace without capture."""
    beside = Child("benchmarks.capture_helpers", "process", RIG, cards.folder / f"{cards.boards[0].name}.bin")
    stack.callback(beside.close)
    idle = ask(beside)
    time.sleep(4.0)
    now = ask(beside)
    show(f"processing alone: {(now['rows'] - idle['rows']) / 4.0:.2f} rows/s of {now['frames']} frames")
    return beside
