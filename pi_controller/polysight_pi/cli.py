"""`polysight-pi`: the command line of the Raspberry Pi half."""

from __future__ import annotations

import argparse
import errno
import json
import math
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polysight_pi import RIG_FILE, advise_as_service
from polysight_shared import __version__
from polysight_shared.program import (
    close_standard_output,
    expand_home,
    interrupts_between_imports,
    open_standard_streams,
)

if TYPE_CHECKING:
    from polysight_shared.config import Instrument
    from polysight_shared.errors import DeviceError

# Commands import their modules when they are called: `--help` needs no package of others, and Ctrl-C ends in no
# traceback. A function with `args` and `instrument` is a command of COMMANDS; it returns the exit status.

# Pause between two bursts of `pulse` (chosen).
PAUSE_NS = 10_000_000
# Largest count of bursts or events, and largest number of an event: the largest that a message to the service can hold.
MAX_COUNT = 2**31 - 1
# Largest distance and speed of `jog`; chosen: further and faster than any stage goes.
MAX_DISTANCE_MM = 10_000.0
MAX_SPEED_MM_S = 10_000.0
# Longest timeout; chosen.
MAX_TIMEOUT_S = 1e6


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _run(args: argparse.Namespace, instrument: Instrument) -> int:
    from polysight_pi.service import run

    return run(instrument, args.wires)


def _check(args: argparse.Namespace, instrument: Instrument) -> int:
    """Print each finding as soon as it is there; return 1 if one is an error."""
    from polysight_pi.checks import check_all, to_json
    from polysight_pi.client import refuse_while_service_runs

    refuse_while_service_runs(instrument)
    findings = []
    for finding in check_all(instrument, args.wires):
        content = to_json(finding)
        findings.append(content)
        if not args.json:
            _write(f"{content['verdict']:5} {content['name']}: {content['found']}")
        if not args.json and finding.do:
            _write(f"        do: {finding.do}")
    if args.json:
        _write(json.dumps(findings))
    return int(any(content["verdict"] == "fail" for content in findings))


def _pulse(args: argparse.Namespace, instrument: Instrument) -> int:
    """Send bursts and print their width and jitter; return 1 if one had a fault."""
    from polysight_pi import system
    from polysight_pi.client import refuse_while_service_runs
    from polysight_pi.lines import open_lines
    from polysight_pi.service import log
    from polysight_pi.trigger import BurstSpec, send_burst
    from polysight_shared.faults import explain
    from polysight_shared.raster import WIDTH_TEXT

    refuse_while_service_runs(instrument)
    lines = open_lines(instrument, args.wires)
    try:
        if args.wires is None:
            # Print each sentence once.
            for sentence in dict.fromkeys(system.prepare_process() + system.prepare_thread()):
                log(sentence)
        # The width is printed below, so it need not be checked here.
        lines.check_width = False
        spec = BurstSpec.from_burst(instrument.burst)
        end_ns = lines.now_ns()
        records = []
        for _ in range(args.count):
            record = send_burst(lines, spec, end_ns + PAUSE_NS)
            records.append(record)
            end_ns = record.end_ns
    finally:
        lines.close()
    if args.json:
        _write(json.dumps([r._asdict() for r in records]))
    else:
        _write(f"{sum(r.pulses for r in records)} pulses in {len(records)} bursts on SYNC_IN {instrument.pi.sync_out}")
        width_us = max(r.width_max_ns for r in records) / 1e3
        jitter_us = max(r.jitter_ns for r in records) / 1e3
        _write(f"longest pulse at most {width_us:.2f} us (the radar accepts {WIDTH_TEXT})")
        _write(f"latest rising edge {jitter_us:.2f} us after its deadline")
    faults = [r.fault for r in records if r.fault]
    for number in sorted(set(faults)):
        explanation = explain(number)
        sys.stderr.write(
            f"error: fault {number} in {faults.count(number)} of {len(records)} bursts: {explanation.problem}\n"
        )
        sys.stderr.write(f"  why: {explanation.cause}\n  do: {explanation.remedy}\n")
    return int(bool(faults))


