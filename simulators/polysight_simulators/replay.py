"""A simulated capture card that replays a recording: it answers commands and streams a .bin file after record start.

    python -m polysight_simulators.replay FILE.bin --rate-mbit 40
    python -m polysight_simulators.replay SCAN --board RH --row 12

Any program for a DCA1000 can record from it; the content of the file does not matter. Specification:
docs/spec/simulated-rig.md.
"""

from __future__ import annotations

import argparse
import json
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import numpy as np
from numpy.typing import NDArray

from polysight_shared.errors import ConfigError, DataError
from polysight_simulators.cards import MAC, CardEndpoint, Clock, EventKind, Network, Pace
from polysight_simulators.faults import OF_CONTROL, read_faults
from polysight_simulators.process import announce_ready, command_line, run_until_stopped

_OF_PULSES = ("overflow", "ddr_full", "missed_pulse", "miss_pulses", *(kind.value for kind in EventKind))
_OF_RADARS = tuple(key for keys in OF_CONTROL.values() for key in keys)
# Default name of the board
BOARD = "card"
IDLE_S = 0.1
PLAYING_S = 0.002
_MAX_QUEUED_BYTES = 1 << 20


class Recording:
    """A recording as LVDS data, of at most `max_bytes`; with `loop` it starts again at its end.

    Raises DataError if the file is missing or empty.
    """

    def __init__(self, path: Path, max_bytes: int | None = None, loop: bool = False) -> None:
        if not path.is_file() or path.stat().st_size == 0:
            raise DataError(f"{path}: nothing to replay", "not a file, or an empty one", "give a recorded .bin file")
        self._data = np.memmap(path, np.uint8, "r")
        # None: without end
        self._left = max_bytes
        if not loop:
            if max_bytes is None:
                self._left = len(self._data)
            else:
                self._left = min(max_bytes, len(self._data))
        self._at = 0

    @property
    def ended(self) -> bool:
        """True if all of it was read."""
        return self._left == 0

    def read(self, n: int) -> NDArray[np.uint8]:
        """Return the next n bytes; fewer or none at the end."""
        n = min(n, len(self._data) - self._at)
        if self._left is not None:
            n = min(n, self._left)
            self._left -= n
        data = self._data[self._at : self._at + n]
        self._at = (self._at + n) % len(self._data)
        return np.asarray(data)


def scan_rows(scan: Path, board: str, row: int | None) -> list[Path]:
    """List the files of a board's committed rows in a scan folder, or that of one `row`.

    Raises DataError if the manifest has no such rows.
    """
    manifest = scan / "manifest.jsonl"
    files: dict[int, Path] = {}
    try:
        lines = manifest.read_text(encoding="utf-8").splitlines()
    except OSError as e:
        raise DataError(f"{manifest}: {e.strerror}", "not a scan folder", "give a .bin file or a scan folder") from None
    for line in lines:
        try:
            fact = json.loads(line)
            if fact["fact"] == "row_committed" and board in fact["boards"]:
                files[fact["row"]] = scan / fact["boards"][board]["file"]
        except (ValueError, KeyError, TypeError):
            # `polysight validate` reports damaged lines
            continue
    rows = sorted(files)
    if row is not None:
        rows = [r for r in rows if r == row]
    if not rows:
        raise DataError(
            f"{manifest}: no committed row {'' if row is None else row} of board {board}",
            "the scan has none, or the board has another name",
            f"`polysight validate {scan}` lists the rows of a scan",
        )
    return [files[r] for r in rows]


class Player:
    """Feed recordings to a card, one for each record, at an LVDS data rate of `bytes_per_s` in wall time."""

    def __init__(
        self, endpoint: CardEndpoint, recordings: Iterator[Recording], bytes_per_s: float, clock_s: Clock
    ) -> None:
        self._endpoint = endpoint
        self._recordings = recordings
        self._bytes_per_s = bytes_per_s
        self._clock_s = clock_s
        self._records = 0
        self._playing: Recording | None = None
        self._fed_to_s = 0.0

    def turn(self) -> float:
        """Do what is due; return the seconds until the next call."""
        self._endpoint.serve_commands()
        card = self._endpoint.card
        now = self._clock_s()
        if card.records != self._records:
            self._records = card.records
            self._playing = next(self._recordings)
            self._fed_to_s = now
        if not card.recording:
            self._playing = None
        if self._playing is not None:
            self._feed(self._playing, now)
        wait = self._endpoint.flush()
        if wait is None and self._playing is None and self._endpoint.due:
            self._endpoint.tick()
            wait = self._endpoint.flush()
        busy = PLAYING_S if self._playing is not None or card.recording else IDLE_S
        if wait is None:
            return busy
        return min(busy, wait)

    def _feed(self, recording: Recording, now: float) -> None:
        room = _MAX_QUEUED_BYTES - self._endpoint.sender.queued_bytes
        due = int((now - self._fed_to_s) * self._bytes_per_s)
        # The radar waits for the network, and does not catch up
        if due > room:
            due = max(0, room)
            self._fed_to_s = now
        else:
            self._fed_to_s += due / self._bytes_per_s
        while due > 0 and not recording.ended:
            data = recording.read(due)
            due -= len(data)
            self._endpoint.counts["lvds_bytes"] += len(data)
            self._endpoint.emit(self._endpoint.card.lvds(data, self._endpoint.wire_s()))
        if recording.ended:
            self._playing = None


