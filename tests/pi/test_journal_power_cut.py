"""Power is lost at each disk operation of a journal.

Afterwards the journal has all events that were synced. What it has is the beginning of the sequence of events.
"""

import os
from typing import Any

import pytest
from tests.support.store.faulty_disk import FaultyDisk, Killed

from polysight_pi.journal import Journal, NewEvent
from polysight_shared import messages as m
from polysight_shared.raster import RasterPlan

PLAN = RasterPlan(columns=3, rows=2, step_x_mm=1.0, step_y_mm=1.0)


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
    other_type, other_fields = other
    return type(event) is other_type and getattr(event, "point", 0) == other_fields.get("point", 0)


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
                journal.open("s", PLAN, host_seq=0)
                for event_type, fields in added:
                    journal.write([NewEvent.now(event_type, **fields)])
                journal.close()
            ended = True
        except Killed:
            pass
        if not ended:
            # The end of the process would release its lock of the folder.
            os.close(journal._lock)
        reopened = Journal(path)
        reopened.open("s", PLAN, host_seq=0)
        stored, _ = reopened.read("s", from_seq=1, limit=1000)
        events_kept = [m.unpack_event(raw) for raw in stored]
        assert [e.seq for e in events_kept] == list(range(1, len(events_kept) + 1))
        assert all(map(is_same_event, events_kept, added)), "a prefix of what was added"
        synced = max((e.seq for e in published if not isinstance(e, m.Capture)), default=0)
        assert len(events_kept) >= synced, "what was published as synced is on the disk"
        last_type, last_fields = added[-1]
        reopened.write([NewEvent.now(last_type, **last_fields)])
        assert reopened.last_seq == len(events_kept) + 1
        reopened.close()
    # There are more operations than events: the cuts did come in the middle.
    assert position > 20
