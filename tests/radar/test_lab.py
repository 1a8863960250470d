"""Beyond a scan: several profiles and chirps, reading back, calibration kept, a tone, advanced frames."""

from __future__ import annotations

import json
import struct

import pytest

from polysight.host.radar import lab_commands as lab
from polysight.host.radar.board import RadarBoard, State
from polysight.host.radar.calibration_data import CalibrationFiles
from polysight.host.radar.commands import START, Chirp, FrameControl, Profile
from polysight.host.radar.program import program
from polysight.shared.errors import ConfigError, DeviceError

FRAMES = 4


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
