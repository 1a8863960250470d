"""A simulated capture card on the network: its state machine, its sockets, and the faults between it and the host."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from polysight.shared.errors import PolysightError
from polysight.simulators.card_faults import Faults
from polysight.simulators.card_sender import CardSender, Pace, bound_udp
from polysight.simulators.dca1000 import (
    SOURCE_PORT,
    Card,
    Code,
    Message,
    Network,
    Output,
    Packets,
    message,
    parse_request,
)
from polysight.simulators.fault_draws import CommandFaults, NetworkFaults

NO_DATA_FLOOR_S = 10.0  # wall time: at many times real time the card's 30 s would be over before the stage has moved
Clock = Callable[[], float]


class CardEndpoint:
    """One card with its sockets.

    Parameters
    ----------
    name
        Of the board: keys the faults' random numbers.
    network
        Addresses in its EEPROM.
    time_scale
        Wire time over wall time.
    clock_s
        Wall clock.
    lanes
        LVDS lanes of the radar; None suits every configuration.

    Raises
    ------
    DeviceError
        when the card's addresses cannot be taken.
    """

    def __init__(
        self,
        name: str,
        network: Network,
        faults: Faults,
        seed: int,
        time_scale: float,
        clock_s: Clock,
        pace: Pace,
        lanes: int | None = 4,
    ) -> None:
        self.name = name
        self.counts: Counter[str] = Counter()
        self.card = Card(
            network,
            faults.first_sequence,
            faults.first_byte_count,
            no_data_floor_s=NO_DATA_FLOOR_S * time_scale,
            stop_discards=faults.stop_discards,
            lanes=lanes,
        )
        self._faults = faults
        self._time_scale = time_scale
        self._clock_s = clock_s
        self._pace = pace
        self._network_faults = NetworkFaults(faults, seed, name, self.counts)
        self._command_faults = CommandFaults(faults, seed, name, self.counts)
        self._deaf_until_s = self._link_up_s = float("-inf")
        self.bindings = 0
        self._bind(network)

    def _bind(self, network: Network) -> None:
        self._commands = bound_udp(network.card_address, network.command_port)
        self._commands.setblocking(False)
        try:
            self.sender = CardSender(
                (network.card_address, SOURCE_PORT),
                (network.host_address, network.command_port),
                (network.host_address, network.data_port),
                self._pace,
            )
        except PolysightError:
            self._commands.close()
            raise
        self.bindings += 1

    def fileno(self) -> int:
        """The command socket, for select. Another one when `bindings` has grown."""
        return self._commands.fileno()

    def wire_s(self) -> float:
        """Wire time by the wall clock."""
        return self._clock_s() * self._time_scale

    def power_cycle(self) -> None:
        """Switch the card off and on: the addresses in its EEPROM are taken.

        Raises DeviceError when those are not addresses of this machine.
        """
        before = self.card.network
        self.card.power_cycle()
        self.counts["power_cycles"] += 1
        self._deaf_until_s = self._clock_s() + self._faults.boot_s / self._time_scale
        if self.card.network != before:
            self.sender.send_now()
            self._keep_sender_counts()
            self.close()
            self._bind(self.card.network)

    def reset(self) -> None:
        """Reset the FPGA, as command 0x01 does, by itself."""
        self.counts["resets"] += 1
        self.card.reset_fpga()

    def take_link_down(self, seconds: float) -> None:
        """Hear nothing, and send no messages, for so long from now, in wire time."""
        self.counts["link_downs"] += 1
        self._link_up_s = self._clock_s() + seconds / self._time_scale

    @property
    def link_is_down(self) -> bool:
        """Whether requests cannot reach the card now."""
        return self._clock_s() < self._link_up_s

    def serve_commands(self) -> None:
        """Answer the requests that have come."""
        while True:
            try:
                datagram = self._commands.recv(2048)
            except BlockingIOError:
                return
            self._serve(datagram)

    def _serve(self, datagram: bytes) -> None:
        request = parse_request(datagram)
        if request is None:
            self.counts["not_requests"] += 1
            return
        self.counts["requests"] += 1
        if self._clock_s() < self._deaf_until_s or self.link_is_down:
            self.counts["requests_unheard"] += 1
            return
        if not self._command_faults.heard():
            return
        code = request[0]
        refused = self._command_faults.refused(code)
        reply, *more = [message(code, 1)] if refused else self.card.command(datagram, self.wire_s())
        if code == Code.CONFIGURE_FPGA:
            self._deaf_until_s = self._clock_s() + self._faults.deaf_ms * 1e-3
        if bits := self._command_faults.status_after(code):
            more.append(message(Code.STATUS, bits))
        if isinstance(reply, Message) and self._command_faults.reply_arrives():
            self.counts["replies"] += 1
            delay_s = self._faults.reply_delay_ms * 1e-3
            self.sender.reply(reply.payload, self._clock_s() + delay_s if delay_s else None)
        self.emit(more)

    def emit(self, outputs: Sequence[Output], link_is_up: bool = True) -> None:
        """Send what the card puts out, through the faults of the network."""
        for output in outputs:
            if isinstance(output, Message):
                if not self.card.recording:
                    for rows in self._network_faults.drain():
                        self.sender.put_packets(rows)
                if link_is_up:
                    self.counts["statuses"] += 1
                    self.sender.put_status(output.payload)
                else:
                    self.counts["link_down_statuses"] += 1
            else:
                self._emit_packets(output, link_is_up)

    def _emit_packets(self, packets: Packets, link_is_up: bool) -> None:
        n, payload_bytes = len(packets.rows), packets.payload_bytes
        self.counts["packets_made"] += n
        self.counts["bytes_made"] += payload_bytes
        if link_is_up:
            for rows in self._network_faults.carry(packets.rows):
                self.sender.put_packets(rows)
        else:
            self._network_faults.skip(packets.rows)
            self.counts["link_down_packets"] += n
            self.counts["link_down_bytes"] += payload_bytes

    @property
    def due(self) -> bool:
        """Whether the record ends now if nothing more comes."""
        deadline_s = self.card.deadline_s
        return deadline_s is not None and self.wire_s() >= deadline_s

    def tick(self, link_is_up: bool = True) -> None:
        """End the record when its time has come."""
        self.emit(self.card.tick(self.wire_s()), link_is_up)

    def flush(self) -> float | None:
        """Send what may be sent now; seconds until there is more to do, None when all is sent."""
        return self.sender.flush(self._clock_s, self.card.packet_delay_s / self._time_scale)

    def _keep_sender_counts(self) -> None:
        for key, value in self.sender.counts().items():
            self.counts[key] += value

    def report(self) -> dict[str, int | None]:
        """Everything counted so far."""
        report: dict[str, int | None] = dict(self.counts)
        for key, value in self.sender.counts().items():
            report[key] = self.counts[key] + value
        report["records"] = self.card.records
        report["dropped_by_receiver"] = self.sender.dropped_by_receiver()
        return report

    def close(self) -> None:
        """Close the sockets."""
        self._commands.close()
        self.sender.close()
