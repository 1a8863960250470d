"""Messages between Pi and host: typed, packed with msgpack, checked on decoding.

A message is a msgpack map with its `type` and its `version`, "major.minor"; another major version is refused. New
fields have defaults and come last, so that all minor versions are compatible. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import zlib
from typing import Annotated, Any, Literal

import msgpack
import msgspec

from polysight_shared.errors import ErrorCode, ProtocolError, VersionError
from polysight_shared.raster import RasterPlan, Row

# "major.minor": a new major number whenever older programs could not read a message.
WIRE_VERSION = "1.0"
# Limits of `Pulse`: number of pulses, and duration, so that the reply arrives well before the timeout of a command.
MAX_PULSES_AT_REST = 256
MAX_PULSES_AT_REST_S = 2.0
# The Pi closes the connection after a longer command; chosen.
MAX_COMMAND_BYTES = 65_536
# Longest heartbeat period of the host (chosen): a host that has died keeps others out for four periods.
MAX_HEARTBEAT_MS = 10_000
# Limits of `Jog` (chosen): a person who watches the stage presses again.
MAX_JOG_MM = 100.0
MAX_JOG_S = 60.0
# Types of the fields: all are finite and bounded, other values are refused. `Index` counts rows, `Take` the attempts at
# a row, `Seq` the events of a scan. `Number` is a fault number (faults.py), `Owner` the secret of a host, `Micros` a
# time in microseconds, `Speed` in mm/s, `Place` a coordinate or distance in mm.
Natural = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seq = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Index = Annotated[int, msgspec.Meta(ge=0, lt=100_000)]
Take = Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
Number = Annotated[int, msgspec.Meta(ge=0, lt=1000)]
# Longest reason or error text, characters; chosen.
MAX_TEXT = 4000
Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
Name = Annotated[str, msgspec.Meta(max_length=120)]
ScanId = Annotated[str, msgspec.Meta(min_length=1, max_length=120, pattern=r"\A[A-Za-z0-9_-][A-Za-z0-9._-]*\Z")]
ScanIdOrNone = Annotated[str, msgspec.Meta(max_length=120, pattern=r"\A([A-Za-z0-9_-][A-Za-z0-9._-]*)?\Z")]
Owner = Annotated[str, msgspec.Meta(max_length=64, pattern=r"\A[A-Za-z0-9-]*\Z")]
Micros = Annotated[float, msgspec.Meta(ge=0, le=1e7)]
Speed = Annotated[float, msgspec.Meta(ge=0, le=1e5)]
Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Axis = Literal["x", "y"]
RowStatus = Literal["done", "aborted", "fault"]
ExitStatus = Literal["success", "abort", "fail"]
State = Literal["idle", "homing", "jogging", "homed", "ready", "running", "held", "done", "fault"]
# Backends of the Pi's SYNC_IN output (`HelloReply.backend`): the kernel's GPIO lines, the SPI controller, and simulated
# wires.
GPIOD = "gpiod"
SPI = "spi"
WIRES = "wires"
# "gpiomem", the registers of the GPIO lines, is in scans of old releases.
_HARDWARE = (GPIOD, SPI, "gpiomem")
Timing = Literal["", "spi", "one-shot", "program"]
"""Part that times a burst. "spi": the SPI controller times all edges. "one-shot": a monostable circuit times the
widths, the program the periods. "program": the program times all edges. "" in events of earlier releases."""


def is_simulated(backend: str) -> bool:
    """Return True if the backend drives no hardware. An unknown backend counts as simulated, to be on the safe side."""
    return backend not in _HARDWARE


# Fields whose key on the wire and in files of events is another word than their name in the code.
_KEYS_ON_THE_WIRE = {"problem": "what", "cause": "why", "lost_events": "lost"}


class _Message(msgspec.Struct, frozen=True, tag_field="type", tag=True, kw_only=True):
    """Base class of all messages; `type` on the wire is the name of the class."""

    version: Name = WIRE_VERSION


# --- events: Pi -> host, PUB ------------------------------------------------------------------------------------------


class Event(_Message, frozen=True, kw_only=True):
    """Fields of every event; `t_mono_ns` is its time on the Pi's monotonic clock.

    `seq` counts the journalled events of one `scan_id` from 1, without gaps unless a journal was lost (`lost_events` of
    `RunStarted`). Heartbeats and stage status are not journalled: they have the `seq` of the last journalled event, so
    that a subscriber detects a lost last event.
    """

    scan_id: ScanIdOrNone
    seq: Seq
    t_mono_ns: Natural


class RunStarted(Event, frozen=True, kw_only=True, rename=_KEYS_ON_THE_WIRE):
    """A run was started or resumed. `lost_events`: number of earlier events that only the host still has."""

    plan: RasterPlan
    resumed: bool = False
    lost_events: Seq = 0


class RunStopped(Event, frozen=True, kw_only=True):
    """The host ended a run."""

    exit_status: ExitStatus
    reason: Text = ""


class RowStarted(Event, frozen=True, kw_only=True):
    """The stage got the command to run a row; `take` counts the attempts at this row from 1."""

    row: Row
    take: Take


class RowFinished(Event, frozen=True, kw_only=True):
    """A row ended. `points` is the stage's count; `edges`, `bursts` and `pulses` are those of the Pi.

    `fault` and `reason`: 0 and "" if `status` is `done` (a row that was held has a reason). `timed_by`: source of the
    pulses' widths and periods. `pulses_seen`: as in `Capture`.
    """

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
    pulses_seen: bool = False


class Capture(Event, frozen=True, kw_only=True):
    """One trigger edge and its burst. Times are on the Pi's monotonic clock.

    `point` counts from 0 in the order of the row, `column` from 0 at the smallest x.
    `width_max_ns` is an upper bound of the pulse widths, `jitter_ns` the largest deviation of a rising edge from its
    scheduled time. `pulses_seen`: `pulses` were counted at the connector; False: they were sent, not seen.
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
    pulses_seen: bool = False


