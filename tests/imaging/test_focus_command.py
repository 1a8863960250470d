"""`polysight focus` on a small simulated scan: what it writes and what it says."""

import json
from pathlib import Path

from host.cli import main
from shared.config import load_instrument
from simulators.scene import decode_scene
from simulators.simulate import simulate

ROOT = Path(__file__).parents[2]
SCENE = {
    "name": "one point",
    "grid": {"columns": 15, "rows": 9, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "image": {"columns": 24, "rows": 20, "pixel_mm": 3.0},
    "burst": {"pulses": 2},
    "points": [{"position_mm": [0.0, 0.0], "amplitude": [0.8, 0.0]}],
}


def test_focus_writes_figure_and_numbers_and_says_when_a_scan_is_too_narrow(tmp_path, capsys):
    simulate(load_instrument(ROOT / "instrument.toml"), decode_scene(SCENE, "t"), tmp_path / "scan")
    assert main(["focus", str(tmp_path / "scan"), "--out", str(tmp_path / "focus"), "--depth", "6"]) == 0
    said = capsys.readouterr().out
    assert "simulated scan one-point" in said
    assert "object_distance_mm = " in said
    assert "do not rely on it" in said
    found = json.loads((tmp_path / "focus" / "focus.json").read_text())
    assert found["simulated"]
    assert not found["certain"]
    assert (found["depths_mm"][0], found["depths_mm"][-1]) == (-6, 6)
    assert max(found["sharpness"]) == 1
    assert (tmp_path / "focus" / "focus.png").read_bytes().startswith(b"\x89PNG")
