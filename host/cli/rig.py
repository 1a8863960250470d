"""The commands around a rig: plan, doctor, card, inspect."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli.options import Add, add_config_option, count, number, positive
from polysight.shared.errors import ConfigError

_FORM = argparse.RawDescriptionHelpFormatter


def add_commands(add: Add) -> None:
    """Register the commands."""
    _add_plan(add)
    _add_doctor(add)
    _add_card(add)
    _add_inspect(add)


def _card(args: argparse.Namespace) -> int:
    """`polysight card` without an action."""
    from polysight.host.jobs.cards import show_cards

    return show_cards(args.config, args.listen, args.json)


def _program(args: argparse.Namespace) -> int:
    from polysight.host.jobs.cards import program_card

    return program_card(args.config, args.board, args.mac, args.at, args.yes, args.wait)


def _reset(args: argparse.Namespace) -> int:
    from polysight.host.jobs.cards import reset_card

    return reset_card(args.config, args.board, args.radar)


_seconds = number(float, "a number of seconds from 0 to 3600", lambda value: 0 <= value <= 3600)


def _add_card(add_command: Add) -> None:
    card = add_command(
        "card", _card, "say of each capture card which hop to it is silent; write its addresses", "polysight card"
    )
    add_config_option(card)
    card.add_argument("--json", action="store_true", help="print JSON, for programs")
    card.add_argument(
        "--listen",
        type=_seconds,
        default=0.0,
        metavar="S",
        help="record from every card for so many seconds, to see whether its radar streams (default: do not)",
    )
    actions = card.add_subparsers(dest="action", metavar="ACTION")

    def add(name: str, text: str, example: str) -> argparse.ArgumentParser:
        sub = actions.add_parser(
            name, help=text, description=f"{text}.", epilog=f"example:\n  {example}", formatter_class=_FORM
        )
        sub.add_argument("board", metavar="BOARD", help="name of the board in the rig file, e.g. RH")
        # Without a default, so that the one given before the action stays.
        sub.add_argument("--config", type=Path, default=argparse.SUPPRESS, metavar="FILE", help="rig file")
        return sub

    sub = add(
        "program",
        "write a board's addresses and ports of the rig file into its card's EEPROM, once confirmed",
        "polysight card program RH --mac 12:34:56:78:90:13 --at 192.168.33.180:4096",
    )
    sub.set_defaults(run=_program)
    sub.add_argument("--mac", required=True, help="MAC address the card gets; cards on one network need different ones")
    sub.add_argument(
        "--at",
        default="",
        metavar="ADDRESS:PORT",
        help="where the card answers now (default: as in the rig file; a new card: 192.168.33.180:4096)",
    )
    sub.add_argument("--yes", action="store_true", help="do not ask; the default is to have the new address typed")
    sub.add_argument(
        "--wait", type=_seconds, default=120.0, metavar="S", help="look for the card afterwards (default: 120 s; 0: no)"
    )
    sub = add("reset", "reset a card's FPGA, or the radar on it", "polysight card reset RH")
    sub.set_defaults(run=_reset)
    sub.add_argument("--radar", action="store_true", help="the radar board, which must be armed again, not the card")


def _doctor(args: argparse.Namespace) -> int:
    from polysight.host.doctor import DoctorOptions, run_doctor

    if args.move and not args.pulse:
        raise ConfigError(
            "--move and --no-pulse", "each point of the row is a burst of SYNC_IN pulses", "leave one of them out"
        )
    options = DoctorOptions(args.config, args.out, args.move, args.pulse, args.bursts)
    return run_doctor(options, args.json, bundle=args.bundle)


_bursts = number(int, "a whole number from 1 to 16", lambda value: 1 <= value <= 16)


def _add_doctor(add: Add) -> None:
    sub = add(
        "doctor",
        _doctor,
        "try every hop of the rig in order, and say what is wrong and what to do; nothing moves without --move",
        "polysight doctor --config instrument.toml --out scans",
    )
    add_config_option(sub)
    sub.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where scans will go: its disk is tried (default: here)"
    )
    sub.add_argument(
        "--move",
        action="store_true",
        help="THE STAGE MOVES: home it and run a short row, to try the trigger line; each of its points is a burst of"
        " SYNC_IN pulses",
    )
    sub.add_argument(
        "--no-pulse",
        dest="pulse",
        action="store_false",
        help="send no SYNC_IN pulses (default: a few bursts at rest; radars that are armed transmit meanwhile)",
    )
    sub.add_argument(
        "--bundle",
        type=Path,
        metavar="FILE.zip",
        help="write what was found, versions, rig file, logs and the last lines of manifests, to send to somebody;"
        " no raw data, no keys",
    )
    sub.add_argument("--bursts", type=_bursts, default=4, metavar="N", help="how many bursts to capture (default: 4)")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


_NUMBERS = (
    ("--speed-mm-s", positive, "stage speed in a row"),
    ("--pulses", count, "chirps a position"),
    ("--period-us", positive, "time from one chirp of a burst to the next"),
    ("--step-x-mm", positive, "distance of positions in a row; the aperture keeps its size"),
    ("--step-y-mm", positive, "distance of rows; the aperture keeps its size"),
    ("--columns", count, "positions in a row"),
    ("--rows", count, "rows"),
    ("--width-mm", positive, "aperture in x"),
    ("--height-mm", positive, "aperture in y"),
    ("--accel-mm-s2", positive, "acceleration of the stage"),
    ("--object-distance-mm", positive, "z of the object plane"),
)


def _plan(args: argparse.Namespace) -> int:
    from polysight.host.plan import Changes, PlanOptions, run_plan

    names = [flag[2:].replace("-", "_") for flag, _, _ in _NUMBERS]
    options = PlanOptions(
        args.minutes, args.count, args.like, args.snr_db, args.row_overhead_s, args.scene_mm, args.json
    )
    return run_plan(args.config, Changes(**{name: getattr(args, name) for name in names}), options)


def _size(text: str) -> tuple[float, float]:
    try:
        width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form WIDTH,HEIGHT in mm, e.g. 170,170") from None
    return width, height


def _add_plan(add: Add) -> None:
    sub = add(
        "plan",
        _plan,
        "time, resolution, noise, aliases and data of a scan before it is made; or the best scan within a time",
        "polysight plan --minutes 30\n  polysight plan --speed-mm-s 100 --pulses 16 --period-us 750",
    )
    add_config_option(sub, shipped=True)
    for flag, kind, text in _NUMBERS:
        sub.add_argument(flag, type=kind, metavar="N", help=f"{text} (default: the rig file's)")
    sub.add_argument("--minutes", type=positive, metavar="M", help="propose the best plans within this time")
    sub.add_argument("--count", type=count, default=5, metavar="N", help="how many (default: 5)")
    sub.add_argument(
        "--scene-mm", type=_size, metavar="W,H", help="size of what lies on the plane (default: the image's)"
    )
    sub.add_argument("--like", type=Path, metavar="SCAN", help="take noise and standstill between rows from this scan")
    sub.add_argument(
        "--snr-db", type=float, metavar="DB", help="direct path over noise: a channel, a sample, a chirp (default: 5.5)"
    )
    sub.add_argument(
        "--row-overhead-s", type=float, metavar="S", help="standstill between rows (default: 0.3, simulated)"
    )
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _inspect(args: argparse.Namespace) -> int:
    from polysight.host.jobs.look import inspect_file

    if args.placement:
        from polysight.host.jobs.placement import inspect_placement

        return inspect_placement(args.file, args.json)
    return inspect_file(args.file, args.config, args.plot, args.card, args.json)


def _add_inspect(add: Add) -> None:
    sub = add(
        "inspect", _inspect, "say what a recording of a DCA1000 holds", "polysight inspect scans/one/raw/RH/0000.bin"
    )
    sub.add_argument(
        "file", type=Path, metavar="FILE", help="payload (.bin), or packets recorded by tcpdump -w (.pcap)"
    )
    sub.add_argument(
        "--config", type=Path, metavar="RIG", help="rig file it was recorded with (default: a scan's own; else guessed)"
    )
    sub.add_argument(
        "--placement", action="store_true", help="FILE is a row of a scan: how its packets were placed, decided again"
    )
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the range profile of every antenna")
    sub.add_argument("--card", default="", metavar="ADDRESS", help="which card, where packets of several were recorded")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")
