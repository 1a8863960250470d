"""Messages and commands are accepted up to the limits of their fields; events have their meaning."""

import binascii
import struct
from dataclasses import replace

import msgspec
import pytest
from tests.support.radar.boards import make_native_rig

from polysight.radar import messages as m
from polysight.radar.commands import Channels, DataFormat, Profile, direct_if_hz, make_program
from polysight_shared.errors import ProtocolError
from polysight_shared.geometry import direct_path_m

# A message has at most 256 bytes (docs/spec/mmwavelink.md): 4 of sync word, 12 of header, 4 of CRC, and the body.
LARGEST_BODY = 256 - 20


def make_command(*sizes: int, **values: int) -> m.Message:
    """Return a command with a sub-block of each size in bytes of data; `values` replace fields of its header."""
    blocks = tuple(m.SubBlock(0x4000, bytes(range(1, size + 1))) for size in sizes)
    return replace(m.command(blocks), **values)


def build_device_message(body: bytes, block_count: int) -> bytes:
    """Return an event of the RF core with this body, which is valid in all else, and has a CRC of 16 bits."""
    message_id = 0x80
    opcode = m.Direction.RF_TO_HOST | m.Kind.EVENT << 4 | message_id << 6
    header_bytes = 12
    crc_bytes = 2
    flags = 0
    remaining_chunks = 0
    length = header_bytes + len(body) + crc_bytes
    head = struct.pack("<5H", opcode, length, flags, remaining_chunks, block_count)
    head += m.checksum(head).to_bytes(2, "little")
    return bytes.fromhex("badccdab") + head + body + binascii.crc_hqx(head + body, 0xFFFF).to_bytes(2, "little")


@pytest.mark.parametrize("size", range(1, 9))
def test_a_body_is_padded_with_ff_to_four_bytes(size):
    message = make_command(size)
    raw = m.encode(message)
    body = raw[16:-4]
    # A sub-block has a header of four bytes.
    padding = -(4 + size) % 4
    assert len(body) == 4 + size + padding
    assert body[4 + size :] == padding * b"\xff"
    assert m.decode(raw).blocks == message.blocks


def test_a_message_has_at_most_256_bytes():
    largest = make_command(LARGEST_BODY - 4)
    raw = m.encode(largest)
    assert len(raw) == 256
    assert m.decode(raw).blocks == largest.blocks
    with pytest.raises(ValueError, match="260 bytes"):
        m.encode(make_command(LARGEST_BODY - 3))


@pytest.mark.parametrize(
    ("values", "is_taken"),
    [
        ({"sequence": 0}, True), ({"sequence": 15}, True), ({"sequence": 16}, False), ({"sequence": -1}, False),
        ({"message_id": 0}, True), ({"message_id": 1023}, True), ({"message_id": 1024}, False),
        ({"message_id": -1}, False),
    ],
)  # fmt: skip
def test_values_that_exceed_the_bits_of_their_header_field_are_refused(values, is_taken):
    message = make_command(4, **values)
    if not is_taken:
        with pytest.raises(ValueError, match="must be"):
            m.encode(message)
        return
    decoded = m.decode(m.encode(message))
    assert (decoded.sequence, decoded.message_id) == (message.sequence, message.message_id)


def test_sub_blocks_of_a_command_share_one_message_id():
    """The RF core has the ids below 0x200; each has 32 sub-blocks."""
    for blocks in ((), (m.SubBlock(0x0040, b""), m.SubBlock(0x0080, b""))):
        with pytest.raises(ValueError, match="share one message id"):
            m.command(blocks)
    assert m.command((m.SubBlock(0x3FFF, b""),)).direction is m.Direction.HOST_TO_RF
    assert m.command((m.SubBlock(0x4000, b""),)).direction is m.Direction.HOST_TO_MAIN


def block(number: int, data: bytes, length: int | None = None) -> bytes:
    """Return a sub-block as bytes; the length in its header of four bytes is the right one, or `length`."""
    if length is None:
        length = len(data) + 4
    return struct.pack("<2H", number, length) + data


@pytest.mark.parametrize(
    ("body", "count", "data"),
    [
        (block(1, b"abcd"), 1, [b"abcd"]),
        (block(1, b"abc") + b"\xff", 1, [b"abc"]),
        (block(1, b"a") + 3 * b"\xff", 1, [b"a"]),
        (block(1, b"") + block(2, b"xy") + 2 * b"\xff", 2, [b"", b"xy"]),
        # Four bytes of padding
        (block(1, b"abcd") + 4 * b"\xff", 1, None),
        # A length below that of the sub-block's header, and one beyond the body
        (block(1, b"abcd", length=3), 1, None),
        (block(1, b"abcd", length=9), 1, None),
        # The second sub-block is missing, without and with padding in its place.
        (block(1, b"abcd"), 2, None),
        (block(1, b"abcd") + b"\xff" * 3, 2, None),
    ],
)
def test_a_body_has_the_announced_sub_blocks_and_up_to_three_bytes_of_padding(body, count, data):
    raw = build_device_message(body, count)
    if data is None:
        with pytest.raises(ProtocolError, match="sub-block"):
            m.decode(raw)
        return
    assert [part.data for part in m.decode(raw).blocks] == data


