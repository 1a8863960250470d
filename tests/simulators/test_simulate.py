"""The files of a simulated scan: rows have the radars' bytes, events agree with the rows, truth.json has the scene."""

import json
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from msgspec import convert
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.messages import Capture, RowFinished, RunStarted, RunStopped, ScanId, unpack_event
from polysight_shared.raster import FIRST_PULSE_DELAY_S, plan_raster
from polysight_simulators.scene import SimulatedRig, decode_scene, row_offsets_mm, simulate
from polysight_simulators.scene.layouts import make_scan_id

RIG = load_published_rig()
RAW: dict[str, Any] = {
    "name": "two small plates",
    "seed": 9,
    "grid": {"columns": 5, "rows": 3, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "plates": [
        {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [30.0, 30.0], "metal": True},
        {"name": "acrylic", "centre_mm": [40.0, 0.0], "size_mm": [30.0, 30.0], "permittivity": [4.0, 0.4]},
    ],
}
SCENE = decode_scene(RAW, "t")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(RIG, SCENE, tmp_path_factory.mktemp("own") / "scan", started_s=0.0)


def test_rows_contain_the_radars_bytes_at_true_positions(folder: Path) -> None:
    radar = SimulatedRig(RIG, SCENE)
    row = plan_raster(radar.rig.grid).row(1)
    x, y = row_offsets_mm(radar, row)
    # Odd rows start at the largest x, and move on until the first pulse and during each burst: 20 mm/s are 0.03 mm
    # between two pulses.
    assert np.isclose(x[0], 20.0 - RIG.stage.speed_mm_s * FIRST_PULSE_DELAY_S)
    # [position, pulse]
    x_of_pulses = x.reshape(5, 16)
    assert np.allclose(np.diff(x_of_pulses, axis=1), -0.03)
    assert np.allclose(np.diff(x_of_pulses[:, 0]), -10.0)
    expected = radar.chirps("RV", x, y, first_chirp=len(x))
    raw = (folder / "raw" / "RV" / "0001.bin").read_bytes()
    # 256 samples of 4 RX, each a complex pair of int16
    assert len(raw) == 5 * 16 * (256 * 4 * 2 * 2)
    assert np.array_equal(np.frombuffer(raw, "<i2").reshape(expected.shape), expected)


def test_events_agree_with_the_rows_in_sequence(folder: Path) -> None:
    unpacker = msgpack.Unpacker()
    unpacker.feed((folder / "events.msgpack").read_bytes())
    events = [unpack_event(msgpack.packb(e)) for e in unpacker]
    assert [e.seq for e in events] == list(range(1, len(events) + 1))
    assert isinstance(events[0], RunStarted)
    assert isinstance(events[-1], RunStopped)
    captures = [e for e in events if isinstance(e, Capture)]
    assert len(captures) == 15
    assert [e.column for e in captures if e.row_index == 1] == [4, 3, 2, 1, 0]
    assert np.all(np.diff([e.edge_ns for e in captures]) > 0)
    assert sum(e.pulses for e in events if isinstance(e, RowFinished)) == 15 * 16


def test_the_same_seed_writes_the_same_bytes_also_of_drawn_specimens(tmp_path: Path) -> None:
    rough = {**RAW["plates"][1], "rough_mm": 0.2, "tilt_deg": [0.5, 0.1]}
    scene = decode_scene({**RAW, "plates": [RAW["plates"][0], rough], "specimen_spread": [0.03, 0.3]}, "t")
    a = simulate(RIG, scene, tmp_path / "a", seed=9, started_s=0.0)
    b = simulate(RIG, scene, tmp_path / "b", seed=None, started_s=0.0)
    c = simulate(RIG, scene, tmp_path / "c", seed=10, started_s=0.0)
    names = sorted(p.relative_to(a) for p in a.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(b) for p in b.rglob("*") if p.is_file())
    assert all((a / n).read_bytes() == (b / n).read_bytes() for n in names)
    assert (a / "raw/RH/0000.bin").read_bytes() != (c / "raw/RH/0000.bin").read_bytes()


def test_truth_json_has_plates_and_points(folder: Path) -> None:
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["simulated"] is True
    assert truth["seed"] == 9
    assert truth["versions"]
    copper, acrylic = truth["plates"]
    assert (copper["name"], copper["metal"], copper["permittivity"]) == ("copper", True, None)
    assert acrylic["permittivity"] == [4.0, 0.4]
    assert np.isclose(acrylic["centre_m"][0] - truth["image_centre_m"][0], 0.04)
    assert decode_scene(truth["scene"], "truth.json") == SCENE


def test_a_folder_with_files_and_a_burst_longer_than_its_position_are_refused(tmp_path: Path) -> None:
    (tmp_path / "note").write_text("mine")
    with expect_refusal(ErrorCode.FILE_EXISTS, tmp_path):
        simulate(RIG, SCENE, tmp_path)
    fast = decode_scene({**RAW, "stage": {"speed_mm_s": 600.0, "accel_mm_s2": 20000.0}}, "t")
    with pytest.raises(ConfigError):
        simulate(RIG, fast, tmp_path / "fast")


@pytest.mark.parametrize(
    ("plate", "run", "named"),
    [
        ({"centre_mm": [2000.0, 2000.0]}, {}, "extend over"),
        ({}, {"burst": {"pulses": 65_536, "period_us": 1500.0}, "stage": {"speed_mm_s": 0.001}}, "MB a board"),
    ],
)
def test_a_scene_that_needs_too_much_memory_is_refused(
    tmp_path: Path, plate: dict[str, Any], run: dict[str, Any], named: str
) -> None:
    copper, acrylic = RAW["plates"]
    scene = decode_scene({**RAW, **run, "plates": [copper, {**acrylic, **plate}]}, "t")
    with pytest.raises(ConfigError, match=named):
        simulate(RIG, scene, tmp_path / "scan")


def test_a_scan_ends_when_its_truth_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan whose simulation ends early is never complete."""

    def refuse(*_args: Any, **_kwargs: Any) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", refuse)
    with pytest.raises(OSError, match="No space left"):
        simulate(RIG, SCENE, tmp_path)
    facts = [json.loads(line)["fact"] for line in (tmp_path / "manifest.jsonl").read_text().splitlines()]
    assert "row_committed" in facts
    assert "scan_ended" not in facts


@pytest.mark.parametrize("name", ["x" * 300, "Übung 1", "木", "a/../b", "-" * 130 + "a", "two plates"])
def test_any_name_of_a_scene_gives_the_id_of_a_scan(name):
    convert(make_scan_id(name), ScanId)
