"""The settings and the synchronised data cubes of the published data set are read.

The settings of a scan (`data_collection_cfg.json`) replace values of a given rig file, the *base*. The raw rows of the
data set are tested in test_published_rows.py.
"""

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
# Channels of a receiving board.
CHANNELS = 4
STEP_X_MM = 2
STEP_Y_MM = 3.0
# Distance between the origins of the transmitter's board and of the receivers'; the middle is at x = 0.
BOARD_DISTANCE_M = 1.5175


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
        "dx": STEP_X_MM,
        "dy": STEP_Y_MM,
        "total_x": COLUMNS,
        "total_y": ROWS,
        "moving_direction": "row",
        "num_trigger": PULSES,
        "period_frame": 1.5,
        "num_frame": PULSES,
        "num_chirp": 1,
        "num_config": 1,
        "num_adc": SAMPLES,
        "num_ch": CHANNELS,
        "object_distance": 430,
        "board_dist": BOARD_DISTANCE_M,
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
def test_the_stage_of_the_rig_has_room_for_a_grid_that_is_too_wide_for_the_base(write, base, columns):
    folder = write(total_x=columns)
    rig = open_source(folder, base).instrument
    assert rig.grid.columns == columns
    assert rig.stage.travel_x_mm > columns * STEP_X_MM


def find_tx_x_m(rig) -> float:
    x_m, _, _ = tx_position_m(rig)
    return x_m


def find_rx_x_m(rig, board) -> float:
    """Return x of the board's first antenna."""
    x_m, _, _ = rx_positions_m(rig, board)[0]
    return x_m


def test_settings_make_the_rig(write, base):
    longer_by_m = 1.6 - BOARD_DISTANCE_M
    folder = write(board_dist=1.6)
    scan = open_source(folder, base)
    rig = scan.instrument
    assert rig.grid.columns == COLUMNS
    assert rig.grid.rows == ROWS
    assert rig.grid.step_x_mm == STEP_X_MM
    assert rig.grid.step_y_mm == STEP_Y_MM
    assert rig.burst.pulses == PULSES
    # `period_frame` is in milliseconds.
    assert rig.burst.period_us == 1.5 * 1e3
    assert rig.chirp.samples == SAMPLES
    # The settings do not have the linear part of the ramp, so that it is the base's.
    assert base.chirp.linear_samples == (0, 192)
    assert rig.chirp.linear_samples == base.chirp.linear_samples
    # `ramp_time` is in seconds here.
    assert rig.chirp.ramp_end_us == pytest.approx(128.5)
    assert rig.chirp.first_sample_hz == pytest.approx(base.chirp.first_sample_hz)
    assert rig.geometry.object_distance_mm == 430
    # Every second row is scanned backwards.
    assert scan.plan.row(1).direction == -1
    assert scan.scan_id == "scan1"
    assert not scan.simulated
    # A larger distance of the boards moves the transmitter to smaller x, and the receivers to larger x.
    assert find_tx_x_m(rig) == pytest.approx(find_tx_x_m(base) - longer_by_m / 2)
    for base_board, board in zip(base.receivers, rig.receivers, strict=True):
        assert find_rx_x_m(rig, board) == pytest.approx(find_rx_x_m(base, base_board) + longer_by_m / 2)


# Angles (degrees) and the offset of the receivers (mm) in the settings of the published data set.
ANGLES = {
    "txboard_angle_y": 44.0,
    "rxboard_v_angle_y": -20.0,
    "rxboard_angle_y": -55.0,
    "rxboard_angle_z": 22.5,
    "rxboard_tilt_offset": [38.3, 33.0, 30.0],
}


def test_the_rig_file_has_the_published_angles(write, base):
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
    boards = zip(base.boards, rig.boards, strict=True)
    assert {board.name for base_board, board in boards if board.mount != base_board.mount} == moved


def turn_about_y(vector, angle_deg: float) -> np.ndarray:
    """Return a vector (x, y, z) turned about the y axis; a turn by 90 degrees takes z to x."""
    angle = np.radians(angle_deg)
    x, y, z = vector
    return np.array([np.cos(angle) * x + np.sin(angle) * z, y, -np.sin(angle) * x + np.cos(angle) * z])


def test_the_receivers_move_by_the_change_of_their_offset_which_is_turned_with_the_board(write, base):
    offset_mm = [30.0, 33.0, 31.0]
    rig = open_source(write(**ANGLES | {"rxboard_tilt_offset": offset_mm}), base).instrument
    change_mm = np.subtract(offset_mm, ANGLES["rxboard_tilt_offset"])
    expected_shift_mm = turn_about_y(change_mm, ANGLES["rxboard_angle_y"])
    for name in ("RH", "RV"):
        old_positions_m = rx_positions_m(base, base.by_name(name))
        new_positions_m = rx_positions_m(rig, rig.by_name(name))
        for old_m, new_m in zip(old_positions_m, new_positions_m, strict=True):
            np.testing.assert_allclose(np.subtract(new_m, old_m) * 1e3, expected_shift_mm, atol=1e-9)


