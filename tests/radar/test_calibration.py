"""The calibration of a radar board is saved, and restored at its next start; its settings are read back."""

import json
import struct

import pytest
from tests.support.refusals import expect_refusal

from polysight.radar.board import RadarBoard, State
from polysight.radar.calibration_data import (
    ALL_CALIBRATIONS,
    RESTORED_CALIBRATIONS,
    CalibrationFiles,
    InitCalibrations,
    RestoreCalibration,
)
from polysight.radar.commands import make_program
from polysight_shared.errors import ErrorCode

FRAMES = 4


@pytest.fixture
def make_board(rig, words, clock):
    def make(calibration=None) -> RadarBoard:
        return RadarBoard("RH", words, clock, make_program(rig, rig.by_name("RH")), calibration=calibration)

    return make


def test_settings_are_read_back_and_a_difference_is_reported(make_board, board):
    radar = make_board()
    radar.configure()
    radar.arm(FRAMES)
    assert radar.read_back() == []
    # In the board one byte of the profile is different.
    board.cores.profiles[0] = board.cores.profiles[0][:4] + b"\0" + board.cores.profiles[0][5:]
    (difference,) = radar.read_back()
    assert difference.startswith("0x0100: sent ")


def test_a_calibration_is_saved_and_restored_at_the_next_start(make_board, board, tmp_path):
    files = CalibrationFiles(tmp_path / "kept", b"settings")
    first = make_board(files)
    first.configure()
    assert first.facts.calibration_restored is False
    (file,) = (tmp_path / "kept").iterdir()
    assert json.loads(file.read_text())["die_id"] == first.facts.die_id
    board.executed.clear()
    restored_board = make_board(files)
    restored_board.configure()
    assert restored_board.facts.calibration_restored is True
    # The saved calibration has three parts.
    assert board.executed.count(RestoreCalibration.ID) == 3
    # The board makes the other calibrations, and not the restored ones.
    (mask,) = struct.unpack_from("<I", board.settings[InitCalibrations.ID])
    assert mask & RESTORED_CALIBRATIONS == 0
    assert mask | RESTORED_CALIBRATIONS == ALL_CALIBRATIONS
    assert restored_board.state is State.CONFIGURED


# Bits of the calibrations that a board reports (ICD 217, docs/spec/mmwavelink.md): those that each board needs, and
# those of the transmitters.
NEEDED = {1: "clock PLL", 2: "VCO1", 3: "VCO2", 4: "LO", 5: "ADC", 6: "high-pass", 7: "low-pass", 10: "gain", 12: "I/Q"}
OF_TX = {8: "peak", 9: "TX power", 11: "TX phase"}


@pytest.mark.parametrize("name", ["LS", "RH"])
@pytest.mark.parametrize(("bit", "text"), (NEEDED | OF_TX).items())
def test_a_failed_rf_init_is_refused_and_not_saved(rig, words, clock, board, tmp_path, name, bit, text):
    """Calibrations of the transmitters are needed only by the board that transmits, LS."""
    # All of bits 1 to 12 but this one.
    board.cores.passing_calibrations = 0x1FFE & ~(1 << bit)
    files = CalibrationFiles(tmp_path / "kept", b"settings")
    radar = RadarBoard(name, words, clock, make_program(rig, rig.by_name(name)), calibration=files)
    if name == "RH" and bit in OF_TX:
        radar.configure()
        return
    with expect_refusal(ErrorCode.RADAR_FAULT, text):
        radar.configure()
    assert not (tmp_path / "kept").exists()
    # No profile (message 0x0100) was sent afterwards.
    assert 0x0100 not in board.executed


def test_a_calibration_folder_that_cannot_be_written_is_named(make_board, tmp_path):
    (tmp_path / "kept").write_text("a file in place of the folder")
    with expect_refusal(ErrorCode.FILE_UNWRITABLE, tmp_path / "kept", "calibration_dir"):
        make_board(CalibrationFiles(tmp_path / "kept", b"settings")).configure()


def test_other_settings_and_other_dies_have_their_own_calibration(make_board, board, tmp_path):
    make_board(CalibrationFiles(tmp_path, b"settings")).configure()
    make_board(CalibrationFiles(tmp_path, b"others")).configure()
    board.cores.die_number = 7
    make_board(CalibrationFiles(tmp_path, b"settings")).configure()
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"crc32": ', '"crc32": 1'),
        lambda _: "[]",
    ],
    ids=["half of the file", "another checksum", "not a table"],
)
def test_a_damaged_calibration_is_not_sent_to_a_board(make_board, board, tmp_path, spoil):
    files = CalibrationFiles(tmp_path, b"settings")
    make_board(files).configure()
    (file,) = tmp_path.iterdir()
    file.write_text(spoil(file.read_text()))
    board.executed.clear()
    with expect_refusal(ErrorCode.FILE_DAMAGED, file):
        make_board(files).configure()
    assert RestoreCalibration.ID not in board.executed
