"""Specimens are drawn reproducibly with the given spread, and written to truth.json; leakage and direct path."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight_shared.config import Instrument
from polysight_simulators.scene import Scene, SimulatedRig, apply_scene, decode_scene, draw_specimens, simulate, truth
from polysight_simulators.scene.scene_file import facets

RIG = load_published_rig()
PLATE = {"name": "a", "centre_mm": [30.0, -20.0], "size_mm": [45.0, 30.0], "permittivity": [4.0, 0.4]}
SMALL_GRID = {"columns": 3, "rows": 2, "step_x_mm": 10.0, "step_y_mm": 10.0}


def make_scene(**tables: Any) -> Scene:
    return decode_scene({"name": "t", "grid": SMALL_GRID, "plates": [PLATE], **tables}, "t")


# --- specimens -------------------------------------------------------------------------------------------------------


def test_permittivities_have_the_given_spread() -> None:
    many = draw_specimens(make_scene(plates=[PLATE] * 2000, specimen_spread=[0.03, 0.5]))
    # Spreads are relative: 3 % of the real part, 50 % of the loss. The limits are several standard errors of 2000
    # plates: 0.07 % and 1.1 % of the means, and 1.6 % of the spreads (more for the loss, which is not normal).
    real, loss = np.array([p.permittivity for p in many.plates]).T
    assert real.mean() == pytest.approx(4.0, rel=0.005)
    assert real.std() / 4.0 == pytest.approx(0.03, rel=0.1)
    assert loss.mean() == pytest.approx(0.4, rel=0.05)
    assert loss.std() / 0.4 == pytest.approx(0.5, rel=0.15)
    assert loss.min() > 0


def test_specimens_depend_on_seed_and_plate_and_are_drawn_only_once() -> None:
    two = make_scene(plates=[PLATE, PLATE], specimen_spread=[0.05, 0.3], plane_tilt_deg=[0.5, 0.2], plane_shift_mm=2.0)
    drawn = draw_specimens(two)
    assert draw_specimens(drawn) == drawn == draw_specimens(two)
    assert drawn.plates[0].permittivity != drawn.plates[1].permittivity
    other_seed = make_scene(plates=[PLATE, PLATE], specimen_spread=[0.05, 0.3], seed=2)
    assert draw_specimens(other_seed).plates[0].permittivity != drawn.plates[0].permittivity
    assert draw_specimens(make_scene()) == make_scene()


def test_layers_vary_but_air_and_metal_do_not() -> None:
    layers = [
        {"permittivity": [5.5, 0.05], "thickness_mm": 3.0},
        {"permittivity": [1.0, 0.0], "thickness_mm": 2.0},
        {"permittivity": [9.0, 18.0]},
    ]
    bare = {key: value for key, value in PLATE.items() if key != "permittivity"}
    plates = [{**bare, "layers": layers}, {**bare, "metal": True}]
    stack, metal = draw_specimens(make_scene(plates=plates, specimen_spread=[0.05, 0.3])).plates
    assert stack.layers[1].permittivity == (1.0, 0.0)
    assert stack.layers[0].permittivity != (5.5, 0.05)
    assert stack.layers[2].permittivity != (9.0, 18.0)
    assert metal.metal


def test_shift_and_tilt_of_the_plane_apply_to_its_plates_and_points() -> None:
    point = {"position_mm": [100.0, 0.0], "height_mm": 1.0}
    drawn = draw_specimens(make_scene(points=[point], plane_tilt_deg=[1.0, -0.5], plane_shift_mm=2.0))
    x, y = np.tan(np.radians([1.0, -0.5]))
    assert drawn.plates[0].tilt_deg == pytest.approx((1.0, -0.5))
    assert drawn.plates[0].height_mm == pytest.approx(2.0 + 30.0 * x - 20.0 * y)
    assert drawn.points[0].height_mm == pytest.approx(3.0 + 100.0 * x)
    tilted_plate = {**PLATE, "tilt_deg": [-1.0, 0.5], "height_mm": -2.0}
    flat = draw_specimens(make_scene(plates=[tilted_plate], plane_tilt_deg=[1.0, -0.5], plane_shift_mm=2.0)).plates[0]
    assert flat.tilt_deg == pytest.approx((0.0, 0.0))


def test_facets_fill_the_plate_and_have_the_given_roughness() -> None:
    plate = make_scene(plates=[{**PLATE, "rough_mm": 0.2, "rough_length_mm": 1.0}]).plates[0]
    drawn = facets(plate, 0, 1)
    # The plate of 45 x 30 mm has a facet for each millimetre.
    assert drawn.height_m.shape == (30, 45)
    # The standard deviation of 1350 facets is known to 1.9 %.
    assert drawn.height_m.std() == pytest.approx(0.2e-3, rel=0.05)
    # The outer facets end at the edges of the plate.
    right_edge_m = drawn.x_m[-1] + drawn.size_m[0] / 2
    lower_edge_m = drawn.y_m[0] - drawn.size_m[1] / 2
    assert np.allclose([right_edge_m, lower_edge_m], [45e-3 / 2, -30e-3 / 2])
    assert not np.array_equal(drawn.height_m, facets(plate, 1, 1).height_m)
    assert np.array_equal(drawn.height_m, facets(plate, 0, 1).height_m)


def test_truth_json_contains_the_drawn_values(tmp_path: Path) -> None:
    real = make_scene(
        plates=[{**PLATE, "tilt_deg": [0.4, 0.0], "rough_mm": 0.1}],
        specimen_spread=[0.05, 0.5],
        plane_shift_mm=1.0,
        disturbances={"direct_loss_db": "absent", "leakage_h": [0.0, 0.07]},
    )
    folder = simulate(RIG, real, tmp_path / "scan")
    content = json.loads((folder / "truth.json").read_text())
    plate = content["plates"][0]
    drawn = draw_specimens(real).plates[0]
    assert plate["permittivity"] == list(drawn.permittivity or ())
    assert plate["nominal_permittivity"] == [4.0, 0.4] != plate["permittivity"]
    assert (plate["tilt_deg"], plate["height_mm"]) == ([0.4, 0.0], 1.0)
    assert (plate["rough_mm"], plate["rough_length_mm"]) == (0.1, 6.0)
    assert plate["centre_m"][2] == pytest.approx(content["image_centre_m"][2] + 1e-3)
    assert content["direct_path"] is False
    assert content["scene"]["disturbances"]["leakage_h"] == [0.0, 0.07]
    assert content["scene"]["disturbances"]["direct_loss_db"] == "absent"
    assert content["scene"]["plane_shift_mm"] == 1.0
    assert truth(RIG, make_scene(), 1)["plates"][0]["permittivity"] == [4.0, 0.4]


def read_polarimetry(rig: Instrument = RIG, **disturbances: Any) -> tuple[Any, Any, Any]:
    p = apply_scene(rig, make_scene(disturbances=disturbances)).polarimetry
    return p.leakage_h, p.leakage_v, p.leakage_std


def test_the_rig_file_of_a_scan_has_the_leakage_that_was_measured() -> None:
    # Leakage that was not measured does not change the rig file.
    in_rig_file = (RIG.polarimetry.leakage_h, RIG.polarimetry.leakage_v, RIG.polarimetry.leakage_std)
    assert read_polarimetry(leakage_h=[0.0, 0.08]) == in_rig_file
    # That an ideal rig has none is known.
    assert read_polarimetry(ideal=True) == ((0.0, 0.0), (0.0, 0.0), 0.0)
    h, v, std = read_polarimetry(leakage_h=[0.0, 0.08], leakage_v=[0.03, 0.0], leakage_measured=0.003)
    assert std == 0.003
    error = np.array([*h, *v]) - [0.0, 0.08, 0.03, 0.0]
    # Five standard errors.
    assert 0 < np.abs(error).max() < 5 * 0.003
    h, v, _ = read_polarimetry(leakage_h=[0.0, 0.08], leakage_v=[0.03, 0.0], leakage_measured=0.0)
    assert (h, v) == ((0.0, 0.08), (0.03, 0.0))


def test_measured_leakage_has_its_standard_error() -> None:
    errors = []
    for seed in range(200):
        drawn_scene = make_scene(seed=seed, disturbances={"ideal": True, "leakage_measured": 0.01})
        p = apply_scene(RIG, drawn_scene).polarimetry
        assert apply_scene(apply_scene(RIG, drawn_scene), drawn_scene).polarimetry == p
        errors += [*p.leakage_h, *p.leakage_v]
    # 800 errors: their standard deviation is known to 2.5 %.
    assert np.std(errors) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize(("loss_db", "gain"), [(-6.0, 10 ** (6 / 20)), (6.0, 10 ** (-6 / 20)), ("absent", 0.0)])
def test_the_direct_path_is_stronger_weaker_or_absent(loss_db: Any, gain: float) -> None:
    def direct(loss: Any) -> np.ndarray:
        disturbances = {"ideal": True, "direct_loss_db": loss}
        return SimulatedRig(RIG, make_scene(plates=[], disturbances=disturbances)).signals(
            "RH", np.zeros(1), np.zeros(1)
        )

    # Rounding of single precision leaves 2e-7 (measured).
    assert np.allclose(direct(loss_db), gain * direct(0.0), atol=1e-5)
