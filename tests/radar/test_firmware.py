"""Firmware is checked before its download and verified after it; a download can be repeated after any interruption."""

import zlib

import pytest
from hypothesis import given, settings, strategies as st
from tests.support.radar.boards import BoardWords, Restarts, VirtualClock, make_native_rig
from tests.support.refusals import expect_refusal

from polysight.radar.board import RadarBoard, State
from polysight.radar.commands import make_program
from polysight.radar.firmware import CHUNK_TIMEOUT_S, TO_FLASH, TO_RAM, check_image, read_image, split_into_chunks
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_simulators.radars import Fault, RadarBoard as Simulated, make_image

RIG = make_native_rig()
# Numbers of messages
CHANNELS = 0x0080
RF_VERSION = 0x0220
RF_POWER_UP = 0x4000
FIRMWARE_PART = 0x4080
MAIN_VERSION = 0x40E0
DEVICE_CONFIGURATION = 0x404C
# An image of firmware in TI's format, 7940 bytes (docs/spec/mmwavelink.md), and one for the ROM of an AWR1243.
DATA = make_image()
IMAGE = check_image(DATA, "image.bin")
FIRST_GENERATION = make_image(rom=bytes((1, 2, 5, 0, 18, 1, 1)))


# Bytes of the CRC-32 at the end of an image
CRC_BYTES = 4
# Offsets in the image of the word that closes its header, and of its two program parts. In a part the version of the
# ROM and that of the patch are at 0x38 and 0x48.
HEADER_END_AT = 0x5C
MAIN_PART_AT = 0x80
RF_PART_AT = 0x880
ROM_VERSION_AT = 0x38
PATCH_VERSION_AT = 0x48


def overwrite_image(offset: int, new_bytes: bytes) -> bytes:
    """Return the image with other bytes at this offset, and with the right checksum."""
    content = DATA[:offset] + new_bytes + DATA[offset + len(new_bytes) : -CRC_BYTES]
    return content + zlib.crc32(content).to_bytes(CRC_BYTES, "little")


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "nothing"),
        (b"Index: mmwave_dfp\n" * 400, "Index: mmwav"),
        (bytes(7940), "MSTR"),
        (b"MSTR", "4 bytes"),
        (DATA[: len(DATA) // 2], "7940"),
        (DATA + b"\0", "7940"),
        (DATA[:-CRC_BYTES], "CRC"),
        # One bit of the byte at 5000 is flipped.
        (DATA[:5000] + bytes((DATA[5000] ^ 4,)) + DATA[5001:], "CRC-32"),
        # Right checksums, but headers of parts that are missing, of another kind, or for another chip. The right words
        # are MEND at the end of the header and RPRC at the begin of a part.
        (overwrite_image(HEADER_END_AT, b"ENDE"), "no program part"),
        (overwrite_image(MAIN_PART_AT, b"CPRR"), "no program part"),
        (FIRST_GENERATION, "AWR1243"),
        (overwrite_image(RF_PART_AT + ROM_VERSION_AT, bytes((6, 2, 0, 13))), "generation 6"),
        (overwrite_image(RF_PART_AT, b"CPRR"), "1 program parts"),
        (overwrite_image(RF_PART_AT + PATCH_VERSION_AT, bytes((6, 4, 1, 13))), "its patches are 6.4.1.13"),
    ],
)
def test_a_file_that_is_not_an_image_is_refused_with_the_reason(data, why):
    with expect_refusal(ErrorCode.FILE_FOREIGN, "image.bin", why):
        check_image(data, "image.bin")


@settings(deadline=None)
@given(st.integers(0, 8 * len(DATA) - 1))
def test_an_image_with_a_flipped_bit_is_refused(bit):
    data = bytearray(DATA)
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(ConfigError):
        check_image(bytes(data), "image.bin")


@settings(deadline=None)
@given(st.integers(0, len(DATA) - 1))
def test_a_truncated_image_is_refused(size):
    with pytest.raises(ConfigError):
        check_image(DATA[:size], "image.bin")


def test_an_image_has_the_versions_of_rom_and_patches(tmp_path):
    (tmp_path / "a.bin").write_bytes(DATA)
    image = read_image(tmp_path / "a.bin")
    assert (image.name, image.rom, image.patches) == ("a.bin", (2, 2, 1, 7), ("2.2.2.0", "2.2.4.0"))


