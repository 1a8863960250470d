"""Packets of rows with all faults of a card and a network: a byte is as sent or masked, and none is masked needlessly.

A *record* is what a card sends of one row of the scan. A state machine receives one record after another, each with
drawn faults; packets that are late in one record come with the next. The test receives 2,000 records; `--long` receives
20,000 and draws new ones.
"""

import random

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from tests.support.capture.records import FULL, HEADER_BYTES, log_packets, make_mask

from polysight.capture.dca1000 import Counters
from polysight.capture.placement import EarlierRecords, PlacedRecord, place_record
from polysight_simulators.cards import NETWORK_TROUBLES, Adversary, SentRecord

# Records of one run of the state machine.
STEPS = 20
# Bytes of a frame, and frames of a row. A packet has 1456 bytes.
GRIDS = [
    # Rows that end in a full packet.
    (64, 91),
    (64, 910),
    (4096, 91),
    # Rows that end in a shorter one.
    (4096, 48),
    (4096, 160),
    # One packet, and two.
    (128, 5),
    (128, 12),
    # Full packets only: one, and seven.
    (1456, 1),
    (1456, 7),
    (512, 30),
]
# Perfect records that may be refused in sequence, whatever has happened before. If the card has restarted without
# notice, the counters of the next record do not fit the expected ones; it is refused, and the host resets the card.
MAX_REFUSED = 1
# Numbers of values of the card's counters, which continue with 0 after the largest: bytes and packets sent before.
BYTE_COUNTS = 2**48
SEQUENCE_NUMBERS = 2**32
# Bytes of the sequence number, before the byte count in the header of a packet
SEQUENCE_BYTES = 4


def count_wrong_bytes(sent: SentRecord, placed: PlacedRecord, out: np.ndarray) -> int:
    """Return the number of bytes that are not masked and are not those of the row."""
    mask = make_mask(out.size, placed.missing)
    truth = np.frombuffer(sent.data, dtype=np.uint8)
    return int((out[~mask] != truth[~mask]).sum())


def read_byte_count(packet: bytes) -> int:
    """Return the number of bytes that the card had sent before this packet, from the packet's header."""
    return int.from_bytes(packet[SEQUENCE_BYTES:HEADER_BYTES], "little")


