"""The published settings make a rig; its synchronised cubes are read. Raw rows are in test_published_rows.py."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.cli.options import rig_file
from polysight.store.open import open_source
from polysight.store.published import PublishedCubes
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import rx_positions_m, tx_position_m

COLUMNS = 7
ROWS = 4
PULSES = 4
SAMPLES = 256


@pytest.fixture(scope="module")
def base():
    return load_published_rig()


def _make_settings(**changes):
    chirp = {
        "f0": 76.01e9,
        "slope": 38.816929e12,
        "ramp_time": 128.5e-6,
        "adc_start_time": 7e-6,
        "num_adc": SAMPLES,
        "Fs": 2.15e6,
    }
    return {
        "dx": 2,
        "dy": 3.0,
        "total_x": COLUMNS,
        "total_y": ROWS,
        "moving_direction": "row",
        "num_trigger": PULSES,
        "period_frame": 1.5,
        "num_frame": PULSES,
        "num_chirp": 1,
        "num_config": 1,
        "num_adc": SAMPLES,
        "num_ch": 4,
        "object_distance": 430,
        "board_dist": 1.5175,
        "chirp_configs": [chirp],
        **changes,
    }


@pytest.fixture
def write(tmp_path):
    """Function that writes the settings of a scan without rows; it returns the folder."""

    def make(**changes):
        folder = tmp_path / "unsynced" / "scan1"
        folder.mkdir(parents=True)
        (folder / "data_collection_cfg.json").write_text(json.dumps(_make_settings(**changes)))
        return folder

    return make


@pytest.mark.parametrize("columns", [400, 450])
def test_for_a_grid_wider_than_the_stage_of_the_given_rig_the_travel_is_longer(write, base, columns):
    folder = write(total_x=columns)
    rig = open_source(folder, base).instrument
    assert rig.grid.columns == columns
    assert rig.stage.travel_x_mm > columns * 2


def test_settings_make_the_rig(write, base):
    folder = write(board_dist=1.6)
    scan = open_source(folder, base)
    rig = scan.instrument
    assert (rig.grid.columns, rig.grid.rows, rig.grid.step_x_mm, rig.grid.step_y_mm) == (COLUMNS, ROWS, 2, 3)
    assert rig.burst.pulses == PULSES
    assert rig.burst.period_us == 1500
    assert rig.chirp.samples == SAMPLES
    assert rig.chirp.linear_samples == (0, 192)
    assert rig.chirp.ramp_end_us == pytest.approx(128.5)
    assert rig.chirp.first_sample_hz == pytest.approx(base.chirp.first_sample_hz)
    assert rig.geometry.object_distance_mm == 430
    assert scan.plan.row(1).direction == -1
    assert scan.scan_id == "scan1"
    assert not scan.simulated
    wider = 1.6 - 1.5175
    assert tx_position_m(rig)[0] == pytest.approx(tx_position_m(base)[0] - wider / 2)
    for old, new in zip(base.receivers, rig.receivers, strict=True):
        assert rx_positions_m(rig, new)[0][0] == pytest.approx(rx_positions_m(base, old)[0][0] + wider / 2)


ANGLES = {
    "txboard_angle_y": 44.0,
    "rxboard_v_angle_y": -20.0,
    "rxboard_angle_y": -55.0,
    "rxboard_angle_z": 22.5,
    "rxboard_tilt_offset": [38.3, 33.0, 30.0],
}


def test_the_published_angles_are_the_rig_files(write, base):
    folder = write(**ANGLES)
    assert open_source(folder, base).instrument.boards == base.boards
    assert open_source(folder, base).notices == ()


@pytest.mark.parametrize(
    ("key", "value", "moved"),
    [
        ("txboard_angle_y", 40.0, {"LS"}),
        ("rxboard_v_angle_y", -10.0, {"RV"}),
        ("rxboard_angle_y", -60.0, {"RH", "RV"}),
        ("rxboard_angle_z", 20.0, {"RH", "RV"}),
        ("rxboard_tilt_offset", [30.0, 33.0, 31.0], {"RH", "RV"}),
    ],
)
def test_each_mount_angle_of_the_scan_turns_its_boards(write, base, key, value, moved):
    folder = write(**ANGLES | {key: value})
    rig = open_source(folder, base).instrument
    assert {b.name for b, old in zip(rig.boards, base.boards, strict=True) if b.mount != old.mount} == moved
    for name in moved:  # by hand: undo what comes after the turn, and turn by the difference
        old = base.by_name(name)
        new = rig.by_name(name)
        if key == "rxboard_tilt_offset":
            turn = np.radians(-55.0)
            shift = np.array([np.cos(turn) * -8.3 + np.sin(turn) * 1.0, 0, -np.sin(turn) * -8.3 + np.cos(turn) * 1.0])
            for a, b in zip(rx_positions_m(base, old), rx_positions_m(rig, new), strict=True):
                np.testing.assert_allclose(np.subtract(b, a) * 1e3, shift, atol=1e-9)
        if key in ("txboard_angle_y", "rxboard_angle_y"):
            by = np.radians(value - ANGLES[key])
            place = tx_position_m if name == "LS" else lambda r, board=new: rx_positions_m(r, r.by_name(board.name))[0]
            a = np.array(place(base))
            b = np.array(place(rig))
            origin = np.array([-0.75875 if name == "LS" else 0.75875, 0, 0])
            x, y, z = a - origin
            rotated = [np.cos(by) * x + np.sin(by) * z, y, -np.sin(by) * x + np.cos(by) * z]
            np.testing.assert_allclose(b - origin, rotated, atol=1e-9)


def test_a_board_never_looks_away_from_the_object(write, base):
    folder = write(**ANGLES | {"rxboard_angle_y": 55.0, "txboard_angle_y": -44.0})
    scan = open_source(folder, base)
    assert scan.instrument.boards == base.boards
    assert len(scan.notices) == 3
    assert "away from the object" in scan.recording_facts()["recording"].notices[0]


def test_settings_in_the_units_of_ti_s_tools_are_understood_too(write, base):
    """GHz, MHz/us, us and thousands of samples a second, instead of SI units."""
    chirp = {"f0": 76.01, "slope": 38.816929, "ramp_time": 128.5, "adc_start_time": 7, "num_adc": SAMPLES, "Fs": 2150}
    folder = write(chirp_configs=[chirp])
    read_chirp = open_source(folder, base).instrument.chirp
    for key in ("start_hz", "slope_hz_per_s", "ramp_end_us", "adc_start_us", "sample_rate_hz"):
        assert getattr(read_chirp, key) == pytest.approx(getattr(base.chirp, key))


def test_an_unknown_order_of_rows_and_a_folder_without_settings_are_refused(write, base, tmp_path):
    with expect_refusal(ErrorCode.FILE_FOREIGN, tmp_path):
        open_source(tmp_path, base)
    folder = write(moving_direction="spiral")
    with expect_refusal(ErrorCode.VALUE_INVALID, "moving_direction", "spiral"):
        open_source(folder, base)
    with expect_refusal(ErrorCode.KEY_MISSING):
        open_source(folder)
    (folder / "data_collection_cfg.json").write_text("{")
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        open_source(folder, base)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dx", 0),
        ("dy", -3),
        ("dx", 1e9),
        ("total_x", 0),
        ("num_trigger", 0),
        ("period_frame", 0),
        ("object_distance", -430),
        ("board_dist", 0),
        ("rxboard_angle_y", 1e9),
    ],
)
def test_a_value_that_no_scan_has_is_refused_by_the_files_own_key(write, base, key, value):
    folder = write(**{key: value})
    with expect_refusal(
        ErrorCode.VALUE_INVALID, key, "data_collection_cfg.json", "docs/how-to/authors-data.md"
    ) as refusal:
        open_source(folder, base)
    assert "instrument.toml" not in str(refusal.value)
    assert "step_x_mm" not in str(refusal.value)


def test_a_whole_number_with_a_decimal_point_is_reported_as_such(write, base):
    folder = write(total_y=4.0)
    with expect_refusal(ErrorCode.TYPE_WRONG, "total_y = 4.0: must be a whole number, without a decimal point"):
        open_source(folder, base)


def test_the_packaged_rig_file_is_the_default_for_published_data_only(write, tmp_path, monkeypatch):
    folder = write()
    monkeypatch.chdir(tmp_path)
    assert open_source(folder, rig_file(None, folder)).instrument.grid.columns == COLUMNS
    (tmp_path / "instrument.toml").write_text("")
    assert rig_file(None, folder) == Path("instrument.toml")
    (tmp_path / "instrument.toml").unlink()
    (folder / "instrument.toml").write_text("")
    assert rig_file(None, folder) == folder / "instrument.toml"
    # A scan folder has its own.
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "manifest.jsonl").write_text("")
    assert rig_file(None, tmp_path / "scan") is None


def test_synchronised_cubes_are_read(tmp_path, base):
    folder = tmp_path / "raw" / "scan1"
    folder.mkdir(parents=True)
    (folder / "data_collection_cfg.json").write_text(json.dumps(_make_settings()))
    rng = np.random.default_rng(0)
    cube = (rng.standard_normal((4, ROWS, COLUMNS, SAMPLES)) * (1 + 1j)).astype(np.complex64)
    for board in ("RH", "RV"):
        np.save(folder / f"{board}_synced.npy", cube)
    scan = open_source(folder, base)
    assert isinstance(scan, PublishedCubes)
    assert list(scan.rows()) == list(range(ROWS))
    np.testing.assert_array_equal(scan.read_row("RV", 2).cube, cube[:, 2])
    np.save(folder / "RH_synced.npy", cube[:, :2])
    with expect_refusal(ErrorCode.MISMATCH):
        scan.read_row("RH", 0)
    np.save(folder / "RH_synced.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        scan.read_row("RH", 0)
