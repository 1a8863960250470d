"""The radars and capture cards of a simulated rig as one process: SYNC_IN edges in, frames out as UDP.

Each rising edge on a board's SYNC_IN line starts one frame; while its card records, the frame's samples leave as data
packets from the card's address on loopback. Specification: docs/spec/simulated-rig.md.
"""

from __future__ import annotations

import argparse
import json
import selectors
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event

from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError, PolysightError
from polysight.shared.wires import WireClient, WireEdge, WireMotion
from polysight.simulators._process import announce_ready, command_line, die_with_parent, stop_requested
from polysight.simulators.card_endpoint import Clock
from polysight.simulators.card_faults import read_faults
from polysight.simulators.card_sender import Pace
from polysight.simulators.dca1000 import TAIL_S
from polysight.simulators.line_server import LineServer
from polysight.simulators.pattern import PatternSource, SignalSource
from polysight.simulators.radar import SimulatedRig
from polysight.simulators.radar_socket import RadarSocket
from polysight.simulators.scene import Disturbances, Scene, load_scene
from polysight.simulators.simulated_card import SimulatedCard
from polysight.simulators.sync_in import StageTrack

EDGES_PER_TURN = 2048
GATHER_S = 0.01  # between readings of the wires that brought pulses: many frames a call cost less than a few
IDLE_S = 0.1


class CardServer:
    """All cards of one process, on one set of wires."""

    def __init__(
        self,
        rig: Instrument,
        cards: list[SimulatedCard],
        wires: WireClient,
        time_scale: float,
        clock_s: Clock,
        track: StageTrack,
        power_cycle: Event | None = None,
        control: Sequence[LineServer] = (),
        chips: Sequence[RadarSocket] = (),
    ) -> None:
        self._cards = cards
        self._control, self._chips = control, chips
        self._power_cycle = power_cycle or Event()
        self._wires = wires
        self._trigger = rig.pi.trigger_in
        self._time_scale = time_scale
        self._clock_s = clock_s
        self._track = track
        self._trigger_ns = self._pulse_ns = 0
        self._selector = selectors.DefaultSelector()
        self._bound: dict[SimulatedCard, tuple[int, int]] = {}  # number of the card's binding, its descriptor then
        self._select_cards()
        self._selector.register(wires, selectors.EVENT_READ)
        for server in (*control, *chips):
            self._selector.register(server, selectors.EVENT_READ)
        self._listening = True
        self._unread = False
        self._next_read_s = 0.0

    @property
    def more_expected(self) -> bool:
        """Whether the stage is in a row, or pulses for its last trigger are still to come."""
        return self._track.moving or self._trigger_ns > self._pulse_ns

    def serve(self, stop: Event) -> None:
        """Work until `stop` is set; `power_cycle`, when set, switches every card off and on.

        Raises DeviceError when the wires break, or a card's new address cannot be taken.
        """
        timeout: float = 0.0
        while not stop.is_set():
            ready = self._selector.select(0.0 if self._unread and self._listening else timeout)
            # A radar is re-armed before the row's first pulse is sent, however late this process comes to see both.
            for server in self._control:
                server.serve()
            # Wires first: a pulse sent before a command was sent belongs before it.
            commands = any(key.fileobj is not self._wires for key, _ in ready)
            if commands or (self._listening and (self._unread or ready)):
                self._take_edges()
            for chip in self._chips:
                chip.serve()
            if self._power_cycle.is_set():
                self._power_cycle.clear()
                for card in self._cards:
                    card.endpoint.power_cycle()
            for card in self._cards:
                card.endpoint.serve_commands()
            self._select_cards()
            timeout = min(self._work(card) for card in self._cards)
            gather_s = self._next_read_s - self._clock_s()
            self._listen(gather_s <= 0 and not any(card.endpoint.sender.full for card in self._cards))
            if gather_s > 0:
                timeout = min(timeout, gather_s)

    def _select_cards(self) -> None:
        """Listen to the cards' sockets, which are others after a power cycle."""
        changed = [card for card in self._cards if self._bound.get(card, (0,))[0] != card.endpoint.bindings]
        for card in changed:
            if card in self._bound:
                self._selector.unregister(self._bound[card][1])
        for card in changed:
            descriptor = card.endpoint.fileno()
            self._selector.register(descriptor, selectors.EVENT_READ)
            self._bound[card] = (card.endpoint.bindings, descriptor)

    def _take_edges(self) -> bool:
        """Read what the wires brought; whether there were pulses."""
        rising: dict[int, list[int]] = {card.line: [] for card in self._cards}
        self._unread = True  # the client may hold lines that its descriptor does not show
        for _ in range(EDGES_PER_TURN):
            message = self._wires.receive(0.0)
            if message is None:
                self._unread = False
                break
            if isinstance(message, WireMotion):
                self._track.add(message)
            elif message.value:
                self._edge(message, rising)
        for card in self._cards:
            if rising[card.line]:
                card.pulses(rising[card.line], self._track)
                self._next_read_s = self._clock_s() + GATHER_S
        return any(rising.values())

    def _edge(self, edge: WireEdge, rising: dict[int, list[int]]) -> None:
        if edge.line == self._trigger:
            self._trigger_ns = edge.t_ns
            self._track.trigger(edge.t_ns)
        elif edge.line in rising:
            self._pulse_ns = edge.t_ns
            rising[edge.line].append(edge.t_ns)

    def _work(self, card: SimulatedCard) -> float:
        """Send, and end the record in time; seconds until this card has more to do."""
        endpoint = card.endpoint
        wait = endpoint.flush()
        if wait is None and endpoint.due and not self._take_edges():  # data that is on its way puts the end off
            card.tick(self.more_expected)
            wait = endpoint.flush()
        if wait is not None:
            return min(wait, IDLE_S)
        return IDLE_S if card.card.deadline_s is None else min(IDLE_S, max(0.001, 0.1 * TAIL_S / self._time_scale))

    def _listen(self, wanted: bool) -> None:
        """Leave the wires unread for a while: the socket and the hub keep the edges."""
        if wanted is not self._listening:
            self._listening = wanted
            if wanted:
                self._selector.register(self._wires, selectors.EVENT_READ)
            else:
                self._selector.unregister(self._wires)

    def close(self) -> None:
        """Forget the sockets; their owners close them."""
        self._selector.close()


