"""What the checks share: findings, the rig file once it is read, the link to the Pi, cards, a capture at rest.

A `Finding` is one line of the doctor. `Bench` is one run, and `capture` records a few bursts of every board. Clock,
disk and kernel are passed in (`System`), so that every fault can be tried without having it.
"""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import socket
import struct
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from polysight.host.acquisition import CaptureRig, PiClient
from polysight.host.capture import CardSurvey, RowCapture, row_words, survey_cards
from polysight.host.doctor.receiver_load import Held, measure
from polysight.host.radar import BoardState, radar_control
from polysight.host.store import PART
from polysight.shared.config import Board, Instrument
from polysight.shared.errors import PolysightError
from polysight.shared.messages import HelloReply, Pulsed

if TYPE_CHECKING:
    from polysight.host.calibration import DirectSignal

Verdict = Literal["ok", "warning", "error", "not checked"]
BURSTS = 4  # of a capture at rest
_TAIL_S = 2.5  # a card sends its short last packet two seconds after the last data
_LOOK_S = 0.05
_STA_UNSYNC = 0x40  # of adjtimex(2)
_SIOCETHTOOL, _ETHTOOL_GRINGPARAM = 0x8946, 0x10
_LOST = ("rx_missed_errors", "rx_fifo_errors", "rx_dropped")
_PROBE_BYTES, _PROBE_S = 64 << 20, 2.0  # of the disk's speed


@dataclass(frozen=True)
class Finding:
    """One line of the doctor. `check` is filled in by the walk; `facts` are the numbers behind it, for programs."""

    verdict: Verdict
    found: str
    why: str = ""
    remedy: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    check: str = ""


def ok(found: str, **facts: Any) -> Finding:
    """As it should be."""
    return Finding("ok", found, facts=facts)


def warning(found: str, why: str, remedy: str, **facts: Any) -> Finding:
    """Good enough to scan."""
    return Finding("warning", found, why, remedy, facts)


def error(found: str, why: str, remedy: str, **facts: Any) -> Finding:
    """A scan would fail, or be worth nothing."""
    return Finding("error", found, why, remedy, facts)


def not_checked(found: str, remedy: str = "") -> Finding:
    """Left out, by choice or because what it needs is not there."""
    return Finding("not checked", found, remedy=remedy)


def of_error(e: PolysightError) -> Finding:
    """What an error says."""
    return error(e.what, e.why, e.remedy)


def clock_is_synchronised() -> bool | None:
    """Whether the kernel calls its wall clock synchronised (adjtimex(2)); None where it does not tell."""
    timex = ctypes.create_string_buffer(512)  # struct timex, with room; modes = 0 only reads
    adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    if adjtimex is None or adjtimex(timex) < 0:
        return None
    *_, status = struct.unpack_from("@illlli", timex.raw)  # modes, offset, freq, maxerror, esterror, status
    return not status & _STA_UNSYNC


@dataclass(frozen=True)
class Nic:
    """A network interface. What cannot be read is None; `lost` counts packets dropped since it came up."""

    name: str
    mtu: int | None = None
    speed_mbit: int | None = None
    ring: int | None = None
    ring_max: int | None = None
    lost: int = 0


