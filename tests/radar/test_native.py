"""All boards of a rig under native control: armed and done together, reset and reopened after faults, reported."""

import json
from pathlib import Path

import pytest
from tests.support.radar.boards import BoardWords, change_radar_table
from tests.support.refusals import expect_refusal

from polysight.radar import board as boards
from polysight.radar.commands import GET_DIE_ID
from polysight.radar.control import NativeRadars, RadarState, make_radar_board
from polysight.radar.diagnosis import ReplayedWords, read_trace
from polysight.store.manifest import decode_line, encode_line
from polysight_shared.config import Instrument, NativeRadar, Radar
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.tables import decode, to_builtins
from polysight_simulators.radars import RadarBoard, make_image

# Period of the published rig's pulses.
PERIOD_S = 1.5e-3
# Frames of a row, each started by a pulse: fewer than in a scan, for a fast test.
FRAMES = 24


class Link(BoardWords):
    """A link that can be lost permanently."""

    lost = False

    def write(self, words):
        self._check()
        super().write(words)

    def read(self, count):
        self._check()
        return super().read(count)

    def interrupt(self):
        self._check()
        return super().interrupt()

    def reset(self, held):
        self._check()
        super().reset(held)

    def _check(self) -> None:
        if self.lost or self.closed:
            raise DeviceError("the USB device is gone")


class Usb:
    """Simulated boards by USB serial number; RH cannot be opened before `back_at`."""

    def __init__(self, rig: Instrument, clock) -> None:
        self.clock = clock
        self.boards = {
            b.usb_serial: RadarBoard(lambda: clock.time, flash=make_image(), die_number=n)
            for n, b in enumerate(rig.radar.native.values(), 1)
        }
        self.links: dict[str, list[Link]] = {serial: [] for serial in self.boards}
        self.back_at = 0.0

    def open(self, serial: str) -> Link:
        if serial == "FTRH" and self.clock.now() < self.back_at:
            raise DeviceError("no such USB device")
        self.links[serial].append(Link(self.boards[serial], self.clock))
        return self.links[serial][-1]

    def unplug(self, for_s: float) -> None:
        self.links["FTRH"][-1].lost = True
        self.back_at = self.clock.now() + for_s

    def pulses(self, count: int, but: str = "") -> None:
        """Send pulses to all boards but one."""
        for _ in range(count):
            for serial, board in self.boards.items():
                if serial != but:
                    board.trigger()
            self.clock.sleep(PERIOD_S)


@pytest.fixture
def usb(rig, clock) -> Usb:
    return Usb(rig, clock)


@pytest.fixture
def radars(rig, usb, clock):
    with NativeRadars(rig, usb.open, clock) as native_radars:
        yield native_radars


def test_each_board_is_identified_by_its_serial_number(rig, radars, usb):
    assert radars.states() == {}
    for board in rig.boards:
        # Byte 18 of the chirp (message 0x0101) has a bit for each transmitter.
        transmitters = usb.boards[f"FT{board.name}"].settings[0x0101][18]
        assert transmitters == (0b010 if board.role == "transmit" else 0)


def test_a_row_is_done_when_every_board_reports_it(radars, usb):
    radars.arm(FRAMES)
    assert {s.state for s in radars.states().values()} == {RadarState.ARMED}
    radars.note_row_start()
    usb.pulses(FRAMES - 1)
    assert {s.state for s in radars.states().values()} == {RadarState.ARMED}
    usb.pulses(1)
    assert {n: s.state for n, s in radars.states().items()} == dict.fromkeys(("LS", "RH", "RV"), RadarState.DONE)


def test_a_board_that_missed_a_pulse_is_not_done(radars, usb):
    radars.arm(FRAMES)
    usb.pulses(1, but="FTRV")
    usb.pulses(FRAMES - 1)
    states = radars.states()
    assert states["RH"].state is RadarState.DONE
    assert states["RV"].state is RadarState.ARMED
    assert radars.wait_done(3.0) == ["RV"]
    radars.arm(FRAMES)
    usb.pulses(FRAMES)
    assert radars.wait_done(3.0) == []


