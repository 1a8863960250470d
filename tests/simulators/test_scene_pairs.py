"""Any two keys of a scene, right or wrong, give a scan or one message; never a traceback or half a scan."""

from __future__ import annotations

import contextlib
import copy
import io
import itertools
import math
import random
import resource
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from tests.support.paths import REPO
from tests.support.rigs import published_rig

from polysight.store.manifest import read
from polysight.store.validation import validate
from polysight_shared.errors import ConfigError
from polysight_shared.raster import Burst, Grid, Stage
from polysight_simulators.__main__ import main
from polysight_simulators.scene import apply_scene, decode_scene
from polysight_simulators.scene.scene_file import Disturbances, Layer, Plate, Point, Scene

Path_ = tuple[str | int, ...]
CPU_LIMIT_S = 20
MEMORY_LIMIT_BYTES = 2 << 30
INF = math.inf
NAN = math.nan
VALUES: list[Any] = [
    NAN, INF, -INF,
    -1, 0, 2, 5, 0.5, -0.001, 1e-300, 1e5, 1e9, 1e300, 10**18, -(10**19), True, "", "x", "off", "absent",
    [], [1.0], [0.3, 0.0], [1.0, 2.0, 3.0], [NAN, 0.0], [INF, INF], [1e300, -1e300], [1e-9, 1e-9], [3e3, 3e3], [[1.0]],
    [{"permittivity": [2.0, 0.0]}], {"a": 1},
]  # fmt: skip
PLATE = {"centre_mm": [0.0, 0.0], "size_mm": [10.0, 10.0]}
GLASS = {"permittivity": [5.5, 0.05], "thickness_mm": 3.0, "name": "glass"}
SCENE: dict[str, Any] = {
    "name": "t",
    "grid": {"columns": 2, "rows": 2, "step_x_mm": 2.0, "step_y_mm": 2.0},
    "burst": {"pulses": 2, "period_us": 1500.0},
    "plates": [
        {**PLATE, "name": "a", "permittivity": [4.0, 0.4]},
        {**PLATE, "name": "b", "centre_mm": [30.0, 0.0], "layers": [GLASS, {"permittivity": [9.0, 18.0]}]},
        {**PLATE, "name": "c", "centre_mm": [0.0, 30.0], "metal": True},
    ],
    "points": [{"position_mm": [20.0, 0.0]}],
}


def keys() -> list[Path_]:
    """Paths of all keys of a scene; those of the first and last layer, and of each plate."""
    tables = {("grid",): Grid, ("burst",): Burst, ("stage",): Stage, ("points", 0): Point}
    tables |= {("disturbances",): Disturbances} | {("plates", i): Plate for i in range(3)}
    tables |= {("plates", 1, "layers", i): Layer for i in range(2)}
    inner = [(*table, key) for table, kind in tables.items() for key in kind.__struct_fields__]
    each_role = [("disturbances", key, "receive_h") for key in ("crystal_ppm", "sync_skew_ns")]
    return [*((key,) for key in Scene.__struct_fields__), *inner, ("disturbances", "ideal"), *each_role]


def change_scene(scene: dict[str, Any], path: Path_, value: Any) -> dict[str, Any]:
    """Return a scene with one key set; as it was if an earlier change took its table away."""
    scene = copy.deepcopy(scene)
    node: Any = scene
    with contextlib.suppress(LookupError, TypeError, AttributeError):
        for part in path[:-1]:
            if isinstance(node, dict) and not isinstance(part, str):
                return scene
            node = node.setdefault(part, {}) if isinstance(node, dict) else node[part]
        # A position in a list means nothing in a table.
        if isinstance(node, dict) == isinstance(path[-1], str):
            node[path[-1]] = value
    return scene


def is_allowed(path: Path_) -> list[Any]:
    """Values with which the scene is accepted when nothing else is changed."""
    rig = published_rig()
    collected = []
    for value in VALUES:
        with contextlib.suppress(ConfigError):
            apply_scene(rig, decode_scene(change_scene(SCENE, path, value), "t"))
            collected.append(value)
    return collected


class Hangs(Exception):  # noqa: N818 (a fault of the program, raised in it)
    """It used more processor time than any tiny scan needs."""


