"""Protocol of the stage line: ASCII lines with sequence number and CRC, and single bytes that act at any time.

Specification: docs/spec/stage-line.md. The firmware's counterpart is arduino_stage/protocol.cpp.
"""

from __future__ import annotations

import binascii
import re
from enum import IntEnum

import msgspec

from polysight_shared.errors import ProtocolError

# Version of the protocol that the banner names (docs/spec/stage-line.md).
PROTOCOL_VERSION = 2
# Longest line, with its line end (docs/spec/stage-line.md).
MAX_LINE_BYTES = 96
# Largest sequence number of a line; 0 follows.
MAX_SEQUENCE = 65535
# Later than every time: the upper bound of a time that is not known.
END_OF_TIME_NS = 2**63 - 1
# The Pi waits so long for the end of homing (chosen, the search in short legs over the longest travel takes minutes);
# programs that wait for the Pi need a longer timeout.
HOMING_TIMEOUT_S = 300.0
# Patterns of an integer, of a command line without its checksum, and of one field of a reply.
_VALUE = re.compile(r"-?[0-9]{1,10}")
_COMMAND = re.compile(r"N([0-9]{1,5}) ([A-Z]+)((?: -?[0-9]{1,10})*)")
_FIELD = re.compile(r"([a-z]+)=([-+.:A-Za-z0-9]+)")


class Immediate(IntEnum):
    """Bytes that the stage handles in its receive interrupt, even during motion.

    Each differs in at least two bits from every byte of a command line. RESUME, which starts motion, differs in at
    least three bits from these and from the other immediate bytes, and must be sent twice.
    """

    HOLD = 0x81
    RESUME = 0x9D
    STATUS = 0x84
    STOP = 0x88

    @property
    def sent(self) -> bytes:
        """Bytes to send."""
        if self is Immediate.RESUME:
            return bytes([self, self])
        return bytes([self])


class Parameter(IntEnum):
    """First argument of `SET`: the setting of the stage; the comment has the unit of the second argument."""

    # Acceleration, steps/s^2.
    ACCEL = 0
    # Milliseconds of silence after which a moving stage stops.
    HEARTBEAT = 1
    # Width of the trigger pulse, microseconds.
    TRIGGER = 2
    # Travel in x, steps: the stage moves within 0..TRAVEL_X.
    TRAVEL_X = 3
    # Travel in y, steps.
    TRAVEL_Y = 4
    # Speed between rows, steps/s.
    TRAVEL_SPEED = 5
    # Backlash, steps: rows are approached from this much below in y, with at least this run-up in x; 0 = off.
    BACKLASH = 6
    # Bits of the pins whose level is inverted, in the order of raster.INVERTIBLE.
    PINS = 7


def crc16(body: bytes) -> int:
    """Compute CRC-16/XMODEM (polynomial 0x1021, start 0), as avr-libc's _crc_xmodem_update."""
    return binascii.crc_hqx(body, 0)


def seal(body: str) -> bytes:
    """Append `*CRC` and the line end.

    Raises ProtocolError if the line is too long, not ASCII, or contains `*` or a line end. Other control characters are
    refused by `unseal` only.
    """
    try:
        raw = body.encode("ascii")
    except UnicodeEncodeError:
        raise ProtocolError(f"stage line {body!r} is not ASCII") from None
    if b"*" in raw or b"\n" in raw or b"\r" in raw:
        raise ProtocolError(f"stage line {body!r} contains a reserved character")
    line = raw + b"*%04X\n" % crc16(raw)
    if len(line) > MAX_LINE_BYTES:
        raise ProtocolError(f"stage line of {len(line)} bytes is longer than {MAX_LINE_BYTES}: {body!r}")
    return line


def unseal(line: bytes) -> str:
    """Check length, line end and CRC, and return the body. Raises ProtocolError for any other line than `seal` makes.

    Bytes of the body are printable ASCII without `*`.
    """
    if len(line) > MAX_LINE_BYTES:
        raise ProtocolError(f"stage line of {len(line)} bytes is longer than {MAX_LINE_BYTES}")
    # A line ends with "*", four digits of the CRC and the line end: six characters.
    if len(line) < 6 or line[-1:] != b"\n" or line[-6:-5] != b"*":
        raise ProtocolError(f"not a stage line: {line!r}")
    body = line[:-6]
    tail = line[-5:-1]
    if tail != b"%04X" % crc16(body):
        raise ProtocolError(f"checksum {tail!r} of stage line {body!r} is wrong, expected {crc16(body):04X}")
    # Printable ASCII reaches from the space, 0x20, to "~", 0x7E.
    if any(not 0x20 <= c < 0x7F or c == ord("*") for c in body):
        raise ProtocolError(f"stage line {body!r} contains a reserved character")
    return body.decode("ascii")


