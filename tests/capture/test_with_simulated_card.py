"""The receiver and the control client against the simulated card, through sockets: original or masked, and counted."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from polysight.host.capture.card import CardClient
from polysight.host.capture.dca1000 import Status
from polysight.host.capture.receiver import ReceiverProcess
from polysight.shared.config import Card
from polysight.simulators.faults import Faults
from tests.support.processes import wait_for

SIZE = 300 * 4096 + 1300  # ends with a short packet
FULL = 1456
LIMIT_S = 60.0
FRESH, WRAPPING = (1, 0), (2**32 - 20, 2**48 - 100_000)  # sequence, byte count
EVERYTHING = {"loss": 0.02, "duplicate": 0.02, "reorder": 0.02, "late": 0.02, "truncate": 0.02, "corrupt_header": 0.02}


@pytest.fixture
def recording(tmp_path) -> Path:
    path = tmp_path / "recording.bin"
    # no zero bytes, so that a wrongly zeroed byte shows
    np.random.default_rng(2).integers(1, 256, SIZE, dtype=np.uint8).tofile(path)
    return path


def records(rig, folder, count=2):
    """Rows received of a card that plays the recording, one record each, until the card says that each is completed."""
    board = rig.by_name("RH")
    with CardClient(board, 5.0) as card, ReceiverProcess(board, 4 << 20) as receiver:
        card.alive()
        card.configure(Card(packet_delay_us=5.0))
        for k in range(count):
            path = folder / f"{k}.bin"
            receiver.begin_row(k, 1, SIZE, 4096, path)
            card.record_start()
            wait_for(lambda: Status.RECORD_COMPLETED in card.take_status(), "packets")
            yield receiver.end_row(card.take_status()), np.fromfile(path, dtype=np.uint8)


@pytest.mark.parametrize(
    ("faults", "counters"),
    [
        ({"loss": 0.05}, WRAPPING),
        ({"duplicate": 0.05}, WRAPPING),
        ({"reorder": 0.05, "late": 0.02, "late_packets": 40}, WRAPPING),
        ({"truncate": 0.03}, WRAPPING),
        (EVERYTHING, FRESH),
        (EVERYTHING, WRAPPING),
    ],
)
def test_original_or_masked_through_real_sockets(cards, rig, recording, tmp_path, faults, counters):
    """Whatever the network does to the packets, from whatever counters: what is not masked is what was recorded."""
    first = {"first_sequence": counters[0], "first_byte_count": counters[1]}
    made = cards("RH", streams=recording, time_scale=20.0, RH=Faults(**faults, **first))
    truth = np.fromfile(recording, dtype=np.uint8)
    got = list(records(rig, tmp_path))
    for row, data in got:
        kept = np.ones(SIZE, dtype=bool)
        for start, stop in row.missing:
            kept[start:stop] = False
            assert start < stop
        assert all(a[1] < b[0] for a, b in pairwise(row.missing))
        assert np.array_equal(data[kept], truth[kept])
        assert row.kernel_drops == row.strangers == 0
        if row.located:
            assert not data[~kept].any()
    counts = made.endpoints["RH"].counts
    rows = [row for row, _ in got]
    if set(faults) == {"loss"}:
        assert sum(SIZE - row.bytes for row in rows) == counts["lost_bytes"] > 0
    if set(faults) == {"duplicate"}:
        assert sum(row.duplicates for row in rows) == counts["duplicated"] > 0
        assert all(row.complete for row in rows)
    if set(faults) <= {"reorder", "late", "late_packets"}:
        assert sum(row.late for row in rows) >= counts["reordered"] // 2 + counts["late"] // 2 > 0
        assert all(row.complete for row in rows)
    if set(faults) == {"truncate"}:
        assert sum(SIZE - row.bytes for row in rows) == counts["truncated_bytes"] > 0
