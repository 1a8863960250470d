"""The estimated start frequencies move the direct path to the middle of the IF band, from anywhere."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.calibration import files
from polysight.calibration.direct_signal import choose_start_offset, fit_start, predict_by_geometry, unwrap_if
from polysight.calibration.files import StartFile, open_raw, read_calibration
from polysight.cli.main import main
from polysight.radar.commands import direct_if_hz
from polysight_shared.errors import ErrorCode
from polysight_shared.tables import to_builtins

TABLES = {"grid": {"columns": 6, "rows": 2}, "burst": {"pulses": 16}, "image": {"columns": 20, "rows": 20}}


def set_offset(value_hz):
    def change(table):
        for board in table["boards"]:
            if board["role"] != "transmit":
                board["start_offset_hz"] = value_hz

    return change


@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
def test_whatever_the_true_if_its_alias_in_the_band_gives_the_offset_to_the_middle(make_rig, if_mode):
    """Law: true IF + change of offset = middle, if the rig file's expectation is within half a sample rate of it."""
    rig = make_rig(set_offset(123e3), chirp={"if_mode": if_mode})
    board = rig.receivers[0]
    rate = rig.chirp.sample_rate_hz
    middle = 0.45 * rate if if_mode == "complex1x" else 0.0
    rng = np.random.default_rng(3)
    for true_hz in rng.uniform(-4e6, 6e6, 50):
        alias_hz = true_hz % rate if if_mode == "complex1x" else (true_hz + rate / 2) % rate - rate / 2
        start_offset = choose_start_offset(rig, board, true_hz + rng.uniform(-0.4, 0.4) * rate, alias_hz, 1.0, 10)
        assert true_hz + start_offset.start_offset_hz - board.start_offset_hz == pytest.approx(middle, abs=1.0)


@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
def test_jitter_across_the_bands_edge_does_not_tear_the_mean_apart(make_rig, if_mode):
    """Law: IFs that are wrapped into the band and unwrapped again differ at most by a multiple of the sample rate."""
    rig = make_rig(chirp={"if_mode": if_mode})
    rate = rig.chirp.sample_rate_hz
    rng = np.random.default_rng(5)
    for centre in np.linspace(-1, 1, 9) * rate:
        true_hz = centre + 0.03 * rate * rng.standard_normal(64)
        alias_hz = true_hz % rate if if_mode == "complex1x" else (true_hz + rate / 2) % rate - rate / 2
        difference = (unwrap_if(alias_hz, rig) - true_hz) / rate
        np.testing.assert_allclose(difference, np.round(difference[0]), atol=1e-9)


def test_by_geometry_alone_the_expectation_is_in_the_middle(make_rig):
    rig = make_rig(set_offset(50e3))
    board = rig.receivers[1]
    board_of_advice = msgspec.structs.replace(board, start_offset_hz=predict_by_geometry(rig, board))
    # Steps of 54 Hz
    assert direct_if_hz(rig, board_of_advice) == pytest.approx(0.45 * rig.chirp.sample_rate_hz, abs=200)


def test_scanning_again_with_the_advised_offsets_finds_nothing_to_change(make_rig, make_scan, tmp_path, capsys):
    """The boards were programmed 260 kHz away from what the rig file says, and their crystals differ."""
    disturbances = {"if_offset_hz": 260e3, "crystal_ppm": {"receive_h": 0.8, "receive_v": -1.1}}

    def make_advice(rig, name):
        folder = make_scan(tmp_path / name, rig, seed=4, disturbances=disturbances)
        assert main(["calibrate", "start-frequency", str(folder), "--out", str(tmp_path / name / "c")]) == 0
        boards = read_calibration(next((tmp_path / name / "c").iterdir()), StartFile, "start_frequency").boards
        output = capsys.readouterr().out
        assert all(f"start_offset_hz = {b.start_offset_hz:.0f}" in output for b in boards.values())
        return {n: to_builtins(b) for n, b in boards.items()}

    first_advice = make_advice(make_rig(set_offset(300e3), **TABLES), "first")

    def set_advice(table):
        for board in table["boards"]:
            if board["name"] in first_advice:
                board["start_offset_hz"] = first_advice[board["name"]]["start_offset_hz"]

    second_advice = make_advice(make_rig(set_advice, **TABLES), "second")
    for name, board in second_advice.items():
        assert abs(first_advice[name]["start_offset_hz"] - 300e3) > 100e3
        error = np.hypot(board["direct_if_standard_error_hz"], first_advice[name]["direct_if_standard_error_hz"])
        assert abs(board["start_offset_hz"] - board["start_offset_was_hz"]) < 5 * error
        assert board["direct_if_hz"] == pytest.approx(board["middle_hz"], abs=5 * error)


def test_without_a_direct_path_the_offset_from_geometry_is_given(make_rig, make_scan, tmp_path):
    rig = make_rig(set_offset(790e3), **TABLES)
    folder = make_scan(tmp_path / "scan", rig, disturbances={"if_offset_hz": 0.0, "direct_loss_db": 80.0})
    with expect_refusal(ErrorCode.NO_DATA, "RH", f"start_offset_hz = {predict_by_geometry(rig, rig.receivers[0]):.0f}"):
        fit_start(open_raw(folder), "RH")


def test_of_many_rows_as_many_as_asked_for_are_read_evenly_spaced(make_rig, monkeypatch):
    monkeypatch.setattr(files, "view_row_words", lambda *_: (None, None))
    recorded = SimpleNamespace(payload=None, missing=(), frames_expected=0)
    source = SimpleNamespace(instrument=make_rig(), rows=lambda: iter((0, 1, 3, 4, 5, 8)), read_row=lambda *_: recorded)
    for limit, rows in ((None, [0, 1, 3, 4, 5, 8]), (6, [0, 1, 3, 4, 5, 8]), (3, [0, 3, 8]), (1, [0])):
        assert [row for row, _, _ in files.read_board_rows(source, "RH", limit)] == rows