def _parser() -> argparse.ArgumentParser:
    parser = command_line(
        "polysight_simulators.replay", str(__doc__).partition("\n")[0], "scans/one --board RH --row 12 --rate-mbit 40"
    )
    parser.add_argument("source", type=Path, help="a .bin file, or a scan folder, each row of which fills one record")
    parser.add_argument("--board", help="board of the scan folder")
    parser.add_argument("--row", type=int, help="only this row of the scan folder")
    parser.add_argument("--card-address", default="127.0.0.180", help="card, on this machine (default: %(default)s)")
    parser.add_argument("--host-address", default="127.0.0.30", help="recording program (default: %(default)s)")
    parser.add_argument("--command-port", type=int, default=4096, help="of card and program (default: %(default)s)")
    parser.add_argument("--data-port", type=int, default=4098, help="of the program (default: %(default)s)")
    parser.add_argument("--rate-mbit", type=float, default=50.0, help="LVDS data rate in Mbit/s (default: %(default)s)")
    parser.add_argument("--loop", action="store_true", help="repeat the recording until record stop")
    parser.add_argument("--frames", type=int, help="end after this number of frames")
    parser.add_argument("--frame-bytes", type=int, default=4096, help="bytes of a frame (default: %(default)s)")
    parser.add_argument("--time-scale", type=float, default=1.0, help="speed relative to a real card")
    parser.add_argument("--no-wait", action="store_true", help="do not wait for the receiver")
    parser.add_argument("--real-pacing", action="store_true", help="send each packet at its own time; needs a core")
    parser.add_argument("--faults", type=Path, help="TOML file with a [faults] table")
    parser.add_argument("--fault", action="append", default=[], metavar="KEY=VALUE", help="a single fault")
    parser.add_argument("--seed", type=int, default=0, help="seed of the faults")
    parser.add_argument("--report", type=Path, help="JSON file for the counters, written at the end")
    return parser


def _check(args: argparse.Namespace) -> None:
    for name in ("rate_mbit", "time_scale", "frame_bytes", "frames"):
        value = getattr(args, name)
        if value is not None and value <= 0:
            raise ConfigError(f"--{name.replace('_', '-')} {value}", "nothing would be sent", "give a number above 0")
    if args.source.is_dir() and not args.board:
        raise ConfigError("no --board", f"{args.source} is a folder, a scan has several boards", "give --board NAME")
    if not args.source.is_dir() and args.row is not None:
        raise ConfigError("--row without a scan folder", f"{args.source} is one recording", "leave it out")


def _recordings(files: list[Path], max_bytes: int | None, loop: bool) -> Iterator[Recording]:
    while True:
        for path in files:
            yield Recording(path, max_bytes, loop)


def _run(args: argparse.Namespace, stop: Event) -> None:
    _check(args)
    name = args.board or BOARD
    if args.source.is_dir():
        files = scan_rows(args.source, name, args.row)
    else:
        files = [args.source]
    max_bytes = None
    if args.frames is not None:
        max_bytes = args.frames * args.frame_bytes
    for path in files:
        # Raises DataError before the start
        Recording(path)
    faults = read_faults(args.faults, args.fault, (name,))[name]
    if useless := [key for key in (*_OF_PULSES, *_OF_RADARS) if getattr(faults, key)]:
        cause = "a replay has no SYNC_IN pulses, radars or frames"
        raise ConfigError(f"faults {useless}", cause, "leave them out")
    network = Network(args.host_address, args.card_address, MAC, args.command_port, args.data_port)
    pace = Pace(not (args.no_wait or args.real_pacing), args.real_pacing)
    endpoint = CardEndpoint(
        name=name,
        network=network,
        faults=faults,
        seed=args.seed,
        time_scale=args.time_scale,
        clock_s=time.monotonic,
        pace=pace,
        lanes=None,
    )
    try:
        bytes_per_s = args.rate_mbit * 1e6 / 8 * args.time_scale
        player = Player(endpoint, _recordings(files, max_bytes, args.loop), bytes_per_s, time.monotonic)
        announce_ready(f"{args.source.name} at {args.card_address}:{args.command_port} for {args.host_address}")
        wait = 0.0
        while not stop.is_set():
            select.select([endpoint], [], [], wait)
            wait = player.turn()
        report = endpoint.report()
    finally:
        endpoint.close()
    sys.stderr.write(f"{name}: " + ", ".join(f"{k} {v}" for k, v in report.items() if v != 0) + "\n")
    if args.report is not None:
        args.report.write_text(json.dumps({"simulated": True, "boards": {name: report}}, indent=2) + "\n", "utf-8")


def main(argv: list[str] | None = None) -> int:
    """Replay until SIGTERM or SIGINT."""
    args = _parser().parse_args(argv)
    return run_until_stopped(lambda stop: _run(args, stop))


if __name__ == "__main__":
    sys.exit(main())
