"""The command `radar`: one board by itself, for its first days."""

from __future__ import annotations

import argparse
from pathlib import Path

from polysight.host.cli.options import Add, add_config_option

_FORM = argparse.RawDescriptionHelpFormatter


def add_commands(add: Add) -> None:
    """Register the command and its actions."""
    radar = add(
        "radar",
        _plan,
        "show what each radar board will be sent; check one board, load its firmware, replay a trace",
        "polysight radar check RH",
    )
    add_config_option(radar)
    actions = radar.add_subparsers(dest="action", metavar="ACTION")

    def action(name: str, text: str, example: str) -> argparse.ArgumentParser:
        sub = actions.add_parser(
            name, help=text, description=f"{text}.", epilog=f"example:\n  {example}", formatter_class=_FORM
        )
        # Without a default, so that the one given before the action stays.
        sub.add_argument("--config", type=Path, default=argparse.SUPPRESS, metavar="FILE", help="rig file")
        return sub

    sub = action("plan", "show each constraint, and the settings that each board will be sent", "polysight radar plan")
    sub.set_defaults(run=_plan)

    sub = action(
        "check",
        "walk one board from USB to one frame: what was expected, what came, what to do",
        "polysight radar check RH --trace first-day.jsonl",
    )
    sub.set_defaults(run=_check)
    _add_board(sub)
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")

    sub = action(
        "firmware",
        "check TI's image, start a board from it in RAM, or write it to the board's flash; verified either way",
        "polysight radar firmware RH xwr22xx_metaImage.bin --flash",
    )
    sub.set_defaults(run=_firmware)
    _add_board(sub)
    sub.add_argument("image", type=Path, metavar="IMAGE", help="TI's xwr22xx_metaImage.bin")
    sub.add_argument(
        "--flash", action="store_true", help="write the board's flash (default: RAM, until its next reset)"
    )

    sub = action("replay", "play a trace to the check, instead of a board", "polysight radar replay first-day.jsonl")
    sub.set_defaults(run=_replay)
    sub.add_argument("trace", type=Path, metavar="TRACE", help="a file that --trace wrote")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")


def _add_board(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("board", metavar="BOARD", help="name of the board in the rig file, e.g. RH")
    sub.add_argument("--trace", type=Path, metavar="FILE", help="write down all that passes between host and board")
    sub.add_argument("--slow", action="store_true", help="words one by one at 1 MHz, for wires that are in doubt")


def _plan(args: argparse.Namespace) -> int:
    from polysight.host.jobs.radar import plan_radars

    return plan_radars(args.config)


def _check(args: argparse.Namespace) -> int:
    from polysight.host.jobs.radar import check_radar

    return check_radar(args.config, args.board, args.trace, args.slow, args.json)


def _firmware(args: argparse.Namespace) -> int:
    from polysight.host.jobs.radar import load_firmware

    return load_firmware(args.config, args.board, args.image, args.flash, args.trace, args.slow)


def _replay(args: argparse.Namespace) -> int:
    from polysight.host.jobs.radar import replay_radar

    return replay_radar(args.config, args.trace, args.json)
