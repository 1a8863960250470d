"""Scans in which boards miss pulses: the row is retaken, or kept with each frame at its pulse or masked."""

from __future__ import annotations

import numpy as np
import pytest
from tests.support.acquisition.fake_rig import FakeRig
from tests.support.store.facts import facts_of
from tests.support.store.plain_scan import errors

from polysight.acquisition.scan import run_scan

POINTS = 8
PULSES = 6


@pytest.fixture
def paced_rig(make_instrument, request):
    """Rows of 8 points and 6 pulses, frames sent at the times of their pulses; the parameter: a row's retakes."""
    retakes = getattr(request, "param", 1)
    fake = FakeRig(make_instrument(columns=POINTS, rows=2, pulses=PULSES, row_retakes=retakes))
    fake.start()
    fake.pi.paced = True
    yield fake
    fake.close()


def check_unmasked(result, payload, name: str) -> np.ndarray:
    """Check that every byte of row 0 is right or masked; return the mask, bool [frame, byte]."""
    data = result.folder.read_row(name, 0)
    truth = np.frombuffer(payload(name, 0, result.folder.instrument.row_bytes), dtype=np.uint8)
    mask = np.zeros(truth.size, dtype=bool) if data.mask is None else data.mask
    np.testing.assert_array_equal(data.payload[~mask], truth[~mask])
    return mask.reshape(POINTS * PULSES, -1)


@pytest.mark.parametrize("paced_rig", [40], indirect=True)
def test_missed_pulses_are_found_and_the_row_is_taken_again(paced_rig, payload, tmp_path):
    # On a busy machine frames come late, and a take may be rejected for that before its pulses are looked at.
    for take in range(1, 4):
        paced_rig.cards["RH"].missed[0, take] = {20}
        paced_rig.cards["RV"].missed[0, take] = {0, 47}
    result = run_scan(paced_rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    rejected = [fact for fact in facts_of(result.folder, "row_rejected") if fact["row"] == 0]
    assert len(rejected) >= 3
    reasons = [reason for fact in rejected for reason in fact["reasons"]]
    assert any(r.startswith("RH") and "SYNC_IN" in r for r in reasons)
    assert any(r.startswith("RV") and "SYNC_IN" in r for r in reasons)
    for name in ("RH", "RV"):
        check_unmasked(result, payload, name)


def test_row_that_is_kept_has_each_frame_at_its_pulse_or_masked(paced_rig, payload, tmp_path):
    missed = {"RH": {20}, "RV": {0, 30, 31, 47}}
    for name, pulses in missed.items():
        for take in (1, 2):
            paced_rig.cards[name].missed[0, take] = pulses
    result = run_scan(paced_rig.instrument, tmp_path / "s", keep_incomplete=True)
    assert (result.exit_status, result.incomplete_rows) == ("success", [0])
    assert errors(result.folder.path) == []
    for name, pulses in missed.items():
        assert check_unmasked(result, payload, name)[sorted(pulses)].all()
        assert facts_of(result.folder, "row_committed")[0]["boards"][name]["pulses_missed"] == len(pulses)
