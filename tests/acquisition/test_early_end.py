"""A row that ends early leaves no data in the cards that the next take could mistake for its own."""

from __future__ import annotations

import threading
import time

import msgspec
import pytest
from tests.support.acquisition.fake_cards import FULL, FakeCard, payload_of
from tests.support.acquisition.fake_rig import FakeRig
from tests.support.store.facts import facts_of

from polysight.acquisition.capture_rig import CaptureRig
from polysight.acquisition.scan import run_scan
from polysight.capture.dca1000 import Code
from polysight.store.validation import validate
from polysight_shared.config import Board

TAIL_S = 0.6  # from the last data to the short last packet; 2 s of a real card
CONFIGURE = int(Code.CONFIGURE_FPGA)


class LateCard(FakeCard):
    """A card that keeps a row's last short packet for a while, as the real one does, or until the record's stop.

    Sends full packets at once; the rest and the status `TAIL_S` later, or `lag_s` after the reply to a stop.
    """

    def __init__(self, board: Board, row_bytes: int, lag_s: float) -> None:
        self._lag_s, self._record = lag_s, 0  # number of the record
        self._tail: tuple[int, bytes] | None = None  # of which record, and what
        self._lock = threading.Lock()
        self.cut: dict[tuple[int, int], int] = {}  # (row, take): so many bytes are all that come
        super().__init__(board, row_bytes)

    def send_row(self, row: int, take: int) -> None:
        if not self.recording:
            return
        data = payload_of(self.board.name, row, self.row_bytes)[: self.cut.get((row, take), self.row_bytes)]
        whole = len(data) // FULL * FULL
        for a in range(0, whole, FULL):
            self._rest = data[a : a + FULL]
            self._send_packet(FULL)
        self._tail = self._record, data[whole:]
        threading.Timer(TAIL_S, self._finish, [self._record]).start()

    def _finish(self, record: int) -> None:
        with self._lock:
            if self._tail is None or self._tail[0] != record:
                return
            self._rest, self._tail = self._tail[1], None
            self.recording = False
            self.end_frames()

    def _command(self, code: int, sender: tuple[str, int]) -> None:
        recorded = self.recording
        self._record += code == 5
        super()._command(code, sender)
        if code == 6 and recorded:
            time.sleep(self._lag_s)
            self._finish(self._record)


@pytest.mark.parametrize("lag_ms", [0, 5, 30])
def test_take_after_a_row_that_ended_early_is_whole(make_instrument, payload, tmp_path, lag_ms):
    """The Pi reports a fault in row 1. The last packet and the status arrive some ms after the reply to the stop."""
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
    assert [(f["row"], f["take"]) for f in facts_of(result.folder, "row_rejected")] == [(1, 1)]
    assert result.folder.read_row("RV", 1).payload.tobytes() == payload("RV", 1, rig.instrument.row_bytes)
    assert validate(tmp_path / "s") == []


def test_card_that_sent_nothing_is_set_up_again_before_the_retake(rig, tmp_path):
    """It lost power for a moment: it replies again, but its configuration is lost."""
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