class Rows(RuleBasedStateMachine):
    """A receiver and a card with all faults."""

    @initialize(
        grid=st.sampled_from(GRIDS),
        seed=st.integers(0, 2**32 - 1),
        is_fresh=st.booleans(),
        is_near_wrap=st.booleans(),
    )
    def begin(self, grid, seed, is_fresh, is_near_wrap):
        """Draw the card's counters: those after a reset, some that soon begin again at 0, or any."""
        self.frame_bytes, self.frames = grid
        self.row_bytes = self.frame_bytes * self.frames
        rng = random.Random(seed)
        if is_fresh:
            count = 0
            sequence = 1
        elif is_near_wrap:
            # A row has 640 to 655,360 bytes in 1 to 451 packets: the counters wrap within one row or after some.
            count = BYTE_COUNTS - rng.randint(1, 40_000)
            sequence = SEQUENCE_NUMBERS - rng.randint(1, 60)
        else:
            count = rng.randrange(BYTE_COUNTS)
            sequence = rng.randrange(SEQUENCE_NUMBERS)
        self.card = Adversary(rng, self.frame_bytes, count, sequence)
        self.past = EarlierRecords(Counters(count, sequence))
        # True if the start of the next record is known.
        self.start_is_known = True
        # Perfect records that were refused in sequence.
        self.refused = 0

    def take(self, troubles: tuple[str, ...], batch: int, pulses_known: bool) -> tuple[SentRecord, PlacedRecord]:
        """Send a record with these troubles, place its packets in the row, check the row, and prepare the next record.

        `batch`: packets that the receiver logs together; `pulses_known`: whether the receiver knows when the row's
        first pulse was sent, so that it leaves out packets that came before.
        """
        sent = self.card.record(self.frames, troubles)
        log = log_packets(sent, self.row_bytes, batch)
        not_before_ns = 0
        if pulses_known:
            not_before_ns = sent.not_before_ns
        placed, out = place_record(log, self.frame_bytes, self.past, not_before_ns)
        assert count_wrong_bytes(sent, placed, out) == 0, (troubles, placed.reason)
        if placed.located:
            # Masked bytes are 0.
            assert not out[make_mask(out.size, placed.missing)].any()
        # Each packet is counted once, under one name.
        c = placed.counts
        well_formed = c.placed + c.duplicates + c.conflicting + c.leftover + c.restarted + c.outside + c.disagreeing
        assert well_formed + c.malformed == len(sent.arrivals)
        self.check_mask(sent, placed)
        self.past = placed.past
        self.start_is_known = placed.located
        # Without a known start the host resets the card before the next row.
        if placed.past.lost:
            self.card.reset_by_host()
            self.past = EarlierRecords.after_reset()
        return sent, placed

    def check_mask(self, sent: SentRecord, placed: PlacedRecord) -> None:
        """If the start is known and the card sent one complete record, exactly the lost bytes are masked."""
        # A complete row is right: its bytes were compared before.
        if placed.complete:
            return
        # With these faults also received bytes may be masked.
        spoiling_troubles = {"truncate", "turn_header_bit", "two_paths", "reset_between"}
        start_is_sure = self.start_is_known and self.past.start and self.card.resets == 0
        if not start_is_sure or not sent.is_complete or spoiling_troubles & {*sent.troubles}:
            return
        # Places in the row, in bytes, at which received packets begin.
        start = self.past.start.byte_count
        received_offsets = set()
        for arrival in sent.arrivals:
            if arrival.record == sent.number:
                received_offsets.add((read_byte_count(arrival.packet) - start) % BYTE_COUNTS)
        # The end of the record is known if its last packet came. Rows of a single packet are not judged here.
        end_has_come = max(received_offsets, default=0) + FULL >= self.row_bytes
        has_several_packets = self.row_bytes > FULL
        if end_has_come and has_several_packets:
            assert placed.located, placed.reason
            lost_offsets = [offset for offset in range(0, self.row_bytes, FULL) if offset not in received_offsets]
            lost_ranges = [(offset, min(offset + FULL, self.row_bytes)) for offset in lost_offsets]
            masked_bytes = make_mask(self.row_bytes, placed.missing)
            assert (masked_bytes == make_mask(self.row_bytes, lost_ranges)).all()

    @rule(
        troubles=st.lists(st.sampled_from(NETWORK_TROUBLES), min_size=1, max_size=3, unique=True).map(tuple),
        batch=st.sampled_from([1, 7, 64]),
        pulses_known=st.booleans(),
    )
    def take_disturbed(self, troubles, batch, pulses_known):
        self.take(troubles, batch, pulses_known)
        self.refused = 0

    @rule(batch=st.sampled_from([1, 7, 64]))
    def perfect(self, batch):
        """A record without faults of its own; leftovers of others may come among its packets."""
        start_is_sure = self.start_is_known and self.past.start is not None and self.card.resets == 0
        sent, placed = self.take((), batch, pulses_known=True)
        foreign_arrivals = [arrival for arrival in sent.arrivals if arrival.record != sent.number]
        # The receiver leaves out packets that came before the first pulse. Later ones disturb this record.
        has_leftovers = any(arrival.t_ns >= sent.not_before_ns for arrival in foreign_arrivals)
        if start_is_sure:
            assert placed.complete, placed.reason
        if placed.complete or has_leftovers:
            self.refused = 0
        else:
            self.refused += 1
        assert self.refused <= MAX_REFUSED, placed.reason

    @rule()
    def resume(self):
        """The host's program is started again: it has no state, and resets the card."""
        self.card.reset_by_host()
        self.past = EarlierRecords.after_reset()
        self.start_is_known = True
        self.refused = 0


def test_no_byte_is_wrong_and_none_is_masked_without_reason(request: pytest.FixtureRequest):
    is_long = request.config.getoption("--long")
    records = 20_000 if is_long else 2_000
    run_state_machine_as_test(
        Rows,
        settings=settings(
            max_examples=records // STEPS,
            stateful_step_count=STEPS,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=list(Phase) if is_long else [Phase.generate, Phase.shrink],
        ),
    )
