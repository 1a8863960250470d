"""The simulated card sends the LVDS data that it receives, for any order of commands, data and pauses.

Codes of commands: 0x01 reset, 0x03 configure, 0x05 start, 0x06 stop, 0x0A status, 0x0B packets.
"""

import struct

import numpy as np
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from polysight_simulators.cards.dca1000 import TAIL_S, Card, Message, Network, Output, Packets, Status, make_message

HOME = Network("192.168.33.30", "192.168.33.180", bytes.fromhex("123456789012"), 4096, 4098)
# The card ends a record without data after this time.
NO_DATA_TIMEOUT_S = 30.0
# Statuses with which a record ends.
ENDS = {Status.RECORD_COMPLETED, Status.NO_LVDS_DATA}


def request(code: int, body: bytes = b"") -> bytes:
    return struct.pack("<HHH", 0xA55A, code, len(body)) + body + b"\xaa\xee"


class AnyUse(RuleBasedStateMachine):
    """The card compared with a model: the bytes that it received and sent, and whether it records.

    `lanes_match` is False while the card is configured for another number of lanes than the LVDS data has.
    """

    @initialize(
        sequence=st.sampled_from([1, 77, 2**32 - 2]),
        count=st.sampled_from([0, 12345, 2**48 - 3000]),
    )
    def switch_on(self, sequence: int, count: int) -> None:
        self.card = Card(HOME, sequence, count)
        self.sequence = sequence
        self.count = count
        self.now = 0.0
        self.recording = False
        self.lanes_match = True
        self.payload = 1456
        # Bytes of the record that the card received, and that the host received from it.
        self.given = b""
        self.received = b""
        self.last_data: float | None = None
        self.next_byte = 0
        self.sizes: list[int] = []

    def compare(self, outputs: list[Output], ends: bool) -> None:
        """Compare the card's packets and messages with the model; `ends`: True if the record ends with them."""
        packets = [row.tobytes() for o in outputs if isinstance(o, Packets) for row in o.rows]
        assert self.recording or not packets, "data outside a record"
        for packet in packets:
            sequence, low, high = struct.unpack_from("<IIH", packet)
            assert (sequence, low | high << 32) == (self.sequence, self.count)
            size = len(packet) - 10
            assert 0 < size <= self.payload
            self.sequence = (sequence + 1) % 2**32
            self.count = (self.count + size) % 2**48
            self.received += packet[10:]
            self.sizes.append(size)
        statuses = [o.payload for o in outputs if isinstance(o, Message) and o.payload[2:4] == b"\x0a\x00"]
        if ends:
            assert self.received == self.given, "bytes lost or invented"
            assert statuses
            assert outputs[-1] in [Message(make_message(0x0A, s).payload) for s in ENDS]
            assert sum(s < self.payload for s in self.sizes) <= 1, "more than one short packet in a record"
            assert all(s == self.payload for s in self.sizes[:-1])
            self.recording = False
        else:
            assert not statuses
            assert not self.recording or all(s == self.payload for s in self.sizes)

    def begin(self) -> None:
        self.recording = True
        self.last_data = None
        self.given = b""
        self.received = b""
        self.sizes = []

    @rule()
    def start(self) -> None:
        outputs = self.card.command(request(0x05), self.now)
        if not self.recording:
            self.begin()
        self.compare(outputs, ends=False)

    @rule()
    def stop(self) -> None:
        outputs = self.card.command(request(0x06), self.now)
        assert outputs[0] == make_message(0x06, 0)
        self.compare(outputs[1:], ends=self.recording)

    @rule(n=st.integers(0, 9000))
    def data(self, n: int) -> None:
        fresh = ((np.arange(n) + self.next_byte) % 251).astype(np.uint8)
        self.next_byte += n
        outputs = self.card.process_lvds(fresh, self.now)
        if self.recording and self.lanes_match:
            self.given += fresh.tobytes()
            self.last_data = self.now
        self.compare(outputs, ends=False)

    @rule(seconds=st.sampled_from([0.001, 0.5, TAIL_S, 31.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds
        # A record ends 30 s after its start if no data came, otherwise `TAIL_S` after the last data.
        if self.last_data is None:
            end_s = self.started + NO_DATA_TIMEOUT_S
        else:
            end_s = self.last_data + TAIL_S
        self.compare(self.card.tick(self.now), ends=self.recording and self.now >= end_s)

    @rule(code=st.sampled_from([0x02, 0x09, 0x0A, 0x0E, 0x07, 0x77]), body=st.binary(max_size=8))
    def ask(self, code: int, body: bytes) -> None:
        (reply,) = self.card.command(request(code, body), self.now)
        assert isinstance(reply, Message)
        assert reply.payload[2:4] == struct.pack("<H", code)

    @rule(body=st.sampled_from(["01010102031e", "01020102031e", "c005350c0000", "0101", ""]))
    @precondition(lambda self: not self.recording)
    def configure(self, body: str) -> None:
        assert self.card.command(request(0x03, bytes.fromhex(body)), self.now) == [make_message(0x03, 0)]
        if body == "01010102031e":
            self.lanes_match = True
        elif body == "01020102031e":
            self.lanes_match = False

    @rule(size=st.sampled_from([48, 1000, 1470, 1472]), ticks=st.integers(0, 5000))
    @precondition(lambda self: not self.recording)
    def pace(self, size: int, ticks: int) -> None:
        assert self.card.command(request(0x0B, struct.pack("<HHH", size, ticks, 0)), self.now) == [
            make_message(0x0B, 0)
        ]
        self.payload = min(size, 1470) - 14
        assert self.card.packet_delay_s == ticks * 8e-9

    @rule(power=st.booleans())
    def power_cycle_or_reset(self, power: bool) -> None:
        if power:
            self.card.power_cycle()
        else:
            assert self.card.command(request(0x01), self.now) == [make_message(0x01, 0)]
        self.recording = False
        self.lanes_match = True
        self.payload = 1456
        self.sequence = 1
        self.count = 0

    @property
    def started(self) -> float:
        deadline = self.card.deadline_s
        return 0.0 if deadline is None else deadline - NO_DATA_TIMEOUT_S

    @invariant()
    def the_card_knows_whether_it_records(self) -> None:
        if hasattr(self, "card"):
            assert self.card.recording == self.recording
            assert (self.card.deadline_s is None) == (not self.recording)
            assert self.given.startswith(self.received)


AnyUse.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAnyUse = AnyUse.TestCase
