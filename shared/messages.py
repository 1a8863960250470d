"""Every message between Pi and host, typed, packed with msgpack, checked on decode.

A message is a msgpack map. `type` names it, `version` is "major.minor": another major version is refused by name. New
fields have defaults and go last, so that old and new programs of one major version understand each other.
Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import zlib
from typing import Annotated, Any, Literal, TypeVar

import msgpack
import msgspec

from polysight.shared.errors import ProtocolError, VersionError
from polysight.shared.raster import RasterPlan, Row

WIRE_VERSION = "1.0"
MOST_PULSES = 256  # of one `Pulse` ...
MOST_PULSES_S = 2.0  # ... and how long they may last: it is answered well before anybody's patience ends
MAX_COMMAND_BYTES = 65_536  # the Pi ends the connection of who sends a longer one
LONGEST_PROMISE_MS = 10_000  # of a host's heartbeat: who falls silent locks others out for four of them
# Every field has a type that is finite and bounded: a message that does not fit is refused, and reaches nothing.
Natural = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seq = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Index = Annotated[int, msgspec.Meta(ge=0, lt=100_000)]
Take = Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
Number = Annotated[int, msgspec.Meta(ge=0, lt=1000)]
MOST_TEXT = 4000
Text = Annotated[str, msgspec.Meta(max_length=MOST_TEXT)]
Name = Annotated[str, msgspec.Meta(max_length=120)]
ScanId = Annotated[str, msgspec.Meta(min_length=1, max_length=120, pattern=r"\A[A-Za-z0-9_-][A-Za-z0-9._-]*\Z")]
ScanIdOrNone = Annotated[str, msgspec.Meta(max_length=120, pattern=r"\A[A-Za-z0-9._-]*\Z")]
Owner = Annotated[str, msgspec.Meta(max_length=64, pattern=r"\A[A-Za-z0-9-]*\Z")]
Micros = Annotated[float, msgspec.Meta(ge=0, le=1e7)]
Speed = Annotated[float, msgspec.Meta(ge=0, le=1e5)]
Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
RowStatus = Literal["done", "aborted", "fault"]
ExitStatus = Literal["success", "abort", "fail"]
State = Literal["idle", "homing", "homed", "ready", "running", "held", "done", "fault"]
GPIOD, GPIOMEM, SPI, WIRES = "gpiod", "gpiomem", "spi", "wires"
"""The Pi's trigger lines by name (`HelloReply.backend`): outputs through the kernel, by the chip's registers, by an SPI
controller, simulated."""
_HARDWARE = (GPIOD, GPIOMEM, SPI)
Timing = Literal["", "spi", "one-shot", "program"]
"""What timed a burst: the SPI controller (widths and spacings), a one-shot behind the line (widths; the program the
spacings), the program alone; "" in events of before."""


def is_simulated(backend: str) -> bool:
    """Whether nothing real is driven. A name that is not known counts as simulated: nothing is called measured then."""
    return backend not in _HARDWARE


class _Message(msgspec.Struct, frozen=True, tag_field="type", tag=True, kw_only=True):
    version: Name = WIRE_VERSION


# --- events: Pi -> host, PUB ------------------------------------------------------------------------------------------


class Event(_Message, frozen=True, kw_only=True):
    """What every event carries.

    `seq` counts the journalled events of one `scan_id` from 1 without gaps. Heartbeats and stage status are not
    journalled: they carry the `seq` of the last journalled event, so that a subscriber notices a lost last event.
    """

    scan_id: ScanIdOrNone
    seq: Seq
    t_mono_ns: Natural


class RunStarted(Event, frozen=True, kw_only=True):
    """A run was begun or taken up again. The journal lacks the `lost` events before this one; the host has them."""

    plan: RasterPlan
    resumed: bool = False
    lost: Seq = 0


class RunStopped(Event, frozen=True, kw_only=True):
    """A run was ended by the host."""

    exit_status: ExitStatus
    reason: Text = ""


class RowStarted(Event, frozen=True, kw_only=True):
    """The stage was told to run a row; `take` counts attempts at this row from 1."""

    row: Row
    take: Take


class RowFinished(Event, frozen=True, kw_only=True):
    """A row ended. `points` by the stage's count, `edges` seen, `bursts` and `pulses` sent and `timed_by` by the Pi."""

    row_index: Index
    take: Take
    status: RowStatus
    points: Natural
    edges: Natural
    bursts: Natural
    pulses: Natural
    fault: Number = 0
    reason: Text = ""
    timed_by: Timing = ""


