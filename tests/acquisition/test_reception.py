"""What goes wrong between card and host, seen from a scan: a buffer too small, data the card dropped itself."""

from __future__ import annotations

import struct

import msgspec
import pytest

from polysight.host.acquisition.scan import run_scan
from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.error_codes import ErrorCode
from tests.support.refusals import refused

DDR_FULL, LVDS_BUFFER_FULL = 1 << 7, 1 << 9


def test_a_receive_buffer_below_two_bursts_ends_the_scan_before_it_begins(rig, tmp_path):
    card = msgspec.structs.replace(rig.instrument.card, receive_buffer_bytes=4096)
    with refused(ErrorCode.VALUE_INVALID, "sysctl -w net.core.rmem_max="):
        run_scan(msgspec.structs.replace(rig.instrument, card=card), tmp_path / "s")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(("bit", "name"), [(DDR_FULL, "DDR_FULL"), (LVDS_BUFFER_FULL, "LVDS_BUFFER_FULL")])
def test_what_the_card_dropped_before_numbering_it_is_told_and_the_row_taken_again(rig, tmp_path, bit, name):
    """No counter shows it: every expected byte comes, and the card's status alone says that some are not in place."""
    card = rig.cards["RV"]
    send_row = card.send_row

    def overflowing(row, take):
        if (row, take) == (1, 1):
            status = struct.pack("<HHHH", 0xA55A, 0x0A, bit, 0xEEAA)
            card.out.sendto(status, (card.board.host_address, card.board.command_port))
        send_row(row, take)

    card.send_row = overflowing
    result = run_scan(rig.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 1)
    (rejected,) = ScanFolder.load(tmp_path / "s").facts("row_rejected")
    assert (rejected["row"], rejected["take"]) == (1, 1)
    assert any("RV" in reason and f"before numbering it ({name})" in reason for reason in rejected["reasons"])
    assert rejected["boards"]["RV"]["card_status"] & bit
    assert not rejected["boards"]["RH"]["card_status"] & bit
