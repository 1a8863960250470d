"""Event files are read up to their first damage, and the damaged event is named."""

import pytest

from polysight.store.logs import parse_events
from polysight_shared.messages import AnyEvent, RunStopped, pack_with_crc


def make_event(seq: int) -> AnyEvent:
    return RunStopped(scan_id="s", seq=seq, t_mono_ns=seq, exit_status="success")


GOOD = [make_event(seq) for seq in (1, 2)]
RAW = b"".join(map(pack_with_crc, GOOD))
THIRD = pack_with_crc(make_event(3))


def test_whole_events_are_neither_torn_nor_damaged():
    log = parse_events(RAW)
    assert (log.events, log.length, log.torn, log.damage) == (GOOD, len(RAW), False, "")
    assert parse_events(b"").events == []


@pytest.mark.parametrize("tail", [THIRD[:-1], THIRD[:1], THIRD[:5] + bytes(7), bytes(3)])
def test_the_beginning_of_an_event_or_zeros_are_torn(tail):
    log = parse_events(RAW + tail)
    assert (log.events, log.length, log.torn, log.damage) == (GOOD, len(RAW), True, "")


def test_a_damaged_event_is_numbered_from_1_and_ends_the_file():
    changed = bytearray(THIRD)
    changed[-1] ^= 1
    log = parse_events(RAW + changed + THIRD)
    assert (log.events, log.length, log.torn) == (GOOD, len(RAW), False)
    assert log.damage.startswith("event 3 is damaged: ")
    # 0xC1 begins nothing in msgpack.
    assert parse_events(RAW + b"\xc1" * 9).damage == f"event 3 is damaged: not msgpack at byte {len(RAW)}"