@pytest.mark.parametrize("size", [1, 223, 224, 225, 456, 457, 1000])
def test_the_parts_of_an_image_are_the_whole_image(size):
    image = bytes(n % 251 for n in range(size))
    parts = split_into_chunks(image)
    joined = b"".join(chunk.part for chunk, _ in parts)
    # The image follows two words: its type, by which the ROM writes it into the flash, and its length.
    assert joined == TO_FLASH.to_bytes(4, "little") + size.to_bytes(4, "little") + image
    # A message has at most 256 bytes: sync word, header, CRC and the header of the part take 24 of them.
    assert all(len(chunk.part) <= 256 - 24 for chunk, _ in parts)
    assert [remaining for _, remaining in parts] == list(reversed(range(len(parts))))


def test_the_first_part_is_that_of_a_user_s_log():
    """A log in TI's forum (E2E 1267477) has 35 parts, the first with type 0, length 7940 and the magic "MSTR"."""
    first, remaining = split_into_chunks(DATA, TO_RAM)[0]
    assert remaining == 0x22
    assert first.part[:12].hex() == "00000000041f00004d535452"


class PowerCut(BoardWords):
    """Switch the board off after `after` messages of its host."""

    def __init__(self, board, clock, after: int) -> None:
        super().__init__(board, clock)
        self.messages_left = after

    def write(self, words):
        # A message begins with this word.
        if words[0] == 0x1234:
            self.messages_left -= 1
            if self.messages_left == 0:
                self.board.switch_power(False)
        super().write(words)


def make_board(board: Simulated, clock: VirtualClock, firmware=None, words=None) -> RadarBoard:
    return RadarBoard("RH", words or BoardWords(board, clock), clock, make_program(RIG, RIG.by_name("RH")), firmware)


def ignore(sent: int, of: int) -> None:
    """Ignore the progress of a download."""


@pytest.fixture
def new(clock) -> Simulated:
    """A new board: its flash is empty, and at its start it reports a fault of its main core that is harmless."""
    return Simulated(lambda: clock.time)


@pytest.mark.parametrize("fault_at", ["power-up", "download", "never"])
def test_a_new_board_runs_from_ram_and_its_flash_stays_empty(clock, fault_at):
    board = Simulated(lambda: clock.time, fault_at=fault_at)
    radar = make_board(board, clock, IMAGE)
    radar.configure()
    assert radar.state is State.CONFIGURED
    assert board.cores.flash == b""
    assert board.cores.ram == DATA
    radar.arm(4)
    # After a fault arming resets the board, which empties its RAM: the image is sent again.
    radar.fail("a fault")
    radar.arm(4)
    assert board.executed.count(FIRMWARE_PART) == 2 * len(split_into_chunks(DATA))


def test_without_an_image_a_new_board_is_refused(new, clock):
    radar = make_board(new, clock)
    with expect_refusal(ErrorCode.RADAR_NO_FIRMWARE) as caught:
        radar.configure()
    # The reason comes from the board's boot status.
    assert "image header" in caught.value.why


def test_an_image_in_the_flash_is_not_downloaded_again(board, clock):
    make_board(board, clock, IMAGE).configure()
    assert FIRMWARE_PART not in board.executed


@pytest.mark.parametrize("fault_at", ["power-up", "download", "never"])
def test_a_flash_write_is_verified_by_a_start_from_the_flash(clock, fault_at):
    board = Simulated(lambda: clock.time, fault_at=fault_at)
    radar = make_board(board, clock)
    progress: list[tuple[int, int]] = []
    assert "2.2.2.0 from flash" in radar.write_flash(IMAGE, lambda sent, of: progress.append((sent, of)))
    assert board.cores.flash == DATA
    assert progress[-1] == (35, 35)
    radar.configure()
    assert radar.state is State.CONFIGURED


def test_a_slow_erase_does_not_time_out(clock):
    board = Simulated(lambda: clock.time, erase_s=0.9 * CHUNK_TIMEOUT_S)
    make_board(board, clock).write_flash(IMAGE, ignore)
    assert board.cores.flash == DATA


@pytest.mark.parametrize("bit", [8, 48, *range(50, 57)])
@pytest.mark.parametrize("flash", [b"", DATA], ids=["flash empty", "flash written"])
@pytest.mark.parametrize("image", [None, IMAGE])
def test_a_board_that_reports_a_hardware_fault_is_refused_after_any_download(clock, bit, flash, image):
    """Boot status bits of docs/spec/mmwavelink.md; the status after a RAM download is clean, but does not count."""
    board = Simulated(lambda: clock.time, flash=flash)
    board.cores.hardware_bits = 1 << bit
    with pytest.raises(DeviceError):
        make_board(board, clock, image).configure()
    assert RF_POWER_UP not in board.executed
    with pytest.raises(DeviceError):
        make_board(board, clock).write_flash(IMAGE, ignore)
    assert board.cores.flash == DATA


