"""Rows with all faults of a card and a network: data is original or masked, and not masked without reason.

A state machine takes one record after another, each with drawn faults; leftovers of a record come with the
next. 2,000 records; `--long` takes 20,000 and draws new ones.
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

STEPS = 20
# Bytes of a frame, frames of a row
GRIDS = [
    (64, 91),  # ends in a full packet
    (64, 910),
    (4096, 91),
    (4096, 48),
    (4096, 160),
    (128, 5),  # one packet
    (128, 12),
    (1456, 1),  # one full packet
    (1456, 7),
    (512, 30),
]
# Perfect records in a row, after anything that may have happened
MAX_REFUSED = 1


def count_wrong_bytes(sent: SentRecord, placed: PlacedRecord, out: np.ndarray) -> int:
    """Bytes that are not masked and are not those of the row."""
    mask = make_mask(out.size, placed.missing)
    assert not placed.located or not out[mask].any()
    return int((out[~mask] != np.frombuffer(sent.data, dtype=np.uint8)[~mask]).sum())


class Rows(RuleBasedStateMachine):
    """A receiver and a card with all faults."""

    @initialize(
        grid=st.sampled_from(GRIDS),
        seed=st.integers(0, 2**32 - 1),
        fresh=st.booleans(),
        near_wrap=st.booleans(),
    )
    def begin(self, grid, seed, fresh, near_wrap):
        self.frame, self.frames = grid
        self.size = self.frame * self.frames
        rng = random.Random(seed)
        if fresh:
            count = 0
        elif near_wrap:
            count = 2**48 - rng.randint(1, 40_000)
        else:
            count = rng.randrange(2**48)
        if fresh:
            sequence = 1
        elif near_wrap:
            sequence = 2**32 - rng.randint(1, 60)
        else:
            sequence = rng.randrange(2**32)
        self.card = Adversary(rng, self.frame, count, sequence)
        self.past = EarlierRecords(Counters(count, sequence))
        # The next record's start is known
        self.sure = True
        self.refused = 0

    def take(self, troubles: tuple[str, ...], batch: int, pulses_known: bool) -> tuple[SentRecord, PlacedRecord]:
        sent = self.card.record(self.frames, troubles)
        log = log_packets(sent, self.size, batch)
        placed, out = place_record(log, self.frame, self.past, sent.not_before_ns if pulses_known else 0)
        assert count_wrong_bytes(sent, placed, out) == 0, (troubles, placed.reason)
        c = placed.counts
        named = c.placed + c.duplicates + c.conflicting + c.leftover + c.restarted + c.outside + c.disagreeing
        assert named + c.malformed == len(sent.arrivals)
        self.check_mask(sent, placed)
        self.past = placed.past
        self.sure = placed.located
        if placed.past.lost:  # as the host does before the next row
            self.card.reset_by_host()
            self.past = EarlierRecords.after_reset()
        return sent, placed

    def check_mask(self, sent: SentRecord, placed: PlacedRecord) -> None:
        """If the start is known and the card sent one complete record, exactly the lost bytes are masked."""
        if placed.complete:  # and right, as was seen before
            return
        spoils = {"truncate", "turn_header_bit", "two_paths", "reset_between"}
        if not (self.sure and self.past.start and sent.is_complete and self.card.resets == 0) or spoils & {
            *sent.troubles
        }:
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
        sure = self.sure and self.past.start is not None and self.card.resets == 0
        sent, placed = self.take((), batch, pulses_known=True)
        alone = all(a.record == sent.number or a.t_ns < sent.not_before_ns for a in sent.arrivals)
        if sure:
            assert placed.complete, placed.reason
        self.refused = 0 if placed.complete or not alone else self.refused + 1
        assert self.refused <= MAX_REFUSED, placed.reason

    @rule()
    def resume(self):
        """The host's program is started again: it has no state, and resets the card."""
        self.card.reset_by_host()
        self.past = EarlierRecords.after_reset()
        self.sure = True
        self.refused = 0


def test_no_byte_is_wrong_and_none_is_masked_without_reason(request: pytest.FixtureRequest):
    records = 20_000 if request.config.getoption("--long") else 2_000
    run_state_machine_as_test(
        Rows,
        settings=settings(
            max_examples=records // STEPS,
            stateful_step_count=STEPS,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=[Phase.generate, Phase.shrink] if not request.config.getoption("--long") else list(Phase),
        ),
    )