def test_two_names_for_one_board_are_refused(rig, usb, clock):
    # The chip at RV's serial number reports the die id of the one at RH's.
    usb.boards["FTRV"].cores.die_number = 2
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "RH and RV"):
        NativeRadars(rig, usb.open, clock)


@pytest.mark.parametrize("die_id", ["zero", "refused"])
def test_the_calibration_of_boards_without_a_die_id_is_not_saved(rig, usb, clock, tmp_path, monkeypatch, die_id):
    """A file without a die id would be used for several boards, whose gains and filters differ."""

    def refuse_die_id(execute):
        def execute_or_refuse(number, *rest):
            if number == GET_DIE_ID.ID:
                error_number = 6
                no_data = b""
                no_delay_s = 0.0
                return error_number, no_data, no_delay_s
            return execute(number, *rest)

        return execute_or_refuse

    for board in usb.boards.values():
        board.cores.die_number = 0
        if die_id == "refused":
            monkeypatch.setattr(board.cores, "execute", refuse_die_id(board.cores.execute))
    rig_with_calibration = change_radar_table(rig, calibration_dir=str(tmp_path))
    with NativeRadars(rig_with_calibration, usb.open, clock) as radars:
        assert list(tmp_path.iterdir()) == []
        assert str(radars.report()).count("its calibration is not saved") == len(usb.boards)


def test_after_a_fault_the_next_row_resets_only_that_board(radars, usb):
    radars.arm(FRAMES)
    # The second pulse comes within the first one's frame.
    faulty_board = usb.boards["FTRH"]
    faulty_board.trigger()
    faulty_board.trigger()
    states = radars.states()
    assert states["RH"].state is RadarState.FAULT
    assert "not triggered by a pulse" in states["RH"].detail
    assert states["RV"].state is RadarState.ARMED
    radars.arm(FRAMES)
    # A reset is followed by a power-up of the RF core.
    rf_power_up = 0x4000
    assert faulty_board.executed.count(rf_power_up) == 2
    assert usb.boards["FTRV"].executed.count(rf_power_up) == 1
    usb.pulses(FRAMES)
    assert {s.state for s in radars.states().values()} == {RadarState.DONE}


def test_the_report_fits_the_manifest_and_is_returned_once(radars):
    radars.arm(FRAMES)
    result = radars.report()
    assert decode_line(encode_line({"fact": "radars", **result})) == {
        "fact": "radars",
        **json.loads(json.dumps(result)),
    }
    assert set(result["boards"]) == {"LS", "RH", "RV"}
    assert result["boards"]["RV"]["rf_firmware"] == "2.2.1.7 patch 2.2.4.0"
    assert set(result["boards"]["RV"]["temperatures_c"]) >= {"rx1", "tx3"}
    # All messages of the bring-up and the arming, 53 here
    assert len(result["boards"]["RV"]["sent"]) > 40
    # The receivers' offset puts the direct path in the middle of the band.
    middle_of_band_hz = 0.45 * 2.15e6
    assert result["direct_if_hz"]["RH"] == pytest.approx(middle_of_band_hz, rel=0.05)
    assert any(c.startswith("IF budget of RV") for c in result["constraints"])
    second_report = radars.report()
    assert second_report["boards"]["RV"]["sent"] == []
    assert "constraints" not in second_report


def test_settings_that_the_radar_cannot_have_are_refused_before_a_board_is_opened(rig, usb, clock):
    def fail_to_open(serial: str) -> BoardWords:
        raise AssertionError(f"{serial} was opened")

    invalid_rig = change_radar_table(rig, rx_gain_db=31)
    with expect_refusal(ErrorCode.VALUE_INVALID, "RX gain step"):
        NativeRadars(invalid_rig, fail_to_open, clock)
    with NativeRadars(rig, usb.open, clock) as native_radars, expect_refusal(ErrorCode.VALUE_INVALID, "frames"):
        native_radars.arm(65536)


def test_a_board_that_fails_at_the_start_closes_the_others(rig, usb, clock):
    usb.boards["FTRV"].cores.flash = b""
    with expect_refusal(ErrorCode.RADAR_NO_FIRMWARE, "RV"):
        NativeRadars(rig, usb.open, clock)
    assert all(link.closed for links in usb.links.values() for link in links)