class StageStatus(Event, frozen=True, kw_only=True):
    """State and position of the stage, stage coordinates. Not journalled.

    `points`: points of the row that the stage has passed; `alarm`: number of its latched alarm, 0 for none.
    """

    state: Name
    x_mm: Place
    y_mm: Place
    points: Natural = 0
    alarm: Number = 0


class Heartbeat(Event, frozen=True, kw_only=True):
    """Sent by the Pi every `period_ms`. Not journalled."""

    state: State
    period_ms: Natural


class Jogged(Event, frozen=True, kw_only=True):
    """A jog ended. `from_mm` and `distance_mm` as in `Jog`; `end_mm`: position at the end, if `status` is `done`."""

    axis: Axis
    from_mm: Place
    distance_mm: Place
    end_mm: Place
    status: RowStatus
    fault: Number = 0
    reason: Text = ""


class Fault(Event, frozen=True, kw_only=True, rename=_KEYS_ON_THE_WIRE):
    """A fault with its number in shared/polysight_shared/faults.py. The first fault of a row is kept."""

    number: Number
    problem: Text
    cause: Text = ""
    remedy: Text = ""


# All events; those that are stored in the journal.
AnyEvent = RunStarted | RunStopped | RowStarted | RowFinished | Capture | StageStatus | Heartbeat | Fault | Jogged
JOURNALLED_EVENTS = (RunStarted, RunStopped, RowStarted, RowFinished, Capture, Fault, Jogged)

# --- commands: host -> Pi, REQ/REP ------------------------------------------------------------------------------------


class Command(_Message, frozen=True, kw_only=True):
    """Base class of commands. Every command gets exactly one reply."""


class Hello(Command, frozen=True, kw_only=True):
    """Request identity and state. Answered with HelloReply in any state."""

    host_release: Name = ""


