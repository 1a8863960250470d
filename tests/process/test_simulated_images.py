"""Which given images count as simulated: those of this program whose scan says so."""

import json

import pytest

from polysight.process.given_images import _is_simulated_product


@pytest.mark.parametrize(
    ("name", "scan", "is_simulated"),
    [
        ("image.npz", {"simulated": True}, True),
        ("image.npz", {"simulated": False}, False),
        ("image.npz", {}, False),
        ("image.npz", [True], False),
        ("image.npz", None, False),
        # A scan.json in its folder does not describe a file of another program.
        ("mine.npz", {"simulated": True}, False),
    ],
)
def test_only_this_programs_images_of_a_simulated_scan_count_as_simulated(tmp_path, name, scan, is_simulated):
    if scan is not None:
        (tmp_path / "scan.json").write_text(json.dumps(scan))
    assert _is_simulated_product(tmp_path / name) is is_simulated