def nic(name: str, root: Path = Path("/")) -> Nic:
    """What the kernel says of an interface. The ring (ethtool) is asked for only on the machine itself."""
    folder = root / "sys/class/net" / name

    def number(file: str) -> int | None:
        try:
            value = int((folder / file).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None
        return value if value >= 0 else None

    ring = _ring(name) if root == Path("/") else None
    return Nic(
        name,
        number("mtu"),
        number("speed"),
        *(ring or (None, None)),
        sum(number(f"statistics/{counter}") or 0 for counter in _LOST),
    )


def _ring(name: str) -> tuple[int, int] | None:
    """Receive descriptors in use and possible (ethtool -g); None where the driver does not tell."""
    words = array.array("I", [_ETHTOOL_GRINGPARAM] + 8 * [0])
    request = struct.pack("16sP16x", name.encode()[:15], words.buffer_info()[0])
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError:
        return None
    return words[5], words[1]


def write_speed(folder: Path) -> float:
    """Bytes a second that this folder's disk takes durably: a file that is written, synced and removed again.

    64 MiB, or what two seconds take. Raises OSError.
    """
    block = os.urandom(1 << 20)
    with tempfile.TemporaryFile(dir=folder) as file:
        began, written = time.perf_counter(), 0
        while written < _PROBE_BYTES and time.perf_counter() - began < _PROBE_S:
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            written += len(block)
        return written / (time.perf_counter() - began)


@dataclass(frozen=True)
class Wanted:
    """What the user asked for."""

    config: Path
    out: Path = Path()
    move: bool = False
    pulse: bool = True
    bursts: int = BURSTS


@dataclass(frozen=True)
class System:
    """What the checks ask of this machine."""

    wall_ns: Callable[[], int] = time.time_ns
    clock_is_synchronised: Callable[[], bool | None] = clock_is_synchronised
    write_speed: Callable[[Path], float] = write_speed
    held: Callable[[Instrument, list[float]], tuple[list[Held], str]] = measure
    root: Path = Path("/")


@dataclass
class Bench:
    """One run of the doctor. Use as a context manager.

    Attributes
    ----------
    given
        The rig, once `config` found it good. Checks that need it come after.
    hello, hello_at_ns
        What the Pi said of itself, and this machine's wall clock in the middle of asking.
    captured
        Frames of each board that was captured.
    signals
        What was found in them of the direct path.
    """

    wanted: Wanted
    system: System = System()
    given: Instrument | None = None
    hello: HelloReply | None = None
    hello_at_ns: int = 0
    hello_took_ns: int = 0
    sound: set[str] = field(default_factory=set)  # boards whose card can be used
    captured: dict[str, Captured] = field(default_factory=dict)
    signals: dict[str, DirectSignal] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)

    @property
    def rig(self) -> Instrument:
        """The rig. Raises RuntimeError before it was read: a check that needs it names `config` among its needs."""
        if self.given is None:
            raise RuntimeError("this check needs the rig file, and does not say so")
        return self.given

    @property
    def boards(self) -> tuple[Board, ...]:
        """Boards that are recorded."""
        return () if self.given is None else self.given.recorded

    @cached_property
    def pi(self) -> PiClient:
        """The link to the Pi, made when it is first needed. Raises ConfigError without keys it needs."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._stack.callback(context.destroy, linger=0)
        return self._stack.enter_context(PiClient(context, self.rig))

    @cached_property
    def surveys(self) -> dict[str, CardSurvey]:
        """Every card of the rig file, asked once, all at the same time."""
        return {survey.board.name: survey for survey in survey_cards(self.rig)}

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()


@dataclass(frozen=True)
class Captured:
    """One board's frames.

    Attributes
    ----------
    words
        int16 [frame, sample, 2, rx], I before Q.
    valid
        bool [frame]: received whole.
    row
        What the receiver counted.
    radar
        What the radar's backend says of it; None when nobody tells.
    """

    words: NDArray[np.int16]
    valid: NDArray[np.bool_]
    row: RowCapture
    radar: BoardState | None = None


def only(rig: Instrument, names: set[str]) -> Instrument:
    """The rig with only these boards recorded."""
    boards = tuple(msgspec.structs.replace(b, record=b.record and b.name in names) for b in rig.boards)
    return msgspec.structs.replace(rig, boards=boards)


def capture(rig: Instrument, pi: PiClient, bursts: int) -> tuple[dict[str, Captured], Pulsed]:
    """Record `bursts` bursts of every recorded board of the rig, at rest. Nothing moves, and nothing is kept.

    They are sent as one, so that no card takes the pause between two for the end of its record.

    Raises
    ------
    DeviceError, ScanError
        when a card, the disk or the Pi does not do its part; ConfigError when the radars cannot be reached as asked.
    """
    frames = bursts * rig.burst.pulses
    with (
        tempfile.TemporaryDirectory(prefix="polysight-doctor-") as folder,
        CaptureRig(rig) as cards,  # first: ports that a scan holds refuse before a radar is touched
        radar_control(rig) as radars,
    ):
        for board in rig.recorded:
            (Path(folder) / "raw" / board.name).mkdir(parents=True)
        cards.configure()
        radars.arm(frames)
        cards.begin_row(0, 1, bursts, Path(folder))
        radars.row_begins()
        sent = pi.pulse(frames, rig.burst.period_us, rig.burst.width_us)
        deadline = time.monotonic() + _TAIL_S + rig.limits.end_of_record_s
        while not cards.complete and time.monotonic() < deadline:
            cards.statuses()
            time.sleep(_LOOK_S)
        rows, states = cards.end_row(), radars.states()
        return {name: _read(rig, Path(folder), name, row, states.get(name), frames) for name, row in rows.items()}, sent


def _read(rig: Instrument, folder: Path, name: str, row: RowCapture, radar: BoardState | None, frames: int) -> Captured:
    payload = np.fromfile(folder / "raw" / name / f"0000{PART}", np.uint8)
    chirps = frames * rig.burst.chirps
    words, valid = row_words(payload, row.missing, chirps, rig.chirp.samples, len(rig.antennas.rx_mm))
    return Captured(words, valid, row, radar)
