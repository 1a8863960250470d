"""Power is lost at each disk operation: everything synced is on the disk, and the disk has a prefix of the events."""

import os
from typing import Any

import pytest
from tests.support.store.faulty_disk import FaultyDisk, Killed

from polysight_pi.journal import Journal, NewEvent
from polysight_shared import messages as m
from polysight_shared.raster import RasterPlan

PLAN = RasterPlan(3, 2, 1.0, 1.0)


def make_events() -> list[tuple[type[m.AnyEvent], dict[str, Any]]]:
    """Return the events of a scan of two rows with three points each: types and fields."""
    scan: list[tuple[type[m.AnyEvent], dict[str, Any]]] = [(m.RunStarted, {"plan": PLAN})]
    for row in PLAN:
        scan.append((m.RowStarted, {"row": row, "take": 1}))
        for k in range(row.points):
            places = {"point": k, "column": k, "edge_ns": k, "first_pulse_ns": k, "last_pulse_ns": k}
            burst = {"pulses": 1, "width_max_ns": 1, "jitter_ns": 0}
            scan.append((m.Capture, {"row_index": row.index, "take": 1, **places, **burst}))
        counts = dict.fromkeys(("points", "edges", "bursts", "pulses"), 3)
        scan.append((m.RowFinished, {"row_index": row.index, "take": 1, "status": "done", **counts}))
    return [*scan, (m.RunStopped, {"exit_status": "success"})]


def is_same_event(event: m.AnyEvent, other: tuple[type[m.AnyEvent], dict[str, Any]]) -> bool:
    return type(event) is other[0] and getattr(event, "point", 0) == other[1].get("point", 0)


@pytest.mark.parametrize("seed", range(5))
def test_what_was_synced_survives_a_power_cut_at_any_moment(tmp_path, seed):
    """Power is lost at the first disk operation, then at the second, until the scan comes to its end.

    The disk keeps all that was synced, and a random part of what was written after it (`seed`).
    """
    position = 0
    ended = False
    added = make_events()
    while not ended:
        position += 1
        path = tmp_path / str(position)
        published = []
        journal = Journal(path, lambda raws, out=published: out.extend(map(m.unpack_event, raws)))
        try:
            with FaultyDisk(path, "power cut", position, seed)():
                journal.open("s", PLAN, 0)
                for event in added:
                    journal.write([NewEvent.now(event[0], **event[1])])
                journal.close()
            ended = True
        except Killed:
            pass
        if not ended:
            # The end of the process would release its lock of the folder.
            os.close(journal._lock)
        reopened = Journal(path)
        reopened.open("s", PLAN, 0)
        events_kept = [m.unpack_event(raw) for raw in reopened.read("s", 1, 1000)[0]]
        assert [e.seq for e in events_kept] == list(range(1, len(events_kept) + 1))
        assert all(map(is_same_event, events_kept, added)), "a prefix of what was added"
        synced = max((e.seq for e in published if not isinstance(e, m.Capture)), default=0)
        assert len(events_kept) >= synced, "what was published as synced is on the disk"
        reopened.write([NewEvent.now(added[-1][0], **added[-1][1])])
        assert reopened.last_seq == len(events_kept) + 1
        reopened.close()
    # There are more operations than events: the cuts did come in the middle.
    assert position > 20
