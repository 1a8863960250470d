"""Radars that this host configures and arms itself, over USB: the backend `native`.

A board that failed is reset and configured anew when the next row, or the same one again, is armed; where its link is
gone, that is opened anew. Not run on hardware yet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

from polysight.host.radar.board import RadarBoard, State
from polysight.host.radar.calibration_data import NO_DIE, CalibrationFiles
from polysight.host.radar.constraints import constraints, direct_if_hz, require
from polysight.host.radar.firmware import Image, read_image
from polysight.host.radar.interface import BoardState, RadarControl, RadarState
from polysight.host.radar.messages import command, encode
from polysight.host.radar.program import program
from polysight.host.radar.spi import Clock, SystemClock, WordLink
from polysight.host.radar.trace import TracedWords, new_trace, traced
from polysight.host.radar.usb import SCHEME, open_tcp, open_usb
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError, DeviceError

_LOOK_S = 0.005
_REOPEN_S = 5.0  # USB takes a moment to find a chip again
_REOPEN_EVERY_S = 0.25
_TOLD = {
    State.ARMED: RadarState.ARMED,
    State.RUNNING: RadarState.ARMED,
    State.DONE: RadarState.DONE,
    State.FAULT: RadarState.FAULT,
}


def open_board(place: str, slow: bool = False) -> WordLink:
    """A board's word link by its USB serial number, `usb:PATH`, or `tcp://address:port`.

    `slow` sends words one by one at 1 MHz. Raises ConfigError, DeviceError.
    """
    return open_tcp(place, slow) if place.startswith(SCHEME) else open_usb(place, slow)


def radar_board(rig: Instrument, name: str, words: WordLink, clock: Clock, firmware: Image | None) -> RadarBoard:
    """One board of a rig behind a word link, with the firmware that the rig file asks for."""
    native = rig.radar.native[name]
    made = program(rig, rig.by_name(name))
    settings = b"".join(one.block().data for one in (*made.basic, *made.waveform))
    folder = rig.radar.calibration_dir
    calibration = CalibrationFiles(Path(folder), settings) if folder else None
    return RadarBoard(name, words, clock, made, firmware, native.die_id, calibration)


def plan_lines(rig: Instrument) -> tuple[list[str], bool]:
    """Each constraint with its value, and, where all hold, the settings of each board as hexadecimal; whether they do.

    Beside the settings a board is sent power-up and RF init, questions and the start of its frames.
    """
    frames = rig.grid.columns * rig.burst.pulses
    found = constraints(rig, frames)
    lines = [
        f"{'holds ' if c.holds else 'BROKEN'}  {c}" + ("" if c.holds else f"\n        do: {c.remedy}") for c in found
    ]
    if not all(c.holds for c in found):
        return [*lines, "\nnothing would be sent"], False
    for board in rig.boards:
        lines.append(f"\n{board.name}, its settings, numbered as if they alone were sent:")
        made = program(rig, board)
        for number, sent in enumerate((*made.basic, *made.waveform, *made.frames(frames))):
            raw = encode(command((sent.block(),), sequence=number % 16))
            lines.append(f"  {type(sent).__name__:19} {raw.hex()}")
    lines.append("\nnot shown: power-up, RF init, frame start, and questions (versions, die id, temperatures)")
    return lines, True


def firmware_of(rig: Instrument) -> Image | None:
    """The image that a rig file wants in its boards' RAM, checked. Raises ConfigError."""
    if not rig.radar.firmware:
        return None
    try:
        return read_image(Path(rig.radar.firmware))
    except OSError as e:
        raise ConfigError(
            f"radar.firmware: {rig.radar.firmware} cannot be read: {e.strerror}", "a typing error", "correct the path"
        ) from None


class _NoLink:
    """In place of a link that did not come back: whatever is asked of it fails as opening it did."""

    def __init__(self, error: DeviceError) -> None:
        self._error = error

    def write(self, words: Sequence[int]) -> None:
        del words
        raise self._again()

    def read(self, count: int) -> list[int]:
        del count
        raise self._again()

    def interrupt(self) -> bool:
        raise self._again()

    def reset(self, held: bool) -> None:
        del held
        raise self._again()

    def close(self) -> None:
        """Nothing is open."""

    def _again(self) -> DeviceError:
        return DeviceError(self._error.what, self._error.why, self._error.remedy)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ConfigError(
            f"radar.trace_dir: {folder} cannot be made: {e.strerror}", "a typing error, or no right", "correct the path"
        ) from None