def _jog(args: argparse.Namespace, instrument: Instrument) -> int:
    """Move the homed stage by a distance and print its position."""
    from polysight_pi.client import refuse_while_service_runs
    from polysight_pi.stage import BenchStage

    refuse_while_service_runs(instrument)
    with BenchStage(instrument.stage) as stage:
        speed_mm_s = args.speed or instrument.stage.travel_speed_mm_s
        return _print_position(args, stage.jog(args.dx, args.dy, speed_mm_s))


def _buzz(args: argparse.Namespace, instrument: Instrument) -> int:
    """Move an axis by 1 mm each way and print the position."""
    from polysight_pi.client import refuse_while_service_runs
    from polysight_pi.stage import BenchStage

    refuse_while_service_runs(instrument)
    if not args.json:
        _write(f"{args.axis}: 1 mm away from its limit switch, 2 mm back, 1 mm forward")
    with BenchStage(instrument.stage) as stage:
        return _print_position(args, stage.buzz(args.axis))


def _home(args: argparse.Namespace, instrument: Instrument) -> int:
    """Home through the running service, or without one; say how many millimetres of steps were lost."""
    from polysight_pi.client import home_by_service
    from polysight_pi.stage import BenchStage

    status = home_by_service(instrument)
    if status is None:
        with BenchStage(instrument.stage) as stage:
            return _print_position(args, stage.home())
    if status.lost_x_mm or status.lost_y_mm:
        error_mm = f"{status.lost_x_mm:.3f} mm in x, {status.lost_y_mm:.3f} mm in y"
        sys.stderr.write(f"polysight-pi: steps were lost since the previous homing: {error_mm}; check the drive\n")
    return _print_position(args, status)


def _print_position(args: argparse.Namespace, status: Any) -> int:
    """Print `x_mm` and `y_mm` of a status or position; return 0."""
    position_mm = {"x_mm": status.x_mm, "y_mm": status.y_mm}
    if args.json:
        _write(json.dumps(position_mm))
    else:
        _write(f"stage at x {status.x_mm:.3f} mm, y {status.y_mm:.3f} mm")
    return 0


def _show_events(args: argparse.Namespace, instrument: Instrument) -> int:
    """Print the events of a scan's journal, or live ones, one JSON object a line."""
    from polysight_pi.client import follow_events, replay_events

    if args.scan_id is not None:
        events = replay_events(instrument, args.scan_id, args.from_seq)
    else:
        events = follow_events(instrument, args.limit_s)
    for n, event in enumerate(events, 1):
        _write(json.dumps(event))
        if n == args.count:
            break
    return 0


def _make_keys(args: argparse.Namespace) -> int:
    """Make the keys of Pi and host, or add, remove and list clients. Works without a rig file if `--dir` is given."""
    from polysight_pi.keys import COPY_INSTRUCTION, allow_client, make_keys, read_allowed, revoke_client

    folder = args.dir or Path(_load_rig(args).pi.key_dir)
    if args.revoke:
        revoke_client(folder, args.revoke)
    if args.client:
        for path in allow_client(folder, args.client):
            _write(str(path))
        _write(f"copy them to that client as host.key and host.key_secret, with {folder / 'pi.key'}")
    if args.revoke or args.client or args.list:
        allowed = read_allowed(folder)
        for key, name in allowed.items():
            _write(f"allowed: {key} {name}")
        if not allowed:
            _write("no client is allowed")
        return 0
    for path in make_keys(folder, args.replace):
        _write(str(path))
    _write(COPY_INSTRUCTION)
    return 0


def _take_over(args: argparse.Namespace, instrument: Instrument) -> int:
    from polysight_pi.client import take_over

    _write(f"the state is {take_over(instrument, args.what)}")
    return 0


