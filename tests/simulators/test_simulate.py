"""A simulated scan on disk: both layouts have the radars' bytes, and truth.json the truth of the scene."""

import json
from pathlib import Path
from typing import Any
from zlib import crc32

import msgpack
import numpy as np
import pytest
from tests.support.paths import RIG_FILE
from tests.support.refusals import refused
from tests.support.rigs import published_rig

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError
from polysight_shared.messages import Capture, RowFinished, RunStarted, RunStopped, unpack_event
from polysight_shared.raster import FIRST_PULSE_DELAY_S, plan_raster
from polysight_simulators.__main__ import main
from polysight_simulators.scene import SimulatedRig, decode_scene, lost_bytes, row_offsets_mm, simulate

RIG = published_rig()
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
LOSSY = SCENE.with_disturbances(packet_loss=0.02)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(RIG, SCENE, tmp_path_factory.mktemp("own") / "scan", started_s=0.0)


def test_rows_contain_the_radars_bytes_at_true_positions(folder: Path) -> None:
    radar = SimulatedRig(RIG, SCENE)
    row = plan_raster(radar.rig.grid).row(1)
    x, y = row_offsets_mm(radar, row)
    # Odd rows start at the largest x, and move on until the first pulse and during each burst.
    assert np.isclose(x[0], 20.0 - RIG.stage.speed_mm_s * FIRST_PULSE_DELAY_S)
    assert np.allclose(np.diff(x.reshape(5, 16), axis=1), -0.03)
    assert np.allclose(np.diff(x.reshape(5, 16)[:, 0]), -10.0)
    expected = radar.chirps("RV", x, y, first_pulse=len(x))
    raw = (folder / "raw" / "RV" / "0001.bin").read_bytes()
    assert len(raw) == 5 * 16 * 4096
    assert np.array_equal(np.frombuffer(raw, "<i2").reshape(expected.shape), expected)


