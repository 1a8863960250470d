"""The radars and capture cards of a simulated rig as one process: SYNC_IN edges in, frames out as UDP.

Each rising edge on a board's SYNC_IN line starts one frame; while its card records, the frame's samples leave as data
packets from the card's address on loopback. Specification: docs/spec/simulated-rig.md.
"""

import argparse
import json
import signal
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event

from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.wires import WireClient
from polysight_simulators.cards.card import SimulatedCard
from polysight_simulators.cards.server import CardServer
from polysight_simulators.cards.sync_in import StageTrack
from polysight_simulators.faults import read_faults
from polysight_simulators.process import announce_ready, make_parser, parse_count, run_until_stopped
from polysight_simulators.radars import LineServer, RadarSocket
from polysight_simulators.scene import (
    Disturbances,
    PatternSource,
    Scene,
    SignalSource,
    SimulatedRig,
    load_scene,
    without_offset,
)


def _make_parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    parser = make_parser(
        "polysight_simulators.cards",
        "Radars and capture cards of a simulated rig; `python -m polysight_simulators.rig` starts them.",
        "--config rig/instrument.toml --wires rig/wires.sock --pattern",
    )
    parser.add_argument("--config", type=Path, required=True, help="rig file of the simulated rig")
    parser.add_argument(
        "--wires", type=Path, required=True, help="Unix socket of the process that stands for the rig's wires"
    )
    parser.add_argument("--scene", type=Path, help="scene file; not needed with --pattern")
    parser.add_argument(
        "--offset-in-rig",
        action="store_true",
        help="the rig file's start frequencies include the scene's if_offset_hz",
    )
    parser.add_argument("--pattern", action="store_true", help="send a counting pattern instead of the scene")
    parser.add_argument("--time-scale", type=float, default=1.0, help="wire time over wall time")
    parser.add_argument("--seed", type=parse_count, default=None, help="default: the scene's")
    parser.add_argument("--boards", default="", help="names, with commas; default: every board")
    parser.add_argument("--faults", type=Path, help="TOML file with a [faults] table")
    parser.add_argument("--fault", action="append", default=[], metavar="[BOARD.]KEY=VALUE", help="a single fault")
    parser.add_argument("--no-wait", action="store_true", help="send even if the receiver does not keep up")
    parser.add_argument("--report", type=Path, help="JSON file for the counts, written at the end")
    parser.add_argument("--cache", type=Path, help="folder where the scene's object fields are kept between runs")
    return parser


def _check_arguments(args: argparse.Namespace, board_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the boards to simulate. Raises ConfigError for arguments that make no sense."""
    if args.time_scale <= 0:
        problem = f"--time-scale {args.time_scale}"
        raise ConfigError(problem, "it must be positive", "give a number above 0", code=ErrorCode.VALUE_INVALID)
    if args.scene is None and not args.pattern:
        cause = "the cards need something to send"
        raise ConfigError("neither --scene nor --pattern", cause, "give one of them", code=ErrorCode.KEY_MISSING)
    if args.boards:
        names = tuple(args.boards.split(","))
    else:
        names = board_names
    if unknown := sorted(set(names) - set(board_names)):
        problem = f"--boards {','.join(unknown)}: no such board"
        raise ConfigError(problem, f"the boards are {board_names}", "correct it", code=ErrorCode.KEY_UNKNOWN)
    return names


def _make_source(
    args: argparse.Namespace, rig: Instrument, scene: Scene | None, names: tuple[str, ...]
) -> SignalSource:
    """Return the data of the radars: a counting pattern, or the signals of the scene."""
    if scene is None or args.pattern:
        return PatternSource(rig)
    radars = SimulatedRig(rig, scene, args.seed, args.cache)
    recorded = [b.name for b in rig.recorded if b.name in names]
    if recorded:
        # Before the first burst of a scan, which it would delay.
        radars.prepare(*recorded)
    return radars


def _run(args: argparse.Namespace, stop: Event) -> None:
    """Run the cards until `stop`. Raises PolysightError."""
    rig = load_instrument(args.config)
    board_names = tuple(b.name for b in rig.boards)
    names = _check_arguments(args, board_names)
    scene = None
    seed = 0
    scene_faults = {}
    disturbances = Disturbances()
    if args.scene is not None:
        scene = load_scene(args.scene)
        if args.offset_in_rig:
            scene = without_offset(scene)
        seed = scene.seed
        disturbances = scene.disturbances
        scene_faults = {"loss": disturbances.packet_loss}
    if args.seed is not None:
        seed = args.seed
    faults = read_faults(args.faults, args.fault, board_names, scene_faults, rig.radar.control)
    source = _make_source(args, rig, scene, names)
    # The signal asks to switch the cards off and on.
    power_cycle = Event()
    signal.signal(signal.SIGUSR1, lambda _signal, _frame: power_cycle.set())
    cards: list[SimulatedCard] = []
    with ExitStack() as open_things:
        open_things.callback(lambda: _report(cards, args.report))
        for name in names:
            card = SimulatedCard(
                rig=rig,
                board=rig.by_name(name),
                source=source,
                faults=faults[name],
                seed=seed,
                time_scale=args.time_scale,
                clock_s=time.monotonic,
                wait_for_receiver=not args.no_wait,
            )
            cards.append(card)
        lines = tuple(sorted({card.line for card in cards} | {rig.pi.trigger_in}))
        wires = open_things.enter_context(closing(WireClient(args.wires, lines, motion=True)))
        track = StageTrack(rig, disturbances.burst_motion, disturbances.backlash_mm)
        chips = _open_chips(rig, cards, open_things)
        control: list[LineServer] = []
        if rig.radar.control == "line_server":
            for card in cards:
                name = card.board.name
                control.append(LineServer(rig.radar.servers[name], card.rearm, faults[name]))
                open_things.callback(control[-1].close)
        server = CardServer(
            rig=rig,
            cards=cards,
            wires=wires,
            time_scale=args.time_scale,
            clock_s=time.monotonic,
            track=track,
            power_cycle=power_cycle,
            control=control,
            chips=chips,
        )
        open_things.callback(server.close)
        announce_ready(", ".join(f"{c.board.name} at {c.board.card_address}" for c in cards))
        server.serve(stop)


def _open_chips(rig: Instrument, cards: list[SimulatedCard], open_things: ExitStack) -> list[RadarSocket]:
    """Open a socket in place of the USB chip of each radar that the cards simulate."""
    chips: list[RadarSocket] = []
    for card in cards:
        if card.radar is not None:
            chips.append(RadarSocket(rig.radar.native[card.board.name].usb_serial, card.radar))
            open_things.callback(chips[-1].close)
    return chips


def _report(cards: list[SimulatedCard], path: Path | None) -> None:
    """Write each card's counts: a line on stderr, all into the file; then close the sockets."""
    reports = {card.board.name: card.report() for card in cards}
    for name, report in reports.items():
        sys.stderr.write(f"{name}: " + ", ".join(f"{k} {v}" for k, v in report.items() if v != 0) + "\n")
    if path is not None:
        path.write_text(json.dumps({"simulated": True, "boards": reports}, indent=2) + "\n", encoding="utf-8")
    for card in cards:
        card.close()


def main(argv: list[str] | None = None) -> int:
    """Run the cards until SIGTERM or SIGINT."""
    args = _make_parser().parse_args(argv)
    return run_until_stopped(lambda stop: _run(args, stop))


if __name__ == "__main__":
    sys.exit(main())
