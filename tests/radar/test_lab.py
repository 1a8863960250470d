"""Commands beyond a scan: several profiles and chirps, reading back, stored calibration, a tone."""

from __future__ import annotations

import json
import struct

import pytest

from polysight.host.radar.board import RadarBoard, State
from polysight.host.radar.calibration_data import (
    ALL,
    RESTORED,
    CalibrationFiles,
    InitCalibrations,
    RestoreCalibration,
    SaveCalibration,
)
from polysight.host.radar.commands import (
    GET_DIE_ID,
    READ_FRAME,
    SLOPE_HZ_PER_S_PER_CODE,
    START_HZ_PER_CODE,
    Chirp,
    Command,
    Profile,
    ReadChirp,
    ReadProfile,
    StreamTone,
    stream_commands,
)
from polysight.host.radar.messages import command, decode
from polysight.host.radar.program import program
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DeviceError
from tests.support.refusals import refused

FRAMES = 4

# What TI's mmWaveLink library writes to its SPI driver for these parameters, without asking for an acknowledgement.
_TONE = StreamTone(1435384036 * START_HZ_PER_CODE, 5e6, 40, tx_backoff_db=3, rf_gain_target_db=36)
_PROFILE = Profile(
    1435384036 * START_HZ_PER_CODE,
    414 * SLOPE_HZ_PER_S_PER_CODE,
    10.0,
    7.0,
    60.0,
    64,
    5e6,
    175.0,
    350.0,
    40,
    36,
    index=3,
)
VECTORS: list[tuple[Command, str]] = [
    (ReadProfile(2), "34122143410218000c040000010099f920010800020000001afb47ba"),
    (ReadChirp(12), "34122143410218000c140000010099e9210108000c000c00851e25d2"),
    (READ_FRAME, "34122143410214000c24000001009dd922010400a14f580e"),
    (InitCalibrations(0x0B10), "34122143010120000c4400000100d1ba89001000100b00000000000000000000d0762e17"),
    (SaveCalibration(0), "34122143410118000c540000010099aaab0008000000000081be78de"),
    (SaveCalibration(1), "34122143410118000c6400000100999aab00080000000100c3eef525"),
    (SaveCalibration(2), "34122143410118000c7400000100998aab000800000002003e607ae6"),
    (
        RestoreCalibration(2, bytes((448 + k) * 7 % 251 for k in range(224))),
        "341221430101f8000ca400000100f9598b00e800030002007c838a91989fa6adb4bbc2c9d0d7dee5ecf3fa060d141b222930"
        "373e454c535a61686f767d848b9299a0a7aeb5bcc3cad1d8dfe6edf400070e151c232a31383f464d545b626970777e858c93"
        "9aa1a8afb6bdc4cbd2d9e0e7eef501080f161d242b323940474e555c636a71787f868d949ba2a9b0b7bec5ccd3dae1e8eff6"
        "020910171e252c333a41484f565d646b727980878e959ca3aab1b8bfc6cdd4dbe2e9f0f7030a11181f262d343b424950575e"
        "656c737a81888f969da4abb2b9c0c7ced5dce3eaf1f8040b121920272e353c434a51585f666d747b828990979ea5acb36df8"
        "cb05",
    ),
    (_TONE, "34122143010228000cb400000100c94903011800e4388e55030303000000000088130000a80000007ecdceb0"),
    (stream_commands(True)[1], "34122143010218000cc400000100d939040108000100000060173742"),
    (stream_commands(True)[0], "34122143858018000cd40000010054ab4640080001000000afaeb0b3"),
    (GET_DIE_ID, "34122143410414000c14000001009de723020400940f23a0"),
    (
        _PROFILE,
        "34122143010240000c2400000100b1d90001300003000000e4388e55e8030000bc0200007017000000000000000000009e01"
        "00004000881300000000a80000007f56dae3",
    ),
    (
        Chirp(0, first=30, last=34, profile=3),
        "34122143010228000c3400000100c9c9010118001e002200030000000000000000000000000000003dfbe877",
    ),
]


@pytest.mark.parametrize(
    ("sent", "expected"), VECTORS, ids=lambda v: type(v).__name__ if isinstance(v, Command) else ""
)
def test_sub_blocks_are_those_of_ti_s_library(sent, expected):
    message = decode(bytes.fromhex(expected))
    assert message.blocks == (sent.block(),)
    assert command((sent.block(),)).direction is message.direction


@pytest.fixture
def made(rig, words, clock):
    def make(calibration=None) -> RadarBoard:
        return RadarBoard("RH", words, clock, program(rig, rig.by_name("RH")), calibration=calibration)

    return make


def profile(index: int) -> Profile:
    return Profile(77e9, 20e12, 10.0, 7.0, 60.0, 64, 5e6, 175.0, 350.0, 40, 36, index=index)


