"""A board's states: each is entered only after a report of the radar; each fatal event is a fault with its reason."""

import struct

import msgspec
import pytest
from tests.support.radar.boards import Restarts
from tests.support.refusals import expect_refusal

from polysight.radar.board import RadarBoard, State
from polysight.radar.commands import (
    RF_POWER_UP,
    SOFTWARE_TRIGGER,
    START,
    STOP_AT_FRAME_END,
    Frame,
    FrameApply,
    FrameControl,
    make_program,
)
from polysight.radar.firmware import check_image
from polysight.radar.link import NotReportedError
from polysight.radar.messages import ANALOG_FAULT, FRAME_END, MAIN_CPU_FAULT, RF_CPU_FAULT, RF_ERROR, RF_ESM_FAULT
from polysight_shared.errors import ErrorCode
from polysight_simulators.radars import Fault, board as simulated, cores, make_image

# Frames of a row, each started by a pulse: fewer than in a scan, for a fast test.
FRAMES = 32
# Period of the published rig's pulses.
PERIOD_S = 1.5e-3
# Numbers of messages and events
DATA_FORMAT = 0x0082
PROFILE = 0x0100
FRAME = 0x0102
FRAME_APPLY = 0x40C0
READY_FOR_TRIGGERS = 0x100B
REPORT_OF_CALIBRATION = 0x1012
POWER_UP = 0x5000
# Error number with which a board refuses a command
REFUSED = 6


@pytest.fixture
def radar(rig, words, clock) -> RadarBoard:
    return RadarBoard("LS", words, clock, make_program(rig, rig.by_name("LS")))


def send_pulses(board: simulated.RadarBoard, clock, count: int, period_s: float = PERIOD_S) -> None:
    for _ in range(count):
        board.trigger()
        clock.sleep(period_s)


def test_a_board_goes_from_off_to_done_with_the_last_pulse_of_a_row(radar, board, clock):
    assert radar.state is State.OFF
    radar.configure()
    assert radar.state is State.CONFIGURED
    radar.arm(FRAMES)
    assert radar.state is State.ARMED
    radar.note_pulses()
    assert radar.state is State.RUNNING
    send_pulses(board, clock, FRAMES - 1)
    assert radar.poll() is State.RUNNING
    send_pulses(board, clock, 1)
    assert radar.poll() is State.DONE


def test_frames_of_a_software_trigger_without_number_run_until_they_are_stopped(radar, board, clock):
    """None of these steps waits for SYNC_IN."""
    radar.configure()
    for command in radar.program.make_frame_commands(0, SOFTWARE_TRIGGER):
        radar.link.call(command)
    radar.link.call(FrameControl(START))
    clock.sleep(1.0)
    with pytest.raises(NotReportedError):
        radar.link.wait_for((FRAME_END,), 1.0, lambda _: None)
    assert not board.trigger()
    radar.link.call(FrameControl(STOP_AT_FRAME_END))
    assert radar.link.wait_for((FRAME_END,), 1.0, lambda _: None).id == FRAME_END


def test_every_message_of_bring_up_and_arming_is_sent_once_in_order(radar, board):
    """Numbers of messages are those of TI's interface control document (docs/spec/mmwavelink.md).

    The frequencies of the profile are codes: 76.01 GHz and the board's offset in steps of 53.6 Hz, 38.8 MHz/us in steps
    of 48.3 kHz/us.
    """
    radar.configure()
    radar.arm(FRAMES)
    expected = [0x404C, 0x4000, 0x0220, 0x40E0, 0x0080, 0x0082, 0x02CC, 0x4041, 0x0083, 0x008D, 0x0086, 0x00C0]
    expected += [0x0100, 0x0101, 0x4042, 0x4044, 0x0085, 0x4043, 0x4045, 0x0223, 0x02EA, 0x0102, 0x40C0, 0x0140]
    assert board.executed == expected
    (start_code,) = struct.unpack_from("<I", board.settings[PROFILE], 4)
    (slope_code,) = struct.unpack_from("<h", board.settings[PROFILE], 28)
    assert (start_code, slope_code) == (1416929098, 804)
    (frames,) = struct.unpack_from("<H", board.settings[FRAME], 8)
    assert frames == FRAMES


