"""`polysight card`, `polysight radar`, `polysight jog`: capture cards, radar boards and the stage, one at a time.

`card` checks the network path to the cards hop by hop (network interface, sockets, the card's replies, its data),
writes a card's addresses, or resets it; `radar` checks a board from USB to one frame, loads its firmware, or replays a
trace, the record of all words exchanged with a board; `jog` moves the stage. Not run on hardware yet.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import zmq

from polysight.acquisition import PiClient
from polysight.capture import CardClient, CardSurvey, EepromSettings, program_eeprom, survey_cards
from polysight.jobs.output import confirm, exit_status, print_json
from polysight.radar import (
    Clock,
    Image,
    RadarBoard,
    ReplayedWords,
    StepResult,
    SystemClock,
    WordLink,
    check_board,
    check_constraints,
    make_radar_board,
    open_board,
    plan_lines,
    read_firmware,
    read_image,
    trace_words,
)
from polysight_shared.config import Board, Instrument, load_instrument
from polysight_shared.errors import ConfigError, DeviceError
from polysight_shared.findings import Finding
from polysight_shared.messages import Axis

# Timeout of a request, with all its attempts, to a card that was switched off and on and may still be starting; chosen.
_REPLY_TIMEOUT_S = 1.5
# Time between two requests to a card that may still be starting; chosen.
_PAUSE_S = 0.2


def show_cards(config: Path, listen_s: float, as_json: bool) -> int:
    """Check every hop to every card; return 0 if all recorded cards can be used. Raises ConfigError.

    `listen_s` is the longest wait for data of the cards; 0: only their replies are checked.
    """
    rig = load_instrument(config)
    if listen_s:
        sys.stderr.write(f"listening for at most {listen_s:g} s: trigger the radars now\n")
    surveys = survey_cards(rig, listen_s)
    if as_json:
        print_json([_describe_survey(s) for s in surveys])
    else:
        sys.stdout.write("\n".join(_format_survey(s) for s in surveys))
    return exit_status(all(s.ok for s in surveys if s.board.record))


def _describe_survey(survey: CardSurvey) -> dict[str, object]:
    """Return the check of one card and its hops as plain data."""
    board = survey.board
    keys = ("name", "role", "record", "card_address", "host_address", "command_port", "data_port")
    return {
        **{key: getattr(board, key) for key in keys},
        "ok": survey.ok,
        "silent_hop": survey.failed_hop,
        "fpga_version": survey.version,
        "hops": [_describe_hop(hop) for hop in survey.hops],
    }


def _describe_hop(finding: Finding) -> dict[str, str]:
    """Return one network hop as plain data; a hop of level `note` was not checked."""
    verdict = finding.level
    if verdict == "note":
        verdict = "not checked"
    return {
        "hop": finding.where,
        "verdict": verdict,
        "found": finding.what,
        "why": finding.why,
        "remedy": finding.do,
    }


def _format_survey(survey: CardSurvey) -> str:
    """Return the check of one card and its hops as text; hops that were not checked share one line."""
    board = survey.board
    if board.record:
        role = board.role
    else:
        role = f"{board.role}, not recorded: only queried"
    unchecked = [hop.where for hop in survey.hops if hop.level == "note" and not hop.what]
    text = f"{board.name} ({role}): card {board.card_address}:{board.command_port},"
    text += f" data to {board.host_address}:{board.data_port}\n"
    text += "".join(_format_hop(hop) for hop in survey.hops if hop.where not in unchecked)
    if unchecked:
        text += f"  not checked {', '.join(unchecked)}\n"
    return text


def _format_hop(finding: Finding) -> str:
    """Return one network hop as a line, with a line each for cause and remedy, if given."""
    hop = _describe_hop(finding)
    line = f"  {hop['verdict']:12}{finding.where:10}{finding.what}".rstrip() + "\n"
    for word, text in (("why", finding.why), ("do", finding.do)):
        if text:
            line += f"{'':24}{word}: {text}\n"
    return line


def _find_board(rig: Instrument, name: str, config: Path) -> Board:
    """Return the board of this name. Raises ConfigError if the rig file has none."""
    try:
        return rig.by_name(name)
    except KeyError:
        raise ConfigError(
            f"{config} has no board {name!r}",
            "a typing error, or another rig file",
            f"give one of {', '.join(b.name for b in rig.boards)}",
        ) from None


def _set_address(board: Board, present_address: str) -> Board:
    """Return the board with its card's present address, `ADDRESS` or `ADDRESS:PORT`. Raises ConfigError."""
    address, _, port = present_address.partition(":")
    if port.isdigit():
        number = int(port)
    else:
        number = board.command_port
    if (port and not port.isdigit()) or not 1 <= number <= 65535:
        raise ConfigError(
            f"--at {present_address!r} is not of the form ADDRESS:PORT",
            "a typing error",
            "e.g. --at 192.168.33.180:4096",
        )
    return msgspec.structs.replace(board, card_address=address or board.card_address, command_port=number)