class Command(msgspec.Struct, frozen=True):
    """Command to the stage: `N<sequence> <VERB> [integers]`; docs/spec/stage-line.md lists verbs and arguments."""

    sequence: int
    verb: str
    args: tuple[int, ...] = ()

    def encode(self) -> bytes:
        """Return the sealed line. Raises ProtocolError if a value is out of the protocol's range."""
        if not 0 <= self.sequence <= MAX_SEQUENCE:
            raise ProtocolError(f"sequence {self.sequence} is outside 0..{MAX_SEQUENCE}")
        if not re.fullmatch(r"[A-Z]+", self.verb):
            raise ProtocolError(f"stage verb {self.verb!r} must be capital letters")
        if any(not -(2**31) <= a < 2**31 for a in self.args):
            raise ProtocolError(f"stage arguments {self.args} must be 32-bit integers")
        return seal(" ".join([f"N{self.sequence}", self.verb, *map(str, self.args)]))

    @staticmethod
    def decode(line: bytes) -> Command:
        """Parse a sealed command line. Raises ProtocolError."""
        body = unseal(line)
        match = _COMMAND.fullmatch(body)
        if match is None or int(match[1]) > MAX_SEQUENCE:
            raise ProtocolError(f"not a stage command: {body!r}")
        args = tuple(int(a) for a in match[3].split())
        if any(not -(2**31) <= a < 2**31 for a in args):
            raise ProtocolError(f"stage arguments {args} must be 32-bit integers")
        return Command(int(match[1]), match[2], args)


class Reply(msgspec.Struct, frozen=True):
    """Reply of the stage.

    `kind` is one of

    * `banner`: boot; fields fw, proto
    * `ok`: command `sequence` accepted (motion) or executed (others); fields depend on the command
    * `error`: command refused with `number`; `sequence` is None if the line could not be read
    * `done`: motion command `sequence` ended; fields x, y, of a row also points, pulses, held, of homing lostx, losty
    * `alarm`: latched fault `number`
    * `status`: answer to the STATUS byte; fields state, x, y, points, pulses, alarm, limits, homed

    Values of `fields` are text; x and y are motor steps from the home corner. `asked_ns` and `written_ns` are not sent:
    the receiver notes that the reply was written between these times, on the clock of the trigger edges.
    """

    kind: str
    sequence: int | None = None
    number: int = 0
    fields: dict[str, str] = {}
    asked_ns: int = 0
    written_ns: int = END_OF_TIME_NS

    def encode(self) -> bytes:
        """Return the sealed line. Raises ProtocolError if it is too long or contains a reserved character."""
        tag = "-" if self.sequence is None else str(self.sequence)
        head = {
            "banner": "polysight-stage",
            "ok": f"ok N{tag}",
            "error": f"error:{self.number} N{tag}",
            "done": f"done N{tag}",
            "alarm": f"alarm:{self.number}",
            "status": "status",
        }[self.kind]
        return seal(" ".join([head, *(f"{k}={v}" for k, v in self.fields.items())]))

    @staticmethod
    def decode(line: bytes) -> Reply:
        """Parse a sealed reply line. Raises ProtocolError."""
        body = unseal(line)
        head, *field_texts = body.split(" ")
        kind, _, number = head.partition(":")
        if kind == "polysight-stage":
            kind = "banner"
        if kind not in ("banner", "ok", "error", "done", "alarm", "status"):
            raise ProtocolError(f"not a stage reply: {body!r}")
        if (kind in ("error", "alarm")) != bool(re.fullmatch(r"[0-9]{1,3}", number)):
            raise ProtocolError(f"stage reply without a valid number: {body!r}")
        sequence: int | None = None
        if kind in ("ok", "error", "done"):
            if not field_texts or not re.fullmatch(r"N([0-9]{1,5}|-)", field_texts[0]):
                raise ProtocolError(f"stage reply without a sequence number: {body!r}")
            tag = field_texts.pop(0)
            if tag != "N-":
                sequence = int(tag[1:])
        fields: dict[str, str] = {}
        for word in field_texts:
            match = _FIELD.fullmatch(word)
            if match is None or match[1] in fields:
                raise ProtocolError(f"stage reply with an invalid field {word!r}: {body!r}")
            fields[match[1]] = match[2]
        return Reply(kind, sequence, int(number or 0), fields)

    def integer(self, key: str) -> int:
        """Return an integer field. Raises ProtocolError if it is missing or not an integer."""
        value = self.fields.get(key)
        if value is None or not _VALUE.fullmatch(value):
            raise ProtocolError(f"stage reply {self.kind!r} needs an integer field {key!r}, got {value!r}")
        return int(value)