class Capture(Event, frozen=True, kw_only=True):
    """One trigger edge and its burst. Times are the Pi's monotonic clock.

    `width_max_ns` is the longest time any pulse may have been high (upper bound), `jitter_ns` the largest deviation of
    a rising edge from its deadline.
    """

    row_index: Index
    take: Take
    point: Natural
    column: Natural
    edge_ns: Natural
    first_pulse_ns: Natural
    last_pulse_ns: Natural
    pulses: Natural
    width_max_ns: Natural
    jitter_ns: Natural


class StageStatus(Event, frozen=True, kw_only=True):
    """Where the stage is, in stage millimetres. Not journalled."""

    state: Name
    x_mm: Place
    y_mm: Place
    points: Natural = 0
    alarm: Number = 0


class Heartbeat(Event, frozen=True, kw_only=True):
    """The Pi is alive. Not journalled."""

    state: State
    period_ms: Natural


class Fault(Event, frozen=True, kw_only=True):
    """Something went wrong; the number is in shared/faults.py. The first fault wins and is kept."""

    number: Number
    what: Text
    why: Text = ""
    remedy: Text = ""


AnyEvent = RunStarted | RunStopped | RowStarted | RowFinished | Capture | StageStatus | Heartbeat | Fault
JOURNALLED = (RunStarted, RunStopped, RowStarted, RowFinished, Capture, Fault)

# --- commands: host -> Pi, REQ/REP ------------------------------------------------------------------------------------


class Command(_Message, frozen=True, kw_only=True):
    """Every command gets exactly one reply."""


class Hello(Command, frozen=True, kw_only=True):
    """Who is there? Answered with HelloReply in any state."""

    host_release: Name = ""


class BeginRun(Command, frozen=True, kw_only=True):
    """Begin a run, or take up the one with this id again after either side died.

    `last_seq` is the newest event of it that the host has: the sequence goes on behind it, even when the Pi's journal
    was lost. `heartbeat_ms`: the host promises an `Alive` so often; 0: it promises nothing. `owner`: a secret of the
    host's choice; the commands of this run have to bring it.
    """

    scan_id: ScanId
    plan: RasterPlan
    pulses: Annotated[int, msgspec.Meta(ge=1, le=65_536)]
    period_us: Micros
    width_us: Micros
    speed_mm_s: Speed
    last_seq: Seq = 0
    heartbeat_ms: Annotated[int, msgspec.Meta(ge=0, le=LONGEST_PROMISE_MS)] = 0
    owner: Owner = ""


class EndRun(Command, frozen=True, kw_only=True):
    """End the run. Answered with Accepted after RunStopped is journalled."""

    scan_id: ScanId
    exit_status: ExitStatus
    reason: Text = ""
    owner: Owner = ""


class Alive(Command, frozen=True, kw_only=True):
    """The host of this run lives. A row ends with fault 108 when four of the promised heartbeats fail to come."""

    scan_id: ScanId
    owner: Owner = ""


class Home(Command, frozen=True, kw_only=True):
    """Home the stage. Accepted at once; the state is `homing`, then `ready`."""


class RunRow(Command, frozen=True, kw_only=True):
    """Run one row of the plan. Accepted at once; RowFinished tells how it ended."""

    scan_id: ScanId
    row_index: Index
    take: Take
    owner: Owner = ""


class Hold(Command, frozen=True, kw_only=True):
    """Decelerate and wait."""

    owner: Owner = ""


class Resume(Command, frozen=True, kw_only=True):
    """Go on after a hold, on the exact grid."""

    owner: Owner = ""


class Abort(Command, frozen=True, kw_only=True):
    """Stop the row now. RowFinished with status `aborted` follows when a row was running."""

    reason: Text = ""
    owner: Owner = ""


class Pulse(Command, frozen=True, kw_only=True):
    """One burst on SYNC_IN at rest, outside of any run; nothing moves. Answered with Pulsed once it has been sent."""

    pulses: Annotated[int, msgspec.Meta(ge=1, le=MOST_PULSES)]
    period_us: Micros
    width_us: Micros


class Status(Command, frozen=True, kw_only=True):
    """Answered with StatusReply in any state."""


class Replay(Command, frozen=True, kw_only=True):
    """Journalled events of a scan from `from_seq` on, at most `limit` of them."""

    scan_id: ScanId
    from_seq: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    limit: Annotated[int, msgspec.Meta(ge=1, le=10000)] = 1000


AnyCommand = Hello | BeginRun | EndRun | Alive | Home | RunRow | Hold | Resume | Abort | Status | Replay | Pulse

# --- replies: Pi -> host ----------------------------------------------------------------------------------------------