def program_card(config: Path, name: str, mac: str, at: str, yes: bool, wait_s: float) -> int:
    """Write a board's addresses into its card after confirmation, and check that it answers there.

    `mac` is the card's MAC address, `at` its present `ADDRESS` or `ADDRESS:PORT` (empty: those of the rig file); `yes`
    leaves the confirmation out. With a `wait_s` of 0 the check is left out.

    Raises
    ------
    ConfigError
        for a wrong board, MAC address or confirmation: nothing was written.
    DeviceError
        when the card is silent or refuses, or was not seen at its new address within `wait_s`.
    """
    rig = load_instrument(config)
    board = _find_board(rig, name, config)
    settings = EepromSettings.of_board(board, mac)
    twins = [b.name for b in rig.boards if b.name != name and b.card_address == board.card_address]
    if twins:
        raise ConfigError(
            f"{config} gives {board.card_address} to {', '.join(twins)} too",
            "two cards share one address",
            "give each its own card_address",
        )
    present = _set_address(board, at)
    with CardClient(present, rig.limits.command_timeout_s) as card:
        message = (
            f"{name}: a card, FPGA {card.read_version()}, answers at {present.card_address}:{present.command_port}; its"
            f" EEPROM is written again, and cannot be read back.\n{name}: {settings.text()}"
        )
        typed_answer = confirm(message, settings.confirmation, yes)
        # Writes only if the answer is `settings.confirmation`; raises ConfigError otherwise.
        program_eeprom(card, settings, typed_answer)
    sys.stdout.write(f"{name}: written, and the card reports no failure. Now switch the card off and on.\n")
    sys.stdout.flush()
    if wait_s > 0:
        version = _wait_for_card(board, wait_s, same_place=present == board)
        sys.stdout.write(f"{name}: it answers at {board.card_address}:{board.command_port}, FPGA {version}.\n")
        sys.stdout.write("Whether it sends data to the right port is seen with `polysight card --listen 10`.\n")
    else:
        sys.stdout.write("Then `polysight card` shows whether it answers at its new address.\n")
    return 0


def _wait_for_card(board: Board, wait_s: float, same_place: bool) -> str:
    """Return the FPGA version that the card reports at its new address, once it was switched off and on.

    With `same_place` the address is the old one, too: only an answer after a silence shows that it was switched off.
    Raises DeviceError after `wait_s`.
    """
    sys.stdout.write(f"{board.name}: looking for it at {board.card_address} for at most {wait_s:g} s\n")
    sys.stdout.flush()
    deadline = time.monotonic() + wait_s
    was_off = not same_place
    while time.monotonic() < deadline:
        try:
            with CardClient(board, _REPLY_TIMEOUT_S) as card:
                version = str(card.read_version())
        except DeviceError:
            was_off = True
        else:
            if was_off:
                return version
        # While the host's network interface is down each request fails immediately, and without a pause the loop would
        # take a whole core.
        time.sleep(_PAUSE_S)
    missing = "the card was not switched off"
    if was_off:
        missing = f"not seen at {board.card_address}:{board.command_port}"
    raise DeviceError(
        f"{board.name}: written, but {missing} within {wait_s:g} s",
        "a card takes its addresses when it is switched on; with its EEPROM switch off it keeps its defaults",
        "switch it off and on, then `polysight card`; if it still does not answer, its EEPROM switch restores the "
        "defaults",
    )


