"""The options of `polysight card`."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli_numbers import number

_FORM = argparse.RawDescriptionHelpFormatter


def card_status(args: argparse.Namespace) -> int:
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


def add_card_arguments(card: argparse.ArgumentParser) -> None:
    """Options of `polysight card`, and its actions `program` and `reset`."""
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
