"""The estimated start frequencies move the direct path to the middle of the IF band, from anywhere.

The IF band is 0 to 0.9 sample rates of complex1x, and -0.45 to 0.45 of complex2x. An IF outside of a whole sample rate
is seen at its *alias*, a multiple of the sample rate away.
"""

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
    """A change of the rig file: the start offset of both receivers."""

    def change(table):
        for board in table["boards"]:
            if board["role"] != "transmit":
                board["start_offset_hz"] = value_hz

    return change


def find_alias_hz(true_hz, rig):
    """Where an IF is seen: within 0 to 1 sample rate of complex1x, -1/2 to 1/2 of complex2x."""
    rate = rig.chirp.sample_rate_hz
    if rig.chirp.if_mode == "complex1x":
        return true_hz % rate
    return (true_hz + rate / 2) % rate - rate / 2


@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
def test_the_alias_of_any_true_if_gives_the_offset_that_moves_it_to_the_middle(make_rig, if_mode):
    """True IF + change of the offset = middle, if the rig file's IF is within half a sample rate of the true one."""
    rig = make_rig(set_offset(123e3), chirp={"if_mode": if_mode})
    board = rig.receivers[0]
    rate = rig.chirp.sample_rate_hz
    middle_hz = 0.45 * rate if if_mode == "complex1x" else 0.0
    rng = np.random.default_rng(3)
    for true_hz in rng.uniform(-4e6, 6e6, 50):
        expected_hz = true_hz + rng.uniform(-0.4, 0.4) * rate
        advice = choose_start_offset(
            rig, board, expected_hz=expected_hz, seen_hz=find_alias_hz(true_hz, rig), error_hz=1.0, chirps=10
        )
        # Offsets are whole hertz.
        change_hz = advice.start_offset_hz - board.start_offset_hz
        assert true_hz + change_hz == pytest.approx(middle_hz, abs=1.0)


@pytest.mark.parametrize("if_mode", ["complex1x", "complex2x"])
def test_ifs_that_scatter_across_the_edge_of_the_band_are_unwrapped_to_one_side(make_rig, if_mode):
    """Their aliases lie at both ends of the band, so that a plain mean would be wrong.

    Unwrapped, all of them differ from the true IFs by the same multiple of the sample rate.
    """
    rig = make_rig(chirp={"if_mode": if_mode})
    rate = rig.chirp.sample_rate_hz
    rng = np.random.default_rng(5)
    for centre_hz in np.linspace(-1, 1, 9) * rate:
        true_hz = centre_hz + 0.03 * rate * rng.standard_normal(64)
        turns = (unwrap_if(find_alias_hz(true_hz, rig), rig) - true_hz) / rate
        np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-9)


def test_the_offset_predicted_by_geometry_puts_the_expected_if_in_the_middle(make_rig):
    rig = make_rig(set_offset(50e3))
    board = rig.receivers[1]
    board_of_advice = msgspec.structs.replace(board, start_offset_hz=predict_by_geometry(rig, board))
    # The start frequencies of the boards have steps of 54 Hz: the limit is four steps.
    middle_of_band_hz = 0.45 * rig.chirp.sample_rate_hz
    assert direct_if_hz(rig, board_of_advice) == pytest.approx(middle_of_band_hz, abs=200)


def test_scanning_again_with_the_advised_offsets_finds_nothing_to_change(make_rig, make_scan, tmp_path, capsys):
    """The true IF is 260 kHz away from that of the rig file, and the crystals of the boards differ."""
    offset_in_file_hz = 300e3
    disturbances = {"if_offset_hz": 260e3, "crystal_ppm": {"receive_h": 0.8, "receive_v": -1.1}}

    def make_advice(rig, name):
        """Scan, calibrate, and return the facts of both receivers by name."""
        folder = make_scan(tmp_path / name, rig, seed=4, disturbances=disturbances)
        out = tmp_path / name / "c"
        exit_status = main(["calibrate", "start-frequency", str(folder), "--out", str(out)])
        assert exit_status == 0
        boards = read_calibration(next(out.iterdir()), StartFile, "start_frequency").boards
        output = capsys.readouterr().out
        assert all(f"start_offset_hz = {board.start_offset_hz:.0f}" in output for board in boards.values())
        return {board_name: to_builtins(board) for board_name, board in boards.items()}

    first_advice = make_advice(make_rig(set_offset(offset_in_file_hz), **TABLES), "first")

    def set_advice(table):
        for board in table["boards"]:
            if board["name"] in first_advice:
                board["start_offset_hz"] = first_advice[board["name"]]["start_offset_hz"]

    second_advice = make_advice(make_rig(set_advice, **TABLES), "second")
    for name, second in second_advice.items():
        first = first_advice[name]
        # The first advice changes the offset much: by 158 and 308 kHz.
        assert abs(first["start_offset_hz"] - offset_in_file_hz) > 100e3
        error_hz = np.hypot(second["direct_if_standard_error_hz"], first["direct_if_standard_error_hz"])
        assert abs(second["start_offset_hz"] - second["start_offset_was_hz"]) < 5 * error_hz
        assert second["direct_if_hz"] == pytest.approx(second["middle_hz"], abs=5 * error_hz)


def test_without_a_direct_path_the_offset_from_geometry_is_given(make_rig, make_scan, tmp_path):
    rig = make_rig(set_offset(790e3), **TABLES)
    folder = make_scan(tmp_path / "scan", rig, disturbances={"if_offset_hz": 0.0, "direct_loss_db": 80.0})
    predicted_hz = predict_by_geometry(rig, rig.receivers[0])
    with expect_refusal(ErrorCode.NO_DATA, "RH", f"start_offset_hz = {predicted_hz:.0f}"):
        fit_start(open_raw(folder), "RH")


def test_of_many_rows_only_the_requested_number_is_read_evenly_spaced(make_rig, monkeypatch):
    """The scan lacks rows 2, 6 and 7."""
    monkeypatch.setattr(files, "view_row_words", lambda *_: (None, None))
    empty_row = SimpleNamespace(payload=None, missing=(), frames_expected=0)
    rows = (0, 1, 3, 4, 5, 8)
    source = SimpleNamespace(instrument=make_rig(), rows=lambda: iter(rows), read_row=lambda *_: empty_row)
    for limit, expected in ((None, [0, 1, 3, 4, 5, 8]), (6, [0, 1, 3, 4, 5, 8]), (3, [0, 3, 8]), (1, [0])):
        assert [row for row, _, _ in files.read_board_rows(source, "RH", limit)] == expected
