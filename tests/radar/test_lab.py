"""Beyond a scan: several profiles and chirps, reading back, calibration kept, a tone, advanced frames."""

from __future__ import annotations

import json
import struct

import pytest

from polysight.host.radar import lab_commands as lab
from polysight.host.radar.board import RadarBoard, State
from polysight.host.radar.calibration_data import CalibrationFiles
from polysight.host.radar.commands import (
    GET_DIE_ID,
    SLOPE_HZ_PER_S_PER_CODE,
    START,
    START_HZ_PER_CODE,
    Chirp,
    Command,
    FrameControl,
    Profile,
)
from polysight.host.radar.messages import command, decode
from polysight.host.radar.program import program
from polysight.shared.errors import ConfigError, DeviceError

FRAMES = 4

# What TI's mmWaveLink library writes to its SPI driver for these parameters, without asking for an acknowledgement.
_TONE = lab.StreamTone(1435384036 * START_HZ_PER_CODE, 5e6, 40, tx_backoff_db=3, rf_gain_target_db=36)
_PARTS = (lab.SubFrame(0, 1, 16, 3000.0, 1, 6000.0), lab.SubFrame(1, 2, 16, 3000.0, 2, 6000.0))
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
    (lab.ReadProfile(2), "34122143410218000c040000010099f920010800020000001afb47ba"),
    (lab.ReadChirp(12), "34122143410218000c140000010099e9210108000c000c00851e25d2"),
    (lab.ReadFrame(), "34122143410214000c24000001009dd922010400a14f580e"),
    (lab.InitCalibrations(0x0B10), "34122143010120000c4400000100d1ba89001000100b00000000000000000000d0762e17"),
    (lab.SaveCalibration(0), "34122143410118000c540000010099aaab0008000000000081be78de"),
    (lab.SaveCalibration(1), "34122143410118000c6400000100999aab00080000000100c3eef525"),
    (lab.SaveCalibration(2), "34122143410118000c7400000100998aab000800000002003e607ae6"),
    (
        lab.RestoreCalibration(2, bytes((448 + k) * 7 % 251 for k in range(224))),
        "341221430101f8000ca400000100f9598b00e800030002007c838a91989fa6adb4bbc2c9d0d7dee5ecf3fa060d141b222930"
        "373e454c535a61686f767d848b9299a0a7aeb5bcc3cad1d8dfe6edf400070e151c232a31383f464d545b626970777e858c93"
        "9aa1a8afb6bdc4cbd2d9e0e7eef501080f161d242b323940474e555c636a71787f868d949ba2a9b0b7bec5ccd3dae1e8eff6"
        "020910171e252c333a41484f565d646b727980878e959ca3aab1b8bfc6cdd4dbe2e9f0f7030a11181f262d343b424950575e"
        "656c737a81888f969da4abb2b9c0c7ced5dce3eaf1f8040b121920272e353c434a51585f666d747b828990979ea5acb36df8"
        "cb05",
    ),
    (_TONE, "34122143010228000cb400000100c94903011800e4388e55030303000000000088130000a80000007ecdceb0"),
    (lab.StreamEnable(True), "34122143010218000cc400000100d939040108000100000060173742"),
    (lab.StreamData(True), "34122143858018000cd40000010054ab4640080001000000afaeb0b3"),
    (
        lab.AdvancedFrame(_PARTS, 350),
        "341221430102a8000ce400000100491905019800020000000000000001001000c02709000000010001000000804f12000000"
        "0000000000000000010002001000c02709000000020001000000804f12000000000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "00005e01020000000000000000000000000069619e48",
    ),
    (
        lab.AdvancedFrameApply(_PARTS, 256),
        "34122143858138000c0400000100357ac1402800020000001000000000020100400000000002010000000000000000000000"
        "0000000000006ad6ca8e",
    ),
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


def test_what_is_read_back_is_what_was_sent(made, board):
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
        assert link.call(lab.ReadProfile(n)).blocks[0].data == profile(n).data()
        assert struct.unpack_from("<3H", link.call(lab.ReadChirp(10 * n + 2)).blocks[0].data)[2] == n
    for wrong in (profile(4), Chirp(0, first=3, last=2), Chirp(0, first=0, last=512), Chirp(0, profile=5)):
        with pytest.raises(DeviceError, match="refuses"):
            link.call(wrong)


def test_a_calibration_is_kept_and_given_back_at_the_next_start(made, board, tmp_path):
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
    assert board.executed.count(lab.RestoreCalibration.ID) == 3
    mask = struct.unpack_from("<I", board.settings[lab.InitCalibrations.ID])[0]
    assert mask & lab.RESTORED_CALIBRATIONS == 0
    assert mask | lab.RESTORED_CALIBRATIONS == lab.ALL_CALIBRATIONS
    assert again.state is State.CONFIGURED