@pytest.mark.parametrize("use", [lambda radar: radar.write_flash(IMAGE, ignore), lambda radar: radar.configure()])
def test_a_board_whose_die_id_is_that_of_another_board_is_not_configured(clock, use):
    """The rig file names the chip that is expected at this USB address."""
    board = Simulated(lambda: clock.time, flash=DATA)
    radar = RadarBoard(
        "LS", BoardWords(board, clock), clock, make_program(RIG, RIG.by_name("LS")), die_id="5eed0002-0-0-0"
    )
    with expect_refusal(ErrorCode.MISMATCH, "5eed0001", "5eed0002"):
        use(radar)
    # No channel was switched on.
    assert CHANNELS not in board.executed


# 27 self-tests, a bit for each that passed.
@pytest.mark.parametrize(("tests", "text"), [(0, "0x7FFFFFF"), (0x07FFFFFE, "0x0000001"), (0x07FFFFFF, None)])
def test_failed_self_tests_of_the_rf_core_are_reported(board, clock, tests, text):
    board.cores.passing_rf_tests = tests
    radar = make_board(board, clock)
    outcomes = []

    def note_step(step, outcome):
        if step.name == "RF power-up":
            outcomes.append(outcome)

    radar.configure(note_step)
    if text:
        assert text in outcomes[0]
    else:
        assert outcomes == ["RF core is up"]
    assert radar.facts.rf_tests_passed == tests


@pytest.mark.parametrize("rom", [(1, 2, 0, 5), (2, 0, 0, 3), (2, 2, 1, 6), (6, 2, 1, 7), (0, 0, 0, 0), (255,) * 4])
@pytest.mark.parametrize("flash", [b"", DATA], ids=["flash empty", "flash written"])
def test_an_image_for_another_rom_is_not_sent(clock, rom, flash):
    board = Simulated(lambda: clock.time, flash=flash)
    board.cores.main_rom = rom
    for use in (lambda r: r.write_flash(IMAGE, ignore), lambda r: r.configure()):
        with expect_refusal(ErrorCode.MISMATCH, ".".join(map(str, rom))):
            use(make_board(board, clock, IMAGE))
    assert FIRMWARE_PART not in board.executed
    assert board.cores.flash == flash


@pytest.mark.parametrize("core", ["main_rom", "rf_rom"])
@pytest.mark.parametrize(
    ("rom", "text"),
    [((1, 2, 0, 5), "AWR1243"), ((6, 2, 0, 13), "57..64 GHz"), ((255,) * 4, "generation 255"), ((0,) * 4, "0.0.0.0")],
)
@pytest.mark.parametrize("image", [None, IMAGE])
def test_a_device_other_than_awr2243_is_refused_before_any_setting(clock, core, rom, text, image):
    """The same codes would mean other frequencies on such a device."""
    board = Simulated(lambda: clock.time, flash=DATA)
    setattr(board.cores, core, rom)
    with expect_refusal(ErrorCode.MISMATCH, text):
        make_board(board, clock, image).configure()
    # Only these messages may have been sent: configuration of the device, power-up of the RF core, and the questions
    # for the versions.
    assert set(board.executed) <= {DEVICE_CONFIGURATION, RF_POWER_UP, RF_VERSION, MAIN_VERSION}


@pytest.mark.parametrize("flash", [b"", DATA], ids=["from RAM", "from flash"])
def test_another_patch_of_the_rf_core_is_a_warning(clock, monkeypatch, flash):
    board = Simulated(lambda: clock.time, flash=flash)
    execute = board.cores._apply_setting_or_query
    # The answer to the question for the version has the ROM's in its first 10 bytes, and then that of the patch.
    old_version = bytes((2, 1, 20, 1, 1, 0))

    def answer_with_old_version(number, data):
        answer = execute(number, data)
        if number == RF_VERSION:
            return answer[:10] + old_version
        return answer

    monkeypatch.setattr(board.cores, "_apply_setting_or_query", answer_with_old_version)
    radar = make_board(board, clock, IMAGE)
    radar.configure()
    (warning,) = [line for line in radar.warnings if "RF core reports patch 2.1.0.0" in line]
    assert "2.2.4.0" in warning
    # Firmware in the flash is replaced with this option.
    assert ("--flash" in warning) is bool(flash)