def reset_card(config: Path, name: str, radar: bool) -> int:
    """Reset a card's FPGA, or with `radar` the radar board on it. Raises ConfigError or DeviceError."""
    rig = load_instrument(config)
    with CardClient(_find_board(rig, name, config), rig.limits.command_timeout_s) as card:
        if radar:
            card.reset_radar()
            sys.stdout.write(f"{name}: the radar is reset; it must be armed again\n")
        else:
            card.reset_fpga()
            sys.stdout.write(f"{name}: the card is reset; a scan configures it again\n")
        sys.stdout.write(f"{name}: the card answers, FPGA {card.read_version()}\n")
    return 0


# Words in the output for a step of a board's check that was passed (True) and for a failed one.
_RESULT_WORDS = {True: "ok", False: "FAILED"}


def plan_radars(config: Path) -> int:
    """Print all constraints and each board's settings as bytes, without a board; return 1 if one is violated.

    Raises ConfigError.
    """
    lines, all_hold = plan_lines(_load_rig(config))
    sys.stdout.write("\n".join(lines) + "\n")
    return exit_status(all_hold)


def check_radar(config: Path, name: str, trace: Path | None, slow: bool, as_json: bool) -> int:
    """Check one board from USB to one frame, step by step; return 0 if all pass. Raises ConfigError, OSError.

    `trace` is a new file for the words exchanged (None: not kept); `slow` uses the slow SPI clock.
    """
    rig = _load_rig_of_board(config, name)
    _check_trace(trace)
    clock = SystemClock()
    return _run_check(rig, name, clock, lambda: _open_link(rig, name, clock, trace, slow), as_json)


def replay_radar(config: Path, trace: Path, as_json: bool) -> int:
    """Run the same check against a trace; return 0 if all steps pass. Raises ConfigError, OSError."""
    # The trace replaces both the clock and the link to the board.
    replay = ReplayedWords(trace)
    name = str(replay.facts.get("board", ""))
    if not as_json:
        sys.stdout.write(f"replayed from {trace}, not a board\n")
    rig = _load_rig_of_board(config, name)
    return _run_check(rig, name, replay, lambda: replay, as_json)


def load_firmware(config: Path, name: str, image: Path, flash: bool, trace: Path | None, slow: bool) -> int:
    """Load firmware into a board's RAM and start it, or with `flash` write and verify its flash; return 0.

    `trace` and `slow` as for :func:`check_radar`. Raises ConfigError, DeviceError, OSError.
    """
    rig = _load_rig_of_board(config, name)
    checked_image = read_image(image)
    clock = SystemClock()
    sys.stdout.write(f"{image.name}: complete, for an AWR2243, patches {' and '.join(checked_image.patches)}\n")
    _check_trace(trace)
    link = _open_link(rig, name, clock, trace, slow)
    # A board writes its flash after it was started without this image.
    image_for_ram = None if flash else checked_image
    board = make_radar_board(rig, name, link, clock, image_for_ram)
    try:
        if flash:
            sys.stdout.write(f"{name}: {_write_flash(board, image, checked_image)}\n")
        else:
            board.configure()
            sys.stdout.write(
                f"{name}: runs {board.facts.main_firmware} from RAM, until its next reset; its flash was not"
                f' written. Set radar.firmware = "{image}" to have it at each start, or use --flash\n'
            )
    finally:
        board.close()
    return 0


def _run_check(rig: Instrument, name: str, clock: Clock, open_link: Callable[[], WordLink], as_json: bool) -> int:
    """Check a board on the link that `open_link` opens; print each step as it ends, or all of them as JSON."""
    rows: list[StepResult] = []

    def print_result(row: StepResult) -> None:
        rows.append(row)
        if not as_json:
            sys.stdout.write(_format_step(name, row))
            sys.stdout.flush()

    firmware = read_firmware(rig)
    transmits = rig.transmitter.name == name

    def make_board(link: WordLink) -> RadarBoard:
        return make_radar_board(rig, name, link, clock, firmware)

    board = check_board(open_link, make_board, transmits, print_result)
    report = {}
    if board:
        report = board.report()
        board.close()
    if as_json:
        steps = [
            {
                "step": row.step,
                "holds": row.passed,
                "expected": row.expected,
                "came": row.outcome,
                "do": row.remedy,
            }
            for row in rows
        ]
        print_json({"board": name, "steps": steps, "report": report})
    else:
        for line in report.get("warnings", []):
            sys.stdout.write(f"      note: {line}\n")
    return exit_status(all(row.passed for row in rows))