def _parser() -> argparse.ArgumentParser:
    parser = command_line(
        "polysight.simulators.cards",
        "Radars and capture cards of a simulated rig; `python -m polysight.simulators.rig` starts them.",
        "--config rig/instrument.toml --wires rig/wires.sock --pattern",
    )
    parser.add_argument("--config", type=Path, required=True, help="rig file of the simulated rig")
    parser.add_argument("--wires", type=Path, required=True, help="Unix socket of the wires hub")
    parser.add_argument("--scene", type=Path, help="scene file; not needed with --pattern")
    parser.add_argument("--pattern", action="store_true", help="send a counting pattern instead of the scene")
    parser.add_argument("--time-scale", type=float, default=1.0, help="wire time over wall time")
    parser.add_argument("--seed", type=int, default=None, help="default: the scene's")
    parser.add_argument("--boards", default="", help="names, with commas; default: every board")
    parser.add_argument("--faults", type=Path, help="TOML file with a [faults] table")
    parser.add_argument("--fault", action="append", default=[], metavar="[BOARD.]KEY=VALUE", help="a single fault")
    parser.add_argument("--no-wait", action="store_true", help="send whether or not the receiver keeps up")
    parser.add_argument(
        "--real-pacing",
        action="store_true",
        help="each packet by itself when it is due; takes a core; not with waiting",
    )
    parser.add_argument("--report", type=Path, help="JSON file for what was counted, written at the end")
    parser.add_argument("--cache", type=Path, help="folder where the scene's object fields are kept between runs")
    return parser


