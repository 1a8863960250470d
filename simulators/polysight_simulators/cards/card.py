"""One board of a simulated rig: the SYNC_IN of its radar, its DCA1000 on the network, their faults, and the UDP sender.

:class:`CardEndpoint` is the card alone: state machine, sockets, and the faults between card and host.
:class:`SimulatedCard` connects it to a radar that turns SYNC_IN pulses into frames. The sender passes many packets per
call, and waits while the receiver has many unread.
"""

from __future__ import annotations

import os
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError
from polysight_simulators.cards import dca1000
from polysight_simulators.cards.fault_draws import NetworkFaults, OverflowFaults, PulseFaults, fault_generator
from polysight_simulators.cards.sync_in import RECOVERY_US, Pulse, StageTrack, SyncInput
from polysight_simulators.faults import Faults
from polysight_simulators.radars import RadarBoard

if TYPE_CHECKING:
    from polysight_simulators.scene import SignalSource

Rows = NDArray[np.uint8]
Clock = Callable[[], float]
# Option of linux/udp.h: the kernel cuts one buffer into equal datagrams.
_UDP_SEGMENT = 103
# Most bytes of one call: below the largest UDP datagram.
_CALL_BYTES = 65_000
# Most packets of one call.
_CALL_SEGMENTS = 44
# The next packets (about 100 kB) are sent while fewer bytes than these are unread at the receiver.
_UNREAD_BYTES = 128 << 10
# Time between two looks at the receiver's queue while it is full; chosen.
_POLL_S = 0.001
# Time to wait for a receiver that does not read; then its packets are lost, as with a real card; chosen.
_WAIT_TIMEOUT_S = 2.0
# Bytes of queued data packets above which the queue is full; chosen.
_MAX_QUEUED_BYTES = 64 << 20
# Largest delay of the packets that later calls make up for; chosen.
_CATCH_UP_S = 0.01
# Least time without data before a record ends, wall time: with a large time scale the card's own 30 s of wire time
# would end before the stage has moved.
NO_DATA_FLOOR_S = 10.0
# Number of frames per call, which bounds the memory; chosen.
FRAMES_PER_CALL = 64
# Default MAC address of a card.
MAC = b"\x12\x34\x56\x78\x90\x12"


class ReceiveQueue:
    """Unread data of a UDP socket of this machine, from the kernel's table of sockets (`table`)."""

    def __init__(self, address: str, port: int, table: Path = Path("/proc/net/udp")) -> None:
        # The table has local address and port in hexadecimal; 0 is a socket bound to any address.
        address_number = struct.unpack("=I", socket.inet_aton(address))[0]
        self._keys = tuple(f"{a:08X}:{port:04X}".encode() for a in (address_number, 0))
        try:
            self._table: int | None = os.open(table, os.O_RDONLY)
        except OSError:
            self._table = None

    def read_state(self) -> tuple[int, int] | None:
        """Return unread bytes and dropped datagrams; None if the socket is not on this machine."""
        if self._table is None:
            return None
        text = os.pread(self._table, 1 << 20, 0)
        for key in self._keys:
            line_start = text.find(b" " + key + b" ")
            if line_start >= 0:
                # From the local address on: remote address, state, waiting bytes `sent:received` (hexadecimal); the
                # last field counts dropped datagrams.
                fields = text[line_start : text.find(b"\n", line_start)].split()
                return int(fields[3].partition(b":")[2], 16), int(fields[-1])
        return None

    def close(self) -> None:
        """Close the table."""
        if self._table is not None:
            os.close(self._table)
            self._table = None