def _format_step(name: str, row: StepResult) -> str:
    """Return a step of a board's check as a line; a failed one with the expected outcome and the remedy."""
    lines = [f"{name}  {row.step:12} {_RESULT_WORDS[row.passed]:6}  {row.outcome}"]
    if not row.passed:
        lines += [f"      expected: {row.expected}", f"      do: {row.remedy}"]
    return "\n".join(lines) + "\n"


def _write_flash(board: RadarBoard, file: Path, image: Image) -> str:
    """Write the flash and show the progress; if stopped by Ctrl-C, print the content of the flash.

    Raises DeviceError, ConfigError.
    """
    parts_sent = 0
    parts = 0

    def show_progress(sent: int, total: int) -> None:
        nonlocal parts_sent, parts
        parts_sent = sent
        parts = total
        sys.stderr.write(f"\r{sent} of {total} parts written")
        if sent == total:
            sys.stderr.write("\n")

    try:
        return board.write_flash(image, show_progress)
    except KeyboardInterrupt:
        command = f"`polysight radar firmware {board.name} {file} --flash`"
        if parts_sent < parts:
            problem = f"stopped after {parts_sent} of {parts} parts"
            note = f"{problem}: its flash now contains no complete image; repeat: {command}"
            sys.stderr.write(f"\n{board.name}: {note}\n")
        elif parts:
            sys.stderr.write(f"\n{board.name}: stopped: its flash was written, but not verified; repeat: {command}\n")
        raise


def _check_trace(trace: Path | None) -> None:
    """Raise ConfigError if the file of a new trace exists already."""
    if trace is not None and trace.is_file():
        raise ConfigError(f"{trace} exists already", "traces are never overwritten", "give another name")


def _open_link(rig: Instrument, name: str, clock: SystemClock, trace: Path | None, slow: bool) -> WordLink:
    """Open the USB link to a board, over which words of 16 bits go; with `trace` all of them are written there too."""
    link = open_board(rig.radar.native[name].place, slow or rig.radar.slow_spi)
    if trace is None:
        return link
    return trace_words(link, clock, trace, rig, name)


def _load_rig(config: Path) -> Instrument:
    """Load a rig file. Raises ConfigError if its radars are not configured by this program."""
    rig = load_instrument(config)
    if not rig.radar.native:
        raise ConfigError(
            f"{config}: no boards under [radar] native",
            f'control is "{rig.radar.control}": another program configures these radars',
            'control = "native", native = { NAME = { usb_serial = "..." } }; see docs/how-to/radar-bring-up.md',
        )
    return rig


def _load_rig_of_board(config: Path, name: str) -> Instrument:
    """Load a rig file and check the settings of its radars. Raises ConfigError if this board is not under `native`."""
    rig = _load_rig(config)
    if name not in rig.radar.native:
        raise ConfigError(f"radar.native has no board {name!r}", "a typing error", f"one of {sorted(rig.radar.native)}")
    # The frames of one row are the most that a board has to count.
    check_constraints(rig, rig.grid.columns * rig.burst.pulses)
    return rig


def jog_stage(config: Path, axis: Axis, distance_mm: float, speed_mm_s: float | None, as_json: bool) -> int:
    """Move one axis of the homed stage; say where it rests, and its limits. Raises DeviceError, ScanError.

    `speed_mm_s` None: the stage's speed of the rig file.
    """
    rig = load_instrument(config)
    stage = rig.stage
    if speed_mm_s is None:
        speed_mm_s = stage.speed_mm_s
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        with PiClient(context, rig) as pi:
            status = pi.jog(axis, distance_mm, speed_mm_s)
    finally:
        context.destroy(linger=0)
    if as_json:
        position = {"x_mm": status.x_mm, "y_mm": status.y_mm}
        limits = {"travel_x_mm": stage.travel_x_mm, "travel_y_mm": stage.travel_y_mm}
        print_json({"state": status.state, **position, **limits})
    else:
        sys.stdout.write(f"x {status.x_mm:.3f} mm (limits: 0 and {stage.travel_x_mm:g} mm)\n")
        sys.stdout.write(f"y {status.y_mm:.3f} mm (limits: 0 and {stage.travel_y_mm:g} mm)\n")
    return 0
