"""Scenes with two drawn values: each is simulated to a whole scan or refused with a message, never with a traceback.

The keys and their limits are read from the scene's own types, so that a new key is drawn without a change here.
"""

import copy
import itertools
import json
import random
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from tests.support.paths import RIG_FILE

from polysight.cli.main import main
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError
from polysight_simulators.__main__ import main as simulators
from polysight_simulators.scene.scene_file import Scene, load_scene

# Tables of the rig file that a scene may override.
OVERRIDES = ("grid", "burst", "image", "stage")
WRONG_NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 10**30)
WRONG_TYPES = ("many", [], [[]], {}, True)
# Texts: none, a long one, a mark that reverses the direction, a line break, a path, format codes, and a usual one.
WORDS = ("", "x" * 300, "e\u202exe", "a\nb", "../x", "%s{}", "metal")
# Scenes with more positions, or with lengths beyond this, are not simulated: they take long.
MOST_POSITIONS = 64
LARGEST_MM = 300.0
# Number of pairs that are drawn without --long
PAIRS = 16

KINDS_OF_PLATES: list[dict[str, Any]] = [
    {"name": "metal", "metal": True},
    {"name": "plain", "permittivity": [4.0, 0.4]},
    {"name": "sheet", "permittivity": [3.0, 0.1], "thickness_mm": 2.0},
    {"name": "stack", "layers": [{"permittivity": [5.5, 0.1], "thickness_mm": 3.0}, {"permittivity": [9.0, 9.0]}]},
    {"name": "strips", "metal": True, "strips_deg": 20.0},
]
BASE: dict[str, Any] = {
    "name": "pairs",
    "grid": {"columns": 5, "rows": 3, "step_x_mm": 40.0, "step_y_mm": 40.0},
    "burst": {"pulses": 2},
    "image": {"columns": 12, "rows": 12, "pixel_mm": 20.0},
    "plates": [
        {"centre_mm": [-90.0 + 45.0 * i, 0.0], "size_mm": [40.0, 40.0], **plate}
        for i, plate in enumerate(KINDS_OF_PLATES)
    ],
    "points": [{"position_mm": [0.0, 60.0]}],
    "shapes": [{"kind": "sphere", "centre_mm": [0.0, -60.0], "radius_mm": 30.0, "metal": True}],
    "disturbances": {},
}


def list_keys() -> list[tuple[tuple[str | int, ...], msgspec.inspect.Type]]:
    """Each key of the base scene, and of tables that it may hold, as a path and its type."""
    keys = list(walk(msgspec.inspect.type_info(Scene), ()))
    rig = msgspec.inspect.type_info(Instrument)
    assert isinstance(rig, msgspec.inspect.StructType)
    for table in rig.fields:
        if table.encode_name in OVERRIDES:
            keys += list(walk(table.type, (table.encode_name,)))
    return keys


def walk(kind: msgspec.inspect.Type, path: tuple[str | int, ...]):
    """Yield the paths below a type, with their types; lists have the items that the base scene has there."""
    if isinstance(kind, msgspec.inspect.StructType):
        for field in kind.fields:
            yield from walk(field.type, (*path, field.encode_name))
        return
    if path:
        yield path, kind
    if isinstance(kind, msgspec.inspect.VarTupleType):
        for i in range(len(look_up(BASE, path))):
            yield from walk(kind.item_type, (*path, i))


def look_up(table: Any, path: tuple[str | int, ...]) -> Any:
    """Return the list at a path of the base scene; an empty one where it has none."""
    for key in path:
        if isinstance(table, dict) and key not in table:
            return []
        table = table[key]
    return table