@pytest.mark.parametrize("broken", [b"", DATA[:100], DATA[:-1], bytes(9000), DATA[:400] + b"\xff" + DATA[401:]])
def test_a_download_repairs_any_content_of_the_flash(clock, broken):
    board = Simulated(lambda: clock.time, flash=broken)
    make_board(board, clock).write_flash(IMAGE, ignore)
    make_board(board, clock).configure()


@pytest.mark.parametrize("part", range(1, 37))
def test_a_power_failure_at_any_part_is_recoverable(clock, part):
    """Message 36 is the question for the version after the 35 parts; one question is sent before them."""
    board = Simulated(lambda: clock.time, flash=make_image(4000))
    radar = make_board(board, clock, words=PowerCut(board, clock, part + 1))
    with pytest.raises(DeviceError):
        radar.write_flash(IMAGE, ignore)
    board.switch_power(True)
    rescued = make_board(board, clock, IMAGE)
    # With firmware in its RAM a board starts whatever its flash contains.
    rescued.configure()
    assert rescued.state is State.CONFIGURED
    make_board(board, clock).write_flash(IMAGE, ignore)
    make_board(board, clock).configure()


@pytest.mark.parametrize("part", range(1, 36))
def test_a_restart_during_a_download_ends_it_immediately(clock, part):
    """The restarted ROM would take the next part as the first of another file."""
    board = Simulated(lambda: clock.time, flash=DATA, erase_s=0.1)
    words = Restarts(board, clock, part + 1)
    with expect_refusal(ErrorCode.RADAR_RESTARTED, f"part {part} of 35"):
        make_board(board, clock, words=words).write_flash(IMAGE, ignore)
    # No message was sent after the restart.
    assert words.later == 0
    # This is virtual time; 0.4 s is measured.
    assert clock.time < 5.0


def test_a_refused_part_is_an_error_with_its_number(new, clock, monkeypatch):
    download = new.cores._download
    calls = []

    def refuse_seventh(data, remaining):
        calls.append(remaining)
        if len(calls) == 7:
            error_number = 7
            no_data = b""
            no_delay_s = 0.0
            return error_number, no_data, no_delay_s
        return download(data, remaining)

    monkeypatch.setattr(new.cores, "_download", refuse_seventh)
    with expect_refusal(ErrorCode.REFUSED_BY_PEER, "part 7 of 35 of image.bin", "error 7"):
        make_board(new, clock).write_flash(IMAGE, ignore)


def test_a_flash_that_loses_data_is_an_error(new, clock, monkeypatch):
    download = new.cores._download

    def forget(data, remaining):
        result = download(data, remaining)
        new.cores.flash = new.cores.flash[:-1] + b"\xff"
        return result

    monkeypatch.setattr(new.cores, "_download", forget)
    with pytest.raises(DeviceError):
        make_board(new, clock).write_flash(IMAGE, ignore)


@pytest.mark.parametrize(("reported", "is_warned"), [((2, 9, 20, 1, 1, 0x30), True), ((0,) * 6, False)])
def test_another_patch_than_that_of_the_image_is_a_warning_and_none_is_an_error(
    new, clock, monkeypatch, reported, is_warned
):
    execute = new.cores._apply_setting_or_query

    def answer(number, data):
        result = execute(number, data)
        # Without a patch these bytes of the answer are zero, as before the download.
        has_patch = any(result[10:])
        if number == MAIN_VERSION and has_patch:
            return result[:10] + bytes(reported)
        return result

    monkeypatch.setattr(new.cores, "_apply_setting_or_query", answer)
    radar = make_board(new, clock, IMAGE)
    if is_warned:
        radar.configure()
        assert any("reports patch 2.9.3.0 after the download" in line for line in radar.warnings)
        return
    with expect_refusal(ErrorCode.RADAR_NO_FIRMWARE):
        radar.configure()
    with expect_refusal(ErrorCode.MISMATCH, "0.0.0.0"):
        radar.write_flash(IMAGE, ignore)


@pytest.mark.parametrize("fault", [Fault.BAD_CRC, Fault.LOST_INTERRUPT, Fault.NACK, Fault.BAD_CHECKSUM])
def test_a_disturbed_download_is_complete(new, clock, fault):
    radar = make_board(new, clock)
    radar.words.board.inject(fault, fault)
    radar.write_flash(IMAGE, ignore)
    assert new.cores.flash == DATA
