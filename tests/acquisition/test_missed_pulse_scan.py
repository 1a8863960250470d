"""Scans in which boards miss pulses: the row is retaken, or kept with each frame at its pulse or masked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.support.acquisition.fake_rig import FakeRig
from tests.support.store.facts import facts_of
from tests.support.store.plain_scan import errors

from polysight.acquisition.scan import run_scan

POINTS, PULSES = 8, 6


@pytest.fixture
def paced(make_instrument):
    """Rows of 8 points and 6 pulses, their frames sent at the times of their pulses."""
    fake = FakeRig(make_instrument(columns=POINTS, rows=2, pulses=PULSES, row_retakes=1))
    fake.start()
    fake.pi.paced = True
    yield fake
    fake.close()


def test_missed_pulses_are_found_and_the_row_is_taken_again(paced, payload, tmp_path):
    paced.cards["RH"].missed[0, 1] = {20}
    paced.cards["RV"].missed[0, 1] = {0, 47}
    result = run_scan(paced.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 1)
    reasons = facts_of(result.folder, "row_rejected")[0]["reasons"]
    assert any(r.startswith("RH") and "SYNC_IN" in r for r in reasons)
    assert any(r.startswith("RV") and "SYNC_IN" in r for r in reasons)
    assert result.folder.read_row("RH", 0).payload.tobytes() == payload("RH", 0, paced.instrument.row_bytes)


def test_row_that_is_kept_has_each_frame_at_its_pulse_or_masked(paced, payload, tmp_path):
    missed = {"RH": {20}, "RV": {0, 30, 31, 47}}
    for name, slots in missed.items():
        for take in (1, 2):
            paced.cards[name].missed[0, take] = slots
    answer: set[str] = set()
    for number in range(20):  # a machine too busy to tell masks the whole row
        answer |= _kept(paced, payload, tmp_path / str(number), missed)
        if answer == set(missed):
            return
    pytest.fail(f"only of {sorted(answer)} were the frames told apart, in 20 scans")


def _kept(paced, payload, folder: Path, missed: dict[str, set[int]]) -> set[str]:
    """Run a scan and check row 0 of every board; return the boards whose frames could be placed."""
    paced.pi.rows_run.clear()  # the rows of the scan before
    result, answer = run_scan(paced.instrument, folder, keep_incomplete=True), set()
    assert (result.exit_status, result.incomplete_rows) == ("success", [0])
    assert errors(folder) == []
    frame = paced.instrument.frame_bytes
    for name, slots in missed.items():
        data = result.folder.read_row(name, 0)
        want = np.frombuffer(payload(name, 0, paced.instrument.row_bytes), dtype=np.uint8)
        assert data.mask is not None
        assert data.mask.reshape(-1, frame)[sorted(slots)].all()
        np.testing.assert_array_equal(data.payload[~data.mask], want[~data.mask])
        if not data.mask.all():
            assert not data.payload[data.mask].any()
            answer.add(name)
        fact = facts_of(result.folder, "row_committed")[0]["boards"][name]
        assert fact["pulses_missed"] == len(slots)
    return answer


def test_row_with_a_spurious_edge_is_not_complete(paced, payload, tmp_path):
    """A radar that counts frames sees a spurious edge: as many frames as pulses, but all behind the edge off by one."""
    for take in (1, 2):
        paced.cards["RV"].extra[0, take] = 20
    want = np.frombuffer(payload("RV", 0, paced.instrument.row_bytes), dtype=np.uint8)
    for number in range(20):  # a machine too busy to tell sees nothing, or is sure of less
        result = run_scan(paced.instrument, tmp_path / str(number), keep_incomplete=True)
        assert result.exit_status == "success"
        if result.incomplete_rows != [0]:
            continue
        fact = facts_of(result.folder, "row_rejected")[0]
        if ("slipped", "RV") not in [(f["kind"], f.get("board")) for f in fact["faults"]]:
            continue
        data = result.folder.read_row("RV", 0)
        if data.mask is None:
            continue  # not noticed in the take that was kept
        np.testing.assert_array_equal(data.payload[~data.mask], want[~data.mask])
        bursts = data.mask.reshape(POINTS * PULSES, -1)
        assert bursts[18:24].all(), "its own"
        if not bursts[:16].any() and data.mask.mean() < 0.5:  # frames beside it are not sure either
            break
    else:
        pytest.fail("not noticed, or not placed, in 20 scans")
    assert errors(tmp_path / str(number)) == []