class NativeRadars(RadarControl):
    """Every board of a rig, each by the serial number of its USB chip.

    Parameters
    ----------
    rig
        With `radar.native` for each board. What it asks of the radars is looked at before anything is written.
    open_words
        Opens a board's word link by its place: `open_board`, fast or slow as the rig file says, when None.
    clock
        Time.

    Raises
    ------
    ConfigError
        when a constraint is broken (:mod:`polysight.host.radar.constraints`), or the USB library is missing.
    DeviceError
        when a board cannot be opened or configured.
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
            self._tell_apart()
            opened.pop_all()

    def arm(self, frames: int) -> None:
        """Start `frames` frames on every board; each has said that it waits for triggers when this returns, or failed.

        One that failed says so in `states`: that costs a take, not the scan. Raises ConfigError.
        """
        require(self._rig, frames)
        for board in self._boards.values():
            try:
                board.arm(frames)
            except DeviceError:  # a chip that went and came back has left a dead link behind
                if self._reopen(board):
                    with suppress(DeviceError):
                        board.arm(frames)

    def _tell_apart(self) -> None:
        """Raises DeviceError when two boards have one die id: they are one board, named twice."""
        found: dict[object, str] = {}
        for name, board in self._boards.items():
            die = board.facts.get("die_id", name)
            if die != NO_DIE and die in found:
                raise DeviceError(
                    f"{found[die]} and {name} have the same die id {die}",
                    "both names of radar.native lead to one board",
                    "correct usb_serial or usb_path of one of them",
                )
            found[die] = name

    def _open(self, name: str) -> WordLink:
        words, folder = self._open_words(self._rig.radar.native[name].place), self._rig.radar.trace_dir
        if not folder:
            return words
        try:
            found = traced(words, self._clock, new_trace(Path(folder), name), self._rig, name)
        except OSError:  # a disk that is full: the board is worth more than its trace
            return words
        self._traces.append(found)
        return found

    def _reopen(self, board: RadarBoard) -> bool:
        """Open a failed board's link anew; False when it does not come back."""
        with suppress(OSError):  # of a device that is not there any more
            board.close()
        deadline = self._clock.now() + _REOPEN_S
        while True:
            try:
                board.reconnect(self._open(board.name))
                return True
            except DeviceError as e:
                if self._clock.now() > deadline:
                    board.reconnect(_NoLink(e))
                    return False
            self._clock.sleep(_REOPEN_EVERY_S)

    def row_begins(self) -> None:
        """Pulses may come from now on."""
        for board in self._boards.values():
            board.pulses_begin()

    def wait_done(self, limit_s: float) -> list[str]:
        """Boards that do not say within the limit that all their frames ended: they missed pulses, or failed."""
        deadline = self._clock.now() + limit_s
        while waiting := [n for n, b in self._boards.items() if b.poll() in (State.ARMED, State.RUNNING)]:
            if self._clock.now() > deadline:
                break
            self._clock.sleep(_LOOK_S)
        return [n for n, b in self._boards.items() if n in waiting or b.state is State.FAULT]

    def states(self) -> dict[str, BoardState]:
        """What each board has said, by name; a link that is gone is a fault. Boards not armed are left out."""
        found = {}
        for name, board in self._boards.items():
            state = board.poll()
            if state in _TOLD:
                detail = board.reason if state is State.FAULT else state.value
                found[name] = BoardState(_TOLD[state], detail)
        return found

    def report(self) -> dict[str, object]:
        """For the manifest: what was checked, what each board said of itself, and every byte sent since then."""
        told: dict[str, object] = {"control": "native", "boards": {n: b.report() for n, b in self._boards.items()}}
        if self._constraints:
            told["constraints"] = self._constraints
            told["direct_if_hz"] = {
                b.name: round(direct_if_hz(self._rig, b)) for b in self._rig.boards if b.role != "transmit"
            }
            self._constraints = []
        if self._traces:
            told["traces"] = [{"file": str(t.file), "ended": t.ended} for t in self._traces]
        return told

    def close(self) -> None:
        """Stop what waits, and let go of every board."""
        for board in self._boards.values():
            board.close()
        self._boards = {}
