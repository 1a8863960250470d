"""Scans in which boards miss pulses: the row is retaken, or kept with each frame at its pulse or masked."""

import numpy as np
import pytest
from tests.support.acquisition.fake_rig import PI_AHEAD_NS, FakeRig
from tests.support.store.facts import load_facts
from tests.support.store.plain_scan import list_errors

from polysight.acquisition import pulse_times
from polysight.acquisition.pulse_times import ReceivedCapture
from polysight.acquisition.scan import run_scan
from polysight.capture.dca1000 import Code
from polysight.capture.row_files import read_index

POINTS = 8
PULSES = 6
# Number of the last pulse of a row; they count from 0.
LAST_PULSE = POINTS * PULSES - 1


@pytest.fixture
def timed_rig(make_instrument, monkeypatch, request):
    """A rig with rows of 8 points and 6 pulses; the parameter of the fixture is the number of a row's retakes.

    Data and events carry their times of arrival, so that the load of this machine has no influence.
    """
    retakes = getattr(request, "param", 1)
    fake = FakeRig(make_instrument(columns=POINTS, rows=2, pulses=PULSES, row_retakes=retakes))
    fake.start()
    fake.pi.send_frame_by_frame = True

    def receive_in_time(event, _):
        # Events arrive a millisecond after the last pulse.
        last_pulse_ns = event.last_pulse_ns - PI_AHEAD_NS
        return ReceivedCapture(event, last_pulse_ns + 1_000_000)

    def read_timed_index(path):
        facts, arrivals = read_index(path)
        times_ns = fake.cards[path.parent.name].arrivals_ns
        return facts, np.array([(times_ns[count], count) for count in arrivals[:, 1].tolist()])

    monkeypatch.setattr(pulse_times, "ReceivedCapture", receive_in_time)
    monkeypatch.setattr(pulse_times, "read_index", read_timed_index)
    yield fake
    fake.close()


def check_unmasked(result, payload, name: str) -> np.ndarray:
    """Check that every byte of row 0 is right or masked; return the mask, bool [frame, byte]."""
    data = result.folder.read_row(name, 0)
    truth = np.frombuffer(payload(name, 0, result.folder.instrument.row_bytes), dtype=np.uint8)
    mask = np.zeros(truth.size, dtype=bool) if data.mask is None else data.mask
    np.testing.assert_array_equal(data.payload[~mask], truth[~mask])
    return mask.reshape(POINTS * PULSES, -1)


@pytest.mark.parametrize("timed_rig", [3], indirect=True)
def test_a_row_with_missed_pulses_is_retaken(timed_rig, payload, tmp_path):
    row = 0
    takes_with_missed_pulses = (1, 2, 3)
    for take in takes_with_missed_pulses:
        timed_rig.cards["RH"].missed[row, take] = {20}
        timed_rig.cards["RV"].missed[row, take] = {0, LAST_PULSE}
    result = run_scan(timed_rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    assert result.retakes == len(takes_with_missed_pulses)
    for fact in load_facts(result.folder, "row_rejected"):
        assert fact["row"] == 0
        assert [fault["kind"] for fault in fact["faults"]] == ["pulses_missed"] * 2
        assert all("SYNC_IN" in reason for reason in fact["reasons"])
    for name in ("RH", "RV"):
        assert not check_unmasked(result, payload, name).any()


def test_an_incomplete_row_that_is_kept_has_each_frame_at_its_pulse_or_masked(timed_rig, payload, tmp_path):
    row = 0
    missed = {"RH": {20}, "RV": {0, 30, 31, LAST_PULSE}}
    for name, pulses in missed.items():
        for take in (1, 2):
            timed_rig.cards[name].missed[row, take] = pulses
    result = run_scan(timed_rig.instrument, tmp_path / "s", keep_incomplete=True)
    assert result.exit_status == "success"
    assert result.incomplete_rows == [row]
    assert list_errors(result.folder.path) == []
    for name, pulses in missed.items():
        assert check_unmasked(result, payload, name)[sorted(pulses)].all()
        assert load_facts(result.folder, "row_committed")[0]["boards"][name]["pulses_missed"] == len(pulses)


def test_a_card_is_reset_after_a_row_whose_frames_came_at_other_times(timed_rig, tmp_path):
    """A spurious edge starts a frame before pulse 20, and the last pulse gets none: the record's length is right."""
    row = 0
    take = 1
    timed_rig.cards["RH"].extra[row, take] = 20
    result = run_scan(timed_rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    assert result.retakes == 1
    # Each card is reset at the start, and RH once more before the retake.
    resets = {name: card.codes_received.count(Code.RESET_FPGA) for name, card in timed_rig.cards.items()}
    assert resets == {"RH": 2, "RV": 1}
