"""Two capture cards at once, paced, into real row files, with the processing of rows running beside them."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from benchmarks.cards import Cards
from benchmarks.child import Child, ask
from benchmarks.trial import HEAD, PlainLoops, Receivers
from polysight_shared.config import load_instrument

RIG = Path(__file__).parents[1] / "instrument.toml"


def highest(sink: Receivers | PlainLoops, beside: Child | None, low: float, high: float, seconds: float) -> float:
    """The highest rate without loss that was reached, by bisection to 5 %, or `low`; `high` is tried first.

    Where the senders cannot keep the pace, the rate they reached counts, and nothing above is tried.
    """
    best, rate = 0.0, high
    while high > 1.05 * low:
        trial = sink.try_rate(rate, seconds, beside)
        show(trial.line())
        if trial.good:
            best = max(best, trial.rate)
        if trial.good and rate == high:
            break
        if trial.good and trial.paced:
            low = rate
        else:
            high = rate
        rate = (low * high) ** 0.5
    return best or low


def show(text: str) -> None:
    """Print now."""
    print(text, flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--seconds", type=float, default=60.0, help="of the run at the highest rate (default 60)")
    parser.add_argument("--search-seconds", type=float, default=3.0, help="of each step of the search (default 3)")
    parser.add_argument("--rate", type=float, default=0.0, help="packets/s of both cards; no search then")
    parser.add_argument("--highest", type=float, default=140_000.0, help="the search ends there (default 140000)")
    parser.add_argument("--alone", action="store_true", help="no processing of rows beside the capture")
    parser.add_argument("--no-compare", action="store_true", help="no plain loop for comparison")
    parser.add_argument("--folder", type=Path, default=None, help="where row files go (default: a temporary folder)")


def run(args: argparse.Namespace) -> int:
    """Search, hold, compare; 1 when the held rate lost something."""
    rig = load_instrument(RIG)
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="polysight-bench-", dir=args.folder))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        cards = Cards(rig, RIG, folder, stack)
        with ExitStack() as ours:
            sink = Receivers(cards, ours)
            show(f"{len(cards.boards)} cards, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {sink.text}")
            show(HEAD)
            show(sink.try_rate(20_000, 2.0, None).line())  # also makes the row that is processed beside
            beside = None
            if not args.alone:
                beside = Child("benchmarks.processing", RIG, folder / f"{cards.boards[0].name}.bin")
                stack.callback(beside.close)
                idle = ask(beside)
                time.sleep(4.0)
                now = ask(beside)
                show(f"processing alone: {(now['rows'] - idle['rows']) / 4.0:.2f} rows/s of {now['frames']} frames")
            rate = args.rate or highest(sink, beside, 20_000, args.highest, args.search_seconds)
            held = sink.try_rate(rate, args.seconds, beside)
            show(held.line())
            while not args.rate and not held.good and rate > 20_000:
                rate *= 0.93
                held = sink.try_rate(rate, args.seconds, beside)
                show(held.line())
        if args.no_compare:
            return 0 if held.good else 1
        with ExitStack() as theirs:
            show("plain recv_into loops that only count:")
            plain = PlainLoops(cards, theirs)
            same = plain.try_rate(rate, args.search_seconds, beside)
            show(same.line())
            best = highest(plain, beside, 10_000, args.highest, args.search_seconds) if not args.rate else 0.0
        ours_cpu, plain_cpu = (sum(t.cpu) / t.rate * 1e6 for t in (held, same))
        show(
            f"at {rate:.0f} packets/s: {ours_cpu:.1f} us of CPU a packet, plain loop {plain_cpu:.1f} us and"
            f" {same.lost} of {same.packets} lost: ratio {plain_cpu / ours_cpu:.2f}"
        )
        if best:
            show(f"highest rate without loss: {rate:.0f}, plain loop {best:.0f}: ratio {rate / best:.2f}")
    return 0 if held.good else 1