def test_only_the_transmitter_transmits(rig):
    for board in rig.boards:
        program = make_program(rig, board)
        # Two messages have a bit for each of the three transmitters: the second one is used, and only by one board.
        masks = [command.tx for command in (*program.basic, *program.waveform) if hasattr(command, "tx")]
        if board.role == "transmit":
            assert masks == [0b010, 0b010]
        else:
            assert masks == [0, 0]


def test_a_board_is_armed_only_after_the_radar_reported_it(radar, monkeypatch):
    """Event 0x100B: ready for triggers."""
    radar.configure()
    # The simulated board never becomes ready.
    monkeypatch.setattr(cores, "READY_S", 1e9)
    with expect_refusal(ErrorCode.NO_ANSWER, "0x100B"):
        radar.arm(FRAMES)
    assert radar.state is State.FAULT
    assert "0x100B" in radar.reason


def test_a_board_that_missed_a_pulse_stays_armed(radar, board, clock):
    radar.arm(FRAMES)
    send_pulses(board, clock, FRAMES - 1)
    clock.sleep(10.0)
    assert radar.poll() is State.ARMED


def test_remaining_frames_are_stopped_before_arming_again(radar, board, clock):
    radar.arm(FRAMES)
    send_pulses(board, clock, 3)
    radar.arm(FRAMES)
    send_pulses(board, clock, FRAMES - 1)
    assert radar.poll() is State.ARMED
    send_pulses(board, clock, 1)
    assert radar.poll() is State.DONE


def test_a_stop_is_never_sent_during_a_frame(radar, board, clock):
    """Arming stops waiting frames. The radar is armed immediately after a pulse, within its frame, and after it."""
    radar.arm(FRAMES)
    for after_pulse_s in (0.0, 3e-4, 6e-4, 9e-4, 12e-4):
        board.trigger()
        clock.sleep(after_pulse_s)
        radar.arm(FRAMES)
        assert radar.state is State.ARMED


def test_the_frame_configuration_is_sent_only_when_it_changes(radar, board, clock):
    for frames in (FRAMES, FRAMES, 16):
        radar.arm(frames)
        send_pulses(board, clock, frames)
        assert radar.poll() is State.DONE
    assert board.executed.count(Frame.ID) == 2
    assert board.executed.count(FrameApply.ID) == 2
    assert board.executed.count(FrameControl.ID) == 3


@pytest.mark.parametrize(
    ("number", "data", "reason"),
    [
        # Data of faults of a core: code, code of an error, line of the firmware. The others are groups of error signals
        # and faults of the supply.
        (RF_CPU_FAULT, struct.pack("<BBH", 3, 1, 4711) + bytes(28), "not triggered by a pulse, firmware line 4711"),
        (RF_CPU_FAULT, struct.pack("<BBH", 2, 0, 0) + bytes(28), "data access abort"),
        (RF_ESM_FAULT, struct.pack("<II", 0, 1), "group 2 0x00000001"),
        (RF_ESM_FAULT, struct.pack("<II", 1 << 25, 0), "group 1 0x02000000"),
        (ANALOG_FAULT, struct.pack("<BBHII", 1, 0, 0, 0b1010, 0), "1.3 V / 1.0 V RF supply, PA LDO shorted"),
        (MAIN_CPU_FAULT, struct.pack("<BBH", 4, 0, 0) + bytes(28), "chirp error"),
        (RF_ERROR, struct.pack("<II", 2, 0), "RF firmware abort"),
        (RF_CPU_FAULT, b"", "only 0 bytes"),
        (RF_ESM_FAULT, bytes(4), "only 4 bytes"),
    ],
)
@pytest.mark.parametrize("is_running", [False, True])
def test_fatal_events_are_faults_with_their_reason(radar, board, number, data, reason, is_running):
    radar.arm(FRAMES)
    if is_running:
        radar.note_pulses()
    board.send_event(number, data)
    assert radar.poll() is State.FAULT
    assert reason in radar.reason


@pytest.mark.parametrize(
    ("number", "data"),
    [
        # Kinds of these events that are not fatal
        (RF_ESM_FAULT, struct.pack("<II", 1, 0)),
        (RF_ERROR, struct.pack("<II", 7, 0)),
        (REPORT_OF_CALIBRATION, bytes(20)),
        # An unknown event
        (0x1234, b""),
    ],
)
def test_other_events_are_not_faults(radar, board, number, data):
    radar.arm(FRAMES)
    board.send_event(number, data)
    assert radar.poll() is State.ARMED


