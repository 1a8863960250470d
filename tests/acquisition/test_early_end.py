"""A row that ends early leaves no data in the cards that the next take could mistake for its own."""

from __future__ import annotations

import msgspec
import pytest

from polysight.host.acquisition.capture_rig import CaptureRig
from polysight.host.acquisition.scan import run_scan
from polysight.host.capture.dca1000 import Code
from polysight.host.store.validation import validate
from tests.support.acquisition.fake_cards import FULL, LateCard
from tests.support.acquisition.fake_rig import FakeRig

CONFIGURE = int(Code.CONFIGURE_FPGA)


@pytest.mark.parametrize("lag_ms", [0, 5, 30])
def test_take_after_a_row_that_ended_early_is_whole(make_instrument, payload, tmp_path, lag_ms):
    """One fault of the Pi in row 1. Its stopped records end some ms after the stop's reply: packet, then status."""
    made = make_instrument(end_of_record_s=10.0)
    rig = FakeRig(msgspec.structs.replace(made, grid=msgspec.structs.replace(made.grid, rows=2)))
    for board in rig.instrument.recorded:
        card = LateCard(board, rig.instrument.row_bytes, lag_ms / 1e3)
        card.cut[1, 1] = 4 * FULL + 100
        rig.cards[board.name] = card
    rig.start_pi()
    rig.pi.fail_rows[1, 1] = 103
    try:
        result = run_scan(rig.instrument, tmp_path / "s")
    finally:
        rig.close()
    assert (result.exit_status, result.retakes) == ("success", 1)
    assert [(f["row"], f["take"]) for f in result.folder.facts("row_rejected")] == [(1, 1)]
    assert result.folder.read_row("RV", 1).payload.tobytes() == payload("RV", 1, rig.instrument.row_bytes)
    assert validate(tmp_path / "s") == []


def test_card_that_sent_nothing_is_set_up_again_before_the_retake(rig, tmp_path):
    """It was without power for a moment, and answers again, but has forgotten what it was told at the start."""
    card = rig.cards["RH"]

    def answer(p) -> None:
        if (p.state, p.row, p.phase) == ("running", 1, "state"):
            card.silent_data = card.seen.count(CONFIGURE) == 1

    result = run_scan(rig.instrument, tmp_path / "s", progress=answer)
    assert (result.exit_status, result.retakes) == ("success", 1)
    assert (card.seen.count(CONFIGURE), rig.cards["RV"].seen.count(CONFIGURE)) == (2, 1)


@pytest.mark.parametrize(("limit_s", "warned"), [(0.25, True), (3.0, False)])
def test_limit_below_the_cards_own_is_a_warning(make_instrument, limit_s, warned):
    with CaptureRig(make_instrument(end_of_record_s=limit_s)) as rig:
        assert any("end_of_record_s" in w for w in rig.warnings) == warned
