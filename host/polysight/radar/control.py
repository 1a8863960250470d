"""Control of radars that start a frame at each SYNC_IN pulse: the interface `RadarControl` and its three backends.

Each row calls `arm` before its cards record, and `states` during the row and at its end (docs/spec/row.md). A backend
reports only what it knows: a board behind a control line without replies stays `UNKNOWN`, and only its data shows that
it was armed, because an armed radar sends nothing before its first pulse.

* `NativeRadars`: this host configures and arms the radars over USB. After a fault a board is reset and configured again
  when the next row, or the retake of a row, is armed; a lost link is reopened. Not run on hardware yet.
* `LineServers` re-arms the radars for each row over TCP: a server for each board receives the line `Retrigger` and
  never replies. The published rig works so: a MATLAB server on the computer of mmWave Studio configures a radar for the
  frames of one row, and restarts it at each line. The kernel of the server's machine acknowledges the line; only the
  data of the row shows that the server read it and that the radar started.
* `Endless`: another program started the radars.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from polysight.radar.board import RadarBoard, State
from polysight.radar.calibration_data import NO_DIE, CalibrationFiles
from polysight.radar.commands import check_constraints, direct_if_hz, list_constraints, make_program
from polysight.radar.diagnosis import TracedWords, new_trace, trace_words
from polysight.radar.firmware import Image, read_image
from polysight.radar.messages import command, encode
from polysight.radar.usb import TCP_PREFIX, Clock, SystemClock, WordLink, open_tcp, open_usb
from polysight_shared.closing import Closing
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode


class RadarState(Enum):
    """Known state of one radar."""

    UNKNOWN = "not reported"
    ARMED = "waits for pulses, or sends frames"
    DONE = "all its frames have ended"
    FAULT = "has stopped with a fault"


class BoardState(NamedTuple):
    """A radar's state with a description."""

    state: RadarState
    detail: str = ""


class RadarControl(Closing):
    """The radars of a rig; a context manager that closes the connections."""

    @abstractmethod
    def arm(self, frames: int) -> None:
        """Arm every board for a frame at each of the next `frames` pulses.

        Afterwards `states` returns `ARMED` for boards that confirmed it. Raises DeviceError if a board or its control
        server fails.
        """

    @abstractmethod
    def states(self) -> dict[str, BoardState]:
        """Return the states by board name, without waiting; boards without any information may be missing."""

    def note_row_start(self) -> None:
        """Note that pulses may come from now on."""

    def wait_done(self, timeout_s: float) -> list[str]:
        """Wait after the row's last pulse; return the boards whose frames did not end within the timeout, seconds."""
        del timeout_s
        return []

    def report(self) -> dict[str, object]:
        """Return the radars' report for the manifest since the last call; empty if there is none."""
        return {}

    def close(self) -> None:
        """Close the connections; may be called twice."""


# Time between two queries of the boards (chosen).
_POLL_S = 0.005
# USB needs some time to find a chip again that was reset or replugged. Both times are chosen.
_REOPEN_TIMEOUT_S = 5.0
_REOPEN_INTERVAL_S = 0.25
# State of the radar in a row, by the state of its board; a board in another state is not armed.
_STATES = {
    State.ARMED: RadarState.ARMED,
    State.RUNNING: RadarState.ARMED,
    State.DONE: RadarState.DONE,
    State.FAULT: RadarState.FAULT,
}


def open_board(place: str, slow: bool = False) -> WordLink:
    """Open a board's word link by its USB serial number, `usb:PATH`, or `tcp://address:port`.

    `slow`: send words one by one at 1 MHz. Raises ConfigError, DeviceError.
    """
    if place.startswith(TCP_PREFIX):
        return open_tcp(place, slow)
    return open_usb(place, slow)


def make_radar_board(rig: Instrument, name: str, words: WordLink, clock: Clock, firmware: Image | None) -> RadarBoard:
    """Create a board of a rig with its word link and firmware."""
    native = rig.radar.native[name]
    commands = make_program(rig, rig.by_name(name))
    # Calibration data is kept for one chip with the same settings.
    settings = b"".join(command.block().data for command in (*commands.basic, *commands.waveform))
    folder = rig.radar.calibration_dir
    calibration = None
    if folder:
        calibration = CalibrationFiles(Path(folder), settings)
    return RadarBoard(name, words, clock, commands, firmware=firmware, die_id=native.die_id, calibration=calibration)