def test_the_rig_file_must_have_every_board_and_each_serial_once(rig):
    table = to_builtins(rig)
    del table["radar"]["native"]["RV"]
    with expect_refusal(ErrorCode.VALUE_INVALID, "radar.native"):
        decode(table, Instrument, "rig.toml")
    twice = {n: NativeRadar("FT1") for n in ("LS", "RH", "RV")}
    with pytest.raises(ValueError, match="usb_serial"):
        Radar(control="native", native=twice)
    assert decode(to_builtins(rig), Instrument, "rig.toml") == rig


# --- lost links, traces ---


def run_row(radars, usb) -> dict[str, RadarState]:
    """Arm the radars and send the pulses of a row; return the state of each board."""
    radars.arm(FRAMES)
    usb.pulses(FRAMES)
    return {name: s.state for name, s in radars.states().items()}


def load_traces(radars) -> list[dict[str, str]]:
    result = radars.report()["traces"]
    assert isinstance(result, list)
    return result


ALL_DONE = dict.fromkeys(("LS", "RH", "RV"), RadarState.DONE)


@pytest.mark.parametrize("for_s", [0.0, 2.0])
def test_a_lost_link_is_reopened(radars, usb, for_s):
    assert run_row(radars, usb) == ALL_DONE
    usb.unplug(for_s)
    assert radars.states()["RH"].state is RadarState.FAULT
    assert run_row(radars, usb) == ALL_DONE
    assert [len(usb.links[s]) for s in ("FTLS", "FTRH", "FTRV")] == [1, 2, 1]
    assert usb.links["FTRH"][0].closed


def test_a_link_that_cannot_be_reopened_is_a_fault_of_that_board_only(radars, usb):
    usb.unplug(for_s=20.0)
    radars.arm(FRAMES)
    result = radars.states()
    assert (result["RH"].state, result["RV"].state) == (RadarState.FAULT, RadarState.ARMED)
    assert "USB" in result["RH"].detail
    usb.clock.sleep(20.0)
    assert run_row(radars, usb) == ALL_DONE


def test_every_link_of_a_scan_is_traced_and_replays(rig, usb, clock, tmp_path):
    traced_rig = change_radar_table(rig, trace_dir=str(tmp_path / "traces"))
    with NativeRadars(traced_rig, usb.open, clock) as radars:
        assert run_row(radars, usb) == ALL_DONE
        usb.unplug(0.0)
        assert run_row(radars, usb) == ALL_DONE
        result = load_traces(radars)
    files = sorted((tmp_path / "traces").iterdir())
    assert sorted(t["file"] for t in result) == [str(f) for f in files]
    assert [read_trace(f)[0]["board"] for f in files] == ["LS", "RH", "RH", "RV"]
    lines = read_trace(files[1])[1] + read_trace(files[2])[1]
    assert any(line.error is not None for line in lines)
    # The first link's trace replays the bring-up without the board.
    replayed = ReplayedWords(files[0])
    # A trace is both the link to the board and its clock.
    replayed_board = make_radar_board(rig, "LS", words=replayed, clock=replayed, firmware=None)
    replayed_board.configure()
    replayed_board.arm(FRAMES)


def test_a_full_disk_ends_a_trace_but_no_row(rig, usb, clock, tmp_path, monkeypatch):
    monkeypatch.setattr("polysight.radar.control.new_trace", lambda *_: Path("/dev/full"))
    traced_rig = change_radar_table(rig, trace_dir=str(tmp_path))
    with NativeRadars(traced_rig, usb.open, clock) as radars:
        assert run_row(radars, usb) == ALL_DONE
        result = load_traces(radars)
    assert len(result) == 3
    assert all("No space" in t["ended"] for t in result)


def test_a_fatal_event_during_arming_is_retried(radars, usb, monkeypatch):
    """The board faults once at its start."""
    arm = boards.RadarBoard.arm
    failed = []

    def fail_once(board, frames) -> None:
        if board.name == "RV" and not failed:
            failed.append(board.name)
            board.fail("RF core fault")
            raise DeviceError("RV: RF core fault")
        arm(board, frames)

    monkeypatch.setattr(boards.RadarBoard, "arm", fail_once)
    assert run_row(radars, usb) == ALL_DONE
    assert failed == ["RV"]