def test_an_early_pulse_is_fatal_and_the_next_arming_resets_the_board(radar, board, clock):
    # The second pulse comes 0.1 ms after the first, within its frame.
    radar.arm(FRAMES)
    send_pulses(board, clock, 2, period_s=1e-4)
    assert radar.poll() is State.FAULT
    assert "not triggered" in radar.reason
    radar.arm(FRAMES)
    assert radar.state is State.ARMED
    assert radar.reason == ""
    assert board.executed.count(RF_POWER_UP.ID) == 2
    send_pulses(board, clock, FRAMES)
    assert radar.poll() is State.DONE


def test_an_unplugged_board_is_a_fault_and_recovers_when_plugged_in(radar, board):
    radar.arm(FRAMES)
    board.plugged = False
    assert radar.poll() is State.FAULT
    assert "unplugged" in radar.reason
    with expect_refusal(ErrorCode.NO_ANSWER, "unplugged"):
        radar.arm(FRAMES)
    board.plugged = True
    radar.arm(FRAMES)
    assert radar.state is State.ARMED


def test_the_report_has_versions_temperatures_calibration_and_every_byte_sent(radar):
    radar.configure()
    radar.arm(FRAMES)
    result = radar.report()
    assert result["rf_firmware"] == "2.2.1.7 patch 2.2.4.0"
    assert result["main_firmware"] == "2.2.1.7 patch 2.2.2.0"
    assert result["die_id"] == "5eed0001-00000d1e-000008c3-00000001"
    assert result["temperatures_c"]["tx2"] == 46
    assert result["calibration"]["temperature_c"] == 41
    # The host's first words ask to read the power-up event; the first command is the configuration of the device.
    assert result["sent"][0].startswith("78566587")
    first = next(raw for raw in result["sent"] if not raw.startswith("78566587"))
    assert first == "3412214385802000000400000100597b4c401000010000000000000000000000bf4a972a"
    assert any("ready for triggers" in line for line in result["events"])
    assert radar.report()["sent"] == []


def test_closing_stops_waiting_frames(radar, board, words):
    radar.arm(FRAMES)
    radar.close()
    radar.close()
    assert words.closed
    assert not board.ready_for_triggers


def test_one_pulse_starts_a_frame_of_many_chirps(rig, words, clock, board):
    burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=228.51, period_us=5000.0)
    rig_of_many_chirps = msgspec.structs.replace(rig, burst=burst)
    program = make_program(rig_of_many_chirps, rig_of_many_chirps.by_name("LS"))
    radar = RadarBoard("LS", words, clock, program)
    radar.arm(FRAMES)
    loops, frames = struct.unpack_from("<2H", board.settings[FRAME], 6)
    (chirps,) = struct.unpack_from("<I", board.settings[FRAME_APPLY])
    assert (loops, frames, chirps) == (16, FRAMES, 16)
    send_pulses(board, clock, FRAMES, 5e-3)
    assert radar.poll() is State.DONE


def test_a_fault_of_the_main_core_is_ignored_only_until_the_board_is_configured(rig, words, clock, board):
    """AWR2243 boards may report one at their start, which then succeeds (docs/spec/mmwavelink.md)."""
    radar = RadarBoard("LS", words, clock, make_program(rig, rig.by_name("LS")))
    radar.configure()
    assert any("main core fault" in line for line in radar.report()["events"])
    board.send_event(MAIN_CPU_FAULT, struct.pack("<BBH", 5, 0, 0) + bytes(32))
    assert radar.poll() is State.FAULT


def test_a_board_that_restarts_by_itself_is_a_fault_and_recovers(radar, board, clock):
    radar.arm(FRAMES)
    board.switch_power(False)
    board.switch_power(True)
    clock.sleep(0.1)
    assert radar.poll() is State.FAULT
    assert "restarted" in radar.reason
    radar.arm(FRAMES)
    assert radar.state is State.ARMED


IMAGE = check_image(make_image(), "image.bin")


