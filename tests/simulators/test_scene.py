"""Scene files: invalid keys are refused, disturbances can be switched, overrides are merged and checked."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.support.paths import REPO

from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError
from polysight_simulators.scene.scene_file import (
    SWITCHED_OFF,
    Disturbances,
    Scene,
    apply_scene,
    decode_scene,
    load_scene,
)


def make_scene(**tables: Any) -> Scene:
    return decode_scene({"name": "t", **tables}, "t.toml")


PLATE = {"name": "a", "centre_mm": [0.0, 0.0], "size_mm": [10.0, 10.0]}


@pytest.mark.parametrize(
    ("raw", "named"),
    [
        ({"name": "t", "plate": []}, "plate"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "colour": "red"}]}, "colour"),
        ({"name": "t", "plates": [PLATE]}, "permittivity"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "permittivity": [3.0, 0.1]}]}, "metal"),
        ({"name": "t", "plates": [{**PLATE, "permittivity": [4.0, 0.4], "strips_deg": 0.0}]}, "strips_deg"),
        (
            {
                "name": "t",
                "plates": [{**PLATE, "layers": [{"permittivity": [3.0, 0.1]}, {"permittivity": [2.0, 0.1]}]}],
            },
            "layers",
        ),
        ({"name": "t", "plates": [{**PLATE, "permittivity": [0.5, 0.1]}]}, "permittivity"),
        ({"name": "t", "plates": [{**PLATE, "permittivity": [3.0, -0.1]}]}, "permittivity"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "name": " "}]}, "name"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "name": "a\x1b[31m"}]}, "printable"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "thickness_mm": 1.0}]}, "thickness_mm"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "size_mm": [0.0, 1.0]}]}, "size_mm"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "tilt_deg": [30.0, 0.0]}]}, "tilt_deg"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "height_mm": 400.0}]}, "height_mm"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "rough_mm": -0.1}]}, "rough_mm"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "rough_length_mm": 0.0}]}, "rough_length_mm"),
        ({"name": "t", "grid": {"columns": 3, "colums": 4}}, "colums"),
        ({"name": "t", "plates": [{**PLATE, "metal": True, "rough_mm": 0.1, "rough_length_mm": 0.01}]}, "facets"),
        ({"name": "t", "disturbances": {"nois": 1.0}}, "nois"),
        ({"name": "t", "disturbances": {"ideal": 3}}, "ideal"),
        ({"name": "t", "disturbances": {"bend_us": "off"}}, "bend_us"),
        ({"name": "t", "disturbances": {"packet_loss": 0.9}}, "packet_loss"),
        ({"name": "t", "disturbances": {"direct_loss_db": "gone"}}, "direct_loss_db"),
        ({"name": "t", "disturbances": {"direct_loss_db": -100.0}}, "direct_loss_db"),
        ({"name": "t", "disturbances": {"crystal_ppm": {"RH": 1.0}}}, "RH"),
        ({"plates": []}, "name"),
    ],
)
def test_a_wrong_key_or_value_is_refused_by_name(raw: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError) as e:
        decode_scene(raw, "t.toml")
    assert named in str(e.value)
    assert "t.toml" in str(e.value)


def test_every_disturbance_has_an_off_value_and_ideal_uses_them_all() -> None:
    # These two are times of other disturbances: no value switches anything off.
    times_of_others = {"bend_us", "ripple_us"}
    assert set(SWITCHED_OFF) | times_of_others == set(Disturbances.__struct_fields__)
    ideal = msgspec.to_builtins(make_scene(disturbances={"ideal": True}).disturbances)
    expected = msgspec.to_builtins(msgspec.convert(SWITCHED_OFF, Disturbances))
    assert ideal == expected


@pytest.mark.parametrize("key", sorted(SWITCHED_OFF))
@pytest.mark.parametrize("word", ["off", False])
def test_each_disturbance_can_be_switched_off_alone(key: str, word: object) -> None:
    disturbances = msgspec.to_builtins(make_scene(disturbances={key: word}).disturbances)
    expected = {
        **msgspec.to_builtins(Disturbances()),
        key: msgspec.to_builtins(msgspec.convert(SWITCHED_OFF, Disturbances))[key],
    }
    assert disturbances == expected


def test_a_scene_replaces_only_the_keys_of_the_rig_that_it_has(rig: Instrument) -> None:
    s = make_scene(object_distance_mm=450.0, grid={"columns": 11}, burst={"pulses": 4}, stage={"speed_mm_s": 10.0})
    once = apply_scene(rig, s)
    assert (once.grid.columns, once.grid.rows) == (11, rig.grid.rows)
    assert (once.burst.pulses, once.burst.period_us) == (4, rig.burst.period_us)
    assert (once.stage.speed_mm_s, once.geometry.object_distance_mm) == (10.0, 450.0)
    assert apply_scene(once, s) == once
    assert apply_scene(rig, make_scene()) == rig


@pytest.mark.parametrize("grid", [{"columns": "many"}, {"columns": 9000}, {"step_x_mm": -1.0}])
def test_an_invalid_override_is_refused(rig: Instrument, grid: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        apply_scene(rig, make_scene(grid=grid))
    assert next(iter(grid)) in str(caught.value)


@pytest.mark.parametrize("path", sorted((REPO / "examples").rglob("*.toml")), ids=lambda p: p.stem)
def test_every_example_fits_the_published_rig(rig: Instrument, path: Path) -> None:
    s = load_scene(path)
    assert apply_scene(rig, s).grid.columns > 0
    boxes = [(*p.centre_mm, *p.size_mm) for p in s.plates if not p.background]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            # Plates do not overlap: there is a gap between them in x or in y.
            gap_x_mm = abs(a[0] - b[0]) - (a[2] + b[2]) / 2
            gap_y_mm = abs(a[1] - b[1]) - (a[3] + b[3]) / 2
            assert max(gap_x_mm, gap_y_mm) > 0


def test_the_library_does_not_contain_the_demo_scan() -> None:
    demo = load_scene(REPO / "examples" / "nine-materials.toml")
    library = [load_scene(p) for p in sorted((REPO / "examples" / "library").glob("*.toml"))]
    # The files were found.
    assert len(library) >= 4
    assert len({s.seed for s in [demo, *library]}) == len(library) + 1
    materials = {p.name: (p.permittivity, p.metal) for p in demo.plates}
    for s in library:
        assert {p.name: (p.permittivity, p.metal) for p in s.plates} == materials
        assert not {p.centre_mm for p in s.plates} & {p.centre_mm for p in demo.plates}