class HelloReply(_Message, frozen=True, kw_only=True):
    """Who answers, and in which state. Not told: 0 of the wall clock, {} of `stage` (`shared.raster.Stage.placing`)."""

    pi_release: Name
    firmware: Name
    backend: Name
    state: State
    scan_id: ScanIdOrNone
    last_seq: Seq
    t_unix_ns: Natural = 0
    in_run: bool = False
    stage: dict[Name, Place] = {}


class Accepted(_Message, frozen=True, kw_only=True):
    """The command was taken; `state` is the state after it."""

    state: State


class Refused(_Message, frozen=True, kw_only=True):
    """The command was not taken, and nothing changed."""

    number: Number
    what: Text
    why: Text = ""
    remedy: Text = ""


class StatusReply(_Message, frozen=True, kw_only=True):
    """Everything the Pi knows about itself. `row_index` is -1 when no row runs. `lost_x_mm`, `lost_y_mm`: how far the
    motors were off when the last homing met the switches, since the homing before it.
    """

    state: State
    homed: bool
    x_mm: Place
    y_mm: Place
    scan_id: ScanIdOrNone
    row_index: Annotated[int, msgspec.Meta(ge=-1, lt=100_000)]
    take: Seq
    points: Natural
    pulses: Natural
    last_seq: Seq
    fault: Number
    reason: Text
    lost_x_mm: Place = 0.0
    lost_y_mm: Place = 0.0


class ReplayReply(_Message, frozen=True, kw_only=True):
    """Events in order; `last_seq` is the newest in the journal of that scan (0 when there is none)."""

    events: Annotated[list[AnyEvent], msgspec.Meta(max_length=10_000)]
    last_seq: Seq


class Pulsed(_Message, frozen=True, kw_only=True):
    """The burst of a `Pulse`: pulses sent, the longest one (upper bound), the latest edge; `fault` as of a row's."""

    pulses: Natural
    width_max_ns: Natural
    jitter_ns: Natural
    fault: Number = 0
    timed_by: Timing = ""


AnyReply = HelloReply | Accepted | Refused | StatusReply | ReplayReply | Pulsed

M = TypeVar("M")


def pack(message: AnyEvent | AnyCommand | AnyReply) -> bytes:
    """A message as msgpack bytes."""
    packed = msgpack.packb(msgspec.to_builtins(message), use_bin_type=True)
    if packed is None:
        raise ProtocolError(f"{type(message).__name__} cannot be packed")
    return packed


def _unpack(raw: bytes, kind: Any, what: str) -> Any:
    try:
        node = msgpack.unpackb(raw, raw=False, strict_map_key=True)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as e:
        raise ProtocolError(
            f"{what} of {len(raw)} bytes is not msgpack: {str(e)[:200]}", "another program on this port?"
        ) from None
    version = node.get("version") if isinstance(node, dict) else None
    if isinstance(version, str) and version.partition(".")[0] != WIRE_VERSION.partition(".")[0]:
        raise VersionError(
            f"{what} {str(node.get('type'))[:40]!r} has wire version {version[:20]},"
            f" this program speaks {WIRE_VERSION}",
            "host and Pi are of different releases",
            "install the same release on both",
        )
    try:
        return msgspec.convert(node, kind)
    except msgspec.ValidationError as e:
        raise ProtocolError(
            f"{what} does not follow its declaration: {str(e)[:300]}", "host and Pi are of different releases"
        ) from None


def unpack_event(raw: bytes) -> AnyEvent:
    """Decode and check an event. Raises ProtocolError."""
    return _unpack(raw, AnyEvent, "event")


def pack_kept(event: AnyEvent) -> bytes:
    """An event as files keep it: its map with a last key `crc`, the CRC-32 of the map packed without it."""
    raw = pack(event)
    return msgpack.packb({**msgpack.unpackb(raw), "crc": zlib.crc32(raw)}) or b""


def unpack_kept(raw: bytes) -> AnyEvent:
    """Decode and check an event of a file. Raises ProtocolError."""
    event = unpack_event(raw)
    node = msgpack.unpackb(raw)
    if node.pop("crc", None) != zlib.crc32(msgpack.packb(node) or b""):
        raise ProtocolError(f"the CRC of event {event.seq} is wrong", "damaged")
    return event


def unpack_command(raw: bytes) -> AnyCommand:
    """Decode and check a command. Raises ProtocolError."""
    return _unpack(raw, AnyCommand, "command")


def unpack_reply(raw: bytes) -> AnyReply:
    """Decode and check a reply. Raises ProtocolError."""
    return _unpack(raw, AnyReply, "reply")