# A bring-up and an arming have 25 commands with firmware in the flash. Without it 35 more load the firmware into the
# RAM; of these 60 every seventh is tried.
@pytest.mark.parametrize(("flash", "commands", "step"), [(make_image(), 25, 1), (b"", 60, 7)], ids=["flash", "RAM"])
def test_a_restart_at_any_command_is_reported_as_such(rig, clock, flash, commands, step):
    """The restart replaces each answer of a bring-up and an arming: it is the cause, not the rig file or the image."""
    for command_of_restart in range(1, commands + 1, step):
        board = simulated.RadarBoard(lambda: clock.time, flash=flash)
        words = Restarts(board, clock, command_of_restart)
        radar = RadarBoard("RH", words, clock, make_program(rig, rig.by_name("RH")), IMAGE)
        begun_s = clock.time
        with expect_refusal(ErrorCode.RADAR_RESTARTED, "RH"):
            radar.arm(FRAMES)
        # This is virtual time; up to 0.7 s are measured.
        assert clock.time - begun_s < 8.0, command_of_restart
        assert radar.state is State.FAULT
        radar.arm(FRAMES)
        assert radar.state is State.ARMED
    # `commands` is the number of commands that are sent without a restart.
    beyond_the_last = 1000
    words = Restarts(simulated.RadarBoard(lambda: clock.time, flash=flash), clock, beyond_the_last)
    RadarBoard("RH", words, clock, make_program(rig, rig.by_name("RH")), IMAGE).arm(FRAMES)
    assert beyond_the_last - words.left == commands


def test_a_refusal_just_after_a_restart_is_reported_as_a_restart(radar, board, monkeypatch):
    """After a restart the ROM refuses a setting before it reports its power-up (event 0x5000)."""
    execute = board.cores.execute

    def restart_at_data_format(number, data, remaining):
        if number == DATA_FORMAT:
            board.cores.event(POWER_UP, struct.pack("<IQQ", 371_216, 0, 0), 0.03)
            no_data = b""
            no_delay_s = 0.0
            return REFUSED, no_data, no_delay_s
        return execute(number, data, remaining)

    monkeypatch.setattr(board.cores, "execute", restart_at_data_format)
    with expect_refusal(ErrorCode.RADAR_RESTARTED, "LS"):
        radar.configure()


def test_frames_that_end_right_after_arming_are_an_error(radar, board, monkeypatch):
    """The board reports the end of the frames together with its being ready for triggers."""
    event = board.cores.event

    def send_with_end(number, data, delay_s):
        event(number, data, delay_s)
        if number == READY_FOR_TRIGGERS:
            event(FRAME_END, b"", delay_s)

    monkeypatch.setattr(board.cores, "event", send_with_end)
    with expect_refusal(ErrorCode.OTHER, "LS"):
        radar.arm(FRAMES)


def test_a_cable_unplugged_before_the_power_up_event_is_not_reported_as_wrong_jumpers(radar, board, words, monkeypatch):
    def pull(held):
        del held
        board.plugged = False

    monkeypatch.setattr(words, "reset", pull)
    with expect_refusal(ErrorCode.NO_ANSWER, "unplugged") as caught:
        radar.configure()
    assert "jumpers" not in caught.value.why


@pytest.mark.parametrize(
    ("faults", "code"),
    [([Fault.REFUSE], ErrorCode.REFUSED_BY_PEER), ([Fault.NO_ANSWER] * 3, ErrorCode.NO_ANSWER)],
)
def test_the_text_of_a_failure_names_the_cause_before_a_fault_that_was_ignored(radar, board, faults, code):
    """The fault that boards report at their start is not the cause, but may help."""
    board.inject(*faults)
    with expect_refusal(code) as caught:
        radar.configure()
    # The cause is a sentence: it has 88 characters here.
    assert caught.value.why.index("main core fault: register read-back error") > 20


def test_events_without_end_delay_a_poll_only_briefly(radar, board, clock):
    radar.arm(FRAMES)
    for _ in range(5000):
        board.send_event(REPORT_OF_CALIBRATION, bytes(20))
    begun_s = clock.time
    assert radar.poll() is State.ARMED
    # This is virtual time; 0.07 s is measured.
    assert clock.time - begun_s < 0.5
    assert any("without a pause" in line for line in radar.warnings)
    for _ in range(200):
        radar.poll()
    # The report has a thousand events at most.
    assert len(radar.report()["events"]) <= 1000
    assert radar.poll() is State.ARMED
