"""`polysight focus` writes numbers and a figure, with x and y of the rig."""

import json

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight import report
from polysight.cli.main import main
from polysight.imaging.focus import Focus
from polysight.jobs import process as offline
from polysight_simulators.scene import decode_scene, simulate

SCENE = {
    "name": "one point",
    "grid": {"columns": 15, "rows": 9, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "image": {"columns": 24, "rows": 20, "pixel_mm": 3.0},
    "burst": {"pulses": 2},
    "points": [{"position_mm": [0.0, 0.0], "amplitude": [0.8, 0.0]}],
}
RIG = load_published_rig()


def test_focus_of_a_too_narrow_scan_writes_figure_and_numbers_that_are_not_certain(tmp_path, capsys):
    simulate(RIG, decode_scene(SCENE, "t"), tmp_path / "scan")
    exit_status = main(["focus", str(tmp_path / "scan"), "--out", str(tmp_path / "focus"), "--depth", "6"])
    assert exit_status == 0
    assert "object_distance_mm = " in capsys.readouterr().out
    focus = json.loads((tmp_path / "focus" / "focus.json").read_text())
    assert focus["simulated"]
    assert not focus["certain"]
    assert (focus["depths_mm"][0], focus["depths_mm"][-1]) == (-6, 6)
    assert max(focus["sharpness"]) == 1
    assert (tmp_path / "focus" / "focus.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("by_columns", [False, True])
def test_x_and_y_are_the_rigs_for_scans_by_rows_and_by_columns(tmp_path, capsys, monkeypatch, by_columns):
    """A scan by columns is imaged as one of a rig with x and y swapped; numbers and figure are those of the rig."""
    point_mm = (15.0, -9.0)
    tilt_deg = (2.0, -1.0)
    scene = decode_scene({**SCENE, "points": [{"position_mm": point_mm}]}, "t").with_disturbances(ideal=True)
    data = simulate(RIG, scene, tmp_path, layout="authors", by_columns=by_columns)
    if by_columns:
        swept_tilt_deg = tilt_deg[::-1]
    else:
        swept_tilt_deg = tilt_deg
    sweep_result = Focus(
        depths_mm=np.linspace(-6, 6, 3),
        sharpness=np.array([0.1, 1.0, 0.1]),
        depth_mm=0.0,
        tilt_deg=swept_tilt_deg,
        gain=1.0,
    )
    figures = []

    def record_figure(*arguments):
        figures.append(arguments)
        return b""

    monkeypatch.setattr(offline, "focus_sweep", lambda *_, **__: sweep_result)
    monkeypatch.setattr(report, "draw_focus_figure", record_figure)
    exit_status = main(["focus", str(data), "--out", str(tmp_path / "focus")])
    assert exit_status == 0
    output = capsys.readouterr().out
    # The tilt along x (2 degrees) is printed before that along y (-1).
    assert output.index("+2.00") < output.index("-1.00")
    focus = json.loads((tmp_path / "focus" / "focus.json").read_text())
    assert tuple(focus["tilt_deg"]) == tilt_deg
    ((sweep, *pictures, x_m, y_m, _),) = figures
    assert tuple(sweep["tilt_deg"]) == tilt_deg
    assert (x_m.size, y_m.size) == (24, 20)
    for picture in pictures:
        row, column = np.unravel_index(np.argmax(np.abs(picture)), (20, 24))
        brightest_mm = 1e3 * np.array([x_m[column] - x_m.mean(), y_m[row] - y_m.mean()])
        # If x and y were exchanged the point would be 24 mm off in both. The limit is two pixels of 3 mm.
        np.testing.assert_allclose(brightest_mm, point_mm, atol=2 * 3.0)
