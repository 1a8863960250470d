"""Rows with all faults of a card and a network: data is original or masked, and not masked without reason.

A state machine takes one record after another, each with drawn faults. Packets that are late in one record come with
the next. The test takes 2,000 records; `--long` takes 20,000 and draws new ones.
"""

import random

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from tests.support.capture.records import FULL, log_packets, make_mask

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
# Perfect records that may be refused in sequence, whatever has happened before
MAX_REFUSED = 1


def count_wrong_bytes(sent: SentRecord, placed: PlacedRecord, out: np.ndarray) -> int:
    """Return the number of bytes that are not masked and are not those of the row."""
    mask = make_mask(out.size, placed.missing)
    assert not placed.located or not out[mask].any()
    return int((out[~mask] != np.frombuffer(sent.data, dtype=np.uint8)[~mask]).sum())


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
        self.frame, self.frames = grid
        self.size = self.frame * self.frames
        rng = random.Random(seed)
        if is_fresh:
            count = 0
            sequence = 1
        elif is_near_wrap:
            count = 2**48 - rng.randint(1, 40_000)
            sequence = 2**32 - rng.randint(1, 60)
        else:
            count = rng.randrange(2**48)
            sequence = rng.randrange(2**32)
        self.card = Adversary(rng, self.frame, count, sequence)
        self.past = EarlierRecords(Counters(count, sequence))
        # True if the start of the next record is known.
        self.start_is_known = True
        # Perfect records that were refused in sequence.
        self.refused = 0

    def take(self, troubles: tuple[str, ...], batch: int, pulses_known: bool) -> tuple[SentRecord, PlacedRecord]:
        sent = self.card.record(self.frames, troubles)
        log = log_packets(sent, self.size, batch)
        placed, out = place_record(log, self.frame, self.past, sent.not_before_ns if pulses_known else 0)
        assert count_wrong_bytes(sent, placed, out) == 0, (troubles, placed.reason)
        # Each packet is counted once, under one name.
        c = placed.counts
        well_formed = c.placed + c.duplicates + c.conflicting + c.leftover + c.restarted + c.outside + c.disagreeing
        assert well_formed + c.malformed == len(sent.arrivals)
        self.check_mask(sent, placed)
        self.past = placed.past
        self.start_is_known = placed.located
        # As the host does before the next row.
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
        received_heads = {a.packet[:10] for a in sent.arrivals if a.record == sent.number}
        start = self.past.start.byte_count
        heads = {(int.from_bytes(head[4:], "little") - start) % 2**48 for head in received_heads}
        if max(heads, default=0) + FULL >= self.size and self.size > FULL:
            assert placed.located, placed.reason
            lost_ranges = [(a, min(a + FULL, self.size)) for a in range(0, self.size, FULL) if a not in heads]
            assert (make_mask(self.size, placed.missing) == make_mask(self.size, lost_ranges)).all()

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
        has_no_leftovers = all(a.record == sent.number or a.t_ns < sent.not_before_ns for a in sent.arrivals)
        if start_is_sure:
            assert placed.complete, placed.reason
        if placed.complete or not has_no_leftovers:
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