def draw_value(kind: msgspec.inspect.Type, draw: random.Random) -> Any:
    """Draw a value for a type: at a limit, beyond it, or of another type."""
    if draw.random() < 0.15:
        return draw.choice((*WRONG_NUMBERS, *WRONG_TYPES))
    if isinstance(kind, msgspec.inspect.UnionType):
        return draw_value(draw.choice([t for t in kind.types if not isinstance(t, msgspec.inspect.NoneType)]), draw)
    if isinstance(kind, msgspec.inspect.TupleType):
        return [draw_value(t, draw) for t in kind.item_types]
    if isinstance(kind, msgspec.inspect.VarTupleType | msgspec.inspect.ListType):
        return []
    if isinstance(kind, msgspec.inspect.LiteralType):
        return draw.choice(list(kind.values))
    if isinstance(kind, msgspec.inspect.BoolType):
        return draw.random() < 0.5
    if isinstance(kind, msgspec.inspect.FloatType | msgspec.inspect.IntType):
        limits = [limit for limit in (kind.ge, kind.gt, kind.le, kind.lt) if limit is not None]
        number = draw.choice([*limits, *(1.001 * limit for limit in limits), 0, 1, 2.5, -3, draw.uniform(-1, 1)])
        return int(number) if isinstance(kind, msgspec.inspect.IntType) else float(number)
    return draw.choice(WORDS)


def change(scene: dict[str, Any], path: tuple[str | int, ...], value: Any) -> None:
    """Set a key of a scene, unless another change has removed its table."""
    table: Any = scene
    for key, following in itertools.pairwise(path):
        if isinstance(key, str) and isinstance(table, dict):
            table = table.setdefault(key, [] if isinstance(following, int) else {})
        elif isinstance(key, int) and isinstance(table, list) and key < len(table):
            table = table[key]
        else:
            return
    if isinstance(table, dict) or (isinstance(table, list) and isinstance(path[-1], int) and path[-1] < len(table)):
        table[path[-1]] = value


def is_small(scene: Path) -> bool:
    """True if the simulation of a scene takes little time; that of refused scenes does."""
    try:
        checked = load_scene(scene)
        grid = {**BASE["grid"], **checked.grid}
        lengths = [length for plate in checked.plates for length in (*plate.centre_mm, *plate.size_mm)]
        lengths += [length for shape in checked.shapes for length in shape.centre_mm]
        lengths += [length for point in checked.points for length in point.position_mm]
        return bool(grid["columns"] * grid["rows"] <= MOST_POSITIONS) and max(map(abs, lengths)) <= LARGEST_MM
    except (ConfigError, TypeError):
        return True


def check_scene(scene: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]) -> bool:
    """Simulate a scene: True if it was accepted. Check that the result is a complete scan, or a message and no scan."""
    file = folder / "scene.toml"
    file.write_text(tomli_w.dumps(scene), encoding="utf-8")
    scan = folder / "scan"
    if not is_small(file):
        return False
    status = simulators(["simulate", str(file), "--config", str(RIG_FILE), "--out", str(scan)])
    output = capsys.readouterr()
    if status:
        assert "\n  why: " in output.err, (scene, output.err)
        assert "\n  do: " in output.err, (scene, output.err)
        assert not (scan / "truth.json").exists(), (scene, output.err)
        return False
    assert "nan" not in output.out.split(), (scene, output.out)
    json.loads((scan / "truth.json").read_text(), parse_constant=pytest.fail)
    assert main(["validate", str(scan)]) == 0, (scene, capsys.readouterr())
    capsys.readouterr()
    return True


def test_each_pair_of_keys_makes_a_whole_scan_or_is_refused(tmp_path, capsys, request):
    draw = random.Random(1)
    pairs = list(itertools.combinations(list_keys(), 2))
    # The keys were found: there are 160, which make 12,720 pairs.
    assert len(pairs) > 5000
    if not request.config.getoption("--long"):
        pairs = draw.sample(pairs, PAIRS)
    accepted = 0
    for i, pair in enumerate(pairs):
        scene = copy.deepcopy(BASE)
        for path, kind in pair:
            change(scene, path, draw_value(kind, draw))
        folder = tmp_path / str(i)
        folder.mkdir()
        accepted += check_scene(scene, folder, capsys)
    assert 0 < accepted < len(pairs)