def test_settings_are_read_back_as_sent(made, board):
    radar = made()
    radar.configure()
    radar.arm(FRAMES)
    assert radar.read_back() == []
    board.cores.profiles[0] = board.cores.profiles[0][:4] + b"\0" + board.cores.profiles[0][5:]
    (difference,) = radar.read_back()
    assert difference.startswith("0x0100: sent ")


def test_four_profiles_and_chirps_of_each(made, board):
    radar = made()
    radar.configure()
    link = radar._link
    for n in range(1, 4):
        link.call(profile(n))
        link.call(Chirp(0, first=10 * n, last=10 * n + 4, profile=n))
    assert sorted(board.cores.profiles) == [0, 1, 2, 3]
    for n in range(1, 4):
        assert link.call(ReadProfile(n)).blocks[0].data == profile(n).data()
        assert struct.unpack_from("<3H", link.call(ReadChirp(10 * n + 2)).blocks[0].data)[2] == n
    for wrong in (profile(4), Chirp(0, first=3, last=2), Chirp(0, first=0, last=512), Chirp(0, profile=5)):
        with refused(ErrorCode.REFUSED_BY_PEER):
            link.call(wrong)


def test_a_calibration_is_saved_and_restored_at_the_next_start(made, board, tmp_path):
    files = CalibrationFiles(tmp_path / "kept", b"settings")
    first = made(files)
    first.configure()
    assert first.facts["calibration_restored"] is False
    (file,) = (tmp_path / "kept").iterdir()
    assert json.loads(file.read_text())["die_id"] == first.facts["die_id"]
    board.executed.clear()
    again = made(files)
    again.configure()
    assert again.facts["calibration_restored"] is True
    assert board.executed.count(RestoreCalibration.ID) == 3
    mask = struct.unpack_from("<I", board.settings[InitCalibrations.ID])[0]
    assert mask & RESTORED == 0
    assert mask | RESTORED == ALL
    assert again.state is State.CONFIGURED


NEEDED = {1: "clock PLL", 2: "VCO1", 3: "VCO2", 4: "LO", 5: "ADC", 6: "high-pass", 7: "low-pass", 10: "gain", 12: "I/Q"}
OF_TX = {8: "peak", 9: "TX power", 11: "TX phase"}


@pytest.mark.parametrize("name", ["LS", "RH"])
@pytest.mark.parametrize(("bit", "said"), (NEEDED | OF_TX).items())
def test_a_failed_rf_init_is_refused_and_not_saved(rig, words, clock, board, tmp_path, name, bit, said):
    """Bits of ICD 217; those of the transmitters are needed by the board that transmits."""
    board.cores.passes = 0x1FFE & ~(1 << bit)
    files = CalibrationFiles(tmp_path / "kept", b"settings")
    radar = RadarBoard(name, words, clock, program(rig, rig.by_name(name)), calibration=files)
    if name == "RH" and bit in OF_TX:
        radar.configure()
        return
    with pytest.raises(DeviceError, match=said):
        radar.configure()
    assert not (tmp_path / "kept").exists()
    assert 0x0100 not in board.executed


def test_a_saved_calibration_of_a_failed_rf_init_is_not_restored(made, tmp_path):
    files = CalibrationFiles(tmp_path, b"settings")
    made(files).configure()
    (file,) = tmp_path.iterdir()
    die, data = json.loads(file.read_text())["die_id"], bytearray.fromhex(json.loads(file.read_text())["data"])
    data[:4] = (0x1FFE & ~(1 << 10)).to_bytes(4, "little")
    files.save(die, bytes(data))
    with refused(ErrorCode.VALUE_INVALID, file):
        made(files).configure()


def test_other_settings_and_other_dies_have_their_own_calibration(made, board, tmp_path):
    made(CalibrationFiles(tmp_path, b"settings")).configure()
    made(CalibrationFiles(tmp_path, b"others")).configure()
    board.cores.die = 7
    made(CalibrationFiles(tmp_path, b"settings")).configure()
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    "spoil", [lambda t: t[: len(t) // 2], lambda t: t.replace('"crc32": ', '"crc32": 1'), lambda t: t[:0] + "[]"]
)
def test_a_damaged_calibration_is_not_sent_to_a_board(made, board, tmp_path, spoil):
    files = CalibrationFiles(tmp_path, b"settings")
    made(files).configure()
    (file,) = tmp_path.iterdir()
    file.write_text(spoil(file.read_text()))
    board.executed.clear()
    with refused(ErrorCode.FILE_DAMAGED, file):
        made(files).configure()
    assert RestoreCalibration.ID not in board.executed


def test_a_tone_is_streamed_and_ended(made, board):
    radar = made()
    radar.configure()
    radar.stream_tone(StreamTone(77e9, 5e6, 40), on=True)
    assert struct.unpack_from("<I", board.settings[0x0103])[0] == round(77e9 / (3.6e9 / 2**26))
    assert board.settings[0x0104][0] == board.settings[0x4046][0] == 1
    radar.stream_tone(StreamTone(77e9, 5e6, 40), on=False)
    assert board.settings[0x0104][0] == board.settings[0x4046][0] == 0
