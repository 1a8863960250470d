"""A scan in which boards miss pulses: found, named, taken again; or kept, each frame at its pulse or masked."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from host.scan.run import run_scan
from host.store.validate import validate

POINTS, PULSES = 8, 6


@pytest.fixture
def paced(make_instrument):
    """Rows of 8 points and 6 pulses, their frames sent at the times of their pulses."""
    from .conftest import FakeRig

    made = make_instrument(row_retakes=1)
    grid = msgspec.structs.replace(made.grid, columns=POINTS, rows=2)
    burst = msgspec.structs.replace(made.burst, pulses=PULSES)
    fake = FakeRig(msgspec.structs.replace(made, grid=grid, burst=burst))
    fake.start()
    fake.pi.paced = True
    yield fake
    fake.close()


def test_missed_pulses_are_found_and_the_row_is_taken_again(paced, payload, tmp_path):
    paced.cards["RH"].missed[0, 1] = {20}
    paced.cards["RV"].missed[0, 1] = {0, 47}
    result = run_scan(paced.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 1)
    reasons = result.folder.facts("row_rejected")[0]["reasons"]
    assert any(r.startswith("RH") and "SYNC_IN" in r for r in reasons)
    assert any(r.startswith("RV") and "SYNC_IN" in r for r in reasons)
    assert result.folder.read_row("RH", 0).payload.tobytes() == payload("RH", 0, paced.instrument.row_bytes)


def test_row_that_is_kept_has_each_frame_at_its_pulse_or_masked(paced, payload, tmp_path):
    missed = {"RH": {20}, "RV": {0, 30, 31, 47}}
    for name, slots in missed.items():
        for take in (1, 2):
            paced.cards[name].missed[0, take] = slots
    result = run_scan(paced.instrument, tmp_path / "s", keep_incomplete=True)
    assert (result.exit_status, result.incomplete_rows) == ("success", [0])
    assert [f for f in validate(tmp_path / "s") if f.severity == "error"] == []
    frame = paced.instrument.frame_bytes
    for name, slots in missed.items():
        data = result.folder.read_row(name, 0)
        want = np.frombuffer(payload(name, 0, paced.instrument.row_bytes), dtype=np.uint8)
        assert data.mask is not None
        assert data.mask.reshape(-1, frame)[sorted(slots)].all()
        np.testing.assert_array_equal(data.payload[~data.mask], want[~data.mask])
        if not data.mask.all():
            assert not data.payload[data.mask].any()
        fact = result.folder.facts("row_committed")[0]["boards"][name]
        assert fact["pulses_missed"] == len(slots)
