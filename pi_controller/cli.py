"""`polysight-pi`: the command line of the Raspberry Pi half."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from polysight.pi_controller.finding import AS_THE_SERVICE
from polysight.shared import __version__
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import PolysightError, os_error
from polysight.shared.faults import explain
from polysight.shared.raster import WIDTH_TEXT

Command = Callable[[argparse.Namespace], int]
AddCommand = Callable[[str, Command, str, str], argparse.ArgumentParser]  # name, action, help, example


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _port(args: argparse.Namespace, instrument: Instrument) -> str:
    return args.stage_port or instrument.stage.port


def _run(args: argparse.Namespace) -> int:
    from polysight.pi_controller.service import Options, run

    options = Options(args.wires, args.stage_port, args.journal, args.command_address, args.event_address)
    return run(load_instrument(args.config), options)


def _check(args: argparse.Namespace) -> int:
    from polysight.pi_controller.checks import check_all
    from polysight.pi_controller.client import refuse_beside_service

    instrument = load_instrument(args.config)
    journal = args.journal or Path(instrument.pi.journal_dir)
    refuse_beside_service(instrument)
    failed, findings = 0, []
    for f in check_all(instrument, args.wires, _port(args, instrument), journal):
        failed += f.verdict == "fail"
        findings.append(f._asdict())
        if not args.json:
            _write(f"{f.verdict:5} {f.name}: {f.found}" + (f"\n        do: {f.remedy}" if f.remedy else ""))
    if args.json:
        _write(json.dumps(findings))
    return 1 if failed else 0


def _pulse(args: argparse.Namespace) -> int:
    from polysight.pi_controller import realtime
    from polysight.pi_controller.bringup import pulse
    from polysight.pi_controller.burst import BurstSpec
    from polysight.pi_controller.client import refuse_beside_service
    from polysight.pi_controller.service import open_lines

    instrument = load_instrument(args.config)
    refuse_beside_service(instrument)
    lines = open_lines(instrument, args.wires)
    try:
        if args.wires is None:
            for sentence in dict.fromkeys(realtime.prepare_process() + realtime.prepare_thread()):  # each once
                sys.stderr.write(f"polysight-pi: {sentence}\n")
        spec = BurstSpec.of(instrument.burst, check_width=False)
        records = pulse(lines, spec, args.count, round(args.pause_ms * 1e6))
    finally:
        lines.close()
    width, jitter = max(r.width_max_ns for r in records), max(r.jitter_ns for r in records)
    if args.json:
        _write(json.dumps([r._asdict() for r in records]))
    else:
        _write(f"{sum(r.pulses for r in records)} pulses in {len(records)} bursts on SYNC_IN {instrument.pi.sync_out}")
        _write(f"longest pulse at most {width / 1e3:.2f} us (the radar takes {WIDTH_TEXT})")
        _write(f"latest rising edge {jitter / 1e3:.2f} us behind its deadline")
    faults = [r.fault for r in records if r.fault]
    for number in sorted(set(faults)):
        e = explain(number)
        sys.stderr.write(f"error: fault {number} in {faults.count(number)} of {len(records)} bursts: {e.what}\n")
        sys.stderr.write(f"  why: {e.why}\n  do: {e.remedy}\n")
    return 1 if faults else 0


def _jog(args: argparse.Namespace) -> int:
    from polysight.pi_controller.bringup import bench_stage
    from polysight.pi_controller.client import refuse_beside_service

    instrument = load_instrument(args.config)
    refuse_beside_service(instrument)
    with bench_stage(instrument.stage, _port(args, instrument)) as stage:
        speed_mm_s = instrument.stage.travel_speed_mm_s if args.speed is None else args.speed
        here = stage.jog(args.dx, args.dy, speed_mm_s)
    _tell_position(args, here.x_mm, here.y_mm)
    return 0


def _home(args: argparse.Namespace) -> int:
    from polysight.pi_controller.bringup import bench_stage
    from polysight.pi_controller.client import home_by_service

    instrument = load_instrument(args.config)
    status = home_by_service(instrument)
    if status is not None:
        _tell_position(args, status.x_mm, status.y_mm)
        if status.lost_x_mm or status.lost_y_mm:
            lost = f"{status.lost_x_mm:.3f} mm in x, {status.lost_y_mm:.3f} mm in y"
            sys.stderr.write(f"polysight-pi: steps were lost since the homing before: {lost}; look at the drive\n")
        return 0
    with bench_stage(instrument.stage, _port(args, instrument)) as stage:
        here = stage.home()
    _tell_position(args, here.x_mm, here.y_mm)
    return 0


def _tell_position(args: argparse.Namespace, x_mm: float, y_mm: float) -> None:
    _write(json.dumps({"x_mm": x_mm, "y_mm": y_mm}) if args.json else f"stage at x {x_mm:.3f} mm, y {y_mm:.3f} mm")


def _events(args: argparse.Namespace) -> int:
    from polysight.pi_controller.client import follow_events, replay_events

    instrument = load_instrument(args.config)
    if args.scan_id:
        events = replay_events(instrument, args.scan_id, args.from_seq)
    else:
        events = follow_events(instrument, args.limit_s)
    for n, event in enumerate(events, 1):
        _write(json.dumps(event))
        if n == args.count:
            break
    return 0


def _keys(args: argparse.Namespace) -> int:
    from polysight.pi_controller.keys import COPY, allow, make_keys, read_allowed, revoke

    folder = args.dir or Path(load_instrument(args.config).pi.key_dir)
    if args.revoke:
        revoke(folder, args.revoke)
    if args.client:
        for path in allow(folder, args.client):
            _write(str(path))
        _write(f"copy them to that client as host.key and host.key_secret, with {folder / 'pi.key'}")
    if args.revoke or args.client or args.list:
        for key, name in read_allowed(folder).items():
            _write(f"allowed: {key} {name}")
        return 0
    for path in make_keys(folder, args.replace):
        _write(str(path))
    _write(COPY)
    return 0


def _take_over(args: argparse.Namespace) -> int:
    from polysight.pi_controller.client import take_over

    instrument = load_instrument(args.config)
    _write(f"the state is {take_over(instrument, args.what, args.journal or Path(instrument.pi.journal_dir))}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="polysight-pi",
        description="The Raspberry Pi half of the instrument: drives the stage, answers its triggers with SYNC_IN "
        "pulses, and tells the host.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="examples:\n  polysight-pi check\n  polysight-pi run --config instrument.toml",
    )
    parser.add_argument("--version", action="version", version=f"polysight-pi {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, action: Command, text: str, example: str) -> argparse.ArgumentParser:
        p = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=f"example:  polysight-pi {name} {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        p.set_defaults(action=action)
        p.add_argument(
            "--config", type=Path, default=Path("instrument.toml"), metavar="FILE", help="rig file (%(default)s)"
        )
        return p

    _add_service(add)
    _add_bench(add)
    _add_events(add)
    _add_keys(add)
    _add_take_over(add)
    return parser


def _stage_port(p: argparse.ArgumentParser) -> None:
    p.add_argument("--stage-port", metavar="TTY", help="serial port of the stage, instead of stage.port")


def _wires(p: argparse.ArgumentParser) -> None:
    p.add_argument("--wires", type=Path, metavar="SOCKET", help="socket of simulated wires, instead of GPIO")


def _journal(p: argparse.ArgumentParser) -> None:
    p.add_argument("--journal", type=Path, metavar="DIR", help="folder of the journals, instead of pi.journal_dir")


def _json(p: argparse.ArgumentParser) -> None:
    p.add_argument("--json", action="store_true", help="print JSON, for programs")


def _add_service(add: AddCommand) -> None:
    """`run`, and `check` before it."""
    p = add("run", _run, "serve the host until SIGTERM or SIGINT", "--config instrument.toml")
    _wires(p)
    _stage_port(p)
    _journal(p)
    p.add_argument("--command-address", metavar="tcp://HOST:PORT", help="instead of pi.command_address")
    p.add_argument("--event-address", metavar="tcp://HOST:PORT", help="instead of pi.event_address")

    p = add(
        "check", _check, "check every line, port, permission, key and disk; nothing moves", "--config instrument.toml"
    )
    _wires(p)
    _stage_port(p)
    _journal(p)
    _json(p)


def _add_bench(add: AddCommand) -> None:
    """What drives lines and stage by hand: `pulse`, `jog`, `home`."""
    p = add("pulse", _pulse, "send bursts on SYNC_IN and tell their width and jitter", "--count 100")
    _wires(p)
    p.add_argument("--count", type=_positive, default=10, metavar="N", help="how many bursts (%(default)s)")
    p.add_argument("--pause-ms", type=float, default=10.0, metavar="MS", help="pause between bursts (%(default)s)")
    _json(p)

    p = add("jog", _jog, "move the stage by a distance (home it first)", "--dx 10 --dy -5")
    _stage_port(p)
    p.add_argument("--dx", type=float, default=0.0, metavar="MM", help="along x, millimetres (0)")
    p.add_argument("--dy", type=float, default=0.0, metavar="MM", help="along y, millimetres (0)")
    p.add_argument("--speed", type=_speed, metavar="MM_S", help="mm/s (default: stage.travel_speed_mm_s)")
    _json(p)

    p = add("home", _home, "home the stage, through the running service if there is one", "--config instrument.toml")
    _stage_port(p)
    _json(p)


def _add_events(add: AddCommand) -> None:
    p = add("events", _events, "print events as JSON lines, live or from the journal", "--scan-id my-scan --from-seq 1")
    p.add_argument("--scan-id", metavar="ID", help="replay this scan from the journal instead of following live events")
    p.add_argument("--from-seq", type=_positive, default=1, metavar="N", help="first event of a replay (%(default)s)")
    p.add_argument("--count", type=_positive, metavar="N", help="stop after so many")
    p.add_argument(
        "--limit-s", type=float, default=10.0, metavar="S", help="give up after so long without an event (%(default)s)"
    )


def _add_keys(add: AddCommand) -> None:
    p = add("keys", _keys, "make CURVE keys for addresses that are not loopback", "--dir /etc/polysight/keys")
    p.add_argument("--dir", type=Path, metavar="DIR", help="folder, instead of pi.key_dir")
    p.add_argument("--replace", action="store_true", help="replace keys that are there already")
    p.add_argument("--client", metavar="NAME", help="make keys for one more client, and allow it")
    p.add_argument("--revoke", metavar="NAME", help="allow this client no more, at once")
    p.add_argument("--list", action="store_true", help="list the clients that are allowed")


def _add_take_over(add: AddCommand) -> None:
    p = add("take-over", _take_over, "command a run that another program began, as a person at the Pi", "abort")
    p.add_argument("what", choices=("hold", "resume", "abort", "end"), help="what to do with it")
    _journal(p)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _speed(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError("must be above 0")
    return value


def main(argv: list[str] | None = None) -> int:
    """Entry point. Exit status 0 only when it worked; an error is one message on stderr, without a trace."""
    args = _parser().parse_args(argv)
    try:
        return args.action(args)
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # Whoever read our output has enough; nothing must be flushed to it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as e:
        error = os_error(e, "a path is wrong, the disk is full, or it belongs to another user", AS_THE_SERVICE)
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main())