def test_every_manifest_line_has_its_crc(tmp_path: Path) -> None:
    folder = simulate(RIG, LOSSY, tmp_path / "scan", started_s=0.0)
    facts = []
    for line in (folder / "manifest.jsonl").read_text().splitlines():
        fact = json.loads(line)
        crc = fact.pop("crc")
        assert crc == f"{crc32(json.dumps(fact, sort_keys=True, separators=(',', ':')).encode()):08x}"
        facts.append(fact)
    assert [f["fact"] for f in facts] == ["scan_started", *["row_committed"] * 3, "scan_ended"]
    assert facts[0]["simulated"] is True
    assert facts[0]["plan"]["columns"] == 5
    assert [f["direction"] for f in facts[1:4]] == [1, -1, 1]
    for fact in facts[1:4]:
        for board in fact["boards"].values():
            raw = (folder / board["file"]).read_bytes()
            assert board["crc32"] == f"{crc32(raw):08x}"
            index = json.loads((folder / board["file"]).with_suffix(".idx").read_text())
            assert board["missing_bytes"] == sum(b - a for a, b in index["missing"])
            assert all(not any(raw[a:b]) for a, b in index["missing"])
            hit = {frame for a, b in index["missing"] for frame in range(a // 4096, (b - 1) // 4096 + 1)}
            assert board["frames_received"] == board["frames_expected"] - len(hit)


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
    a, b, c = (simulate(RIG, scene, tmp_path / n, seed=s, started_s=0.0) for n, s in (("a", 9), ("b", None), ("c", 10)))
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


def test_the_authors_layout_contains_the_same_bytes(tmp_path: Path) -> None:
    own_folder = simulate(RIG, LOSSY, tmp_path / "own", started_s=0.0)
    theirs = simulate(RIG, LOSSY, tmp_path / "theirs", layout="authors", started_s=100.0)
    assert theirs.parent == tmp_path / "theirs" / "unsynced"
    for row, stem in enumerate(("0_0", "4_1", "0_2")):
        for board in ("RH", "RV"):
            assert (theirs / board / f"{stem}.bin").read_bytes() == (
                own_folder / "raw" / board / f"{row:04d}.bin"
            ).read_bytes()
        assert (theirs / "LS" / f"{stem}.bin").stat().st_size == 5 * 16 * 4096
    cfg = json.loads((theirs / "data_collection_cfg.json").read_text())
    expected = {
        "dx": 10.0,
        "total_x": 5,
        "total_y": 3,
        "num_trigger": 16,
        "period_frame": 1.5,
        "object_distance": 499.0,
    }
    assert expected.items() <= cfg.items()
    angles = {"txboard_angle_y": 44.0, "rxboard_v_angle_y": -20.0, "rxboard_angle_y": -55.0, "rxboard_angle_z": 22.5}
    assert {**angles, "rxboard_tilt_offset": [38.3, 33.0, 30.0]}.items() <= cfg.items()
    assert np.isclose(cfg["board_dist"], 1.5175)
    chirp = json.loads((theirs / "devices_comm_cfg.json").read_text())["chirp_configs"][0]
    assert (chirp["f0"], chirp["slope"], chirp["Fs"]) == (76.01e9, 38.816929e12, 2.15e6)


@pytest.mark.parametrize("zero_filling", [True, False])
def test_logs_list_the_received_packets(tmp_path: Path, zero_filling: bool) -> None:
    folder = simulate(RIG, LOSSY, tmp_path, layout="authors", started_s=100.0, zero_filling=zero_filling)
    radar = SimulatedRig(RIG, LOSSY)
    row = plan_raster(radar.rig.grid).row(0)
    gaps = lost_bytes(radar, "RH", row)
    bytes_lost = sum(b - a for a, b in gaps)
    assert bytes_lost > 0
    log = np.loadtxt(folder / "RH" / "0_0_log.csv", delimiter=",")
    size = 5 * 16 * 4096
    assert log[:, 1].sum() == size - bytes_lost
    assert (folder / "RH" / "0_0.bin").stat().st_size == (size if zero_filling else size - bytes_lost)
    starts = (log[:, 0].astype(int) - 1) * 1456
    assert not any(a <= s < b for s in starts for a, b in gaps)
    assert np.all(np.diff(log[:, 2]) >= 0)
    assert log[0, 2] >= 100.0


def test_a_row_with_backlash_is_within_the_aperture() -> None:
    radar = SimulatedRig(RIG, SCENE.with_disturbances(backlash_mm=-3.0))
    for row in plan_raster(radar.rig.grid):
        radar.chirps("RH", *row_offsets_mm(radar, row))
    assert radar.outside["RH"] == 0


def test_a_full_folder_and_a_burst_that_does_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / "note").write_text("mine")
    with refused(ErrorCode.FILE_EXISTS, tmp_path):
        simulate(RIG, SCENE, tmp_path)
    fast = decode_scene({**RAW, "stage": {"speed_mm_s": 600.0, "accel_mm_s2": 20000.0}}, "t")
    with pytest.raises(ConfigError):
        simulate(RIG, fast, tmp_path / "fast")


def test_the_command_prints_its_folder_and_refuses_invalid_arguments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "s.toml"
    scene.write_text('name = "s"\n[grid]\ncolumns = 2\nrows = 1\n')
    common = ["--config", str(RIG_FILE), "--out", str(tmp_path / "o")]
    assert main(["simulate", str(scene), *common, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["simulated"] is True
    assert Path(answer["folder"], "truth.json").exists()
    assert main(["simulate", str(scene), *common]) == 3
    for of_the_authors in ("--columns", "--absent"):
        assert main(["simulate", str(scene), *common, of_the_authors]) == 2
        assert of_the_authors in capsys.readouterr().err
    assert main(["simulate", str(scene), *common[:-1], str(scene)]) == 5
    assert str(scene) in capsys.readouterr().err
    scene.write_text('name = "s"\nplate = 1\n')
    assert main(["simulate", str(scene), *common]) == 2
    assert "plate" in capsys.readouterr().err
