"""`polysight radar`: bring-up of one board. Not run on hardware yet."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from polysight.jobs.output import print_json
from polysight.radar import (
    Clock,
    Image,
    RadarBoard,
    ReplayedWords,
    Row,
    SystemClock,
    WordLink,
    check_board,
    firmware_of,
    open_board,
    plan_lines,
    radar_board,
    read_image,
    require,
    traced,
)
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError

_WORDS = {True: "ok", False: "FAILED"}


def plan_radars(config: Path) -> int:
    """Print all constraints and each board's settings as bytes, without a board; return 1 if one is violated.

    Raises ConfigError.
    """
    lines, holds = plan_lines(_native(config))
    sys.stdout.write("\n".join(lines) + "\n")
    return 0 if holds else 1


def check_radar(config: Path, name: str, trace: Path | None, slow: bool, as_json: bool) -> int:
    """Check one board from USB to one frame, step by step; return 0 if all pass. Raises ConfigError, OSError."""
    rig = _checked(config, name)
    _fresh(trace)
    clock = SystemClock()
    return _check(rig, name, clock, lambda: _open(rig, name, clock, trace, slow), as_json)


def replay_radar(config: Path, trace: Path, as_json: bool) -> int:
    """Run the same check against a trace; return 0 if all steps pass. Raises ConfigError, OSError."""
    words = ReplayedWords(trace)
    name = str(words.facts.get("board", ""))
    if not as_json:
        sys.stdout.write(f"replayed from {trace}, not a board\n")
    return _check(_checked(config, name), name, words, lambda: words, as_json)


def load_firmware(config: Path, name: str, image: Path, flash: bool, trace: Path | None, slow: bool) -> int:
    """Load firmware into a board's RAM, or write its flash, start it, and verify.

    Raises ConfigError, DeviceError, OSError.
    """
    rig = _checked(config, name)
    checked, clock = read_image(image), SystemClock()
    sys.stdout.write(f"{image.name}: whole, for an AWR2243, patches {' and '.join(checked.patches)}\n")
    _fresh(trace)
    words = _open(rig, name, clock, trace, slow)
    board = radar_board(rig, name, words, clock, None if flash else checked)
    try:
        if flash:
            sys.stdout.write(f"{name}: {_write_flash(board, image, checked)}\n")
        else:
            board.configure()
            sys.stdout.write(
                f"{name}: runs {board.facts['main_firmware']} from RAM, until its next reset; its flash was not"
                f' written. Set radar.firmware = "{image}" to have it at each start, or use --flash\n'
            )
    finally:
        board.close()
    return 0


def _check(rig: Instrument, name: str, clock: Clock, open_words: Callable[[], WordLink], as_json: bool) -> int:
    rows: list[Row] = []

    def tell(row: Row) -> None:
        rows.append(row)
        if not as_json:
            sys.stdout.write(_text(name, row))
            sys.stdout.flush()

    firmware = firmware_of(rig)
    transmits = rig.transmitter.name == name
    board = check_board(open_words, lambda w: radar_board(rig, name, w, clock, firmware), transmits, tell)
    report = board.report() if board else {}
    if board:
        board.close()
    if as_json:
        steps = [row._asdict() for row in rows]
        print_json({"board": name, "steps": steps, "report": report})
    else:
        for line in report.get("warnings", []):
            sys.stdout.write(f"      note: {line}\n")
    return 0 if all(row.holds for row in rows) else 1


def _text(name: str, row: Row) -> str:
    lines = [f"{name}  {row.step:12} {_WORDS[row.holds]:6}  {row.came}"]
    if not row.holds:
        lines += [f"      expected: {row.expected}", f"      do: {row.do}"]
    return "\n".join(lines) + "\n"


def _write_flash(board: RadarBoard, file: Path, image: Image) -> str:
    """Write the flash; report the progress if stopped. Raises DeviceError, ConfigError."""
    done = [0, 0]

    def progress(sent: int, of: int) -> None:
        done[:] = sent, of
        _progress(sent, of)

    try:
        return board.write_flash(image, progress)
    except KeyboardInterrupt:
        sent, of = done
        again = f"`polysight radar firmware {board.name} {file} --flash`"
        if of and sent < of:
            note = f"stopped after {sent} of {of} parts: its flash holds no whole image now; again: {again}"
            sys.stderr.write(f"\n{board.name}: {note}\n")
        elif of:
            sys.stderr.write(f"\n{board.name}: stopped: its flash was written, not verified; again: {again}\n")
        raise


def _fresh(trace: Path | None) -> None:
    if trace is not None and trace.is_file():
        raise ConfigError(
            f"{trace}: is there already", "a trace of before, which is never written over", "another name"
        )


def _progress(sent: int, of: int) -> None:
    sys.stderr.write(f"\r{sent} of {of} parts written" + ("\n" if sent == of else ""))


def _open(rig: Instrument, name: str, clock: SystemClock, trace: Path | None, slow: bool) -> WordLink:
    words = open_board(rig.radar.native[name].place, slow or rig.radar.slow_spi)
    return words if trace is None else traced(words, clock, trace, rig, name)


def _native(config: Path) -> Instrument:
    rig = load_instrument(config)
    if not rig.radar.native:
        raise ConfigError(
            f"{config}: no boards under [radar] native",
            f'control is "{rig.radar.control}": something else configures these radars',
            'control = "native", native = { NAME = { usb_serial = "..." } }; see docs/how-to/radar-bring-up.md',
        )
    return rig


def _checked(config: Path, name: str) -> Instrument:
    rig = _native(config)
    if name not in rig.radar.native:
        raise ConfigError(f"radar.native has no board {name!r}", "a typing error", f"one of {sorted(rig.radar.native)}")
    require(rig, rig.grid.columns * rig.burst.pulses)
    return rig
