"""Power is cut at each thing that is done to the disk: what was synced is there, and what is there is a prefix."""

from __future__ import annotations

from typing import Any

import pytest

from polysight.pi_controller.journal import JournalFolder
from polysight.pi_controller.ledger import Ledger
from polysight.shared import messages as m
from polysight.shared.raster import RasterPlan
from tests.support.store.faulty_disk import FaultyDisk, Killed

PLAN = RasterPlan(3, 2, 1.0, 1.0)
NEW: dict[str, Any] = {"scan_id": "", "seq": 0, "t_mono_ns": 0}


def events() -> list[m.AnyEvent]:
    """Two rows, and the scan's end."""
    scan: list[m.AnyEvent] = [m.RunStarted(**NEW, plan=PLAN)]
    for row in PLAN:
        scan.append(m.RowStarted(**NEW, row=row, take=1))
        scan += [
            m.Capture(
                **NEW, row_index=row.index, take=1, point=k, column=k, edge_ns=k, first_pulse_ns=k, last_pulse_ns=k,
                pulses=1, width_max_ns=1, jitter_ns=0,
            )
            for k in range(row.points)
        ]  # fmt: skip
        scan.append(
            m.RowFinished(
                **NEW, row_index=row.index, take=1, status="done", points=3, edges=3, bursts=3, pulses=3
            )
        )  # fmt: skip
    return [*scan, m.RunStopped(**NEW, exit_status="success")]


def same(event: m.AnyEvent, other: m.AnyEvent) -> bool:
    return type(event) is type(other) and getattr(event, "point", 0) == getattr(other, "point", 0)


@pytest.mark.parametrize("seed", range(5))
def test_what_was_synced_survives_a_power_cut_at_any_moment(tmp_path, seed):
    at, ended, added = 0, False, events()
    while not ended:
        at += 1
        path = tmp_path / str(at)
        folder, published = JournalFolder(path), []
        ledger = Ledger(folder, lambda raws, told=published: told.extend(map(m.unpack_event, raws)))
        try:
            with FaultyDisk(path, "power cut", at, seed)():
                ledger.open("s", PLAN, 0)
                for event in added:
                    ledger.add(event)
                    ledger.commit()
                ledger.close()
            ended = True
        except Killed:
            pass
        again = Ledger(folder, lambda _: None)
        again.open("s", PLAN, 0)
        kept = again.replay("s", 1, 1000).events
        assert [e.seq for e in kept] == list(range(1, len(kept) + 1))
        assert all(map(same, kept, added)), "a prefix of what was added"
        synced = max((e.seq for e in published if not isinstance(e, m.Capture)), default=0)
        assert len(kept) >= synced, "what was published as synced is on the disk"
        again.add(added[-1])
        again.commit()
        assert again.last_seq == len(kept) + 1
        again.close()
        folder.close()
    assert at > 20
