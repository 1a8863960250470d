"""`python -m polysight_simulators.radars TRACE`: replay the host's side of a trace to a simulated board.

Prints where the simulated board answers differently from the traced one: a limit of the simulator, or a fault of the
traced board. Format of the trace: docs/spec/mmwavelink.md.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

from polysight_simulators.process import make_parser
from polysight_simulators.radars.board import FUNCTIONAL_LEVELS, RadarBoard
from polysight_simulators.radars.cores import make_image

# If the traced board raised its interrupt, the simulated clock advances in these steps until the simulated board
# raises its own, at most for this timeout. Chosen; the timeout is longer than the start of a board.
_STEP_S = 1e-4
_TIMEOUT_S = 15.0


class _Time:
    """The trace's time, seconds, which the simulated board reads."""

    def __init__(self) -> None:
        self.s = 0.0

    def now(self) -> float:
        return self.s


def replay(trace: Path, make: Callable[[Callable[[], float]], RadarBoard]) -> list[str]:
    """Return a line for each read of the trace that the board answers differently; what else it sends is not compared.

    `make` creates the board from its clock. In a trace, "out" is what the host wrote to the board, "in" what it read.

    Raises OSError, ValueError if the file is not a trace; a damaged line may also raise KeyError, TypeError,
    AttributeError or RecursionError.
    """
    time = _Time()
    board = make(time.now)
    differences = []
    if not trace.is_file():
        raise ValueError("not a regular file")
    lines = trace.read_text(encoding="utf-8").splitlines()
    first = None
    if lines:
        first = json.loads(lines[0])
    if len(lines) < 2 or not isinstance(first, dict) or first.get("trace") != 1:
        raise ValueError("not a trace of version 1, or an empty one")
    for number, line in enumerate(lines, 1):
        record = json.loads(line)
        time.s = max(time.s, record.get("t", 0.0))
        if record.get("line") == "NRST":
            # Set before the release of the reset, at which the board reads its mode from the sense-on-power pins.
            board.set_sense_lines(FUNCTIONAL_LEVELS)
            board.reset(held=not record["level"])
        elif record.get("line") == "HOST_INTR" and record["level"]:
            until = time.s + _TIMEOUT_S
            while not board.interrupt and time.s < until:
                time.s += _STEP_S
            if not board.interrupt:
                differences.append(f"line {number}: the simulated board sends nothing here")
        elif "out" in record:
            for word in _list_words(record["out"]):
                board.write_word(word)
        elif "in" in record:
            sent_words = [board.read_word() for _ in _list_words(record["in"])]
            if sent_words != _list_words(record["in"]):
                sent_hex = b"".join(w.to_bytes(2, "little") for w in sent_words).hex()
                differences.append(f"line {number}: the traced board sent {record['in']}, the simulated one {sent_hex}")
    return differences


def _list_words(text: str) -> list[int]:
    raw = bytes.fromhex(text)
    return [int.from_bytes(raw[offset : offset + 2], "little") for offset in range(0, len(raw), 2)]


def main() -> int:
    """Return 0 if the simulated board answers the same, 1 if not, 2 if the trace cannot be read."""
    parser = make_parser("polysight_simulators.radars", str(__doc__), "first-day.jsonl")
    parser.add_argument("trace", type=Path, metavar="TRACE", help="file of `polysight radar check BOARD --trace FILE`")
    parser.add_argument("--empty-flash", action="store_true", help="simulate a new board")
    args = parser.parse_args()
    flash = b""
    if not args.empty_flash:
        flash = make_image()
    try:
        differences = replay(args.trace, lambda now: RadarBoard(now, flash=flash))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as e:
        sys.stderr.write(f"{args.trace}: {e}\n")
        return 2
    sys.stdout.write("\n".join(differences or ["the simulated board answers the same"]) + "\n")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