class BeginRun(Command, frozen=True, kw_only=True):
    """Start a run, or resume the run with this id after a restart of either side.

    `pulses`, `period_us` and `width_us` are the burst of each position, `speed_mm_s` the speed of the stage in a row.
    `last_seq` is the run's last event that the host has; the Pi continues the sequence after it, even if its journal
    was lost. `heartbeat_ms`: period of the host's `Alive` messages; 0: none. `owner`: a secret chosen by the host,
    required in all commands of this run. `owns_home`: `Home` requires it, too; False from old hosts, whose `Home` has
    no owner.
    """

    scan_id: ScanId
    plan: RasterPlan
    pulses: Annotated[int, msgspec.Meta(ge=1, le=65_536)]
    period_us: Micros
    width_us: Micros
    speed_mm_s: Speed
    last_seq: Seq = 0
    heartbeat_ms: Annotated[int, msgspec.Meta(ge=0, le=MAX_HEARTBEAT_MS)] = 0
    owner: Owner = ""
    owns_home: bool = False


class EndRun(Command, frozen=True, kw_only=True):
    """End the run. Answered with Accepted after RunStopped is journalled."""

    scan_id: ScanId
    exit_status: ExitStatus
    reason: Text = ""
    owner: Owner = ""


class Alive(Command, frozen=True, kw_only=True):
    """Heartbeat of the host. A row, a homing or a jog ends with fault 108 if four consecutive heartbeats are missing.

    `scan_id` is "" for a jog outside of a run.
    """

    scan_id: ScanIdOrNone
    owner: Owner = ""


class Home(Command, frozen=True, kw_only=True):
    """Home the stage. Accepted immediately; the state is `homing`, then `ready` in a run and `homed` outside of one.

    `owner`: the owner of the current run, if there is one and its host is alive.
    """

    owner: Owner = ""


class Jog(Command, frozen=True, kw_only=True):
    """Move one axis of the homed stage by a distance. Accepted immediately; `Jogged` has the result.

    `from_mm`: the axis' position by the sender's knowledge; the stage does not move if it is elsewhere, so that a
    repeated command moves it once. `heartbeat_ms`: period of the sender's `Alive`, without which the stage stops.
    `owner`: as in `Home`.
    """

    axis: Axis
    from_mm: Place
    distance_mm: Annotated[float, msgspec.Meta(ge=-MAX_JOG_MM, le=MAX_JOG_MM)]
    speed_mm_s: Speed
    heartbeat_ms: Annotated[int, msgspec.Meta(ge=1, le=MAX_HEARTBEAT_MS)]
    owner: Owner = ""


class RunRow(Command, frozen=True, kw_only=True):
    """Run one row of the plan. Accepted immediately; RowFinished has the result."""

    scan_id: ScanId
    row_index: Index
    take: Take
    owner: Owner = ""


class Hold(Command, frozen=True, kw_only=True):
    """Decelerate within the row and wait."""

    owner: Owner = ""


class Resume(Command, frozen=True, kw_only=True):
    """Continue after a hold, on the exact grid."""

    owner: Owner = ""


class Abort(Command, frozen=True, kw_only=True):
    """Stop the row, jog or homing immediately. For a row or a jog, RowFinished or Jogged (`aborted`) follows."""

    reason: Text = ""
    owner: Owner = ""


class Pulse(Command, frozen=True, kw_only=True):
    """Send one burst on SYNC_IN at rest, outside of a run. Answered with Pulsed after the burst."""

    pulses: Annotated[int, msgspec.Meta(ge=1, le=MAX_PULSES_AT_REST)]
    period_us: Micros
    width_us: Micros


class Status(Command, frozen=True, kw_only=True):
    """Request the status. Answered with StatusReply in any state."""


class Replay(Command, frozen=True, kw_only=True):
    """Request journalled events of a scan from `from_seq` on, at most `limit`."""

    scan_id: ScanId
    from_seq: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    limit: Annotated[int, msgspec.Meta(ge=1, le=10000)] = 1000


AnyCommand = Hello | BeginRun | EndRun | Alive | Home | Jog | RunRow | Hold | Resume | Abort | Status | Replay | Pulse

# --- replies: Pi -> host ----------------------------------------------------------------------------------------------


class HelloReply(_Message, frozen=True, kw_only=True):
    """Identity and state of the Pi.

    `backend` is what makes the pulses (GPIOD, SPI or WIRES), `last_seq` the newest event of `scan_id`, `in_run` True
    while a run is active. `t_unix_ns`: the Pi's clock; `stage`: settings by which the Pi places rows, to compare with
    the host's (`Stage.placement_settings`); older releases send 0 and {}.
    """

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
    """The command was accepted; `state` is the state after it."""

    state: State