def _parse_count(text: str) -> int:
    """Parse a whole number from 1 to MAX_COUNT. Raises ArgumentTypeError."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 1 <= value <= MAX_COUNT:
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from 1 to {MAX_COUNT}")
    return value


def _number_within(low: float, high: float) -> Callable[[str], float]:
    """Return a function that parses a number of this range and raises ArgumentTypeError for another."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} must be a number from {low:g} to {high:g}")
        return value

    return parse


def _make_option(*names: str, **how: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the arguments of `add_argument` for an option or argument of a command."""
    return names, how


def _load_rig(args: argparse.Namespace) -> Instrument:
    """Load the rig file, with the values given on the command line."""
    import msgspec

    from polysight_shared.config import load_instrument
    from polysight_shared.errors import ConfigError, ErrorCode

    try:
        rig = load_instrument(args.config)
    except ConfigError as e:
        # On the Pi, a person may run the first command in another folder than that of the rig file.
        if e.code == ErrorCode.FILE_MISSING and Path(RIG_FILE).exists():
            e.remedy = f"give the rig file of this Pi: `--config {RIG_FILE}`"
        raise
    overrides = {key: value for key, value in vars(args).items() if value is not None}
    pi_values = {key: overrides[key] for key in ("journal_dir", "command_address", "event_address") if key in overrides}
    stage_values = {"port": overrides["stage_port"]} if "stage_port" in overrides else {}
    replace = msgspec.structs.replace
    return replace(rig, pi=replace(rig.pi, **pi_values), stage=replace(rig.stage, **stage_values))


# Options of several commands.
WIRES_OPTION = _make_option("--wires", type=Path, metavar="SOCKET", help="socket of simulated wires, instead of GPIO")
STAGE_PORT = _make_option("--stage-port", metavar="TTY", help="serial port of the stage; replaces stage.port")
JOURNAL_OPTION = _make_option(
    "--journal", dest="journal_dir", metavar="DIR", help="folder of the journals; replaces pi.journal_dir"
)
JSON_OPTION = _make_option("--json", action="store_true", help="print JSON, for programs")
# Settings of options that are a number of things or a distance.
COUNT_SETTINGS = {"type": _parse_count, "metavar": "N"}
DISTANCE_SETTINGS = {"type": _number_within(-MAX_DISTANCE_MM, MAX_DISTANCE_MM), "default": 0.0, "metavar": "MM"}
SPEED_SETTINGS = {"type": _number_within(0.001, MAX_SPEED_MM_S), "metavar": "MM_S"}
TIMEOUT_SETTINGS = {"type": _number_within(0.001, MAX_TIMEOUT_S), "default": 10.0, "metavar": "S"}
# Name, action, help, example (the words after the name) and options of each command.
COMMANDS: tuple[tuple[str, Any, str, str, tuple[tuple[tuple[str, ...], dict[str, Any]], ...]], ...] = (
    ("run", _run, "serve the host until SIGTERM or SIGINT", "--config instrument.toml", (
        WIRES_OPTION, STAGE_PORT, JOURNAL_OPTION,
        _make_option("--command-address", metavar="tcp://HOST:PORT", help="replaces pi.command_address"),
        _make_option("--event-address", metavar="tcp://HOST:PORT", help="replaces pi.event_address"),
    )),
    ("check", _check, "check lines, ports, permissions, keys and disk; nothing moves", "--config instrument.toml", (
        WIRES_OPTION, STAGE_PORT, JOURNAL_OPTION, JSON_OPTION,
    )),
    ("pulse", _pulse, "send bursts on SYNC_IN and print their width and jitter", "--count 100", (
        WIRES_OPTION, JSON_OPTION,
        _make_option("--count", **COUNT_SETTINGS, default=10, help="number of bursts (%(default)s)"),
    )),
    ("buzz", _buzz, "move an axis by 1 mm each way, slowly, before the first homing", "x", (
        _make_option("axis", choices=("x", "y"), help="axis; y is the vertical one"), STAGE_PORT, JSON_OPTION,
    )),
    ("jog", _jog, "move the stage by a distance (home it first)", "--dx 10 --dy -5", (
        STAGE_PORT, JSON_OPTION, _make_option("--dx", **DISTANCE_SETTINGS, help="along x, millimetres (0)"),
        _make_option("--dy", **DISTANCE_SETTINGS, help="along y, millimetres (0)"),
        _make_option("--speed", **SPEED_SETTINGS, help="mm/s (default: stage.travel_speed_mm_s)"),
    )),
    ("home", _home, "home the stage, through the service if it runs", "--config instrument.toml", (
        STAGE_PORT, JSON_OPTION,
    )),
    ("events", _show_events, "print events as JSON lines, live or from the journal", "--scan-id my-scan --from-seq 1", (
        _make_option("--scan-id", metavar="ID", help="print the journal of this scan instead of live events"),
        _make_option("--from-seq", **COUNT_SETTINGS, default=1, help="first event from the journal (%(default)s)"),
        _make_option("--count", **COUNT_SETTINGS, help="stop after this number of events"),
        _make_option("--limit-s", **TIMEOUT_SETTINGS, help="timeout without an event (%(default)s)"),
    )),
    ("keys", _make_keys, "make CURVE keys for addresses that are not loopback", "--dir /etc/polysight/keys", (
        _make_option("--dir", type=Path, metavar="DIR", help="folder of the keys; replaces pi.key_dir"),
        _make_option("--replace", action="store_true", help="replace existing keys"),
        _make_option("--client", metavar="NAME", help="make keys for one more client and allow it"),
        _make_option("--revoke", metavar="NAME", help="remove this client from the list; it is refused immediately"),
        _make_option("--list", action="store_true", help="list the allowed clients"),
    )),
    ("take-over", _take_over, "control the run of another program, as a person at the Pi", "abort", (
        _make_option("what", choices=("hold", "resume", "abort", "end"), help="action on the run"), JOURNAL_OPTION,
    )),
)  # fmt: skip


def _make_parser() -> argparse.ArgumentParser:
    """Return the parser of COMMANDS."""
    parser = argparse.ArgumentParser(
        prog="polysight-pi",
        description="The Raspberry Pi half of the instrument: controls the stage, answers its triggers with SYNC_IN "
        "pulses, and reports to the host.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="examples:\n  polysight-pi check\n  polysight-pi run --config instrument.toml",
    )
    parser.add_argument("--version", action="version", version=f"polysight-pi {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, action, text, example, options in COMMANDS:
        command_parser = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=f"example:  polysight-pi {name} {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command_parser.set_defaults(action=action)
        command_parser.add_argument(
            "--config", type=Path, default=Path("instrument.toml"), metavar="FILE", help="rig file (%(default)s)"
        )
        for flags, settings in options:
            command_parser.add_argument(*flags, **settings)
    return parser


def _convert_os_error(e: OSError, words: Sequence[str]) -> DeviceError:
    """Return the error of ours for an error of the operating system in the command with these words."""
    from polysight_shared.errors import convert_os_error

    if e.errno in (errno.EACCES, errno.EPERM):
        return convert_os_error(e, "it belongs to another user", advise_as_service(words))
    if e.errno in (errno.ENOSPC, errno.EDQUOT):
        return convert_os_error(e, "the disk is full", "free space on it (df -h)")
    return convert_os_error(e)


def main(argv: list[str] | None = None) -> int:
    """Run the command of `argv` (default: the program's arguments) and return the exit status.

    An error of ours or of the operating system is one message on stderr, without a traceback.
    """
    open_standard_streams()
    words = expand_home(sys.argv[1:] if argv is None else argv)
    try:
        with interrupts_between_imports():
            args = _make_parser().parse_args(words)
            if args.action is _make_keys:
                return args.action(args)
            return args.action(args, _load_rig(args))
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # The reader of our output has closed the pipe.
        close_standard_output()
        return 0
    except Exception as e:
        from polysight_shared.errors import PolysightError

        if isinstance(e, OSError):
            error = _convert_os_error(e, words)
        elif isinstance(e, PolysightError):
            error = e
        else:
            raise
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
