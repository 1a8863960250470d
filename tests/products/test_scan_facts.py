"""scan.json: the gains that were divided out, number by number, and the rig that the images were made with."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from polysight.host.imaging import ChannelImages
from polysight.host.products.files import SCAN, write_scan_facts
from polysight.shared.tables import decode, to_builtins
from tests.support.rigs import published_rig


@pytest.fixture
def rigs():
    """The scan's own rig, and another that the images were made with."""
    own = published_rig()
    table = to_builtins(own)
    table["geometry"]["object_distance_mm"] = 501.25
    return own, decode(table, type(own), "as calibrated")


def test_gains_relative_to_each_board_s_first_and_the_rig_of_the_images(tmp_path, rigs):
    own, placed = rigs
    none, axis = np.zeros((1, 1), np.complex64), np.zeros(1)
    gains = {
        "RH": np.array([2.0, 20.0, 2.0j, -0.2], np.complex128),
        "RV": np.array([5j, 5j], np.complex128),
    }
    images = ChannelImages(none, none, none, none, none, none, axis, axis, np.ones((1, 1), bool), gains)
    write_scan_facts(tmp_path, SimpleNamespace(scan_id="s", simulated=True, instrument=own), placed, images)
    facts = json.loads((tmp_path / SCAN).read_text(encoding="utf-8"))
    assert (facts["scan_id"], facts["simulated"]) == ("s", True)
    found = {name: [(g["gain_db"], g["phase_deg"]) for g in board] for name, board in facts["rx_gains"].items()}
    assert found["RH"] == [pytest.approx(g) for g in ((0.0, 0.0), (20.0, 0.0), (0.0, 90.0), (-20.0, 180.0))]
    assert found["RV"] == [pytest.approx((0.0, 0.0))] * 2
    assert facts["instrument"]["geometry"]["object_distance_mm"] == 501.25