def _check_arguments(args: argparse.Namespace, known: tuple[str, ...]) -> tuple[str, ...]:
    if args.time_scale <= 0:
        raise ConfigError(f"--time-scale {args.time_scale}", "time runs forwards", "give a number above 0")
    if args.scene is None and not args.pattern:
        raise ConfigError("neither --scene nor --pattern", "the cards need something to send", "give one of them")
    names = tuple(args.boards.split(",")) if args.boards else known
    if unknown := sorted(set(names) - set(known)):
        raise ConfigError(f"--boards {','.join(unknown)}: no such board", f"the boards are {known}", "correct it")
    return names


def _source(args: argparse.Namespace, rig: Instrument, scene: Scene | None, names: tuple[str, ...]) -> SignalSource:
    if scene is None or args.pattern:
        return PatternSource(rig)
    radars = SimulatedRig(rig, scene, args.seed, args.cache)
    recorded = [b.name for b in rig.recorded if b.name in names]
    if recorded:
        radars.prepare(*recorded)  # now, so that the first burst of a scan does not wait for it
    return radars


def _run(args: argparse.Namespace, stop: Event, open_things: ExitStack) -> None:
    rig = load_instrument(args.config)
    known = tuple(b.name for b in rig.boards)
    names = _check_arguments(args, known)
    scene = None if args.scene is None else load_scene(args.scene)
    base = {} if scene is None else {"loss": scene.disturbances.packet_loss}
    faults = read_faults(args.faults, args.fault, known, base, rig.radar.control)
    seed = args.seed if args.seed is not None else 0 if scene is None else scene.seed
    source = _source(args, rig, scene, names)
    power_cycle = Event()
    signal.signal(signal.SIGUSR1, lambda _signal, _frame: power_cycle.set())
    pace = Pace(not (args.no_wait or args.real_pacing), args.real_pacing)
    cards: list[SimulatedCard] = []
    open_things.callback(lambda: _report(cards, args.report))
    for name in names:
        board = rig.by_name(name)
        cards.append(SimulatedCard(rig, board, source, faults[name], seed, args.time_scale, time.monotonic, pace))
    lines = tuple(sorted({card.line for card in cards} | {rig.pi.trigger_in}))
    wires = open_things.enter_context(closing(WireClient(args.wires, lines, motion=True)))
    disturbed = Disturbances() if scene is None else scene.disturbances
    track = StageTrack(rig, disturbed.burst_motion, disturbed.backlash_mm)
    control: list[LineServer] = []
    chips: list[RadarSocket] = []
    for card in cards:
        if card.radar is not None:
            chips.append(RadarSocket(rig.radar.native[card.board.name].usb_serial, card.radar))
            open_things.callback(chips[-1].close)
    if rig.radar.control == "line_server":
        for card in cards:
            name = card.board.name
            control.append(LineServer(rig.radar.servers[name], card.rearm, faults[name]))
            open_things.callback(control[-1].close)
    server = CardServer(rig, cards, wires, args.time_scale, time.monotonic, track, power_cycle, control, chips)
    open_things.callback(server.close)
    announce_ready(", ".join(f"{c.board.name} at {c.board.card_address}" for c in cards))
    server.serve(stop)


def _report(cards: list[SimulatedCard], path: Path | None) -> None:
    """What each card counted: one line each on stderr, all of it into the file; then the sockets are closed."""
    reports = {card.board.name: card.report() for card in cards}
    for name, report in reports.items():
        sys.stderr.write(f"{name}: " + ", ".join(f"{k} {v}" for k, v in report.items() if v != 0) + "\n")
    if path is not None:
        path.write_text(json.dumps({"simulated": True, "boards": reports}, indent=2) + "\n", encoding="utf-8")
    for card in cards:
        card.close()


def main(argv: list[str] | None = None) -> int:
    """Run the cards until SIGTERM or SIGINT."""
    args = _parser().parse_args(argv)
    stop = stop_requested()
    die_with_parent()
    try:
        with ExitStack() as open_things:
            _run(args, stop, open_things)
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