def raise_hangs(_signal: int, _frame: object) -> None:
    raise Hangs


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Limit processor time and additional memory of this process."""
    former = resource.getrlimit(resource.RLIMIT_AS)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    handler = signal.signal(signal.SIGPROF, raise_hangs)
    resource.setrlimit(resource.RLIMIT_AS, (in_use + MEMORY_LIMIT_BYTES, former[1]))
    signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_AS, former)


def check(scene: dict[str, Any], tmp_path: Path, name: str = "scan") -> bool:
    """Simulate; return True for a scan. Otherwise there is one message and no folder."""
    file = tmp_path / f"{name}.toml"
    out = tmp_path / name
    err = io.StringIO()
    file.write_text(tomli_w.dumps(scene))
    command = ["simulate", str(file), "--config", str(REPO / "instrument.toml"), "--out", str(out), "--json"]
    quiet = contextlib.redirect_stdout(io.StringIO())
    with limits(), contextlib.redirect_stderr(err), quiet, warnings.catch_warnings():
        warnings.simplefilter("error")
        status = main(command)
    message = err.getvalue()
    if status == 0:
        assert not message
        assert [f for f in validate(out) if f.level == "error"] == []
        truth = (out / "truth.json").read_text()
        assert "NaN" not in truth
        assert "Infinity" not in truth
        return True
    assert message.startswith("error: ")
    assert message.count("\n  why: ") == message.count("\n  do: ") == 1
    assert not out.exists()
    return False


def test_a_scene_with_these_keys_alone_is_a_scan(tmp_path: Path) -> None:
    assert check(SCENE, tmp_path)


@pytest.mark.timeout(3600)  # with --long
def test_two_keys_of_a_scene_give_a_scan_or_a_message(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    every_pair = list(itertools.combinations(keys(), 2))
    if pytestconfig.getoption("--long"):
        drawn = every_pair
    else:
        drawn = random.Random(1).sample(every_pair, 40)
    rng = random.Random(2)
    scans = 0
    of_key: dict[Path_, list[Any]] = {}
    for number, pair in enumerate(drawn):
        scene = SCENE
        values = []
        for path in pair:
            if path not in of_key:
                of_key[path] = is_allowed(path)
            usual = bool(of_key[path]) and rng.random() < 0.8
            values.append(rng.choice(of_key[path] if usual else VALUES))
            scene = change_scene(scene, path, values[-1])
        try:
            scans += check(scene, tmp_path, str(number))
        except Exception as e:
            e.add_note(f"{pair[0]} = {values[0]!r}, {pair[1]} = {values[1]!r}")
            raise
    assert len(drawn) / 4 < scans < len(drawn), "values are right and wrong"


def test_drawn_layers_are_written(tmp_path: Path) -> None:
    assert check({**SCENE, "specimen_spread": [0.03, 0.3]}, tmp_path)


@pytest.mark.parametrize("option", ["--seed", "--specimens"])
@pytest.mark.parametrize("value", ["-1", "1.5", "nan", "x", str(1 << 63)])
def test_a_wrong_seed_is_refused(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "scene.toml", "--out", "out", option, value])
    assert ended.value.code == 2
    assert f"{value} is not a whole number, 0 or more" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ([(("plates", 1, "centre_mm"), [2000.0, 2000.0])], "extend over"),
        ([(("plates", 0, "rough_mm"), 0.1), (("plates", 0, "rough_length_mm"), 0.01)], "facets"),
        ([(("burst", "pulses"), 400_000), (("stage", "speed_mm_s"), 0.001)], "MB a board"),
    ],
)
def test_what_exceeds_the_memory_is_refused(
    changes: list[tuple[Path_, Any]], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = SCENE
    for path, value in changes:
        scene = change_scene(scene, path, value)
    file = tmp_path / "scene.toml"
    file.write_text(tomli_w.dumps(scene))
    assert main(["simulate", str(file), "--config", str(REPO / "instrument.toml"), "--out", str(tmp_path / "o")]) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_scan_ends_when_its_truth_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan whose simulation ends early is never complete."""

    def refuse(*_args: Any, **_kwargs: Any) -> int:
        raise OSError(28, "No space left on device")

    file = tmp_path / "scene.toml"
    out = tmp_path / "scan"
    file.write_text(tomli_w.dumps(SCENE))
    monkeypatch.setattr(Path, "write_text", refuse)
    assert main(["simulate", str(file), "--config", str(REPO / "instrument.toml"), "--out", str(out)]) == 5
    assert read(out / "manifest.jsonl").ended is None