def test_the_transmitter_is_turned_about_its_origin_by_the_change_of_its_angle(write, base):
    rig = open_source(write(**ANGLES | {"txboard_angle_y": 40.0}), base).instrument
    origin_m = np.array([-BOARD_DISTANCE_M / 2, 0, 0])
    turned_m = turn_about_y(tx_position_m(base) - origin_m, 40.0 - ANGLES["txboard_angle_y"])
    np.testing.assert_allclose(tx_position_m(rig) - origin_m, turned_m, atol=1e-9)


@pytest.mark.parametrize("name", ["RH", "RV"])
def test_a_receiver_is_turned_about_its_origin_by_the_change_of_its_angle(write, base, name):
    rig = open_source(write(**ANGLES | {"rxboard_angle_y": -60.0}), base).instrument
    origin_m = np.array([BOARD_DISTANCE_M / 2, 0, 0])
    old_position_m = rx_positions_m(base, base.by_name(name))[0]
    new_position_m = rx_positions_m(rig, rig.by_name(name))[0]
    turned_m = turn_about_y(old_position_m - origin_m, -60.0 - ANGLES["rxboard_angle_y"])
    np.testing.assert_allclose(new_position_m - origin_m, turned_m, atol=1e-9)


def test_a_board_never_looks_away_from_the_object(write, base):
    """An angle with the wrong sign is read with the right one, with a notice for each board that it would turn away."""
    folder = write(**ANGLES | {"rxboard_angle_y": 55.0, "txboard_angle_y": -44.0})
    scan = open_source(folder, base)
    assert scan.instrument.boards == base.boards
    assert [notice.partition(":")[0] for notice in scan.notices] == ["LS", "RH", "RV"]
    assert "away from the object" in scan.recording_facts()["recording"].notices[0]


def test_settings_in_the_units_of_ti_s_tools_are_understood_too(write, base):
    """GHz, MHz/us, us and thousands of samples a second, instead of SI units."""
    chirp = {"f0": 76.01, "slope": 38.816929, "ramp_time": 128.5, "adc_start_time": 7, "num_adc": SAMPLES, "Fs": 2150}
    folder = write(chirp_configs=[chirp])
    read_chirp = open_source(folder, base).instrument.chirp
    for key in ("start_hz", "slope_hz_per_s", "ramp_end_us", "adc_start_us", "sample_rate_hz"):
        assert getattr(read_chirp, key) == pytest.approx(getattr(base.chirp, key))


def test_a_folder_without_settings_is_refused(base, tmp_path):
    with expect_refusal(ErrorCode.FILE_FOREIGN, tmp_path):
        open_source(tmp_path, base)


def test_an_unknown_order_of_rows_is_refused(write, base):
    folder = write(moving_direction="spiral")
    with expect_refusal(ErrorCode.VALUE_INVALID, "moving_direction", "spiral"):
        open_source(folder, base)


def test_published_data_without_a_rig_file_is_refused(write):
    folder = write()
    with expect_refusal(ErrorCode.KEY_MISSING):
        open_source(folder, base=None)


def test_settings_that_are_not_json_are_refused(write, base):
    folder = write()
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


def draw_cube() -> np.ndarray:
    """Return synchronised samples of a board, complex64 [channel, row, column, sample]."""
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((CHANNELS, ROWS, COLUMNS, SAMPLES)) * (1 + 1j)
    return samples.astype(np.complex64)


@pytest.fixture
def cube_folder(tmp_path) -> Path:
    """The folder of a scan whose two boards have the same cube."""
    folder = tmp_path / "raw" / "scan1"
    folder.mkdir(parents=True)
    (folder / "data_collection_cfg.json").write_text(json.dumps(_make_settings()))
    for board in ("RH", "RV"):
        np.save(folder / f"{board}_synced.npy", draw_cube())
    return folder


def test_synchronised_cubes_are_read(cube_folder, base):
    scan = open_source(cube_folder, base)
    assert isinstance(scan, PublishedCubes)
    assert list(scan.rows()) == list(range(ROWS))
    row = 2
    np.testing.assert_array_equal(scan.read_row("RV", row).cube, draw_cube()[:, row])


def test_a_cube_with_fewer_rows_than_the_settings_is_refused(cube_folder, base):
    scan = open_source(cube_folder, base)
    np.save(cube_folder / "RH_synced.npy", draw_cube()[:, :2])
    with expect_refusal(ErrorCode.MISMATCH):
        scan.read_row("RH", 0)


def test_a_cube_that_is_a_pickle_of_objects_is_refused(cube_folder, base):
    scan = open_source(cube_folder, base)
    np.save(cube_folder / "RH_synced.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        scan.read_row("RH", 0)
