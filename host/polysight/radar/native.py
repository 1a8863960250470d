"""The backend `native`: this host configures and arms the radars over USB.

After a fault a board is reset and configured again when the next row, or the retake of a row, is armed; a lost link is
reopened. Not run on hardware yet.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from polysight.radar.board import RadarBoard, State
from polysight.radar.calibration_data import NO_DIE, CalibrationFiles
from polysight.radar.constraints import constraints, direct_if_hz, require
from polysight.radar.firmware import Image, read_image
from polysight.radar.interface import BoardState, RadarControl, RadarState
from polysight.radar.messages import command, encode
from polysight.radar.program import program
from polysight.radar.spi import Clock, SystemClock, WordLink
from polysight.radar.trace import TracedWords, new_trace, traced
from polysight.radar.usb import SCHEME, open_tcp, open_usb
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError

_POLL_S = 0.005
_REOPEN_TIMEOUT_S = 5.0  # USB needs some time to find a chip again
_REOPEN_INTERVAL_S = 0.25
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
    return open_tcp(place, slow) if place.startswith(SCHEME) else open_usb(place, slow)


def radar_board(rig: Instrument, name: str, words: WordLink, clock: Clock, firmware: Image | None) -> RadarBoard:
    """Create a board of a rig with its word link and firmware."""
    native = rig.radar.native[name]
    commands = program(rig, rig.by_name(name))
    settings = b"".join(one.block().data for one in (*commands.basic, *commands.waveform))
    folder = rig.radar.calibration_dir
    calibration = CalibrationFiles(Path(folder), settings) if folder else None
    return RadarBoard(name, words, clock, commands, firmware, native.die_id, calibration)


def plan_lines(rig: Instrument) -> tuple[list[str], bool]:
    """Return lines with each constraint and, if all hold, each board's commands in hexadecimal; and whether all hold.

    Power-up, RF init, queries and the start of frames are not among the commands.
    """
    frames = rig.grid.columns * rig.burst.pulses
    found = constraints(rig, frames)
    lines = [
        f"{'holds ' if c.holds else 'BROKEN'}  {c}" + ("" if c.holds else f"\n        do: {c.remedy}") for c in found
    ]
    if not all(c.holds for c in found):
        return [*lines, "\nnothing would be sent"], False
    for board in rig.boards:
        lines.append(f"\n{board.name}, its settings, with sequence numbers as if only they were sent:")
        commands = program(rig, board)
        for number, sent in enumerate((*commands.basic, *commands.waveform, *commands.frames(frames))):
            raw = encode(command((sent.block(),), sequence=number % 16))
            lines.append(f"  {sent.name:19} {raw.hex()}")
    lines.append("\nnot shown: power-up, RF init, frame start, and queries (versions, die id, temperatures)")
    return lines, True


def firmware_of(rig: Instrument) -> Image | None:
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
    """All boards of a rig, identified by the serial number of their USB chips.

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
        self._rig, self._clock = rig, clock or SystemClock()
        self._open_words = open_words or partial(open_board, slow=rig.radar.slow_spi)
        frames = rig.grid.columns * rig.burst.pulses
        require(rig, frames)
        self._constraints = [str(c) for c in constraints(rig, frames)]
        self._boards: dict[str, RadarBoard] = {}
        self._traces: list[TracedWords] = []
        if rig.radar.trace_dir:
            _make_folder(Path(rig.radar.trace_dir))
        firmware = firmware_of(rig)
        with ExitStack() as opened:
            opened.callback(self.close)
            for board in rig.boards:
                words = self._open(board.name)
                self._boards[board.name] = radar_board(rig, board.name, words, self._clock, firmware)
            for board in self._boards.values():
                board.configure()
            self._check_distinct()
            opened.pop_all()

    def arm(self, frames: int) -> None:
        """Start `frames` frames on every board and wait until each waits for triggers or has failed.

        `states` reports a failed board, which costs a take, not the scan. Raises ConfigError.
        """
        require(self._rig, frames)
        for board in self._boards.values():
            try:
                board.arm(frames)
            except DeviceError:  # a chip that was disconnected and came back leaves a dead link
                if self._reopen(board):
                    with suppress(DeviceError):
                        board.arm(frames)

    def _check_distinct(self) -> None:
        """Raise DeviceError if two boards have the same die id, so that two names refer to one board."""
        found: dict[object, str] = {}
        for name, board in self._boards.items():
            die = board.facts.get("die_id", name)
            if die != NO_DIE and die in found:
                raise DeviceError(
                    f"{found[die]} and {name} have the same die id {die}",
                    "both names in radar.native refer to one board",
                    "correct usb_serial or usb_path of one of them",
                    code=ErrorCode.VALUES_CONFLICT,
                )
            found[die] = name

    def _open(self, name: str) -> WordLink:
        words, folder = self._open_words(self._rig.radar.native[name].place), self._rig.radar.trace_dir
        if not folder:
            return words
        try:
            found = traced(words, self._clock, new_trace(Path(folder), name), self._rig, name)
        except OSError:  # such as a full disk: continue without a trace
            return words
        self._traces.append(found)
        return found

    def _reopen(self, board: RadarBoard) -> bool:
        """Reopen a failed board's link; return False after the timeout."""
        with suppress(OSError):  # the device is gone
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

    def row_begins(self) -> None:
        """Note that pulses may come from now on."""
        for board in self._boards.values():
            board.pulses_begin()

    def wait_done(self, timeout_s: float) -> list[str]:
        """Wait for the end of all frames; return the boards that missed pulses or failed."""
        deadline = self._clock.now() + timeout_s
        while waiting := [n for n, b in self._boards.items() if b.poll() in (State.ARMED, State.RUNNING)]:
            if self._clock.now() > deadline:
                break
            self._clock.sleep(_POLL_S)
        return [n for n, b in self._boards.items() if n in waiting or b.state is State.FAULT]

    def states(self) -> dict[str, BoardState]:
        """Return the states by name, without boards that are not armed; a lost link is a fault."""
        found = {}
        for name, board in self._boards.items():
            state = board.poll()
            if state in _STATES:
                detail = board.reason if state is State.FAULT else state.value
                found[name] = BoardState(_STATES[state], detail)
        return found

    def report(self) -> dict[str, object]:
        """Return checked constraints, and the report of each board since the last call, for the manifest."""
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