class CardSender:
    """Sends what one card emits, from its own source port, in order.

    On a real network a card at 25 us a packet never outruns a host. A simulated one at many times real time does, when
    the host's process gets no CPU for a moment; such losses say nothing about the instrument. So before every call the
    sender looks at the receiver's queue, and waits while it is filled. `wait_for_receiver=False` leaves that out.

    The packet delay is kept as a mean: up to 44 packets leave at a time.

    Raises
    ------
    DeviceError
        if the card's address cannot be taken.
    """

    def __init__(
        self,
        source: tuple[str, int],
        command_to: tuple[str, int],
        data_to: tuple[str, int],
        wait_for_receiver: bool = True,
    ) -> None:
        self._command_to = command_to
        self._data_to = data_to
        self._socket = bind_udp(*source)
        self._segmented = _can_segment(self._socket)
        self._receiver = ReceiveQueue(*data_to)
        self._wait_for_receiver = wait_for_receiver
        self._queue: deque[bytes | Rows] = deque()
        self._queued_bytes = 0
        self._not_before_s = 0.0
        self._was_idle = True
        self._waiting_since_s: float | None = None
        self.packets = 0
        self.payload_bytes = 0
        self.waits = 0

    @property
    def full(self) -> bool:
        """True if the queue is full."""
        return self._queued_bytes > _MAX_QUEUED_BYTES

    @property
    def queued_bytes(self) -> int:
        """Bytes of data packets not sent yet."""
        return self._queued_bytes

    def counts(self) -> dict[str, int]:
        """Return the numbers of data packets and payload bytes sent, and of waits for the receiver."""
        return {"packets_sent": self.packets, "bytes_sent": self.payload_bytes, "waits": self.waits}

    def count_dropped_by_receiver(self) -> int | None:
        """Return the number of datagrams dropped by the receiving socket; None if it is not on this machine."""
        queue_state = self._receiver.read_state()
        if queue_state is None:
            return None
        _, dropped = queue_state
        return dropped

    def reply(self, message: bytes) -> None:
        """Send a command's reply immediately."""
        self._send_datagram(message, self._command_to)

    def put_status(self, message: bytes) -> None:
        """Send an asynchronous status after the data queued before it."""
        self._queue.append(message)

    def put_packets(self, rows: Rows) -> None:
        """Send data packets, uint8 [n, size], after what was queued before them."""
        self._queue.append(rows)
        self._queued_bytes += rows.size

    def flush(self, clock_s: Callable[[], float], packet_interval_s: float) -> float | None:
        """Send data that is due; return the seconds until more is due, None if all is sent.

        `clock_s` is the wall clock; `packet_interval_s` the shortest mean time between packets, wall time.
        """
        while self._queue:
            item = self._queue[0]
            if isinstance(item, bytes):
                self._send_datagram(item, self._command_to)
                self._queue.popleft()
                continue
            now = clock_s()
            if now < self._not_before_s:
                return self._not_before_s - now
            if not self._may_send(now):
                return _POLL_S
            n = min(len(item), _CALL_SEGMENTS, max(1, _CALL_BYTES // item.shape[1]))
            self._send(item[:n])
            self._queued_bytes -= n * item.shape[1]
            catch_up_s = 0.0 if self._was_idle else _CATCH_UP_S
            self._was_idle = False
            self._not_before_s = max(self._not_before_s, now - catch_up_s) + n * packet_interval_s
            if n == len(item):
                self._queue.popleft()
            else:
                self._queue[0] = item[n:]
        self._was_idle = True
        return None

    def send_now(self) -> None:
        """Send everything queued immediately, before the sockets are closed."""
        for item in self._queue:
            if isinstance(item, bytes):
                self._send_datagram(item, self._command_to)
            else:
                for start in range(0, len(item), _CALL_SEGMENTS):
                    self._send(item[start : start + _CALL_SEGMENTS])
        self._queue.clear()
        self._queued_bytes = 0

    def _may_send(self, now_s: float) -> bool:
        """Return True if the receiver has room, or has not read for too long."""
        if not self._wait_for_receiver:
            return True
        queue_state = self._receiver.read_state()
        if queue_state is None or queue_state[0] <= _UNREAD_BYTES:
            self._waiting_since_s = None
            return True
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s
            self.waits += 1
        return now_s - self._waiting_since_s > _WAIT_TIMEOUT_S

    def _send(self, rows: Rows) -> None:
        """Send data packets in one call if the kernel can cut them, otherwise one by one."""
        size = rows.shape[1]
        self.packets += len(rows)
        self.payload_bytes += len(rows) * max(0, size - dca1000.DATA_HEADER_BYTES)
        if self._segmented and len(rows) > 1:
            segment = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", size))]
            self._send_datagram(np.ascontiguousarray(rows).data, self._data_to, segment)
            return
        for row in rows:
            self._send_datagram(row.data, self._data_to)

    def _send_datagram(
        self, data: bytes | memoryview, address: tuple[str, int], ancillary: list[tuple[int, int, bytes]] | None = None
    ) -> None:
        """Send one buffer, which `ancillary` may cut into datagrams.

        Raises DeviceError if the address is unreachable.
        """
        try:
            self._socket.sendmsg([data], ancillary or [], 0, address)
        except OSError as e:
            raise DeviceError(
                f"simulated card: cannot send to {address[0]}:{address[1]}: {e.strerror}",
                "that address cannot be reached from the card's address",
                "give card and host addresses of one network: both on loopback, or both of one interface",
            ) from None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        self._receiver.close()


def bind_udp(address: str, port: int) -> socket.socket:
    """Return a UDP socket bound to an address of this machine. Raises DeviceError."""
    udp_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp_socket.bind((address, port))
    except OSError as e:
        udp_socket.close()
        raise DeviceError(
            f"simulated card: cannot bind {address}:{port}: {e.strerror}",
            "another simulated rig uses this address, or it is not an address of this machine (loopback is 127.x.y.z)",
            "start the rig with `python -m polysight_simulators.rig`, which chooses free loopback addresses",
            code=ErrorCode.BUSY,
        ) from None
    return udp_socket


def _can_segment(s: socket.socket) -> bool:
    """True if this kernel cuts large buffers into datagrams (UDP_SEGMENT, Linux 4.18 and later)."""
    try:
        s.setsockopt(socket.IPPROTO_UDP, _UDP_SEGMENT, 0)
    except OSError:
        return False
    return True


class CardEndpoint:
    """One card with its sockets.

    Parameters
    ----------
    name
        Name of the board, which also seeds the faults' random numbers.
    network
        Addresses in its EEPROM.
    time_scale
        Wire time (that of the simulated card) over wall time.
    clock_s
        Wall clock.

    Raises
    ------
    DeviceError
        if the card's addresses cannot be bound.
    """

    def __init__(
        self,
        name: str,
        network: dca1000.Network,
        faults: Faults,
        seed: int,
        time_scale: float,
        clock_s: Clock,
        wait_for_receiver: bool = True,
    ) -> None:
        self.name = name
        self.counts: Counter[str] = Counter()
        self.card = dca1000.Card(
            network,
            no_data_floor_s=NO_DATA_FLOOR_S * time_scale,
        )
        self._faults = faults
        self._time_scale = time_scale
        self._clock_s = clock_s
        self._wait_for_receiver = wait_for_receiver
        self._network_faults = NetworkFaults(faults, seed, name, self.counts)
        self._status_rng = fault_generator(seed, name, "status")
        # A second card at the same address, which sends the data in reverse under other counters.
        if faults.twin:
            self._twin = dca1000.Packetiser(sequence=700, byte_count=1 << 40)
        else:
            self._twin = None
        # Wall time until which the card boots and hears no request.
        self._boots_until_s = float("-inf")
        self.bindings = 0
        self._bind(network)

    def _bind(self, network: dca1000.Network) -> None:
        """Bind command socket and sender at these addresses. Raises DeviceError."""
        self._commands = bind_udp(network.card_address, network.command_port)
        self._commands.setblocking(False)
        try:
            self.sender = CardSender(
                (network.card_address, dca1000.SOURCE_PORT),
                (network.host_address, network.command_port),
                (network.host_address, network.data_port),
                self._wait_for_receiver,
            )
        except PolysightError:
            self._commands.close()
            raise
        self.bindings += 1

    def fileno(self) -> int:
        """Return the command socket, for select; it changes when `bindings` grows."""
        return self._commands.fileno()

    def wire_s(self) -> float:
        """Return the present wire time."""
        return self._clock_s() * self._time_scale

    def power_cycle(self) -> None:
        """Switch the card off and on, which activates the addresses in its EEPROM.

        Raises DeviceError if those are not addresses of this machine.
        """
        network_before = self.card.network
        self.card.power_cycle()
        self.counts["power_cycles"] += 1
        self._boots_until_s = self._clock_s() + self._faults.boot_s / self._time_scale
        if self.card.network != network_before:
            self.sender.send_now()
            self._keep_sender_counts()
            self.close()
            self._bind(self.card.network)

    def serve_commands(self) -> None:
        """Answer pending requests."""
        while True:
            try:
                datagram = self._commands.recv(2048)
            except BlockingIOError:
                return
            self._serve(datagram)

    def _serve(self, datagram: bytes) -> None:
        """Execute one request and send its replies."""
        request = dca1000.parse_request(datagram)
        if request is None:
            self.counts["not_requests"] += 1
            return
        self.counts["requests"] += 1
        if self._clock_s() < self._boots_until_s:
            self.counts["requests_unheard"] += 1
            return
        if self._faults.mute:
            self.counts["requests_unanswered"] += 1
            return
        # The reply; after that of a record stop come the short last packet and the status.
        reply, *last_of_record = self.card.command(datagram, self.wire_s())
        if isinstance(reply, dca1000.Message):
            self.counts["replies"] += 1
            for _ in range(2 if self._twin else 1):
                self.sender.reply(reply.payload)
        self.emit(last_of_record)

    def emit(self, outputs: Sequence[dca1000.Output]) -> None:
        """Send the card's output through the faults of the network."""
        for output in outputs:
            if isinstance(output, dca1000.Packets):
                self._emit_packets(output)
                continue
            # The status that ends a record: packets that a fault held back arrive before it.
            if not self.card.recording:
                for rows in self._network_faults.drain():
                    self.sender.put_packets(rows)
            if self._status_rng.random() < self._faults.status_loss:
                self.counts["statuses_lost"] += 1
            else:
                self.counts["statuses"] += 1
                self.sender.put_status(output.payload)

    def _emit_packets(self, packets: dca1000.Packets) -> None:
        """Send data packets through the faults of the network; a twin sends the payload reversed."""
        self.counts["packets_made"] += len(packets.rows)
        self.counts["bytes_made"] += packets.payload_bytes
        for rows in self._network_faults.transmit(packets.rows):
            self.sender.put_packets(rows)
        if self._twin is not None:
            reversed_payload = packets.rows[:, dca1000.DATA_HEADER_BYTES :].reshape(-1)[::-1]
            self.sender.put_packets(self._twin.feed(np.ascontiguousarray(reversed_payload)))

    @property
    def due(self) -> bool:
        """True if a record runs and its deadline has passed, whether or not more pulses wait at the wires."""
        deadline_s = self.card.deadline_s
        return deadline_s is not None and self.wire_s() >= deadline_s

    def tick(self) -> None:
        """End the record if its deadline has passed."""
        self.emit(self.card.tick(self.wire_s()))

    def flush(self) -> float | None:
        """Send data that is due; return the seconds until more is due, None if all is sent."""
        return self.sender.flush(self._clock_s, self.card.packet_delay_s / self._time_scale)

    def _keep_sender_counts(self) -> None:
        """Add the counts of a sender that is about to be closed."""
        for key, value in self.sender.counts().items():
            self.counts[key] += value

    def report(self) -> dict[str, int | None]:
        """Return all counts."""
        report: dict[str, int | None] = dict(self.counts)
        for key, value in self.sender.counts().items():
            report[key] = self.counts[key] + value
        report["records"] = self.card.records
        report["dropped_by_receiver"] = self.sender.count_dropped_by_receiver()
        return report

    def close(self) -> None:
        """Close the sockets."""
        self._commands.close()
        self.sender.close()


def _group_pulses(pulses: list[Pulse]) -> Iterator[list[Pulse]]:
    """Yield runs of consecutive pulse numbers, at most FRAMES_PER_CALL long."""
    first = 0
    for i in range(1, len(pulses) + 1):
        if i == len(pulses) or i - first == FRAMES_PER_CALL or pulses[i].number != pulses[i - 1].number + 1:
            yield pulses[first:i]
            first = i


class SimulatedCard:
    """One board with its radar and its DCA1000. Raises DeviceError if the card's addresses cannot be bound."""

    def __init__(
        self,
        rig: Instrument,
        board: Board,
        source: SignalSource,
        faults: Faults,
        seed: int,
        time_scale: float,
        clock_s: Clock,
        wait_for_receiver: bool = True,
    ) -> None:
        self.board = board
        # One line of the Pi feeds the SYNC_IN of all boards.
        self.line = rig.pi.sync_out[0]
        self._source = source
        self._clock_s = clock_s
        network = dca1000.Network(board.host_address, board.card_address, MAC, board.command_port, board.data_port)
        self.endpoint = CardEndpoint(
            name=board.name,
            network=network,
            faults=faults,
            seed=seed,
            time_scale=time_scale,
            clock_s=clock_s,
            wait_for_receiver=wait_for_receiver,
        )
        self._burst = rig.burst
        # Time after a pulse in which the radar ignores others: chirps after the first, the last ramp, and recovery.
        later_us = (rig.burst.chirps - 1) * rig.burst.chirp_us
        dead_s = (later_us + rig.chirp.ramp_end_us + RECOVERY_US) * 1e-6
        native = rig.radar.control == "native"
        # Number of the chip, by which the host distinguishes boards.
        die = 1 + [b.name for b in rig.boards].index(board.name)
        if native:
            self.radar = RadarBoard(clock_s, dead_s=dead_s, fault_pulses=faults.radar_fault_pulses, die_number=die)
        else:
            self.radar = None
        self._sync = SyncInput(rig, self.radar)
        self._pulse_faults = PulseFaults(faults, seed, board.name)
        self._overflow = OverflowFaults(faults, seed, board.name)
        self._pulses = 0
        self.last_data_wall_s = 0.0

    def rearm(self) -> None:
        """Arm the radar for the pulses of a row, as its control server does."""
        self._sync.arm()

    @property
    def card(self) -> dca1000.Card:
        """Its DCA1000."""
        return self.endpoint.card

    def process_pulses(self, rising_ns: list[int], track: StageTrack) -> None:
        """Process rising edges of SYNC_IN at these wire times."""
        pulses = [Pulse(self._pulses + i, t) for i, t in enumerate(rising_ns)]
        self._pulses += len(pulses)
        self._send_frames(self._sync.select_starting(self._pulse_faults.select_seen(pulses)), track)
        self.last_data_wall_s = self._clock_s()

    def _send_frames(self, started: list[Pulse], track: StageTrack) -> None:
        """Send the frames of these pulses, at their numbers in the plan; without a record only count them."""
        if not self.card.recording:
            self.endpoint.counts["frames_not_recorded"] += len(started)
            return
        for run in _group_pulses(track.number_by_plan(started)):
            self._send_run(run, track)

    def _send_run(self, run: list[Pulse], track: StageTrack) -> None:
        """Simulate the frames of consecutive pulses and pass them to the card."""
        counts = self.endpoint.counts
        burst = self._burst
        x_mm, y_mm = track.offsets_mm(
            [p.t_ns + round(n * burst.chirp_us * 1e3) for p in run for n in range(burst.chirps)]
        )
        # int16 [chirp, sample, I and Q of each RX]; the card gets them over LVDS, and may lose some to an overflow.
        chirps = self._source.chirps(self.board.name, x_mm, y_mm, run[0].number * burst.chirps)
        frames = chirps.reshape(len(run), -1, *chirps.shape[2:])
        counts["frames"] += len(frames)
        for lvds in self._overflow.split(frames):
            self.endpoint.emit(self.card.process_lvds(lvds.data, self.endpoint.wire_s()))
            if lvds.lost_bytes:
                counts["overflows"] += 1
                counts["overflow_bytes"] += lvds.lost_bytes
                self.endpoint.emit(self.card.overflow())

    def tick(self, more_expected: bool) -> None:
        """End the record if its deadline has passed.

        With `more_expected`, while the stage moves or pulses are still to follow, the record ends only after 2 s of
        wall time without data: at many times real time 2 s of wire time pass in a moment, for which any process may get
        no CPU. In real time both are the same.
        """
        if more_expected and self._clock_s() - self.last_data_wall_s < dca1000.TAIL_S:
            return
        self.endpoint.tick()

    def report(self) -> dict[str, int | None]:
        """Return all counts, for comparison with those of a host."""
        radar = {"pulses": self._pulses, "too_soon": self._sync.too_soon, "missed": self._pulse_faults.missed}
        radar |= {"rearmed": self._sync.rearmed, "unarmed": self._sync.unarmed}
        return {"frames": 0, **radar, **self.endpoint.report()}

    def close(self) -> None:
        """Close the sockets."""
        self.endpoint.close()
