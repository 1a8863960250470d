"""All boards of a rig under native control: armed together, done together, and what the manifest keeps."""

from __future__ import annotations

import json

import msgspec
import pytest

from polysight.host.radar.backends import radar_control
from polysight.host.radar.interface import RadarState
from polysight.host.radar.native import NativeRadars
from polysight.host.store.manifest import decode_line, encode_line
from polysight.shared.config import Instrument, NativeRadar, Radar
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DeviceError
from polysight.shared.tables import decode, to_builtins
from polysight.simulators.radars import RadarBoard, UsbChip, make_image
from tests.support.radar.boards import BoardWords
from tests.support.refusals import refused

PERIOD_S = 1.5e-3
FRAMES = 24


class Boards:
    """Simulated boards by USB serial number."""

    def __init__(self, rig: Instrument, clock) -> None:
        self.clock = clock
        self.by_serial = {
            b.usb_serial: RadarBoard(lambda: clock.time, flash=make_image(), die=n)
            for n, b in enumerate(rig.radar.native.values(), 1)
        }
        self.words = {s: BoardWords(b, clock) for s, b in self.by_serial.items()}

    def pulses(self, count: int, but: str = "") -> None:
        for _ in range(count):
            for serial, board in self.by_serial.items():
                if serial != but:
                    board.trigger()
            self.clock.sleep(PERIOD_S)


@pytest.fixture
def boards(rig, clock) -> Boards:
    return Boards(rig, clock)


@pytest.fixture
def radars(rig, boards, clock):
    with NativeRadars(rig, boards.words.__getitem__, clock) as made:
        yield made


def test_each_board_is_bound_by_its_serial_number(rig, radars, boards):
    assert radars.states() == {}
    for board in rig.boards:
        tx = boards.by_serial[f"FT{board.name}"].settings[0x0101][18]
        assert tx == (0b010 if board.role == "transmit" else 0)


def test_a_row_is_done_when_every_board_says_so(radars, boards):
    radars.arm(FRAMES)
    assert {s.state for s in radars.states().values()} == {RadarState.ARMED}
    radars.row_begins()
    boards.pulses(FRAMES - 1)
    assert {s.state for s in radars.states().values()} == {RadarState.ARMED}
    boards.pulses(1)
    assert {n: s.state for n, s in radars.states().items()} == dict.fromkeys(("LS", "RH", "RV"), RadarState.DONE)


def test_a_board_that_missed_a_pulse_still_waits(radars, boards):
    radars.arm(FRAMES)
    boards.pulses(1, but="FTRV")
    boards.pulses(FRAMES - 1)
    states = radars.states()
    assert states["RH"].state is RadarState.DONE
    assert states["RV"].state is RadarState.ARMED
    assert radars.wait_done(3.0) == ["RV"]
    radars.arm(FRAMES)
    boards.pulses(FRAMES)
    assert radars.wait_done(3.0) == []


def test_a_board_in_fault_is_not_done(radars, boards):
    radars.arm(FRAMES)
    boards.by_serial["FTRH"].say(0x1002, bytes(4))
    boards.pulses(FRAMES)
    assert radars.wait_done(3.0) == ["RH"]


def test_two_names_of_one_board_are_refused(rig, boards, clock):
    boards.by_serial["FTRV"].cores.die = 2
    with pytest.raises(DeviceError, match="RH and RV"):
        NativeRadars(rig, boards.words.__getitem__, clock)


def test_boards_without_a_die_id_keep_no_calibration(rig, boards, clock, tmp_path):
    for board in boards.by_serial.values():
        board.cores.die = 0
    kept = msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, calibration_dir=str(tmp_path)))
    with NativeRadars(kept, boards.words.__getitem__, clock):
        assert list(tmp_path.iterdir()) == []