def test_a_message_shorter_or_longer_than_its_header_says_is_refused():
    raw = m.encode(make_command(4))
    for wrong in (raw[:-1], raw + b"\0"):
        with pytest.raises(ProtocolError):
            m.decode(wrong)
    # The length counts header, body and CRC: at least 14 bytes with a CRC of 16 bits, and at most 252.
    for length in (13, 253):
        head = struct.pack("<5H", m.Direction.RF_TO_HOST | m.Kind.EVENT << 4, length, 0, 0, 0)
        with pytest.raises(ProtocolError, match="invalid length"):
            m.decode_header(bytes.fromhex("badccdab") + head + m.checksum(head).to_bytes(2, "little"))


@pytest.mark.parametrize(
    ("number", "kind", "is_fatal", "words"),
    [
        (m.RF_CPU_FAULT, 3, True, "firmware line 300"),
        (m.RF_CPU_FAULT, 2, True, "data access abort"),
        (m.RF_CPU_FAULT, 4, True, "chirp error"),
        (m.MAIN_CPU_FAULT, 3, True, "firmware fatal error"),
        (m.RF_CPU_FAULT, 7, True, "code 7"),
        (m.RF_CPU_FAULT, 255, False, "no fault"),
    ],
)
def test_only_a_fatal_error_of_the_firmware_has_a_line(number, kind, is_fatal, words):
    """The event has a kind, an error code and the line of the firmware, which counts only for kind 3 of the RF core."""
    event = m.decode_event(m.SubBlock(number, struct.pack("<BBH", kind, 1, 300)))
    assert event.fatal is is_fatal
    assert words in event.detail
    assert ("firmware line" in event.detail) == ("line" in words)


def test_times_of_power_up_are_ticks_of_5_ns():
    event = m.decode_event(m.SubBlock(m.RF_POWER_UP_DONE, struct.pack("<II", 0xFFFFFFFF, 200_000)))
    assert event.values["power_up_us"] == pytest.approx(1000.0)
    assert event.detail == ""
    event = m.decode_event(m.SubBlock(m.MAIN_POWER_UP, struct.pack("<IQQ", 200_000, 0, 0)))
    assert event.values["power_up_us"] == pytest.approx(1000.0)


@pytest.mark.parametrize("names", [("LS", "RH", "RV"), ("M", "A", "Z")])
def test_only_the_transmitting_board_switches_a_transmitter_on(names):
    """The role of a board counts, not its name."""
    rig = make_native_rig()
    boards = tuple(msgspec.structs.replace(board, name=name) for board, name in zip(rig.boards, names, strict=True))
    native = dict(zip(names, rig.radar.native.values(), strict=True))
    rig = msgspec.structs.replace(rig, boards=boards, radar=msgspec.structs.replace(rig.radar, native=native))
    for board in boards:
        program = make_program(rig, board)
        transmitters = 0
        if board == rig.transmitter:
            transmitters = 1 << board.tx_antenna
        # All four receivers are on.
        assert Channels(0b1111, transmitters) in program.basic
        assert DataFormat(0b1111) in program.basic
        assert program.transmits is (transmitters > 0)


def test_a_profile_has_the_chirp_of_the_rig_file_and_the_offset_of_its_board():
    rig = make_native_rig()
    chirp = msgspec.structs.replace(rig.chirp, hpf1_khz=0.0, hpf2_khz=0.0, sample_rate_hz=2_150_000.0)
    (profile,) = [part for part in make_program(rig, rig.boards[1]).waveform if isinstance(part, Profile)]
    assert profile.start_hz == rig.chirp.start_hz + rig.boards[1].start_offset_hz
    assert rig.boards[1].start_offset_hz > 0
    assert (profile.hpf1_khz, profile.hpf2_khz) == (rig.chirp.hpf1_khz, rig.chirp.hpf2_khz)

    # For a simulated rig without filters the radar is set to its lowest corners.
    unfiltered_rig = msgspec.structs.replace(rig, chirp=chirp)
    (profile,) = [part for part in make_program(unfiltered_rig, rig.boards[1]).waveform if isinstance(part, Profile)]
    assert (profile.hpf1_khz, profile.hpf2_khz) == (175.0, 350.0)

    # The sample rate in thousands a second is in bytes 34 and 35, rounded.
    assert struct.unpack_from("<H", profile.data(), 34) == (2150,)
    assert struct.unpack_from("<H", replace(profile, sample_rate_hz=2_150_900.0).data(), 34) == (2151,)


def test_the_expected_frequency_of_the_direct_path_is_the_mean_over_the_antennas():
    """The slope is that of the radar's nearest code, in steps of 48.3 kHz/us; frequencies are in steps of 53.6 Hz."""
    rig = make_native_rig()
    for board in rig.receivers:
        paths_m = direct_path_m(rig, board)
        slope = round(rig.chirp.slope_hz_per_s / 48.2797623e9) * 48.2797623e9
        # 60 Hz: a step of the frequency, and rounding.
        expected = slope * sum(paths_m) / len(paths_m) / 299_792_458 + board.start_offset_hz
        assert direct_if_hz(rig, board) == pytest.approx(expected, abs=60.0)