NEEDED = {1: "clock PLL", 2: "VCO1", 3: "VCO2", 4: "LO", 5: "ADC", 6: "high-pass", 7: "low-pass", 10: "gain", 12: "I/Q"}
OF_TX = {8: "peak", 9: "TX power", 11: "TX phase"}


@pytest.mark.parametrize("name", ["LS", "RH"])
@pytest.mark.parametrize(("bit", "said"), (NEEDED | OF_TX).items())
def test_an_rf_init_that_did_not_pass_is_refused_and_never_kept(rig, words, clock, board, tmp_path, name, bit, said):
    """Bits of ICD 217; those of the transmitters are needed by the board that transmits."""
    board.cores.passes = 0x1FFE & ~(1 << bit)
    files = CalibrationFiles(tmp_path / "kept", b"settings")
    radar = RadarBoard(name, words, clock, program(rig, rig.by_name(name)), calibration=files)
    if name == "RH" and bit in OF_TX:
        radar.configure()
        return
    with pytest.raises(DeviceError, match=rf"RF init did not pass: .*{said}"):
        radar.configure()
    assert not (tmp_path / "kept").exists()
    assert 0x0100 not in board.executed


def test_what_a_start_that_did_not_pass_left_behind_is_never_given_back(made, tmp_path):
    files = CalibrationFiles(tmp_path, b"settings")
    made(files).configure()
    (file,) = tmp_path.iterdir()
    die, data = json.loads(file.read_text())["die_id"], bytearray.fromhex(json.loads(file.read_text())["data"])
    data[:4] = (0x1FFE & ~(1 << 10)).to_bytes(4, "little")
    files.save(die, bytes(data))
    with pytest.raises(ConfigError, match="RF init did not pass"):
        made(files).configure()


def test_other_settings_or_another_die_have_a_calibration_of_their_own(made, board, tmp_path):
    made(CalibrationFiles(tmp_path, b"settings")).configure()
    made(CalibrationFiles(tmp_path, b"others")).configure()
    board.cores.die = 7
    made(CalibrationFiles(tmp_path, b"settings")).configure()
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    "spoil", [lambda t: t[: len(t) // 2], lambda t: t.replace('"crc32": ', '"crc32": 1'), lambda t: t[:0] + "[]"]
)
def test_a_damaged_calibration_is_never_given_to_a_board(made, board, tmp_path, spoil):
    files = CalibrationFiles(tmp_path, b"settings")
    made(files).configure()
    (file,) = tmp_path.iterdir()
    file.write_text(spoil(file.read_text()))
    board.executed.clear()
    with pytest.raises(ConfigError, match="calibration data"):
        made(files).configure()
    assert lab.RestoreCalibration.ID not in board.executed


def test_a_tone_is_streamed_and_ended(made, board):
    radar = made()
    radar.configure()
    radar.stream_tone(lab.StreamTone(77e9, 5e6, 40), on=True)
    assert struct.unpack_from("<I", board.settings[0x0103])[0] == round(77e9 / (3.6e9 / 2**26))
    assert board.settings[0x0104][0] == board.settings[0x4046][0] == 1
    radar.stream_tone(lab.StreamTone(77e9, 5e6, 40), on=False)
    assert board.settings[0x0104][0] == board.settings[0x4046][0] == 0


def test_an_advanced_frame_waits_for_pulses(made, board, clock):
    """ICD 98: with hardware triggers a pulse starts each burst; here one burst a frame."""
    radar = made()
    radar.configure()
    parts = (lab.SubFrame(0, 1, 4, 1300.0, 1, 1300.0),)
    link = radar._link
    link.call(lab.AdvancedFrame(parts, frames=2))
    link.call(lab.AdvancedFrameApply(parts, samples=256))
    link.call(FrameControl(START))
    assert board.ready_for_triggers
    assert board.trigger()
    clock.sleep(1.5e-3)
    assert board.trigger()
    assert not board.trigger()


def test_sizes_are_the_document_s():
    parts = (lab.SubFrame(0, 1, 16, 3000.0, 1, 3000.0),)
    sizes = {
        lab.ReadProfile(): 4, lab.ReadChirp(): 4, lab.ReadFrame(): 0, lab.InitCalibrations(): 12,
        lab.SaveCalibration(0): 4, lab.RestoreCalibration(0, bytes(224)): 228, lab.StreamTone(77e9, 5e6, 40): 20,
        lab.StreamData(True): 4, lab.StreamEnable(True): 4, lab.AdvancedFrame(parts, 1): 148,
        lab.AdvancedFrameApply(parts, 256): 36,
    }  # fmt: skip
    assert {type(one): len(one.data()) for one in sizes} == {type(one): size for one, size in sizes.items()}
    with pytest.raises(ValueError, match="sub-frames"):
        lab.AdvancedFrame((), 1).data()
