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
def test_round_trip(messages: st.SearchStrategy[Command | Reply], data: st.DataObject):
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
        # A command is read line by line, and a bit may make a line's end.
        parts = bytes(flipped).splitlines(keepends=True) if isinstance(message, Command) else [bytes(flipped)]
        for part in parts:
            with pytest.raises(ProtocolError):
                type(message).decode(part)


def test_immediate_bytes_differ_from_all_others_in_two_bits_and_resume_in_three():
    used_in_lines = set(b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ-* \n")
    for byte in Immediate:
        if byte == Immediate.RESUME:
            other_bytes = used_in_lines
        else:
            other_bytes = used_in_lines | set(range(0x20, 0x7F))
        nearest = min((byte ^ other_byte).bit_count() for other_byte in other_bytes | set(Immediate) - {byte})
        assert nearest >= (3 if byte == Immediate.RESUME else 2)


@given(st.binary(max_size=100))
def test_random_bytes_are_refused_or_sealed(raw: bytes):
    try:
        body = unseal(raw)
    except ProtocolError:
        return
    assert seal(body) == raw


def test_crc_is_xmodem():
    # Check value of CRC-16/XMODEM
    assert crc16(b"123456789") == 0x31C3


@pytest.mark.parametrize("bad", [Command(70000, "HOME"), Command(1, "home"), Command(1, "MOVE", (2**31,))])
def test_out_of_range_is_refused(bad: Command):
    with pytest.raises(ProtocolError):
        bad.encode()


def test_a_line_has_at_most_96_bytes():
    """A star, four digits of the checksum and the end of the line are six of them."""
    longest = "x" * (96 - 6)
    assert unseal(seal(longest)) == longest
    with pytest.raises(ProtocolError, match="longer"):
        seal(longest + "x")
    raw = (longest + "x").encode()
    with pytest.raises(ProtocolError, match="longer"):
        unseal(raw + b"*%04X\n" % crc16(raw))


@pytest.mark.parametrize(
    ("code", "is_taken"), [(0x1F, False), (0x20, True), (0x7E, True), (0x7F, False), (0x80, False)]
)
def test_a_line_is_printable_ascii(code, is_taken):
    raw = b"ab" + bytes([code])
    line = raw + b"*%04X\n" % crc16(raw)
    if is_taken:
        assert unseal(line) == raw.decode()
        return
    with pytest.raises(ProtocolError):
        unseal(line)


def test_a_line_may_be_empty_and_is_not_shorter():
    assert unseal(seal("")) == ""
    with pytest.raises(ProtocolError, match="not a stage line"):
        unseal(seal("")[1:])


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
def test_a_reply_has_its_number_sequence_and_fields(body):
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