def test_a_fault_is_told_and_the_next_row_resets_that_board_alone(radars, boards):
    radars.arm(FRAMES)
    bad = boards.by_serial["FTRH"]
    bad.trigger()
    bad.trigger()
    states = radars.states()
    assert states["RH"].state is RadarState.FAULT
    assert "not triggered by a pulse" in states["RH"].detail
    assert states["RV"].state is RadarState.ARMED
    radars.arm(FRAMES)
    assert bad.executed.count(0x4000) == 2
    assert boards.by_serial["FTRV"].executed.count(0x4000) == 1
    boards.pulses(FRAMES)
    assert {s.state for s in radars.states().values()} == {RadarState.DONE}


def test_the_report_fits_the_manifest_and_is_told_once(radars):
    radars.arm(FRAMES)
    told = radars.report()
    assert decode_line(encode_line({"fact": "radars", **told})) == {"fact": "radars", **json.loads(json.dumps(told))}
    assert set(told["boards"]) == {"LS", "RH", "RV"}
    assert told["boards"]["RV"]["rf_firmware"] == "2.2.1.7 patch 2.2.4.0"
    assert set(told["boards"]["RV"]["temperatures_c"]) >= {"rx1", "tx3"}
    assert len(told["boards"]["RV"]["sent"]) > 40
    assert 0.9e6 < told["direct_if_hz"]["RH"] < 1.05e6
    assert any(c.startswith("IF budget of RV") for c in told["constraints"])
    again = radars.report()
    assert again["boards"]["RV"]["sent"] == []
    assert "constraints" not in again


def test_a_broken_constraint_is_refused_before_a_byte_is_written(rig, clock, boards):
    def never(serial: str) -> BoardWords:
        raise AssertionError(f"{serial} was opened")

    wrong = msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, rx_gain_db=31))
    with refused(ErrorCode.VALUE_INVALID, "RX gain step"):
        NativeRadars(wrong, never, clock)
    with NativeRadars(rig, boards.words.__getitem__, clock) as made, refused(ErrorCode.VALUE_INVALID, "frames"):
        made.arm(65536)


def test_ldo_bypass_never_reaches_a_board_without_its_acknowledgement(rig, clock, boards):
    native = {n: msgspec.structs.replace(b, ldo_bypass=True) for n, b in rig.radar.native.items()}
    wrong = msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, native=native))
    with refused(ErrorCode.VALUE_INVALID, "LDO bypass of LS"):
        NativeRadars(wrong, boards.words.__getitem__, clock)
    assert not any(b.destroyed for b in boards.by_serial.values())


def test_a_board_that_fails_at_the_start_closes_the_others(rig, clock, boards):
    boards.by_serial["FTRV"].cores.flash = b""
    with refused(ErrorCode.RADAR_NO_FIRMWARE, "RV"):
        NativeRadars(rig, boards.words.__getitem__, clock)
    assert all(w.closed for w in boards.words.values())


def test_three_boards_behind_usb(rig, clock, boards):
    from polysight.host.radar.usb import UsbWords

    chips = {s: UsbChip(b) for s, b in boards.by_serial.items()}
    with NativeRadars(
        rig, lambda s: UsbWords(*(chips[s].channel(n) for n in "ABCD"), sleep=clock.sleep), clock
    ) as made:
        made.arm(FRAMES)
        boards.pulses(FRAMES)
        assert {s.state for s in made.states().values()} == {RadarState.DONE}
    assert [c.errors for c in chips.values()] == [[], [], []]


def test_the_rig_file_must_name_every_board_and_each_serial_once(rig):
    table = to_builtins(rig)
    del table["radar"]["native"]["RV"]
    with refused(ErrorCode.VALUE_INVALID, "radar.native"):
        decode(table, Instrument, "rig.toml")
    twice = {n: NativeRadar("FT1") for n in ("LS", "RH", "RV")}
    with pytest.raises(ValueError, match="usb_serial"):
        Radar(control="native", native=twice)
    assert decode(to_builtins(rig), Instrument, "rig.toml") == rig


def test_the_backend_is_chosen_by_the_rig_file(rig, monkeypatch):
    monkeypatch.setattr(
        "polysight.host.radar.native.NativeRadars.__init__", lambda self, rig: setattr(self, "rig", rig)
    )
    made = radar_control(rig)
    assert isinstance(made, NativeRadars)