def plan_lines(rig: Instrument) -> tuple[list[str], bool]:
    """Return lines with each constraint and, if all hold, each board's commands in hexadecimal; and whether all hold.

    Power-up, RF init, queries and the start of frames are not among the commands.
    """
    frames = rig.grid.columns * rig.burst.pulses
    checked_constraints = list_constraints(rig, frames)
    lines = []
    for constraint in checked_constraints:
        if constraint.holds:
            lines.append(f"holds   {constraint}")
        else:
            lines.append(f"BROKEN  {constraint}\n        do: {constraint.remedy}")
    if not all(c.holds for c in checked_constraints):
        return [*lines, "\nnothing would be sent"], False
    for board in rig.boards:
        lines.append(f"\n{board.name}, its settings, with sequence numbers as if only they were sent:")
        commands = make_program(rig, board)
        for number, sent in enumerate((*commands.basic, *commands.waveform, *commands.make_frame_commands(frames))):
            # Sequence numbers have four bits.
            raw = encode(command((sent.block(),), sequence=number % 16))
            lines.append(f"  {sent.name:19} {raw.hex()}")
    lines.append("\nnot shown: power-up, RF init, frame start, and queries (versions, die id, temperatures)")
    return lines, True


def read_firmware(rig: Instrument) -> Image | None:
    """Read and check the firmware image of a rig file; None if it has none. Raises ConfigError."""
    if not rig.radar.firmware:
        return None
    try:
        return read_image(Path(rig.radar.firmware))
    except OSError as e:
        raise ConfigError(
            f"radar.firmware: {rig.radar.firmware} cannot be read: {e.strerror}",
            "a typing error",
            "correct the path",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None


class _LostLink:
    """Replaces a link that could not be reopened; every call raises the error of opening it."""

    def __init__(self, error: DeviceError) -> None:
        self._error = error

    def _fail(self, *_: object, **__: object) -> Any:
        raise DeviceError(self._error.what, self._error.why, self._error.remedy, code=self._error.code)

    write = read = interrupt = reset = _fail

    def close(self) -> None:
        """Do nothing."""


def _make_folder(folder: Path) -> None:
    """Make the folder of traces. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ConfigError(
            f"radar.trace_dir: {folder} cannot be created: {e.strerror}",
            "a typing error, or a missing permission",
            "correct the path",
            code=ErrorCode.FILE_UNWRITABLE,
        ) from None


class NativeRadars(RadarControl):
    """All boards of a rig, each opened at the place that the rig file has: serial number, USB path, or TCP address.

    Parameters
    ----------
    rig
        Rig file with `radar.native` for each board; its constraints are checked before anything is sent.
    open_words
        Opens a board's word link by its place; default: `open_board`.
    clock
        Default: the system's.

    Raises
    ------
    ConfigError
        if a constraint is broken, or the USB library is missing.
    DeviceError
        if a board cannot be opened or configured.
    """

    def __init__(
        self, rig: Instrument, open_words: Callable[[str], WordLink] | None = None, clock: Clock | None = None
    ) -> None:
        self._rig = rig
        self._clock = clock or SystemClock()
        self._open_words = open_words or partial(open_board, slow=rig.radar.slow_spi)
        frames = rig.grid.columns * rig.burst.pulses
        check_constraints(rig, frames)
        self._constraints = [str(c) for c in list_constraints(rig, frames)]
        self._boards: dict[str, RadarBoard] = {}
        self._traces: list[TracedWords] = []
        if rig.radar.trace_dir:
            _make_folder(Path(rig.radar.trace_dir))
        firmware = read_firmware(rig)
        with ExitStack() as opened:
            opened.callback(self.close)
            for board in rig.boards:
                words = self._open(board.name)
                self._boards[board.name] = make_radar_board(rig, board.name, words, self._clock, firmware)
            for board in self._boards.values():
                board.configure()
            self._check_distinct()
            opened.pop_all()

    def arm(self, frames: int) -> None:
        """Start `frames` frames on every board and wait until each waits for triggers or has failed.

        `states` reports a failed board, which costs one take of the row (it is retaken), not the scan. Raises
        ConfigError.
        """
        check_constraints(self._rig, frames)
        for board in self._boards.values():
            try:
                board.arm(frames)
            except DeviceError:
                # A chip that was disconnected and came back leaves a dead link.
                if self._reopen(board):
                    with suppress(DeviceError):
                        board.arm(frames)

    def _check_distinct(self) -> None:
        """Raise DeviceError if two boards have the same die id, so that two names refer to one board."""
        names_by_die: dict[object, str] = {}
        for name, board in self._boards.items():
            # Zeros (`NO_DIE`), as a chip without an id gives them, do not identify it.
            die = board.facts.die_id or name
            if die != NO_DIE and die in names_by_die:
                raise DeviceError(
                    f"{names_by_die[die]} and {name} have the same die id {die}",
                    "both names in radar.native refer to one board",
                    "correct usb_serial or usb_path of one of them",
                    code=ErrorCode.VALUES_CONFLICT,
                )
            names_by_die[die] = name

    def _open(self, name: str) -> WordLink:
        """Open a board's link, with a trace if the rig file requests one. Raises DeviceError."""
        words = self._open_words(self._rig.radar.native[name].place)
        folder = self._rig.radar.trace_dir
        if not folder:
            return words
        try:
            log = trace_words(words, self._clock, new_trace(Path(folder), name), self._rig, name)
        except OSError:
            # The disk is full, for instance: continue without a trace.
            return words
        self._traces.append(log)
        return log

    def _reopen(self, board: RadarBoard) -> bool:
        """Reopen a failed board's link; return False after the timeout."""
        # Closing fails if the device was unplugged.
        with suppress(OSError):
            board.close()
        deadline = self._clock.now() + _REOPEN_TIMEOUT_S
        while True:
            try:
                board.reconnect(self._open(board.name))
                return True
            except DeviceError as e:
                if self._clock.now() > deadline:
                    board.reconnect(_LostLink(e))
                    return False
            self._clock.sleep(_REOPEN_INTERVAL_S)

    def note_row_start(self) -> None:
        """Note that pulses may come from now on."""
        for board in self._boards.values():
            board.note_pulses()

    def wait_done(self, timeout_s: float) -> list[str]:
        """Wait for the end of all frames; return the boards that missed pulses or failed."""
        deadline = self._clock.now() + timeout_s
        while waiting := [n for n, b in self._boards.items() if b.poll() in (State.ARMED, State.RUNNING)]:
            if self._clock.now() > deadline:
                break
            self._clock.sleep(_POLL_S)
        return [n for n, b in self._boards.items() if n in waiting or b.state is State.FAULT]

    def states(self) -> dict[str, BoardState]:
        """Return the states by name, without boards that were not armed yet; a lost link is a fault."""
        states = {}
        for name, board in self._boards.items():
            state = board.poll()
            if state in _STATES:
                detail = board.reason if state is State.FAULT else state.value
                states[name] = BoardState(_STATES[state], detail)
        return states

    def report(self) -> dict[str, object]:
        """Return each board's report since the last call, for the manifest; the first has the checked constraints."""
        report: dict[str, object] = {"control": "native", "boards": {n: b.report() for n, b in self._boards.items()}}
        if self._constraints:
            report["constraints"] = self._constraints
            report["direct_if_hz"] = {
                b.name: round(direct_if_hz(self._rig, b)) for b in self._rig.boards if b.role != "transmit"
            }
            self._constraints = []
        if self._traces:
            report["traces"] = [{"file": str(t.file), "ended": t.ended} for t in self._traces]
        return report

    def close(self) -> None:
        """Stop waiting boards and close all links."""
        for board in self._boards.values():
            board.close()
        self._boards = {}


# The line that the servers of the published rig expect.
RETRIGGER_LINE = b"Retrigger\n"
# Time between two looks whether a line was acknowledged (chosen).
_POLL_MS = 5
_SERVER_REMEDY = (
    "start the control server of this board (on the computer of mmWave Studio), or correct radar.servers in"
    " instrument.toml (then continue the scan: `polysight resume SCAN --config instrument.toml`)"
)


class LineServers(RadarControl):
    """A connection to each board's control server, kept open between rows, and reopened if its server closed it.

    `servers` has the `address:port` of each board's server; `timeout_s` limits connecting, and the acknowledgement of a
    line. Raises DeviceError if a server cannot be reached.
    """

    def __init__(self, servers: Mapping[str, str], timeout_s: float) -> None:
        self._servers = dict(servers)
        self._timeout_s = timeout_s
        self._sockets: dict[str, socket.socket] = {}
        # Boards whose server broke the connection since the last line.
        self._reset: set[str] = set()
        try:
            for board in self._servers:
                self._connect(board)
        except DeviceError:
            self.close()
            raise

    def arm(self, frames: int) -> None:
        """Send the line to every server and wait for the acknowledgement of its machine. Raises DeviceError.

        The number of frames is set in the server's own configuration. `states` reports connections that were reset.
        """
        del frames
        self._reset.clear()
        for board in self._servers:
            if self._is_closed(board):
                self._connect(board)
            self._reset.discard(board)
            try:
                self._sockets[board].sendall(RETRIGGER_LINE)
            except BlockingIOError:
                raise DeviceError(
                    f"{board}: its control server at {self._servers[board]} does not read its lines",
                    "the program there hangs: the lines of many rows fill its connection",
                    "restart it, then `polysight resume SCAN`",
                    code=ErrorCode.NO_ANSWER,
                ) from None
            except ConnectionError:
                self._reset.add(board)
        deadline = time.monotonic() + self._timeout_s
        for board in self._servers:
            self._wait_until_acknowledged(board, deadline)

    def states(self) -> dict[str, BoardState]:
        """Return `FAULT` for boards whose server reset the connection, otherwise `UNKNOWN` with its address."""
        states = {}
        for board, address in self._servers.items():
            self._is_closed(board)
            if board in self._reset:
                states[board] = BoardState(RadarState.FAULT, f"its control server at {address} reset the connection")
            else:
                states[board] = BoardState(RadarState.UNKNOWN, f"re-armed through {address}, which never replies")
        return states

    def close(self) -> None:
        """Close the connections."""
        for connection in self._sockets.values():
            connection.close()
        self._sockets.clear()

    def _connect(self, board: str) -> None:
        """Connect to a board's server, in place of an earlier connection. Raises DeviceError."""
        old = self._sockets.pop(board, None)
        if old is not None:
            old.close()
        address, _, port = self._servers[board].rpartition(":")
        try:
            connection = socket.create_connection((address, int(port)), self._timeout_s)
        except OSError as e:
            raise self._unreachable_error(board, e) from None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setblocking(False)
        self._sockets[board] = connection

    def _is_closed(self, board: str) -> bool:
        """Return True if the server closed or reset the connection; data that it sent is discarded."""
        try:
            while self._sockets[board].recv(4096):
                pass
        except BlockingIOError:
            return False
        except OSError:
            self._reset.add(board)
        return True

    def _wait_until_acknowledged(self, board: str, deadline: float) -> None:
        """Wait until the other machine acknowledged the line, or the connection ended.

        Raises DeviceError at the deadline (monotonic clock).
        """
        connection = self._sockets[board]
        ended = select.poll()
        # With no events requested, poll reports a reset, or the end of both directions.
        ended.register(connection, 0)
        while _count_unacknowledged(connection):
            if ended.poll(_POLL_MS):
                return
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"{board}: its control server at {self._servers[board]} did not acknowledge the line within"
                    f" {self._timeout_s:g} s",
                    "the connection is half-open: that machine was switched off, or the network is cut",
                    "check that machine and the cable, then `polysight resume SCAN`",
                    code=ErrorCode.NO_ANSWER,
                )

    def _unreachable_error(self, board: str, e: OSError) -> DeviceError:
        """Return the error for a server that cannot be reached, with the likely cause."""
        if isinstance(e, ConnectionRefusedError):
            reason = ": connection refused"
            cause = "that machine is running, but no server listens"
        elif isinstance(e, TimeoutError):
            reason = f" within {self._timeout_s:g} s"
            cause = "that machine is off, or a firewall drops the connection"
        else:
            reason = f": {e.strerror or e}"
            cause = "the address is wrong, or there is no route to it"
        message = f"{board}: cannot reach its control server at {self._servers[board]}{reason}"
        return DeviceError(message, cause, _SERVER_REMEDY, code=ErrorCode.NO_ANSWER)


def _count_unacknowledged(connection: socket.socket) -> int:
    """Return the sent bytes that the other kernel has not acknowledged (SIOCOUTQ, tcp(7))."""
    # These modules exist on POSIX systems only; this file is imported on others, too.
    import fcntl
    import termios

    return struct.unpack("=i", fcntl.ioctl(connection, termios.TIOCOUTQ, b"\0\0\0\0"))[0]


class Endless(RadarControl):
    """Radars that another program started with an infinite number of frames; nothing is done for a row."""

    def arm(self, frames: int) -> None:
        """Do nothing."""

    def states(self) -> dict[str, BoardState]:
        """Return no states; they are not known."""
        return {}


def open_radar_control(instrument: Instrument) -> RadarControl:
    """Connect to the radars of a rig with the backend of its file. Raises ConfigError, DeviceError."""
    if instrument.radar.control == "line_server":
        return LineServers(instrument.radar.servers, instrument.limits.command_timeout_s)
    if instrument.radar.control == "native":
        return NativeRadars(instrument)
    return Endless()