class Refused(_Message, frozen=True, kw_only=True, rename=_KEYS_ON_THE_WIRE):
    """The command was refused, and changed nothing."""

    number: Number
    problem: Text
    cause: Text = ""
    remedy: Text = ""


class StatusReply(_Message, frozen=True, kw_only=True):
    """Status of the Pi. If no row is running, `row_index` is -1 and `take` 0.

    `points` and `pulses` are bursts and pulses that were sent in the running row. `fault` and `reason` are the first
    fault since the last homing, row or jog began; 0 and "" if there was none.

    `lost_x_mm`, `lost_y_mm`: position error found by the last homing at the switches, since the homing before it.
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
    """Events in order; `last_seq` is the last one in the journal of that scan (0 if there is none)."""

    events: Annotated[list[AnyEvent], msgspec.Meta(max_length=10_000)]
    last_seq: Seq


class Pulsed(_Message, frozen=True, kw_only=True):
    """Result of `Pulse`: the fields of a burst as in `Capture`, and the fault number."""

    pulses: Natural
    width_max_ns: Natural
    jitter_ns: Natural
    fault: Number = 0
    timed_by: Timing = ""
    pulses_seen: bool = False


AnyReply = HelloReply | Accepted | Refused | StatusReply | ReplayReply | Pulsed


def pack(message: AnyEvent | AnyCommand | AnyReply) -> bytes:
    """Pack a message as msgpack."""
    return msgpack.packb(msgspec.to_builtins(message), use_bin_type=True) or b""


def _unpack(raw: bytes, kind: Any, what: str) -> Any:
    """Decode a message of the union `kind`; `what` names it in errors.

    Raises VersionError for another major version, ProtocolError for any other fault.
    """
    try:
        node = msgpack.unpackb(raw, raw=False, strict_map_key=True)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as e:
        raise ProtocolError(
            f"{what} of {len(raw)} bytes is not msgpack: {str(e)[:200]}",
            "another program uses this port",
            code=ErrorCode.MESSAGE_INVALID,
        ) from None
    version = node.get("version") if isinstance(node, dict) else None
    if isinstance(version, str) and version.partition(".")[0] != WIRE_VERSION.partition(".")[0]:
        raise VersionError(
            f"{what} {str(node.get('type'))[:40]!r} has wire version {version[:20]}, this program uses {WIRE_VERSION}",
            "host and Pi have different releases",
            "install the same release on both",
            code=ErrorCode.VERSION_UNSUPPORTED,
        )
    try:
        return msgspec.convert(node, kind)
    except msgspec.ValidationError as e:
        raise ProtocolError(
            f"{what} has invalid fields: {str(e)[:300]}",
            "host and Pi have different releases",
            code=ErrorCode.MESSAGE_INVALID,
        ) from None


def unpack_event(raw: bytes) -> AnyEvent:
    """Decode and check an event. Raises ProtocolError."""
    return _unpack(raw, AnyEvent, "event")


def pack_with_crc(event: AnyEvent) -> bytes:
    """Pack an event for a file: its map with a last key `crc`, the CRC-32 of the packed map without it."""
    raw = pack(event)
    return msgpack.packb({**msgpack.unpackb(raw), "crc": zlib.crc32(raw)}) or b""


def unpack_with_crc(raw: bytes) -> AnyEvent:
    """Decode and check an event from a file. Raises ProtocolError."""
    event = unpack_event(raw)
    node = msgpack.unpackb(raw)
    if node.pop("crc", None) != zlib.crc32(msgpack.packb(node) or b""):
        raise ProtocolError(
            f"the CRC of event {event.seq} is wrong", "the file is damaged", code=ErrorCode.FILE_DAMAGED
        )
    return event


def unpack_command(raw: bytes) -> AnyCommand:
    """Decode and check a command. Raises ProtocolError."""
    return _unpack(raw, AnyCommand, "command")


def unpack_reply(raw: bytes) -> AnyReply:
    """Decode and check a reply. Raises ProtocolError."""
    return _unpack(raw, AnyReply, "reply")
