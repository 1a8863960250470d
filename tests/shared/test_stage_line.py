"""The stage line: lines survive a round trip, and a line with a flipped bit is refused."""

import pytest
from hypothesis import given, strategies as st

from polysight_shared.errors import ProtocolError
from polysight_shared.stage_line import Command, Immediate, Reply, crc16, seal, unseal

commands = st.builds(
    Command,
    sequence=st.integers(0, 65535),
    verb=st.sampled_from(["HELLO", "HOME", "MOVE", "ROW", "SET", "CLEAR", "ENABLE"]),
    args=st.lists(st.integers(-(2**31), 2**31 - 1), max_size=5).map(tuple),
)
fields = st.dictionaries(
    st.sampled_from(["x", "y", "points", "pulses", "fw"]),
    st.from_regex(r"[-A-Za-z0-9.]{1,8}", fullmatch=True),
    max_size=3,
)
replies = st.one_of(
    st.builds(Reply, kind=st.sampled_from(["ok", "done"]), sequence=st.integers(0, 65535), fields=fields),
    st.builds(Reply, kind=st.just("error"), sequence=st.none() | st.integers(0, 65535), number=st.integers(0, 255)),
    st.builds(Reply, kind=st.just("alarm"), number=st.integers(0, 255)),
    st.builds(Reply, kind=st.sampled_from(["status", "banner"]), fields=fields),
)


@pytest.mark.parametrize("messages", [commands, replies], ids=["commands", "replies"])
@given(data=st.data())
def test_an_encoded_line_is_decoded_to_the_same_message(
    messages: st.SearchStrategy[Command | Reply], data: st.DataObject
):
    message = data.draw(messages)
    assert type(message).decode(message.encode()) == message


@pytest.mark.parametrize("messages", [commands, replies], ids=["commands", "replies"])
@given(data=st.data())
def test_every_single_bit_flip_is_refused(messages: st.SearchStrategy[Command | Reply], data: st.DataObject):
    message = data.draw(messages)
    line = message.encode()
    for bit in range(len(line) * 8):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        # The stage reads commands line by line, and a flipped bit may make a character the end of a line.
        if isinstance(message, Command):
            lines = bytes(flipped).splitlines(keepends=True)
        else:
            lines = [bytes(flipped)]
        for part in lines:
            with pytest.raises(ProtocolError):
                type(message).decode(part)


def test_no_flipped_bit_makes_an_immediate_byte_of_another_and_no_two_make_resume():
    """RESUME differs in three bits from the bytes of lines and of other commands, as it moves a stage that was held.

    The other immediate bytes differ in two bits from these, and from printable characters that no line has.
    """
    used_in_lines = set(b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ-* \n")
    printable = set(range(0x20, 0x7F))
    for byte in Immediate:
        if byte == Immediate.RESUME:
            other_bytes = used_in_lines
            least_bits = 3
        else:
            other_bytes = used_in_lines | printable
            least_bits = 2
        other_bytes = other_bytes | set(Immediate) - {byte}
        fewest_bits = min((byte ^ other_byte).bit_count() for other_byte in other_bytes)
        assert fewest_bits >= least_bits


@given(st.binary(max_size=100))
def test_bytes_that_are_not_refused_are_those_of_a_sealed_line(raw: bytes):
    try:
        body = unseal(raw)
    except ProtocolError:
        return
    assert seal(body) == raw


def test_the_checksum_is_crc_16_xmodem():
    # The check value that catalogues of CRCs give for XMODEM: the checksum of these nine digits.
    assert crc16(b"123456789") == 0x31C3


@pytest.mark.parametrize(
    "command",
    # A sequence number of more than 16 bits, small letters, and an argument of more than 32 bits.
    [Command(70000, "HOME"), Command(1, "home"), Command(1, "MOVE", (2**31,))],
)
def test_a_command_outside_the_protocols_ranges_is_not_sent(command: Command):
    with pytest.raises(ProtocolError):
        command.encode()


def test_a_line_has_at_most_96_bytes():
    """The star, the four digits of the checksum and the end of the line are six of these bytes."""
    longest = "x" * (96 - 6)
    assert unseal(seal(longest)) == longest
    with pytest.raises(ProtocolError, match="longer"):
        seal(longest + "x")
    too_long = (longest + "x").encode()
    with pytest.raises(ProtocolError, match="longer"):
        unseal(too_long + b"*%04X\n" % crc16(too_long))


@pytest.mark.parametrize(
    ("code", "is_taken"), [(0x1F, False), (0x20, True), (0x7E, True), (0x7F, False), (0x80, False)]
)
def test_a_line_is_printable_ascii(code, is_taken):
    body = b"ab" + bytes([code])
    line = body + b"*%04X\n" % crc16(body)
    if is_taken:
        assert unseal(line) == body.decode()
        return
    with pytest.raises(ProtocolError):
        unseal(line)


def test_a_line_may_have_an_empty_body_but_not_less_than_its_checksum():
    assert unseal(seal("")) == ""
    without_star = seal("")[1:]
    with pytest.raises(ProtocolError, match="not a stage line"):
        unseal(without_star)


@pytest.mark.parametrize(
    ("body", "is_taken"),
    [
        ("N65535 SET 2147483647 -2147483648", True), ("N65536 SET 0", False), ("N0 SET 2147483648", False),
        ("N0 SET -2147483649", False), ("N0 HELLO", True),
    ],
)  # fmt: skip
def test_a_command_has_16_bits_of_sequence_and_32_of_each_argument(body, is_taken):
    if not is_taken:
        with pytest.raises(ProtocolError):
            Command.decode(seal(body))
        return
    command = Command.decode(seal(body))
    assert command.encode() == seal(body)


@pytest.mark.parametrize(
    "body",
    [
        "ok", "ok 5", "ok N", "ok N123456", "ok:1 N5", "error N5", "error:1234 N5", "error: N5", "alarm", "alarm:x",
        "done x=1", "status x", "status x=1 x=2", "other N5",
    ],
)  # fmt: skip
def test_a_reply_without_its_number_sequence_or_fields_is_refused(body):
    with pytest.raises(ProtocolError):
        Reply.decode(seal(body))


def test_replies_are_read_with_their_numbers():
    assert Reply.decode(seal("error:123 N-")) == Reply("error", None, 123)
    assert Reply.decode(seal("error:1 N12345")) == Reply("error", 12345, 1)
    assert Reply.decode(seal("alarm:7")) == Reply("alarm", number=7)
    reply = Reply.decode(seal("done N5 x=-12 y=0 held=yes"))
    assert (reply.integer("x"), reply.integer("y")) == (-12, 0)
    for key in ("held", "missing"):
        with pytest.raises(ProtocolError, match=key):
            reply.integer(key)
